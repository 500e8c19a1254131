"""How a number is called and written for a person: names, units, digits, changes."""

from __future__ import annotations

from dataclasses import dataclass

from gns_model.measures import WINDOW_LENGTH
from gns_model.scene import Scene

#: Relative change that says nothing: two layouts whose measures differ by less are called the same.
#: By how much the comparison of two layouts changes with the filling of the release, rounded up
#: (`python benchmarks/fillings.py`).
REPEATABILITY = {
    "centroid_travel": 0.002,
    "upstream_depth": 0.03,
    "runout_p99": 0.02,
}
OTHERWISE = 0.01

NBSP = "\u00a0"

NUMERALS = ("No", "One", "Two", "Three", "Four", "Five", "Six", "Seven", "Eight", "Nine")


@dataclass(frozen=True)
class Quantity:
    """A measure as it is shown: value in SI times `factor`, with `digits` decimals of `unit`."""

    name: str
    title: str
    unit: str
    factor: float
    digits: int
    #: -1: less is better; +1: more is better; 0: reported only.
    sense: int
    explanation: str

    def text(self, value: float | None, *, unit: bool = True) -> str:
        """The value as text; an en dash where there is none."""
        if value is None:
            return "–"
        number = f"{value * self.factor:.{self.digits}f}".replace("-", "−")
        return f"{number}{NBSP}{self.unit}" if unit else number


def quantities(scene: Scene | None) -> list[Quantity]:
    """The measures in the order of the report: the objective's first, the paper's runout last."""
    section = f"x = {scene.control_section:.2f} m" if scene else "the control section"
    energy = "J" if scene is None or scene.dim == 3 else "J/m"
    return [
        Quantity(
            "centroid_travel",
            "Centroid travel",
            "m",
            1,
            3,
            -1,
            "How far the centre of mass has moved downstream at the end.",
        ),
        Quantity(
            "upstream_depth",
            "Peak depth upstream of a baffle",
            "m",
            1,
            3,
            -1,
            f"Deepest flow in the {100 * WINDOW_LENGTH:.0f} cm before a baffle; without baffles "
            "the deepest in windows of the same size.",
        ),
        Quantity(
            "runout_p99",
            "Runout, 99th percentile",
            "m",
            1,
            3,
            -1,
            "Travel of the front that 1 % of the mass lies beyond.",
        ),
        Quantity(
            "mass_past_section",
            f"Mass past {section}",
            "%",
            100,
            2,
            -1,
            "Share of the mass beyond the control section at the end.",
        ),
        Quantity(
            "overtopping",
            "Mass over a baffle's top",
            "%",
            100,
            2,
            -1,
            "Share of the mass that crossed above the plan of a baffle at some time.",
        ),
        Quantity(
            "energy_dissipated",
            "Energy dissipated",
            energy,
            1,
            0,
            0,
            "Potential and kinetic energy lost from start to end; mass held high keeps some.",
        ),
        Quantity(
            "runout_max",
            "Farthest grain",
            "m",
            1,
            3,
            0,
            "The paper's runout. Single grains decide it: reported, never optimised.",
        ),
    ]


def relative(value: float | None, reference: float | None) -> float | None:
    """(value - reference) / |reference|, or None where that says nothing."""
    if value is None or reference is None or abs(reference) < 1e-12:
        return None
    return (value - reference) / abs(reference)


def percent(value: float | None, digits: int = 1) -> str:
    """A signed share as per cent, with a true minus; an en dash where there is none."""
    if value is None:
        return "–"
    return f"{100 * value:+.{digits}f}{NBSP}%".replace("-", "−")


def share(value: float) -> str:
    """A share without its sign, as per cent."""
    return f"{abs(100 * value):.1f}{NBSP}%"


def verdict(change: float | None, sense: int, name: str = "centroid_travel") -> str:
    """ "better", "worse", "same", or "" where neither is meant, of a change in a measure."""
    if change is None or sense == 0:
        return ""
    if negligible(change, name):
        return "same"
    return "better" if change * sense > 0 else "worse"


def negligible(change: float, name: str = "centroid_travel") -> bool:
    """Whether a relative change of a measure is within the repeatability of the solver."""
    return abs(change) < REPEATABILITY.get(name, OTHERWISE)


def count(number: int, noun: str) -> str:
    """ "Three baffles", "One baffle", "12 baffles"."""
    numeral = NUMERALS[number] if number < len(NUMERALS) else str(number)
    return f"{numeral} {noun}{'' if number == 1 else 's'}"


def duration(seconds: float) -> str:
    """12.3 s, 4 min 05 s, 2 h 10 min."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    if seconds < 3600:
        return f"{int(seconds // 60)} min {int(seconds % 60):02d} s"
    return f"{int(seconds // 3600)} h {int(seconds % 3600 // 60):02d} min"

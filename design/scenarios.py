"""Robust design: the flows that a layout has to stand, drawn from ranges.

| flag         | unit     | default range, about the scene's own flow |
|--------------|----------|-------------------------------------------|
| `--speed`    | m/s      | 0.8 to 1.2 times the scene's              |
| `--volume`   | [-]      | 0.8 to 1.2 times the scene's              |
| `--friction` | degrees  | 5 less to 5 more than the material's      |

A default range is cut to what the learned simulator was trained for; a range that is given is
taken as it is, and the simulator warns of what it never saw. The flows are a Latin hypercube: each
range is divided into as many equal parts as there are flows, and every part holds one of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import qmc

from design.risk import MEAN, Risk
from gns_env.scenario import VOLUME_RATIO, Scenario, ScenarioSpace
from gns_model.errors import GnsError
from gns_model.scene import Scene

#: Default ranges: shares of the scene's speed and volume, degrees about its friction angle.
SPEED, VOLUME, FRICTION = (0.8, 1.2), (0.8, 1.2), 5.0
#: Most flows: each costs a rollout for every layout.
MOST = 256

Range = tuple[float, float]


class ScenarioError(GnsError, ValueError):
    """Scenarios that cannot be drawn."""


@dataclass(frozen=True, kw_only=True)
class Scenarios:
    """What to draw, and what to make of it.

    Attributes:
        count: how many flows.
        speed: range of the fastest release's speed [m/s]; None: the default.
        volume: range of the volume released, relative to the scene's [-]; None: the default.
        friction: range of the friction angle [degrees]; None: the default.
        risk: of their costs, what a search makes small.
        seed: of the draw.

    Raises:
        ScenarioError: for a count out of range, or a range that is none.
    """

    count: int
    speed: Range | None = None
    volume: Range | None = None
    friction: Range | None = None
    risk: Risk = MEAN
    seed: int = 0

    def __post_init__(self) -> None:
        if not 1 <= self.count <= MOST:
            raise ScenarioError(f"scenarios must be 1 to {MOST}, got {self.count}")
        for name in ("speed", "volume", "friction"):
            given = getattr(self, name)
            if given is not None and not (np.isfinite(given).all() and 0 <= given[0] <= given[1]):
                raise ScenarioError(f"{name} must be a range low:high, got {given[0]}:{given[1]}")
        if self.volume and not 1 / VOLUME_RATIO <= self.volume[0] <= self.volume[1] <= VOLUME_RATIO:
            raise ScenarioError(
                f"volume is relative to the scene's and must lie in {1 / VOLUME_RATIO:g} to "
                f"{VOLUME_RATIO:g}, got {self.volume[0]:g}:{self.volume[1]:g}"
            )

    def draw(self, scene: Scene, simulator: Any = None) -> tuple[list[Scenario], list[str]]:
        """The flows, and a line for every range that the simulator's training cut.

        Raises:
            InvalidScenario: if a range is wider than a scenario may be.
        """
        limits = getattr(getattr(simulator, "config", None), "limits", None)
        space = ScenarioSpace(scene)
        own, notes = space.own, []
        ranges = {
            "volume": _scaled(self.volume or VOLUME, own.volume),
            "speed": self.speed or _scaled(SPEED, own.speed),
            "friction_angle": self.friction
            or (max(own.friction_angle - FRICTION, 1.0), own.friction_angle + FRICTION),
        }
        # What "random" draws is cut to the limits already; where nobody asked, so are we.
        usual = ScenarioSpace(scene, limits=limits).usual
        for name, given in (
            ("volume", self.volume),
            ("speed", self.speed),
            ("friction_angle", self.friction),
        ):
            low, high = ranges[name]
            if given is None and limits is not None:
                trained = usual[name]
                cut = max(low, trained[0]), min(high, trained[1])
                if cut[0] > cut[1]:
                    cut = (getattr(own, name),) * 2
                if not np.allclose(cut, (low, high), rtol=1e-6):
                    notes.append(_cut(name, cut, simulator.name))
                ranges[name] = cut
        space = ScenarioSpace(scene, ranges)  # checks them
        unit = qmc.LatinHypercube(d=len(ranges), seed=self.seed).random(self.count)
        drawn = []
        for row in unit:
            values: dict[str, Any] = {
                name: float(low + share * (high - low))
                for share, (name, (low, high)) in zip(row, ranges.items(), strict=True)
            }
            drawn.append(replace(own, **values))
        return drawn, notes

    def describe(self) -> dict[str, Any]:
        """The options that drew the scenarios, as words for the same command."""
        ranges = {name: getattr(self, name) for name in ("speed", "volume", "friction")}
        return {
            "count": self.count,
            **{name: f"{r[0]:g}:{r[1]:g}" for name, r in ranges.items() if r is not None},
            "risk": self.risk.kind,
            **({"level": self.risk.level} if self.risk.kind == "cvar" else {}),
        }


def scenes(scene: Scene, drawn: list[Scenario]) -> list[Scene]:
    """The scene with each flow of `drawn`.

    Raises:
        SceneError: if a release then leaves the domain.
    """
    space = ScenarioSpace(scene)
    return [space.apply(scenario) for scenario in drawn]


def widest(flows: list[Scene]) -> Scene:
    """The flow whose releases take the most room: what is clear of them is clear of all.

    Releases grow about one place when a volume does, so the largest covers the others.
    """
    return max(flows, key=lambda s: sum(float(np.prod(r.size)) for r in s.releases))


def parse_range(name: str, text: str | None) -> Range | None:
    """A range "low:high", or one number for a range without width.

    Raises:
        ScenarioError: if it is none.
    """
    if text is None:
        return None
    try:
        numbers = [float(part) for part in text.split(":")]
        low, high = numbers if len(numbers) == 2 else (*numbers, *numbers)
    except (ValueError, TypeError):
        raise ScenarioError(f"--{name} must be a range low:high, got {text!r}") from None
    return low, high


def scenarios_of(
    count: int | None,
    speed: str | None,
    volume: str | None,
    friction: str | None,
    risk: str | None,
    level: float | None,
    seed: int,
) -> Scenarios | None:
    """What the options of the command ask for; None if they ask for no scenarios.

    Raises:
        ScenarioError, RiskError: if they do not go together or one is out of range.
    """
    given = {"speed": speed, "volume": volume, "friction": friction}
    if count is None:
        options = {**given, "risk": risk, "cvar-level": level}
        alone = next((name for name, value in options.items() if value is not None), None)
        if alone is not None:
            raise ScenarioError(f"--{alone} says how scenarios are drawn: give --scenarios N too")
        return None
    if level is not None and risk != "cvar":
        raise ScenarioError("--cvar-level goes with --risk cvar")
    if risk not in (None, "mean", "cvar"):
        raise ScenarioError(f"risk must be mean or cvar, got {risk!r}")
    chosen = Risk("cvar" if risk == "cvar" else "mean", Risk.level if level is None else level)
    ranges = {name: parse_range(name, text) for name, text in given.items()}
    return Scenarios(count=count, risk=chosen, seed=seed, **ranges)


def _scaled(shares: Range, value: float) -> Range:
    return shares[0] * value, shares[1] * value


def _cut(name: str, cut: Range, simulator: str) -> str:
    what, unit = {
        "volume": ("volume", "m³"),
        "speed": ("speed", "m/s"),
        "friction_angle": ("friction angle", "degrees"),
    }[name]
    if cut[0] == cut[1]:
        return f"scenarios: the {what} stays at {cut[0]:.4g} {unit}, all that {simulator} has seen"
    return (
        f"scenarios: the {what} is drawn from {cut[0]:.4g} to {cut[1]:.4g} {unit}, as far as "
        f"{simulator} was trained"
    )

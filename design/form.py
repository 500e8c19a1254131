"""Size and yaw of the baffles of a layout, and which of them a search may choose.

All baffles of a layout have one form, for a contractor casts them in one formwork. Each variable is
a column of the layout, in metres: a yaw is the way that the corner of the nominal baffle goes when
it turns, so that a centimetre is about as much of a change in every column, and searches and
distances need not tell them apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gns_model.errors import LayoutError
from gns_model.footprint import wrap
from gns_model.parts import TOLERANCE
from gns_model.placement import Placement, Vary

#: Variables of a form, in the order of their columns; the sizes in the order of `Baffle.size`.
FORM = ("along", "height", "across", "yaw")


@dataclass(frozen=True)
class Form:
    """Size of every baffle of a layout [m], shape (D,), and its yaw [degrees]."""

    size: tuple[float, ...]
    yaw: float = 0.0


class Forms:
    """The forms that a placement lets a search choose.

    Args:
        own: the nominal form, which a layout has where nothing varies.
        ceiling: height of the domain [m].

    Attributes:
        names: the variables, some of `FORM`.
        lower, upper: their bounds [m].
        nominal: the variables of `own` [m].
        degree: a degree of yaw, in its column [m].
        notes: what was cut from the ranges, and why.

    Raises:
        LayoutError: if a range lies outside the limits altogether.
    """

    def __init__(self, placement: Placement, own: Form, ceiling: float) -> None:
        vary = placement.vary or Vary()
        self.own = own
        #: Way of a corner that turns by a radian [m].
        self._arm = math.hypot(own.size[0], *own.size[2:]) / 2
        self._max_height, self._max_volume = placement.max_height, placement.max_volume
        self.names = tuple(name for name in FORM if getattr(vary, name) is not None)
        self.notes: list[str] = []
        self.lower, self.upper = self._bounds(vary, ceiling)
        self.nominal = self.columns(own)
        self.degree = math.radians(1.0) * self._arm

    def _bounds(self, vary: Vary, ceiling: float) -> tuple[np.ndarray, np.ndarray]:
        ends = []
        for name in self.names:
            low, high = getattr(vary, name)
            if name == "yaw":
                ends.append([math.radians(low) * self._arm, math.radians(high) * self._arm])
                continue
            if name == "height":
                limit, cause = ceiling, "the height of the domain"
                most = self._max_height
                if most is not None and most < limit:
                    limit, cause = most, "max_height"
                if low > limit + TOLERANCE:
                    raise LayoutError(
                        f"height {low:g} to {high:g} m lies above {cause}, {limit:g} m: {cause} "
                        "is to blame"
                    )
                if high > limit + TOLERANCE:
                    self.notes.append(f"height is varied up to {limit:g} m, {cause}")
                high = min(high, limit)
            ends.append([low, high])
        return tuple(np.array(ends, dtype=float).reshape(-1, 2).T.copy())  # type: ignore[return-value]

    def columns(self, form: Form) -> np.ndarray:
        """The variables of a form [m], shape (len(names),)."""
        sizes = dict(zip(("along", "height", "across"), form.size, strict=False))
        turn = {"yaw": math.radians(form.yaw) * self._arm}
        return np.array([{**sizes, **turn}[name] for name in self.names])

    def form(self, values: np.ndarray) -> Form:
        """The form of variables [m]; what has none is as the nominal form has it."""
        size, yaw = list(self.own.size), self.own.yaw
        for name, value in zip(self.names, values, strict=True):
            if name == "yaw":
                yaw = wrap(math.degrees(value / self._arm))
            else:
                size[FORM.index(name)] = float(value)
        return Form(tuple(size), yaw)

    def unit(self, values: np.ndarray) -> np.ndarray:
        """Variables [m] within their bounds, 0 to 1; half where the bounds leave no choice."""
        width = self.upper - self.lower
        share = (values - self.lower) / np.where(width > 0, width, 1)
        return np.clip(np.where(width > 0, share, 0.5), 0, 1)

    def at_unit(self, unit: ArrayLike) -> np.ndarray:
        """The variables [m] at shares of the way from lower to upper."""
        return self.lower + np.asarray(unit) * (self.upper - self.lower)

    def within(self, n: int, wish: np.ndarray) -> np.ndarray:
        """`wish` within the bounds, shrunk until n baffles keep to max_volume.

        Raises:
            LayoutError: if even the smallest take more.
        """
        wish = np.clip(wish, self.lower, self.upper)
        limit = self._max_volume
        if limit is None:
            return wish
        sizes = np.array([name != "yaw" for name in self.names], dtype=bool)

        def taken(factor: float) -> tuple[np.ndarray, float]:
            shrunk = np.where(sizes, np.maximum(wish * factor, self.lower), wish)
            return shrunk, n * math.prod(self.form(shrunk).size)

        if taken(1.0)[1] <= limit:
            return wish
        least = taken(0.0)[1]
        if least > limit * (1 + 1e-9):
            unit = "m³" if len(self.own.size) == 3 else "m²"
            raise LayoutError(
                f"{n} baffles take {least:.4g} {unit} at least, more than max_volume {limit:g}: "
                "max_volume is to blame"
            )
        low, high = 0.0, 1.0
        for _ in range(50):
            middle = (low + high) / 2
            low, high = (middle, high) if taken(middle)[1] <= limit else (low, middle)
        return taken(low)[0]


def described(layout: ArrayLike, form: Form | None) -> dict[str, Any]:
    """A layout as plain values: `layout`, the centres [m]; and, if a form is given, `size` [m] and
    `yaw` [degrees]."""
    rows = np.round(np.asarray(layout, dtype=float), 6)
    if form is None:
        return {"layout": rows.tolist()}
    values = {"size": [round(s, 6) for s in form.size]}
    return {
        "layout": rows[:, : len(form.size) - 1].tolist(),
        **values,
        **({"yaw": round(form.yaw, 4)} if form.yaw else {}),
    }

"""What a search may choose beside the places: how many baffles, their size, height and yaw.

All baffles of a layout have one form, for a contractor casts them in one formwork. A layout stays
an array of one row a baffle: its centre (x, z), and behind it a column for each variable of the
form that `placement.vary` frees, the same in all rows. Every column is in metres: a yaw is the way
that the corner of the nominal baffle goes when it turns, so that a centimetre is about as much of
a change in every column, and searches and distances need not tell them apart.

A scene that varies nothing has its plain `LayoutSpace`, whose layouts are the centres alone.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from design.blame import room_for
from gns_env.layout import LayoutSpace
from gns_model.errors import LayoutError
from gns_model.footprint import wrap
from gns_model.parts import TOLERANCE
from gns_model.placement import Vary
from gns_model.scene import Placement, Scene

#: Variables of a form, in the order of their columns; the sizes in the order of `Baffle.size`.
FORM = ("along", "height", "across", "yaw")
#: Layout spaces of other forms that are kept.
MOST_SPACES = 256
#: Halvings of the way from a form that does not fit to one that does.
HALVINGS = 6


@dataclass(frozen=True)
class Form:
    """Size of every baffle of a layout [m], shape (D,), and its yaw [degrees]."""

    size: tuple[float, ...]
    yaw: float = 0.0


class DesignSpace:
    """The layouts of a scene whose placement lets the number or the form vary.

    Attributes:
        scene: as given. n_baffles, form: the nominal ones, what a layout without variables has.
        numbers: how many baffles there may be, all that fit, ascending.
        names: variables of the form, some of `FORM`; lower, upper: their bounds [m], in columns.
        notes: what was cut from the ranges, and why.

    Raises:
        LayoutError: if no number of any form fits, with the constraint to blame.
        SceneError: if the scene says nothing about the size of a baffle.
    """

    def __init__(self, scene: Scene, n_baffles: int) -> None:
        self.scene = scene
        placement = scene.placement or LayoutSpace(scene, 1).placement
        vary = placement.vary or Vary()
        self._placement = placement.model_copy(update={"vary": None})
        own = Form(tuple(scene.baffle_size), scene.baffle_yaw)
        self._dim = scene.dim
        #: Way of a corner that turns by a radian [m].
        self._arm = math.hypot(*(own.size[0], *own.size[2:])) / 2
        self.names = tuple(name for name in FORM if getattr(vary, name) is not None)
        self.notes: list[str] = []
        low, high = self._bounds(vary, scene)
        self.lower, self.upper = low, high
        self._nominal = self._columns(own)
        self._own = own
        self._spaces: OrderedDict[tuple[float, ...], LayoutSpace] = OrderedDict()
        asked = range(vary.number[0], vary.number[1] + 1) if vary.number else (n_baffles,)
        self._safe: dict[int, np.ndarray] = {}
        for n in asked:
            try:
                self._safe[n] = self._some_form(n)
            except LayoutError as error:
                fault = error
                self.notes.append(f"{n} baffles are left out: {error}")
        if not self._safe:
            # The fewest are the easiest to fit: what they lack is what to change.
            self.notes.clear()
            n = asked[0]
            self._volume(n)
            raise _blamed(self._at(self.lower), n) or fault
        self.numbers = tuple(self._safe)
        self.n_baffles = min(self.numbers, key=lambda n: (abs(n - n_baffles), n))
        values = self._fit(self.n_baffles, self._nominal)
        self.form = self._form(values)
        #: Of the nominal layout, as of a `LayoutSpace`.
        self.base = self._space(self.n_baffles, values)
        self.placement = self.base.placement.model_copy(update={"vary": placement.vary})

    # -- what a layout is ----------------------------------------------------------------------

    @property
    def columns(self) -> int:
        """Of a layout: coordinates of a centre, then the variables of the form."""
        return self._dim - 1 + len(self.names)

    @property
    def degree(self) -> float:
        """A degree of yaw, in its column [m]."""
        return math.radians(1.0) * self._arm

    @property
    def size(self) -> np.ndarray:
        """Of a nominal baffle [m], shape (D,)."""
        return np.array(self.form.size)

    def split(self, layout: ArrayLike) -> tuple[np.ndarray, Form]:
        """Centres [m], shape (n, D-1), and the form of a layout; of centres alone the nominal one.

        Raises:
            LayoutError: if it is no layout of this space.
        """
        rows = np.asarray(layout, dtype=float)
        plan = self._dim - 1
        if rows.ndim == 2 and rows.shape[1] == plan:
            return rows, self.form
        if rows.ndim != 2 or rows.shape[1] != self.columns or not len(rows):
            raise LayoutError(f"a layout has shape (n, {self.columns}), got {rows.shape}")
        return rows[:, :plan], self._form(rows[:, plan:].mean(axis=0))

    def join(self, centres: ArrayLike, form: Form) -> np.ndarray:
        """The layout of centres [m], shape (n, D-1), and a form."""
        plan = np.asarray(centres, dtype=float)
        return np.column_stack([plan, np.tile(self._columns(form), (len(plan), 1))])

    def at(self, n: int, form: Form) -> LayoutSpace:
        """The buildable places of n baffles of a form.

        Raises:
            LayoutError: if they do not fit.
        """
        return self._space(n, self._columns(form))

    # -- as a LayoutSpace ----------------------------------------------------------------------

    def check(self, layout: ArrayLike) -> list[str]:
        """What is wrong with a layout, one sentence each; empty if nothing."""
        rows = np.asarray(layout, dtype=float)
        centres, _ = self.split(rows)
        if len(centres) not in self.numbers:
            return [f"{len(centres)} baffles, but {self._numbers_text()} can be placed"]
        values = self._values(rows)
        faults = []
        if rows.shape[1] == self.columns and len(values):
            if np.ptp(rows[:, self._dim - 1 :], axis=0).max() > TOLERANCE:
                faults.append("the baffles differ in their form")
            for name, value, low, high in zip(
                self.names, values, self.lower, self.upper, strict=True
            ):
                if not low - TOLERANCE <= value <= high + TOLERANCE:
                    faults.append(f"{name} {value:g} lies outside {low:g} to {high:g}")
        if faults:
            return faults
        try:
            return self._space(len(centres), values).check(centres)
        except LayoutError as error:
            return [str(error)]

    def project(self, layout: ArrayLike) -> np.ndarray:
        """A buildable layout near `layout`: its form first, then the nearest places for that.

        A size that takes too much concrete shrinks by one factor in all variable sizes, as far as
        their bounds let it; a form that leaves no room goes towards one that does. A buildable
        layout comes back unchanged. The number of baffles stays, if it may be placed at all.

        Raises:
            LayoutError: if that many baffles cannot be placed.
        """
        rows = np.asarray(layout, dtype=float)
        if not self.check(rows):
            return rows.copy()
        centres, _ = self.split(rows)
        n = len(centres)
        if n not in self.numbers:
            raise LayoutError(f"{n} baffles, but {self._numbers_text()} can be placed")
        values = self._fit(n, self._values(rows))
        return self._rows(self._space(n, values).project(centres), values)

    def random(self, rng: np.random.Generator) -> np.ndarray:
        """A random buildable layout: number and form uniform, places as `LayoutSpace.random`."""
        n = int(rng.choice(self.numbers))
        values = self._fit(n, rng.uniform(self.lower, self.upper))
        return self._rows(self._space(n, values).random(rng), values)

    # -- the form ------------------------------------------------------------------------------

    def unit(self, layout: ArrayLike) -> np.ndarray:
        """The variables of a layout's form within their bounds, 0 to 1."""
        width = self.upper - self.lower
        values = self._values(np.asarray(layout, dtype=float)) - self.lower
        return np.clip(np.where(width > 0, values / np.where(width > 0, width, 1), 0.5), 0, 1)

    @property
    def nominal_unit(self) -> np.ndarray:
        """The nominal form within the bounds, 0 to 1."""
        return self.unit(self.join(np.zeros((1, self._dim - 1)), self.form))

    def at_unit(self, n: int, unit: Sequence[float] | np.ndarray) -> tuple[LayoutSpace, Form]:
        """The places for about n baffles of the form nearest to `unit` that can be built."""
        n = min(self.numbers, key=lambda k: (abs(k - n), k))
        values = self._fit(n, self.lower + np.asarray(unit) * (self.upper - self.lower))
        return self._space(n, values), self._form(values)

    def _bounds(self, vary: Vary, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
        ends = []
        for name in self.names:
            low, high = getattr(vary, name)
            if name == "yaw":
                ends.append([math.radians(low) * self._arm, math.radians(high) * self._arm])
                continue
            if name == "height":
                limit, cause = scene.domain.size[1], "the height of the domain"
                most = self._placement.max_height
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

    def _columns(self, form: Form) -> np.ndarray:
        sizes = dict(zip(("along", "height", "across"), form.size, strict=False))
        turn = {"yaw": math.radians(form.yaw) * self._arm}
        return np.array([{**sizes, **turn}[name] for name in self.names])

    def _form(self, values: np.ndarray) -> Form:
        size, yaw = list(self._own.size), self._own.yaw
        for name, value in zip(self.names, values, strict=True):
            if name == "yaw":
                yaw = wrap(math.degrees(value / self._arm))
            else:
                size[FORM.index(name)] = float(value)
        return Form(tuple(size), yaw)

    def _values(self, rows: np.ndarray) -> np.ndarray:
        """The form of rows, shape (len(names),); of centres alone the nominal one."""
        if rows.shape[1] == self._dim - 1:
            return self._columns(self.form)
        return rows[:, self._dim - 1 :].mean(axis=0)

    def _rows(self, centres: np.ndarray, values: np.ndarray) -> np.ndarray:
        return np.column_stack([centres, np.tile(values, (len(centres), 1))])

    def _volume(self, n: int, values: np.ndarray | None = None) -> np.ndarray:
        """`values` within the bounds, shrunk until n baffles keep to max_volume.

        Raises:
            LayoutError: if even the smallest take more.
        """
        wish = np.clip(self._nominal if values is None else values, self.lower, self.upper)
        limit = self._placement.max_volume
        if limit is None:
            return wish
        sizes = np.array([name != "yaw" for name in self.names], dtype=bool)

        def taken(factor: float) -> tuple[np.ndarray, float]:
            shrunk = np.where(sizes, np.maximum(wish * factor, self.lower), wish)
            return shrunk, n * math.prod(self._form(shrunk).size)

        if taken(1.0)[1] <= limit:
            return wish
        least = taken(0.0)[1]
        if least > limit * (1 + 1e-9):
            raise LayoutError(
                f"{n} baffles take {least:.4g} {'m³' if self._dim == 3 else 'm²'} at least, more "
                f"than max_volume {limit:g}: max_volume is to blame"
            )
        low, high = 0.0, 1.0
        for _ in range(50):
            middle = (low + high) / 2
            low, high = (middle, high) if taken(middle)[1] <= limit else (low, middle)
        return taken(low)[0]

    def _fit(self, n: int, wish: np.ndarray) -> np.ndarray:
        """The form nearest to `wish` on the way to one that fits of which n baffles fit."""
        values = self._volume(n, wish)
        if self._fits(n, values):
            return values
        safe = self._safe[n]
        good, bad = 1.0, 0.0
        for _ in range(HALVINGS):
            share = (good + bad) / 2
            if self._fits(n, self._volume(n, values + share * (safe - values))):
                good = share
            else:
                bad = share
        return self._volume(n, values + good * (safe - values))

    def _some_form(self, n: int) -> np.ndarray:
        """A form of which n baffles fit, the nominal one if that does."""
        small = np.where([name == "yaw" for name in self.names], self._nominal, self.lower)
        wishes = [self._nominal, small]
        if "yaw" in self.names:
            k = self.names.index("yaw")
            for turn in (0.0, self.lower[k], self.upper[k]):
                wishes.append(small.copy())
                wishes[-1][k] = turn
        for wish in wishes:
            values = self._volume(n, wish)
            if self._fits(n, values):
                return values
        self._space(n, self._volume(n, wishes[1]))  # raises, and says why
        raise AssertionError("a form that did not fit, and now does")  # pragma: no cover

    def _fits(self, n: int, values: np.ndarray) -> bool:
        try:
            self._space(n, values)
        except LayoutError:
            return False
        return True

    def _at(self, values: np.ndarray) -> Scene:
        form = self._form(values)
        placement = self._placement.model_copy(update={"size": form.size, "yaw": form.yaw or None})
        return self.scene.model_copy(update={"baffles": (), "placement": placement})

    def _space(self, n: int, values: np.ndarray) -> LayoutSpace:
        key = (n, *np.round(values, 12).tolist())
        if key in self._spaces:
            self._spaces.move_to_end(key)
        else:
            self._spaces[key] = LayoutSpace(self._at(values), n)
            if len(self._spaces) > MOST_SPACES:
                self._spaces.popitem(last=False)
        return self._spaces[key]

    def _numbers_text(self) -> str:
        return " or ".join(map(str, self.numbers))


#: Where a search may place baffles, and perhaps what else it may choose.
Space = LayoutSpace | DesignSpace


def design_space(scene: Scene, n_baffles: int) -> Space:
    """The space of a scene: a plain one if its placement varies nothing. For rows see `rows`.

    Raises:
        LayoutError: if nothing fits, with the constraint to blame.
        SceneError: if the scene says nothing about the size of a baffle.
    """
    if scene.placement is None or not varies(scene.placement):
        return room_for(scene, n_baffles)
    return DesignSpace(scene, n_baffles)


def varies(placement: Placement) -> bool:
    """Whether a search on this placement may choose more than places."""
    return placement.vary is not None and any(ends is not None for _, ends in placement.vary)


def split(space: Space, layout: ArrayLike) -> tuple[np.ndarray, Form]:
    """Centres [m], shape (n, D-1), and the form of a layout of `space`."""
    if isinstance(space, DesignSpace):
        return space.split(layout)
    return space.as_centres(layout), Form(tuple(map(float, space.size)), space.yaw)


def built(scene: Scene, space: Space, layout: ArrayLike) -> Scene:
    """`scene` with the baffles of a layout of `space` in place of its own.

    Raises:
        SceneError: if a baffle leaves the domain or overlaps a release or another baffle.
    """
    centres, form = split(space, layout)
    return scene.with_baffles(centres, size=form.size, yaw=form.yaw)


def numbers(space: Space) -> tuple[int, ...]:
    """How many baffles a layout may have."""
    return space.numbers if isinstance(space, DesignSpace) else (space.n_baffles,)


def form_of(space: Space, layout: ArrayLike) -> Form | None:
    """The form of a layout where a search may choose it, else None."""
    if isinstance(space, DesignSpace) and space.names:
        return space.split(layout)[1]
    return None


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


def _blamed(scene: Scene, n_baffles: int) -> LayoutError | None:
    try:
        room_for(scene, n_baffles)
    except LayoutError as error:
        return error
    return None

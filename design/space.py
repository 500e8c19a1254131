"""What a search may choose beside the places: how many baffles, their size, height and yaw.

A layout stays an array of one row a baffle: its centre (x, z), and behind it a column for each
variable of the form that `placement.vary` frees, the same in all rows; see `form`.

A scene that varies nothing has its plain `LayoutSpace`, whose layouts are the centres alone.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from design.blame import room_for
from design.form import Form, Forms
from gns_env.layout import LayoutSpace
from gns_model.errors import LayoutError
from gns_model.parts import TOLERANCE
from gns_model.placement import Vary
from gns_model.scene import Placement, Scene

#: Layout spaces of other forms that are kept.
MOST_SPACES = 256
#: Halvings of the way from a form that does not fit to one that does.
HALVINGS = 6


class DesignSpace:
    """The layouts of a scene whose placement lets the number or the form vary.

    Attributes:
        scene: as given. n_baffles, form: the nominal ones, what a layout without variables has.
        numbers: how many baffles there may be, all that fit, ascending.
        forms: which forms there may be; names: their variables, some of `form.FORM`.
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
        self._dim = scene.dim
        own = Form(tuple(scene.baffle_size), scene.baffle_yaw)
        self.forms = Forms(placement, own, scene.domain.size[1])
        self.names, self.notes = self.forms.names, list(self.forms.notes)
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
            self.forms.within(n, self.forms.nominal)
            raise _blamed(self._at(self.forms.lower), n) or fault
        self.numbers = tuple(self._safe)
        self.n_baffles = min(self.numbers, key=lambda n: (abs(n - n_baffles), n))
        values = self._fit(self.n_baffles, self.forms.nominal)
        self.form = self.forms.form(values)
        #: Of the nominal layout, as of a `LayoutSpace`.
        self.base = self._space(self.n_baffles, values)
        self.placement = self.base.placement.model_copy(update={"vary": placement.vary})

    # -- what a layout is ----------------------------------------------------------------------

    @property
    def columns(self) -> int:
        """Of a layout: coordinates of a centre, then the variables of the form."""
        return self._dim - 1 + len(self.names)

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
        return rows[:, :plan], self.forms.form(rows[:, plan:].mean(axis=0))

    def join(self, centres: ArrayLike, form: Form) -> np.ndarray:
        """The layout of centres [m], shape (n, D-1), and a form."""
        plan = np.asarray(centres, dtype=float)
        return np.column_stack([plan, np.tile(self.forms.columns(form), (len(plan), 1))])

    def at(self, n: int, form: Form) -> LayoutSpace:
        """The buildable places of n baffles of a form.

        Raises:
            LayoutError: if they do not fit.
        """
        return self._space(n, self.forms.columns(form))

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
                self.names, values, self.forms.lower, self.forms.upper, strict=True
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
        values = self._fit(n, rng.uniform(self.forms.lower, self.forms.upper))
        return self._rows(self._space(n, values).random(rng), values)

    # -- the form; see `Forms` -----------------------------------------------------------------

    def unit(self, layout: ArrayLike) -> np.ndarray:
        """The variables of a layout's form within their bounds, 0 to 1."""
        return self.forms.unit(self._values(np.asarray(layout, dtype=float)))

    @property
    def nominal_unit(self) -> np.ndarray:
        """The nominal form within the bounds, 0 to 1."""
        return self.unit(self.join(np.zeros((1, self._dim - 1)), self.form))

    def at_unit(self, n: int, unit: Sequence[float] | np.ndarray) -> tuple[LayoutSpace, Form]:
        """The places for about n baffles of the form nearest to `unit` that can be built."""
        n = min(self.numbers, key=lambda k: (abs(k - n), k))
        values = self._fit(n, self.forms.at_unit(unit))
        return self._space(n, values), self.forms.form(values)

    def _values(self, rows: np.ndarray) -> np.ndarray:
        """The form of rows, shape (len(names),); of centres alone the nominal one."""
        if rows.shape[1] == self._dim - 1:
            return self.forms.columns(self.form)
        return rows[:, self._dim - 1 :].mean(axis=0)

    def _rows(self, centres: np.ndarray, values: np.ndarray) -> np.ndarray:
        return np.column_stack([centres, np.tile(values, (len(centres), 1))])

    def _fit(self, n: int, wish: np.ndarray) -> np.ndarray:
        """The form nearest to `wish` on the way to one that fits of which n baffles fit."""
        values = self.forms.within(n, wish)
        if self._fits(n, values):
            return values
        safe = self._safe[n]
        good, bad = 1.0, 0.0
        for _ in range(HALVINGS):
            share = (good + bad) / 2
            if self._fits(n, self.forms.within(n, values + share * (safe - values))):
                good = share
            else:
                bad = share
        return self.forms.within(n, values + good * (safe - values))

    def _some_form(self, n: int) -> np.ndarray:
        """A form of which n baffles fit, the nominal one if that does."""
        forms = self.forms
        small = np.where([name == "yaw" for name in self.names], forms.nominal, forms.lower)
        wishes = [forms.nominal, small]
        if "yaw" in self.names:
            k = self.names.index("yaw")
            for turn in (0.0, forms.lower[k], forms.upper[k]):
                wishes.append(small.copy())
                wishes[-1][k] = turn
        for wish in wishes:
            values = forms.within(n, wish)
            if self._fits(n, values):
                return values
        self._space(n, forms.within(n, wishes[1]))  # raises, and says why
        raise AssertionError("a form that did not fit, and now does")  # pragma: no cover

    def _fits(self, n: int, values: np.ndarray) -> bool:
        try:
            self._space(n, values)
        except LayoutError:
            return False
        return True

    def _at(self, values: np.ndarray) -> Scene:
        form = self.forms.form(values)
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


def _blamed(scene: Scene, n_baffles: int) -> LayoutError | None:
    try:
        room_for(scene, n_baffles)
    except LayoutError as error:
        return error
    return None

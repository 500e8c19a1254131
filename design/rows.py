"""Rows as an engineer draws them: `--pattern rows`, for every method that samples.

Baffles stand in one to three straight rows across the flow, of equal numbers up to one. What a
search chooses is how many rows, where the first one stands and how far apart they are, the spacing
across, how far every second row is shifted (stagger, up to half a spacing) and how far the whole
pattern stands off the middle (offset): six numbers for any number of baffles, beside number and
form. In 2D a row is one baffle, so start and spacing are all.

A pattern that a keep-out or a release does not let stand gives way to the nearest one of a grid
that does.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike
from optuna.distributions import BaseDistribution, FloatDistribution, IntDistribution

from design.baselines import row_counts, rows
from design.distinct import distance
from design.form import Form
from design.space import MOST_SPACES, DesignSpace
from gns_env.layout import LayoutSpace
from gns_model.errors import LayoutError
from gns_model.scene import Scene

#: Parameter for the number of baffles, where it varies.
NUMBER = "number"
#: Parameters of a pattern, each from 0 to 1.
ROWS, FIRST, ALONG, ACROSS, STAGGER, OFFSET = (
    "rows",
    "first_row",
    "spacing_along",
    "spacing_across",
    "stagger",
    "offset",
)
#: Coordinates nearer than this are of one row, and patterns nearer than this one pattern [m].
SAME = 1e-6
#: Finest grid that is looked through for a pattern that may stand.
FINEST = 2


class RowSpace(DesignSpace):
    """The layouts of a scene that are rows; see the module.

    Raises:
        LayoutError: as `DesignSpace`; or if no rows of that many baffles may stand.
    """

    def __init__(self, scene: Scene, n_baffles: int) -> None:
        super().__init__(scene, n_baffles)
        self._grids: dict[tuple[int, Form], list[np.ndarray]] = {}
        self._grid(self.n_baffles, self.form)

    def check(self, layout: ArrayLike) -> list[str]:
        """As `DesignSpace.check`; and whether it is rows."""
        faults = super().check(layout)
        if not faults:
            centres, form = self.split(layout)
            if _read(self.at(len(centres), form), centres) is None:
                faults.append("the baffles do not stand in equal straight rows")
        return faults

    def project(self, layout: ArrayLike) -> np.ndarray:
        """The nearest rows of a grid that may stand; rows that may come back unchanged."""
        if not self.check(layout):
            return np.array(layout, dtype=float)
        near = super().project(layout)
        centres, form = self.split(near)
        grid = self._grid(len(centres), form)
        return self.join(min(grid, key=lambda c: distance(c, centres)), form)

    def random(self, rng: np.random.Generator) -> np.ndarray:
        """Random rows that may stand: every parameter uniform."""
        drawn = {name: rng.uniform() for name in self.distributions()}
        if NUMBER in drawn:
            drawn[NUMBER] = int(rng.choice(self.numbers))
        return self.project(self.to_layout(drawn))

    def distributions(self) -> dict[str, BaseDistribution]:
        """What a sampler may choose: names and ranges."""
        pattern = [ROWS, FIRST, ALONG, ACROSS, STAGGER, OFFSET]
        if self.scene.dim == 2:
            pattern = [FIRST, ALONG]
        unit = FloatDistribution(0.0, 1.0)
        return {**number_of(self), **dict.fromkeys([*self.names, *pattern], unit)}

    def to_parameters(self, layout: ArrayLike) -> dict[str, float]:
        """Parameters of rows; of another layout those of the nearest rows."""
        centres, form = self.split(layout)
        pattern = _read(self.at(len(centres), form), centres)
        if pattern is None:
            layout = self.project(layout)
            centres, form = self.split(layout)
            pattern = _read(self.at(len(centres), form), centres)
            assert pattern is not None
        values = {**dict(zip(self.names, self.unit(layout).tolist(), strict=True)), **pattern}
        if NUMBER in self.distributions():
            values[NUMBER] = len(centres)
        return {name: values[name] for name in self.distributions()}

    def to_layout(self, parameters: Mapping[str, float]) -> np.ndarray:
        """The rows that parameters stand for; not projected yet."""
        n = int(parameters.get(NUMBER, self.n_baffles))
        space, form = self.at_unit(n, [parameters[name] for name in self.names])
        return self.join(_drawn(space, parameters), form)

    def _grid(self, n: int, form: Form) -> list[np.ndarray]:
        """Centres of rows that may stand [m], each of shape (n, D-1).

        Raises:
            LayoutError: if there are none.
        """
        if (n, form) not in self._grids:
            space = self.at(n, form)
            found: list[np.ndarray] = []
            for level in range(FINEST + 1):
                if not found:
                    found = [c for c in rows(space, level) if _read(space, c) is not None]
            if not found:
                raise LayoutError(
                    f"no straight rows of {n} baffles may stand here: the keep-outs are to blame, "
                    "or give --pattern free"
                )
            if len(self._grids) >= MOST_SPACES:
                self._grids.clear()
            self._grids[n, form] = found
        return self._grids[n, form]


def number_of(space: DesignSpace) -> dict[str, BaseDistribution]:
    """The parameter for the number of baffles, if it varies."""
    if len(space.numbers) == 1:
        return {}
    return {NUMBER: IntDistribution(min(space.numbers), max(space.numbers))}


def _drawn(space: LayoutSpace, p: Mapping[str, float]) -> np.ndarray:
    """Centres [m], shape (n, D-1), of a pattern."""
    plane = len(space.lower) == 1
    n = space.n_baffles
    splits = [(1,) * n] if plane else row_counts(n)
    columns = (1,) * n if plane else splits[min(int(p[ROWS] * len(splits)), len(splits) - 1)]
    more, closest = len(columns) - 1, float(space.separation[0])
    room = max(float(space.upper[0] - space.lower[0]) - more * closest, 0.0)
    start = p[FIRST] * room
    along = closest + p[ALONG] * (room - start) / max(more, 1)
    x = space.lower[0] + start + along * np.repeat(np.arange(len(columns)), columns)
    if plane:
        return x[:, None]
    offsets = _offsets(columns, 0.5 * p[STAGGER])
    reach, closest = float(np.ptp(offsets)), float(space.separation[1])
    width = float(space.upper[1] - space.lower[1])
    widest = max(width / reach, closest) if reach > SAME else closest
    across = offsets * (closest + p[ACROSS] * (widest - closest))
    slack = width - float(np.ptp(across))
    z = space.lower[1] + across - across.min() + p[OFFSET] * slack
    return np.column_stack([x, z])


def _offsets(columns: tuple[int, ...], stagger: float) -> np.ndarray:
    """Places across in spacings, row after row, every second row shifted by `stagger`."""
    return np.concatenate(
        [np.arange(n) - (n - 1) / 2 + (stagger if k % 2 else 0.0) for k, n in enumerate(columns)]
    )


def _read(space: LayoutSpace, centres: np.ndarray) -> dict[str, float] | None:
    """The parameters of rows [m], shape (n, D-1); None if they are none."""
    n = len(centres)
    c = centres[np.lexsort(centres.T[::-1])]
    breaks = np.flatnonzero(np.diff(c[:, 0]) > SAME) + 1
    columns = tuple(len(row) for row in np.split(c, breaks))
    first = c[[0, *breaks], 0]
    more, closest = len(columns) - 1, float(space.separation[0])
    room = float(space.upper[0] - space.lower[0]) - more * closest
    start = float(first[0] - space.lower[0])
    found = {FIRST: start / room if room > SAME else 0.0, ALONG: 0.0}
    if more and room - start > SAME:
        found[ALONG] = (float(first[1] - first[0]) - closest) * more / (room - start)
    if len(space.lower) > 1:
        splits = row_counts(n)
        if columns not in splits:
            return None
        found[ROWS] = (splits.index(columns) + 0.5) / len(splits)
        z = [row[:, 1] for row in np.split(c, breaks)]
        shift = float(z[1].mean() - z[0].mean()) if more else 0.0
        spacing = next((float(row[1] - row[0]) for row in z if len(row) > 1), None)
        least = float(space.separation[1])
        if spacing is None:
            spacing = max(2 * shift, least)
        stagger = shift / spacing
        reach = float(np.ptp(_offsets(columns, stagger)))
        width = float(space.upper[1] - space.lower[1])
        widest = max(width / reach, least) if reach > SAME else least
        slack = width - float(np.ptp(c[:, 1]))
        found[STAGGER] = 2 * stagger
        found[ACROSS] = (spacing - least) / (widest - least) if widest - least > SAME else 0.0
        found[OFFSET] = float(c[:, 1].min() - space.lower[1]) / slack if slack > SAME else 0.5
    if any(not -1e-4 <= value <= 1 + 1e-4 for value in found.values()):
        return None
    found = {name: float(np.clip(value, 0.0, 1.0)) for name, value in found.items()}
    again = _drawn(space, found)
    return found if distance(again, centres) < 1e-4 else None

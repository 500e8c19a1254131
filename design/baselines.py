"""What a search has to beat: layouts by chance, and rows as an engineer draws them.

Practice puts baffles in one row across the flow or in two staggered rows (findings/FIELD.md). These
are enqueued before anything is sampled, so that a search starts from what an engineer would try and
never returns less.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from design.space import DesignSpace, Space
from gns_env.layout import LayoutSpace

if TYPE_CHECKING:
    from design.campaign import Campaign

#: Where along the placement area a single row is tried: 0 upstream, 1 downstream.
ROW_PLACES = (0.0, 0.33, 0.67)
#: Upstream and downstream row of a staggered pair.
STAGGERED_PLACES = ((0.0, 0.4), (0.2, 0.8))
#: Most of them where the number of baffles varies, too.
MOST_USUAL = 8
#: Most rows one behind the other: practice builds two or three (findings/FIELD.md).
MOST_ROWS = 3
#: Finest grid of rows: places and spacings are divided into 2 times 2^level parts at most.
LAST_LEVEL = 3


def random_search(campaign: Campaign) -> None:
    """Random buildable layouts until the budget is spent."""
    while (left := campaign.left()) > 0:
        count = min(campaign.batch, left)
        campaign.run(list(random_layouts(campaign.space, count, campaign.rng(3))))


def rows_search(campaign: Campaign) -> None:
    """Rows: the usual ones, then every number of rows, stagger and spacing, ever finer.

    Ends when the budget is spent or the finest grid has been tried.
    """
    campaign.run(
        [layout for layout in engineering_layouts(campaign.space) if new(campaign, layout)]
    )
    for level in range(LAST_LEVEL + 1):
        if not campaign.left():
            return
        grid = [("rows", layout) for layout in grids(campaign, level)]
        # What a budget cuts off a grid should not be one side of it.
        order = np.random.default_rng([campaign.seed, level]).permutation(len(grid))
        campaign.run([grid[k] for k in order if new(campaign, grid[k])])


def new(campaign: Campaign, layout: tuple[str, np.ndarray]) -> bool:
    """Whether no trial is of this layout yet."""
    centres = campaign.log.buildable(layout[1])
    return not any(
        t.centres.shape == centres.shape and np.allclose(t.centres, centres, atol=1e-4)
        for t in campaign.log.trials()
    )


def grids(campaign: Campaign, level: int) -> list[np.ndarray]:
    """`rows` of the campaign's space; where number or form vary, of every number, in the nominal
    form and, a level finer, in two more, drawn at random."""
    space = campaign.space
    if not isinstance(space, DesignSpace):
        return rows(space, level)
    rng = np.random.default_rng([campaign.seed, level, 1])
    found = []
    for n in space.numbers:
        drawn = rng.uniform(size=(2 * level * bool(space.names), len(space.names)))
        for unit in (space.nominal_unit, *drawn):
            room, form = space.at_unit(n, unit)
            found += [space.join(centres, form) for centres in rows(room, level)]
    return found


def rows(space: LayoutSpace, level: int) -> list[np.ndarray]:
    """Buildable layouts [m], shape (n, D-1), in straight rows on a grid; twice as fine a level.

    In 3D one to three rows across the flow, centred, of equal numbers of baffles up to one; each
    second row shifted by half the spacing across or not; the spacing across from the closest that
    the gap allows to the widest that fits, the spacing along likewise. In 2D a row is one baffle,
    and what varies is where the series starts and its spacing. What stands in a keep-out is left
    out.
    """
    found: dict[tuple[float, ...], np.ndarray] = {}
    steps = np.linspace(0.0, 1.0, 2 * 2**level + 1)
    length = float(space.upper[0] - space.lower[0])
    plane = len(space.lower) == 1
    counts = [(1,) * space.n_baffles] if plane else row_counts(space.n_baffles)
    for columns in counts:
        more = len(columns) - 1
        room = length - more * float(space.separation[0])
        if room < -1e-9:
            continue
        for start, wider in product(steps, steps if more else steps[:1]):
            # Start and spacing share the room that the closest rows leave.
            first = float(space.lower[0]) + start * room
            along = float(space.separation[0])
            along += wider * (1 - start) * room / max(more, 1)
            x = first + along * np.repeat(np.arange(len(columns)), columns)
            for across in (
                [np.zeros((space.n_baffles, 0))] if plane else _rows_across(space, columns, steps)
            ):
                centres = np.column_stack([x, across])
                if not space.check(centres):
                    key = tuple(centres[np.lexsort(centres.T)].ravel().round(4))
                    found.setdefault(key, centres)
    return list(found.values())


def row_counts(n: int) -> list[tuple[int, ...]]:
    """How n baffles divide into one to three rows whose numbers differ by one at most."""
    divided: list[tuple[int, ...]] = []
    for count in range(1, min(n, MOST_ROWS) + 1):
        few, longer = divmod(n, count)
        fronts = [(few + 1,) * longer + (few,) * (count - longer)]
        if longer:
            fronts.append(fronts[0][::-1])
            if count == 3:  # the odd row in the middle
                fronts.append((few, few + 1, few) if longer == 1 else (few + 1, few, few + 1))
        divided += dict.fromkeys(fronts)
    return divided


def _rows_across(
    space: LayoutSpace, columns: tuple[int, ...], steps: np.ndarray
) -> Iterator[np.ndarray]:
    """Places across of all baffles [m], shape (n, 1), row after row."""
    width = float(space.upper[1] - space.lower[1])
    middle = float(space.lower[1] + space.upper[1]) / 2
    closest = float(space.separation[1])
    for stagger in (0.0, 0.5) if len(columns) > 1 else (0.0,):
        offsets = [
            np.arange(n) - (n - 1) / 2 + (stagger if k % 2 else 0.0) for k, n in enumerate(columns)
        ]
        # Rows of unequal numbers stand behind the gaps by themselves, and behind each other if
        # shifted; the whole pattern is centred.
        flat = np.concatenate(offsets)
        flat = flat - (flat.max() + flat.min()) / 2
        reach = float(np.ptp(flat))
        widest = width / reach if reach else closest
        if widest < closest - 1e-9:
            continue
        for share in steps if reach else steps[:1]:
            yield middle + (flat * (closest + share * (widest - closest)))[:, None]


def engineering_layouts(space: Space) -> Iterator[tuple[str, np.ndarray]]:
    """Named buildable layouts [m], shape (n, D-1), without repetitions.

    In 3D single rows and staggered pairs; in 2D, where only x is free, evenly spaced series. Where
    the number varies, the first of each kind for every number, `MOST_USUAL` in all.
    """
    if isinstance(space, DesignSpace):
        yield from _usual(space)
        return
    seen: list[np.ndarray] = []
    for name, centres in _wishes(space):
        built = np.asarray(space.project(centres), dtype=float)
        if any(np.abs(built - other).max() < 1e-3 for other in seen):
            continue
        seen.append(built)
        yield name, built


def _usual(space: DesignSpace) -> Iterator[tuple[str, np.ndarray]]:
    first: list[tuple[str, np.ndarray]] = []
    rest: list[tuple[str, np.ndarray]] = []
    for n in sorted(space.numbers, key=lambda n: abs(n - space.n_baffles)):
        room, form = space.at_unit(n, space.nominal_unit)
        kinds: set[str] = set()
        for name, centres in engineering_layouts(room):
            (rest if name in kinds else first).append((name, space.join(centres, form)))
            kinds.add(name)
    yield from [*first, *rest][: MOST_USUAL if len(space.numbers) > 1 else None]


def random_layouts(
    space: Space, count: int, rng: np.random.Generator
) -> Iterator[tuple[str, np.ndarray]]:
    """`count` random buildable layouts [m], shape (n, D-1)."""
    for _ in range(count):
        yield "random", np.asarray(space.random(rng), dtype=float)


def _wishes(space: LayoutSpace) -> Iterator[tuple[str, np.ndarray]]:
    n = space.n_baffles
    if len(space.lower) == 1:
        for end in (0.5, 1.0):
            yield "series", _at(space, np.linspace(0.0, end, n)[:, None])
        return
    for place in ROW_PLACES:
        yield "row", _at(space, np.column_stack([np.full(n, place), _across(n)]))
    if n == 1:
        return
    front = (n + 1) // 2
    for first, second in STAGGERED_PLACES:
        x = np.concatenate([np.full(front, first), np.full(n - front, second)])
        # The second row stands behind the gaps of the first.
        z = np.concatenate([_across(front), _gaps(front)[: n - front]])
        yield "staggered", _at(space, np.column_stack([x, z]))


def _across(n: int) -> np.ndarray:
    """n places evenly across [0, 1], half a space from the sides."""
    return (np.arange(n) + 0.5) / n


def _gaps(n: int) -> np.ndarray:
    """Places behind the n - 1 inner gaps of a row of n, the middle one first, then the sides."""
    inner = np.arange(1, n) / n
    inner = inner[np.argsort(np.abs(inner - 0.5), kind="stable")]
    return np.concatenate([inner, [0.0, 1.0]])


def _at(space: LayoutSpace, unit: np.ndarray) -> np.ndarray:
    return np.asarray(space.decode(unit.ravel()), dtype=float).reshape(unit.shape)

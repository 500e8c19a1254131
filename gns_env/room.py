"""Room for baffles: where one centre may be, and how many baffles fit.

Everything here lives in the space of centres. A rectangle that a baffle must not touch becomes,
for its centre, that rectangle grown by half the baffle (`blocked`, open: its edge is allowed). Two
baffles are clear of each other when their centres differ by at least `separation` along x or along
z. What is left of the placement area is described by its maximal free rectangles, each convex.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Rounding in sums of typed decimals [m]; finer than `gns_model.scene.TOLERANCE` on purpose.
ROUNDING = 1e-10
#: How long to look for a packing among obstacles before giving up [s].
PACKING_SECONDS = 10.0


def free_rectangles(area: Array, blocked: Array) -> Array:
    """Maximal rectangles of `area` that meet no open `blocked` rectangle.

    Args:
        area: lower and upper corner [m], shape (2, d).
        blocked: lower and upper corners [m], shape (K, 2, d).

    Returns:
        Lower and upper corners, shape (M, 2, d); they overlap and may have no width; M may be 0.
    """
    free = [area]
    for lower, upper in blocked:
        kept: list[Array] = []
        cut: list[Array] = []
        for rectangle in free:
            meets = (rectangle[0] < upper - ROUNDING) & (rectangle[1] > lower + ROUNDING)
            (cut if meets.all() else kept).append(rectangle)
        for rectangle in cut:
            for axis in range(area.shape[1]):
                if lower[axis] >= rectangle[0, axis] - ROUNDING:
                    below = rectangle.copy()
                    below[1, axis] = max(lower[axis], rectangle[0, axis])
                    kept.append(below)
                if upper[axis] <= rectangle[1, axis] + ROUNDING:
                    above = rectangle.copy()
                    above[0, axis] = min(upper[axis], rectangle[1, axis])
                    kept.append(above)
        free = _maximal(kept)
    return np.array(free).reshape(-1, 2, area.shape[1])


def _maximal(rectangles: list[Array]) -> list[Array]:
    if len(rectangles) < 2:
        return rectangles
    r = np.array(rectangles)
    inside = (r[:, None, 0] >= r[None, :, 0] - ROUNDING).all(-1) & (
        r[:, None, 1] <= r[None, :, 1] + ROUNDING
    ).all(-1)
    # Of equal rectangles the first one stays.
    equal_later = inside & inside.T & np.tri(len(r), k=-1, dtype=bool)
    covered = (inside & ~inside.T) | equal_later
    return [rectangles[k] for k in np.flatnonzero(~np.any(covered, axis=1))]


def nearest_free(free: Array, point: Array) -> Array:
    """The point of the free rectangles (M, 2, d), M > 0, that is nearest to `point` (d,)."""
    candidates = np.clip(point, free[:, 0], free[:, 1])
    return candidates[np.argmin(((candidates - point) ** 2).sum(1))]


def pack(free: Array, separation: Array, n: int) -> tuple[Array, int]:
    """Find places for at least `n` centres in the free rectangles, or the most that fit.

    One free rectangle is packed in rows and columns, which is optimal for equal boxes. Otherwise
    every packing can be pushed towards the lower corner until each coordinate is an edge of a free
    rectangle plus a multiple of the separation, so a search over those finitely many places is
    exact: greedily first, then, if that falls short, as an integer programme (HiGHS).

    Returns:
        Places [m], shape (m, d), pairwise separated, and an upper bound on how many fit (m is n or
        more unless fewer fit; the bound equals m then, unless the search ran out of time).
    """
    d = free.shape[2]
    if len(free) == 0:
        return np.zeros((0, d)), 0
    if len(free) == 1:
        lower, upper = free[0]
        counts = np.floor((upper - lower + ROUNDING) / separation).astype(int) + 1
        # Only as many rows as are of use: a thin baffle in a wide channel has thousands of slots.
        counts = np.minimum(counts, max(4 * n, 64))
        axes = [
            np.linspace(lo, up, c) if c > 1 else np.array([(lo + up) / 2])
            for lo, up, c in zip(lower, upper, counts, strict=True)
        ]
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, d), int(counts.prod())
    places = _candidates(free, separation)
    chosen = _greedy(places, separation)
    if len(chosen) >= n:
        return chosen, len(chosen)
    exact, bound = _exact(places, separation)
    return (exact if len(exact) > len(chosen) else chosen), bound


def _candidates(free: Array, separation: Array) -> Array:
    axes = []
    for axis, step in enumerate(separation):
        edges = np.unique(free[:, 0, axis].round(10))
        end = free[:, 1, axis].max()
        values = [np.arange(int((end - e + ROUNDING) / step) + 1) * step + e for e in edges]
        axes.append(np.unique(np.concatenate(values).round(10)))
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, free.shape[2])
    held = (grid[:, None] >= free[None, :, 0] - ROUNDING) & (
        grid[:, None] <= free[None, :, 1] + ROUNDING
    )
    return grid[np.any(held.all(-1), axis=1)]


def _greedy(places: Array, separation: Array) -> Array:
    chosen = []
    while len(places):
        chosen.append(places[0])
        clear = (np.abs(places - places[0]) >= separation - ROUNDING).any(1)
        places = places[clear]
    return np.array(chosen).reshape(-1, separation.size)


def _exact(places: Array, separation: Array) -> tuple[Array, int]:
    """The largest set of pairwise separated places: at most one in any window of one separation."""
    from scipy.optimize import Bounds, LinearConstraint, milp
    from scipy.sparse import csr_matrix

    corners = np.array(list(itertools.product(*(np.unique(column) for column in places.T))))
    rows = [
        (places >= corner - ROUNDING).all(1) & (places < corner + separation - ROUNDING).all(1)
        for corner in corners
    ]
    shared = [row for row in rows if row.sum() > 1]
    if not shared:
        return places, len(places)
    result = milp(
        -np.ones(len(places)),
        integrality=np.ones(len(places)),
        bounds=Bounds(0, 1),
        constraints=LinearConstraint(csr_matrix(np.array(shared, dtype=float)), ub=1),
        options={"time_limit": PACKING_SECONDS},
    )
    if result.x is None:
        return np.zeros((0, separation.size)), len(places)
    return places[result.x > 0.5], int(np.floor(-result.mip_dual_bound + 1e-6))

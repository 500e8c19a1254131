"""What a search has to beat: engineering rows, and layouts by chance.

Practice puts baffles in one row across the flow or in two staggered rows (findings/FIELD.md). These
are enqueued before anything is sampled, so that a search starts from what an engineer would try and
never returns less.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gns_env.layout import LayoutSpace

#: Where along the placement area a single row is tried: 0 upstream, 1 downstream.
ROW_PLACES = (0.0, 0.33, 0.67)
#: Upstream and downstream row of a staggered pair.
STAGGERED_PLACES = ((0.0, 0.4), (0.2, 0.8))


def engineering_layouts(space: LayoutSpace) -> Iterator[tuple[str, np.ndarray]]:
    """Named buildable layouts [m], shape (n, D-1), without repetitions.

    In 3D single rows and staggered pairs; in 2D, where only x is free, evenly spaced series.
    """
    seen: list[np.ndarray] = []
    for name, centres in _wishes(space):
        built = np.asarray(space.project(centres), dtype=float)
        if any(np.abs(built - other).max() < 1e-3 for other in seen):
            continue
        seen.append(built)
        yield name, built


def random_layouts(
    space: LayoutSpace, count: int, rng: np.random.Generator
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

"""How far apart two layouts are, whichever way their baffles are numbered."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

#: Layouts closer than this are the same one [m].
SAME = 1e-6


def distance(a: np.ndarray, b: np.ndarray) -> float:
    """The farthest that a baffle has to move to turn layout `a` into `b` [m]; both (n, D-1).

    Baffles are matched so that the summed squared distance is least.
    """
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    if a.shape != b.shape:
        return float("inf")
    apart = np.linalg.norm(a[:, None] - b[None], axis=-1)
    rows, columns = linear_sum_assignment(apart**2)
    return float(apart[rows, columns].max(initial=0.0))


def apart(
    layouts: Sequence[np.ndarray],
    least: float,
    count: int,
    *,
    avoid: Sequence[np.ndarray] = (),
) -> list[np.ndarray]:
    """The first `count` of `layouts` at least `least` [m] from `avoid` and each earlier one."""
    chosen: list[np.ndarray] = []
    for layout in layouts:
        if len(chosen) == count:
            break
        if all(distance(layout, other) >= least for other in (*avoid, *chosen)):
            chosen.append(layout)
    return chosen


def among(layout: np.ndarray, layouts: Sequence[np.ndarray]) -> bool:
    """Whether `layout` is one of `layouts`, but for round-off."""
    return any(distance(layout, other) < SAME for other in layouts)

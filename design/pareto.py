"""The Pareto front of a search with several objectives, and points spread along it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from design.outcome import Trial


def front(trials: Sequence[Trial]) -> list[Trial]:
    """The trials that no other beats: as good in every objective and better in one.

    By the first objective, best first; of equal ones the first tried. Failures and trials of one
    objective are never on it, nor, if any trial keeps all limits, those that break one.
    """
    tried = [t for t in trials if t.ok and len(t.outcome.costs) > 1]
    tried = [t for t in tried if t.outcome.feasible] or tried
    if not tried:
        return []
    costs = np.array([t.outcome.costs for t in tried])
    order = np.lexsort((np.arange(len(costs)), *costs.T[::-1]))
    kept: list[int] = []
    for k in order:
        # Whoever beats or equals k comes before it in this order.
        if not any((costs[j] <= costs[k]).all() for j in kept):
            kept.append(int(k))
    return [tried[k] for k in kept]


def spread(points: Sequence[Trial], count: int) -> list[Trial]:
    """`count` of the points of a front, spread along it: least sum, both ends, then the farthest.

    Each next one is the farthest from those chosen, every objective scaled to its range.
    """
    if len(points) <= count or count < 1:
        return list(points[: max(count, 0)])
    costs = np.array([t.outcome.costs for t in points])
    width = np.ptp(costs, axis=0)
    scaled = (costs - costs.min(axis=0)) / np.where(width > 0, width, 1.0)
    first = int(np.argmin([t.cost for t in points]))
    ends = [int(np.argmin(column)) for column in scaled.T]
    chosen = list(dict.fromkeys([first, *ends]))[:count]
    while len(chosen) < count:
        away = np.linalg.norm(scaled[:, None] - scaled[None, chosen], axis=-1).min(axis=1)
        chosen.append(int(np.argmax(away)))
    return [points[k] for k in chosen]


def staircase(points: np.ndarray) -> np.ndarray:
    """The border of what a front of two objectives dominates, corner by corner, shape (k, 2)."""
    points = np.asarray(points, dtype=float)
    points = points[np.lexsort(points.T[::-1])]
    corners = [points[0]]
    for before, after in pairwise(points):
        corners += [np.array([after[0], before[1]]), after]
    return np.array(corners)

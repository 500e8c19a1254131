"""Which true grain stands for which of the model's: grains of one kind may trade places.

No model foretells where a single grain ends, and nobody asks. But a state that the model rolled is
asked the way back to the truth, and if every grain is asked to *its own* place, the front of a
flow is asked to stay behind: whatever grains the model has out there by chance are, in the truth,
mostly somewhere in the crowd. That takes the tip off every flow, the more the longer it lasts. The
heap as a whole is right where its grains lie where true ones lie, whichever they are; so the way
back is that of least squares over all pairings, in place and in velocity.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from gns_model.data.windows import Window
from gns_model.particles import STATIONARY

#: Points that are paired at once. Time and memory grow with the square and more: 0.15 s for these.
#: Of more, slabs across each axis in turn, each point with the partners of its own slab, which
#: never makes the sum larger.
AT_ONCE = 1300


def least_way_back(
    history: np.ndarray, truth: Window, order: np.ndarray, return_steps: float
) -> np.ndarray:
    """The true point that stands for each of the model's from now on, shape (N,) int32.

    The pairing has the least sum of |e|² + (tau e')² among points of one kind (type and friction),
    with e the difference of places, e' that of velocities and tau = `return_steps` dt, as in
    `replay`. Stationary points stand for themselves.

    Args:
        history: the model's positions [m], shape (N, H+1, D).
        truth: the truth at the same frame.
        order: the pairing so far, shape (N,). It stays where nothing is gained.
        return_steps: see `replay`.
    """
    found = order.copy()
    own, true = (_state(h, return_steps) for h in (history, truth.history))
    kinds = np.stack([truth.particle_type, truth.tan_friction], axis=1)
    for kind in np.unique(kinds, axis=0):
        if kind[0] == STATIONARY:
            continue
        alike = np.flatnonzero((kinds == kind).all(axis=1))
        parts = [alike]
        if len(alike) > AT_ONCE:
            by_axis = (alike[np.argsort(own[alike, k])] for k in range(history.shape[2]))
            slabs = -(-len(alike) // AT_ONCE)
            parts = [slab for line in by_axis for slab in np.array_split(line, slabs)]
        for part in parts:
            candidates = found[part]
            cost = cdist(own[part], true[candidates], "sqeuclidean")
            found[part] = candidates[linear_sum_assignment(cost)[1]]
    return found


def _state(history: np.ndarray, return_steps: float) -> np.ndarray:
    """Place and tau times velocity of every point [m], shape (N, 2 D)."""
    now, before = history[:, -1].astype(float), history[:, -2].astype(float)
    return np.concatenate([now, return_steps * (now - before)], axis=1)

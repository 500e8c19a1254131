"""Gaussian random-walk noise on the input positions, against the drift of long rollouts.

Sanchez-Gonzalez et al. 2020, *Learning to simulate complex physics with graph networks*, section
"Adding noise to the training inputs"; the same in geoelements/gns: velocity noise of standard
deviation noise_std / sqrt(H) is drawn for every interval and cumulated, so that it reaches
noise_std at the last velocity; position noise is the cumulated sum of that, zero at first.
"""

from __future__ import annotations

import numpy as np


def random_walk(
    rng: np.random.Generator, points: int, history: int, dim: int, noise_std: float
) -> np.ndarray:
    """Position noise [m] for a history of H velocities, shape (N, H+1, D) float32.

    Args:
        rng: where the randomness comes from.
        points: N.
        history: H.
        dim: D.
        noise_std: standard deviation of the displacement noise of the last interval [m].
    """
    steps = rng.standard_normal((points, history, dim), dtype=np.float32)
    velocity = np.cumsum(steps * np.float32(noise_std / np.sqrt(history)), axis=1)
    position = np.zeros((points, history + 1, dim), dtype=np.float32)
    np.cumsum(velocity, axis=1, out=position[:, 1:])
    return position

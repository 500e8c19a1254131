"""Noise on the input positions, against the drift of long rollouts.

**Random walk**, of every point by itself. Sanchez-Gonzalez et al. 2020, *Learning to simulate
complex physics with graph networks*, section "Adding noise to the training inputs"; the same in
geoelements/gns: velocity noise of standard deviation noise_std / sqrt(H) is drawn for every
interval and cumulated, so that it reaches noise_std at the last velocity; position noise is the
cumulated sum of that, zero at first.

**Shared acceleration**, of all points together. A history of true states says how fast a flow is
being accelerated, and the next step is much like the last: a network that is asked for the next
step learns to repeat it (the copycat problem of imitation, de Haan et al. 2019, *Causal confusion
in imitation learning*). Of an error that all points share it then repeats a part k as well, so that
a rollout, whose history is its own, is off by 1 / (1 - k) times the error of a step. Noise of
single points does not hide what they share, their neighbours tell; this noise does: it adds to the
accelerations of the history a field that is smooth in place and the same at all times, and leaves
the last position, the last velocity and the target as they are. The next acceleration must then be
told by where the points are and how they move. A history of one velocity asks for the same and
leaves nothing to repeat.
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


#: Waves that make up the field of a shared acceleration, and the shortest one [spacings].
WAVES, SHORTEST = 4, 8.0


def shared_acceleration(
    rng: np.random.Generator, history: np.ndarray, spacing: float, share: float
) -> np.ndarray:
    """Position noise [m] that adds a smooth field to the accelerations of a history of one scene.

    The field is a sum of `WAVES` waves in random directions and phases, of lengths between
    `SHORTEST` spacings and four times the extent of the scene (most of which are nearly the same
    everywhere in it); its standard deviation is `share` of the root mean square of the
    accelerations in the history.

    Args:
        rng: where the randomness comes from.
        history: positions [m], oldest first, shape (N, H+1, D).
        spacing: of the points [m].
        share: of the accelerations that are there.

    Returns:
        shape (N, H+1, D) float32; zero in the last two frames, as the last velocity stays.
    """
    frames, dim = history.shape[1:]
    place = history[:, -1] - history[:, -1].mean(0)
    strength = np.sqrt(np.mean(np.square(np.diff(history.astype(np.float64), n=2, axis=1))))
    longest = 4 * max(float(np.ptp(place, axis=0).max()), SHORTEST * spacing)
    length = SHORTEST * spacing * (longest / (SHORTEST * spacing)) ** rng.random(WAVES)
    direction = rng.standard_normal((WAVES, dim))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    phase = 2 * np.pi * (place @ (direction / length[:, None]).T + rng.random(WAVES))
    amplitude = rng.standard_normal((WAVES, dim)) * np.sqrt(2 / WAVES) * share * strength
    field = np.cos(phase) @ amplitude
    # n frames before the last, n - 1 velocities differ, by 1, 2, ... times the field.
    back = np.arange(frames)[::-1]
    return (field[:, None] * (back * (back - 1) / 2)[:, None]).astype(np.float32)

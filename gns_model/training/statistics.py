"""What the data looks like on average: scales for the network, and edges to expect of a window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gns_model.data.windows import WindowIndex
from gns_model.learned.graph import radius_graph
from gns_model.learned.model import LearnedModel
from gns_model.particles import STATIONARY
from gns_model.training.augment import mirror_axis
from gns_model.training.kinematic import with_baffle_points

#: Bins of time, from release to rest, in which the number of neighbours is averaged.
TIME_BINS = 8


@dataclass(frozen=True)
class Statistics:
    """Means and standard deviations in SI units; one deviation for all axes.

    One deviation keeps the geometry: a rotation of a velocity rotates its normalised value.

    Attributes:
        velocity_mean, acceleration_mean: [m/s], [m/s²], shape (D,). The mean along the mirror's
            axis is zero by symmetry; where gravity is subtracted, the acceleration is a - g.
        velocity_std, acceleration_std: root mean square over the axes [m/s], [m/s²], noise of the
            training included.
        neighbours: mean number of edges for each point of a file, those of kinematic points that
            join it included, in each of TIME_BINS bins of time.
    """

    velocity_mean: tuple[float, ...]
    velocity_std: float
    acceleration_mean: tuple[float, ...]
    acceleration_std: float
    neighbours: tuple[float, ...]

    def apply(self, model: LearnedModel) -> None:
        """Set the normalisation buffers of `model`."""
        dim = model.config.dim
        model.set_normalisation(
            velocity_mean=torch.tensor(self.velocity_mean),
            velocity_std=torch.full((dim,), self.velocity_std),
            acceleration_mean=torch.tensor(self.acceleration_mean),
            acceleration_std=torch.full((dim,), self.acceleration_std),
        )

    def edges(self, points: int, when: float) -> float:
        """Edges to expect in a window of `points` points at the fraction `when` of its flow."""
        return points * self.neighbours[time_bin(when)]


def time_bin(when: float) -> int:
    """Which of TIME_BINS bins the fraction `when` in [0, 1] of a flow lies in."""
    return min(TIME_BINS - 1, int(when * TIME_BINS))


def measure(
    index: WindowIndex,
    *,
    windows: int,
    radius: float,
    noise_std: float,
    subtract_gravity: bool,
    kinematic: float | None = None,
    seed: int = 0,
) -> Statistics:
    """Stream over random windows, one in memory at a time.

    Args:
        windows: how many to read.
        radius: of the graph [m].
        noise_std: of the training [m]. It adds noise_std / dt to the deviation of the last
            velocity and noise_std / dt² to that of the acceleration, in squares.
        subtract_gravity: whether the network predicts a - g.
        kinematic: see `kinematic_spacing`; what stands still adds edges and nothing else.
        seed: of the choice of windows.
    """
    rng = np.random.default_rng([seed, 0x57A7])
    count = 0
    sums = np.zeros((4, index.dim))
    edges, points = np.zeros(TIME_BINS), np.zeros(TIME_BINS)
    for k in range(windows):
        source = int(rng.integers(len(index.sources)))
        starts = index.starts(source, 1)
        # Strata of time, so that a few windows already see all of a flow.
        when = (k % TIME_BINS + rng.random()) / TIME_BINS
        frame = min(starts - 1, int(when * starts))
        mixture = int(rng.integers(2**31))
        window = index.read(source, frame, mixture=mixture, unroll=1)
        rows = len(window.history)
        moving = window.particle_type != STATIONARY
        now, before, after = (
            positions[moving].astype(float)
            for positions in (window.history[:, -1], window.history[:, -2], window.future[:, 0])
        )
        velocity = (now - before) / index.dt
        acceleration = ((after - now) / index.dt - velocity) / index.dt
        if subtract_gravity:
            acceleration -= np.asarray(window.scene.gravity)
        count += len(now)
        for row, values in enumerate((velocity, velocity**2, acceleration, acceleration**2)):
            sums[row] += values.sum(axis=0)
        if k < 8 * TIME_BINS:
            if kinematic is not None:
                window = with_baffle_points(window, kinematic)
            senders, _ = radius_graph(torch.from_numpy(window.history[:, -1].copy()), radius)
            edges[time_bin(when)] += len(senders)
            points[time_bin(when)] += rows
    means = sums / max(1, count)
    axis = mirror_axis(index.dim)
    means[0, axis] = means[2, axis] = 0.0
    velocity_variance = np.mean(np.maximum(0, means[1] - means[0] ** 2))
    acceleration_variance = np.mean(np.maximum(0, means[3] - means[2] ** 2))
    overall = edges.sum() / max(1.0, points.sum())
    neighbours = np.where(points > 0, edges / np.maximum(points, 1), overall)
    floor = 1e-6
    return Statistics(
        velocity_mean=tuple(map(float, means[0])),
        velocity_std=float(np.sqrt(velocity_variance + (noise_std / index.dt) ** 2) + floor),
        acceleration_mean=tuple(map(float, means[2])),
        acceleration_std=float(
            np.sqrt(acceleration_variance + (noise_std / index.dt**2) ** 2) + floor
        ),
        neighbours=tuple(map(float, np.maximum(neighbours, 0.1))),
    )

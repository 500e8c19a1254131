"""Scene -> points at a spacing: where the material points start and how fast.

Every simulator fills a release with a regular lattice of `spacing`, centred in its box, as the
paper's MPM does (2 x 2 x 2 points in an element of twice the spacing).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gns_model.errors import SceneError, SimulatorError
from gns_model.scene import Scene

#: Particle types, as geoelements/gns numbers them.
MOVING = 6
STATIONARY = 3


@dataclass(frozen=True)
class Points:
    """The points of a scene at t = 0.

    Attributes:
        positions: [m], shape (N, D).
        velocities: [m/s], shape (N, D).
        lattice: integer lattice coordinates within the release, shape (N, D). Points whose
            lattice agrees modulo n form a lattice of n times the spacing.
        spacing: [m].
        jitter, filling: how they were moved off their lattice, see `shaken`.
    """

    positions: np.ndarray
    velocities: np.ndarray
    lattice: np.ndarray
    spacing: float
    jitter: float = 0.0
    filling: int = 0

    @property
    def volume(self) -> float:
        """Volume of one point: [m³], in 2D [m²] per metre of width."""
        return self.spacing ** self.positions.shape[1]


def scatter(points: Points, subcells: int, draw: int = 0) -> Points:
    """Move every point to the middle of a random one of subcells^D equal parts of its cell.

    So the points of a coarse model start as a random choice of a finer solver's points, one in
    each cell, which moves as the whole does. The choice is the same for the same number of points
    and the same `draw`.
    """
    if subcells == 1:
        return points
    part = np.random.default_rng(draw).integers(0, subcells, points.positions.shape)
    offset = (part + 0.5) / subcells - 0.5
    return replace(points, positions=points.positions + points.spacing * offset)


def shaken(points: Points, jitter: float, draw: int = 0) -> Points:
    """Move every point by up to `jitter` spacings along each axis, which leaves it in its own cell
    up to half of one: another filling of the same releases. The same `draw` moves it likewise."""
    most = jitter * points.spacing
    shift = np.random.default_rng(draw).uniform(-most, most, points.positions.shape)
    return replace(points, positions=points.positions + shift, jitter=jitter, filling=draw)


def check_filling(jitter: float, filling: int) -> None:
    """Raise SimulatorError if points cannot be `shaken` so."""
    if not 0 <= jitter < 0.5:
        raise SimulatorError(f"jitter must be 0 or more and below 0.5, got {jitter}")
    if filling < 0:
        raise SimulatorError(f"filling must not be negative, got {filling}")


def fill(scene: Scene, spacing: float) -> Points:
    """Fill the releases of `scene` with points `spacing` [m] apart.

    Raises:
        SceneError: if a release is thinner than one spacing.
    """
    positions, velocities, lattices = [], [], []
    for k, release in enumerate(scene.releases):
        counts = [int(s / spacing + 1e-6) for s in release.size]
        if min(counts) < 1:
            raise SceneError(
                f"release[{k}] of size {release.size} is thinner than the spacing {spacing:g} m"
            )
        axes = [
            (lo + up) / 2 + spacing * (np.arange(n) - (n - 1) / 2)
            for lo, up, n in zip(release.lower, release.upper, counts, strict=True)
        ]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, scene.dim)
        index = np.stack(
            np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1
        ).reshape(-1, scene.dim)
        positions.append(grid)
        velocities.append(np.broadcast_to(np.asarray(release.velocity, float), grid.shape))
        lattices.append(index)
    return Points(
        np.concatenate(positions),
        np.ascontiguousarray(np.concatenate(velocities)),
        np.concatenate(lattices),
        spacing,
    )

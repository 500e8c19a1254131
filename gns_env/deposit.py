"""Where the material came to rest, as a map of depth over the plan."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gns_model.measures import moving_positions
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory

#: Side of a cell of the deposit map that the env shows to a policy [m].
CELL = 0.05


def cells(scene: Scene, cell: float = CELL) -> tuple[int, ...]:
    """Number of cells of about `cell` [m] along each plan axis of the domain."""
    size = np.array(scene.domain.size)[[0, *range(2, scene.dim)]]
    return tuple(int(c) for c in np.maximum(np.rint(size / cell), 1))


def depth_map(trajectory: Trajectory, frame: int, cell: float) -> NDArray[np.float64]:
    """Depth of material over the plan [m], cells of about `cell` [m], shape (nx,) or (nx, nz).

    It is the volume of the points in a cell over its area, so it conserves mass; points outside
    the domain (of a rollout that failed) are left out.
    """
    scene = trajectory.scene
    plan = [0, *range(2, scene.dim)]
    lower, upper = np.array(scene.domain.lower)[plan], np.array(scene.domain.upper)[plan]
    shape = cells(scene, cell)
    points = moving_positions(trajectory)[frame][:, plan]
    counts, _ = np.histogramdd(points, bins=list(shape), range=list(zip(lower, upper, strict=True)))
    return counts * (trajectory.point_volume / np.prod((upper - lower) / shape))

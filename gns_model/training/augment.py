"""Mirror augmentation: the physics is the same in a mirror, so every flow counts twice.

The mirror stands across the flow, at the middle of the domain's last horizontal axis: z in 3D, and
x, the only one, in 2D. A mirrored scene teaches the network the symmetry at no cost in its
architecture.
"""

from __future__ import annotations

import numpy as np

from gns_model import footprint
from gns_model.scene import Scene, Vector


def mirror_axis(dim: int) -> int:
    """The axis that the mirror turns round: 2 (z) in 3D, 0 (x) in 2D."""
    return 2 if dim == 3 else 0


def mirrored(scene: Scene) -> Scene:
    """The scene in the mirror: domain and gravity, releases, baffles and placement; grains mirror
    with `mirror_positions`."""
    axis = mirror_axis(scene.dim)
    plan = 0 if axis == 0 else 1  # the same axis in plan, where there is no height
    total = scene.domain.lower[axis] + scene.domain.upper[axis]

    def box(lower: Vector, upper: Vector, axis: int) -> dict[str, Vector]:
        return {
            "lower": _put(lower, axis, total - upper[axis]),
            "upper": _put(upper, axis, total - lower[axis]),
        }

    releases = tuple(
        r.model_copy(update={**box(r.lower, r.upper, axis), "velocity": _flip(r.velocity, axis)})
        for r in scene.releases
    )
    baffles = tuple(
        b.model_copy(
            update={
                "center": _put(b.center, plan, total - b.center[plan]),
                "yaw": footprint.wrap(-b.yaw),
            }
        )
        for b in scene.baffles
    )
    placement = scene.placement
    if placement is not None:
        other = plan + scene.dim - 1  # the upper corner of a rectangle follows its lower one
        placement = placement.model_copy(
            update={
                **box(placement.lower, placement.upper, plan),
                "yaw": footprint.wrap(-placement.yaw) if placement.yaw else placement.yaw,
                "keep_out": tuple(
                    _put(_put(r, plan, total - r[other]), other, total - r[plan])
                    for r in placement.keep_out
                ),
            }
        )
    return scene.model_copy(
        update={
            "gravity": _flip(scene.gravity, axis),
            "releases": releases,
            "baffles": baffles,
            "placement": placement,
        }
    )


def mirror_positions(positions: np.ndarray, scene: Scene) -> np.ndarray:
    """Positions (..., D) [m] in the same mirror as `mirrored(scene)`."""
    axis = mirror_axis(scene.dim)
    out = np.array(positions)
    total = np.float32(scene.domain.lower[axis] + scene.domain.upper[axis])
    out[..., axis] = total - out[..., axis]
    return out


def _put(vector: Vector, axis: int, value: float) -> Vector:
    return (*vector[:axis], value, *vector[axis + 1 :])


def _flip(vector: Vector, axis: int) -> Vector:
    return _put(vector, axis, -vector[axis])

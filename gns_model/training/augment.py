"""Mirror augmentation: the physics is the same in a mirror across z, so every flow counts twice.

A mirrored scene teaches the network the symmetry at no cost in its architecture.
"""

from __future__ import annotations

import numpy as np

from gns_model.scene import Scene, Vector


def mirrored(scene: Scene) -> Scene:
    """The scene seen in a mirror across the mid-plane of z (3D only): domain and gravity,
    releases, baffles and placement; grains mirror with `mirror_positions`."""
    total = scene.domain.lower[2] + scene.domain.upper[2]
    releases = tuple(
        r.model_copy(
            update={
                "lower": (*r.lower[:2], total - r.upper[2]),
                "upper": (*r.upper[:2], total - r.lower[2]),
                "velocity": _flip(r.velocity),
            }
        )
        for r in scene.releases
    )
    baffles = tuple(
        b.model_copy(update={"center": (b.center[0], total - b.center[1])}) for b in scene.baffles
    )
    placement = scene.placement
    if placement is not None:
        placement = placement.model_copy(
            update={
                "lower": (placement.lower[0], total - placement.upper[1]),
                "upper": (placement.upper[0], total - placement.lower[1]),
                "keep_out": tuple(
                    (r[0], total - r[3], r[2], total - r[1]) for r in placement.keep_out
                ),
            }
        )
    return scene.model_copy(
        update={
            "gravity": _flip(scene.gravity),
            "releases": releases,
            "baffles": baffles,
            "placement": placement,
        }
    )


def mirror_positions(positions: np.ndarray, scene: Scene) -> np.ndarray:
    """Positions (..., D) [m] in the same mirror as `mirrored(scene)`."""
    out = np.array(positions)
    out[..., 2] = np.float32(scene.domain.lower[2] + scene.domain.upper[2]) - out[..., 2]
    return out


def _flip(vector: Vector) -> Vector:
    return (*vector[:2], -vector[2])

"""The paper's barriers in training: points that stand still, added to windows of our trajectories.

Our files hold grains only, and what stands in the way as boxes; imported ones bring such points
along as rows of their own.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from gns_model.data.windows import Window
from gns_model.learned.config import ModelConfig
from gns_model.learned.world import baffle_points, baffle_poses
from gns_model.particles import STATIONARY


def kinematic_spacing(config: ModelConfig) -> float | None:
    """Distance of the kinematic points that stand for baffles [m]; None: the model has none."""
    return config.spacing if config.baffles == "points" else None


def with_baffle_points(window: Window, spacing: float) -> Window:
    """The window with its baffles as kinematic points, `spacing` [m] apart, after all others."""
    boxes, turns = baffle_poses(window.scene)
    fixed = baffle_points(boxes, spacing, turns).numpy()
    count = len(fixed)
    tangent = math.tan(math.radians(window.scene.material.friction_angle))

    def append(positions: np.ndarray) -> np.ndarray:
        still = np.repeat(fixed[:, None], positions.shape[1], axis=1)
        return np.concatenate([positions, still])

    return replace(
        window,
        history=append(window.history),
        future=append(window.future),
        particle_type=np.concatenate([window.particle_type, np.full(count, STATIONARY)]),
        tan_friction=np.concatenate([window.tan_friction, np.full(count, tangent, np.float32)]),
    )

"""Tiny flows with a known motion: grains fly, land and stay. Written as the solver would."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gns_model.particles import MOVING, fill
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory

SPACING, INTERVAL = 0.03125, 0.01


def flying_scene(shift: float = 0.0, speed: float = 1.0) -> Scene:
    """A cube of 8³ points that is thrown over a floor; a baffle stands aside of its way."""
    return Scene.from_dict(
        {
            "domain": {"lower": [0.0, 0.0, 0.0], "upper": [0.8, 0.8, 0.8]},
            "release": [
                {
                    "lower": [0.05, 0.05, 0.1 + shift],
                    "upper": [0.30, 0.30, 0.35 + shift],
                    "velocity": [speed, 0.2, 0.1],
                }
            ],
            "baffle": [{"center": [0.6, 0.75], "size": [0.1, 0.2, 0.1]}],
            "duration": 0.2,
        }
    )


def flight(scene: Scene, spacing: float = SPACING, frames: int = 21) -> Trajectory:
    """Ballistic points that stop where they meet the floor: an exact solution, float64 time."""
    points = fill(scene, spacing)
    time = np.arange(frames) * INTERVAL
    t = time[:, None, None]
    path = points.positions + points.velocities * t + 0.5 * np.asarray(scene.gravity) * t**2
    for k in range(1, frames):
        landed = path[k, :, 1] < 0.01
        path[k:, landed] = path[k - 1, landed]
    return Trajectory(
        positions=path.astype(np.float32),
        time=time,
        particle_type=np.full(len(points.positions), MOVING, np.int8),
        scene=scene,
        point_volume=points.volume,
        simulator="flight",
        lattice=points.lattice,
    )


@pytest.fixture(scope="session")
def flights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of four trajectories."""
    folder = tmp_path_factory.mktemp("flights")
    for k in range(4):
        flight(flying_scene(0.1 * k, 0.8 + 0.2 * k)).save(folder / f"{k:03}.h5")
    return folder

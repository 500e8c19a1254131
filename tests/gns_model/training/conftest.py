"""Tiny flows with a known motion: grains fly, land and stay. Written as the solver would."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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
def free_scene() -> Scene:
    """A scene without baffles in the way, whose points fly for 0.1 s before any of them lands."""
    return flying_scene().replace(
        releases=({"lower": (0.05, 0.4, 0.1), "upper": (0.30, 0.65, 0.35), "velocity": (1, 0, 0)},)
    )


@pytest.fixture(scope="session")
def free_flight(free_scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of one trajectory in which nothing but gravity acts."""
    folder = tmp_path_factory.mktemp("free")
    flight(free_scene, frames=11).save(folder / "free.h5")
    return folder


@pytest.fixture(scope="session")
def flights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of four trajectories."""
    folder = tmp_path_factory.mktemp("flights")
    for k in range(4):
        flight(flying_scene(0.1 * k, 0.8 + 0.2 * k)).save(folder / f"{k:03}.h5")
    return folder


@pytest.fixture(scope="session")
def tiny(flights: Path) -> dict[str, Any]:
    """A recipe, as plain values, that trains in a second on `flights`."""
    return {
        "name": "tiny",
        "train": [str(flights)],
        "valid": [str(flights)],
        "steps": 6,
        "edges_per_batch": 800,
        "statistics_windows": 16,
        "valid_rollouts": 2,
        "valid_windows": 4,
        "unroll": 2,
        "unroll_fraction": 0.5,
        "device": "cpu",
        "model": {"spacing": 0.0625, "dt": 0.02, "radius": 0.1, "latent": 8, "blocks": 2},
    }

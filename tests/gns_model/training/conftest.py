"""Tiny flows with a known motion, stored as the solver would store them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from gns_model.particles import MOVING, fill
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory

SPACING, INTERVAL = 0.03125, 0.01
DRAG = 5.0  #: [1/s]


def cube_scene(shift: float = 0.0, speed: float = 1.0) -> Scene:
    """A cube of 8³ points on its way along the floor; a baffle stands aside."""
    return Scene.from_dict(
        {
            "domain": {"lower": [0.0, 0.0, 0.0], "upper": [0.8, 0.8, 0.8]},
            "release": [
                {
                    "lower": [0.05, 0.05, 0.1 + shift],
                    "upper": [0.30, 0.30, 0.35 + shift],
                    "velocity": [speed, 0.0, 0.1],
                }
            ],
            "baffle": [{"center": [0.6, 0.75], "size": [0.1, 0.2, 0.1]}],
            "duration": 0.2,
        }
    )


def slide(scene: Scene, t: np.ndarray) -> np.ndarray:
    """Positions at times t (T,): points slow down at DRAG times their velocity, without weight."""
    points = fill(scene, SPACING)
    return points.positions + points.velocities * ((1 - np.exp(-DRAG * t)) / DRAG)[:, None, None]


def fly(scene: Scene, t: np.ndarray) -> np.ndarray:
    """Positions at times t (T,): nothing but gravity acts."""
    points, t = fill(scene, SPACING), t[:, None, None]
    return points.positions + points.velocities * t + 0.5 * np.asarray(scene.gravity) * t**2


def trajectory(
    scene: Scene, motion: Callable[[Scene, np.ndarray], np.ndarray], frames: int
) -> Trajectory:
    """An exact solution, stored as a solver would store it."""
    points = fill(scene, SPACING)
    time = np.arange(frames) * INTERVAL
    return Trajectory(
        positions=motion(scene, time).astype(np.float32),
        time=time,
        particle_type=np.full(len(points.positions), MOVING, np.int8),
        scene=scene,
        point_volume=points.volume,
        simulator="exact",
        lattice=points.lattice,
    )


@pytest.fixture(scope="session")
def free_scene() -> Scene:
    """A scene without baffles in the way, whose points fly for 0.1 s before any of them lands."""
    return cube_scene().replace(
        releases=({"lower": (0.05, 0.4, 0.1), "upper": (0.30, 0.65, 0.35), "velocity": (1, 0, 0)},)
    )


@pytest.fixture(scope="session")
def free_flight(free_scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of one trajectory in which nothing but gravity acts."""
    folder = tmp_path_factory.mktemp("free")
    trajectory(free_scene, fly, 11).save(folder / "free.h5")
    return folder


@pytest.fixture(scope="session")
def slides(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of four trajectories."""
    folder = tmp_path_factory.mktemp("slides")
    for k in range(4):
        trajectory(cube_scene(0.1 * k, 0.8 + 0.2 * k), slide, 21).save(folder / f"{k:03}.h5")
    return folder


@pytest.fixture(scope="session")
def tiny(slides: Path) -> dict[str, Any]:
    """A recipe, as plain values, that trains in a second on `slides`."""
    return {
        "name": "tiny",
        "train": [str(slides)],
        "valid": [str(slides)],
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


@pytest.fixture(scope="session")
def write_recipe() -> Callable[[Path, dict[str, Any]], Path]:
    """A function that writes a recipe, given as plain values, to a file."""

    def write(path: Path, values: dict[str, Any]) -> Path:
        lines = [f"{k} = {json.dumps(v)}" for k, v in values.items() if k != "model"]
        lines += ["[model]", *(f"{k} = {json.dumps(v)}" for k, v in values["model"].items())]
        path.write_text("\n".join(lines))
        return path

    return write


@pytest.fixture(scope="session")
def same_state() -> Callable[[Path, Path], bool]:
    """A function: whether weights, moving average and moments of two runs agree bit for bit."""

    def same(a: Path, b: Path) -> bool:
        one, two = load_file(a / "state.safetensors"), load_file(b / "state.safetensors")
        assert one.keys() == two.keys()
        assert any(key.startswith("optimiser.") for key in one)
        return all(torch.equal(one[key], two[key]) for key in one)

    return same

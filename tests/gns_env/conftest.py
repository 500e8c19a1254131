"""Simulators for tests of the env: the real solver, coarse, and the shipped model if any."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import gns_model
from gns_model.mpm import MpmSimulator
from gns_model.scene import Scene
from gns_model.simulator import Progress, Simulator
from gns_model.trajectory import DIVERGED, Trajectory

SHIPPED = Path(gns_model.__file__).parent / "pretrained" / "baffle-lite"


@pytest.fixture(scope="session")
def is_shipped() -> bool:
    """Whether this checkout holds the default model."""
    return SHIPPED.exists()


@pytest.fixture
def coarse_mpm() -> MpmSimulator:
    """The reference solver with so few points that a rollout takes a fraction of a second."""
    return MpmSimulator(spacing=0.0625, frame_interval=0.02)


@pytest.fixture(
    params=[
        "mpm",
        pytest.param(
            "baffle-lite",
            marks=pytest.mark.skipif(not SHIPPED.exists(), reason="no model is shipped yet"),
        ),
    ]
)
def simulator(request: pytest.FixtureRequest, coarse_mpm: MpmSimulator) -> Simulator:
    """Every simulator that a user can name."""
    if request.param == "mpm":
        return coarse_mpm
    return gns_model.load_simulator(request.param)


@pytest.fixture
def site(flume: Scene, simulator: Simulator) -> Scene:
    """The flume; for the shipped model, which takes ten seconds for all of it, its first third."""
    return flume if simulator.name == "mpm" else flume.replace(duration=0.3)


@pytest.fixture
def tiny_scene() -> Scene:
    """A 2D flow of two dozen points that rests in milliseconds, for thousands of steps."""
    return Scene.from_dict(
        {
            "name": "tiny",
            "duration": 0.25,
            "section": 0.7,
            "domain": {"lower": [0.0, 0.0], "upper": [1.2, 0.5]},
            "release": [{"lower": [0.0, 0.0], "upper": [0.2, 0.3], "velocity": [1.0, 0.0]}],
            "baffle": [{"center": [0.6], "size": [0.1, 0.15]}],
            "placement": {"lower": [0.3], "upper": [1.1], "gap": 0.05},
        }
    )


@pytest.fixture
def tiny_mpm() -> MpmSimulator:
    """The reference solver in a few milliseconds a rollout of `tiny_scene`."""
    return MpmSimulator(spacing=0.05, frame_interval=0.05)


class Faulty:
    """The coarse solver, made to fail as a network may: for scenes with `at_least` baffles."""

    name = "faulty"

    def __init__(self, how: str, at_least: int = 1) -> None:
        self.inner = MpmSimulator(spacing=0.0625, frame_interval=0.02)
        self.how, self.at_least = how, at_least
        self.batches: list[int] = []

    def check(self, scene: Scene) -> None:
        self.inner.check(scene)

    def rollout(
        self, scenes: Sequence[Scene], *, progress: Progress | None = None
    ) -> list[Trajectory]:
        self.batches.append(len(scenes))
        return [self._spoil(t) for t in self.inner.rollout(scenes, progress=progress)]

    def _spoil(self, trajectory: Trajectory) -> Trajectory:
        if len(trajectory.scene.baffles) < self.at_least or self.how == "not at all":
            return trajectory
        positions = trajectory.positions.copy()
        half = len(positions) // 2
        if self.how == "says so":
            return replace(trajectory, status=DIVERGED)
        if self.how == "nan":
            positions[half:, 3] = np.nan
        elif self.how == "explodes":
            positions[half:] = 3e38
        elif self.how == "one flies":
            positions[half:, 3] += 100.0
        elif self.how == "sinks":
            positions[half:, :, 1] -= 0.2
        elif self.how == "leaks":
            positions[half:, : positions.shape[1] // 4] = trajectory.scene.baffle_boxes()[0].mean(0)
        return replace(trajectory, positions=positions)


@pytest.fixture
def faulty() -> type[Faulty]:
    """A simulator class whose rollouts fail in a chosen way."""
    return Faulty

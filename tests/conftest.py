"""What every test may ask for: the example scenes and clouds of points with known measures."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from gns_model.particles import MOVING
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory

# Numba compiles and torch warms up inside the first example: a deadline would only measure that.
settings.register_profile(
    "project",
    deadline=None,
    max_examples=40,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.load_profile("project")


def pytest_configure(config: pytest.Config) -> None:
    """Compile the kernels once, before several processes would each begin with that; and hear
    interrupts, which a shell's background jobs (`make test &`) begin by ignoring, children too."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        compile_kernels()


def compile_kernels() -> None:
    """Fill numba's cache, which every later process reads, by running a flow of a few points."""
    import torch

    from gns_model.learned.graph import radius_graph
    from gns_model.mpm import MpmSimulator

    for dim in (2, 3):
        for dtype in (torch.float32, torch.float64):
            radius_graph(torch.zeros((2, dim), dtype=dtype), 1.0)
        scene = Scene.from_dict(
            {
                "duration": 1e-3,
                "domain": {"lower": [0.0] * dim, "upper": [1.0] * dim},
                "release": [{"lower": [0.0] * dim, "upper": [0.1] * dim, "velocity": [0.0] * dim}],
                "baffle": [{"center": [0.5] * (dim - 1), "size": [0.1] * dim}],
            }
        )
        for threads in (1, 2):
            MpmSimulator(spacing=0.05, threads=threads).rollout([scene])


EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(scope="session")
def examples() -> Path:
    """The folder of the example scenes."""
    return EXAMPLES


@pytest.fixture(scope="session")
def flume() -> Scene:
    """The paper's flume with its three baffles."""
    return Scene.from_toml(EXAMPLES / "flume.toml")


@pytest.fixture(scope="session")
def small_flume() -> Scene:
    """A flume of about a thousand coarse points with one baffle, for tests that roll out."""
    return Scene.from_dict(
        {
            "name": "small-flume",
            "duration": 0.3,
            "section": 0.7,
            "domain": {"lower": [0.0, 0.0, 0.0], "upper": [1.0, 0.5, 0.6]},
            "release": [
                {"lower": [0.0, 0.0, 0.1], "upper": [0.25, 0.2, 0.5], "velocity": [1.5, 0.0, 0.0]}
            ],
            "baffle": [{"center": [0.55, 0.3], "size": [0.1, 0.25, 0.15]}],
            "placement": {"lower": [0.35, 0.0], "upper": [0.9, 0.6], "gap": 0.05},
        }
    )


@pytest.fixture(scope="session")
def plane_scene() -> Scene:
    """A 2D column against the left wall with one baffle downstream."""
    return Scene.from_dict(
        {
            "name": "plane",
            "duration": 0.4,
            "domain": {"lower": [0.0, 0.0], "upper": [1.0, 0.5]},
            "release": [{"lower": [0.0, 0.0], "upper": [0.2, 0.3], "velocity": [0.0, 0.0]}],
            "baffle": [{"center": [0.6], "size": [0.1, 0.15]}],
        }
    )


@pytest.fixture(scope="session")
def trajectory_of() -> Callable[..., Trajectory]:
    """A function that wraps positions (T, N, D) of a scene into a trajectory."""

    def build(
        positions: np.ndarray,
        scene: Scene,
        *,
        interval: float = 0.1,
        point_volume: float = 1e-3,
        **more: object,
    ) -> Trajectory:
        positions = np.asarray(positions)
        return Trajectory(
            positions=positions,
            time=np.arange(len(positions)) * interval,
            particle_type=np.full(positions.shape[1], MOVING, np.int8),
            scene=scene,
            point_volume=point_volume,
            simulator="made up",
            **more,  # type: ignore[arg-type]
        )

    return build

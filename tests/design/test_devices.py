"""The env and the gradient of a search on the stand-in for a GPU (`tests/faux_cuda.py`)."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

import design
import gns_env  # noqa: F401  registers the env
from gns_env.task import BaffleTask
from gns_model import Scene, load_simulator
from tests.faux_cuda import on_both


@pytest.fixture(scope="module")
def flow() -> Scene:
    """A block that strikes its baffles within a tenth of a second."""
    return Scene.from_dict(
        {
            "domain": {"lower": [0, 0, 0], "upper": [0.8, 0.5, 0.5]},
            "release": [{"lower": [0, 0, 0.1], "upper": [0.2, 0.1, 0.4], "velocity": [2.0, 0, 0]}],
            "placement": {"lower": [0.25, 0.05], "upper": [0.5, 0.45], "size": [0.1, 0.3, 0.1]},
            "section": 0.5,
            "duration": 0.14,
        }
    )


@pytest.mark.slow
def test_a_step_of_the_env_and_the_gradient_of_a_layout_are_those_of_the_cpu(flow):
    layout = np.array([[0.33, 0.16], [0.36, 0.33]])

    def run(device: str) -> tuple[float, np.ndarray, float]:
        simulator = load_simulator("baffle-lite", device=device)
        task = BaffleTask(flow, simulator, n_baffles=2)
        cost, gradient = design.cost_and_gradient(task, layout)
        env = gymnasium.make("GranularBaffle-v0", scene=flow, simulator=simulator, n_baffles=2)
        env.reset(seed=0)
        reward = env.step(np.zeros_like(env.action_space.sample()))[1]
        return cost, gradient, reward

    here, there = on_both(run)
    assert there[0] == pytest.approx(here[0], abs=1e-5)
    np.testing.assert_allclose(there[1], here[1], rtol=1e-2, atol=1e-4)
    assert np.abs(here[1]).max() > 1e-3
    assert there[2] == pytest.approx(here[2], abs=1e-5)

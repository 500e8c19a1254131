"""A model may leave its first steps to the reference solver, as the paper's rollouts begin."""

import numpy as np
import pytest
import torch

from gns_model.errors import SimulatorError
from gns_model.learned.config import ModelConfig
from gns_model.learned.model import LearnedModel
from gns_model.learned.simulator import LearnedSimulator
from gns_model.mpm import MpmSimulator
from gns_model.paper import COLUMNS, column_scene

SPACING, DT, STEPS = 0.05, 0.01, 3


@pytest.fixture(scope="module")
def simulator():
    torch.manual_seed(0)
    config = ModelConfig(
        dim=2, spacing=SPACING, dt=DT, radius=0.11, history=4, latent=8, blocks=1,
        solver_steps=STEPS,
    )  # fmt: skip
    return LearnedSimulator(LearnedModel(config), "begun-by-the-solver")


def column(duration=0.08):
    return column_scene(COLUMNS[2]).replace(duration=duration)


def test_a_rollout_begins_with_the_solvers_frames_and_goes_on_by_itself(simulator):
    solved = MpmSimulator(spacing=SPACING, frame_interval=DT).rollout([column()])[0]
    found = simulator.rollout([column()])[0]
    assert found.positions.shape == solved.positions.shape
    np.testing.assert_array_equal(found.positions[: STEPS + 1], solved.positions[: STEPS + 1])
    assert np.abs(found.positions[STEPS + 1] - solved.positions[STEPS + 1]).max() > 1e-6


def test_another_filling_is_the_solvers_too(simulator):
    chosen = {"jitter": 0.25, "filling": 3}
    solved = MpmSimulator(spacing=SPACING, frame_interval=DT, **chosen).rollout([column()])[0]
    other = LearnedSimulator(simulator.model, **chosen)
    found = other.rollout([column()])[0]
    np.testing.assert_array_equal(found.positions[: STEPS + 1], solved.positions[: STEPS + 1])
    assert {**found.settings, **chosen} == found.settings
    usual = simulator.rollout([column()])[0].positions
    assert 0.2 < np.abs(found.positions[0] - usual[0]).max() / SPACING <= 0.25 + 1e-6
    tensor = other.rollout_tensor([column()])[0]
    np.testing.assert_allclose(tensor.detach(), found.positions, atol=1e-6)
    shared = LearnedSimulator(simulator.model, **chosen, workers=2)
    try:
        for trajectory in shared.rollout([column(), column()]):
            np.testing.assert_allclose(trajectory.positions, found.positions, atol=1e-6)
    finally:
        shared.close()
    with pytest.raises(SimulatorError, match="jitter"):
        LearnedSimulator(simulator.model, jitter=0.5)


def test_a_model_starts_as_the_flows_did_that_it_was_trained_on(simulator, recwarn):
    model = LearnedModel(simulator.config.model_copy(update={"jitter": 0.25}))
    solver = MpmSimulator(spacing=SPACING, frame_interval=DT, jitter=0.25)
    found = LearnedSimulator(model, "shaken").rollout([column()])[0]
    solved = solver.rollout([column()])[0]
    np.testing.assert_array_equal(found.positions[0], solved.positions[0])
    assert found.settings["jitter"] == 0.25
    assert not recwarn.list
    lattice = LearnedSimulator(model, "shaken", jitter=0.0)
    with pytest.warns(UserWarning, match="jitter = 0, but trained on starts moved by 0.25"):
        lattice.check(column())
    lattice.check(column())  # said once
    with pytest.warns(UserWarning, match="jitter = 0.1, but trained on starts moved by 0 "):
        simulator.refilled(0.1, 1).check(column())
    assert not simulator.outside(column())
    assert not any("jitter" in line for line in lattice.refilled(0.4, 2).outside(column()))


def test_the_network_sees_the_solvers_motion(simulator):
    """Its first own step is one step from a history that ends with the solver's frames."""
    found = simulator.rollout([column()])[0].positions
    history = np.concatenate([found[:1], found[: STEPS + 1]]).transpose(1, 0, 2)  # at rest before
    own = simulator.predict_positions(history, scene=column())
    np.testing.assert_allclose(own, found[STEPS + 1], atol=1e-6)


def test_scenes_of_all_lengths_in_one_batch_and_the_tensor_rollout_agree(simulator):
    scenes = [column(0.02), column(0.08), column(0.05)]
    together = simulator.rollout(scenes)
    assert [len(t.positions) for t in together] == [3, 9, 6]
    alone = simulator.rollout([scenes[1]])[0]
    np.testing.assert_allclose(together[1].positions, alone.positions, atol=1e-6)
    whole = simulator.rollout_tensor(scenes[1:])
    for tensor, trajectory in zip(whole, together[1:], strict=True):
        np.testing.assert_allclose(tensor.detach(), trajectory.positions, atol=1e-6)
    with pytest.raises(SimulatorError, match="shorter"):
        simulator.rollout_tensor(scenes[:2])


def test_scattered_points_are_not_the_solvers():
    with pytest.raises(ValueError, match="subcells"):
        ModelConfig(solver_steps=2, subcells=2)

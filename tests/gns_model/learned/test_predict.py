"""One step from bare arrays, and rollouts that begin with points in motion."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gns_model.errors import SimulatorError
from gns_model.learned import LearnedSimulator, World, load_model, save_model
from gns_model.learned.world import baffle_boxes, baffle_points
from gns_model.particles import MOVING, STATIONARY, fill

BOUNDS = ((0.0, 0.9), (0.0, 0.5), (0.0, 0.4))
SEES_POINTS = {"baffles": "points", "types": 9, "walls": "clip", "project": False}


def history_of(scene, steps: int = 2, seed: int = 0) -> np.ndarray:
    """A disordered history of the points of `scene`, shape (N, steps + 1, D)."""
    points = fill(scene, 0.05).positions
    walk = np.random.default_rng(seed).normal(size=(len(points), steps + 1, points.shape[1]))
    return (points[:, None] + 0.003 * walk.cumsum(1)).astype(np.float32)


def test_arrays_for_arrays_and_tensors_for_tensors(make_model, make_scene):
    simulator = LearnedSimulator(make_model(bounds=BOUNDS, **SEES_POINTS))
    history = history_of(make_scene())
    kinds = np.full(len(history), MOVING)
    array = simulator.predict_positions(history, kinds)
    assert isinstance(array, np.ndarray)
    assert array.dtype == np.float32
    world = World.from_bounds(BOUNDS, torch.from_numpy(kinds))
    expected = simulator.model.predict(torch.from_numpy(history), world)
    np.testing.assert_array_equal(array, expected)
    tensor = torch.from_numpy(history).requires_grad_()
    found = simulator.predict_positions(tensor, torch.from_numpy(kinds).int())
    np.testing.assert_array_equal(found.detach(), array)
    (gradient,) = torch.autograd.grad(found.sum(), tensor)
    assert torch.isfinite(gradient).all()
    assert (gradient[:, -1].sum(0) - 2 * len(history)).abs().max() < 0.5 * len(history)
    np.testing.assert_array_equal(simulator.predict_positions(history), array)
    np.testing.assert_array_equal(simulator.predict_positions(history[:0], kinds[:0]).shape, (0, 3))


def test_types_and_bounds_matter_and_stationary_points_are_answered_for(make_model, make_scene):
    simulator = LearnedSimulator(make_model(bounds=BOUNDS, **SEES_POINTS))
    history = history_of(make_scene())
    moving = simulator.predict_positions(history, [MOVING] * len(history))
    still = simulator.predict_positions(history, [STATIONARY] * len(history))
    assert np.abs(moving - still).max() > 2e-5
    assert np.abs(still - history[:, -1]).max() > 1e-4
    wide = [(low - 1, high + 1) for low, high in BOUNDS]
    assert np.abs(simulator.predict_positions(history, bounds=wide) - moving).max() > 1e-6


def test_a_scene_gives_what_arrays_do_not_tell(make_model, make_scene):
    model, scene = make_model(material_features=("tan_friction_angle",)), make_scene()
    simulator, history = LearnedSimulator(model), history_of(scene)
    expected = model.step(torch.from_numpy(history), World.from_scenes([scene], [len(history)]))
    found = simulator.predict_positions(history, scene=scene)
    np.testing.assert_array_equal(found, expected.detach())
    tangent = np.tan(np.radians(scene.material.friction_angle))
    for material in (tangent, np.full(len(history), tangent), np.full((len(history), 1), tangent)):
        again = simulator.predict_positions(history, material=material, scene=scene)
        np.testing.assert_allclose(again, found, atol=1e-7)
    other = simulator.predict_positions(history, material=0.1, scene=scene)
    assert np.abs(other - found).max() > 1e-6


def test_bounds_are_kept_in_the_checkpoint(make_model, make_scene, tmp_path):
    model = make_model(bounds=BOUNDS, hidden=6, edge_update="doubled", **SEES_POINTS)
    history = history_of(make_scene())
    again = load_model(save_model(tmp_path / "m", model))
    assert again.config == model.config
    np.testing.assert_array_equal(
        again.predict_positions(history), LearnedSimulator(model).predict_positions(history)
    )


FRICTION = {**SEES_POINTS, "bounds": BOUNDS, "material_features": ("tan_friction_angle",)}
ROUGH = {**SEES_POINTS, "bounds": BOUNDS, "material_features": ("base_friction",)}


@pytest.mark.parametrize(
    ("options", "call", "words"),
    [
        ({}, {}, "baffles by their distance"),
        (SEES_POINTS, {}, "where are the walls"),
        (SEES_POINTS, {"bounds": BOUNDS[:2]}, "bounds must be 3 ordered pairs"),
        (SEES_POINTS, {"bounds": [(1, 0)] * 3}, "bounds must be 3 ordered pairs"),
        (ROUGH, {}, "base_friction"),
        (FRICTION, {}, "give material"),
        (FRICTION, {"material": np.ones(3)}, r"material must be a number or have shape \(64,\)"),
        ({**SEES_POINTS, "bounds": BOUNDS}, {"material": 0.5}, "sees no tan_friction_angle"),
        (SEES_POINTS, {"particle_type": [6]}, "particle_type must be integers"),
        (SEES_POINTS, {"particle_type": np.ones(64)}, "particle_type must be integers"),
        (SEES_POINTS, {"particle_type": [9] * 64}, r"must lie in 0..8"),
        (SEES_POINTS, {"particle_type": [-1] * 64}, r"must lie in 0..8"),
        ({}, {"flat": True}, "the scene is 2D and the model 3D"),
        ({}, {"short": True}, r"must have shape \(N, 3, 3\)"),
    ],
)
def test_what_is_missing_or_does_not_fit_is_one_clear_line(
    make_model, make_scene, options, call, words
):
    simulator, history = LearnedSimulator(make_model(**options)), history_of(make_scene())
    if call.pop("flat", False):
        call["scene"] = make_scene(2)
    if call.pop("short", False):
        history = history[:, 1:]
    with pytest.raises(SimulatorError, match=words) as caught:
        simulator.predict_positions(history, **call)
    assert "\n" not in str(caught.value)


# -- rollouts from points in motion --------------------------------------------------------------


@pytest.mark.parametrize("options", [{}, SEES_POINTS])
def test_a_rollout_goes_on_where_another_stopped(make_model, make_scene, options):
    simulator = LearnedSimulator(make_model(**options), "tiny")
    scene = make_scene()
    (whole,) = simulator.rollout([scene])
    history = whole.positions[4:7].transpose(1, 0, 2)
    kinds = np.full(len(history), MOVING)
    if options:  # the barriers that a scene's rollout puts there by itself
        fixed = baffle_points(baffle_boxes(scene), 0.05).numpy()
        history = np.concatenate([history, np.repeat(fixed[:, None], 3, axis=1)])
        kinds = np.concatenate([kinds, np.full(len(fixed), STATIONARY)])
    seen: list[float] = []
    found = simulator.rollout_from(scene, history, kinds, frames=5, progress=seen.append)
    assert found.positions.shape == (5, len(history), 3)
    moving = whole.positions.shape[1]
    assert np.abs(found.positions[:, :moving] - whole.positions[6:]).max() <= 1e-5
    assert (found.positions[:, moving:] == found.positions[0, moving:]).all()
    np.testing.assert_array_equal(found.particle_type, kinds)
    np.testing.assert_allclose(found.time, 0.01 * np.arange(5))
    assert (found.status, found.simulator, seen[-1]) == ("ok", "tiny", 1.0)
    longest = simulator.rollout_from(scene, history, kinds)
    assert len(longest.positions) == len(whole.positions)


def test_friction_of_its_own_and_divergence(make_model, make_scene):
    simulator = LearnedSimulator(make_model(material_features=("tan_friction_angle",)))
    scene = make_scene()
    history, kinds = history_of(scene), np.full(64, MOVING)
    tangent = np.full(64, np.tan(np.radians(scene.material.friction_angle)), np.float32)
    plain, same, other, sick = (
        simulator.rollout_from(scene, history, kinds, friction, frames=4)
        for friction in (None, tangent, 5 * tangent, np.full(64, 1e38, np.float32))
    )
    np.testing.assert_allclose(plain.positions, same.positions, atol=1e-6)
    assert np.abs(plain.positions[-1] - other.positions[-1]).max() > 1e-5
    assert (plain.status, sick.status) == ("ok", "diverged")
    assert np.isfinite(sick.positions).all()
    with pytest.raises(SimulatorError, match="history must have shape"):
        simulator.rollout_from(scene, history[:, 1:], kinds)
    with pytest.raises(SimulatorError, match="in a 2D one"):
        simulator.rollout_from(make_scene(2), history, kinds)

from __future__ import annotations

import copy
import warnings

import numpy as np
import pytest
import torch

from gns_model.errors import SimulatorError
from gns_model.learned import LearnedSimulator, Limits
from gns_model.learned import rollout as module
from gns_model.learned.adjoint import FilterAdjoint, smoothed
from gns_model.simulator import Simulator
from gns_model.trajectory import Trajectory

DIMS = pytest.mark.parametrize("dim", [2, 3])


def several(make_scene, dim=3):
    """Scenes of different duration, layout and number of points."""
    none = make_scene(dim, baffle=[])
    other = make_scene(dim, duration=0.06, shift=(1.0, 0.0, -1.0))
    size = [0.4, 0.3, 0.3][:dim]
    lower = [0.05, 0.02, 0.05][:dim]
    large = {
        "lower": lower,
        "upper": [a + b for a, b in zip(lower, [0.2, 0.3, 0.3], strict=False)],
        "velocity": [1.0, 0.0, 0.0][:dim],
    }
    assert len(size) == dim
    return [make_scene(dim), none, other, make_scene(dim, release=[large])]


@DIMS
def test_rollout_is_a_trajectory(make_model, make_scene, dim, tmp_path):
    simulator = LearnedSimulator(make_model(dim=dim), "tiny")
    assert isinstance(simulator, Simulator)
    scene = make_scene(dim)
    (trajectory,) = simulator.rollout([scene])
    assert trajectory.positions.shape == (11, 4**dim, dim)
    np.testing.assert_allclose(trajectory.time, np.arange(11) * 0.01)
    assert (trajectory.status, trajectory.simulator, trajectory.scene) == ("ok", "tiny", scene)
    assert trajectory.point_volume == pytest.approx(0.05**dim)
    first = trajectory.positions[1] - trajectory.positions[0]
    assert np.median(first[:, 0]) == pytest.approx(2.0 * 0.01, rel=0.3)  # it starts as released
    trajectory.save(tmp_path / "t.h5")
    assert Trajectory.load(tmp_path / "t.h5").settings == trajectory.settings


@DIMS
def test_batch_equals_singles(make_model, make_scene, dim, monkeypatch):
    simulator = LearnedSimulator(make_model(dim=dim))
    scenes = several(make_scene, dim)
    together = simulator.rollout(scenes)
    monkeypatch.setitem(module.BATCH_POINTS, "cpu", 1)
    alone = simulator.rollout(scenes)
    assert [len(t.positions) for t in together] == [11, 11, 7, 11]
    for one, other in zip(together, alone, strict=True):
        assert np.abs(one.positions - other.positions).max() <= 1e-5


def test_no_point_in_a_baffle_and_the_layout_matters(make_model, make_scene):
    simulator = LearnedSimulator(make_model())
    with_baffles, without = simulator.rollout(
        [make_scene(duration=0.3), make_scene(duration=0.3, baffle=[])]
    )
    # Float32 positions against the exact boxes and domain: rounding must not let a point in.
    boxes = with_baffles.scene.baffle_boxes()
    points = with_baffles.positions[:, :, None].astype(np.float64)
    assert not ((points > boxes[:, 0]) & (points < boxes[:, 1])).all(-1).any()
    assert (points[:, :, 0] >= with_baffles.scene.domain.lower).all()
    assert (points[:, :, 0] <= with_baffles.scene.domain.upper).all()
    on_a_face = ((abs(points - boxes[:, 0]) < 1e-6) | (abs(points - boxes[:, 1]) < 1e-6)).any(-1)
    assert on_a_face.any()
    assert np.abs(with_baffles.positions[-1] - without.positions[-1]).max() > 0.02


def test_a_diverged_scene_ends_and_leaves_the_others_alone(make_model, make_scene):
    simulator = LearnedSimulator(make_model(material_features=("base_friction",)))
    good = make_scene()
    sick = make_scene(friction={"base": 1e38})  # overflows float32 inside the network
    (alone,) = simulator.rollout([good])
    one, bad, other = simulator.rollout([good, sick, good])
    assert [one.status, bad.status, other.status] == ["ok", "diverged", "ok"]
    assert np.isfinite(bad.positions).all()
    assert bad.positions.shape == one.positions.shape
    assert (bad.positions == bad.positions[0]).all()
    assert bad.settings["diverged_at"] == pytest.approx(0.01)
    for trajectory in (one, other):
        assert np.abs(trajectory.positions - alone.positions).max() <= 1e-5


def test_absurd_speed_is_divergence(make_model, make_scene):
    model = make_model(project=False)
    model.acceleration_std.mul_(1000)
    (trajectory,) = LearnedSimulator(model).rollout([make_scene()])
    assert trajectory.status == "diverged"
    assert np.abs(trajectory.positions).max() < 10


def test_progress_rises_to_one(make_model, make_scene, monkeypatch):
    monkeypatch.setitem(module.BATCH_POINTS, "cpu", 100)
    seen: list[float] = []
    LearnedSimulator(make_model()).rollout(several(make_scene), progress=seen.append)
    assert seen == sorted(seen)
    assert 0 < seen[0] < 0.1
    assert seen[-1] == pytest.approx(1)


def test_the_original_model_may_train_on(make_model, make_scene):
    model = make_model().train()
    simulator = LearnedSimulator(model)
    assert all(p.requires_grad for p in model.parameters())
    assert not any(p.requires_grad for p in simulator.model.parameters())
    before = simulator.rollout([make_scene()])[0].positions
    with torch.no_grad():
        for p in model.parameters():
            p.mul_(2)
    assert (simulator.rollout([make_scene()])[0].positions == before).all()


def test_check(make_model, make_scene):
    simulator = LearnedSimulator(make_model(dim=2), "flat")
    with pytest.raises(SimulatorError, match="flat is a 2D model"):
        simulator.check(make_scene(3))
    with pytest.raises(SimulatorError, match="2D model"):
        simulator.rollout([make_scene(3)])
    thin = {"lower": [0.1, 0.1], "upper": [0.12, 0.3], "velocity": [0, 0]}
    with pytest.raises(ValueError, match=r"release\[0\]"):
        simulator.check(make_scene(2, release=[thin]))
    for options in ({"workers": 0}, {"threads": 0}, {"precision": "float16"}):
        with pytest.raises(SimulatorError):
            LearnedSimulator(make_model(), **options)


def test_warns_once_of_what_it_was_not_trained_for(make_model, make_scene):
    trained = [make_scene(), make_scene(material={"friction_angle": 30})]
    limits = Limits.of(trained)
    simulator = LearnedSimulator(make_model(limits=limits), "tiny")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for scene in trained:
            simulator.check(scene)
        simulator.check(make_scene(baffle=[]))
    odd = make_scene(
        material={"friction_angle": 20}, friction={"base": 0.1}, gravity=[3.0, -9.3, 0.0]
    )
    with pytest.warns(UserWarning, match="tiny was trained on") as caught:
        simulator.check(odd)
    lines = [str(w.message) for w in caught]
    assert len(lines) == 3
    for name in ("friction_angle = 20", "base_friction = 0.1", "slope = 17.8"):
        assert sum(name in line and "\n" not in line for line in lines) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        simulator.check(odd)


def test_kinematic_points_are_not_returned(make_model, make_scene):
    model = make_model(baffles="points", types=9, project=False)
    scenes = [make_scene(), make_scene(baffle=[])]
    one, other = LearnedSimulator(model).rollout(scenes)
    assert one.positions.shape == other.positions.shape
    assert (one.particle_type == 6).all()
    tensors = LearnedSimulator(model).rollout_tensor(scenes)
    assert np.abs(tensors[0].numpy() - one.positions).max() <= 1e-5


@pytest.mark.slow
def test_workers_give_the_same(make_model, make_scene):
    scenes = several(make_scene)
    simulator = LearnedSimulator(make_model(), "tiny", workers=2)
    expected = LearnedSimulator(make_model(), "tiny").rollout(scenes)
    seen: list[float] = []
    for _ in range(2):  # the second time with the processes at hand
        found = simulator.rollout(scenes, progress=seen.append)
        for one, other in zip(found, expected, strict=True):
            assert np.abs(one.positions - other.positions).max() <= 1e-5
            assert (one.status, one.scene) == (other.status, other.scene)
    assert seen[-1] == 1
    copy.deepcopy(simulator)
    simulator.close()


# -- gradients -----------------------------------------------------------------------------------


def centres_of(scene, dtype=torch.float64):
    return torch.tensor([b.center for b in scene.baffles], dtype=dtype, requires_grad=True)


def test_rollout_tensor_is_the_rollout(make_model, make_scene):
    simulator = LearnedSimulator(make_model())
    scenes = several(make_scene)
    plain = simulator.rollout(scenes)
    tensors = simulator.rollout_tensor(scenes)
    for tensor, trajectory in zip(tensors, plain, strict=True):
        assert tensor.shape == trajectory.positions.shape
        assert np.abs(tensor.numpy() - trajectory.positions).max() <= 1e-5
    assert [len(t) for t in simulator.rollout_tensor(scenes, frames=4)] == [4] * 4


def test_centres_and_noise_are_used(make_model, make_scene):
    simulator = LearnedSimulator(make_model())
    scene = make_scene()
    moved = scene.with_baffles([[0.40, 0.2], [0.60, 0.2]], size=scene.baffles[0].size)
    same_size = scene.with_baffles([[0.42, 0.13], [0.58, 0.28]], size=scene.baffles[0].size)
    centres = torch.tensor([b.center for b in moved.baffles])
    (by_centres,) = simulator.rollout_tensor([same_size], [centres])
    (by_scene,) = simulator.rollout_tensor([moved])
    torch.testing.assert_close(by_centres, by_scene, atol=1e-6, rtol=0)
    shift = torch.full((64, 3), 0.004)
    (shifted,) = simulator.rollout_tensor([scene], frames=2, noise=[shift])
    (plain,) = simulator.rollout_tensor([scene], frames=2)
    torch.testing.assert_close(shifted[0] - plain[0], shift, atol=1e-7, rtol=0)
    assert not torch.equal(shifted[1] - shifted[0], plain[1] - plain[0])


def objective(simulator, scenes, centres, **options):
    tensors = simulator.rollout_tensor(scenes, centres, frames=21, **options)
    return sum(t[-1, :, 0].mean() + (t[:, :, 1] ** 2).mean() + t[5:, :, -1].mean() for t in tensors)


@pytest.mark.parametrize("baffles", ["distance", "points"])
@DIMS
def test_gradient_against_central_differences(make_model, make_scene, dim, baffles):
    options = {"types": 9} if baffles == "points" else {}
    model = make_model(dim=dim, dtype=torch.float64, baffles=baffles, **options)
    simulator = LearnedSimulator(model)
    scene = make_scene(dim)
    centres = centres_of(scene)
    (gradient,) = torch.autograd.grad(objective(simulator, [scene], [centres]), centres)
    step, numeric = 1e-6, torch.zeros_like(gradient)
    with torch.no_grad():
        for index in np.ndindex(*centres.shape):
            sides = []
            for sign in (1, -1):
                moved = centres.detach().clone()
                moved[index] += sign * step
                sides.append(objective(simulator, [scene], [moved]))
            numeric[index] = (sides[0] - sides[1]) / (2 * step)
    assert numeric.norm() > 1e-3
    assert (gradient - numeric).norm() <= 1e-4 * numeric.norm()


def test_checkpointed_gradient_equals_plain_and_batch_equals_singles(make_model, make_scene):
    simulator = LearnedSimulator(make_model(dtype=torch.float64))
    scenes = [make_scene(), make_scene(shift=(0.5, 0.0, 0.25))]
    gradients = []
    for options in ({"checkpoint": True}, {"checkpoint": False}):
        centres = [centres_of(s) for s in scenes]
        objective(simulator, scenes, centres, **options).backward()
        gradients.append(torch.cat([c.grad for c in centres]))
    centres = [centres_of(s) for s in scenes]
    for scene, own in zip(scenes, centres, strict=True):
        objective(simulator, [scene], [own]).backward()
    gradients.append(torch.cat([c.grad for c in centres]))
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(gradients[0], gradients[2], rtol=1e-9, atol=1e-12)
    assert all(p.grad is None for p in simulator.model.parameters())


def test_bfloat16_rollout_stays_near(make_model, make_scene):
    exact, short = (
        LearnedSimulator(make_model(), precision=p).rollout([make_scene()])[0].positions
        for p in ("float32", "bfloat16")
    )
    assert 0 < np.abs(exact - short).max() < 2e-3


def test_no_grain_drowns_the_others_in_a_limited_gradient():
    adjoint = torch.tensor(
        [[1.0, 0.0], [0.0, 1.0], [3e6, 4e6], [0.0, 0.0], [5.0, 0.0], [50.0, 0.0]]
    )
    positions = torch.zeros(6, 2, requires_grad=True)
    moving = torch.ones(6, dtype=torch.bool)
    same = FilterAdjoint.apply(positions, [4, 2], moving, 2.0, 0.0, 0.1)
    torch.testing.assert_close(same, positions)
    same.backward(adjoint)
    # Scene 0: median 1, so at most 2; scene 1: median 5, so at most 10. Directions stay.
    expected = [[1.0, 0.0], [0.0, 1.0], [1.2, 1.6], [0.0, 0.0], [5.0, 0.0], [10.0, 0.0]]
    torch.testing.assert_close(positions.grad, torch.tensor(expected))


def test_smoothing_spreads_an_adjoint_among_neighbours_and_keeps_the_sum_of_each_scene():
    rng = np.random.default_rng(0)
    positions = torch.tensor(rng.uniform(0, 0.2, (60, 3)), dtype=torch.float32)
    adjoint = torch.tensor(rng.normal(size=(60, 3)), dtype=torch.float32)
    batch = torch.repeat_interleave(torch.arange(2), 30)
    moving = torch.ones(60, dtype=torch.bool)
    moving[25:30] = False
    calm = smoothed(adjoint, positions, batch, moving, 1.0, 0.08)
    for scene in (0, 1):
        torch.testing.assert_close(calm[batch == scene].sum(0), adjoint[batch == scene].sum(0))
        assert calm[batch == scene].var() < 0.7 * adjoint[batch == scene].var()
    torch.testing.assert_close(calm[25:30], adjoint[25:30])  # they stand still
    torch.testing.assert_close(
        smoothed(torch.ones(60, 3), positions, batch, moving, 1.0, 0.08), torch.ones(60, 3)
    )
    torch.testing.assert_close(smoothed(adjoint, positions, batch, moving, 0.0, 0.08), adjoint)

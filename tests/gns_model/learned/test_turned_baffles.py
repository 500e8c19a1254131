"""Baffles turned about the vertical, as a learned simulator has them."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gns_model import footprint, measures
from gns_model.errors import SimulatorError
from gns_model.learned import LearnedSimulator
from gns_model.learned.config import Limits
from gns_model.learned.contact import project
from gns_model.learned.features import signed_distance
from gns_model.learned.world import World, baffle_points, baffle_poses
from gns_model.scene import Scene
from gns_model.training.augment import mirrored

YAWS = (35.0, -60.0)


def askew(scene: Scene, yaws: tuple[float, ...] = YAWS) -> Scene:
    baffles = [b.model_dump() | {"yaw": y} for b, y in zip(scene.baffles, yaws, strict=True)]
    return scene.replace(baffles=tuple(baffles))


#: Turned boxes, one of which touches a wall with a corner, and one along the axes in a corner.
CROWDED = Scene.from_dict(
    {
        "domain": {"lower": (1.0, 0.0, 1.0), "upper": (2.0, 0.4, 1.8)},
        "release": [{"lower": (1, 0, 1), "upper": (1.1, 0.2, 1.2), "velocity": (1, 0, 0)}],
        "baffle": [
            {"center": (1.45, 1.4), "size": (0.1, 0.3, 0.2), "yaw": 30.0},
            {"center": (1.3, 1 + 0.1 * np.sqrt(0.5)), "size": (0.1, 0.25, 0.1), "yaw": 45.0},
            {"center": (1.8, 1.55), "size": (0.05, 0.4, 0.3), "yaw": -70.0},
            {"center": (1.95, 1.05), "size": (0.1, 0.3, 0.1)},
        ],
    }
)


def inside(points: np.ndarray, scene: Scene) -> np.ndarray:
    """Whether points (N, 3), float64, lie in a baffle, edge and base left aside."""
    found = np.zeros(len(points), bool)
    for baffle in scene.baffles:
        cosine, sine = footprint.turn(baffle.yaw)
        x, z = points[:, 0] - baffle.center[0], points[:, 2] - baffle.center[1]
        u, v = cosine * x + sine * z, cosine * z - sine * x
        a, h, b = baffle.size
        found |= (abs(u) < a / 2) & (abs(v) < b / 2) & (points[:, 1] < scene.base + h)
    return found


@given(st.integers(0, 10**6), st.sampled_from([torch.float32, torch.float64]))
def test_nothing_ends_inside_a_turned_baffle_or_outside_the_domain(seed, dtype):
    rng = np.random.default_rng(seed)
    lower, upper = np.array(CROWDED.domain.lower), np.array(CROWDED.domain.upper)
    before = rng.uniform(lower, upper, (400, 3))
    after = before + rng.normal(0, rng.choice([0.03, 0.2]), before.shape)
    after[:40, 1] = before[:40, 1] = 0.0
    world = World.from_scenes([CROWDED], [len(before)], dtype=dtype)
    args = [torch.tensor(a, dtype=dtype) for a in (before, after)]
    moved = project(*args, world).double().numpy()
    # The corner at the wall leaves less room than one rounding.
    tight = np.hypot(moved[:, 0] - 1.3, moved[:, 2] - 1.0) < 1e-5
    assert not inside(moved[~tight], CROWDED).any()
    assert (moved >= lower - 1e-12).all()
    assert (moved <= upper + 1e-6).all()
    kept = ~inside(np.clip(after, lower, upper), CROWDED)
    met = np.abs(moved - np.clip(after, lower, upper)).max(1) > 1e-5
    assert met.any()
    assert (kept & ~met).any()
    again = project(torch.tensor(moved, dtype=dtype), torch.tensor(moved, dtype=dtype), world)
    assert np.abs(again.double().numpy() - moved)[~tight].max() < 1e-5


@settings(max_examples=20)
@given(st.tuples(*[st.floats(-0.5, 0.5)] * 3), st.floats(-89, 90))
def test_the_distance_turns_with_the_box_and_the_normal_is_its_slope(point, yaw):
    boxes = torch.tensor([[[-0.1, -9.0, -0.2], [0.1, 0.3, 0.2]]], dtype=torch.float64)[None, 0]
    boxes = boxes.reshape(1, 1, 2, 3)
    cosine, sine = footprint.turn(yaw)
    frames = torch.tensor([[[0.0, 0.0, cosine, sine]]], dtype=torch.float64)
    p = torch.tensor([point], dtype=torch.float64, requires_grad=True)
    turned = torch.tensor([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]], dtype=torch.float64)
    distance, normal = signed_distance(p, boxes, frames)
    expected, flat = signed_distance(p @ turned.T, boxes)
    torch.testing.assert_close(distance, expected)
    torch.testing.assert_close(normal[0], flat[0] @ turned)
    (slope,) = torch.autograd.grad(distance.sum(), p)
    if distance.item() > 1e-6:
        torch.testing.assert_close(slope, normal[0], rtol=1e-6, atol=1e-6)


def test_no_point_enters_a_turned_baffle_and_the_yaw_matters(make_model, make_scene):
    simulator = LearnedSimulator(make_model())
    plain, scene = make_scene(duration=0.25), askew(make_scene(duration=0.25))
    a, b = simulator.rollout([scene, plain])
    assert a.status == "ok"
    assert measures.points_inside_baffles(a, slack=0.0) == 0
    assert np.abs(a.positions[-1] - b.positions[-1]).max() > 0.01
    # Beside a turned scene a plain one is what it is alone, up to rounding.
    (alone,) = simulator.rollout([plain])
    np.testing.assert_allclose(b.positions[:15], alone.positions[:15], atol=1e-4)


def test_a_quarter_turn_is_exchanged_sides(make_model, make_scene):
    simulator = LearnedSimulator(make_model())
    scene = make_scene(duration=0.2)
    sizes = [(0.06, 0.15, 0.14), (0.04, 0.2, 0.16)]
    centres = [b.center for b in scene.baffles]
    turned = scene.with_baffles(centres, size=sizes, yaw=90.0)
    plain = scene.with_baffles(centres, size=[(b, h, a) for a, h, b in sizes], yaw=0.0)
    a, b = simulator.rollout([turned, plain])
    np.testing.assert_array_equal(a.positions, b.positions)


def test_no_yaw_as_a_tensor_is_no_yaw(make_model, make_scene):
    simulator = LearnedSimulator(make_model(dtype=torch.float64))
    scene = make_scene()
    with torch.no_grad():
        (plain,) = simulator.rollout_tensor([scene], frames=20)
        (zero,) = simulator.rollout_tensor([scene], frames=20, yaws=[torch.zeros(2)])
        (own,) = simulator.rollout_tensor([askew(scene)], frames=20)
        (given_,) = simulator.rollout_tensor([scene], frames=20, yaws=[torch.tensor(YAWS)])
    torch.testing.assert_close(zero, plain, rtol=0, atol=1e-9)
    torch.testing.assert_close(given_, own, rtol=0, atol=1e-9)
    assert (own - plain).abs().max() > 1e-3


@pytest.mark.parametrize("baffles", ["distance", "points"])
def test_gradient_in_place_size_and_yaw_against_central_differences(
    make_model, make_scene, baffles
):
    options = {"types": 9} if baffles == "points" else {}
    simulator = LearnedSimulator(make_model(dtype=torch.float64, baffles=baffles, **options))
    scene = askew(make_scene())

    def objective(centres, sizes, yaws):
        (t,) = simulator.rollout_tensor([scene], [centres], sizes=[sizes], yaws=[yaws], frames=15)
        return t[-1, :, 0].mean() + (t[:, :, 1] ** 2).mean() + t[5:, :, -1].mean()

    values = [
        torch.tensor([getattr(b, name) for b in scene.baffles], dtype=torch.float64)
        for name in ("center", "size", "yaw")
    ]
    wanted = [v.clone().requires_grad_() for v in values]
    gradients = torch.autograd.grad(objective(*wanted), wanted)
    for which, (name, gradient) in enumerate(
        zip(("centre", "size", "yaw"), gradients, strict=True)
    ):
        step, numeric = 1e-6 if which < 2 else 1e-4, torch.zeros_like(gradient)
        with torch.no_grad():
            for index in np.ndindex(*gradient.shape):
                sides = []
                for sign in (1, -1):
                    moved = [v.clone() for v in values]
                    moved[which][index] += sign * step
                    sides.append(objective(*moved))
                numeric[index] = (sides[0] - sides[1]) / (2 * step)
        assert numeric.norm() > 1e-6, name
        assert (gradient - numeric).norm() <= 1e-4 * numeric.norm(), name


def test_kinematic_points_turn_with_their_baffle(make_scene):
    scene = askew(make_scene())
    boxes, turns = baffle_poses(scene)
    points = baffle_points(boxes, 0.02, turns).double().numpy()
    assert len(points) == len(baffle_points(boxes, 0.02))
    assert inside(points, scene).all()
    straight = baffle_points(*baffle_poses(make_scene())[:1], 0.02).double().numpy()
    assert not inside(straight, scene).all()


def test_a_pose_needs_a_row_for_every_baffle(make_model, make_scene):
    simulator = LearnedSimulator(make_model())
    for wrong in ({"yaws": [torch.zeros(3)]}, {"sizes": [torch.ones(2, 2)]}):
        with pytest.raises(ValueError, match="must have shape"):
            simulator.rollout_tensor([make_scene()], frames=3, **wrong)
    flat = LearnedSimulator(make_model(dim=2))
    with pytest.raises(SimulatorError, match="3D"):
        flat.rollout_tensor([make_scene(2)], frames=3, yaws=[torch.zeros(2)])


def test_the_mirror_image_turns_the_other_way(make_scene):
    scene = askew(make_scene())
    image = mirrored(scene)
    assert [b.yaw for b in image.baffles] == [-35.0, 60.0]
    total = scene.domain.lower[2] + scene.domain.upper[2]
    for one, other in zip(scene.baffles, image.baffles, strict=True):
        corners = one.corners * [1, -1] + [0, total]
        assert np.abs(corners[:, None] - other.corners).sum(-1).min(1).max() < 1e-12
    assert [b.yaw for b in mirrored(image).baffles] == [*YAWS]


def test_a_model_of_straight_baffles_warns_once_of_turned_ones(make_model, make_scene):
    straight = Limits.of([make_scene()])
    scene = askew(make_scene())
    assert straight.baffle_yaw is None
    assert straight.broken_by(make_scene()) == []
    simulator = LearnedSimulator(make_model(limits=straight))
    with pytest.warns(UserWarning, match=r"baffle_yaw = -60 degrees, but trained on baffles along"):
        simulator.check(scene)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        simulator.check(askew(scene, (10.0, 0.0)))
    turned = Limits.of([make_scene(), scene])
    assert turned.baffle_yaw == (-60.0, 35.0)
    assert turned.broken_by(scene) == turned.broken_by(make_scene()) == []
    assert "baffle_yaw" in turned.broken_by(askew(scene, (70.0, 0.0)))[0]

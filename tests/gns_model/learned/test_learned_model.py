from __future__ import annotations

import pytest
import torch

from gns_model.learned import World
from gns_model.learned.graph import radius_graph
from gns_model.learned.world import baffle_boxes, baffle_points
from gns_model.particles import MOVING, STATIONARY, fill

DIMS = pytest.mark.parametrize("dim", [2, 3])
#: What vertices and edges may see beside the paper's features, and what else a step may do.
MORE = pytest.mark.parametrize(
    "more", [{}, {"depth_range": 0.1, "strain_unit": 0.3}, {"crowding_limit": 1.001}]
)


def start(model, scene, dtype=torch.float32, seed=0):
    """A history with some disorder in it, near the first baffle, and its world."""
    config = model.config
    points = torch.tensor(fill(scene, config.spacing).positions, dtype=dtype)
    points[:, 0] += 0.1
    walk = torch.randn(
        len(points), config.history + 1, config.dim, dtype=dtype,
        generator=torch.Generator().manual_seed(seed),
    )  # fmt: skip
    history = points[:, None] + 0.003 * walk.cumsum(1)
    return history, World.from_scenes([scene], [len(points)], dtype=dtype)


@DIMS
@MORE
def test_permutation(make_model, make_scene, dim, more):
    model, scene = make_model(dim=dim, **more), make_scene(dim)
    history, world = start(model, scene)
    order = torch.randperm(len(history), generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        one, other = model.step(history, world), model.step(history[order], world)
    assert (one[order] - other).abs().max() <= 1e-5
    assert (one - history[:, -1]).abs().max() > 1e-3


@DIMS
@MORE
def test_translation_with_the_domain(make_model, make_scene, dim, more):
    model = make_model(dim=dim, **more)
    history, world = start(model, make_scene(dim))
    shift = (0.25, -0.5, 0.125)
    moved = make_scene(dim, shift)
    offset = torch.tensor(shift[:dim])
    with torch.no_grad():
        here = model.step(history, world)
        there = model.step(history + offset, World.from_scenes([moved], [len(history)]))
    assert (here + offset - there).abs().max() <= 1e-5


def test_mirror_symmetric_features_do_not_favour_a_side(make_model, make_scene):
    # Weights know left from right; what they are fed must not: a step of the mirrored scene by
    # the network with mirrored inputs is the mirrored step.
    model = make_model(depth_range=0.1, strain_unit=0.3)
    scene = make_scene()
    history, world = start(model, scene)
    z = make_scene().domain.upper[2]
    baffles = [{"center": (b.center[0], z - b.center[1]), "size": b.size} for b in scene.baffles]
    releases = [{**r.model_dump(), "lower": r.lower, "upper": r.upper} for r in scene.releases]
    other = World.from_scenes([make_scene(baffle=baffles, release=releases)], [len(history)])
    mirrored = history.clone()
    mirrored[..., 2] = z - mirrored[..., 2]
    seen = []
    for h, w in ((history, world), (mirrored, other)):
        velocities = (h[:, 1:] - h[:, :-1]) / model.config.dt
        edges = radius_graph(h[:, -1], model.config.radius, w.batch)
        seen.append(model._vertex_features(h[:, -1], velocities[:, -1], velocities, w, *edges))
    a, b = seen
    config = model.config
    sign, order = torch.ones(a.shape[1]), torch.arange(a.shape[1])
    sign[2 : 3 * config.history : 3] = -1  # z velocities
    walls = 3 * config.history
    order[[walls + 2, walls + 5]] = order[[walls + 5, walls + 2]]  # the two side walls
    sign[walls + 6 + 3] = -1  # z of the baffles' normals
    sign[walls + 6 + 5 + 3] = -1  # slope of the flow depth along z
    sign[[walls + 15 + 2, walls + 15 + 4]] = -1  # xz and yz of the strain rate
    sign[walls + 15 + 9] = -1  # z of the direction of motion
    torch.testing.assert_close(b, (a * sign)[:, order], atol=1e-4, rtol=1e-4)


def test_free_flight_is_exact_with_a_silent_network(make_model, make_scene):
    model = make_model(dtype=torch.float64)
    with torch.no_grad():
        for p in model.network.decode.parameters():
            p.zero_()
    history, world = start(model, make_scene(), torch.float64)
    history[:, :, 1] += 0.2
    expected = (
        2 * history[:, -1] - history[:, -2]
        + torch.tensor([0, -9.81, 0]).double() * model.config.dt**2
    )  # fmt: skip
    torch.testing.assert_close(model.step(history, world), expected)
    far = make_model(subtract_gravity=False, dtype=torch.float64)
    with torch.no_grad():
        for p in far.network.decode.parameters():
            p.zero_()
    torch.testing.assert_close(far.step(history, world), 2 * history[:, -1] - history[:, -2])


def test_step_is_semi_implicit_euler_of_the_denormalised_acceleration(make_model, make_scene):
    model = make_model(dtype=torch.float64, project=False)
    mean, std = torch.tensor([[1.0, -2.0, 0.0], [4.0, 5.0, 6.0]]).double()
    zero, one = torch.zeros(3), torch.ones(3)
    model.set_normalisation(
        velocity_mean=zero, velocity_std=one, acceleration_mean=mean, acceleration_std=std
    )
    history, world = start(model, make_scene(), torch.float64)
    dt = model.config.dt
    with torch.no_grad():
        acceleration = model.acceleration(history, world) * std + mean
        velocity = (history[:, -1] - history[:, -2]) / dt
        velocity = velocity + (acceleration + torch.tensor([0, -9.81, 0]).double()) * dt
        torch.testing.assert_close(model.step(history, world), history[:, -1] + velocity * dt)


@pytest.mark.parametrize(("envelope", "jump"), [(True, False), (False, True)])
def test_output_is_continuous_where_a_point_comes_within_the_radius(
    make_model, make_scene, envelope, jump
):
    model = make_model(
        dtype=torch.float64, envelope=envelope, relative_velocity=False, depth_range=0.08
    )
    scene = make_scene()
    base = torch.tensor([[0.3, 0.25, 0.2], [0.33, 0.25, 0.2]], dtype=torch.float64)

    def output(distance: float) -> torch.Tensor:
        third = base[:1] + torch.tensor([[-distance, 0, 0]], dtype=torch.float64)
        points = torch.cat([base, third])
        history = points[:, None].expand(-1, model.config.history + 1, -1)
        with torch.no_grad():
            return model.acceleration(history, World.from_scenes([scene], [3], dtype=torch.float64))

    radius = model.config.radius
    change = (output(radius - 1e-9) - output(radius + 1e-9)).abs().max()
    assert bool(change > 1e-3) == jump
    if not jump:
        assert change < 1e-7
        # The edge matters once it is well inside.
        assert (output(0.6 * radius) - output(1.1 * radius)).abs().max() > 1e-3


def test_kinematic_points_stay_and_are_felt(make_model, make_scene):
    model = make_model(baffles="points", types=9, walls="clip", project=False, envelope=False)
    scene = make_scene()
    history, _ = start(model, scene)
    fixed = baffle_points(baffle_boxes(scene), model.config.spacing)
    both = torch.cat([history, fixed[:, None].expand(-1, history.shape[1], -1)])
    kind = torch.tensor([MOVING] * len(history) + [STATIONARY] * len(fixed))
    world = World.from_scenes([scene], [len(both)], particle_type=kind)
    bare = World.from_scenes([scene], [len(history)])
    with torch.no_grad():
        after = model.step(both, world)
        felt = model.acceleration(both, world)[: len(history)]
        alone = model.acceleration(history, bare)
    assert torch.equal(after[len(history) :], fixed)
    assert (felt - alone).abs().max() > 1e-3


def test_baffle_points_fill_their_boxes_and_follow_them(make_scene):
    scene = make_scene()
    centres = torch.tensor([b.center for b in scene.baffles], requires_grad=True)
    boxes = baffle_boxes(scene, centres)
    torch.testing.assert_close(boxes, baffle_boxes(scene))
    points = baffle_points(boxes, 0.05)
    assert len(points) == 2 * 3 * 2 + 2 * 4 * 2
    assert ((points[:12] > boxes[0, 0]) & (points[:12] < boxes[0, 1])).all()
    points[:, 0].sum().backward()
    assert centres.grad.tolist() == [[12, 0], [16, 0]]


def test_material_features_reach_the_output(make_model, make_scene):
    model = make_model(material_features=("base_friction", "tan_friction_angle"))
    history, _ = start(model, make_scene())
    steps = []
    for friction, angle in ((0.2, 35.0), (0.7, 35.0), (0.2, 20.0)):
        scene = make_scene(friction={"base": friction}, material={"friction_angle": angle})
        with torch.no_grad():
            steps.append(model.step(history, World.from_scenes([scene], [len(history)])))
    assert not torch.equal(steps[0], steps[1])
    assert not torch.equal(steps[0], steps[2])


def test_friction_of_every_point_takes_the_place_of_the_scenes(make_model, make_scene):
    model = make_model(material_features=("tan_friction_angle", "base_friction"))
    soft, hard = (make_scene(material={"friction_angle": a}) for a in (20.0, 40.0))
    history, _ = start(model, soft)
    tangents = torch.tensor([20.0, 40.0]).deg2rad().tan()
    half = len(history) // 2
    mixed = torch.cat([tangents[0].expand(half), tangents[1].expand(len(history) - half)])
    count = [len(history)]
    with torch.no_grad():
        for friction, scene in ((tangents[0], soft), (tangents[1], hard)):
            given = World.from_scenes([soft], count, tan_friction=friction.expand(len(history)))
            expected = model.step(history, World.from_scenes([scene], count))
            torch.testing.assert_close(model.step(history, given), expected, atol=1e-7, rtol=0)
        seen = World.from_scenes([soft, hard], [half, len(history) - half]).point_material
    torch.testing.assert_close(
        World.from_scenes([soft], count, tan_friction=mixed).point_material, seen
    )


def test_refuses_a_history_of_another_length(make_model, make_scene):
    model = make_model()
    history, world = start(model, make_scene())
    with pytest.raises(ValueError, match="history must have shape"):
        model.acceleration(history[:, 1:], world)


def test_refuses_vanishing_deviations(make_model):
    zero, one = torch.zeros(3), torch.ones(3)
    with pytest.raises(ValueError, match="positive"):
        make_model().set_normalisation(
            velocity_mean=zero, velocity_std=zero, acceleration_mean=zero, acceleration_std=one
        )


def test_refuses_centres_of_another_shape(make_scene):
    with pytest.raises(ValueError, match=r"shape \(2, 2\)"):
        baffle_boxes(make_scene(), torch.zeros(3, 2))

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gns_model.learned.features import (
    DEPTH_UNIT,
    baffle_features,
    depth_features,
    edge_features,
    envelope,
    fade,
    signed_distance,
    strain_features,
    wall_features,
)
from gns_model.learned.graph import radius_graph

BOX = torch.tensor([[[[0.2, 0.0, 0.2], [0.5, 0.4, 0.6]]]], dtype=torch.float64)
coordinate = st.floats(-0.3, 1.0)


def brute_distance(point: np.ndarray) -> float:
    """Signed distance from definitions: nearest point outside, nearest face inside."""
    low, high = BOX[0, 0].numpy()
    nearest = np.clip(point, low, high)
    outside = float(np.linalg.norm(point - nearest))
    return outside if outside > 0 else -float(min((point - low).min(), (high - point).min()))


@given(st.tuples(coordinate, coordinate, coordinate))
def test_signed_distance_and_its_gradient(point):
    p = torch.tensor([point], dtype=torch.float64, requires_grad=True)
    distance, normal = signed_distance(p, BOX)
    assert abs(distance.item() - brute_distance(np.array(point))) < 1e-12
    assert abs(normal.norm().item() - 1) < 1e-9
    (gradient,) = torch.autograd.grad(distance.sum(), p)
    # At ties inside and on the faces the derivative of the distance has a choice of faces.
    beyond = torch.maximum(BOX[0, 0, 0] - p, p - BOX[0, 0, 1])[0].detach().sort().values
    if beyond[-1] > 1e-6 or (beyond[-1] < -1e-6 and beyond[-1] - beyond[-2] > 1e-6):
        torch.testing.assert_close(gradient, normal[:, 0].detach(), atol=1e-6, rtol=0)


def test_normal_on_a_face_is_that_of_the_face():
    points = torch.tensor([[0.2, 0.1, 0.4], [0.3, 0.4, 0.3], [0.3, 0.1, 0.6]], dtype=torch.float64)
    distance, normal = signed_distance(points, BOX.expand(3, -1, -1, -1))
    assert distance.abs().max() == 0
    assert normal[:, 0].tolist() == [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]


def test_everything_fades_with_its_slope():
    for end, function in ((0.1, lambda x: fade(x, 0.1)), (1.0, envelope)):
        x = torch.tensor([end - 1e-7, end, end + 1e-7], dtype=torch.float64, requires_grad=True)
        value = function(x)
        (slope,) = torch.autograd.grad(value.sum(), x)
        assert value.abs().max() < 1e-11
        assert slope.abs().max() < 1e-4
    assert envelope(torch.tensor(0.0)) == 1
    assert fade(torch.tensor(0.0), 0.1) == 1


def test_baffle_features_end_at_their_range_and_turn_with_the_scene():
    far = torch.tensor([[0.7, 0.1, 0.4]], dtype=torch.float64)
    velocity = torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64)
    assert baffle_features(far, velocity, BOX, 0.2 - 1e-9).abs().max() == 0
    near = baffle_features(far, velocity, BOX, 0.4)
    # w = (1 - 0.2/0.4)², normal +x, approach 1
    torch.testing.assert_close(near, torch.tensor([[0.25, 0.25, 0, 0, 0.25]], dtype=torch.float64))
    mirror = torch.tensor([1.0, 1, -1], dtype=torch.float64)
    flipped = torch.stack([BOX[..., 0, :], BOX[..., 1, :]], dim=-2) * mirror
    flipped = torch.stack(
        [torch.minimum(*flipped.unbind(-2)), torch.maximum(*flipped.unbind(-2))], dim=-2
    )
    point = torch.tensor([[0.55, 0.45, 0.65]], dtype=torch.float64)
    one = baffle_features(point, velocity, BOX, 0.3)
    other = baffle_features(point * mirror, velocity * mirror, flipped, 0.3)
    torch.testing.assert_close(other, one * torch.tensor([1, 1, 1, -1, 1]).double())


def test_wall_features_paper_and_ours():
    points = torch.tensor([[0.01, 0.5]])
    lower, upper = torch.zeros(1, 2), torch.ones(1, 2)
    clipped = wall_features(points, lower, upper, 0.04, clip=1.0)
    torch.testing.assert_close(clipped, torch.tensor([[0.25, 1, 1, 1]]))
    wider = wall_features(points, lower, upper, 0.04, clip=20.0)
    torch.testing.assert_close(wider, torch.tensor([[0.25, 12.5, 20, 12.5]]))
    faded = wall_features(points, lower, upper, 0.04)
    torch.testing.assert_close(faded, torch.tensor([[0.5625, 0, 0, 0]]))


def test_edge_features_are_receiver_minus_sender_and_differentiable_when_points_coincide():
    points = torch.tensor([[0.0, 0.0], [0.3, 0.4], [0.3, 0.4]], requires_grad=True)
    velocity = torch.tensor([[1.0, 0.0], [0.0, 2.0], [0.0, 0.0]])
    senders, receivers = torch.tensor([0, 1]), torch.tensor([1, 2])
    feature, norm = edge_features(points, velocity, senders, receivers, 0.5)
    torch.testing.assert_close(
        feature, torch.tensor([[0.6, 0.8, 1, -1, 2], [0, 0, 0, 0, -2]]), atol=2e-6, rtol=0
    )
    assert edge_features(points, None, senders, receivers, 0.5)[0].shape == (2, 3)
    norm.sum().backward()
    assert torch.isfinite(points.grad).all()


def heap(dim: int, spacing: float = 0.02, height=lambda x: 0.3 + 0.0 * x) -> torch.Tensor:
    """A lattice over 0.6 m (x 0.4 m) whose free surface lies at `height` [m] above x."""
    axis = [(torch.arange(round(e / spacing)) + 0.5) * spacing for e in (0.6, 0.6, 0.4)[:dim]]
    points = torch.cartesian_prod(*axis).double()
    return points[points[:, 1] < height(points[:, 0])]


def depths(points, spacing=0.02, reach=0.06, moving=None, batch=None):
    moving = torch.ones(len(points), dtype=torch.bool) if moving is None else moving
    batch = torch.zeros(len(points), dtype=torch.int64) if batch is None else batch
    return depth_features(points, moving, batch, reach, spacing)


@pytest.mark.parametrize("dim", [2, 3])
def test_depth_features_of_a_layer_and_of_a_wedge(dim):
    points = heap(dim)
    inner = (points[:, ::2] > 0.07).all(1)
    inner &= (points[:, 0] < 0.53) & ((points[:, 2] < 0.33) if dim == 3 else True)
    over, depth, *slope = depths(points)[inner].T
    torch.testing.assert_close(depth * DEPTH_UNIT, torch.full_like(depth, 0.3), rtol=0.02, atol=0)
    buried = 0.3 - points[inner, 1]
    torch.testing.assert_close(over * DEPTH_UNIT, buried, rtol=0.02, atol=0.004)
    assert torch.stack(slope).abs().max() < 1e-4

    points = heap(dim, height=lambda x: 0.4 - 0.5 * x)
    inner = (points[:, 0] > 0.15) & (points[:, 0] < 0.45)
    if dim == 3:
        inner &= (points[:, 2] > 0.07) & (points[:, 2] < 0.33)
    slope = depths(points, reach=0.1)[inner, 2]
    assert slope.mean().item() == pytest.approx(-0.5, abs=0.02)


def test_depth_features_see_what_has_weight_in_their_own_scene():
    points = heap(2)
    alone = depths(points)
    twice = torch.cat([points, points])
    scene = torch.arange(2).repeat_interleave(len(points))
    torch.testing.assert_close(depths(twice, batch=scene), torch.cat([alone, alone]))
    fixed = depths(twice, moving=scene == 0)
    torch.testing.assert_close(fixed, torch.cat([alone, alone]))
    assert (depths(twice)[:, 1] > 1.9 * alone[:, 1].repeat(2)).all()


@pytest.mark.parametrize("dim", [2, 3])
def test_gradient_of_depth_features(dim):
    shift = torch.rand((12, dim), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points = (shift * 0.1).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: depths(p), points, eps=1e-7, atol=1e-5)


def strains(points, velocity, unit=0.5, radius=0.05):
    return strain_features(points, velocity, *radius_graph(points.detach(), radius), radius, unit)


def in_shear(dim, rate):
    """Points of a block with a linear velocity field, those of its inside, and the gradient."""
    points = heap(dim).double()
    gradient = rate * torch.tensor([[0.3, 1.0, 0.2], [-0.2, -0.3, 0.0], [0.5, 0.1, 0.4]])
    gradient = gradient[:dim, :dim].double()
    inner = (points > 0.05).all(1) & (points < points.amax(0) - 0.05).all(1)
    return points, points @ gradient.T, inner, gradient


@pytest.mark.parametrize("dim", [2, 3])
def test_strain_features_of_a_linear_field(dim):
    points, velocity, inner, gradient = in_shear(dim, 4.0)
    direction, size, slip = strains(points, velocity).split([dim * (dim + 1) // 2, 1, dim], dim=1)
    rate = (gradient + gradient.T) / 2 / 0.5
    square = rate.square().sum()
    wanted = (rate / (square + 1).sqrt())[tuple(torch.triu_indices(dim, dim))]
    assert (direction[inner] - wanted).abs().max() < 0.01
    assert (size[inner] - torch.log1p(square) / 2).abs().max() < 0.05
    assert (slip.norm(dim=1) < 1).all()
    # A translation of all strains nothing.
    other = strains(points, velocity + 3.0)[:, : dim * (dim + 1) // 2]
    torch.testing.assert_close(other, direction)


@pytest.mark.parametrize("dim", [2, 3])
def test_friction_is_told_the_direction_however_slow_the_shear(dim):
    slow, fast = (strains(*in_shear(dim, rate)[:2]) for rate in (5.0, 50.0))
    inner, columns = in_shear(dim, 1.0)[2], dim * (dim + 1) // 2
    assert (slow - fast)[inner, :columns].abs().max() < 0.02
    assert ((fast - slow)[inner, columns] - np.log(10)).abs().max() < 0.05
    still = strains(heap(dim).double(), torch.zeros_like(heap(dim)).double())
    assert (still == 0).all()


@pytest.mark.parametrize("dim", [2, 3])
def test_gradient_of_strain_features(dim):
    """Also of a grain with one neighbour and of one with none."""
    numbers = torch.rand((2, 8, dim), generator=torch.Generator().manual_seed(0)).double()
    points = torch.cat([numbers[0] * 0.04, torch.tensor([[0.2] * dim, [0.22] * dim, [0.6] * dim])])
    velocity = torch.cat([numbers[1], torch.tensor([[0.5] * dim] * 3)]) - 0.4
    inputs = points.requires_grad_(), velocity.requires_grad_()
    assert torch.autograd.gradcheck(strains, inputs, eps=1e-7, atol=1e-4)


def test_strain_features_of_what_is_not_finite_are_no_exception():
    points = heap(2).double()
    velocity = torch.zeros_like(points)
    velocity[3] = torch.nan
    seen = strains(points, velocity)
    assert seen[3].isnan().any()
    assert seen[-1].isfinite().all()
    everywhere = torch.full_like(points[:4], torch.nan)
    edges = torch.tensor([0, 1, 2, 3]), torch.tensor([1, 0, 3, 2])
    assert strain_features(everywhere, everywhere, *edges, 0.05, 0.5).isnan().all()

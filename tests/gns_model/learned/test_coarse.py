from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gns_model.learned.coarse import FAINT, Grid
from gns_model.learned.world import World

SPACING, SIZE = 0.05, 0.2


def grid_of(points: torch.Tensor, *, lower: float = 0.0, batch=None) -> Grid:
    batch = torch.zeros(len(points), dtype=torch.int64) if batch is None else batch
    return Grid.of(points, torch.full_like(points, lower), batch, size=SIZE, spacing=SPACING)


def cloud(dim: int, seed: int, count: int = 40) -> torch.Tensor:
    return torch.tensor(np.random.default_rng(seed).uniform(0.0, 1.0, (count, dim)))


@given(st.sampled_from([2, 3]), st.integers(0, 2**32 - 1))
def test_weights_share_out_every_point_and_keep_its_place(dim, seed):
    points = cloud(dim, seed)
    grid = grid_of(points)
    assert (grid.weights >= 0).all()
    torch.testing.assert_close(grid.weights.sum(1), torch.ones(len(points)).double())
    share = (SPACING / SIZE) ** dim
    torch.testing.assert_close(grid.filling.sum(), torch.tensor(share * len(points)).double())
    senders, receivers = grid.senders, grid.receivers
    assert sorted(zip(senders.tolist(), receivers.tolist(), strict=True)) == sorted(
        zip(receivers.tolist(), senders.tolist(), strict=True)
    )
    assert (grid.offsets.abs().amax(1) == 1).all()


@pytest.mark.parametrize("dim", [2, 3])
def test_a_full_node_has_filling_one_and_the_mean_of_its_points(dim):
    along = SPACING * (torch.arange(24, dtype=torch.float64) + 0.5)
    points = torch.cartesian_prod(*[along] * dim)
    grid = grid_of(points)
    full = (grid.filling - 1).abs().squeeze(1) < 0.02
    assert full.sum() >= 3**dim
    means = grid.down(points)[full] * (1 + FAINT)
    # Nodes lie a cell apart, and the sender of a pair where its offset says.
    inner = full[grid.senders] & full[grid.receivers]
    place = torch.zeros(len(full), dim).double()
    place[full] = means
    apart = place[grid.receivers[inner]] - place[grid.senders[inner]]
    torch.testing.assert_close(apart, SIZE * grid.offsets[inner], atol=0.03 * SIZE, rtol=0)


@given(st.integers(0, 2**32 - 1))
def test_scenes_have_nodes_of_their_own(seed):
    points = cloud(3, seed)
    alone = grid_of(points)
    both = grid_of(points.repeat(2, 1), batch=torch.arange(2).repeat_interleave(len(points)))
    count = len(alone.filling)
    assert len(both.filling) == 2 * count
    assert len(both.senders) == 2 * len(alone.senders)
    assert ((both.senders < count) == (both.receivers < count)).all()
    values = torch.randn(len(points), 4).double()
    torch.testing.assert_close(
        both.up(both.down(values.repeat(2, 1))), alone.up(alone.down(values)).repeat(2, 1)
    )


def test_points_that_are_not_finite_do_not_stop_it():
    points = cloud(3, 0)
    points[3, 1], points[5, 0] = torch.nan, torch.inf
    assert len(grid_of(points).filling) > 0


def slab(model, reach: float):
    """A bar of points along x, four thick, at rest, ordered along it."""
    spacing, dim = model.config.spacing, model.config.dim
    along, across = (spacing * (torch.arange(n) + 0.5) for n in (round(reach / spacing), 4))
    points = torch.cartesian_prod(along, *[across] * (dim - 1))
    return points[:, None].repeat(1, model.config.history + 1, 1)


@pytest.mark.parametrize(("coarse", "heard"), [(0, False), (3, True)])
def test_what_happens_far_away_is_heard_by_the_coarse_level_alone(
    make_model, make_scene, coarse, heard
):
    model = make_model(coarse_blocks=coarse, coarse_cells=2, dtype=torch.float64)
    history = slab(model, 0.6).double()
    scene = make_scene(baffle=[])
    world = World.from_scenes([scene], [len(history)], dtype=torch.float64)
    struck = history.clone()
    struck[-16:, :-1, 0] += 0.01  # the end comes at 1 m/s
    with torch.no_grad():
        change = model.acceleration(struck, world) - model.acceleration(history, world)
    reach = model.config.blocks * model.config.radius
    far = history[:, -1, 0] < history[-1, -1, 0] - reach - 0.1
    assert far.any()
    assert bool(change[far].abs().max() > 1e-6) == heard


def test_nodes_that_come_and_go_make_no_jump(make_model, make_scene):
    """Over a line of places on which points enter and leave the reach of nodes."""
    model = make_model(coarse_blocks=2, coarse_cells=2, dtype=torch.float64)
    scene = make_scene(baffle=[])
    history = slab(model, 0.3).double()
    world = World.from_scenes([scene], [len(history)], dtype=torch.float64)
    size = model.config.coarse_cells * model.config.spacing

    def at(shift):
        with torch.no_grad():
            return model.acceleration(history + torch.tensor([shift, 0.0, 0.0]), world)

    for edge in (0.25, 0.5, 0.75, 1.0):  # of a cell, where the points stand in its parts
        begin = edge * size - 0.0125
        a, b, c = (at(begin + k * 1e-7) for k in (-1, 0, 1))
        assert float((a - b).abs().max()) < 1e-4
        # Nor does the slope jump: second differences are of second order.
        assert float((a - 2 * b + c).abs().max()) < 1e-8


@pytest.mark.parametrize("dim", [2, 3])
def test_derivatives_are_those_of_differences(make_model, make_scene, dim):
    model = make_model(dim=dim, coarse_blocks=2, coarse_cells=2, dtype=torch.float64)
    history = slab(model, 0.4).double() + 1e-3
    world = World.from_scenes([make_scene(dim, baffle=[])], [len(history)], dtype=torch.float64)
    way = torch.randn(len(history), dim, generator=torch.Generator().manual_seed(1)).double()

    def value(shift):
        moved = history + shift * way[:, None]
        return model.acceleration(moved, world).square().sum()

    shift = torch.zeros((), dtype=torch.float64, requires_grad=True)
    [found] = torch.autograd.grad(value(shift), shift)
    h = 1e-6
    expected = (value(torch.tensor(h)) - value(torch.tensor(-h))) / (2 * h)
    assert float(found) == pytest.approx(float(expected.detach()), rel=1e-4)

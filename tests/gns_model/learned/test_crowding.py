from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gns_model.learned import ModelConfig
from gns_model.learned.crowding import SHARE, density, spread
from gns_model.learned.world import World
from gns_model.particles import MOVING, STATIONARY

SPACING = 0.02
SIZE = {2: 1.0, 3: 0.4}


def world_of(points: int, dim: int, *, batch=None, kinds=None, shift: float = 0.0) -> World:
    """An empty box of `SIZE`, once for each scene."""
    batch = torch.zeros(points, dtype=torch.int64) if batch is None else batch
    scenes = int(batch.max()) + 1
    lower = torch.full((scenes, dim), shift, dtype=torch.float64)
    return World(
        batch=batch,
        lower=lower,
        upper=lower + SIZE[dim],
        gravity=torch.zeros(scenes, dim, dtype=torch.float64),
        boxes=torch.zeros(0, 2, dim, dtype=torch.float64),
        box_batch=torch.zeros(0, dtype=torch.int64),
        material=torch.zeros(scenes, 2, dtype=torch.float64),
        particle_type=torch.full((points,), MOVING) if kinds is None else kinds,
    )


def lattice(dim: int, *, at: float | None = None, side: int = 9, squeezed: float = 1.0):
    """side^D points; in the middle of the box, or with their cells `at` each lower wall."""
    along = SPACING * squeezed * (torch.arange(side, dtype=torch.float64) + 0.5)
    begin = (SIZE[dim] - SPACING * squeezed * side) / 2 if at is None else at
    return begin + torch.cartesian_prod(*[along] * dim)


def heap(dim: int, seed: int, *, squeezed: float = 0.85) -> torch.Tensor:
    """A shaken lattice that is too dense."""
    rng = np.random.default_rng(seed)
    regular = lattice(dim, side=7, squeezed=squeezed)
    return regular + torch.tensor(rng.uniform(-0.3, 0.3, regular.shape) * SPACING)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_lattice_has_density_one_inside_and_on_its_walls(dim):
    points = lattice(dim, at=0.0)
    found = density(points, world_of(len(points), dim), SPACING)
    cells = (points / SPACING).floor()
    inside = (cells < 6).all(1)  # away from the free faces
    at_walls = (cells < 2).sum(1)
    assert found[inside & (at_walls == 0)].numpy() == pytest.approx(1.0)
    assert found[inside & (at_walls == 1)].numpy() == pytest.approx(1.0)
    # In corners the images of images are left out.
    assert (found[inside & (at_walls > 1)] < 1.0 + 1e-9).all()
    assert found.max() < 1.0 + 1e-9


@pytest.mark.parametrize("dim", [2, 3])
def test_what_is_not_crowded_stays_exactly_where_it_is(dim):
    points = lattice(dim, at=0.0)
    assert torch.equal(spread(points, world_of(len(points), dim), SPACING, 1.05), points)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("squeezed", [0.8, 0.9])
def test_what_is_crowded_expands_until_it_is_not(dim, squeezed):
    points = lattice(dim, squeezed=squeezed)
    world, limit = world_of(len(points), dim), 1.1
    excess = []
    for _ in range(60):
        found = density(points, world, SPACING)
        excess.append(float((found - limit).clamp_min(0).sum()))
        points = spread(points, world, SPACING, limit)
    assert excess[0] > 1.0
    assert (np.diff(excess) < 0).all()
    assert excess[-1] < 0.05 * excess[0]
    middle = density(points, world, SPACING)[len(points) // 2]
    assert 1.0 < float(middle) < limit + 0.02  # nor farther apart than on its lattice


@given(st.sampled_from([2, 3]), st.integers(0, 2**32 - 1), st.floats(1.05, 1.6))
def test_the_centroid_stays(dim, seed, limit):
    points = heap(dim, seed)
    moved = spread(points, world_of(len(points), dim), SPACING, limit)
    assert torch.allclose(moved.mean(0), points.mean(0), atol=1e-12)
    assert float((moved - points).abs().max()) < SPACING


@given(st.sampled_from([2, 3]), st.integers(0, 2**32 - 1))
def test_neither_order_nor_place_nor_a_mirror_matters(dim, seed):
    points = heap(dim, seed)
    world = world_of(len(points), dim)
    moved = spread(points, world, SPACING, 1.2)
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(seed % 1000))
    assert torch.allclose(spread(points[order], world, SPACING, 1.2), moved[order], atol=1e-12)
    elsewhere = world_of(len(points), dim, shift=0.7)
    assert torch.allclose(spread(points + 0.7, elsewhere, SPACING, 1.2), moved + 0.7, atol=1e-11)
    assert torch.allclose(
        spread(SIZE[dim] - points, world, SPACING, 1.2), SIZE[dim] - moved, atol=1e-11
    )


def test_scenes_do_not_see_each_other_and_kinematic_points_stay():
    points = heap(3, 0)
    alone = spread(points, world_of(len(points), 3), SPACING, 1.2)
    batch = torch.arange(2).repeat_interleave(len(points))
    both = spread(points.repeat(2, 1), world_of(len(batch), 3, batch=batch), SPACING, 1.2)
    assert torch.allclose(both, alone.repeat(2, 1), atol=1e-12)
    kinds = torch.where(torch.arange(len(points)) % 3 == 0, STATIONARY, MOVING)
    held = spread(points, world_of(len(points), 3, kinds=kinds), SPACING, 1.2)
    assert torch.equal(held[kinds == STATIONARY], points[kinds == STATIONARY])
    assert not torch.allclose(held[kinds == MOVING], points[kinds == MOVING])


@pytest.mark.parametrize("dim", [2, 3])
def test_derivatives_are_those_of_differences(dim):
    points = heap(dim, 3) - lattice(dim).min() + 0.3 * SPACING  # near walls, too
    world, rng = world_of(len(points), dim), np.random.default_rng(0)
    direction = torch.tensor(rng.normal(size=points.shape))

    def value(positions):
        return (spread(positions, world, SPACING, 1.2) * direction).sum()

    leaf = points.clone().requires_grad_()
    [found] = torch.autograd.grad(value(leaf), leaf)
    for _ in range(5):
        way = torch.tensor(rng.normal(size=points.shape))
        h = 1e-6 * SPACING
        expected = (value(points + h * way) - value(points - h * way)) / (2 * h)
        assert float((found * way).sum()) == pytest.approx(float(expected), rel=1e-4)


def test_a_step_of_a_model_keeps_grains_apart(make_model, make_scene):
    """Grains that the network drives into the base, from a heap that is twice too dense."""
    scene = make_scene(baffle=[])
    free, limited = (make_model(crowding_limit=limit) for limit in (0.0, 1.2))
    spacing = free.config.spacing
    cells = itertools.product(range(5), repeat=3)
    points = torch.tensor([[0.2 + 0.8 * spacing * (k + 0.5) for k in cell] for cell in cells])
    history = points[:, None].repeat(1, free.config.history + 1, 1)
    world = World.from_scenes([scene], [len(points)])
    with torch.no_grad():
        before, after = (
            float(density(model.step(history, world), world, spacing).max())
            for model in (free, limited)
        )
    assert before > 1.3
    assert after < before - SHARE / 2 * (before - 1.2)


@pytest.mark.parametrize("limit", [0.5, 1.0, -1.0])
def test_a_limit_that_a_release_exceeds_is_refused(limit):
    with pytest.raises(ValueError, match="crowding_limit"):
        ModelConfig(crowding_limit=limit)

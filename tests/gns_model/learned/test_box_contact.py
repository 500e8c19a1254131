from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gns_model.learned.contact import project
from gns_model.learned.world import FLUSH, World
from gns_model.particles import MOVING

LOWER, UPPER = np.zeros(3), np.array([1.0, 0.5, 1.0])


def world_of(boxes: np.ndarray | torch.Tensor, points: int, dim: int = 3) -> World:
    boxes = torch.as_tensor(boxes, dtype=torch.float64).reshape(-1, 2, dim)
    return World(
        batch=torch.zeros(points, dtype=torch.int64),
        lower=torch.tensor(LOWER[:dim])[None],
        upper=torch.tensor(UPPER[:dim])[None],
        gravity=torch.zeros(1, dim, dtype=torch.float64),
        boxes=boxes,
        box_batch=torch.zeros(len(boxes), dtype=torch.int64),
        material=torch.zeros(1, 2, dtype=torch.float64),
        particle_type=torch.full((points,), MOVING),
    )


@st.composite
def arrangements(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes on the base in the cells of a 3 x 3 plan, some touching walls or each other."""
    edge = st.sampled_from([0.0, 0.0, 1e-4, 0.01, 0.05])
    boxes = []
    for i in range(3):
        for k in range(3):
            if draw(st.booleans()):
                x0, x1 = i / 3 + draw(edge), (i + 1) / 3 - draw(edge)
                z0, z1 = k / 3 + draw(edge), (k + 1) / 3 - draw(edge)
                x1, z1 = (1.0 if i == 2 and x1 > 0.9999 else x1), z1
                boxes.append([[x0, 0, z0], [x1, draw(st.sampled_from([0.1, 0.3, 0.45])), z1]])
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    before = rng.uniform(LOWER, UPPER, (60, 3))
    reach = draw(st.sampled_from([0.03, 0.2, 1.0]))
    after = before + rng.normal(0, reach, (60, 3))
    # Some go straight along an axis, some rest on the base.
    after[:10, [1, 2]] = before[:10, [1, 2]]
    after[10:20, 1] = before[10:20, 1] = 0.0
    return np.array(boxes).reshape(-1, 2, 3), before, after


@given(arrangements())
def test_nothing_ends_inside_a_box_or_outside_the_domain(arrangement):
    boxes, before, after = arrangement
    moved = project(*map(torch.tensor, (before, after)), world_of(boxes, len(before))).numpy()
    assert (moved >= LOWER).all()
    assert (moved <= UPPER).all()
    # Grains on the base or at a wall under a flush face are as much inside as any.
    low = np.where(boxes[:, 0] <= LOWER + FLUSH, -np.inf, boxes[:, 0])
    high = np.where(boxes[:, 1] >= UPPER - FLUSH, np.inf, boxes[:, 1])
    assert not ((moved[:, None] > low) & (moved[:, None] < high)).all(-1).any()
    # Points that met nothing come back bit for bit.
    swept_low, swept_high = np.minimum(before, after), np.maximum(before, after)
    met = ((swept_high[:, None] > low) & (swept_low[:, None] < high)).all(-1).any(-1)
    free = ~met & (after >= LOWER).all(-1) & (after <= UPPER).all(-1)
    assert (moved[free] == after[free]).all()


BOX = [[0.4, 0.0, 0.4], [0.6, 0.3, 0.6]]


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        ((0.35, 0.1, 0.5), (0.45, 0.1, 0.5), (0.40, 0.1, 0.5)),  # through the front
        ((0.35, 0.1, 0.5), (0.55, 0.1, 0.5), (0.40, 0.1, 0.5)),  # deep: not out at the back
        ((0.50, 0.35, 0.5), (0.52, 0.05, 0.5), (0.52, 0.3, 0.5)),  # from above
        ((0.50, 0.1, 0.39), (0.45, 0.1, 0.41), (0.45, 0.1, 0.40)),  # from the side
        ((0.30, 0.1, 0.5), (0.75, 0.1, 0.5), (0.40, 0.1, 0.5)),  # right across
        ((0.39, 0.1, 0.59), (0.41, 0.1, 0.61), (0.41, 0.1, 0.61)),  # round the corner
        ((0.40, 0.1, 0.5), (0.40, 0.2, 0.55), (0.40, 0.2, 0.55)),  # along the face
        ((0.40, 0.1, 0.5), (0.42, 0.1, 0.5), (0.40, 0.1, 0.5)),  # from the face inwards
        ((0.50, 0.01, 0.5), (0.58, 0.01, 0.5), (0.60, 0.01, 0.5)),  # was inside: nearest face ...
        ((0.50, 0.01, 0.5), (0.50, 0.01, 0.5), (0.40, 0.01, 0.5)),  # ... and never the base
        ((0.5, 0.4, 0.9), (0.5, -0.1, 1.2), (0.5, 0.0, 1.0)),  # into the domain
    ],
)
def test_leaves_by_the_face_that_it_crossed(before, after, expected):
    moved = project(
        torch.tensor([before]).double(), torch.tensor([after]).double(), world_of([BOX], 1)
    )
    torch.testing.assert_close(moved, torch.tensor([expected]).double(), atol=1e-7, rtol=0)


def test_a_face_flush_with_a_wall_is_no_way_out():
    box = [[0.4, 0.0, 0.9], [0.6, 0.5, 1.0 - FLUSH / 2]]  # to the side wall and to the ceiling
    inside = torch.tensor([[0.5, 0.49, 0.99], [0.45, 0.49, 0.99]]).double()
    moved = project(inside, inside, world_of([box], 2))
    torch.testing.assert_close(
        moved, torch.tensor([[0.5, 0.49, 0.9], [0.4, 0.49, 0.99]]).double(), atol=1e-7, rtol=0
    )


def test_two_dimensions():
    moved = project(
        torch.tensor([[0.35, 0.1], [0.5, 0.4]]).double(),
        torch.tensor([[0.45, 0.1], [0.5, 0.2]]).double(),
        world_of([[[0.4, 0.0], [0.6, 0.3]]], 2, dim=2),
    )
    torch.testing.assert_close(moved, torch.tensor([[0.4, 0.1], [0.5, 0.3]]).double())


def test_gradient_follows_the_face_and_stops_at_it():
    boxes = torch.tensor([BOX], dtype=torch.float64, requires_grad=True)
    after = torch.tensor([[0.45, 0.1, 0.5]], dtype=torch.float64, requires_grad=True)
    before = torch.tensor([[0.35, 0.1, 0.5]], dtype=torch.float64)
    project(before, after, world_of(boxes, 1)).sum().backward()
    assert boxes.grad is not None
    assert boxes.grad[0].tolist() == [[1, 0, 0], [0, 0, 0]]
    assert after.grad.tolist() == [[0, 1, 1]]

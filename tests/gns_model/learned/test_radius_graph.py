from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gns_model.learned.graph import radius_graph, torch_radius_graph

RADIUS = 0.3


def brute_force(
    points: torch.Tensor,
    radius: float,
    batch: torch.Tensor | None = None,
    *,
    self_edges: bool = False,
) -> list[tuple[int, int]]:
    """Every pair, compared as the docstring says; (receiver, sender), sorted."""
    array = points.numpy()
    squared = np.zeros((len(array),) * 2, array.dtype)
    for axis in range(array.shape[1]):
        squared += (array[:, None, axis] - array[None, :, axis]) ** 2
    close = squared < array.dtype.type(radius * radius)
    np.fill_diagonal(close, self_edges)
    if batch is not None:
        close &= batch.numpy()[:, None] == batch.numpy()[None, :]
    return [(int(i), int(j)) for i, j in zip(*np.nonzero(close), strict=True)]


@st.composite
def clouds(draw: st.DrawFn) -> tuple[torch.Tensor, torch.Tensor]:
    """Points on and off a lattice of step RADIUS, so that ties at the radius are common."""
    dim = draw(st.sampled_from([2, 3]))
    dtype = draw(st.sampled_from([np.float32, np.float64]))
    n = draw(st.integers(1, 60))
    lattice = draw(hnp.arrays(np.int64, (n, dim), elements=st.integers(-3, 3)))
    jitter = draw(hnp.arrays(np.float64, (n, dim), elements=st.floats(-0.3, 0.3)))
    offset = draw(st.sampled_from([0.0, 1e3]))
    loose = draw(st.booleans())
    points = (offset + RADIUS * lattice + loose * jitter).astype(dtype)
    batch = draw(hnp.arrays(np.int64, n, elements=st.integers(0, 3)))
    return torch.from_numpy(points), torch.from_numpy(batch)


@given(clouds(), st.booleans(), st.sampled_from([radius_graph, torch_radius_graph]), st.booleans())
def test_equals_brute_force(cloud, batched, graph, self_edges):
    points, batch = cloud
    batch = batch if batched else None
    senders, receivers = graph(points, RADIUS, batch, self_edges=self_edges)
    assert senders.dtype == receivers.dtype == torch.int64
    found = list(zip(receivers.tolist(), senders.tolist(), strict=True))
    expected = brute_force(points, RADIUS, batch, self_edges=self_edges)
    assert found == expected  # the order too


def test_many_neighbours_are_not_capped():
    points = torch.rand(400, 3, generator=torch.Generator().manual_seed(1)) * 0.1
    for graph in (radius_graph, torch_radius_graph):
        assert len(graph(points, 1.0)[0]) == 400 * 399


@pytest.mark.parametrize("graph", [radius_graph, torch_radius_graph])
def test_far_flung_and_non_finite_points(graph):
    near = torch.rand(50, 3, generator=torch.Generator().manual_seed(2))
    odd = torch.tensor([[1e30, 0, 0], [torch.nan, 0, 0], [0, torch.inf, 0], [-1e7, 1e7, 3.0]])
    senders, receivers = graph(torch.cat([near, odd]), RADIUS)
    assert list(zip(receivers.tolist(), senders.tolist(), strict=True)) == brute_force(near, RADIUS)


def test_empty_and_single():
    for n in (0, 1):
        senders, receivers = radius_graph(torch.zeros(n, 3), RADIUS)
        assert senders.shape == receivers.shape == (0,)


@pytest.mark.parametrize(
    ("points", "radius", "batch"),
    [
        (torch.zeros(3, 4), 0.1, None),
        (torch.zeros(3), 0.1, None),
        (torch.zeros(3, 3, dtype=torch.int64), 0.1, None),
        (torch.zeros(3, 3), 0.0, None),
        (torch.zeros(3, 3), float("nan"), None),
        (torch.zeros(3, 3), 0.1, torch.zeros(2, dtype=torch.int64)),
        (torch.zeros(3, 3), 0.1, torch.tensor([0, -1, 0])),
    ],
)
def test_refuses_nonsense(points, radius, batch):
    with pytest.raises(ValueError, match="must"):
        radius_graph(points, radius, batch)

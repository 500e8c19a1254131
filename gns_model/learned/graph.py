"""The radius graph: which points talk to which. Exact, without a cap on neighbours."""

from __future__ import annotations

import functools
from itertools import product

import numpy as np
import torch
from torch import Tensor

#: Cells are this much wider than the radius, so that rounding never loses a pair.
_CELL_SLACK = 1.0 + 1e-4


@torch.no_grad()
def radius_graph(
    positions: Tensor, radius: float, batch: Tensor | None = None, *, self_edges: bool = False
) -> tuple[Tensor, Tensor]:
    """All ordered pairs of different points of one batch entry that are closer than `radius`.

    The comparison is strict and is made on squared distances, added axis by axis, in the dtype of
    the positions. Points with a coordinate that is not finite have no neighbours.

    Args:
        positions: [m], shape (N, D), float32 or float64, D = 2 or 3.
        radius: [m].
        batch: shape (N,), index of the scene of every point; default: all of one.
        self_edges: add every (finite) point as a neighbour of itself.

    Returns:
        senders and receivers, int64, shape (E,), sorted by receiver and then by sender. Every edge
        comes with its reverse.

    Raises:
        ValueError: if shapes or dtypes are other than these.
    """
    if positions.ndim != 2 or positions.shape[1] not in (2, 3):
        raise ValueError(f"positions must have shape (N, 2) or (N, 3), got {positions.shape}")
    if positions.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"positions must be float32 or float64, got {positions.dtype}")
    if not radius > 0:
        raise ValueError(f"radius must be positive, got {radius}")
    if batch is not None and batch.shape != positions.shape[:1]:
        raise ValueError(f"batch must have shape {positions.shape[:1]}, got {batch.shape}")
    if len(positions) == 0:
        empty = torch.zeros(0, dtype=torch.int64, device=positions.device)
        return empty, empty
    if positions.device.type == "cpu" and _compiled() is not None:
        return _numba_graph(positions, radius, batch, self_edges)
    return torch_radius_graph(positions, radius, batch, self_edges=self_edges)


@functools.cache
def _compiled():  # type: ignore[no-untyped-def]
    """The compiled kernel, or None where numba is not installed."""
    try:
        from gns_model.learned.cell_list import neighbours
    except ImportError:
        return None
    return neighbours


def _numba_graph(
    positions: Tensor, radius: float, batch: Tensor | None, self_edges: bool
) -> tuple[Tensor, Tensor]:
    points = np.ascontiguousarray(positions.detach().numpy())
    if batch is None:
        index, n_batches = np.zeros(len(points), np.int64), 1
    else:
        index = np.ascontiguousarray(batch.numpy().astype(np.int64, copy=False))
        if index.min() < 0:
            raise ValueError("batch must not be negative")
        n_batches = int(index.max()) + 1
    squared = points.dtype.type(radius * radius)
    capacity = 32 * len(points)
    while True:
        senders, receivers, edges = _compiled()(
            points, index, n_batches, squared, radius * _CELL_SLACK, capacity, self_edges
        )
        if edges <= capacity:
            break
        capacity = edges
    return torch.from_numpy(senders[:edges]), torch.from_numpy(receivers[:edges])


@torch.no_grad()
def torch_radius_graph(
    positions: Tensor, radius: float, batch: Tensor | None = None, *, self_edges: bool = False
) -> tuple[Tensor, Tensor]:
    """`radius_graph` in torch operations: for CUDA, and for machines without numba."""
    device, n = positions.device, len(positions)
    finite = torch.isfinite(positions).all(dim=1)
    index = torch.zeros(n, dtype=torch.int64, device=device) if batch is None else batch.long()
    points = torch.where(finite[:, None], positions, torch.zeros_like(positions)).double()
    low, high = points.amin(dim=0), points.amax(dim=0)
    # Far-flung points get wider cells, so that cell numbers fit 64 bits: slower, never wrong.
    width = torch.clamp((high - low) / 1e5, min=radius * _CELL_SLACK)
    cell = ((points - low) / width).long() + 1
    shape = cell.amax(dim=0) + 2  # a rim of empty cells, so that neighbours never wrap around
    stride = torch.ones_like(shape)
    for axis in range(len(shape) - 2, -1, -1):
        stride[axis] = stride[axis + 1] * shape[axis + 1]
    # Points that are not finite go to a batch entry of their own, cell by cell unreachable.
    key = torch.where(finite, index * shape.prod() + (cell * stride).sum(dim=1), -(10**18))
    sorted_key, order = key.sort(stable=True)

    squared = torch.tensor(radius * radius, dtype=positions.dtype, device=device)
    found: list[Tensor] = []
    receiver = torch.nonzero(finite).squeeze(1)
    for shift in product((-1, 0, 1), repeat=len(shape) - 1):
        centre = key[receiver] + sum(s * stride[a] for a, s in enumerate(shift))
        first = torch.searchsorted(sorted_key, centre - 1)
        last = torch.searchsorted(sorted_key, centre + 1, right=True)
        count = last - first
        i = torch.repeat_interleave(receiver, count)
        begin = torch.repeat_interleave(first - (count.cumsum(0) - count), count)
        j = order[begin + torch.arange(len(i), device=device)]
        distance = torch.zeros(len(i), dtype=positions.dtype, device=device)
        for axis in range(positions.shape[1]):
            distance = distance + (positions[i, axis] - positions[j, axis]) ** 2
        found.append((i * n + j)[(distance < squared) & ((i != j) | self_edges)])
    pairs = torch.cat(found).sort().values
    return pairs % n, pairs // n

"""The compiled cell list behind `radius_graph`; imported on first use, since numba is slow to load.

Cells are at least one radius wide, so the neighbours of a point lie in the 3^D cells around its
own. Points are sorted by cell and the last axis runs fastest, so three cells in a row are one
stretch of memory: 9 stretches to scan in 3D, 3 in 2D.
"""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def _bounds(positions, batch, n_batches):  # type: ignore[no-untyped-def]
    """Lowest and highest finite coordinate and number of finite points of every batch."""
    n, dim = positions.shape
    low = np.full((n_batches, 3), np.inf)
    high = np.full((n_batches, 3), -np.inf)
    count = np.zeros(n_batches, np.int64)
    finite = np.ones(n, np.bool_)
    for i in range(n):
        for k in range(dim):
            if not np.isfinite(positions[i, k]):
                finite[i] = False
        if finite[i]:
            b = batch[i]
            count[b] += 1
            for k in range(dim):
                x = np.float64(positions[i, k])
                low[b, 3 - dim + k] = min(low[b, 3 - dim + k], x)
                high[b, 3 - dim + k] = max(high[b, 3 - dim + k], x)
    for b in range(n_batches):
        for k in range(3):
            if count[b] == 0 or k < 3 - dim:
                low[b, k] = 0.0
                high[b, k] = 0.0
    return low, high, count, finite


@numba.njit(cache=True, nogil=True)
def _grid(low, high, count, width):  # type: ignore[no-untyped-def]
    """Cells of every batch. Few points spread far get wider cells: slower, never wrong."""
    n_batches = low.shape[0]
    shape = np.ones((n_batches, 3), np.int64)
    size = np.full((n_batches, 3), width)
    first = np.zeros(n_batches + 1, np.int64)
    for b in range(n_batches):
        for k in range(3):
            size[b, k] = max(width, (high[b, k] - low[b, k]) / 1e5)
        while True:
            for k in range(3):
                shape[b, k] = np.int64((high[b, k] - low[b, k]) / size[b, k]) + 1
            if shape[b, 0] * shape[b, 1] * shape[b, 2] <= 16 * count[b] + 4096:
                break
            for k in range(3):
                size[b, k] *= 1.5
        first[b + 1] = first[b] + shape[b, 0] * shape[b, 1] * shape[b, 2]
    return shape, size, first


@numba.njit(cache=True, nogil=True)
def neighbours(  # type: ignore[no-untyped-def]
    positions, batch, n_batches, radius_squared, width, capacity, self_edges
):
    """Edges sorted by receiver, then sender.

    Args:
        positions: [m], shape (N, D), float32 or float64.
        batch: int64, shape (N,).
        n_batches: one more than the largest entry of `batch`.
        radius_squared: scalar of the positions' dtype [m²]; a pair closer than it is an edge.
        width: of a cell, a little more than the radius [m].
        capacity: room for edges in the answer.
        self_edges: whether a point is its own neighbour.

    Returns:
        senders, receivers (both of length `capacity`) and the true number of edges; where that
        exceeds `capacity` the answer is incomplete and the call is to be repeated with more room.
    """
    n, dim = positions.shape
    pad = 3 - dim
    low, high, count, finite = _bounds(positions, batch, n_batches)
    shape, size, first = _grid(low, high, count, width)

    cell = np.zeros((n, 3), np.int64)
    key = np.empty(n, np.int64)
    start = np.zeros(first[n_batches] + 2, np.int64)
    for i in range(n):
        if not finite[i]:
            continue
        b = batch[i]
        for k in range(dim):
            c = pad + k
            cell[i, c] = np.int64((np.float64(positions[i, k]) - low[b, c]) / size[b, c])
        key[i] = first[b] + (cell[i, 0] * shape[b, 1] + cell[i, 1]) * shape[b, 2] + cell[i, 2]
        start[key[i] + 2] += 1
    for c in range(2, start.shape[0]):
        start[c] += start[c - 1]
    order = np.empty(n, np.int64)
    placed = np.zeros((n, 3), positions.dtype)
    for i in range(n):
        if finite[i]:
            slot = start[key[i] + 1]
            start[key[i] + 1] += 1
            order[slot] = i
            for k in range(dim):
                placed[slot, pad + k] = positions[i, k]

    senders = np.empty(capacity, np.int64)
    receivers = np.empty(capacity, np.int64)
    here = np.zeros(3, positions.dtype)
    edges = 0
    for i in range(n):
        if not finite[i]:
            continue
        b = batch[i]
        for k in range(dim):
            here[pad + k] = positions[i, k]
        begin = edges
        z0, z1 = max(cell[i, 2] - 1, 0), min(cell[i, 2] + 1, shape[b, 2] - 1)
        for cx in range(max(cell[i, 0] - 1, 0), min(cell[i, 0] + 2, shape[b, 0])):
            for cy in range(max(cell[i, 1] - 1, 0), min(cell[i, 1] + 2, shape[b, 1])):
                row = first[b] + (cx * shape[b, 1] + cy) * shape[b, 2]
                for slot in range(start[row + z0], start[row + z1 + 1]):
                    dx = here[0] - placed[slot, 0]
                    dy = here[1] - placed[slot, 1]
                    dz = here[2] - placed[slot, 2]
                    other = order[slot] != i or self_edges
                    if dx * dx + dy * dy + dz * dz < radius_squared and other:
                        if edges < capacity:
                            # Insertion keeps the senders of one receiver ascending.
                            j = edges
                            sender = order[slot]
                            while j > begin and senders[j - 1] > sender:
                                senders[j] = senders[j - 1]
                                j -= 1
                            senders[j] = sender
                            receivers[edges] = i
                        edges += 1
    return senders, receivers, edges

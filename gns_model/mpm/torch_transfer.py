"""A substep of `transfer.py` for all points of a batch at once, in torch: the same scheme.

A point's contribution to a node is its weight times a linear function of the node's offset, so
scatter and gather are products with one small matrix a point, `basis`: weight times (1, offset).

On a CPU the sums over points run in one order. On CUDA `index_add_` sums by atomic additions in
any order, so that two runs differ by round-off, unless `torch.use_deterministic_algorithms(True)`
(with CUBLAS_WORKSPACE_CONFIG=:4096:8 in the environment) makes it sort first.

Nothing here waits for the device or depends on values, so a substep can be captured in a graph.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gns_model.mpm.torch_batch import Batch, State
from gns_model.mpm.torch_material import TINY, advance_stress


def advance(state: State, batch: Batch) -> None:
    """Advance all points by a substep of their scene, in place."""
    node, basis = support(state.position, batch)
    grid = points_to_grid(state, node, basis, batch)
    grid_to_points(state, node, basis, update_grid(grid, batch), batch)


def support(position: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
    """Nodes around every point, shape (P * K,), and its basis, shape (P, K, 1 + D)."""
    count, dim = position.shape
    x = torch.addcmul(batch.start, position, batch.inverse)
    first = torch.clamp((x - 0.5).long(), batch.zero, batch.last)
    f = x - first
    centre, scale, height = batch.spline
    w = torch.addcmul(height, (f[:, None, :] - centre).square_(), scale)
    basis = batch.basis
    weight = basis[:, :, 0].view(count, *(3,) * dim)
    if dim == 2:
        torch.mul(w[:, :, None, 0], w[:, None, :, 1], out=weight)
    else:
        across = w[:, :, None, 1] * w[:, None, :, 2]
        torch.mul(w[:, :, None, None, 0], across[:, None], out=weight)
    torch.mul(basis[:, :, :1], batch.offsets - f[:, None, :], out=basis[:, :, 1:])
    node = (first * batch.stride).sum(1, keepdim=True) + batch.support
    return node.view(-1), basis


def points_to_grid(state: State, node: Tensor, basis: Tensor, batch: Batch) -> Tensor:
    """Mass, momentum and impulse of the stress at every node, shape (G, 1 + 2 D)."""
    count, dim = state.position.shape
    c = batch.coefficients
    torch.mul(state.velocity, batch.mass, out=c[:, 0, 1 : 1 + dim])
    torch.mul(state.affine.transpose(1, 2), batch.mass_dx, out=c[:, 1:, 1 : 1 + dim])
    stress = state.stress.index_select(0, batch.matrix_rows).view(dim, dim, count)
    torch.mul(stress.permute(2, 0, 1), batch.impulse, out=c[:, 1:, 1 + dim :])
    shares = torch.bmm(basis, c).view(len(node), -1)
    grid = torch.zeros(len(batch.fall), c.shape[2], dtype=c.dtype, device=c.device)
    return grid.index_add_(0, node, shares)


def update_grid(grid: Tensor, batch: Batch) -> Tensor:
    """Velocities of the nodes after and before the substep [m/s], shape (G, 2 D)."""
    dim = batch.fall.shape[1]
    mass = grid[:, :1].clamp(min=TINY)  # a node that no point reaches has no momentum, either
    new, old = batch.grid[:, :dim], batch.grid[:, dim:]
    torch.div(grid[:, 1 : 1 + dim], mass, out=old)
    torch.addcdiv(old + batch.fall, grid[:, 1 + dim :], mass, out=new)
    for contact in batch.nodes:
        contact.apply(new)
    return batch.grid


def grid_to_points(state: State, node: Tensor, basis: Tensor, grid: Tensor, batch: Batch) -> None:
    """Gather velocities, advance the stress, advect, resolve contact with baffles and domain."""
    count, dim = state.position.shape
    around = grid.index_select(0, node).view(count, -1, 2 * dim)
    moments = torch.bmm(basis.transpose(1, 2), around)
    torch.mul(moments[:, 1:, :dim].transpose(1, 2), batch.slope, out=state.affine)
    batch.gradient[:dim, :dim].copy_(state.affine.permute(1, 2, 0))
    divergence = batch.gradient.diagonal(dim1=0, dim2=1).sum(1)
    strain = torch.addcmul(state.strain, divergence, batch.materials.dt)
    torch.minimum(strain, batch.materials.strain_limit, out=state.strain)
    normal, shear = advance_stress(state.stress, state.strain, batch.gradient, batch.materials)
    state.stress[:3].copy_(normal)
    state.stress[3:].copy_(shear)
    new, old = moments[:, 0, :dim], moments[:, 0, dim:]
    position = torch.addcmul(state.position, new, batch.dt)
    velocity = torch.addcmul(new, state.velocity - old, batch.keep)
    for contact in batch.boxes:
        position, velocity = contact.apply(position, velocity)
    # A point that left the domain is put back and keeps no velocity that leads out again.
    torch.clamp(position, batch.lower, batch.upper, out=state.position)
    inwards = (state.position - position) * velocity
    torch.mul(velocity, inwards >= 0.0, out=state.velocity)
    for turned in batch.turned:
        position, velocity = turned.apply(state.position, state.velocity)
        torch.clamp(position, batch.lower, batch.upper, out=state.position)
        state.velocity.copy_(velocity)

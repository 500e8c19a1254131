"""A coarse level: how grains that no chain of messages joins in one step hear of each other.

Pressure crosses a heap in a step (at 40 m/s, 0.6 m in 0.015 s), and messages of five blocks with
R = 0.025 m go 0.1 m: a cube that strikes a wall is braked at its back by what no grain there sees.
More blocks cost as much as they reach. Here the latents of the vertices go down to the nodes of a
grid a few spacings wide, a few rounds of messages between neighbouring nodes carry them on, and
what arrives is added to the vertices again, as in multigrid solvers and in the material point
method itself, whose weights these are: quadratic B-splines, so that all of it is smooth in the
positions.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

#: A node that holds less than this share of the mass of a full one says little to its neighbours,
#: and nothing as it empties: or nodes that come and go would make steps in the answer.
FAINT = 0.02


@dataclass(frozen=True)
class Grid:
    """Where the vertices are on the coarse grid, and which nodes are neighbours.

    Attributes:
        nodes: that a vertex belongs to, shape (N, 3^D).
        weights: by how much, summing to 1, shape (N, 3^D).
        share: of a full node's mass in one point.
        filling: mass of every node, 1 where it is full, shape (M, 1).
        senders, receivers: pairs of neighbouring nodes, shape (E,).
        offsets: from sender to receiver, in nodes, shape (E, D).
    """

    nodes: Tensor
    weights: Tensor
    share: float
    filling: Tensor
    senders: Tensor
    receivers: Tensor
    offsets: Tensor

    @classmethod
    def of(
        cls, positions: Tensor, lower: Tensor, batch: Tensor, *, size: float, spacing: float
    ) -> Grid:
        """The grid under the points of some scenes, of which none sees another's.

        Args:
            positions: [m], shape (N, D).
            lower: corner of each point's domain, where the grid begins [m], shape (N, D).
            batch: scene of every point, shape (N,).
            size: of a cell of the grid [m].
            spacing: of the points [m].
        """
        dim = positions.shape[1]
        place = (positions - lower) / size
        first = (place.detach() - 0.5).floor()
        # What has diverged shall end as a status: it lies anywhere rather than at no node.
        first = first.nan_to_num(0.0, 0.0, 0.0).clamp(-1000, 1000)
        off = place - first
        along = torch.stack(
            [(1.5 - off).square() / 2, 0.75 - (off - 1).square(), (off - 0.5).square() / 2], dim=2
        )
        steps = torch.tensor([*itertools.product(range(3), repeat=dim)], device=positions.device)
        weights = torch.ones_like(along[:, 0, :1])
        for axis in range(dim):
            weights = weights * along[:, axis, steps[:, axis]]
        cells = first.long()[:, None] + steps
        lowest = cells.amin((0, 1)) - 1
        shape = cells.amax((0, 1)) - lowest + 2  # a rim, so that neighbours never wrap around
        stride = torch.ones_like(shape)
        for axis in range(dim - 2, -1, -1):
            stride[axis] = stride[axis + 1] * shape[axis + 1]
        keys = ((cells - lowest) * stride).sum(2) + batch[:, None] * shape.prod()
        known, nodes = keys.unique(return_inverse=True)
        share = (spacing / size) ** dim
        mass = weights.new_zeros(len(known)).index_add(0, nodes.flatten(), weights.flatten())

        ways = torch.tensor(
            [way for way in itertools.product((-1, 0, 1), repeat=dim) if any(way)],
            device=positions.device,
        )
        wanted = known[:, None] - (ways * stride).sum(1)
        found = torch.searchsorted(known, wanted).clamp(max=len(known) - 1)
        receivers, way = (known[found] == wanted).nonzero().unbind(1)
        return cls(
            nodes=nodes,
            weights=weights,
            share=share,
            filling=share * mass[:, None],
            senders=found[receivers, way],
            receivers=receivers,
            offsets=ways[way].to(positions.dtype),
        )

    def down(self, values: Tensor) -> Tensor:
        """Means over the vertices of values (N, W), by weight, shape (M, W); 0 at empty nodes."""
        total = values.new_zeros((len(self.filling), values.shape[1]))
        for nodes, weights in zip(self.nodes.unbind(1), self.weights.unbind(1), strict=True):
            total = total.index_add(0, nodes, weights[:, None] * values)
        return self.share * total / (self.filling + FAINT)

    def up(self, values: Tensor) -> Tensor:
        """Values of nodes (M, W) at the vertices, by weight, shape (N, W)."""
        total = values.new_zeros((len(self.nodes), values.shape[1]))
        for nodes, weights in zip(self.nodes.unbind(1), self.weights.unbind(1), strict=True):
            total = total + weights[:, None] * values.index_select(0, nodes)
        return total


class CoarseLevel(nn.Module):
    """Down to a grid, messages there, and up again; at first, with `lift` zero, it adds nothing.

    Args:
        latent: width of the vertices' latents.
        dim: of space.
        blocks: that carry messages between nodes, as between vertices.
        mlp: makes an MLP of (inputs, outputs).
        block: makes one of the blocks.
    """

    def __init__(
        self,
        latent: int,
        dim: int,
        blocks: int,
        mlp: Callable[[int, int], nn.Module],
        block: Callable[[], nn.Module],
    ) -> None:
        super().__init__()
        self.encode_node = mlp(latent + 1, latent)
        self.encode_offset = mlp(dim, latent)
        self.blocks = nn.ModuleList(block() for _ in range(blocks))
        self.lift = nn.Linear(latent, latent)
        nn.init.zeros_(self.lift.weight)
        nn.init.zeros_(self.lift.bias)

    def forward(self, vertex: Tensor, grid: Grid, dtype: torch.dtype) -> Tensor:
        """Latents of vertices (N, L) -> (N, L); dtype of the products over pairs of nodes."""
        known = grid.filling / (grid.filling + FAINT)
        node = self.encode_node(torch.cat([grid.down(vertex), grid.filling], dim=1))
        edge = self.encode_offset(grid.offsets)
        heard = known.index_select(0, grid.senders)
        for block in self.blocks:
            node, edge = block(node, edge, grid.senders, grid.receivers, heard, dtype)
        return vertex + self.lift(grid.up(known * node))

"""What keeps the gradient of a long flow right: adjoints that are limited and smoothed.

A granular flow is chaotic: over tens of steps the exact derivative is that of a few grains which
happened to be about to part ways, and says nothing about a move of a centimetre. Two things bring
back what all grains agree on. No grain's adjoint may be many times the usual one, and neighbours
share theirs: the effect that a push on the sand has on where it comes to rest varies over the size
of a baffle, so what varies from grain to grain is noise. Sharing is diffusion in the backward pass,
with weights that conserve the sum (Metropolis weights; Xiao & Boyd 2004, Fast linear iterations for
distributed averaging).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gns_model.learned.graph import radius_graph

# Cosines with central differences of 2 cm over 45 steps of the flume with `baffle-lite`, for one
# start and the other, on the paper's layout; `benchmarks/gradients.py` prints some of them anew.
#
#     limit, smoothing    trained on windows    and through whole flows
#     none, 0             0.53                  0.65
#     6, 0                0.94, 0.77            0.27, -0.23
#     6, 0.2              0.93, 0.97            0.26 (mean of four)
#     6, 0.5              0.86, 0.90            0.69, 0.75
#     6, 1                0.82                  0.71, 0.77
#     2, 0.5                                    0.59, 0.71
#
# A model whose flows do not stop too early damps less, so its adjoints grow faster. At 0.5 the
# length is right too, within a fifth, and the mean of two starts agrees best. More sharing favours
# moves along the flow over moves across it. What is still missing across the flow are the grains
# that just pass a baffle, or just do not: no derivative of a path sees that it might have taken the
# other one.

#: Limit of a grain's adjoint for design gradients over a whole flow, in medians of its scene.
ADJOINT_LIMIT = 6.0
#: Share of its adjoint that a grain gives to and takes from its neighbours in each step.
ADJOINT_SMOOTHING = 0.5


class FilterAdjoint(torch.autograd.Function):
    """The identity; backward, adjoints are limited, then smoothed."""

    @staticmethod
    def forward(
        ctx,
        positions: Tensor,
        counts: Sequence[int],
        moving: Tensor,
        limit: float | None,
        smoothing: float,
        radius: float,
    ) -> Tensor:
        """The same positions [m], shape (N, D).

        Args:
            counts: points of each scene.
            moving: mask of the points that take part in smoothing, shape (N,).
            limit: see `limited`; None: none.
            smoothing, radius: see `smoothed`.
        """
        ctx.save_for_backward(positions, moving)
        ctx.settings = counts, limit, smoothing, radius
        return positions.view_as(positions)

    @staticmethod
    def backward(ctx, adjoint: Tensor) -> tuple[Tensor | None, ...]:
        """Adjoint (N, D) of the positions."""
        positions, moving = ctx.saved_tensors
        counts, limit, smoothing, radius = ctx.settings
        if limit is not None:
            adjoint = limited(adjoint, counts, limit)
        if smoothing:
            batch = torch.repeat_interleave(
                torch.arange(len(counts), device=adjoint.device),
                torch.tensor(counts, device=adjoint.device),
            )
            adjoint = smoothed(adjoint, positions, batch, moving, smoothing, radius)
        return adjoint, None, None, None, None, None


def limited(adjoint: Tensor, counts: Sequence[int], limit: float) -> Tensor:
    """Rows (N, D), none longer than `limit` times the median of its scene's that are not zero."""
    parts = []
    for part in adjoint.split(list(counts)):
        norm = part.norm(dim=1, keepdim=True)
        felt = norm[norm > 0]
        if len(felt):
            part = part * (limit * felt.median() / norm.clamp_min(1e-30)).clamp(max=1)
        parts.append(part)
    return torch.cat(parts)


def smoothed(
    adjoint: Tensor,
    positions: Tensor,
    batch: Tensor,
    moving: Tensor,
    smoothing: float,
    radius: float,
) -> Tensor:
    """Rows (N, D) after one step of diffusion between neighbours; each scene's sum stays.

    a_i += smoothing * sum_j (a_j - a_i) / (1 + max(n_i, n_j)), with n_i the number of neighbours.

    Args:
        positions: [m], shape (N, D).
        batch: scene of every row, shape (N,).
        moving: rows that take part, shape (N,).
        smoothing: 0 to 1.
        radius: within which points are neighbours [m].
    """
    senders, receivers = radius_graph(positions.detach(), radius, batch)
    both = moving[senders] & moving[receivers]
    senders, receivers = senders[both], receivers[both]
    degree = torch.bincount(receivers, minlength=len(positions)).to(adjoint)
    weight = smoothing / (1 + torch.maximum(degree[senders], degree[receivers]))
    change = weight[:, None] * (adjoint[senders] - adjoint[receivers])
    return adjoint.index_add(0, receivers, change)

"""Encode, process, decode: the graph network of Choi & Kumar, with the first edge layer split."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor, nn

from gns_model.learned.edge_kernel import edge_mlp

ACTIVATIONS = {"silu": nn.functional.silu, "relu": nn.functional.relu}


class MLP(nn.Module):
    """`hidden_layers` hidden layers, a linear output and, unless `norm` is off, a LayerNorm."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        *,
        hidden: int,
        hidden_layers: int,
        activation: str,
        norm: bool = True,
    ) -> None:
        super().__init__()
        sizes = [inputs] + [hidden] * hidden_layers + [outputs]
        linear = [nn.Linear(a, b) for a, b in itertools.pairwise(sizes)]
        # A ModuleList registers them; typed as what it holds.
        self.layers: Sequence[nn.Linear] = nn.ModuleList(linear)  # type: ignore[assignment]
        self.activation = activation
        self.norm = nn.LayerNorm(outputs) if norm else None

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) -> (..., outputs)."""
        return self.after_first(self.layers[0](x))

    def after_first(self, h: Tensor) -> Tensor:
        """The rest, given the value of the first linear layer before its activation."""
        for layer in list(self.layers)[1:]:
            h = layer(ACTIVATIONS[self.activation](h))
        return h if self.norm is None else self.norm(h)

    def split_first(self, *widths: int) -> tuple[Tensor, ...]:
        """Weights of the first layer for inputs that come in parts of these widths.

        W [a, b] = W_a a + W_b b: parts that live on vertices are multiplied once per vertex, and
        no wide concatenation is ever written.
        """
        return self.layers[0].weight.split(widths, dim=1)

    def over_edges(
        self,
        edge: Tensor,
        senders: Tensor,
        receivers: Tensor,
        dtype: torch.dtype,
        first: Tensor,
        vertex_terms: tuple[Tensor, Tensor] | None = None,
        envelope: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """The MLP by `edge_mlp`, with `first` as the edge's part of the first weight."""
        assert self.norm is not None
        return edge_mlp(
            edge,
            vertex_terms,
            envelope,
            senders,
            receivers,
            first=first,
            biases=[layer.bias for layer in self.layers],
            weights=[layer.weight for layer in list(self.layers)[1:]],
            norm=(self.norm.weight, self.norm.bias),
            activation=self.activation,
            dtype=dtype,
        )


class Block(nn.Module):
    """One round of message passing, with residuals on vertices and edges.

    message = MLP(v_i, v_j, e_ij); v_i += MLP(v_i, sum_j envelope_ij message_ij); e_ij += message,
    or, if `doubled`, e_ij += e_ij.
    """

    def __init__(self, latent: int, mlp: Callable[..., MLP], *, doubled: bool = False) -> None:
        super().__init__()
        self.latent = latent
        self.doubled = doubled
        self.edge = mlp(3 * latent, latent)
        self.vertex = mlp(2 * latent, latent)

    def forward(
        self,
        vertex: Tensor,
        edge: Tensor,
        senders: Tensor,
        receivers: Tensor,
        envelope: Tensor | None,
        dtype: torch.dtype,
    ) -> tuple[Tensor, Tensor]:
        """Vertex (N, L) and edge (E, L) latents; envelope (E, 1); dtype of edge products."""
        w_receiver, w_sender, w_edge = self.edge.split_first(*[self.latent] * 3)
        at_receiver = nn.functional.linear(vertex, w_receiver)
        at_sender = nn.functional.linear(vertex, w_sender)
        updated, total = self.edge.over_edges(
            edge, senders, receivers, dtype, w_edge, (at_receiver, at_sender), envelope
        )
        w_vertex, w_total = self.vertex.split_first(*[self.latent] * 2)
        hidden = nn.functional.linear(vertex, w_vertex, self.vertex.layers[0].bias)
        hidden = hidden + nn.functional.linear(total, w_total)
        return vertex + self.vertex.after_first(hidden), 2 * edge if self.doubled else updated


class EncodeProcessDecode(nn.Module):
    """Features of vertices and edges -> one vector per vertex."""

    def __init__(
        self,
        vertex_inputs: int,
        edge_inputs: int,
        outputs: int,
        *,
        latent: int,
        hidden_layers: int,
        blocks: int,
        activation: str,
        hidden: int | None = None,
        edge_update: str = "residual",
    ) -> None:
        super().__init__()
        mlp = partial(
            MLP, hidden=hidden or latent, hidden_layers=hidden_layers, activation=activation
        )
        doubled = edge_update == "doubled"
        self.encode_vertex = mlp(vertex_inputs, latent)
        self.encode_edge = mlp(edge_inputs, latent)
        self.blocks = nn.ModuleList(Block(latent, mlp, doubled=doubled) for _ in range(blocks))
        self.decode = mlp(latent, outputs, norm=False)

    def forward(
        self,
        vertex: Tensor,
        edge: Tensor,
        senders: Tensor,
        receivers: Tensor,
        envelope: Tensor | None = None,
    ) -> Tensor:
        """(N, vertex_inputs), (E, edge_inputs), (E,), (E,), (E, 1) -> (N, outputs).

        Under `torch.autocast` only the products over edges take its dtype: they are nearly all of
        the work, while the few vertices keep their precision from block to block.
        """
        kind = vertex.device.type
        short = torch.is_autocast_enabled(kind)
        dtype = torch.get_autocast_dtype(kind) if short else edge.dtype
        with torch.autocast(kind, enabled=False):
            first = self.encode_edge.layers[0].weight
            vertex = self.encode_vertex(vertex)
            edge, _ = self.encode_edge.over_edges(edge, senders, receivers, dtype, first)
            for block in self.blocks:
                vertex, edge = block(vertex, edge, senders, receivers, envelope, dtype)
            return self.decode(vertex)

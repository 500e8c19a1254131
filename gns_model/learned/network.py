"""Encode, process, decode: the graph network of Choi & Kumar, with the first edge layer split."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

ACTIVATIONS = {"silu": nn.functional.silu, "relu": nn.functional.relu}


class MLP(nn.Module):
    """`hidden_layers` hidden layers, a linear output and, unless `norm` is off, a LayerNorm."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        *,
        latent: int,
        hidden_layers: int,
        activation: str,
        norm: bool = True,
    ) -> None:
        super().__init__()
        sizes = [inputs] + [latent] * hidden_layers + [outputs]
        self.layers = nn.ModuleList(
            nn.Linear(a, b) for a, b in itertools.pairwise(sizes)
        )
        self.activation = ACTIVATIONS[activation]
        self.norm = nn.LayerNorm(outputs) if norm else None

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) -> (..., outputs)."""
        return self.after_first(self.layers[0](x))

    def after_first(self, h: Tensor) -> Tensor:
        """The rest, given the value of the first linear layer before its activation."""
        for layer in self.layers[1:]:
            h = layer(self.activation(h))
        return h if self.norm is None else self.norm(h)

    def split_first(self, *widths: int) -> tuple[list[Tensor], Tensor]:
        """Weights of the first layer for inputs that come in parts of these widths, and its bias.

        W [a, b] = W_a a + W_b b: parts that live on vertices are multiplied once per vertex, and
        no wide concatenation is ever written.
        """
        first = self.layers[0]
        assert isinstance(first, nn.Linear)
        return list(first.weight.split(widths, dim=1)), first.bias


class Block(nn.Module):
    """One round of message passing, with residuals on vertices and edges.

    message = MLP(v_i, v_j, e_ij); v_i += MLP(v_i, sum_j envelope_ij message_ij); e_ij += message.
    """

    def __init__(self, latent: int, hidden_layers: int, activation: str) -> None:
        super().__init__()
        kwargs = {"latent": latent, "hidden_layers": hidden_layers, "activation": activation}
        self.latent = latent
        self.edge = MLP(3 * latent, latent, **kwargs)
        self.vertex = MLP(2 * latent, latent, **kwargs)

    def forward(
        self,
        vertex: Tensor,
        edge: Tensor,
        senders: Tensor,
        receivers: Tensor,
        envelope: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Vertex (N, L) and edge (E, L) latents; envelope (E, 1) or None."""
        (w_receiver, w_sender, w_edge), bias = self.edge.split_first(*[self.latent] * 3)
        hidden = nn.functional.linear(edge, w_edge)
        hidden = hidden + nn.functional.linear(vertex, w_receiver, bias).index_select(0, receivers)
        hidden = hidden + nn.functional.linear(vertex, w_sender).index_select(0, senders)
        message = self.edge.after_first(hidden)
        weighted = message if envelope is None else message * envelope
        total = aggregate(weighted, receivers, len(vertex))
        (w_vertex, w_total), bias = self.vertex.split_first(*[self.latent] * 2)
        hidden = nn.functional.linear(vertex, w_vertex, bias)
        hidden = hidden + nn.functional.linear(total, w_total)
        return vertex + self.vertex.after_first(hidden), edge + message


def aggregate(messages: Tensor, receivers: Tensor, vertices: int) -> Tensor:
    """Sum of the messages (E, L) that each of `vertices` receives, shape (vertices, L)."""
    return messages.new_zeros((vertices, messages.shape[1])).index_add(0, receivers, messages)


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
    ) -> None:
        super().__init__()
        kwargs = {"latent": latent, "hidden_layers": hidden_layers, "activation": activation}
        self.encode_vertex = MLP(vertex_inputs, latent, **kwargs)
        self.encode_edge = MLP(edge_inputs, latent, **kwargs)
        self.blocks = nn.ModuleList(Block(latent, hidden_layers, activation) for _ in range(blocks))
        self.decode = MLP(latent, outputs, norm=False, **kwargs)

    def forward(
        self,
        vertex: Tensor,
        edge: Tensor,
        senders: Tensor,
        receivers: Tensor,
        envelope: Tensor | None = None,
    ) -> Tensor:
        """(N, vertex_inputs), (E, edge_inputs), (E,), (E,), (E, 1) -> (N, outputs)."""
        # Under autocast to bfloat16 the wide edge streams are short, while the few vertices keep
        # their precision from block to block. (`index_select` has a faster backward than `[]`.)
        vertex, edge = self.encode_vertex(vertex).to(vertex.dtype), self.encode_edge(edge)
        for block in self.blocks:
            vertex, edge = block(vertex, edge, senders, receivers, envelope)
        with torch.autocast(vertex.device.type, enabled=False):
            return self.decode(vertex)

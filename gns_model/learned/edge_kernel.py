"""The MLP of the edges in cache-sized tiles: gather, layers, LayerNorm, receiver sum in one pass.

A plain MLP over 60,000 edges writes and reads a dozen arrays of 15 MB in every block. Here a tile
of edges stays in the cache from the gather to the sum. When only the inputs need a gradient (a
rollout differentiated by its layout) nothing inside is kept and the backward pass computes it
again; when parameters need one (training) the values before the activations are kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

#: Edges of a tile: on a CPU its arrays shall fit the second-level cache, a GPU wants long ones.
TILE = {"cpu": 2048, "cuda": 1 << 20}

#: Edges up to which training in a short dtype keeps whatever autograd keeps instead of tiles: a
#: fifth faster (0.38 s against 0.47 s at 58,000 edges, latent 64, 5 blocks) for more memory.
PLAIN_TRAINING = 120_000

_aten = torch.ops.aten
_EPSILON = 1e-5  # LayerNorm's


def edge_mlp(
    edge: Tensor,
    vertex_terms: tuple[Tensor, Tensor] | None,
    envelope: Tensor | None,
    senders: Tensor,
    receivers: Tensor,
    *,
    first: Tensor,
    biases: list[Tensor],
    weights: list[Tensor],
    norm: tuple[Tensor, Tensor],
    activation: str,
    dtype: torch.dtype,
) -> tuple[Tensor, Tensor]:
    """message = LayerNorm(MLP(first edge + a[receivers] + b[senders] + bias)), and what follows.

    Without `vertex_terms` this encodes edges; with them it is the edge part of a message-passing
    block. Differentiable once, in everything but the indices.

    Args:
        edge: shape (E, K).
        vertex_terms: a and b, each (N, W): the vertices' share of the first layer; or None.
        envelope: factor of the messages in the sum, shape (E, 1), or None.
        senders, receivers: shape (E,).
        first: weight of the first layer for the edge's own part, shape (W, K).
        biases: of all layers, the first included.
        weights: of the layers after the first; the activation goes before each.
        norm: gain and shift of the LayerNorm.
        activation: "silu" or "relu".
        dtype: in which matrices are multiplied, e.g. bfloat16; sums and norms stay in `edge`'s.

    Returns:
        with vertex terms: edge + message (E, L), and the sum of envelope · message over the edges
        of each receiver (N, L); without: message (E, L), and an empty tensor.
    """
    a, b = vertex_terms if vertex_terms is not None else (None, None)
    training = torch.is_grad_enabled() and first.requires_grad and dtype != edge.dtype
    # A compiler fuses by itself, and cannot see into ours.
    if torch.compiler.is_compiling() or (training and len(edge) <= PLAIN_TRAINING):
        return _plain(
            edge, a, b, envelope, senders, receivers, activation, dtype, [first, *weights], biases,
            norm,
        )  # fmt: skip
    return _EdgeMLP.apply(
        edge, a, b, envelope, senders, receivers, activation, dtype,
        first, *biases, *weights, *norm,
    )  # fmt: skip


def add_messages(total: Tensor, receivers: Tensor, messages: Tensor) -> Tensor:
    """Aggregation: add each message (E, L) to the row of `total` (N, L) of its receiver."""
    return total.index_add_(0, receivers, messages)


def _plain(
    edge: Tensor,
    a: Tensor | None,
    b: Tensor | None,
    envelope: Tensor | None,
    senders: Tensor,
    receivers: Tensor,
    activation: str,
    dtype: torch.dtype,
    weights: list[Tensor],
    biases: list[Tensor],
    norm: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    """`edge_mlp` in plain operations."""
    linear = torch.nn.functional.linear
    hidden = linear(edge.to(dtype), weights[0].to(dtype), biases[0].to(dtype))
    if a is not None and b is not None:
        hidden = hidden + a.to(dtype).index_select(0, receivers)
        hidden = hidden + b.to(dtype).index_select(0, senders)
    for weight, bias in zip(weights[1:], biases[1:], strict=True):
        active = torch.nn.functional.silu(hidden) if activation == "silu" else hidden.relu()
        hidden = linear(active, weight.to(dtype), bias.to(dtype))
    message = torch.layer_norm(hidden.to(edge.dtype), norm[0].shape, *norm, _EPSILON)
    if a is None:
        return message, edge.new_zeros(0)
    weighted = message if envelope is None else message * envelope
    return edge + message, add_messages(edge.new_zeros(len(a), edge.shape[1]), receivers, weighted)


class _Layers:
    """The parameters of the MLP in the dtype of its products, and passes over one tile."""

    def __init__(self, parameters: tuple[Tensor, ...], activation: str, dtype: torch.dtype) -> None:
        first, *rest = parameters
        depth = (len(rest) - 1) // 2  # biases of `depth` layers, weights of all but the first
        self.first = first.to(dtype)
        self.biases = [p.to(dtype) for p in rest[:depth]]
        self.weights = [p.to(dtype) for p in rest[depth : 2 * depth - 1]]
        self.gain, self.shift = rest[-2:]
        self.silu = activation == "silu"
        self.dtype = dtype

    def room(self, edges: int) -> list[Tensor]:
        """Arrays for the values before each activation and before LayerNorm."""
        return [bias.new_empty((edges, len(bias))) for bias in self.biases]

    def enter(
        self, edge: Tensor, a: Tensor | None, b: Tensor | None, to: Tensor, origin: Tensor
    ) -> Tensor:
        """The first layer before its activation, for a tile."""
        hidden = torch.addmm(self.biases[0], edge, self.first.t())
        if a is not None and b is not None:
            hidden += a.index_select(0, to)
            hidden += b.index_select(0, origin)
        return hidden

    def activate(self, hidden: Tensor, *, overwrite: bool) -> Tensor:
        if self.silu:
            return torch.nn.functional.silu(hidden, inplace=overwrite)
        return hidden.relu_() if overwrite else hidden.relu()

    def forward(self, hidden: Tensor, kept: list[Tensor] | None) -> Tensor:
        """From the first layer to the value before LayerNorm; copies what it passes to `kept`."""
        for k, weight in enumerate(self.weights):
            if kept is not None:
                kept[k].copy_(hidden)
            active = self.activate(hidden, overwrite=True)
            hidden = torch.addmm(self.biases[k + 1], active, weight.t())
        if kept is not None:
            kept[-1].copy_(hidden)
        return hidden

    def normalise(self, last: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """LayerNorm, in the dtype of the parameters: value, mean and reciprocal deviation."""
        wide = last.to(self.gain.dtype)
        return torch.native_layer_norm(wide, self.gain.shape, self.gain, self.shift, _EPSILON)

    def backward(
        self,
        grad: Tensor,
        before: list[Tensor],
        mean: Tensor,
        scale: Tensor,
        sums: list[Tensor] | None,
    ) -> Tensor:
        """Gradient of the first layer's value from that of the message.

        `before` are the values before each activation and before LayerNorm; gradients of the
        parameters are added to `sums`, which is ordered like `parameters`.
        """
        *hidden, last = before
        train = sums is not None
        grad, gain, shift = _aten.native_layer_norm_backward(
            grad, last.to(self.gain.dtype), self.gain.shape, mean, scale, self.gain, self.shift,
            [True, train, train],
        )  # fmt: skip
        if sums is not None:
            sums[-2] += gain
            sums[-1] += shift
        depth = len(self.biases)
        grad = grad.to(self.dtype)
        for k in range(depth - 1, 0, -1):
            if sums is not None:
                active = self.activate(hidden[k - 1], overwrite=False)
                sums[1 + k] += grad.sum(0, dtype=self.gain.dtype)
                sums[depth + k] += grad.t() @ active
            grad = grad @ self.weights[k - 1]
            if self.silu:
                grad = _aten.silu_backward(grad, hidden[k - 1])
            else:
                grad = _aten.threshold_backward(grad, hidden[k - 1], 0)
        if sums is not None:
            sums[1] += grad.sum(0, dtype=self.gain.dtype)
        return grad


class _EdgeMLP(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        edge: Tensor,
        a: Tensor | None,
        b: Tensor | None,
        envelope: Tensor | None,
        senders: Tensor,
        receivers: Tensor,
        activation: str,
        dtype: torch.dtype,
        *parameters: Tensor,
    ) -> tuple[Tensor, Tensor]:
        layers = _Layers(parameters, activation, dtype)
        low_a, low_b = (None, None) if a is None or b is None else (a.to(dtype), b.to(dtype))
        out = edge.new_empty((len(edge), len(layers.gain)))
        total = edge.new_zeros(0) if a is None else edge.new_zeros((len(a), edge.shape[1]))
        trains = any(ctx.needs_input_grad[8:])
        kept = layers.room(len(edge)) if trains else []
        moments = [out.new_empty((len(edge), 1)) for _ in range(2)] if trains else []
        for tile in _tiles(edge):
            to, origin = receivers[tile], senders[tile]
            own = edge[tile]
            hidden = layers.enter(own.to(dtype), low_a, low_b, to, origin)
            last = layers.forward(hidden, [k[tile] for k in kept] if trains else None)
            message, mean, scale = layers.normalise(last)
            if trains:
                moments[0][tile], moments[1][tile] = mean, scale
            if a is None:
                out[tile] = message
            else:
                torch.add(own, message, out=out[tile])
                if envelope is not None:
                    message *= envelope[tile]
                add_messages(total, to, message)
        ctx.save_for_backward(
            edge, a, b, envelope, senders, receivers, *parameters, *kept, *moments
        )
        ctx.activation, ctx.dtype, ctx.parameters = activation, dtype, len(parameters)
        return out, total

    @staticmethod
    @once_differentiable
    def backward(  # type: ignore[override]
        ctx: Any, grad_out: Tensor, grad_total: Tensor
    ) -> tuple[Tensor | None, ...]:
        edge, a, b, envelope, senders, receivers, *saved = ctx.saved_tensors
        dtype, parameters = ctx.dtype, saved[: ctx.parameters]
        kept = saved[ctx.parameters :]
        layers = _Layers(parameters, ctx.activation, dtype)
        low_a, low_b = (None, None) if a is None else (a.to(dtype), b.to(dtype))
        sums = [torch.zeros_like(p) for p in parameters] if kept else None
        need_edge, need_envelope = ctx.needs_input_grad[0], ctx.needs_input_grad[3]
        grad_edge = torch.empty_like(edge) if need_edge else None
        grad_a = torch.zeros_like(a) if a is not None else None
        grad_b = torch.zeros_like(b) if b is not None else None
        grad_envelope = torch.empty_like(envelope) if need_envelope else None

        for tile in _tiles(edge):
            to, origin = receivers[tile], senders[tile]
            own = edge[tile].to(dtype)
            if kept:
                before = [k[tile] for k in kept[:-2]]
                mean, scale = kept[-2][tile], kept[-1][tile]
                message = layers.normalise(before[-1])[0] if need_envelope else None
            else:
                hidden = layers.enter(own, low_a, low_b, to, origin)
                before = layers.room(len(own))
                message, mean, scale = layers.normalise(layers.forward(hidden, before))
            grad = grad_out[tile]
            if grad_a is not None and grad_b is not None:
                received = grad_total.index_select(0, to)
                if grad_envelope is not None and message is not None:
                    grad_envelope[tile] = (message * received).sum(1, keepdim=True)
                if envelope is not None:
                    received *= envelope[tile]
                received += grad
                low = layers.backward(received, before, mean, scale, sums)
                wide = low.to(edge.dtype)
                grad_a.index_add_(0, to, wide)
                grad_b.index_add_(0, origin, wide)
                if grad_edge is not None:
                    torch.add(grad, low @ layers.first, out=grad_edge[tile])
            else:
                low = layers.backward(grad, before, mean, scale, sums)
                if grad_edge is not None:
                    grad_edge[tile] = low @ layers.first
            if sums is not None:
                sums[0] += low.t() @ own
        return (
            grad_edge, grad_a, grad_b, grad_envelope, None, None, None, None,
            *(sums if sums is not None else [None] * len(parameters)),
        )  # fmt: skip


def _tiles(edge: Tensor) -> Iterator[slice]:
    size = TILE.get(edge.device.type, TILE["cuda"])
    for begin in range(0, len(edge), size):
        yield slice(begin, min(begin + size, len(edge)))

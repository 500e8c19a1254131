"""Edge networks in cache-sized tiles, with a backward pass that computes them again.

A plain MLP over 60,000 edges writes and reads a dozen arrays of 15 MB for every block, and autograd
keeps half of them. Here a tile of edges goes through gather, layers, LayerNorm and the receiver sum
while it sits in the cache; what is kept for the backward pass is the edge latents alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

#: Edges of a tile: on a CPU its arrays shall fit the second-level cache, a GPU wants long ones.
TILE = {"cpu": 1024, "cuda": 1 << 20}

_aten = torch.ops.aten


@dataclass(frozen=True)
class Layers:
    """An MLP behind its first linear layer: what follows the sum that the caller has formed.

    Attributes:
        weights, biases: of the linear layers after the first, each preceded by the activation.
        gain, shift: of the LayerNorm.
        activation: "silu" or "relu".
        dtype: in which matrices are multiplied.
    """

    weights: tuple[Tensor, ...]
    biases: tuple[Tensor, ...]
    gain: Tensor
    shift: Tensor
    activation: str
    dtype: torch.dtype

    def forward(self, hidden: Tensor) -> Tensor:
        """Overwrites `hidden`, the value of the first layer before its activation."""
        for weight, bias in zip(self.weights, self.biases, strict=True):
            hidden = torch.addmm(bias, self._activate_(hidden), weight.t())
        return torch.layer_norm(hidden.to(self.gain.dtype), self.gain.shape, self.gain, self.shift)

    def _activate_(self, hidden: Tensor) -> Tensor:
        if self.activation == "silu":
            return torch.nn.functional.silu(hidden, inplace=True)
        return hidden.relu_()

    def recompute(self, hidden: Tensor) -> tuple[Tensor, list[Tensor], list[Tensor], tuple[Any, ...]]:
        """Output, the values before each activation, after it, and what LayerNorm needs."""
        before, after = [], []
        for weight, bias in zip(self.weights, self.biases, strict=True):
            before.append(hidden)
            if self.activation == "silu":
                after.append(torch.nn.functional.silu(hidden))
            else:
                after.append(hidden.relu())
            hidden = torch.addmm(bias, after[-1], weight.t())
        last = hidden.to(self.gain.dtype)
        out, mean, scale = torch.native_layer_norm(
            last, self.gain.shape, self.gain, self.shift, 1e-5
        )
        return out, before, after, (last, mean, scale)

    def backward(
        self,
        grad: Tensor,
        before: list[Tensor],
        after: list[Tensor],
        norm: tuple[Any, ...],
        sums: Gradients | None,
    ) -> Tensor:
        """Gradient of the first layer's value; those of the parameters are added to `sums`."""
        last, mean, scale = norm
        mask = [True, sums is not None, sums is not None]
        grad, gain, shift = _aten.native_layer_norm_backward(
            grad, last, self.gain.shape, mean, scale, self.gain, self.shift, mask
        )
        if sums is not None:
            sums.gain += gain
            sums.shift += shift
        for k in range(len(self.weights) - 1, -1, -1):
            low = grad.to(self.dtype)
            if sums is not None:
                sums.weights[k] += low.t() @ after[k]
                sums.biases[k] += grad.sum(0)
            grad = low @ self.weights[k]
            if self.activation == "silu":
                grad = _aten.silu_backward(grad, before[k])
            else:
                grad = _aten.threshold_backward(grad, before[k], 0)
        return grad


@dataclass
class Gradients:
    """Sums of the gradients of the parameters of `Layers` and of the first weight."""

    first: Tensor
    weights: list[Tensor]
    biases: list[Tensor]
    gain: Tensor
    shift: Tensor

    @classmethod
    def zeros(cls, first: Tensor, parameters: tuple[Tensor, ...]) -> Gradients:
        zero = [torch.zeros_like(p) for p in parameters]
        half = (len(zero) - 2) // 2
        return cls(torch.zeros_like(first), zero[:half], zero[half:-2], zero[-2], zero[-1])

    def all(self) -> list[Tensor]:
        return [*self.weights, *self.biases, self.gain, self.shift]


def _tiles(edges: int, device: torch.device) -> Iterator[slice]:
    size = TILE.get(device.type, TILE["cuda"])
    for begin in range(0, edges, size):
        yield slice(begin, min(begin + size, edges))


def _layers(parameters: tuple[Tensor, ...], activation: str, dtype: torch.dtype) -> Layers:
    half = (len(parameters) - 2) // 2
    return Layers(
        tuple(p.to(dtype) for p in parameters[:half]),
        tuple(p.to(dtype) for p in parameters[half:-2]),
        parameters[-2],
        parameters[-1],
        activation,
        dtype,
    )


class _Messages(torch.autograd.Function):
    """(edge, at receiver, at sender, envelope) -> (edge + message, sum of enveloped messages)."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        edge: Tensor,
        at_receiver: Tensor,
        at_sender: Tensor,
        envelope: Tensor | None,
        senders: Tensor,
        receivers: Tensor,
        activation: str,
        dtype: torch.dtype,
        first: Tensor,
        *parameters: Tensor,
    ) -> tuple[Tensor, Tensor]:
        layers = _layers(parameters, activation, dtype)
        low_first, low_receiver = first.to(dtype), at_receiver.to(dtype)
        low_sender = at_sender.to(dtype)
        out = torch.empty_like(edge)
        total = torch.zeros_like(at_receiver)
        for tile in _tiles(len(edge), edge.device):
            to, origin = receivers[tile], senders[tile]
            hidden = edge[tile].to(dtype) @ low_first.t()
            hidden += low_receiver.index_select(0, to)
            hidden += low_sender.index_select(0, origin)
            message = layers.forward(hidden)
            torch.add(edge[tile], message, out=out[tile])
            if envelope is not None:
                message *= envelope[tile]
            total.index_add_(0, to, message)
        ctx.save_for_backward(
            edge, at_receiver, at_sender, envelope, senders, receivers, first, *parameters
        )
        ctx.activation, ctx.dtype = activation, dtype
        return out, total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_out: Tensor, grad_total: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        edge, at_receiver, at_sender, envelope, senders, receivers, first, *rest = ctx.saved_tensors
        dtype = ctx.dtype
        layers = _layers(tuple(rest), ctx.activation, dtype)
        low_first, low_receiver = first.to(dtype), at_receiver.to(dtype)
        low_sender = at_sender.to(dtype)
        trains = any(ctx.needs_input_grad[8:])
        sums = Gradients.zeros(first, tuple(rest)) if trains else None
        grad_edge = torch.empty_like(edge)
        grad_receiver, grad_sender = torch.zeros_like(at_receiver), torch.zeros_like(at_sender)
        grad_envelope = torch.empty_like(envelope) if envelope is not None else None
        for tile in _tiles(len(edge), edge.device):
            to, origin = receivers[tile], senders[tile]
            low_edge = edge[tile].to(dtype)
            hidden = low_edge @ low_first.t()
            hidden += low_receiver.index_select(0, to)
            hidden += low_sender.index_select(0, origin)
            message, *inner = layers.recompute(hidden)
            grad = grad_total.index_select(0, to)
            if envelope is not None and grad_envelope is not None:
                torch.sum(message * grad, 1, keepdim=True, out=grad_envelope[tile])
                grad *= envelope[tile]
            grad += grad_out[tile]
            low = layers.backward(grad, *inner, sums)
            grad = low.to(edge.dtype)
            grad_receiver.index_add_(0, to, grad)
            grad_sender.index_add_(0, origin, grad)
            if sums is not None:
                sums.first += low.t() @ low_edge
            torch.add(grad_out[tile], low @ low_first, out=grad_edge[tile])
        parameters = [sums.first, *sums.all()] if sums is not None else [None] * (1 + len(rest))
        return (
            grad_edge, grad_receiver, grad_sender, grad_envelope, None, None, None, None,
            *parameters,
        )  # fmt: skip


def messages(
    edge: Tensor,
    at_receiver: Tensor,
    at_sender: Tensor,
    envelope: Tensor | None,
    senders: Tensor,
    receivers: Tensor,
    *,
    first: Tensor,
    parameters: tuple[Tensor, ...],
    activation: str,
    dtype: torch.dtype,
) -> tuple[Tensor, Tensor]:
    return _Messages.apply(
        edge, at_receiver, at_sender, envelope, senders, receivers, activation, dtype, first,
        *parameters,
    )  # fmt: skip

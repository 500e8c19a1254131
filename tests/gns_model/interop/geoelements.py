"""geoelements/gns once more, word for word from its description: what imports are compared with."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

PREFIX = "_encode_process_decode."


def random_state(
    dim: int = 2,
    *,
    types: int = 9,
    embedding: int = 16,
    material: bool = False,
    latent: int = 12,
    hidden: int = 10,
    blocks: int = 2,
    seed: int = 0,
) -> dict[str, Tensor]:
    """A state_dict as it saves one, of any size."""
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator) / shape[-1] ** 0.5

    state: dict[str, Tensor] = {"_particle_type_embedding.weight": random(types, embedding) * 4}
    vertex_inputs = 7 * dim + (embedding if types > 1 else 0) + material
    mlps = {
        "_encoder.node_fn.0.": (vertex_inputs, latent),
        "_encoder.edge_fn.0.": (dim + 1, latent),
        "_decoder.node_fn.": (latent, dim),
    }
    for k in range(blocks):
        mlps[f"_processor.gnn_stacks.{k}.node_fn.0."] = (2 * latent, latent)
        mlps[f"_processor.gnn_stacks.{k}.edge_fn.0."] = (3 * latent, latent)
    for name, (inputs, outputs) in mlps.items():
        widths = [inputs, hidden, hidden, outputs]
        for p in range(3):
            state[f"{PREFIX}{name}NN-{p}.weight"] = random(widths[p + 1], widths[p])
            state[f"{PREFIX}{name}NN-{p}.bias"] = 0.3 * random(widths[p + 1], 1)[:, 0]
        if name.endswith(".0."):
            norm = PREFIX + name.removesuffix("0.") + "1."
            state[norm + "weight"] = 1 + 0.3 * random(outputs, 1)[:, 0]
            state[norm + "bias"] = 0.3 * random(outputs, 1)[:, 0]
    return state


def metadata(dim: int = 2, **changes: Any) -> dict[str, Any]:
    """A metadata.json for it."""
    return {
        "bounds": [[0.1, 0.5 + 0.1 * axis] for axis in range(dim)],
        "sequence_length": 8,
        "default_connectivity_radius": 0.05,
        "dim": dim,
        "dt": 0.0025,
        "vel_mean": [1e-4, -2e-4, 3e-4][:dim],
        "vel_std": [1.5e-3, 2e-3, 1e-3][:dim],
        "acc_mean": [1e-6, -2e-6, 3e-6][:dim],
        "acc_std": [2e-4, 3e-4, 1e-4][:dim],
        **changes,
    }


def mlp(state: dict[str, Tensor], name: str, x: Tensor) -> Tensor:
    """Linear, ReLU, Linear, ReLU, Linear and, for all but the decoder, LayerNorm."""
    for p in range(3):
        weight, bias = (state[f"{PREFIX}{name}NN-{p}.{part}"] for part in ("weight", "bias"))
        x = (x if p == 0 else x.relu()) @ weight.T + bias
    if not name.endswith(".0."):
        return x
    norm = PREFIX + name.removesuffix("0.") + "1."
    x = (x - x.mean(1, keepdim=True)) / (x.var(1, keepdim=True, unbiased=False) + 1e-5).sqrt()
    return x * state[norm + "weight"] + state[norm + "bias"]


def predict(
    state: dict[str, Tensor],
    about: dict[str, Any],
    sequence: Tensor,
    types: Tensor,
    material: Tensor | None,
    *,
    noise_std: float,
    edge_update: str,
) -> tuple[Tensor, Tensor]:
    """Next positions and normalised acceleration in the dtype of `sequence`; graph in float32."""
    dtype = sequence.dtype
    state = {k: v.to(dtype) for k, v in state.items()}
    radius, position = about["default_connectivity_radius"], sequence[:, -1]
    mean = {k: torch.tensor(about[f"{k}_mean"], dtype=dtype) for k in ("vel", "acc")}
    std = {
        k: (torch.tensor(about[f"{k}_std"], dtype=dtype) ** 2 + noise_std**2).sqrt()
        for k in ("vel", "acc")
    }
    at = position.detach().float()
    squared = sum((at[:, None, a] - at[None, :, a]) ** 2 for a in range(at.shape[1]))
    senders, receivers = torch.nonzero(squared < radius**2, as_tuple=True)

    velocity = (sequence[:, 1:] - sequence[:, :-1] - mean["vel"]) / std["vel"]
    lower, upper = torch.tensor(about["bounds"], dtype=dtype).T
    walls = torch.cat([position - lower, upper - position], dim=1) / radius
    limit = about.get("boundary_augment", 1.0)
    parts = [velocity.flatten(1), walls.clamp(-limit, limit)]
    embedding = state["_particle_type_embedding.weight"]
    if len(embedding) > 1:
        parts.append(embedding[types])
    if material is not None:
        parts.append(material[:, None].to(dtype))
    x = mlp(state, "_encoder.node_fn.0.", torch.cat(parts, dim=1))
    apart = (position[senders] - position[receivers]) / radius
    norm = torch.where(
        (senders == receivers)[:, None],
        0.0,
        (apart**2).sum(1, keepdim=True).clamp(min=1e-30).sqrt(),
    )
    e = mlp(state, "_encoder.edge_fn.0.", torch.cat([apart, norm], dim=1))
    block = 0
    while f"{PREFIX}_processor.gnn_stacks.{block}.edge_fn.1.bias" in state:
        stack = f"_processor.gnn_stacks.{block}."
        m = mlp(state, stack + "edge_fn.0.", torch.cat([x[receivers], x[senders], e], dim=1))
        total = torch.zeros_like(x).index_add(0, receivers, m)
        x = x + mlp(state, stack + "node_fn.0.", torch.cat([total, x], dim=1))
        e = 2 * e if edge_update == "doubled" else e + m
        block += 1
    normalised = mlp(state, "_decoder.node_fn.", x)
    acceleration = normalised * std["acc"] + mean["acc"]
    return position + (position - sequence[:, -2]) + acceleration, normalised


def motion(dim: int, points: int = 120, seed: int = 1) -> tuple[Tensor, Tensor, Tensor]:
    """A cloud that moves: sequence (N, 6, D), types (N,) and material (N,)."""
    generator = torch.Generator().manual_seed(seed)
    size = 0.25 if dim == 2 else 0.14
    place = 0.08 + size * torch.rand(points, 1, dim, generator=generator)
    steps = 1.5e-3 * torch.randn(points, 6, dim, generator=generator)
    types = torch.randint(0, 9, (points,), generator=generator)
    material = 0.3 + 0.7 * torch.rand(points, generator=generator)
    return place + steps.cumsum(1), types, material

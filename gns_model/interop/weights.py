"""Weights of geoelements/gns become a model of ours: renamed, columns put in our order.

Theirs and ours are the same function in other conventions:

| theirs | ours |
|---|---|
| metres per step | SI: the statistics are divided by dt and dt² |
| edge: sender - receiver | receiver - sender: those columns change sign |
| vertex input: motion, walls, type, material | motion, walls, material, type |
| vertex update: MLP([sum, vertex]) | MLP([vertex, sum]) |

Sizes are read off the shapes. Radius, bounds, statistics and dt come from `metadata.json`; the
training noise and the rule by which edges go on from block to block are in no file.
"""

from __future__ import annotations

import hashlib
import math
import os
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import ValidationError
from torch import Tensor

from gns_model.errors import FileFormatError, first_fault
from gns_model.interop.metadata import Metadata
from gns_model.learned.config import Limits, ModelConfig
from gns_model.learned.model import LearnedModel
from gns_model.particles import STATIONARY

EdgeUpdate = Literal["residual", "doubled"]
State = dict[str, Tensor]

#: Velocities that their simulator looks at: a constant in their code.
HISTORY = 5

#: Where a training script may have put the state_dict in a larger dictionary.
WRAPPERS = ("state_dict", "model_state_dict", "model_state", "model")

#: A release faster than the mean and this many deviations of the training velocities is unheard of.
SPEED_DEVIATIONS = 5.0

_NETWORK = "_encode_process_decode."
_EMBEDDING = "_particle_type_embedding.weight"


@dataclass(frozen=True)
class Architecture:
    """Sizes of a network, read off the shapes of its weights."""

    dim: int
    latent: int
    hidden: int
    hidden_layers: int
    blocks: int
    types: int  #: that it embeds; 0: none
    type_embedding: int
    material: bool  #: whether a material property is its last input
    vertex_inputs: int


def import_model(
    path: str | os.PathLike[str],
    metadata: str | os.PathLike[str],
    *,
    edge_update: EdgeUpdate,
    noise_std: float,
    dt: float | None = None,
    spacing: float | None = None,
) -> tuple[LearnedModel, dict[str, Any]]:
    """The model in a checkpoint of geoelements/gns, and what a card should say about it.

    Args:
        path: `model-N.pt`, a state_dict, alone or in a larger dictionary.
        metadata: `metadata.json` of its dataset. Of a split one the section `rollout` counts, as
            when geoelements/gns predicts.
        edge_update: "doubled" for weights trained before December 2024, else "residual".
        noise_std: of its training, the option `--noise_std` [m].
        dt: stride [s], where the metadata has none.
        spacing: of the points [m] that a rollout of a scene begins with; default: the paper's
            share of the radius.

    Raises:
        FileFormatError: one line, if a file cannot be read safely, the checkpoint is of another
            architecture, or it and the metadata disagree.
    """
    about = Metadata.read(metadata, "rollout").with_dt(dt)
    state = read_state(path)
    sizes = read_architecture(state, path)
    _check_agreement(sizes, about, path, metadata)
    if noise_std < 0 or not math.isfinite(noise_std):
        raise FileFormatError(f"noise-std must be 0 or positive, got {noise_std}")
    try:
        config = _config(sizes, about, edge_update, noise_std, spacing)
    except ValidationError as error:
        raise FileFormatError(f"{metadata}: {first_fault(error, 'model')}") from None
    model = LearnedModel(config)
    state = _converted(state, sizes)
    buffers = {k: v for k, v in model.state_dict().items() if k not in state}
    model.load_state_dict({**state, **buffers})
    try:
        model.set_normalisation(**_normalisation(about, noise_std))
    except ValueError:
        raise FileFormatError(f"{metadata}: vel_std and acc_std must exceed 0") from None
    assumed = {}
    if about.dt is None:
        assumed["dt"] = f"{about.stride:g} s, as the metadata has none"
    if spacing is None:
        assumed["spacing"] = f"{config.spacing:g} m, the paper's share of the radius"
    assumed["gravity"] = "9.81 m/s² downwards in training"
    card = {
        "imported": {
            "from": "geoelements/gns",
            "file": Path(path).name,
            "sha256": hashlib.sha256(Path(path).read_bytes()).hexdigest(),
            "metadata": about.keys(),
            "assumed": assumed,
        }
    }
    return model, card


def read_state(path: str | os.PathLike[str]) -> State:
    """The tensors in a file that torch wrote, by name. Nothing else in it is ever run.

    Raises:
        FileFormatError: if it is missing or truncated, or holds anything but tensors.
    """
    if not Path(path).is_file():
        raise FileFormatError(f"{path}: no such file")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of torch, on what is about to be refused
            content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file raises nearly anything
        what = re.search(r"Unsupported global: GLOBAL (\S+)", str(error))
        reason = f"it wants {what[1]}, which is no tensor" if what else "truncated or foreign"
        raise FileFormatError(f"{path}: cannot be read safely as a state_dict ({reason})") from None
    for name in WRAPPERS:
        if isinstance(content, dict) and isinstance(content.get(name), dict):
            content = content[name]
            break
    if (
        not isinstance(content, dict)
        or not content
        or not all(isinstance(k, str) and isinstance(v, Tensor) for k, v in content.items())
    ):
        raise FileFormatError(f"{path}: not a state_dict, which holds named tensors and no more")
    if all(k.startswith("module.") for k in content):  # as wrapped for distributed training
        content = {k.removeprefix("module."): v for k, v in content.items()}
    for name, value in content.items():
        if not value.is_floating_point() or not torch.isfinite(value).all():
            raise FileFormatError(f"{path}: {name} holds values that are not finite numbers")
    return {k: v.float() for k, v in content.items()}


def read_architecture(state: State, path: str | os.PathLike[str]) -> Architecture:
    """Sizes of the network in `state`, after a check of every tensor.

    Raises:
        FileFormatError: if it is not a network of geoelements/gns; names the first tensor that is
            missing, too many or of an odd shape.
    """

    def shape(key: str) -> tuple[int, ...]:
        if key not in state or state[key].ndim != 2:
            raise FileFormatError(
                f"{path}: another architecture: no matrix {key!r}, as geoelements/gns has"
            )
        return tuple(state[key].shape)

    layers = len(
        [k for k in state if re.fullmatch(_NETWORK + r"_decoder\.node_fn\.NN-\d+\.weight", k)]
    )
    blocks = {
        int(m[1])
        for k in state
        if (m := re.match(_NETWORK + r"_processor\.gnn_stacks\.(\d+)\.", k))
    }
    hidden, vertex_inputs = shape(_NETWORK + "_encoder.node_fn.0.NN-0.weight")
    dim = shape(f"{_NETWORK}_decoder.node_fn.NN-{max(0, layers - 1)}.weight")[0]
    latent = shape(_NETWORK + "_decoder.node_fn.NN-0.weight")[1]
    types, embedding = shape(_EMBEDDING) if _EMBEDDING in state else (0, 1)
    if types <= 1:
        types = 0  # a single type is not embedded, though its row is in the file
    motion = (HISTORY + 2) * dim + (embedding if types else 0)
    if dim not in (2, 3) or vertex_inputs - motion not in (0, 1) or not blocks or layers < 2:
        raise FileFormatError(
            f"{path}: another architecture: a {dim}D network of geoelements/gns with {types} "
            f"embedded types sees {motion} or {motion + 1} numbers of a vertex, this one "
            f"{vertex_inputs}"
        )
    sizes = Architecture(
        dim=dim,
        latent=latent,
        hidden=hidden,
        hidden_layers=layers - 1,
        blocks=len(blocks),
        types=types,
        type_embedding=embedding,
        material=vertex_inputs > motion,
        vertex_inputs=vertex_inputs,
    )
    expected = {theirs: wanted for theirs, _, wanted in _tensors(sizes)}
    for key, wanted in expected.items():
        found = tuple(state[key].shape) if key in state else None
        if found != wanted:
            what = "is missing" if found is None else f"has shape {found}"
            raise FileFormatError(
                f"{path}: another architecture: {key} {what}, geoelements/gns has {wanted}"
            )
    extra = sorted(set(state) - set(expected) - {_EMBEDDING})
    if extra:
        raise FileFormatError(
            f"{path}: another architecture: {extra[0]} is unknown to geoelements/gns"
        )
    return sizes


def _tensors(sizes: Architecture) -> list[tuple[str, str, tuple[int, ...]]]:
    """Their name, our name and their shape of every tensor in use."""
    latent = sizes.latent
    mlps = [
        ("_encoder.node_fn", "encode_vertex", sizes.vertex_inputs, latent),
        ("_encoder.edge_fn", "encode_edge", sizes.dim + 1, latent),
        ("_decoder.node_fn", "decode", latent, sizes.dim),
    ]
    for k in range(sizes.blocks):
        stack = f"_processor.gnn_stacks.{k}"
        mlps.append((f"{stack}.edge_fn", f"blocks.{k}.edge", 3 * latent, latent))
        mlps.append((f"{stack}.node_fn", f"blocks.{k}.vertex", 2 * latent, latent))
    tensors: list[tuple[str, str, tuple[int, ...]]] = []
    for theirs, ours, inputs, outputs in mlps:
        normed = ours != "decode"
        widths = [inputs, *[sizes.hidden] * sizes.hidden_layers, outputs]
        for p in range(len(widths) - 1):
            name = f"{_NETWORK}{theirs}.{'0.' if normed else ''}NN-{p}"
            own = f"network.{ours}.layers.{p}"
            tensors.append((f"{name}.weight", f"{own}.weight", (widths[p + 1], widths[p])))
            tensors.append((f"{name}.bias", f"{own}.bias", (widths[p + 1],)))
        if normed:
            for part in ("weight", "bias"):
                name = f"{_NETWORK}{theirs}.1.{part}"
                tensors.append((name, f"network.{ours}.norm.{part}", (outputs,)))
    if sizes.types:
        tensors.append((_EMBEDDING, "type_embedding.weight", (sizes.types, sizes.type_embedding)))
    return tensors


def _converted(state: State, sizes: Architecture) -> State:
    """Our names and conventions."""
    ours = {own: state[theirs].clone() for theirs, own, _ in _tensors(sizes)}
    ours["network.encode_edge.layers.0.weight"][:, : sizes.dim] *= -1
    if sizes.material and sizes.types:
        key = "network.encode_vertex.layers.0.weight"
        motion, kind, material = ours[key].split(
            [(HISTORY + 2) * sizes.dim, sizes.type_embedding, 1], dim=1
        )
        ours[key] = torch.cat([motion, material, kind], dim=1)
    for k in range(sizes.blocks):
        key = f"network.blocks.{k}.vertex.layers.0.weight"
        total, vertex = ours[key].split(sizes.latent, dim=1)
        ours[key] = torch.cat([vertex, total], dim=1)
    return ours


def _check_agreement(
    sizes: Architecture,
    about: Metadata,
    path: str | os.PathLike[str],
    metadata: str | os.PathLike[str],
) -> None:
    for key, told, found in (
        ("dim", about.dim, sizes.dim),
        ("nnode_in", about.nnode_in, sizes.vertex_inputs),
        ("nedge_in", about.nedge_in, sizes.dim + 1),
    ):
        if told is not None and told != found:
            raise FileFormatError(
                f"{metadata}: {key} = {told}, but the weights in {path} are for {found}"
            )


def _config(
    sizes: Architecture,
    about: Metadata,
    edge_update: EdgeUpdate,
    noise_std: float,
    spacing: float | None,
) -> ModelConfig:
    speed = math.hypot(*about.vel_mean) + SPEED_DEVIATIONS * math.hypot(*about.vel_std)
    return ModelConfig(
        dim=about.dim,
        spacing=about.usual_spacing if spacing is None else spacing,
        dt=about.stride,
        radius=about.default_connectivity_radius,
        history=HISTORY,
        self_edges=True,
        latent=sizes.latent,
        hidden=None if sizes.hidden == sizes.latent else sizes.hidden,
        hidden_layers=sizes.hidden_layers,
        blocks=sizes.blocks,
        activation="relu",
        edge_update=edge_update,
        envelope=False,
        relative_velocity=False,
        subtract_gravity=False,
        walls="clip",
        wall_clip=about.boundary_augment,
        baffles="points" if sizes.types > STATIONARY else "none",
        project=False,
        types=sizes.types,
        type_embedding=sizes.type_embedding,
        material_features=("tan_friction_angle",) if sizes.material else (),
        noise_std=noise_std,
        limits=Limits(
            max_speed=speed / about.stride,
            release_height=about.bounds[1][1] - about.bounds[1][0],
            gravity=(9.81, 9.81),
            slope=(0.0, 0.0),
        ),
        bounds=about.bounds,
    )


def _normalisation(about: Metadata, noise_std: float) -> dict[str, Tensor]:
    """Statistics in SI units, widened by the training noise: sqrt(std² + noise²)."""

    def widened(std: tuple[float, ...]) -> Tensor:
        return (torch.tensor(std, dtype=torch.float64).square() + noise_std**2).sqrt()

    dt = about.stride
    return {
        "velocity_mean": torch.tensor(about.vel_mean, dtype=torch.float64) / dt,
        "velocity_std": widened(about.vel_std) / dt,
        "acceleration_mean": torch.tensor(about.acc_mean, dtype=torch.float64) / dt**2,
        "acceleration_std": widened(about.acc_std) / dt**2,
    }

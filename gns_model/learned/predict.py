"""One step from bare arrays, the call of geoelements/gns: positions in, next positions out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from gns_model.errors import SimulatorError
from gns_model.learned.config import ModelConfig
from gns_model.learned.model import LearnedModel
from gns_model.learned.world import World
from gns_model.particles import MOVING
from gns_model.scene import Scene

Array = TypeVar("Array", np.ndarray, Tensor)
Bounds = Sequence[Sequence[float]]


def predict_positions(
    model: LearnedModel,
    position_sequence: Array,
    particle_type: np.ndarray | Tensor | Sequence[int] | None = None,
    material: np.ndarray | Tensor | Sequence[float] | float | None = None,
    *,
    scene: Scene | None = None,
    bounds: Bounds | None = None,
) -> Array:
    """As `LearnedSimulator.predict_positions`, which see."""
    config = model.config
    place: dict[str, Any] = {
        "device": model.velocity_std.device,
        "dtype": model.velocity_std.dtype,
    }
    torch_in = isinstance(position_sequence, Tensor)
    history = torch.as_tensor(position_sequence, **place)
    if history.ndim != 3 or history.shape[1:] != (config.history + 1, config.dim):
        raise SimulatorError(
            f"position_sequence must have shape (N, {config.history + 1}, {config.dim}), "
            f"got {tuple(history.shape)}"
        )
    count = len(history)
    world = _world(
        config,
        count,
        _types(config, particle_type, count, place["device"]),
        _per_point(config, material, count, scene, place["device"]),
        scene,
        bounds,
        place,
    )
    if torch_in:
        return model.predict(history, world)  # type: ignore[return-value]
    with torch.inference_mode():
        return model.predict(history, world).cpu().numpy()  # type: ignore[return-value]


def _types(
    config: ModelConfig,
    particle_type: np.ndarray | Tensor | Sequence[int] | None,
    count: int,
    device: torch.device,
) -> Tensor:
    if particle_type is None:
        particle_type = np.full(count, MOVING)
    types = torch.as_tensor(particle_type, device=device)
    if types.shape != (count,) or types.is_floating_point():
        raise SimulatorError(
            f"particle_type must be integers of shape ({count},), got {types.dtype} of shape "
            f"{tuple(types.shape)}"
        )
    types = types.long()
    if config.types and count and not 0 <= int(types.min()) <= int(types.max()) < config.types:
        raise SimulatorError(
            f"particle_type must lie in 0..{config.types - 1}, the types that the model embeds, "
            f"got {int(types.min())} to {int(types.max())}"
        )
    return types


def _per_point(
    config: ModelConfig,
    material: np.ndarray | Tensor | Sequence[float] | float | None,
    count: int,
    scene: Scene | None,
    device: torch.device,
) -> Tensor | None:
    """The material property of every point, checked against what the model sees."""
    features = config.material_features
    if material is not None:
        if "tan_friction_angle" not in features:
            raise SimulatorError("material was given, but the model sees no tan_friction_angle")
        values = torch.as_tensor(material, device=device).float()
        if values.ndim == 0:
            return values.expand(count)
        if values.numel() != count:
            raise SimulatorError(
                f"material must be a number or have shape ({count},), got {tuple(values.shape)}"
            )
        return values.reshape(count)
    if "tan_friction_angle" in features and scene is None:
        raise SimulatorError("the model sees tan_friction_angle: give material, shape (N,)")
    return None


def _world(
    config: ModelConfig,
    count: int,
    types: Tensor,
    material: Tensor | None,
    scene: Scene | None,
    bounds: Bounds | None,
    place: dict[str, Any],
) -> World:
    if scene is not None:
        if scene.dim != config.dim:
            raise SimulatorError(f"the scene is {scene.dim}D and the model {config.dim}D")
        return World.from_scenes(
            [scene], [count], particle_type=types, tan_friction=material, **place
        )
    if config.baffles == "distance" or "base_friction" in config.material_features:
        what = "baffles by their distance" if config.baffles == "distance" else "base_friction"
        raise SimulatorError(f"the model sees {what}, which arrays do not tell: give scene=")
    limits = config.bounds if bounds is None else bounds
    if limits is None:
        raise SimulatorError("where are the walls? The model does not know: give scene= or bounds=")
    if np.shape(limits) != (config.dim, 2) or not all(low < high for low, high in limits):
        raise SimulatorError(f"bounds must be {config.dim} ordered pairs, got {limits}")
    return World.from_bounds(limits, types, tan_friction=material, **place)

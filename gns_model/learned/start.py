"""How a rollout begins: what the model sees of the time before the release."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gns_model.learned.config import ModelConfig
from gns_model.learned.world import baffle_boxes, baffle_points
from gns_model.particles import MOVING, STATIONARY, Points
from gns_model.scene import Scene


@dataclass(frozen=True)
class Start:
    """What a rollout of one scene begins with.

    Attributes:
        history: positions [m], oldest first, shape (N, H + 1, D).
        particle_type: shape (N,).
        rows: how many of the points, from the first, the trajectory is about. Kinematic points
            that stand for baffles of the scene come after them.
        tan_friction: of every point, shape (N,), where it is not the scene's.
    """

    history: Tensor
    particle_type: Tensor
    rows: int
    tan_friction: Tensor | None = None


def start(
    config: ModelConfig,
    scenes: Sequence[Scene],
    points: Sequence[Points],
    centres: Sequence[Tensor] | None = None,
    *,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> list[Start]:
    """Every scene at t = 0.

    Before its release the mass moved as it moves at the release: the history is that motion
    extended backwards. Kinematic points, if the model wants them, come after the moving ones.

    Args:
        points: the moving points of each scene, at the spacing of the model.
        centres: of the baffles, in place of the scenes' own; only kinematic points read it.
    """
    starts = []
    past = torch.arange(config.history, -1, -1, dtype=dtype, device=device)
    for k, (scene, begin) in enumerate(zip(scenes, points, strict=True)):
        position = torch.tensor(begin.positions, dtype=dtype, device=device)
        velocity = torch.tensor(begin.velocities, dtype=dtype, device=device)
        history = position[:, None] - velocity[:, None] * (past * config.dt)[:, None]
        kind = torch.full((len(position),), MOVING, device=device)
        if config.baffles == "points":
            own = centres[k] if centres is not None else None
            boxes = baffle_boxes(scene, own, device=device, dtype=dtype)
            fixed = baffle_points(boxes, config.spacing)
            history = torch.cat([history, fixed[:, None].expand(-1, len(past), -1)])
            kind = torch.cat([kind, kind.new_full((len(fixed),), STATIONARY)])
        starts.append(Start(history, kind, len(position)))
    return starts


def launched(config: ModelConfig, begin: Start, points: Points, velocity: Tensor) -> Start:
    """`begin` with other velocities of the release [m/s], (D,) or (N, D), differentiable in them.

    The points are where they were at t = 0, and the history before it is the new motion.
    """
    own = torch.tensor(points.velocities).to(begin.history)
    change = velocity.to(begin.history) - own
    past = torch.arange(config.history, -1, -1).to(begin.history) * config.dt
    moved = begin.history[: begin.rows] - change[:, None] * past[:, None]
    return replace(begin, history=torch.cat([moved, begin.history[begin.rows :]]))

"""How a rollout begins: what the model sees of the time before the release."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gns_model.errors import SimulatorError
from gns_model.learned.config import ModelConfig
from gns_model.learned.world import baffle_points, baffle_poses
from gns_model.particles import MOVING, STATIONARY, Points, fill, scatter, shaken
from gns_model.scene import Scene

#: Share of the spacing by which a perturbed start displaces the points of a lattice.
PERTURBATION = 0.05


@dataclass(frozen=True)
class Start:
    """What a rollout of one scene begins with.

    Attributes:
        history: positions [m], oldest first, shape (N, H + 1, D).
        particle_type: shape (N,).
        rows: how many of the points, from the first, the trajectory is about. Kinematic points
            that stand for baffles of the scene come after them.
        tan_friction: of every point, shape (N,), where it is not the scene's.
        before: frames of the trajectory that are known already, the last of which ends `history`:
            positions [m], shape (K, rows, D); K = 1 where the rollout begins at t = 0.
    """

    history: Tensor
    particle_type: Tensor
    rows: int
    tan_friction: Tensor | None = None
    before: Tensor | None = None

    @property
    def known(self) -> Tensor:
        """`before`; the current positions where there is none."""
        return self.history[: self.rows, -1][None] if self.before is None else self.before


def start(
    config: ModelConfig,
    scenes: Sequence[Scene],
    points: Sequence[Points],
    centres: Sequence[Tensor] | None = None,
    *,
    sizes: Sequence[Tensor] | None = None,
    yaws: Sequence[Tensor] | None = None,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> list[Start]:
    """Every scene at t = 0.

    Before its release the mass moved as it moves at the release: the history is that motion
    extended backwards. Kinematic points, if the model wants them, come after the moving ones. Where
    the model leaves its first steps to the reference solver (`solver_steps`), they are part of the
    history, too.

    Args:
        points: the moving points of each scene, at the spacing of the model.
        centres, sizes, yaws: of the baffles, in place of the scenes' own; only kinematic points
            read them.
    """
    starts = []
    past = torch.arange(config.history, -1, -1, dtype=dtype, device=device)
    for k, (scene, begin) in enumerate(zip(scenes, points, strict=True)):
        position = torch.tensor(begin.positions, dtype=dtype, device=device)
        velocity = torch.tensor(begin.velocities, dtype=dtype, device=device)
        history = position[:, None] - velocity[:, None] * (past * config.dt)[:, None]
        before = None
        if config.solver_steps:
            solved = solver_frames(config, scene, begin).to(position)
            before = solved[: frame_count(config, scene)]
            history = torch.cat([history[:, :-1], before.transpose(0, 1)], dim=1)
            history = history[:, -len(past) :]
        kind = torch.full((len(position),), MOVING, device=device)
        if config.baffles == "points":
            own = {"centres": centres, "sizes": sizes, "yaws": yaws}
            given: dict[str, Any] = {
                name: values[k] for name, values in own.items() if values is not None
            }
            boxes, turns = baffle_poses(scene, **given, device=device, dtype=dtype)
            fixed = baffle_points(boxes, config.spacing, turns)
            history = torch.cat([history, fixed[:, None].expand(-1, len(past), -1)])
            kind = torch.cat([kind, kind.new_full((len(fixed),), STATIONARY)])
        starts.append(Start(history, kind, len(position), before=before))
    return starts


def shifted(scene: Scene, spacing: float, subcells: int, filling: int, draw: int) -> np.ndarray:
    """Displacements [m], shape (N, D), from the usual start of `scene` to another of the same flow.

    Draw 0 is the usual start. A model of mixed tracers starts from another random choice of them
    (`particles.scatter`); one that starts on a lattice has its points shifted by up to
    `PERTURBATION` of the spacing.
    """
    usual = scatter(fill(scene, spacing), subcells, filling)
    if subcells > 1:
        other = scatter(fill(scene, spacing), subcells, filling + draw)
    else:
        other = shaken(usual, PERTURBATION if draw else 0.0, draw)
    shift: np.ndarray = other.positions - usual.positions
    return shift


def solver_frames(config: ModelConfig, scene: Scene, points: Points) -> Tensor:
    """Frames 0 to `solver_steps` of `scene` by the reference solver, shape (K, N, D) [m], from
    the filling that `points` are."""
    from gns_model.mpm import MpmSimulator

    solver = MpmSimulator(
        spacing=config.spacing,
        frame_interval=config.dt,
        jitter=points.jitter,
        filling=points.filling,
    )
    short = scene.replace(duration=config.solver_steps * config.dt)
    return torch.from_numpy(solver.rollout([short])[0].positions)


def frame_count(config: ModelConfig, scene: Scene) -> int:
    """Number of frames of a rollout of `scene`, the start included."""
    return 1 + max(1, math.floor(scene.duration / config.dt + 1e-6))


def launched(config: ModelConfig, begin: Start, points: Points, velocity: Tensor) -> Start:
    """`begin` with other velocities of the release [m/s], (D,) or (N, D), differentiable in them.

    The points are where they were at t = 0, and the history before it is the new motion.

    Raises:
        SimulatorError: if the model has `solver_steps`.
    """
    if config.solver_steps:
        raise SimulatorError(
            "this model leaves its first steps to the reference solver, so nothing can be "
            "differentiated by the velocity of the release"
        )
    own = begin.history.new_tensor(points.velocities)
    change = velocity.to(begin.history) - own
    steps = torch.arange(config.history, -1, -1, device=begin.history.device)
    past = steps.to(begin.history) * config.dt
    moved = begin.history[: begin.rows] - change[:, None] * past[:, None]
    return replace(begin, history=torch.cat([moved, begin.history[begin.rows :]]))

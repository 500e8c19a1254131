"""Step after step: the loop of a rollout, once for speed and once for gradients."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint as rematerialise

from gns_model.errors import SimulatorError
from gns_model.learned.adjoint import FilterAdjoint
from gns_model.learned.divergence import astray, speed_limit
from gns_model.learned.model import LearnedModel
from gns_model.learned.start import Start, frame_count, launched, start
from gns_model.learned.world import World
from gns_model.particles import Points
from gns_model.scene import Scene
from gns_model.simulator import Progress

#: Points in one batch. On a CPU more would only leave the caches: two flumes of 4,048 points at
#: once cost 10% more than one after the other, four 20% (one thread). A GPU wants to be filled.
BATCH_POINTS = {"cpu": 6_000, "cuda": 400_000}


def groups(sizes: Sequence[int], most: int) -> Iterator[list[int]]:
    """Consecutive indices whose sizes add up to at most `most`, at least one in each group."""
    group: list[int] = []
    for k, size in enumerate(sizes):
        if group and sum(sizes[j] for j in group) + size > most:
            yield group
            group = []
        group.append(k)
    if group:
        yield group


def batch_points(device: torch.device) -> int:
    """Most points of one batch on a device."""
    return BATCH_POINTS.get(device.type, BATCH_POINTS["cuda"])


@torch.inference_mode()
def roll_out(
    model: LearnedModel, scenes: Sequence[Scene], starts: Sequence[Start], advance: Progress
) -> tuple[list[np.ndarray], dict[int, int]]:
    """Run scenes as one block-diagonal batch.

    Args:
        starts: of each scene, on the device and in the dtype of the model.
        advance: called with the fraction done.

    Returns:
        positions [m] of the rows of each start, (T, N, D) float32; and, of the scenes that
        diverged, the first frame that was not good any more: from there on the last good one is
        repeated.
    """
    config = model.config
    frames = [frame_count(config, scene) for scene in scenes]
    out = [
        np.empty((t, s.rows, config.dim), np.float32) for t, s in zip(frames, starts, strict=True)
    ]
    diverged: dict[int, int] = {}
    for found, begin in zip(out, starts, strict=True):
        found[: len(begin.known)] = begin.known.cpu().numpy()
    longest = torch.tensor([speed_limit(s) * config.dt for s in scenes], **place(model))

    running = [k for k, s in enumerate(starts) if frames[k] > len(s.known)]
    if not running:
        advance(1.0)
        return out, diverged
    window = torch.cat([starts[k].history for k in running])
    world = _world([scenes[k] for k in running], [starts[k] for k in running], model)
    for frame in range(len(starts[running[0]].known), max(frames)):
        after = model.step(window, world)
        bad = astray(window[:, -1], after, world, longest[running])
        window = torch.cat([window[:, 1:], after[:, None]], dim=1)
        counts = [len(starts[k].history) for k in running]
        going = []
        for slot, (k, rows) in enumerate(zip(running, after.split(counts), strict=True)):
            if slot in bad:
                diverged[k] = frame
                out[k][frame:] = out[k][frame - 1]
                continue
            out[k][frame] = rows[: starts[k].rows].cpu().numpy()
            if frame + 1 < frames[k]:
                going.append(slot)
        if not going:
            break
        if len(going) < len(running):
            # Scenes that ended or diverged leave the batch; the rest do not notice.
            parts = window.split(counts)
            window = torch.cat([parts[slot] for slot in going])
            running = [running[slot] for slot in going]
            world = _world([scenes[k] for k in running], [starts[k] for k in running], model)
        advance(frame / (max(frames) - 1))
    advance(1.0)
    return out, diverged


def roll_out_tensor(
    model: LearnedModel,
    scenes: Sequence[Scene],
    points: Sequence[Points],
    centres: Sequence[Tensor] | None,
    *,
    frames: int | None,
    checkpoint: bool,
    noise: Sequence[Tensor] | None,
    limit: float | None,
    smoothing: float,
    velocities: Sequence[Tensor] | None = None,
    tan_friction: Sequence[Tensor] | None = None,
    sizes: Sequence[Tensor] | None = None,
    yaws: Sequence[Tensor] | None = None,
) -> list[Tensor]:
    """As `LearnedSimulator.rollout_tensor`, which see."""
    config = model.config
    lengths = [frames or frame_count(config, scene) for scene in scenes]
    poses: dict[str, Any] = {"centres": centres, "sizes": sizes, "yaws": yaws}
    starts = start(config, scenes, points, **poses, **place(model))
    if velocities is not None:
        starts = [
            launched(config, s, p, v) for s, p, v in zip(starts, points, velocities, strict=True)
        ]
    if tan_friction is not None:
        starts = [
            replace(s, tan_friction=t.to(s.history).expand(len(s.history)))
            for s, t in zip(starts, tan_friction, strict=True)
        ]
    moving, histories = [s.rows for s in starts], [s.history for s in starts]
    if noise is not None:
        for history, shift, n in zip(histories, noise, moving, strict=True):
            history[:n] += shift.to(history)[:, None]
    world = _world(scenes, starts, model, **poses)
    begun = len(starts[0].known)
    if any(len(s.known) != begun for s in starts) or min(lengths) < begun:
        raise SimulatorError(
            f"the first {model.config.solver_steps} steps are the solver's: no scene may be shorter"
        )
    counts = [len(h) for h in histories]
    steps = max(lengths) - begun
    rolled = unrolled(
        model, torch.cat(histories), world, counts, steps, limit, smoothing, checkpoint=checkpoint
    )
    # Kinematic points stand still, so any frame of theirs will do for the first ones.
    first = [
        torch.cat([s.known, h[s.rows :, -1].expand(begun, -1, -1)], 1)[:-1]
        for s, h in zip(starts, histories, strict=True)
    ]
    whole = torch.cat([torch.cat(first, dim=1), torch.cat(histories)[None, :, -1], rolled])
    parts = whole.split(counts, dim=1)
    return [p[:t, :n] for p, t, n in zip(parts, lengths, moving, strict=True)]


def unrolled(
    model: LearnedModel,
    history: Tensor,
    world: World,
    counts: Sequence[int],
    steps: int,
    limit: float | None,
    smoothing: float,
    *,
    checkpoint: bool = True,
) -> Tensor:
    """Positions after each of `steps` steps [m], shape (steps, N, D), for autograd.

    Args:
        history: shape (N, H + 1, D) [m].
        counts: points of each scene.
        limit, smoothing: of the adjoints, see `adjoint`.
        checkpoint: compute every step again in the backward pass.
    """
    track, depth = list(history.unbind(1)), model.config.history + 1

    def step(*past: Tensor) -> Tensor:
        return model.step(torch.stack(past, dim=1), world)

    for _ in range(steps):
        past = track[-depth:]
        if checkpoint and torch.is_grad_enabled():
            after = rematerialise(step, *past, use_reentrant=False)
        else:
            after = step(*past)
        if limit is not None or smoothing:
            after = FilterAdjoint.apply(
                after, counts, world.moving, limit, smoothing, model.config.radius
            )
        track.append(after)
    return torch.stack(track[depth:]) if steps else history.new_zeros((0, *history[:, -1].shape))


def place(model: LearnedModel) -> dict[str, Any]:
    """Device and dtype of the positions: those of the model."""
    return {"device": model.velocity_std.device, "dtype": model.velocity_std.dtype}


def _world(
    scenes: Sequence[Scene],
    starts: Sequence[Start],
    model: LearnedModel,
    **poses: Any,
) -> World:
    friction = [s.tan_friction for s in starts if s.tan_friction is not None]
    return World.from_scenes(
        scenes,
        [len(s.history) for s in starts],
        **poses,
        particle_type=torch.cat([s.particle_type for s in starts]),
        tan_friction=torch.cat(friction) if len(friction) == len(starts) else None,
        **place(model),
    )

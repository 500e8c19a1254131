"""Which windows a step trains on, and how they become one block-diagonal batch.

All chance in training comes from generators seeded with (seed, purpose, step, rank): the position
of the sampler is the number of the step, and a resumed run draws what it would have drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor

from gns_model.data.windows import Window, WindowIndex
from gns_model.learned.world import World
from gns_model.particles import STATIONARY
from gns_model.training.augment import mirror_positions, mirrored
from gns_model.training.kinematic import with_baffle_points
from gns_model.training.noise import random_walk, shared_acceleration
from gns_model.training.statistics import Statistics

#: Purposes of random generators.
DRAW, NOISE, UNROLL, REPLAY, FLOWS, REMEMBER, RECALL = 1, 2, 3, 4, 5, 6, 7


@dataclass(frozen=True)
class Draw:
    """One window to read."""

    source: int
    frame: int
    mixture: int  #: seed of the choice of tracers
    mirror: bool
    edges: float  #: that it will have, about
    half: bool = False  #: of a symmetric flow, against a wall in its middle


@dataclass(frozen=True)
class Batch:
    """Windows side by side.

    Attributes:
        history: noisy positions [m], oldest first, shape (N, H+1, D).
        moves: true displacement of each coming step [m], shape (N, K, D).
        world: what surrounds the points.
        moving: mask of the points that the loss is about, shape (N,); None: all.
        back: the part of the first move that leads drifted points back to the truth [m], shape
            (N, D); None: no move has one.
        shared: the part of `history` that is noise shared by neighbours, shape (N, H+1, D); None:
            it has none.
    """

    history: Tensor
    moves: Tensor
    world: World
    moving: Tensor | None = None
    back: Tensor | None = None
    shared: Tensor | None = None


def generator(seed: int, purpose: int, step: int, rank: int = 0) -> np.random.Generator:
    """The random generator of one purpose in one step on one rank."""
    return np.random.default_rng([seed, purpose, step, rank])


def draw(
    index: WindowIndex,
    rng: np.random.Generator,
    *,
    ranks: int,
    edges_per_batch: int,
    statistics: Statistics,
    mirror: bool,
    early: float = 0.0,
    early_steps: int = 8,
    unroll: int = 1,
    halves: bool = False,
) -> list[list[Draw]]:
    """The windows of one step for every rank, so that all have about `edges_per_batch` edges.

    Trajectories, frames and tracers are drawn uniformly, but for a share `early` of the windows
    that come from the first `early_steps` steps of a rollout: a release collapses within a few
    steps, every later step inherits what goes wrong there, and uniform draws hardly ever show it.

    With `halves`, every other window of a symmetric flow is half of it, against a wall.

    Every rank calls this with the same generator and takes its own part. The largest windows are
    dealt first, each to the rank that has the least, so that no rank waits long for another.
    """
    draws: list[Draw] = []
    total = 0.0
    while True:
        source = int(rng.integers(len(index.sources)))
        starts = index.starts(source, unroll)
        stride = index.stride(source)
        if rng.random() < early:
            frame = stride * int(rng.integers(min(early_steps, -(-starts // stride))))
        else:
            frame = int(rng.integers(starts))
        mixture = int(rng.integers(2**31))
        flip = bool(rng.integers(2)) and mirror
        points = len(index.sources[source].residue) // index.residues(source)
        half = halves and index.sources[source].plane is not None and rng.random() < 0.5
        edges = statistics.edges(points, (frame + 0.5) / starts) / (2 if half else 1)
        if len(draws) >= ranks and total + edges / 2 > ranks * edges_per_batch:
            break
        draws.append(Draw(source, frame, mixture, flip, edges, half))
        total += edges
    return deal(draws, ranks)


class _Heavy(Protocol):
    @property
    def edges(self) -> float: ...


Item = TypeVar("Item", bound=_Heavy)


def deal(items: Sequence[Item], ranks: int) -> list[list[Item]]:
    """Share `items` out, the largest first, each to the rank that has the fewest edges."""
    parts: list[list[Item]] = [[] for _ in range(ranks)]
    for item in sorted(items, key=lambda one: -one.edges):
        min(parts, key=lambda part: sum(one.edges for one in part)).append(item)
    return parts


def read(
    index: WindowIndex, item: Draw, *, unroll: int = 1, kinematic: float | None = None
) -> Window:
    """Read what was drawn, halved and mirrored if so drawn.

    Args:
        unroll: number of future steps.
        kinematic: see `kinematic.kinematic_spacing`.
    """
    window = index.read(
        item.source, item.frame, mixture=item.mixture, unroll=unroll, half=item.half
    )
    if item.mirror:
        window = replace(
            window,
            history=mirror_positions(window.history, window.scene),
            future=mirror_positions(window.future, window.scene),
            scene=mirrored(window.scene),
        )
    return window if kinematic is None else with_baffle_points(window, kinematic)


def collate(
    windows: Sequence[Window],
    *,
    noise_std: float,
    rng: np.random.Generator,
    device: torch.device,
    acceleration_noise: float = 0.0,
    spacing: float | None = None,
) -> Batch:
    """Lay windows side by side and add noise (`noise`) to the history of what moves.

    The true displacements are taken between true positions, so that adding one to a noisy position
    corrects the target for the noise: a step that reproduces it ends with the true velocity.

    Raises:
        ValueError: `acceleration_noise` without the `spacing` of the points [m], which it needs.
    """
    history = np.concatenate([w.history for w in windows])
    future = np.concatenate([w.future for w in windows])
    kinds = np.concatenate([w.particle_type for w in windows])
    friction = np.concatenate([w.tan_friction for w in windows])
    moves = np.diff(future, axis=1, prepend=history[:, -1:])
    moving = kinds != STATIONARY
    shared = None
    if acceleration_noise > 0:
        if spacing is None:
            raise ValueError("acceleration_noise needs the spacing of the points")
        each = [shared_acceleration(rng, w.history, spacing, acceleration_noise) for w in windows]
        shared = np.concatenate(each) * moving[:, None, None]
        history = history + shared
    if noise_std > 0:
        points, frames, dim = history.shape
        noise = random_walk(rng, points, frames - 1, dim, noise_std)
        history = history + noise * moving[:, None, None]
    world = World.from_scenes(
        [w.scene for w in windows],
        [len(w.history) for w in windows],
        device=device,
        particle_type=torch.from_numpy(kinds).to(device),
        tan_friction=torch.from_numpy(friction).to(device),
    )
    return Batch(
        torch.from_numpy(history).to(device),
        torch.from_numpy(moves).to(device),
        world,
        None if moving.all() else torch.from_numpy(moving).to(device),
        shared=None if shared is None else torch.from_numpy(shared).to(device),
    )

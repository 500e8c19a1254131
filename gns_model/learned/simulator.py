"""The learned simulator: scenes in, trajectories out, all scenes of a batch in one graph."""

from __future__ import annotations

import copy
import math
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint as rematerialise

from gns_model.errors import SimulatorError
from gns_model.learned.model import LearnedModel
from gns_model.learned.world import World, baffle_boxes, baffle_points
from gns_model.particles import MOVING, STATIONARY, Points, fill
from gns_model.scene import Scene
from gns_model.simulator import Progress
from gns_model.trajectory import DIVERGED, OK, Trajectory

#: Points in one batch. On a CPU more would only leave the caches; a GPU wants to be filled.
BATCH_POINTS = {"cpu": 16_000, "cuda": 400_000}

#: A grain this many times faster than release and fall could make it has diverged.
_SPEED_MARGIN = 4.0


class LearnedSimulator:
    """A trained model as a simulator.

    Args:
        model: is copied, so that training may go on with the original.
        name: written into the trajectories.
        card: what is known about the model.
        threads: torch threads on the CPU during a rollout; default: as torch is set.
        workers: processes that share the scenes of a rollout, on the CPU, one thread each.
        precision: "bfloat16" makes the products over edges in that dtype: a little faster on a
            CPU, much on a GPU, at half a percent of error in each step's acceleration.
    """

    def __init__(
        self,
        model: LearnedModel,
        name: str = "learned",
        card: dict[str, Any] | None = None,
        *,
        threads: int | None = None,
        workers: int = 1,
        precision: str = "float32",
    ) -> None:
        if precision not in ("float32", "bfloat16"):
            raise SimulatorError(f"precision must be float32 or bfloat16, got {precision!r}")
        for option, value in (("threads", threads), ("workers", workers)):
            if value is not None and value < 1:
                raise SimulatorError(f"{option} must be at least 1, got {value}")
        self.model = copy.deepcopy(model).eval().requires_grad_(False)
        self.config = self.model.config
        self.name = name
        self.card = dict(card or {})
        self.threads = threads
        self.workers = workers
        self.precision = precision
        self._warned: set[str] = set()
        self._pool: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_pool": None}  # a copy starts processes of its own

    @property
    def device(self) -> torch.device:
        """Where the model runs."""
        return self.model.velocity_std.device

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the positions: that of the model."""
        return self.model.velocity_std.dtype

    def check(self, scene: Scene) -> None:
        """Refuse a scene that this model cannot run, and warn, once, of what it never saw.

        Raises:
            SimulatorError: if the dimension is another.
            SceneError: if a release is thinner than the spacing of the model.
        """
        if scene.dim != self.config.dim:
            raise SimulatorError(
                f"{self.name} is a {self.config.dim}D model and the scene {scene.name!r} is "
                f"{scene.dim}D"
            )
        for release in scene.releases:
            if min(release.size) < self.config.spacing:
                fill(scene, self.config.spacing)  # raises the error that names the release
        for line in self.config.limits.broken_by(scene):
            if line not in self._warned:
                self._warned.add(line)
                warnings.warn(
                    f"scene {scene.name!r} is outside what {self.name} was trained on: {line}",
                    stacklevel=2,
                )

    # -- rollouts ------------------------------------------------------------------------------

    def rollout(
        self, scenes: Sequence[Scene], *, progress: Progress | None = None
    ) -> list[Trajectory]:
        """Simulate every scene for its duration, with a frame every `config.dt` from t = 0.

        A scene in which a point becomes non-finite, absurdly fast or leaves for far away ends with
        status "diverged", its last good frame repeated; the others go on as if alone.

        Returns:
            one trajectory a scene, in order; positions (T, N, D) float32 of the moving points.

        Raises:
            SimulatorError, SceneError: as `check`.
        """
        scenes = list(scenes)
        for scene in scenes:
            self.check(scene)
        if self.workers > 1 and len(scenes) > 1 and self.device.type == "cpu":
            return self._share(scenes, progress)
        points = [fill(scene, self.config.spacing) for scene in scenes]
        work = [len(p.positions) * self.frames(s) for s, p in zip(scenes, points, strict=True)]
        total, done = max(1, sum(work)), 0.0
        trajectories: list[Trajectory] = []
        for group in groups([len(p.positions) for p in points], self._batch_points()):
            share = sum(work[k] for k in group)

            def advance(fraction: float, done: float = done, share: float = share) -> None:
                if progress is not None:
                    progress(min(1.0, (done + fraction * share) / total))

            with self._settings(), torch.inference_mode():
                trajectories += self._rollout_batch(
                    [scenes[k] for k in group], [points[k] for k in group], advance
                )
            done += share
        return trajectories

    def _share(self, scenes: list[Scene], progress: Progress | None) -> list[Trajectory]:
        from gns_model.learned.workers import WorkerPool  # it imports this module

        if self._pool is None:
            self._pool = WorkerPool(self, self.workers)
        try:
            return self._pool.rollout(scenes, progress)
        except BaseException:
            self._pool = None
            raise

    def close(self) -> None:
        """End the worker processes, if any run. The next rollout would start new ones."""
        if self._pool is not None:
            self._pool.close()
            self._pool = None

    def frames(self, scene: Scene) -> int:
        """Number of frames of a rollout of `scene`, the start included."""
        return 1 + max(1, math.floor(scene.duration / self.config.dt + 1e-6))

    @contextmanager
    def _settings(self) -> Iterator[None]:
        before = torch.get_num_threads()
        try:
            if self.threads is not None:
                torch.set_num_threads(self.threads)
            short = self.precision == "bfloat16"
            with torch.autocast(self.device.type, torch.bfloat16, enabled=short):
                yield
        finally:
            if self.threads is not None:
                torch.set_num_threads(before)

    def _batch_points(self) -> int:
        return BATCH_POINTS.get(self.device.type, BATCH_POINTS["cuda"])

    def _rollout_batch(
        self, scenes: list[Scene], points: list[Points], advance: Progress
    ) -> list[Trajectory]:
        began = time.perf_counter()
        moving = [len(p.positions) for p in points]
        frames = [self.frames(scene) for scene in scenes]
        dim = self.config.dim
        out = [np.empty((t, n, dim), np.float32) for t, n in zip(frames, moving, strict=True)]
        diverged: dict[int, int] = {}
        histories, types = self._start(scenes, points)
        for k, history in enumerate(histories):
            out[k][0] = history[: moving[k], -1].cpu().numpy()

        running = list(range(len(scenes)))
        world = self._world(scenes, histories, types)
        window = torch.cat(histories)
        for frame in range(1, max(frames)):
            after = self.model.step(window, world)
            bad = self._diverged(window[:, -1], after, world, [scenes[k] for k in running])
            window = torch.cat([window[:, 1:], after[:, None]], dim=1)
            sizes = [len(histories[k]) for k in running]
            going = []
            for slot, (k, rows) in enumerate(zip(running, after.split(sizes), strict=True)):
                if slot in bad:
                    diverged[k] = frame
                    out[k][frame:] = out[k][frame - 1]
                    continue
                out[k][frame] = rows[: moving[k]].cpu().numpy()
                if frame + 1 < frames[k]:
                    going.append(slot)
            if len(going) < len(running):
                # Scenes that ended or diverged leave the batch; the rest do not notice.
                parts = window.split(sizes)
                running = [running[slot] for slot in going]
                if not running:
                    break
                window = torch.cat([parts[slot] for slot in going])
                world = self._world(
                    [scenes[k] for k in running],
                    [histories[k] for k in running],
                    [types[k] for k in running],
                )
            advance(frame / (max(frames) - 1))
        advance(1.0)
        seconds = time.perf_counter() - began
        return [
            self._trajectory(scene, points[k], out[k], diverged.get(k), seconds / len(scenes))
            for k, scene in enumerate(scenes)
        ]

    def _trajectory(
        self,
        scene: Scene,
        points: Points,
        positions: np.ndarray,
        diverged: int | None,
        seconds: float,
    ) -> Trajectory:
        settings: dict[str, Any] = {
            "spacing": self.config.spacing,
            "dt": self.config.dt,
            "seconds": round(seconds, 4),
        }
        if diverged is not None:
            settings["diverged_at"] = diverged * self.config.dt
        return Trajectory(
            positions=positions,
            time=np.arange(len(positions)) * self.config.dt,
            particle_type=np.full(positions.shape[1], MOVING, np.int8),
            scene=scene,
            point_volume=points.volume,
            simulator=self.name,
            status=OK if diverged is None else DIVERGED,
            settings=settings,
            lattice=points.lattice,
        )

    def _start(
        self,
        scenes: Sequence[Scene],
        points: Sequence[Points],
        centres: Sequence[Tensor] | None = None,
    ) -> tuple[list[Tensor], list[Tensor]]:
        """History (N, H + 1, D) and particle types (N,) of every scene at t = 0.

        Before its release the mass moved as it moves at the release: the history is that motion
        extended backwards. Kinematic points, if the model wants them, come last.
        """
        config, histories, types = self.config, [], []
        past = torch.arange(config.history, -1, -1, dtype=self.dtype, device=self.device)
        for k, (scene, start) in enumerate(zip(scenes, points, strict=True)):
            position = torch.tensor(start.positions, dtype=self.dtype, device=self.device)
            velocity = torch.tensor(start.velocities, dtype=self.dtype, device=self.device)
            history = position[:, None] - velocity[:, None] * (past * config.dt)[:, None]
            kind = torch.full((len(position),), MOVING, device=self.device)
            if config.baffles == "points":
                own = centres[k] if centres is not None else None
                boxes = baffle_boxes(scene, own, device=self.device, dtype=self.dtype)
                fixed = baffle_points(boxes, config.spacing)
                history = torch.cat([history, fixed[:, None].expand(-1, len(past), -1)])
                kind = torch.cat([kind, kind.new_full((len(fixed),), STATIONARY)])
            histories.append(history)
            types.append(kind)
        return histories, types

    def _world(
        self,
        scenes: Sequence[Scene],
        histories: Sequence[Tensor],
        types: Sequence[Tensor],
        centres: Sequence[Tensor] | None = None,
    ) -> World:
        return World.from_scenes(
            scenes,
            [len(h) for h in histories],
            device=self.device,
            dtype=self.dtype,
            centres=centres,
            particle_type=torch.cat(list(types)),
        )

    def _diverged(
        self, now: Tensor, after: Tensor, world: World, scenes: Sequence[Scene]
    ) -> set[int]:
        """Slots of the scenes in the batch that have gone astray in this step."""
        reach = torch.tensor([_furthest_step(s) for s in scenes], dtype=self.dtype).to(now.device)
        size = world.point_upper - world.point_lower
        step = (after - now).square().sum(1).sqrt()
        # Written so that NaN, which compares false, counts as astray.
        sane = (step <= reach[world.batch] * self.config.dt) & (
            (after >= world.point_lower - size) & (after <= world.point_upper + size)
        ).all(1)
        if bool(sane.all()):
            return set()
        return set(world.batch[~sane].unique().tolist())

    # -- gradients -----------------------------------------------------------------------------

    def rollout_tensor(
        self,
        scenes: Sequence[Scene],
        centres: Sequence[Tensor] | None = None,
        *,
        frames: int | None = None,
        checkpoint: bool = True,
        noise: Sequence[Tensor] | None = None,
    ) -> list[Tensor]:
        """A rollout that autograd can differentiate with respect to the baffles.

        Nothing is caught here: a rollout that diverges returns what it computed.

        Args:
            scenes: one batch; all are run together.
            centres: plan centres of the baffles [m], a tensor (B, D-1) for each scene, in place of
                the scene's own; sizes stay.
            frames: number of frames to return, the start included; default: as long as each scene.
            checkpoint: recompute every step in the backward pass, so that memory holds positions
                and the inside of one step only.
            noise: displacement of the starting points [m], a tensor (N, D) for each scene.

        Returns:
            positions [m], (T, N, D) for each scene, in the dtype of the model.

        Raises:
            SimulatorError, SceneError: as `check`.
        """
        scenes = list(scenes)
        for scene in scenes:
            self.check(scene)
        points = [fill(scene, self.config.spacing) for scene in scenes]
        moving = [len(p.positions) for p in points]
        lengths = [frames or self.frames(scene) for scene in scenes]
        with self._settings():
            histories, types = self._start(scenes, points, centres)
            if noise is not None:
                for history, shift, n in zip(histories, noise, moving, strict=True):
                    history[:n] += shift.to(history)[:, None]
            world = self._world(scenes, histories, types, centres)
            track = list(torch.cat(histories).unbind(1))
            depth = self.config.history + 1

            def step(*past: Tensor) -> Tensor:
                return self.model.step(torch.stack(past, dim=1), world)

            for _ in range(1, max(lengths)):
                past = track[-depth:]
                if checkpoint and torch.is_grad_enabled():
                    after = rematerialise(step, *past, use_reentrant=False)
                else:
                    after = step(*past)
                track.append(after)
        whole = torch.stack(track[depth - 1 :])
        parts = whole.split([len(h) for h in histories], dim=1)
        return [p[:t, :n] for p, t, n in zip(parts, lengths, moving, strict=True)]


def _furthest_step(scene: Scene) -> float:
    """A speed [m/s] that no grain of `scene` can have, by a wide margin."""
    fall = math.sqrt(2 * math.hypot(*scene.gravity) * math.hypot(*scene.domain.size))
    return _SPEED_MARGIN * (max(math.hypot(*r.velocity) for r in scene.releases) + fall)


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

"""The learned simulator: scenes in, trajectories out, all scenes of a batch in one graph."""

from __future__ import annotations

import copy
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor

from gns_model.errors import SimulatorError
from gns_model.learned import scope
from gns_model.learned.model import LearnedModel
from gns_model.learned.precision import Precision, is_short
from gns_model.learned.predict import Array, Bounds, predict_positions
from gns_model.learned.rollout import batch_points, groups, place, roll_out, roll_out_tensor
from gns_model.learned.start import Start, frame_count, shifted, start
from gns_model.particles import MOVING, Points, check_filling, fill, scatter, shaken
from gns_model.scene import Scene
from gns_model.simulator import Progress
from gns_model.trajectory import DIVERGED, OK, Trajectory


class LearnedSimulator:
    """A trained model as a simulator.

    Args:
        model: is copied, so that training may go on with the original.
        name: written into the trajectories.
        card: what is known about the model.
        threads: torch threads on the CPU during a rollout; default: as torch is set.
        workers: processes that share the scenes of a rollout, on the CPU, one thread each.
        precision: "bfloat16" makes the products over edges in that dtype: a little faster on a
            CPU that has instructions for it (several times slower on one that has none), much on a
            GPU, at half a percent of error in each step's acceleration. "auto": where it is faster.
        filling: seed of the places in their cells that points start from; of no effect on a model
            without `subcells` unless there is `jitter`.
        jitter: how far the points of the start are moved off their lattice, in spacings; below a
            half of one; default: as in what the model was trained on (`ModelConfig.jitter`). The
            reference solver with the same `jitter` and `filling` starts likewise.
    """

    def __init__(
        self,
        model: LearnedModel,
        name: str = "learned",
        card: dict[str, Any] | None = None,
        *,
        threads: int | None = None,
        workers: int = 1,
        precision: Precision = "float32",
        filling: int = 0,
        jitter: float | None = None,
    ) -> None:
        if precision not in get_args(Precision):
            raise SimulatorError(f"precision must be float32, bfloat16 or auto, got {precision!r}")
        for option, value in (("threads", threads), ("workers", workers)):
            if value is not None and value < 1:
                raise SimulatorError(f"{option} must be at least 1, got {value}")
        self.model = copy.deepcopy(model).eval().requires_grad_(False)
        self.config = self.model.config
        self.name = name
        self.card = dict(card or {})
        self.threads = threads
        self.workers = workers
        self.precision: Precision = "bfloat16" if is_short(precision, self.device) else "float32"
        jitter = self.config.jitter if jitter is None else jitter
        check_filling(jitter, filling)
        self.filling, self.jitter = filling, jitter
        self._warned: set[str] = set()
        self._pool: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_pool": None}  # a copy starts processes of its own

    @property
    def device(self) -> torch.device:
        """Where the model runs."""
        return self.model.velocity_std.device

    def check(self, scene: Scene) -> None:
        """Refuse a scene that this model cannot run, and warn, once, of what it never saw.

        Raises:
            SimulatorError: if the dimension is another.
            SceneError: if a release is thinner than the spacing of the model.
        """
        scope.require(self.config, self.name, scene)
        for line in self.outside(scene):
            limit = line.split(" = ")[0]  # once for each limit, however many scenes pass it
            if limit not in self._warned:
                self._warned.add(limit)
                warnings.warn(
                    f"scene {scene.name!r} is outside what {self.name} was trained on: {line}",
                    stacklevel=2,
                )

    def outside(self, scene: Scene) -> list[str]:
        """One line for everything in which a rollout of `scene` is unlike the training flows."""
        foreign = self.config.foreign_start(self.jitter)
        return self.config.limits.broken_by(scene) + ([foreign] if foreign else [])

    def _fill(self, scene: Scene) -> Points:
        points = scatter(fill(scene, self.config.spacing), self.config.subcells, self.filling)
        return shaken(points, self.jitter, self.filling) if self.jitter else points

    def refilled(self, jitter: float, filling: int) -> LearnedSimulator:
        """The same model on starts off their lattice, see the arguments of the class."""
        check_filling(jitter, filling)
        other = copy.copy(self)
        other.filling, other.jitter = filling, jitter
        return other

    def perturbed_start(self, scene: Scene, draw: int) -> Tensor:
        """Displacements [m], shape (N, D), to another start of the same flow, for `noise`; draw 0
        is the usual start. See `start.shifted`."""
        shift = shifted(scene, self.config.spacing, self.config.subcells, self.filling, draw)
        return torch.from_numpy(shift).to(**place(self.model))

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
        points = [self._fill(scene) for scene in scenes]
        work = [
            len(p.positions) * frame_count(self.config, scene)
            for scene, p in zip(scenes, points, strict=True)
        ]
        total, done = max(1, sum(work)), 0.0
        trajectories: list[Trajectory] = []
        for group in groups([len(p.positions) for p in points], batch_points(self.device)):
            share = sum(work[k] for k in group)

            def advance(fraction: float, done: float = done, share: float = share) -> None:
                if progress is not None:
                    progress(min(1.0, (done + fraction * share) / total))

            began = time.perf_counter()
            with self._settings():
                chosen = [scenes[k] for k in group]
                starts = start(self.config, chosen, [points[k] for k in group], **place(self.model))
                positions, diverged = roll_out(self.model, chosen, starts, advance)
            seconds = (time.perf_counter() - began) / len(group)
            for j, k in enumerate(group):
                found = self._trajectory(scenes[k], points[k].volume, positions[j], diverged.get(j))
                found.settings["seconds"] = round(seconds, 4)
                found.lattice = points[k].lattice
                trajectories.append(found)
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

    def rollout_from(
        self,
        scene: Scene,
        history: np.ndarray,
        particle_type: np.ndarray,
        tan_friction: np.ndarray | None = None,
        *,
        frames: int | None = None,
        progress: Progress | None = None,
    ) -> Trajectory:
        """Simulate on from points in motion instead of from the releases of `scene`.

        Args:
            scene: domain, gravity and baffles. Its releases are not filled.
            history: positions [m], oldest first, one `config.dt` apart, shape (N, H + 1, D).
            particle_type: shape (N,); points of type 3 stay where they are.
            tan_friction: of every point, shape (N,); default: the scene's.
            frames: number of frames, the last of the history included; default: the scene's
                duration.
            progress: called with the fraction done.

        Returns:
            all N points, in order; it may end "diverged", as with `rollout`.

        Raises:
            SimulatorError: if dimension or shapes do not fit the model.
        """
        config = self.config
        shape = (len(particle_type), config.history + 1, config.dim)
        if history.shape != shape or scene.dim != config.dim:
            raise SimulatorError(
                f"history must have shape {shape} in a {config.dim}D scene, got {history.shape} "
                f"in a {scene.dim}D one"
            )
        if frames is not None:
            scene = scene.replace(duration=max(1, frames - 1) * config.dt)
        at = place(self.model)
        friction = None if tan_friction is None else torch.from_numpy(tan_friction).to(**at)
        begin = Start(
            torch.from_numpy(history).to(**at),
            torch.from_numpy(particle_type).to(at["device"], torch.int64),
            len(history),
            friction,
        )
        began = time.perf_counter()
        with self._settings():
            positions, diverged = roll_out(
                self.model, [scene], [begin], progress or (lambda _fraction: None)
            )
        seconds = time.perf_counter() - began
        found = self._trajectory(scene, config.spacing**config.dim, positions[0], diverged.get(0))
        found.settings["seconds"] = round(seconds, 4)
        found.particle_type = particle_type.astype(np.int8)
        return found

    def _trajectory(
        self, scene: Scene, point_volume: float, positions: np.ndarray, diverged: int | None
    ) -> Trajectory:
        settings: dict[str, Any] = {
            "spacing": self.config.spacing, "dt": self.config.dt,
            "jitter": self.jitter, "filling": self.filling,
        }  # fmt: skip
        if diverged is not None:
            settings["diverged_at"] = diverged * self.config.dt
        return Trajectory(
            positions=positions,
            time=np.arange(len(positions)) * self.config.dt,
            particle_type=np.full(positions.shape[1], MOVING, np.int8),
            scene=scene,
            point_volume=point_volume,
            simulator=self.name,
            status=OK if diverged is None else DIVERGED,
            settings=settings,
        )

    # -- one step ------------------------------------------------------------------------------

    def predict_positions(
        self,
        position_sequence: Array,
        particle_type: np.ndarray | Tensor | Sequence[int] | None = None,
        material: np.ndarray | Tensor | Sequence[float] | float | None = None,
        *,
        scene: Scene | None = None,
        bounds: Bounds | None = None,
    ) -> Array:
        """Positions one step later, from the last ones: the call of geoelements/gns.

        As there, stationary points (type 3) get the network's answer like all others; who knows
        where they are puts them there.

        Args:
            position_sequence: [m], oldest first, one `config.dt` apart, shape (N, H + 1, D).
            particle_type: shape (N,); default: all of type 6, which moves.
            material: tan of the friction angle, shape (N,) or one number; needed by models that
                see it unless there is a scene.
            scene: what the points move in. Models that see baffles by their distance need it.
            bounds: lowest and highest coordinate of the domain [m], shape (D, 2); default: those
                of the scene, else those that the model was trained in.

        Returns:
            positions [m], shape (N, D), in the dtype of the model: an array for an array, a tensor
            for a tensor, which autograd can differentiate.

        Raises:
            SimulatorError: one line on what does not fit the model or is missing.
        """
        with self._settings():
            return predict_positions(
                self.model, position_sequence, particle_type, material, scene=scene, bounds=bounds
            )

    # -- gradients -----------------------------------------------------------------------------

    def rollout_tensor(
        self,
        scenes: Sequence[Scene],
        centres: Sequence[Tensor] | None = None,
        *,
        frames: int | None = None,
        checkpoint: bool = True,
        noise: Sequence[Tensor] | None = None,
        limit: float | None = None,
        smoothing: float = 0.0,
        velocities: Sequence[Tensor] | None = None,
        tan_friction: Sequence[Tensor] | None = None,
        sizes: Sequence[Tensor] | None = None,
        yaws: Sequence[Tensor] | None = None,
    ) -> list[Tensor]:
        """A rollout that autograd can differentiate: in the baffles, the release or the friction.

        Nothing is caught here: a rollout that diverges returns what it computed.

        Args:
            scenes: one batch; all are run together.
            centres: plan centres of the baffles [m], a tensor (B, D-1) for each scene, in place of
                the scene's own.
            frames: number of frames to return, the start included; default: as long as each scene.
            checkpoint: recompute every step in the backward pass, so that memory holds positions
                and the inside of one step only.
            noise: displacement of the starting points [m], a tensor (N, D) for each scene.
            limit: of a grain's adjoint in every step, see `adjoint`; default: none.
            smoothing: of the adjoints of neighbours in every step, likewise. With neither the
                gradient is exact, which over a whole flow says little about a finite move.
            velocities: of the points at their release [m/s], a tensor (D,) or (N, D) for each
                scene, in place of the scene's.
            tan_friction: tan of the friction angle, a tensor () or (N,) for each scene, in place of
                the scene's; the model has to see it.
            sizes: of the baffles [m], a tensor (B, D) for each scene, in place of the scene's.
            yaws: of the baffles [degrees], a tensor (B,) for each scene, in place of the scene's;
                3D only.

        Returns:
            positions [m], (T, N, D) for each scene, in the dtype of the model.

        Raises:
            SimulatorError, SceneError: as `check`; or for a friction that the model does not see.
        """
        scenes = list(scenes)
        for scene in scenes:
            self.check(scene)
        if tan_friction is not None and "tan_friction_angle" not in self.config.material_features:
            raise SimulatorError(f"{self.name} does not see the friction angle")
        if yaws is not None and self.config.dim != 3:
            raise SimulatorError("only baffles in 3D can be turned")
        points = [self._fill(scene) for scene in scenes]
        with self._settings():
            return roll_out_tensor(
                self.model,
                scenes,
                points,
                centres,
                frames=frames,
                checkpoint=checkpoint,
                noise=noise,
                limit=limit,
                smoothing=smoothing,
                velocities=velocities,
                tan_friction=tan_friction,
                sizes=sizes,
                yaws=yaws,
            )

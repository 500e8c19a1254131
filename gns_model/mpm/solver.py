"""The reference solver: scenes in, trajectories out."""

from __future__ import annotations

import math
import multiprocessing
import os
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any

import numba
import numpy as np

from gns_model.errors import SimulatorError
from gns_model.mpm.contact import SKIN, solid_nodes
from gns_model.mpm.material import material_constants, wave_speed
from gns_model.mpm.transfer import (
    COLUMNS,
    NODE_COLUMNS,
    PADDING,
    POSITION,
    Lattice,
    advance,
    advance_serial,
)
from gns_model.particles import MOVING, fill
from gns_model.scene import Scene
from gns_model.simulator import Progress
from gns_model.trajectory import DIVERGED, OK, Trajectory

#: Points along one edge of an element of the grid.
POINTS_PER_EDGE = 2
#: Spacings that give the paper's elements, 0.025 m in 2D and 0.03125 m in 3D. (In 3D its points
#: too, 262,144/m³; in 2D it has 4 along an edge, which runs some 10% farther at equal friction.)
DEFAULT_SPACING = {2: 0.0125, 3: 0.015625}
#: Rate at which a point's velocity leans to the grid's [1/s] (findings: results then depend on
#: neither the number of substeps nor E).
DAMPING_RATE = 50.0
#: A point this many times faster than gravity can make it has left physics: the rollout diverged.
ABSURD = 10.0

# numba's OpenMP layer sets the number of threads of the whole process, torch's included, whose
# one-thread rollouts then fight for all cores, many times slower. Its own layer leaves torch
# alone; it takes one caller at a time, which the lock sees to.
if "NUMBA_THREADING_LAYER" not in os.environ:
    numba.config.THREADING_LAYER = "workqueue"  # type: ignore[attr-defined]
_ONE_CALLER = threading.Lock()


class MpmSimulator:
    """Explicit MPM on the CPU, float64, in 3D and 2D plane strain.

    Args:
        spacing: distance between material points [m]; an element of the grid is two of them
            wide. Default: 0.015625 in 3D and 0.0125 in 2D, which gives the paper's elements.
        frame_interval: time between stored frames [s].
        cfl: share of the stable substep that is used.
        threads: threads of one rollout; results do not depend on it. Default 1.
        workers: processes that roll out several scenes side by side, one thread each.
        damping_rate: see DAMPING_RATE [1/s].
    """

    name = "mpm"

    def __init__(
        self,
        *,
        spacing: float | None = None,
        frame_interval: float = 0.01,
        cfl: float = 0.4,
        threads: int = 1,
        workers: int = 1,
        damping_rate: float = DAMPING_RATE,
    ) -> None:
        self.spacing = spacing
        self.frame_interval = frame_interval
        self.cfl = cfl
        self.threads = threads
        self.workers = workers
        self.damping_rate = damping_rate
        for key in ("spacing", "frame_interval", "cfl", "threads", "workers"):
            value = getattr(self, key)
            if value is not None and not value > 0:
                raise SimulatorError(f"{key} must be positive, got {value}")
        if not damping_rate >= 0:
            raise SimulatorError(f"damping_rate must not be negative, got {damping_rate}")

    def settings(self) -> dict[str, Any]:
        """The arguments that this simulator was made with."""
        keys = ("spacing", "frame_interval", "cfl", "threads", "workers", "damping_rate")
        return {key: getattr(self, key) for key in keys}

    def check(self, scene: Scene) -> None:
        """Raise SimulatorError if `scene` would not fit in memory."""
        dx = POINTS_PER_EDGE * self._spacing(scene)
        nodes = math.prod(s / dx + 5 for s in scene.domain.size)
        if nodes > 2e8:
            raise SimulatorError(
                f"a grid of {nodes:.0f} nodes ({dx:g} m apart) is too large: raise the spacing"
            )

    def rollout(
        self, scenes: Sequence[Scene], *, progress: Progress | None = None
    ) -> list[Trajectory]:
        """Simulate every scene for its duration.

        Args:
            scenes: any mixture of 2D and 3D.
            progress: called with the fraction done.

        Returns:
            One trajectory a scene, in order. A rollout that blows up has status "diverged" and
            repeats its last good frame.
        """
        for scene in scenes:
            self.check(scene)
        total = max(len(scenes), 1)
        if self.workers == 1 or len(scenes) == 1:
            results = []
            for n, scene in enumerate(scenes):
                inner = None
                if progress is not None:
                    inner = lambda f, n=n: progress((n + f) / total)  # noqa: E731
                results.append(self._rollout_one(scene, inner))
            return results
        single = {**self.settings(), "workers": 1, "threads": 1}
        # spawn: a forked process would inherit threads of torch and numba in an unknown state.
        context = multiprocessing.get_context("spawn")
        done: dict[int, Trajectory] = {}
        with ProcessPoolExecutor(
            min(self.workers, len(scenes)), mp_context=context, initializer=_one_thread
        ) as pool:
            jobs = {pool.submit(_rollout_job, single, s): n for n, s in enumerate(scenes)}
            try:
                for job in as_completed(jobs):
                    done[jobs[job]] = job.result()
                    if progress is not None:
                        progress(len(done) / total)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
        return [done[n] for n in range(len(scenes))]

    def _rollout_one(self, scene: Scene, progress: Progress | None) -> Trajectory:
        started = time.perf_counter()
        dim = scene.dim
        spacing = self._spacing(scene)
        start = fill(scene, spacing)
        count = len(start.positions)
        points = np.zeros((count, COLUMNS))
        points[:, POSITION : POSITION + dim] = start.positions
        points[:, 3 : 3 + dim] = start.velocities
        ids = np.arange(count)
        lattice, lower, upper = _lattice(scene, POINTS_PER_EDGE * spacing)
        boxes = np.zeros((len(scene.baffles), 2, 3))
        boxes[:, :, :dim] = scene.baffle_boxes()
        boxes[:, 0] -= SKIN
        boxes[:, 1] += SKIN
        solid = solid_nodes(lattice, boxes, 0.5 * lattice.dx, lower, upper)
        grid = np.zeros((len(solid), NODE_COLUMNS))
        gravity = np.zeros(3)
        gravity[:dim] = scene.gravity

        frames = max(1, round(scene.duration / self.frame_interval))
        fastest = _fastest(scene)
        limit = ABSURD * fastest
        stable = self.cfl * lattice.dx / (wave_speed(scene.material) + fastest)
        substeps = math.ceil(self.frame_interval / stable)
        dt = self.frame_interval / substeps
        arguments = (
            grid, lattice, (0,) if dim == 2 else (0, 1, 2), solid, boxes, gravity,
            material_constants(scene.material), scene.material.density * start.volume,
            start.volume, scene.friction.base, scene.friction.walls, scene.friction.baffles,
            lower, upper, math.exp(-self.damping_rate * dt), dt, substeps,
        )  # fmt: skip
        positions = np.empty((frames + 1, count, dim), np.float32)
        positions[0] = start.positions
        status = OK
        spare, spare_ids = np.empty_like(points), np.empty_like(ids)
        threads = min(self.threads, numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
        threads_before = numba.get_num_threads()
        try:
            for frame in range(1, frames + 1):
                if threads == 1:
                    points, ids, spare, spare_ids = advance_serial(
                        points, ids, spare, spare_ids, *arguments
                    )
                else:
                    with _ONE_CALLER:
                        numba.set_num_threads(threads)
                        points, ids, spare, spare_ids = advance(
                            points, ids, spare, spare_ids, *arguments
                        )
                if not np.abs(points[:, 3:6]).max() < limit:  # False for NaN, too
                    status = DIVERGED
                    positions[frame:] = positions[frame - 1]
                    break
                positions[frame, ids] = points[:, :dim]
                if progress is not None:
                    progress(frame / frames)
        finally:
            numba.set_num_threads(threads_before)
        return Trajectory(
            positions=positions,
            time=np.arange(frames + 1) * self.frame_interval,
            particle_type=np.full(count, MOVING, np.int8),
            scene=scene,
            point_volume=start.volume,
            simulator=self.name,
            status=status,
            settings={
                **self.settings(), "spacing": spacing, "dx": lattice.dx, "substep": dt,
                "seconds": time.perf_counter() - started,
            },
            lattice=start.lattice,
        )  # fmt: skip

    def _spacing(self, scene: Scene) -> float:
        return self.spacing or DEFAULT_SPACING[scene.dim]


def _fastest(scene: Scene) -> float:
    """The fastest that grains can get by falling through the whole domain [m/s]."""
    start = max(math.hypot(*release.velocity) for release in scene.releases)
    return math.sqrt(start**2 + 2 * math.hypot(*scene.gravity) * math.hypot(*scene.domain.size))


def _lattice(scene: Scene, dx: float) -> tuple[Lattice, np.ndarray, np.ndarray]:
    """Grid with nodes on the lower faces of the domain, and where points may be, shape (3,)."""
    dim = scene.dim
    lower, upper = np.zeros(3), np.zeros(3)
    lower[:dim] = np.asarray(scene.domain.lower) + SKIN
    upper[:dim] = np.asarray(scene.domain.upper) - SKIN
    origin = lower - SKIN - PADDING * dx
    walls = [PADDING + math.ceil(s / dx - 1e-9) for s in scene.domain.size]
    if dim == 2:
        origin[2] = 0.0
        walls.append(1)
    counts = [w + PADDING + 1 for w in walls[:dim]] + ([1] if dim == 2 else [])
    ox, oy, oz = map(float, origin)
    lattice = Lattice(dx, ox, oy, oz, *counts, *walls, dim == 2)  # type: ignore[arg-type, call-arg]
    return lattice, lower, upper


def _one_thread() -> None:
    os.environ["OMP_NUM_THREADS"] = "1"
    numba.set_num_threads(1)


def _rollout_job(settings: dict[str, Any], scene: Scene) -> Trajectory:
    return MpmSimulator(**settings).rollout([scene])[0]

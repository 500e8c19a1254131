"""The reference solver: scenes in, trajectories out."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numba
import numpy as np

from gns_model.interrupts import postponed
from gns_model.mpm.problem import DAMPING_RATE, Discretisation, pose, require_positive
from gns_model.mpm.transfer import COLUMNS, NODE_COLUMNS, POSITION, advance, advance_serial
from gns_model.scene import Scene
from gns_model.simulator import Progress
from gns_model.trajectory import Trajectory
from gns_model.workers import Workers, report, results

# numba's OpenMP layer sets the number of threads of the whole process, torch's included, whose
# one-thread rollouts then fight for all cores, many times slower. Its own layer leaves torch
# alone; it takes one caller at a time, which the lock sees to.
if "NUMBA_THREADING_LAYER" not in os.environ:
    numba.config.THREADING_LAYER = "workqueue"  # type: ignore[attr-defined]
_ONE_CALLER = threading.Lock()
#: Points from which threads are worth their meetings in every substep. Four of them take twenty
#: times as long as one for 600 points in 2D, twice for 4,000 in 3D, the same for 10,000 in 2D and
#: two thirds for 31,000 in 3D (`benchmarks/mpm.py`).
THREAD_POINTS = 15_000


class MpmSimulator:
    """Explicit MPM on the CPU, float64, in 3D and 2D plane strain.

    Args:
        spacing: distance between material points [m]; an element of the grid is two of them
            wide. Default: 0.015625 in 3D and 0.0125 in 2D, which gives the paper's elements.
        frame_interval: time between stored frames [s].
        cfl: share of the stable substep that is used.
        threads: most threads of one rollout, of which one of fewer than `THREAD_POINTS` points
            uses one; results do not depend on it. Default 1.
        workers: processes that roll out several scenes side by side, one thread each.
        damping_rate: see DAMPING_RATE [1/s].
        jitter, filling: another start of the same flow, see `Discretisation`.
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
        jitter: float = 0.0,
        filling: int = 0,
    ) -> None:
        self.chosen = Discretisation(
            spacing=spacing, frame_interval=frame_interval, cfl=cfl, damping_rate=damping_rate,
            jitter=jitter, filling=filling,
        )  # fmt: skip
        self.threads = threads
        self.workers = workers
        require_positive(threads=threads, workers=workers)

    @property
    def spacing(self) -> float | None:
        """The spacing asked for [m]; None is the default for the scene's dimension."""
        return self.chosen.spacing

    def settings(self) -> dict[str, Any]:
        """The arguments that this simulator was made with."""
        return {**asdict(self.chosen), "threads": self.threads, "workers": self.workers}

    def threads_for(self, count: int) -> int:
        """Threads that a rollout of `count` points uses."""
        most: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
        return min(self.threads, most) if count >= THREAD_POINTS else 1

    def refilled(self, jitter: float, filling: int) -> MpmSimulator:
        """The same solver on starts off their lattice, see `Discretisation`."""
        return MpmSimulator(**{**self.settings(), "jitter": jitter, "filling": filling})

    def check(self, scene: Scene) -> None:
        """Raise SimulatorError if `scene` would not fit in memory."""
        self.chosen.check(scene)

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
        if self.workers == 1 or len(scenes) <= 1:
            trajectories = []
            for n, scene in enumerate(scenes):
                inner = None
                if progress is not None:
                    inner = lambda f, n=n: progress((n + f) / total)  # noqa: E731
                trajectories.append(self._rollout_one(scene, inner))
            return trajectories
        single = {**self.settings(), "workers": 1, "threads": 1}
        with Workers(min(self.workers, len(scenes))) as pool:
            jobs = [pool.submit(_rollout_job, single, scene) for scene in scenes]
            return results(jobs, progress)

    def _rollout_one(self, scene: Scene, progress: Progress | None) -> Trajectory:
        started = time.perf_counter()
        dim = scene.dim
        problem = pose(scene, self.chosen)
        frames, count, start = problem.frames, problem.count, problem.start
        points = np.zeros((count, COLUMNS))
        points[:, POSITION : POSITION + dim] = start.positions
        points[:, 3 : 3 + dim] = start.velocities
        ids = np.arange(count)
        arguments = (
            np.zeros((len(problem.solid), NODE_COLUMNS)), problem.lattice,
            (0,) if dim == 2 else (0, 1, 2), problem.solid, problem.boxes, problem.turned,
            problem.turns, problem.gravity, problem.constants, problem.point_mass, start.volume,
            scene.friction.base, scene.friction.walls, scene.friction.baffles, problem.lower,
            problem.upper, problem.keep, problem.dt, problem.substeps,
        )  # fmt: skip
        positions = np.empty((frames + 1, count, dim), np.float32)
        positions[0] = start.positions
        bad_frame = None
        spare, spare_ids = np.empty_like(points), np.empty_like(ids)
        threads = self.threads_for(count)
        threads_before = numba.get_num_threads()
        try:
            for frame in range(1, frames + 1):
                # numba turns an interrupt while it looks for its code into a SystemError.
                with postponed():
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
                if not np.abs(points[:, 3:6]).max() < problem.limit:  # False for NaN, too
                    bad_frame = frame
                    break
                positions[frame, ids] = points[:, :dim]
                if progress is not None:
                    progress(frame / frames)
        finally:
            numba.set_num_threads(threads_before)
        seconds = time.perf_counter() - started
        return problem.trajectory(positions, bad_frame, {**self.settings(), "seconds": seconds})


def _rollout_job(settings: dict[str, Any], scene: Scene, slot: int) -> Trajectory:
    return MpmSimulator(**settings).rollout([scene], progress=report(slot))[0]

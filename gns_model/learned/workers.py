"""A long list of scenes on the CPU: several one-thread processes beat one process with threads."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

import torch

from gns_model.errors import SimulatorError
from gns_model.learned.config import Limits, ModelConfig
from gns_model.learned.model import LearnedModel
from gns_model.learned.simulator import LearnedSimulator, groups
from gns_model.particles import fill
from gns_model.scene import Scene
from gns_model.simulator import Progress
from gns_model.trajectory import Trajectory

#: Points that one task should have: small scenes share a task, large ones have their own.
TASK_POINTS = 4_000

_simulator: LearnedSimulator | None = None  # of this worker process


class WorkerPool:
    """Processes that each hold a copy of one model; they start on first use and then stay.

    They are spawned, so a script that rolls out with workers needs the usual
    `if __name__ == "__main__":` guard.
    """

    def __init__(self, simulator: LearnedSimulator, workers: int) -> None:
        config = simulator.config.model_copy(update={"limits": Limits()})  # the parent has warned
        state = {k: v.numpy() for k, v in simulator.model.state_dict().items()}
        self.spacing = config.spacing
        self.workers = workers
        self._pool = ProcessPoolExecutor(
            workers,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_start,
            initargs=(
                config.model_dump_json(),
                state,
                simulator.name,
                {"precision": simulator.precision, "filling": simulator.filling},
            ),
        )

    def rollout(self, scenes: Sequence[Scene], progress: Progress | None) -> list[Trajectory]:
        """As `LearnedSimulator.rollout`, of scenes that have been checked.

        Raises:
            SimulatorError: if a worker process dies; the pool is then of no more use.
        """
        sizes = [len(fill(scene, self.spacing).positions) for scene in scenes]
        even = -(-sum(sizes) // self.workers)
        tasks = list(groups(sizes, min(TASK_POINTS, even)))
        done: dict[int, list[Trajectory]] = {}
        try:
            futures = {
                self._pool.submit(_rollout, [scenes[k].to_dict() for k in task]): number
                for number, task in enumerate(tasks)
            }
            waiting = set(futures)
            while waiting:
                finished, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for future in finished:
                    done[futures[future]] = future.result()
                if progress is not None:
                    progress(len(done) / len(tasks))
        except BrokenProcessPool:
            raise SimulatorError(
                "a worker process died, perhaps for want of memory: use fewer workers"
            ) from None
        except BaseException:
            self.close()
            raise
        return [trajectory for number in range(len(tasks)) for trajectory in done[number]]

    def close(self) -> None:
        """End the processes, at once and with whatever they were doing."""
        processes = list((getattr(self._pool, "_processes", None) or {}).values())
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.terminate()


def _start(config: str, state: dict[str, Any], name: str, options: dict[str, Any]) -> None:
    global _simulator
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends us
    torch.set_num_threads(1)
    model = LearnedModel(ModelConfig.model_validate_json(config))
    model.to(torch.from_numpy(state["velocity_std"]).dtype)
    model.load_state_dict({k: torch.from_numpy(v) for k, v in state.items()})
    _simulator = LearnedSimulator(model, name, **options)


def _rollout(scenes: list[dict[str, Any]]) -> list[Trajectory]:
    assert _simulator is not None
    return _simulator.rollout([Scene.from_dict(scene) for scene in scenes])

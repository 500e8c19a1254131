"""A long list of scenes on the CPU: several one-thread processes beat one process with threads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from gns_model.learned.config import Limits, ModelConfig
from gns_model.learned.model import LearnedModel
from gns_model.learned.rollout import groups
from gns_model.learned.simulator import LearnedSimulator
from gns_model.particles import fill
from gns_model.scene import Scene
from gns_model.simulator import Progress
from gns_model.trajectory import Trajectory
from gns_model.workers import Workers, report, results

#: Points that one task should have: small scenes share a task, large ones have their own.
TASK_POINTS = 4_000

_simulator: LearnedSimulator | None = None  # of this worker process


class WorkerPool:
    """Processes that each hold a copy of one model; they start on first use and then stay."""

    def __init__(self, simulator: LearnedSimulator, workers: int) -> None:
        config = simulator.config.model_copy(update={"limits": Limits()})  # the parent has warned
        state = {k: v.numpy() for k, v in simulator.model.state_dict().items()}
        self.spacing = config.spacing
        self.workers = workers
        self._pool = Workers(
            workers,
            _start,
            config.model_dump_json(),
            state,
            simulator.name,
            {
                "precision": simulator.precision,
                "filling": simulator.filling,
                "jitter": simulator.jitter,
            },
        )

    def rollout(self, scenes: Sequence[Scene], progress: Progress | None) -> list[Trajectory]:
        """As `LearnedSimulator.rollout`, of scenes that have been checked.

        Raises:
            WorkerError: if a process dies; the pool is then of no more use.
        """
        sizes = [len(fill(scene, self.spacing).positions) for scene in scenes]
        even = -(-sum(sizes) // self.workers)
        tasks = list(groups(sizes, min(TASK_POINTS, even)))
        try:
            jobs = [
                self._pool.submit(_rollout, [scenes[k].to_dict() for k in task]) for task in tasks
            ]
            shares = results(jobs, progress)
        except BaseException:
            self.close()
            raise
        return [trajectory for share in shares for trajectory in share]

    def close(self) -> None:
        """End the processes, at once and with whatever they were doing."""
        self._pool.end()


def _start(config: str, state: dict[str, Any], name: str, options: dict[str, Any]) -> None:
    global _simulator
    torch.set_num_threads(1)
    model = LearnedModel(ModelConfig.model_validate_json(config))
    model.to(torch.from_numpy(state["velocity_std"]).dtype)
    model.load_state_dict({k: torch.from_numpy(v) for k, v in state.items()})
    _simulator = LearnedSimulator(model, name, **options)


def _rollout(scenes: list[dict[str, Any]], slot: int) -> list[Trajectory]:
    assert _simulator is not None
    return _simulator.rollout([Scene.from_dict(scene) for scene in scenes], progress=report(slot))

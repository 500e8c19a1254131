"""Run layouts, as one batch in this process or one by one in workers: a search sees no difference.

On a GPU a batch is one block-diagonal graph and fills the device; on a CPU one-thread processes do
more (findings/SPEED.md).
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from design.trials import Outcome
from design.workers import Workers, as_completed
from gns_env.objective import Objective
from gns_env.task import BaffleTask
from gns_model.scene import Scene
from gns_model.simulator import Progress, Simulator, load_simulator
from gns_model.trajectory import Trajectory


@dataclass(frozen=True)
class SimulatorSpec:
    """A simulator as a few words that another process can load it from."""

    name: str
    device: str = "cpu"
    options: tuple[tuple[str, Any], ...] = ()

    def load(self) -> Simulator:
        """The simulator; the same one within a process.

        Raises:
            SimulatorError, FileFormatError: as `load_simulator`.
        """
        return _simulator(self)

    def describe(self) -> dict[str, Any]:
        """Plain values that tell two simulators apart: name, options, and a hash of the weights."""
        values = {"name": self.name, **dict(self.options)}
        weights = _weights(self.name)
        return {**values, "weights": weights} if weights else values


@lru_cache(maxsize=4)
def _simulator(spec: SimulatorSpec) -> Simulator:
    return load_simulator(spec.name, device=spec.device, **dict(spec.options))


@lru_cache(maxsize=8)
def _weights(name: str) -> str | None:
    if name == "mpm":
        return None
    from gns_model.learned.checkpoint import shipped_models

    file = Path(shipped_models().get(name, Path(name))) / "model.safetensors"
    return hashlib.sha256(file.read_bytes()).hexdigest()[:12] if file.is_file() else None


def differentiable(simulator: Simulator) -> bool:
    """Whether rollouts of `simulator` can be differentiated in the layout."""
    return hasattr(simulator, "rollout_tensor")


class InProcess:
    """Runs all layouts of a call as one batch of `task`, in this process."""

    def __init__(self, task: BaffleTask) -> None:
        self.task = task
        self.differentiable = differentiable(task.simulator)

    def evaluate(self, layouts: Sequence[np.ndarray]) -> Iterator[tuple[int, Outcome]]:
        """See `campaign.Evaluator`."""
        yield from enumerate(run(self.task, layouts))

    def differentiate(self, layouts: Sequence[np.ndarray]) -> Iterator[tuple[int, Outcome]]:
        """See `campaign.Evaluator`."""
        from design.gradient import differentiate

        yield from enumerate(differentiate(self.task, layouts))


@dataclass(frozen=True)
class TaskSpec:
    """A BaffleTask as plain values, for another process to build.

    `reference` is a trajectory file: the scene without baffles by the same simulator, so that the
    workers need not all simulate it.
    """

    scene: str
    n_baffles: int
    objective: Objective
    simulator: SimulatorSpec
    reference: Path

    @classmethod
    def of(
        cls,
        scene: Scene,
        n_baffles: int,
        objective: Objective,
        simulator: SimulatorSpec,
        reference: Path,
    ) -> TaskSpec:
        """The spec of a task on `scene`."""
        return cls(json.dumps(scene.to_dict()), n_baffles, objective, simulator, reference)

    def task(self) -> BaffleTask:
        """The task; the same one within a process."""
        return _task(self)


@lru_cache(maxsize=2)
def _task(spec: TaskSpec) -> BaffleTask:
    simulator = KnownReference(spec.simulator.load(), spec.reference)
    return BaffleTask(
        Scene.from_dict(json.loads(spec.scene)),
        simulator,
        n_baffles=spec.n_baffles,
        objective=spec.objective,
    )


class KnownReference:
    """A simulator whose rollout without baffles is already on file."""

    def __init__(self, simulator: Simulator, reference: Path) -> None:
        self.name = simulator.name
        self._simulator, self._reference = simulator, reference

    def rollout(
        self, scenes: Sequence[Scene], *, progress: Progress | None = None
    ) -> list[Trajectory]:
        """As the simulator's, but a scene without baffles comes from the file."""
        given = [scene for scene in scenes if scene.baffles]
        rolled = iter(self._simulator.rollout(given, progress=progress) if given else [])
        return [
            next(rolled) if scene.baffles else Trajectory.load(self._reference) for scene in scenes
        ]

    def check(self, scene: Scene) -> None:
        """As the simulator's."""
        self._simulator.check(scene)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._simulator, name)


class InWorkers:
    """Runs every layout of a call as a job of its own."""

    def __init__(
        self, workers: Workers, spec: TaskSpec, watch: Callable[[], None] | None = None
    ) -> None:
        self._workers, self._spec, self._watch = workers, spec, watch
        self.differentiable = differentiable(spec.simulator.load())

    def evaluate(self, layouts: Sequence[np.ndarray]) -> Iterator[tuple[int, Outcome]]:
        """See `campaign.Evaluator`."""
        yield from self._each(_evaluate_job, layouts)

    def differentiate(self, layouts: Sequence[np.ndarray]) -> Iterator[tuple[int, Outcome]]:
        """See `campaign.Evaluator`."""
        yield from self._each(_differentiate_job, layouts)

    def _each(
        self, job: Callable[..., Outcome], layouts: Sequence[np.ndarray]
    ) -> Iterator[tuple[int, Outcome]]:
        jobs = [self._workers.submit(job, self._spec, np.asarray(c)) for c in layouts]
        for k in as_completed(jobs, self._watch):
            yield k, jobs[k].result()


def run(task: BaffleTask, layouts: Sequence[np.ndarray]) -> list[Outcome]:
    """One rollout of each layout [m], shape (n, D-1), as one batch."""
    started = time.perf_counter()
    evaluations = task.evaluate(list(layouts))
    seconds = (time.perf_counter() - started) / max(len(layouts), 1)
    return [
        Outcome(
            cost=float(e.cost),
            measures={} if e.failed else dict(e.measures),
            status=e.status,
            seconds=seconds,
            costs=e.costs if len(e.costs) > 1 else (),
        )
        for e in evaluations
    ]


def _evaluate_job(spec: TaskSpec, layout: np.ndarray, slot: int) -> Outcome:
    return run(spec.task(), [layout])[0]


def _differentiate_job(spec: TaskSpec, layout: np.ndarray, slot: int) -> Outcome:
    from design.gradient import differentiate

    return differentiate(spec.task(), [layout])[0]

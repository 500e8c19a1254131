"""Run layouts, as one batch in this process or one by one in workers: a search sees no difference.

On a GPU a batch is one block-diagonal graph and fills the device; on a CPU one-thread processes do
more (findings/SPEED.md).
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from design.outcome import Outcome
from design.risk import MEAN, Flow, Risk, weigh
from design.rules import FREE, Rules
from design.space import Space, design_space, split, varies
from gns_env.objective import Objective
from gns_env.task import BaffleTask, simulate
from gns_model.scene import Scene
from gns_model.simulator import Progress, Simulator, load_simulator
from gns_model.trajectory import Trajectory
from gns_model.workers import Workers, as_completed


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


@lru_cache(maxsize=8)
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
    """Runs all layouts of a call as one batch, in this process.

    Args:
        tasks: one task, or one for each scenario, of the same simulator and layouts.
        risk: of their costs.
        rules: prices and limits; default: the limits of the scene.
        space: of the layouts; default: that of the first task.
    """

    def __init__(
        self,
        tasks: BaffleTask | Sequence[BaffleTask],
        risk: Risk | None = None,
        rules: Rules | None = None,
        space: Space | None = None,
    ) -> None:
        self.tasks = [tasks] if isinstance(tasks, BaffleTask) else list(tasks)
        self.risk = risk or Risk()
        self.rules = rules or Rules.of(self.tasks[0].scene)
        self.space = space or space_of(self.tasks[0])
        self.differentiable = differentiable(self.tasks[0].simulator)

    @property
    def task(self) -> BaffleTask:
        """The first task."""
        return self.tasks[0]

    def evaluate(self, layouts: Sequence[np.ndarray]) -> Iterator[tuple[int, Outcome]]:
        """See `campaign.Evaluator`."""
        yield from enumerate(run(self.tasks, layouts, self.risk, self.rules, self.space))

    def differentiate(self, layouts: Sequence[np.ndarray]) -> Iterator[tuple[int, Outcome]]:
        """See `campaign.Evaluator`."""
        from design.gradient import differentiate_flows

        yield from enumerate(
            differentiate_flows(self.tasks, layouts, self.risk, self.rules, self.space)
        )


@dataclass(frozen=True)
class TaskSpec:
    """BaffleTasks as plain values, for another process to build: one for each scenario.

    `references` are trajectory files: each scene without baffles by the same simulator, so that the
    workers need not all simulate it.
    """

    scenes: tuple[str, ...]
    n_baffles: int
    objectives: tuple[Objective, ...]
    simulator: SimulatorSpec
    references: tuple[Path, ...]
    risk: Risk = MEAN
    rules: Rules = FREE

    @classmethod
    def of(
        cls,
        scenes: Sequence[Scene],
        n_baffles: int,
        objectives: Sequence[Objective],
        simulator: SimulatorSpec,
        references: Sequence[Path],
        risk: Risk = MEAN,
        rules: Rules = FREE,
    ) -> TaskSpec:
        """The spec of tasks on `scenes`."""
        texts = tuple(json.dumps(scene.to_dict()) for scene in scenes)
        return cls(texts, n_baffles, tuple(objectives), simulator, tuple(references), risk, rules)

    def tasks(self) -> list[BaffleTask]:
        """The tasks; the same ones within a process."""
        return _tasks(self)

    def space(self) -> Space:
        """Of the layouts; the same one within a process."""
        return _space(self)


@lru_cache(maxsize=2)
def _tasks(spec: TaskSpec) -> list[BaffleTask]:
    scenes = [Scene.from_dict(json.loads(text)) for text in spec.scenes]
    simulator = KnownReference(
        spec.simulator.load(), dict(zip(scenes, spec.references, strict=True))
    )
    return [
        BaffleTask(scene, simulator, n_baffles=spec.n_baffles, objective=spec.objectives)
        for scene in scenes
    ]


@lru_cache(maxsize=2)
def _space(spec: TaskSpec) -> Space:
    return space_of(spec.tasks()[0])


class KnownReference:
    """A simulator whose rollouts without baffles are already on file, by scene."""

    def __init__(self, simulator: Simulator, references: Mapping[Scene, Path]) -> None:
        self.name = simulator.name
        self._simulator = simulator
        self._references = {_flow(scene): path for scene, path in references.items()}

    def rollout(
        self, scenes: Sequence[Scene], *, progress: Progress | None = None
    ) -> list[Trajectory]:
        """As the simulator's, but a scene without baffles comes from its file."""
        known = [None if s.baffles else self._references.get(_flow(s)) for s in scenes]
        given = [scene for scene, path in zip(scenes, known, strict=True) if path is None]
        rolled = iter(self._simulator.rollout(given, progress=progress) if given else [])
        return [next(rolled) if path is None else Trajectory.load(path) for path in known]

    def check(self, scene: Scene) -> None:
        """As the simulator's."""
        self._simulator.check(scene)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._simulator, name)


def _flow(scene: Scene) -> str:
    """What a rollout without baffles depends on; where baffles may stand does not count."""
    values = scene.replace(placement=None, baffles=()).to_dict()
    return json.dumps(values, sort_keys=True)


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


def space_of(task: BaffleTask) -> Space:
    """What a search may choose in a task: places, and what its placement varies.

    Raises:
        LayoutError: if nothing fits.
    """
    if varies(task.space.placement):
        return design_space(task.scene, task.space.n_baffles)
    return task.space


def run(
    tasks: Sequence[BaffleTask],
    layouts: Sequence[np.ndarray],
    risk: Risk | None = None,
    rules: Rules | None = None,
    space: Space | None = None,
) -> list[Outcome]:
    """One rollout of each layout [m], as `space` has them, in each task, all as one batch."""
    started = time.perf_counter()
    rules = rules or Rules.of(tasks[0].scene)
    space = space or space_of(tasks[0])
    asked = []
    for layout in layouts:
        centres, form = split(space, layout)
        asked += [(t.with_form(form.size, form.yaw), centres) for t in tasks]
    found = simulate(asked)
    seconds = (time.perf_counter() - started) / max(len(layouts), 1)
    outcomes = []
    for k in range(0, len(asked), len(tasks)):
        flows = []
        for (task, centres), known in zip(asked[k : k + len(tasks)], found[k:], strict=False):
            e = task.judge(centres, *known)
            sizes = [task.scene.baffle_size] * len(centres)
            flows.append(
                Flow.of(e.status, dict(e.measures), task.reference, task.objectives, rules, sizes)
            )
        outcome = weigh(flows, risk or Risk(), failure_cost(tasks[0].objectives))
        outcomes.append(replace(outcome, seconds=seconds))
    return outcomes


def failure_cost(objectives: Sequence[Objective]) -> float:
    """The cost of a rollout that failed, of the sum of several objectives."""
    return sum(objective.failure_cost for objective in objectives)


def _evaluate_job(spec: TaskSpec, layout: np.ndarray, slot: int) -> Outcome:
    return run(spec.tasks(), [layout], spec.risk, spec.rules, spec.space())[0]


def _differentiate_job(spec: TaskSpec, layout: np.ndarray, slot: int) -> Outcome:
    from design.gradient import differentiate_flows

    return differentiate_flows(spec.tasks(), [layout], spec.risk, spec.rules, spec.space())[0]

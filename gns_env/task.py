"""BaffleTask: a scene, what may be placed in it, what to make small, and who simulates.

The env, the searches and the verification all hold a task and differ in which layouts they ask for.
"""

from __future__ import annotations

import math
import os
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gns_env.layout import LayoutSpace
from gns_env.objective import Objective, ObjectiveError
from gns_model import measures as hard
from gns_model.scene import Scene
from gns_model.simulator import Progress, Simulator, load_simulator
from gns_model.trajectory import DIVERGED, INTERRUPTED, OK, Trajectory

#: Layouts closer than this in every coordinate are one layout [m].
SAME_LAYOUT = 1e-6
#: A rollout has failed in which more than this share of the points enters a baffle or ends more
#: than LEAK_DEPTH [m] outside the domain; so has one that throws a grain a domain's length away.
LEAK_SHARE, LEAK_DEPTH = 0.05, 0.01
#: Status of such a rollout, beside those of `gns_model.trajectory`.
LEAKED = "leaked"
#: Evaluations and trajectories that a task remembers.
REMEMBERED, KEPT_TRAJECTORIES = 10_000, 8


@dataclass(frozen=True)
class Evaluation:
    """What a simulator says about one layout.

    Attributes:
        centres: the layout [m], shape (n, D-1), in the order asked for.
        measures: as `gns_model.measures.summary`; finite whatever happened.
        cost: the objective; of several, their sum. Lower is better; a failure is finite too.
        costs: the cost under each objective.
        status: "ok", or how the rollout failed: "diverged", "interrupted" or "leaked".
        trajectory: if it was asked for.
    """

    centres: NDArray[np.float64]
    measures: dict[str, float]
    cost: float
    costs: tuple[float, ...]
    status: str
    trajectory: Trajectory | None = None

    @property
    def failed(self) -> bool:
        """Whether the measures are of a rollout that failed, and the cost is the failure cost."""
        return self.status != OK


class BaffleTask:
    """Place `n_baffles` in `scene` so that `objective` is small, as `simulator` sees it.

    Args:
        scene: a scene; its own baffles give the size, unless its placement does, and are taken out.
        simulator: anything that rolls out scenes, or the name or path of one.
        n_baffles: how many to place.
        objective: what to make small; several for a Pareto front.
        device: torch device, if `simulator` is a name or a path.

    Attributes:
        scene: the scene without baffles, its placement filled in.
        space: LayoutSpace.
        objectives: tuple of Objective.
        rollouts: how many were really run, remembered answers not counted.
        failures: how many of these failed.

    Raises:
        LayoutError: if the baffles do not fit.
        SimulatorError: if the simulator is unknown or cannot run the scene.
        FileFormatError: if its checkpoint is not one.
    """

    def __init__(
        self,
        scene: Scene,
        simulator: Simulator | str | os.PathLike[str],
        *,
        n_baffles: int = 3,
        objective: Objective | Sequence[Objective] | None = None,
        device: str = "cpu",
    ) -> None:
        self.space = LayoutSpace(scene, n_baffles)
        self.scene = scene.replace(baffles=(), placement=self.space.placement)
        if objective is None or isinstance(objective, Objective):
            self.objectives: tuple[Objective, ...] = (objective or Objective(),)
        else:
            self.objectives = tuple(objective)
            if not self.objectives:
                raise ObjectiveError("a task needs one objective at least")
        if isinstance(simulator, (str, os.PathLike)):
            simulator = load_simulator(simulator, device=device)
        simulator.check(self.scene)
        self.simulator = simulator
        self.rollouts = self.failures = 0
        self._evaluations: OrderedDict[bytes, Evaluation] = OrderedDict()
        self._trajectories: OrderedDict[bytes, Trajectory] = OrderedDict()
        self._nothing = _key(self._no_baffles())

    @property
    def objective(self) -> Objective:
        """The first, and mostly the only, objective."""
        return self.objectives[0]

    @property
    def reference(self) -> dict[str, float]:
        """Measures of the scene without baffles, simulated at the first need.

        Raises:
            ObjectiveError: if that rollout fails, for then nothing can be relative to it.
        """
        return self.evaluate([self._no_baffles()])[0].measures

    def scene_with(self, centres: ArrayLike) -> Scene:
        """The scene with baffles at `centres` [m], shape (k, D-1)."""
        return self.scene.with_baffles(np.asarray(centres, dtype=float))

    def evaluate(
        self,
        layouts: Sequence[ArrayLike],
        *,
        trajectories: bool = False,
        progress: Progress | None = None,
    ) -> list[Evaluation]:
        """Simulate layouts (k, D-1) [m] in one batch; k may differ, 0 is the flow without baffles.

        A layout that is known already, in whatever order of its baffles, is not simulated again.
        A layout need not be buildable (the paper's may stand outside the placement), but has to be
        physically possible. The flow without baffles joins the first batch by itself.

        Args:
            layouts: centres of each layout.
            trajectories: return each rollout's trajectory too; the last few are remembered.
            progress: called with the fraction done.

        Raises:
            SceneError: if baffles overlap each other or a release, or leave the domain.
            LayoutError: if centres has a wrong shape or is not finite.
            ObjectiveError: if the flow without baffles fails or is zero in a measure that counts.
        """
        if len(layouts) == 0:
            return []
        asked = [self.space.as_centres(layout) for layout in layouts]
        keys = [_key(centres) for centres in asked]
        nothing = self._nothing
        wanted = dict(zip(keys, asked, strict=True))
        if nothing not in self._evaluations:
            wanted.setdefault(nothing, self._no_baffles())
        found: dict[bytes, tuple[Evaluation, Trajectory | None]] = {}
        missing: list[bytes] = []
        for key in wanted:
            if key in self._evaluations and (not trajectories or key in self._trajectories):
                self._evaluations.move_to_end(key)
                found[key] = self._evaluations[key], self._trajectories.get(key)
            else:
                missing.append(key)
        if missing:
            # Baffles in one order, so that the answer does not depend on the order asked for.
            scenes = [self.scene_with(_sorted(wanted[key])) for key in missing]
            results = self.simulator.rollout(scenes, progress=progress)
            self.rollouts += len(results)
            for key, trajectory in sorted(
                zip(missing, results, strict=True), key=lambda pair: pair[0] != nothing
            ):
                evaluation = self._judge(wanted[key], trajectory, key == nothing)
                self.failures += evaluation.failed
                found[key] = evaluation, trajectory
                self._remember(key, evaluation, trajectory if trajectories else None)
        return [
            replace(
                found[key][0],
                centres=centres.copy(),
                measures=dict(found[key][0].measures),
                trajectory=found[key][1] if trajectories else None,
            )
            for key, centres in zip(keys, asked, strict=True)
        ]

    def _judge(
        self, centres: NDArray[np.float64], trajectory: Trajectory, is_reference: bool
    ) -> Evaluation:
        values, status = _finite_summary(trajectory)
        if is_reference:
            if status != OK:
                raise ObjectiveError(
                    f"the rollout of {self.simulator.name} without baffles ended as {status!r}, "
                    "so no cost can be relative to it"
                )
            reference = values
        else:
            reference = self._evaluations[self._nothing].measures
        costs = tuple(
            objective.cost(values, reference) if status == OK else objective.failure_cost
            for objective in self.objectives
        )
        return Evaluation(centres, values, sum(costs), costs, status)

    def _remember(self, key: bytes, evaluation: Evaluation, trajectory: Trajectory | None) -> None:
        if evaluation.status == INTERRUPTED:  # another time it may run to its end
            return
        self._evaluations[key] = evaluation
        if trajectory is not None:
            self._trajectories[key] = trajectory
        for memory, size in (
            (self._evaluations, REMEMBERED),
            (self._trajectories, KEPT_TRAJECTORIES),
        ):
            while len(memory) > size:
                oldest: Any = next(iter(memory))
                if oldest == _key(self._no_baffles()):  # the reference is always needed
                    memory.move_to_end(oldest)
                    continue
                del memory[oldest]

    def _no_baffles(self) -> NDArray[np.float64]:
        return np.zeros((0, self.scene.dim - 1))


def _forget(memory: OrderedDict[bytes, Any], size: int, always: bytes) -> None:
    """Drop the longest unused entries beyond `size`, but never that of the key `always`."""
    if always in memory:
        memory.move_to_end(always)
    while len(memory) > size:
        memory.popitem(last=False)


def _sorted(centres: NDArray[Any]) -> NDArray[Any]:
    return centres[np.lexsort(centres.T[::-1])] if len(centres) else centres


def _key(centres: NDArray[np.float64]) -> bytes:
    rounded = np.rint(centres / SAME_LAYOUT).astype(np.int64)
    return _sorted(rounded).tobytes()


def _finite_summary(trajectory: Trajectory) -> tuple[dict[str, float], str]:
    """Finite measures and a status, whatever the trajectory holds."""
    status = trajectory.status
    if status == OK and not np.isfinite(trajectory.positions).all():
        status = DIVERGED
    with np.errstate(over="ignore", invalid="ignore"):  # of numbers that are about to be refused
        values = hard.summary(trajectory)
    if not all(map(math.isfinite, values.values())):
        status = DIVERGED if status == OK else status
        values = {name: v if math.isfinite(v) else 0.0 for name, v in values.items()}
    return values, _leaks(trajectory) if status == OK else status


def _leaks(trajectory: Trajectory) -> str:
    """Status of a finite rollout: "ok", unless its grains are where no grain can be."""
    domain, last = trajectory.scene.domain, hard.moving_positions(trajectory)[-1]
    outside = np.maximum(np.array(domain.lower) - last, last - np.array(domain.upper)).max(axis=1)
    if outside.max() > max(domain.size):
        return DIVERGED
    allowed = LEAK_SHARE * len(last)
    if (outside > LEAK_DEPTH).sum() > allowed or hard.points_inside_baffles(trajectory) > allowed:
        return LEAKED
    return OK

"""BaffleTask: a scene, what may be placed in it, what to make small, and who simulates.

The env, the searches and the verification all hold a task and differ in which layouts they ask for.
"""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gns_env.cache import Keep, Outcome, RolloutCache, layout_key, scene_key, sorted_centres
from gns_env.deposit import CELL, depth_map
from gns_env.layout import LayoutSpace
from gns_env.objective import Objective, ObjectiveError
from gns_model import measures as hard
from gns_model.particles import MOVING
from gns_model.scene import Scene
from gns_model.simulator import Progress, Simulator, load_simulator
from gns_model.trajectory import DIVERGED, INTERRUPTED, OK, Trajectory

#: A rollout has failed in which more than this share of the points enters a baffle or ends more
#: than LEAK_DEPTH [m] outside the domain; so has one that throws a grain a domain's length away.
LEAK_SHARE, LEAK_DEPTH = 0.05, 0.01
#: Forms of baffles that a task remembers.
MOST_FORMS = 256
#: Status of such a rollout, beside those of `gns_model.trajectory`.
LEAKED = "leaked"


@dataclass(frozen=True)
class Evaluation:
    """What a simulator says about one layout.

    Attributes:
        centres: the layout [m], shape (n, D-1), in the order asked for.
        measures: as `gns_model.measures.summary`; finite whatever happened.
        cost: the objective; of several, their sum. Lower is better; a failure is finite too.
        costs: the cost under each objective.
        status: "ok", or how the rollout failed: "diverged", "interrupted" or "leaked".
        deposit: depth where the material came to rest [m], see `gns_env.deposit`.
        depths: peak depth upstream of each baffle [m], shape (n,), in the order of `centres`.
        trajectory: if it was asked for.
    """

    centres: NDArray[np.float64]
    measures: dict[str, float]
    cost: float
    costs: tuple[float, ...]
    status: str
    deposit: NDArray[np.float32]
    depths: NDArray[np.float32]
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
        cache: where rollouts are remembered; default: a cache of the task's own.

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
        cache: RolloutCache | None = None,
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
        self.cache = RolloutCache() if cache is None else cache
        self._scene_key = scene_key(simulator, self.scene)
        self._free: Outcome | None = None  # of the flow without baffles: always needed
        self._nominal = self
        self._forms: dict[tuple[float, ...], BaffleTask] = {}

    def with_form(self, size: Sequence[float], yaw: float = 0.0) -> BaffleTask:
        """The same task with baffles of another size [m], shape (D,), and yaw [degrees].

        Costs stay relative to the same flow without baffles, in whose windows, as wide as this
        task's own baffles, the free depth is read: so forms can be compared. What may be placed
        where (`space`) stays that of this task's own form.
        """
        key = (*map(float, size), float(yaw))
        own = self._nominal
        if np.allclose(key, (*own.scene.baffle_size, own.scene.baffle_yaw), rtol=0, atol=1e-12):
            return own
        if key not in own._forms:
            placement = self.space.placement.model_copy(
                update={"size": key[:-1], "yaw": key[-1] or None}
            )
            other = copy.copy(own)
            other.scene = own.scene.replace(placement=placement)
            other._scene_key = scene_key(own.simulator, other.scene)
            if len(own._forms) >= MOST_FORMS:
                own._forms.clear()
            own._forms[key] = other
        return own._forms[key]

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
        return self._nominal.evaluate([self.space.as_centres([])])[0].measures

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
            trajectories: return each rollout's trajectory too; the last ones are remembered.
            progress: called with the fraction done.

        Raises:
            SceneError: if baffles overlap each other or a release, or leave the domain.
            LayoutError: if centres has a wrong shape or is not finite.
            ObjectiveError: if the flow without baffles fails or is zero in a measure that counts.
        """
        if len(layouts) == 0:
            return []
        asked = [self.space.as_centres(layout) for layout in layouts]
        keep: Keep = "whole" if trajectories else "nothing"
        found = simulate([(self, centres) for centres in asked], keep=keep, progress=progress)
        return [self.judge(c, *known) for c, known in zip(asked, found, strict=True)]

    def judge(
        self, centres: NDArray[np.float64], outcome: Outcome, trajectory: Trajectory | None = None
    ) -> Evaluation:
        """What an outcome of `simulate` is worth.

        Raises:
            ObjectiveError: as `evaluate`.
        """
        free = self._nominal._free
        assert free is not None, "simulate() finds the free flow first"
        if free.status != OK:
            raise ObjectiveError(
                f"the rollout of {self.simulator.name} without baffles ended as "
                f"{free.status!r}, so no cost can be relative to it"
            )
        reference = free.measures
        costs = tuple(
            objective.cost(outcome.measures, reference)
            if outcome.status == OK
            else objective.failure_cost
            for objective in self.objectives
        )
        depths = np.zeros(len(centres), np.float32)
        if len(centres):
            depths[np.lexsort(centres.T[::-1])] = outcome.depths
        return Evaluation(
            centres=centres.copy(),
            measures=dict(outcome.measures),
            cost=sum(costs),
            costs=costs,
            status=outcome.status,
            deposit=outcome.deposit.copy(),
            depths=depths,
            trajectory=trajectory,
        )

    def key(self, centres: NDArray[np.float64]) -> bytes:
        """What the cache knows a layout of this task by."""
        return self._scene_key + layout_key(centres)


def simulate(
    wanted: Sequence[tuple[BaffleTask, NDArray[np.float64]]],
    *,
    keep: Keep = "nothing",
    progress: Progress | None = None,
) -> list[tuple[Outcome, Trajectory | None]]:
    """Outcomes of layouts of several tasks that share one simulator, in one batch.

    Each different rollout is run once, and none that a task's cache remembers. The flow without
    baffles of every task joins the batch if it is not known.

    Args:
        wanted: tasks and centres [m], shape (k, D-1).
        keep: what to keep and return of each trajectory.
        progress: called with the fraction done.

    Raises:
        SceneError: if baffles overlap each other or a release, or leave the domain.
    """
    nothing = [
        (task, task.space.as_centres([]))
        for task in {id(task._nominal): task._nominal for task, _ in wanted}.values()
        if task._free is None
    ]
    found: dict[bytes, tuple[Outcome, Trajectory | None]] = {}
    missing: dict[bytes, tuple[BaffleTask, Scene]] = {}
    for task, centres in [*wanted, *nothing]:
        key = task.key(centres)
        if key in found or key in missing:
            continue
        known = task.cache.find(key, keep)
        if known is not None:
            found[key] = known
        elif len(centres) == 0 and task._free is not None and keep == "nothing":
            found[key] = task._free, None
        else:
            missing[key] = task, task.scene_with(sorted_centres(centres))
    if missing:
        simulator = next(iter(missing.values()))[0].simulator
        scenes = [scene for _, scene in missing.values()]
        results = simulator.rollout(scenes, progress=progress)
        for (key, (task, _)), trajectory in zip(missing.items(), results, strict=True):
            outcome = _read(trajectory)
            kept = _kept(trajectory, keep)
            task._nominal.rollouts += 1
            task._nominal.failures += outcome.status != OK
            found[key] = outcome, kept
            if outcome.status != INTERRUPTED:  # another time it may run to its end
                task.cache.remember(key, outcome, keep, kept)
    for task, none in nothing:
        task._free = found[task.key(none)][0]
    return [found[task.key(centres)] for task, centres in wanted]


def _read(trajectory: Trajectory) -> Outcome:
    values, status = _finite_summary(trajectory)
    with np.errstate(over="ignore", invalid="ignore"):
        depths = hard.upstream_depth_over_time(trajectory).max(axis=0)
        deposit = depth_map(trajectory, -1, CELL)
    if not trajectory.scene.baffles:
        depths = depths[:0]  # the windows of a free flow belong to no baffle
    return Outcome(
        values, status, deposit.astype(np.float32), np.nan_to_num(depths).astype(np.float32)
    )


def _kept(trajectory: Trajectory, keep: Keep) -> Trajectory | None:
    if keep != "rest":
        return trajectory if keep == "whole" else None
    # Two frames are enough to draw where it all came to rest, and how fast it still was.
    positions = hard.moving_positions(trajectory)[-2:].copy()
    return Trajectory(
        positions=positions,
        time=trajectory.time[-2:].copy(),
        particle_type=np.full(positions.shape[1], MOVING, np.int8),
        scene=trajectory.scene,
        point_volume=trajectory.point_volume,
        simulator=trajectory.simulator,
        status=trajectory.status,
    )


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

"""Problem and Episode: what the single and the vector env have in common.

A `Problem` is what the arguments of the env say. An `Episode` is one flow with the baffles placed
so far; it plans its next rollout (`plan_reset`, `plan_step`) and `play` runs the plans of many
episodes as one batch. So the single env is a batch of one, and both give the same results.
"""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import resources
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from gns_env.actions import Actions
from gns_env.cache import Keep, RolloutCache, shared_cache
from gns_env.errors import EnvError, InvalidObjective, InvalidScenario, gymnasium_errors
from gns_env.objective import Objective, ObjectiveError
from gns_env.observation import Observer
from gns_env.scenario import Scenario, ScenarioSpace
from gns_env.task import BaffleTask, Evaluation, simulate
from gns_model.errors import GnsError
from gns_model.particles import fill
from gns_model.scene import Scene
from gns_model.simulator import Simulator, load_simulator

#: Scenarios drawn before giving up on ranges of which hardly any flow can be built or measured.
DRAWS = 100
#: Tasks of recent scenarios that a problem keeps.
KEPT_TASKS = 64


def flume() -> Scene:
    """The flume of Choi & Kumar, as shipped with the package (examples/flume.toml)."""
    with resources.as_file(resources.files("gns_env") / "scenes" / "flume.toml") as path:
        return Scene.from_toml(path)


class Problem:
    """The arguments of GranularBaffle-v0, checked; see the docstring of the env.

    Raises:
        EnvError: of the kinds in `gns_env.errors`.
    """

    def __init__(
        self,
        scene: Scene | str | os.PathLike[str] | None,
        simulator: Simulator | str | os.PathLike[str],
        *,
        n_baffles: int,
        placement: str,
        action: str,
        observation: str,
        objective: Objective | None,
        scenarios: str | Mapping[str, Any] | None,
        device: str,
        workers: int,
        cache: RolloutCache | None,
    ) -> None:
        with gymnasium_errors():
            if objective is not None and not isinstance(objective, Objective):
                raise InvalidObjective(f"the env takes one Objective, got {objective!r}")
            if scene is None:
                scene = flume()
            elif isinstance(scene, (str, os.PathLike)):
                scene = Scene.from_toml(scene)
            elif not isinstance(scene, Scene):
                raise EnvError(f"scene must be a Scene or the path of one, got {scene!r}")
            self._loaded = isinstance(simulator, (str, os.PathLike))
            if isinstance(simulator, (str, os.PathLike)):
                options: dict[str, Any] = {} if workers == 1 else {"workers": workers}
                simulator = load_simulator(simulator, device=device, **options)
            elif workers != 1:
                raise EnvError("workers are for a simulator given by name; give yours its own")
            self.simulator = simulator
            self.objective, self.n_baffles = objective, n_baffles
            self.cache = shared_cache() if cache is None else cache
            limits = getattr(getattr(simulator, "config", None), "limits", None)
            base = BaffleTask(
                scene, simulator, n_baffles=n_baffles, objective=objective, cache=self.cache
            )
            # One placement for all scenarios, so that an action means one place.
            self.scenarios = ScenarioSpace(base.scene, scenarios, limits)
            self._tasks: OrderedDict[Scenario, BaffleTask] = OrderedDict()
            self._tasks[self.scenarios.own] = base
            self.actions = Actions(base.space, placement, action)
            self.observer = Observer(base.scene, base.space, observation)
            if self.scenarios.ranges:
                self.draw(np.random.default_rng(0), None)  # refuse now what no reset could do

    def draw(
        self, rng: np.random.Generator, options: Mapping[str, Any] | None
    ) -> tuple[Scenario, BaffleTask]:
        """A scenario and its task; one that cannot be built is drawn again, if it was drawn.

        Raises:
            EnvError: if what the options fix cannot be built, or nothing drawn can.
        """
        ranges = self.scenarios.ranges_with(options)
        drawn = any(low < high for low, high in ranges.values())
        with gymnasium_errors():
            for attempt in range(DRAWS):
                scenario = self.scenarios.draw(rng, options)
                try:
                    return scenario, self.task(scenario)
                except GnsError as error:
                    if not drawn or attempt == DRAWS - 1:
                        raise InvalidScenario(f"no flow for {_say(scenario)}: {error}") from None
        raise AssertionError("unreachable")  # pragma: no cover

    def task(self, scenario: Scenario) -> BaffleTask:
        """The task of a scenario; one object for the same scenario, while it is remembered."""
        if scenario not in self._tasks:
            scene = self.scenarios.apply(scenario)
            spacing = getattr(self.simulator, "spacing", None)
            if spacing is not None:
                fill(scene, spacing)  # a release may have become too thin for the points
            self._tasks[scenario] = BaffleTask(
                scene,
                self.simulator,
                n_baffles=self.n_baffles,
                objective=self.objective,
                cache=self.cache,
            )
            if len(self._tasks) > KEPT_TASKS:
                self._tasks.popitem(last=False)
        self._tasks.move_to_end(scenario)
        return self._tasks[scenario]

    def close(self) -> None:
        """End the worker processes of a simulator that was given by name."""
        if self._loaded and hasattr(self.simulator, "close"):
            self.simulator.close()


@dataclass
class _Plan:
    """The next rollout of an episode: a step, or a reset if `rng` is given."""

    scenario: Scenario
    task: BaffleTask
    centres: NDArray[np.float64]
    moved: float = 0.0
    rng: np.random.Generator | None = None
    options: Mapping[str, Any] | None = None


class Episode:
    """One episode of `problem`: a flow, and the baffles placed so far.

    Attributes:
        state: Evaluation of the baffles that stand; None before the first reset.
        scenario, task: of this episode.
        reward: of the last step; 0 after a reset.
        over: whether it has ended.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.scenario = problem.scenarios.own
        self.task = problem.task(self.scenario)
        self.state: Evaluation | None = None
        self.reward, self.moved, self.over = 0.0, 0.0, False
        self._plan: _Plan | None = None

    def plan_reset(
        self, rng: np.random.Generator, options: Mapping[str, Any] | None = None
    ) -> None:
        """Begin anew: draw a scenario and ask for its flow without baffles.

        Raises:
            EnvError: as `Problem.draw`.
        """
        scenario, task = self.problem.draw(rng, options)
        nothing = task.space.as_centres([])
        self._plan = _Plan(scenario, task, nothing, rng=rng, options=options)

    def plan_step(self, action: Any) -> None:
        """Ask for the flow with the baffles of `action`, moved to the nearest buildable places.

        Raises:
            ResetNeeded: if the episode has not begun, or is over.
            InvalidAction: as `Actions.wish`.
        """
        if self.state is None or self.over:
            raise ResetNeeded("the episode is over or has not begun: call reset() first")
        actions, space = self.problem.actions, self.task.space
        wish, inside = actions.wish(action)
        if actions.joint:
            centres = space.project(inside)
        else:
            centres = np.vstack([self.state.centres, space.place(inside[0], self.state.centres)])
        moved = float(np.linalg.norm(centres[-actions.baffles :] - wish))
        self._plan = _Plan(self.scenario, self.task, centres, moved)

    def cancel(self) -> None:
        """Forget what was planned and not yet played."""
        self._plan = None

    def observation(self) -> Any:
        """What the policy is shown, freshly allocated."""
        assert self.state is not None
        scenario = self.problem.scenarios.observe(self.scenario)
        return self.problem.observer.observe(
            self.state, self.task.space, self.task.reference, scenario
        )

    def info(self) -> dict[str, Any]:
        """See the env, freshly allocated."""
        assert self.state is not None
        scenario = asdict(self.scenario)
        return {
            "centres": tuple(tuple(map(float, c)) for c in self.state.centres),
            "measures": dict(self.state.measures),
            "cost": float(self.state.cost),
            "status": self.state.status,
            "diverged": self.state.failed,
            "moved": self.moved,
            "scenario": {**scenario, "place": np.array(self.scenario.place)},
        }

    def _settle(self, evaluation: Evaluation) -> None:
        plan, before = self._plan, self.state
        assert plan is not None
        self._plan = None
        self.scenario, self.task, self.state = plan.scenario, plan.task, evaluation
        self.moved = plan.moved
        if plan.rng is not None or before is None:
            self.reward, self.over = 0.0, False
            return
        self.reward = float(before.cost - evaluation.cost)
        self.over = evaluation.failed or len(evaluation.centres) == self.problem.n_baffles


def play(episodes: Sequence[Episode], keep: Keep = "nothing") -> None:
    """Run what the episodes have planned as one batch, and bring each one forward.

    A flow without baffles that fails, or has nothing to improve on, is drawn again if its scenario
    was drawn.

    Args:
        keep: what to keep of each trajectory; "rest" to draw it.

    Raises:
        EnvError: if that flow is the only one there is.
    """
    for _ in range(DRAWS):
        plans = [(e, e._plan) for e in episodes if e._plan is not None]
        if not plans:
            return
        with gymnasium_errors():
            found = simulate([(p.task, p.centres) for _, p in plans], keep=keep)
        for (episode, plan), (outcome, trajectory) in zip(plans, found, strict=True):
            try:
                episode._settle(plan.task.judge(plan.centres, outcome, trajectory))
            except ObjectiveError as error:
                ranges = episode.problem.scenarios.ranges_with(plan.options)
                fixed = all(low == high for low, high in ranges.values())
                if plan.rng is None or fixed:
                    raise InvalidObjective(str(error)) from None
                episode.plan_reset(plan.rng, plan.options)
    raise InvalidObjective(f"{DRAWS} scenarios in a row have no flow without baffles to improve on")


def _say(scenario: Scenario) -> str:
    return ", ".join(
        f"{key} = {value:.4g}" if isinstance(value, float) else f"{key} = {value}"
        for key, value in asdict(scenario).items()
    )

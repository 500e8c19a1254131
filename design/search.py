"""One interface for all searches, in code: `optimize` a task, or take one gradient of it.

    import design
    from gns_env import BaffleTask

    task = BaffleTask(scene, "baffle-lite", n_baffles=3)
    result = design.optimize(task, method="hybrid", budget=48, seed=0)
    result.best.centres, result.best.cost, result.rollouts, result.backwards

What `gns-design optimize` does beyond that (run folder, verification, report) is in run.py.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import optuna

from design.campaign import Campaign
from design.evaluators import InProcess, differentiable
from design.gradient import cost_and_gradient
from design.methods import METHODS, choose
from design.outcome import Trial
from design.pareto import front
from design.rows import RowSpace
from design.rules import Rules
from design.settings import SettingError, check_pattern
from design.trials import TrialLog
from gns_env.task import BaffleTask

__all__ = ["Result", "cost_and_gradient", "optimize"]


@dataclass(frozen=True)
class Result:
    """What a search found and what it spent.

    Attributes:
        method: that searched.
        trials: every layout tried, in order.
        seconds: spent, all together.
    """

    method: str
    trials: tuple[Trial, ...]
    seconds: float

    @property
    def best(self) -> Trial | None:
        """The trial of least cost (of several objectives: of least sum), None if all failed.

        One that breaks a limit on the flow comes only where every one does.
        """
        return min((t for t in self.trials if t.ok), key=lambda t: t.order, default=None)

    @property
    def front(self) -> list[Trial]:
        """Of a task with several objectives, the trials that no other beats in all of them."""
        return front(self.trials)

    @property
    def rollouts(self) -> int:
        """Forward rollouts spent."""
        return sum(t.outcome.rollouts for t in self.trials)

    @property
    def backwards(self) -> int:
        """Backward passes spent."""
        return sum(t.outcome.backwards for t in self.trials)

    @property
    def curve(self) -> np.ndarray:
        """The least cost so far against passes spent, shape (trials, 2): passes, cost."""
        passes = np.cumsum([t.outcome.rollouts + t.outcome.backwards for t in self.trials])
        costs = [t.cost if t.outcome.feasible else np.inf for t in self.trials]
        return np.column_stack([passes, np.minimum.accumulate(costs)]).reshape(-1, 2)

    def __str__(self) -> str:
        best = self.best
        found = "no layout whose rollout reached its end" if best is None else f"{best.cost:.4f}"
        return (
            f"{self.method}: best cost {found}; {self.rollouts} rollouts, "
            f"{self.backwards} backward passes, {self.seconds:.1f} s"
        )


def optimize(
    task: BaffleTask,
    *,
    method: str | None = None,
    budget: int = 48,
    seed: int = 0,
    batch: int = 8,
    pattern: str = "free",
    baffle_cost: float = 0.0,
    concrete_cost: float = 0.0,
    on_trial: Callable[[Trial], None] = lambda trial: None,
) -> Result:
    """Search for a layout of small cost, in this process and in memory.

    Args:
        task: what to search; with several objectives, for their Pareto front. What its placement
            lets vary (`placement.vary`) is searched too, and its limits are kept.
        method: "random", "rows", "bayes", "tpe", "gp", "nsga2", "gradient", "lbfgs" or "hybrid";
            default: hybrid where the simulator has a gradient, else bayes.
        budget: passes through a rollout; a backward pass counts like a forward one. The flow
            without baffles comes on top.
        seed: of everything random.
        batch: layouts proposed at a time; each batch is one batched rollout.
        pattern: "free", or "rows" as an engineer draws them.
        baffle_cost, concrete_cost: of each baffle and m³ of concrete, in units of the objective.
        on_trial: called with every trial as it ends.

    Raises:
        MethodError: if there is no such method, or it cannot search this task.
        SettingError: for a budget, batch or seed out of range.
        ObjectiveError: if no cost can be relative to the flow without baffles.
    """
    for name, value, least in (("budget", budget, 1), ("batch", batch, 1), ("seed", seed, 0)):
        if value < least:
            raise SettingError(f"{name} must be {least} or more, got {value}")
    several = len(task.objectives)
    simulator = task.simulator
    check_pattern(pattern)
    method = choose(method, differentiable(simulator), several, simulator.name, pattern)
    began = time.perf_counter()
    study = optuna.create_study(directions=["minimize"] * several)
    evaluator = InProcess(task, rules=Rules.of(task.scene, baffle_cost, concrete_cost))
    if pattern == "rows":
        evaluator.space = RowSpace(task.scene, task.space.n_baffles)
    campaign = Campaign(TrialLog(study, evaluator.space), evaluator, budget, seed, batch, on_trial)
    METHODS[method](campaign)
    return Result(method, tuple(campaign.log.trials()), time.perf_counter() - began)

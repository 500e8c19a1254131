"""What a search works with: layouts to propose, an evaluator to run them, a log, and a budget."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import optuna

from design.space import Space
from design.trials import Outcome, Proposal, Trial, TrialLog


class Evaluator(Protocol):
    """Runs layouts, several at once; yields (index, outcome) as they end."""

    differentiable: bool

    def evaluate(self, layouts: Sequence[np.ndarray]) -> Iterator[tuple[int, Outcome]]:
        """One rollout a layout; each layout [m], shape (n, D-1)."""
        ...

    def differentiate(self, layouts: Sequence[np.ndarray]) -> Iterator[tuple[int, Outcome]]:
        """One rollout and one backward pass a layout; outcomes hold a gradient."""
        ...


class Search(Protocol):
    """A search: spends what is left of the campaign's budget and leaves trials in its log."""

    def __call__(self, campaign: Campaign) -> None: ...


@dataclass
class Campaign:
    """One search under way.

    Attributes:
        log: every trial so far, also those of an earlier run that is resumed.
        evaluator: runs layouts.
        budget: passes through a rollout to spend in all; a backward pass counts like a forward one.
        price: rollouts that one layout takes: one in each scenario.
        seed: of everything random.
        batch: layouts proposed before their results are looked at. Fixed, and not the number of
            workers, so that a seed gives the same search on every machine.
        on_trial: called with every new trial.
        salt: tells apart the machines that share one study.
    """

    log: TrialLog
    evaluator: Evaluator
    budget: int
    seed: int = 0
    batch: int = 8
    on_trial: Callable[[Trial], None] = lambda trial: None
    salt: int = 0
    price: int = 1

    @property
    def space(self) -> Space:
        """The buildable layouts."""
        return self.log.space

    @property
    def passes(self) -> int:
        """The budget in passes through a layout, all its scenarios together."""
        return self.budget // self.price

    def spent(self) -> int:
        """Passes through a layout so far, also those of an earlier run that is resumed."""
        return self.log.spent() // self.price

    def left(self) -> int:
        """Passes through a layout still to spend."""
        return max(self.passes - self.spent(), 0)

    def rng(self, *salt: int) -> np.random.Generator:
        """Randomness that depends on the seed and on how far the search is, so that a resumed
        search goes on as it would have."""
        return np.random.default_rng([self.seed, self.salt, len(self.log.trials()), *salt])

    def try_proposals(
        self, count: int, sampler: optuna.samplers.BaseSampler, origin: str
    ) -> list[Trial]:
        """Ask for `count` layouts, run them, tell their outcomes as they come."""
        proposals: list[Proposal] = []
        trials = []
        try:
            proposals = self.log.ask(count, sampler, origin)
            for k, outcome in self.evaluator.evaluate([p.centres for p in proposals]):
                trials.append(self.log.tell(proposals[k], outcome))
                self.on_trial(trials[-1])
        finally:
            self.log.abandon()
        return trials

    def run(self, layouts: Sequence[tuple[str, np.ndarray]]) -> None:
        """Run layouts (origin, centres [m]), a batch at a time, as far as the budget goes."""
        layouts = list(layouts)
        while layouts and (left := self.left()) > 0:
            now, layouts = layouts[: min(self.batch, left)], layouts[min(self.batch, left) :]
            for k, outcome in self.evaluator.evaluate([centres for _, centres in now]):
                self.record(*now[k], outcome)

    def record(self, origin: str, centres: np.ndarray, outcome: Outcome) -> Trial:
        """Put a layout that the log did not ask for on record."""
        trial = self.log.add(origin, centres, outcome)
        self.on_trial(trial)
        return trial

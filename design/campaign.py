"""What a search works with: layouts to propose, an evaluator to run them, a log, and a budget."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
import optuna

from design.outcome import Outcome, Trial
from design.space import Space
from design.trials import Proposal, TrialLog

#: How often a worker without budget looks whether the others have ended [s].
LOOK = 1.0


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
        """Passes through a layout so far, also those of an earlier run that is resumed and those
        that other workers on the study have spent or are spending."""
        return self.log.taken(self.price) // self.price

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
        self.catch_up()
        count = min(count, self.left())
        return self._run(lambda: self.log.ask(count, sampler, origin), self.evaluator.evaluate)

    def run(self, layouts: Sequence[tuple[str, np.ndarray]]) -> None:
        """Run layouts (origin, centres [m]), a batch at a time, as far as the budget goes."""
        layouts = list(layouts)
        while layouts and (left := self._left_after_others()) > 0:
            now, layouts = layouts[: min(self.batch, left)], layouts[min(self.batch, left) :]
            given = [centres for _, centres in now]
            ask = partial(self.log.reserve, now, self.price)
            self._run(ask, self.evaluator.evaluate, given)

    def differentiate(self, origin: str, layouts: Sequence[np.ndarray]) -> dict[int, Outcome]:
        """Run layouts [m], shape (n, D-1), forward and backward; outcomes by index, without those
        that another worker runs just now."""
        found: dict[int, Outcome] = {}
        self._run(
            lambda: self.log.reserve([(origin, c) for c in layouts], 2 * self.price),
            self.evaluator.differentiate,
            layouts,
            found,
        )
        return found

    def catch_up(self) -> None:
        """Run what workers that died, or an earlier run, asked for and did not tell."""
        while self._run(lambda: self.log.again(self.batch), self.evaluator.evaluate):
            pass

    def wait(self, watch: Callable[[int], None] = lambda trials: None) -> bool:
        """Wait until no other worker runs a trial, and take over from those that die.

        Returns:
            whether budget came back that the search may spend.
        """
        left = self.left()
        while True:
            self.catch_up()
            if self.left() > left:
                return True
            others = self.log.others()
            watch(len(others))
            if not others:
                return False
            time.sleep(LOOK)

    def _left_after_others(self) -> int:
        self.catch_up()
        return self.left()

    def _run(
        self,
        ask: Callable[[], list[Proposal]],
        evaluate: Callable[[Sequence[np.ndarray]], Iterator[tuple[int, Outcome]]],
        given: Sequence[np.ndarray] | None = None,
        found: dict[int, Outcome] | None = None,
    ) -> list[Trial]:
        """Ask, run and tell; `given`: the layouts as they are to be run, with their baffles in the
        order that they were given. `found`: outcomes by index."""
        trials = []
        try:
            proposals = ask()
            admitted = self.log.admit(proposals, self.budget, self.price) if proposals else []
            indices = [k for k, proposal in enumerate(admitted) if proposal is not None]
            layouts = [proposals[k].centres if given is None else given[k] for k in indices]
            for n, outcome in evaluate(layouts) if layouts else ():
                k = indices[n]
                trials.append(self.log.tell(proposals[k], outcome))
                if found is not None:
                    found[k] = outcome
                self.on_trial(trials[-1])
        finally:
            self.log.abandon()
        return trials

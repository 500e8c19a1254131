"""Bayesian search: an Optuna sampler proposes batches of layouts, each batch is one evaluation.

The sampler sees layouts through `parameters`, one point a layout. A point whose layout cannot be
built stands for the buildable layout nearest to it, so the cost is a function on the whole cube and
the sampler is told what its own proposal gave. (Told the parameters of the projected layout
instead, it never learns what its proposal was worth, and makes it again and again.)
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, IntDistribution
from optuna.trial import FrozenTrial

from design.baselines import engineering_layouts
from design.campaign import Campaign
from design.parameters import to_parameters
from design.trials import TrialLog

#: Trials, baselines included, before the model takes over.
LEAST_STARTUP = 10
#: Up to here a Gaussian process proposes, beyond it TPE. On the flume (three baffles, coarse MPM,
#: means of three seeds) the best cost after 32 and 64 rollouts was 1.287 and 1.281 with the process
#: and 1.314 and 1.303 with TPE (two seeds); the best baseline has 1.331. A proposal takes 0.1 to
#: 0.25 s of CPU, against 0.03 s with TPE.
MOST_PROCESS_TRIALS = 150
#: Generations that the budget of NSGA-II is divided into, and its largest population.
GENERATIONS, MOST_POPULATION = 5, 50


def search(campaign: Campaign, until: int | None = None, startup: int | None = None) -> None:
    """Baselines first, then batches of the sampler that suits the budget, to its end or `until`.

    `startup`: trials before its model takes over; default: as `sampler`.
    """
    few = campaign.passes <= MOST_PROCESS_TRIALS
    _search(campaign, "gp" if few else "tpe", "bayes", until, startup)


def tpe(campaign: Campaign) -> None:
    """Baselines, then a multivariate tree-structured Parzen estimator."""
    _search(campaign, "tpe")


def gp(campaign: Campaign) -> None:
    """Baselines, then a Gaussian process."""
    _search(campaign, "gp")


def nsga2(campaign: Campaign) -> None:
    """Baselines, then generations of NSGA-II."""
    _search(campaign, "nsga2")


def _search(
    campaign: Campaign,
    kind: str,
    origin: str = "",
    until: int | None = None,
    startup: int | None = None,
) -> None:
    """`origin`: what its trials are called; default: the kind of sampler."""
    enqueue_baselines(campaign)
    goal = campaign.passes if until is None else min(until, campaign.passes)
    while (left := goal - campaign.spent()) > 0:
        count = min(campaign.batch, left)
        campaign.try_proposals(count, sampler(campaign, kind, startup), origin or kind)


def enqueue_baselines(campaign: Campaign) -> None:
    """Have the engineering layouts tried first."""
    for origin, centres in engineering_layouts(campaign.space):
        campaign.log.enqueue(origin, centres)


def sampler(
    campaign: Campaign, kind: str, startup: int | None = None
) -> optuna.samplers.BaseSampler:
    """The sampler "tpe", "gp" or "nsga2" of the next batch.

    Made anew for each batch, so that resuming changes nothing.

    Args:
        startup: trials before a model takes over; until then layouts are random.
    """
    rng = campaign.rng()
    seed = int(rng.integers(2**31))
    # A model that knows little is better than no model: chance has half of the budget at most.
    if startup is None:
        startup = max(LEAST_STARTUP, 2 * len(campaign.log.distributions))
        startup = min(startup, max(campaign.passes // 2, 1))
    model: optuna.samplers.BaseSampler
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        if kind == "gp":
            model = optuna.samplers.GPSampler(n_startup_trials=startup, seed=seed)
        elif kind == "tpe":
            model = optuna.samplers.TPESampler(
                multivariate=True, constant_liar=True, n_startup_trials=startup, seed=seed
            )
        else:
            size = min(max(campaign.passes // GENERATIONS, LEAST_STARTUP), MOST_POPULATION)
            model = optuna.samplers.NSGAIISampler(population_size=size, seed=seed)
    return BuildableSampler(model, campaign.log, rng)


class BuildableSampler(optuna.samplers.BaseSampler):
    """Proposes what `model` does, and random buildable layouts before the model has seen enough."""

    def __init__(
        self, model: optuna.samplers.BaseSampler, log: TrialLog, rng: np.random.Generator
    ) -> None:
        self._model, self._log, self._rng = model, log, rng

    def before_trial(self, study: optuna.Study, trial: FrozenTrial) -> None:
        """A proposal takes a while: others are to know that somebody is at it."""
        self._log.hold(trial.number, trial._trial_id)
        self._model.before_trial(study, trial)

    def infer_relative_search_space(
        self, study: optuna.Study, trial: FrozenTrial
    ) -> dict[str, BaseDistribution]:
        """All parameters, also in a study without trials."""
        # A sampler may remember what it inferred, so it is asked although its answer is not
        # needed: the space here is the same for every trial.
        self._model.infer_relative_search_space(study, trial)
        return dict(self._log.distributions)

    def sample_relative(
        self, study: optuna.Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """Parameters of the next proposal."""
        wish = self._model.sample_relative(study, trial, search_space)
        if not wish:
            space = self._log.space
            return dict(to_parameters(space, space.random(self._rng)))
        # NSGA-II leaves out what it mutates: that is uniform.
        return {
            name: wish[name] if name in wish else self._uniform(distribution)
            for name, distribution in self._log.distributions.items()
        }

    def _uniform(self, distribution: BaseDistribution) -> float:
        if isinstance(distribution, IntDistribution):
            return int(self._rng.integers(distribution.low, distribution.high + 1))
        return float(self._rng.uniform())

    def sample_independent(
        self,
        study: optuna.Study,
        trial: FrozenTrial,
        param_name: str,
        param_distribution: BaseDistribution,
    ) -> Any:
        """Never needed: every parameter is sampled with the others."""
        raise AssertionError(f"{param_name} was not sampled with the others")

    def after_trial(self, *arguments: Any, **options: Any) -> None:
        """Let the model see what became of its proposal."""
        self._model.after_trial(*arguments, **options)

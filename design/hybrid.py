"""Hybrid search: Optuna looks around; then moves near the best and leaps along gradients, by turns.

After BO-Leap (Antonova et al. 2022): the landscape is rugged with useful local gradients, so a
global model chooses where to start and gradients finish the job. What is tried near the best moves
several baffles at once by up to a few widths, farther than a gradient sees and nearer than a model
of few trials looks. Every trial is told to the study. Whoever improves the best layout goes on;
whoever fails hands over.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from design import bayes
from design.campaign import Campaign
from design.chains import LEAST_STEP, STEP, Adam, Chain
from design.distinct import apart
from design.gradient import require_gradient

#: Most chains of a leap, and the passes of budget for each: long chains from few starts beat single
#: steps from many.
CHAINS, PASSES_A_CHAIN = 4, 40
#: Least and greatest standard deviation of a move near the best [m].
NEAR = (0.05, 0.3)
#: Least and greatest factor by which a layout is drawn together or spread.
SPREAD = (0.4, 1.4)
#: Moves that are drawn for a batch before those that are new are taken as they are.
MOST_TRIES = 100
#: Share of the budget in which Optuna looks for where to start. With 20 passes in the flume a leap
#: from the best engineering row did not pay in three pilot runs, and what Optuna's model found did.
EXPLORE = 0.7
#: A turn that lowers the best cost by less is over [-]. Starts of the same flow with other grains
#: differ by some thousandths.
GAIN = 5e-4


def search(campaign: Campaign) -> None:
    """Baselines and Optuna's batches; then turns near and from the best, to the end of the budget.

    Raises:
        SimulatorError: if the simulator has no gradient.
    """
    require_gradient(campaign)
    bayes.search(campaign, until=max(round(EXPLORE * campaign.passes), 1))
    chains: list[Chain] = []
    while campaign.left() > 0:
        look_near(campaign)
        chains = leap(campaign, chains)
        look_around(campaign)


def leap(campaign: Campaign, chains: Sequence[Chain] = ()) -> list[Chain]:
    """Gradient steps for as long as they pay, all chains together; returns the living chains.

    Without `chains`, or once Optuna has found better than they have, they start from the best
    layouts that no gradient has been taken at or near.
    """
    trials = sorted((t for t in campaign.log.trials() if t.ok), key=lambda t: t.outcome.merit)
    living = list(chains)
    if not trials:
        return living
    if not living or trials[0].outcome.merit < min(chain.best_cost for chain in living):
        leapt = [t.centres for t in trials if t.origin == "gradient"]
        leapt += campaign.log.at_work("gradient")  # by another worker
        count = min(CHAINS, max(campaign.passes // PASSES_A_CHAIN, 1))
        origins = apart([t.centres for t in trials], STEP, count, avoid=leapt)
        living = [Adam(campaign.space, origin) for origin in origins]
    paying = True
    while living and paying and campaign.left() >= 2:
        living = living[: campaign.left() // 2]
        before = [chain.best_cost for chain in living]
        outcomes = campaign.differentiate("gradient", [chain.centres for chain in living])
        # What another worker runs just now is the other's chain.
        mine = [(before[k], living[k]) for k in sorted(outcomes)]
        for (_, chain), k in zip(mine, sorted(outcomes), strict=True):
            chain.learn(outcomes[k])
        paying = any(b - chain.best_cost > GAIN for b, chain in mine)
        living = [chain for _, chain in mine if chain.step >= LEAST_STEP]
    return living


def look_near(campaign: Campaign) -> None:
    """Batches of moves from the best layout for as long as they pay, one at least."""
    paying = True
    while paying and campaign.left() > 0:
        best = campaign.log.best()
        if best is None:
            return
        rng = campaign.rng(4)
        known = [t.centres for t in campaign.log.trials()]
        moved: list[np.ndarray] = []
        count = min(campaign.batch, max(campaign.left() // 3, 1))  # the rest is for leaps
        for _ in range(MOST_TRIES):
            if len(moved) == count:
                break
            layout = campaign.log.buildable(_near(campaign, best.centres, rng))
            moved += apart([layout], LEAST_STEP, 1, avoid=[*known, *moved])
        if not moved:
            return
        campaign.run([("near", layout) for layout in moved])
        found = campaign.log.best()
        paying = found is not None and best.outcome.merit - found.outcome.merit > GAIN


def _near(campaign: Campaign, centres: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A layout near `centres` [m]: spread or drawn together as a whole, or moved one by one."""
    plan = campaign.space.scene.dim - 1
    moved: np.ndarray = centres.copy()
    scale = np.exp(rng.uniform(np.log(NEAR[0]), np.log(NEAR[1])))
    if rng.random() < 0.5:
        middle = moved[:, :plan].mean(axis=0)
        factor = np.exp(rng.uniform(np.log(SPREAD[0]), np.log(SPREAD[1]), plan))
        moved[:, :plan] = middle + factor * (moved[:, :plan] - middle)
        moved[:, :plan] += rng.normal(0.0, scale, plan)
    else:
        some = rng.random(len(moved)) < rng.uniform(0.3, 1.0)
        moved[:, :plan] += some[:, None] * rng.normal(0.0, scale, (len(moved), plan))
    moved[:, plan:] += rng.normal(0.0, scale, moved.shape[1] - plan)  # the form, which all share
    return moved


def look_around(campaign: Campaign) -> None:
    """Batches of Optuna's for as long as they pay, one at least."""
    paying = True
    while paying and campaign.left() > 0:
        best = campaign.log.best()
        bayes.search(campaign, until=campaign.spent() + campaign.batch)
        found = campaign.log.best()
        if best is None or found is None:
            return
        paying = best.outcome.merit - found.outcome.merit > GAIN

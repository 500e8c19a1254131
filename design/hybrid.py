"""Hybrid search: Optuna looks around, gradients leap from the best, by turns, as long as each pays.

After BO-Leap (Antonova et al. 2022): the landscape is rugged with useful local gradients, so a
global model chooses where to start and gradients finish the job. Steps of a leap are told back to
the study as trials. Whoever improves the best layout goes on; whoever fails hands over.
"""

from __future__ import annotations

from collections.abc import Sequence

from design import bayes
from design.baselines import engineering_layouts
from design.campaign import Campaign
from design.chains import LEAST_STEP, STEP, Adam, Chain
from design.distinct import apart
from design.gradient import require_gradient

#: Most chains of a leap, and the passes of budget for each: long chains from few starts beat single
#: steps from many.
CHAINS, PASSES_A_CHAIN = 4, 40
#: Trials before Optuna's model takes over. The baselines and the first steps of a leap tell it more
#: than as many layouts by chance would.
STARTUP = 6
#: A turn that lowers the best cost by less is over [-]. Starts of the same flow with other grains
#: differ by some thousandths.
GAIN = 5e-4


def search(campaign: Campaign) -> None:
    """Baselines; then leaps and batches by turns until the budget is spent.

    Raises:
        SimulatorError: if the simulator has no gradient.
    """
    require_gradient(campaign)
    baselines = len(list(engineering_layouts(campaign.space)))
    bayes.search(campaign, until=min(baselines, max(campaign.passes // 2, 1)))
    chains: list[Chain] = []
    while campaign.left() > 0:
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


def look_around(campaign: Campaign) -> None:
    """Batches of Optuna's for as long as they pay, one at least."""
    paying = True
    while paying and campaign.left() > 0:
        best = campaign.log.best()
        bayes.search(campaign, until=campaign.spent() + campaign.batch, startup=STARTUP)
        found = campaign.log.best()
        if best is None or found is None:
            return
        paying = best.outcome.merit - found.outcome.merit > GAIN

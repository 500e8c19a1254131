"""Hybrid search: Optuna looks around, gradients leap from the best, and it learns from the leaps.

After BO-Leap (Antonova et al. 2022): the landscape is rugged with useful local gradients, so a
global model chooses where to start and gradients finish the job. Steps of a leap are told back to
the study as trials.
"""

from __future__ import annotations

from design import bayes
from design.campaign import Campaign
from design.chains import STEP
from design.distinct import apart
from design.gradient import descend, require_gradient

#: Share of the budget that is sampled before the first leap, and the share of each leap. A gradient
#: takes about four rollouts of time and counts two, so leaps are the smaller part.
EXPLORE, LEAP = 0.6, 0.25
#: Most chains of one leap, and the fewest gradients of a chain: long chains from few starts beat
#: single steps from many.
CHAINS, LEAST_GRADIENTS = 4, 3


def search(campaign: Campaign) -> None:
    """Most of the budget on sampling, then leaps and batches by turns.

    Raises:
        SimulatorError: if the simulator has no gradient.
    """
    require_gradient(campaign)
    bayes.search(campaign, until=round(EXPLORE * campaign.passes))
    while campaign.left() > 0:
        leap(campaign)
        bayes.search(campaign, until=campaign.spent() + campaign.batch)


def leap(campaign: Campaign) -> None:
    """Gradient steps from the best layouts that no gradient has been taken at or near."""
    budget = min(round(LEAP * campaign.passes), campaign.left())
    count = min(CHAINS, max(budget // (2 * LEAST_GRADIENTS), 1))
    trials = sorted((t for t in campaign.log.trials() if t.ok), key=lambda t: t.cost)
    leapt = [t.centres for t in trials if t.origin == "gradient"]
    descend(campaign, apart([t.centres for t in trials], STEP, count, avoid=leapt), budget)

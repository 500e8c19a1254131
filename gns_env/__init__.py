"""The Gymnasium face: what may be placed where, what to make small, and GranularBaffle-v0.

`import gns_env` registers the environment; `gymnasium.make("gns_env:GranularBaffle-v0")` imports
it by itself.
"""

import gymnasium

from gns_env.cache import RolloutCache
from gns_env.layout import LayoutSpace
from gns_env.objective import FAILURE_COST, Objective, ObjectiveError
from gns_env.task import BaffleTask, Evaluation

__all__ = [
    "FAILURE_COST",
    "BaffleTask",
    "Evaluation",
    "LayoutSpace",
    "Objective",
    "ObjectiveError",
    "RolloutCache",
]

if "GranularBaffle-v0" not in gymnasium.registry:
    gymnasium.register(
        id="GranularBaffle-v0",
        entry_point="gns_env.env:GranularBaffleEnv",
        vector_entry_point="gns_env.vector_env:GranularBaffleVectorEnv",
    )

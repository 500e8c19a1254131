"""Training of learned simulators: `Recipe` says what, `train` does it, `launch` on many ranks."""

from __future__ import annotations

from gns_model.training.claim import TrainingError
from gns_model.training.launching import launch
from gns_model.training.loop import train
from gns_model.training.recipe import Recipe, RecipeError

__all__ = ["Recipe", "RecipeError", "TrainingError", "launch", "train"]

"""Learning rate over the budget, and the moving average of the weights."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from gns_model.training.recipe import Recipe


def learning_rate(recipe: Recipe, step: int, progress: float) -> float:
    """Learning rate of optimiser step `step`, with `progress` in [0, 1] of the budget behind it.

    "cosine" rises linearly over the first `warmup` of the budget and falls to zero at its end
    (Loshchilov & Hutter 2017). "exponential" is Choi & Kumar's lr · 0.1^(step / decay_steps).
    """
    if recipe.schedule == "exponential":
        return recipe.learning_rate * 0.1 ** (step / recipe.decay_steps)
    progress = min(max(progress, 0.0), 1.0)
    # A run timed in minutes begins at progress 0, where a rate of zero would waste steps.
    rise = min(1.0, max(progress / recipe.warmup, 0.02)) if recipe.warmup else 1.0
    fall = max(0.0, (progress - recipe.warmup) / max(1e-9, 1.0 - recipe.warmup))
    return recipe.learning_rate * rise * 0.5 * (1 + math.cos(math.pi * fall))


class MovingAverage:
    """Exponential moving average of a module's parameters (Polyak averaging).

    The decay grows from 0.1 to `decay`, so that the random start is forgotten at once.
    """

    def __init__(self, module: nn.Module, decay: float) -> None:
        self.decay = decay
        self.weights: dict[str, Tensor] = {
            name: p.detach().clone() for name, p in module.named_parameters()
        }

    @torch.no_grad()
    def update(self, module: nn.Module, step: int) -> None:
        """Take in the parameters after optimiser step `step` (counted from 0)."""
        decay = min(self.decay, (1 + step) / (10 + step))
        for name, p in module.named_parameters():
            self.weights[name].lerp_(p, 1 - decay)

    @torch.no_grad()
    def copy_to(self, module: nn.Module) -> None:
        """Overwrite the parameters of `module` with the averages."""
        for name, p in module.named_parameters():
            p.copy_(self.weights[name])

"""A recipe: everything that decides what a training run makes, in one small TOML file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from gns_model.errors import GnsError, first_fault
from gns_model.files import write_whole
from gns_model.learned.config import ModelConfig
from gns_model.learned.precision import Precision
from gns_model.particles import MOVING
from gns_model.toml import read_toml, toml_text

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]


#: What of a model follows from the flows that it is trained on.
FILLED_IN = {"model": {"limits", "jitter"}}


class RecipeError(GnsError, ValueError):
    """A recipe that cannot be trained: the message names the key, the value and what is allowed."""


class Recipe(BaseModel):
    """What to train, on what, for how long. Frozen; unknown keys are refused.

    The folders are relative to the directory that training is started in.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    name: str = "model"
    #: Architecture and resolution. Its `noise_std` is the noise of the training, too; its
    #: `limits` and `jitter` are filled in from the training flows.
    model: ModelConfig = ModelConfig()

    #: Begin with the weights of this model (shipped, or a checkpoint folder), not random ones.
    start_from: str | None = None

    train: tuple[str, ...] = Field(min_length=1)  #: folders of trajectory files
    valid: tuple[str, ...] = ()  #: folders of held-out ones; without any, the last model is kept
    #: Use only flows that are let go, not thrown: impacts hold nearly all the squares of a loss,
    #: and a column never sees one.
    at_rest: bool = False
    #: Learn from a flow until it comes to a wall that it did not stand at, and no further: what
    #: follows is an impact, too. See `gns_model.data.impact`.
    before_impact: bool = False
    valid_rollouts: Count = 8  #: trajectories that a validation simulates, spread over the ranks
    valid_windows: Count = 32  #: windows of the one-step validation loss

    steps: Count | None = None  #: optimiser steps, or ...
    minutes: Positive | None = None  #: ... time to spend, earlier runs that it resumes included
    edges_per_batch: Count = 60_000  #: of one rank; a batch holds at least one window
    #: "adam", or "descent": plain steps along the running mean of the clipped gradients, of
    #: `learning_rate` in length where all agree. For `flow_share`: the gradient of a flow lies in
    #: few directions, and Adam makes a step in all of the rest, too.
    optimiser: Literal["adam", "descent"] = "adam"
    learning_rate: Positive = 2e-3
    #: "cosine": warm-up, then to zero at the end of the budget. "exponential": the paper's,
    #: tenfold lower every `decay_steps`.
    schedule: Literal["cosine", "exponential"] = "cosine"
    warmup: Fraction = 0.02  #: of the budget
    decay_steps: Count = 5_000_000
    weight_decay: NonNegative = 1e-4
    #: Error in standard deviations beyond which the loss grows linearly; none: squares all the way.
    linear_beyond: Positive | None = None
    #: Weight of the error that all points of a scene share; see `loss.Emphasis`.
    momentum_weight: NonNegative = 0.0
    local_weight: NonNegative = 0.0  #: likewise of the mean error of a cell of some grains
    front_weight: NonNegative = 0.0  #: likewise of the front of a scene
    tip_weight: NonNegative = 0.0  #: likewise of the tip of that
    strain_weight: NonNegative = 0.0  #: likewise of how the error strains a scene and its cells
    #: Errors count relative to what accelerates their scene, this much more [standard deviations].
    relative_to: Positive | None = None
    scenes_alike: bool = False  #: every scene of a batch counts the same, however many its points
    early: Fraction = 0.0  #: share of windows from the first `early_steps` steps of a rollout
    early_steps: Count = 8  #: 0.16 s at a stride of 0.02 s: a release turns into a flow
    clip_norm: Positive = 1.0  #: of the whole gradient
    ema_decay: Annotated[float, Field(ge=0, lt=1)] = 0.999
    #: Smooth noise on the accelerations of the history, as a share of them; see `noise`. With it a
    #: model must tell from the state what drives it, and does not repeat what it did last.
    acceleration_noise: NonNegative = 0.0
    mirror: bool = True  #: show every other window in a mirror (`augment`)
    #: Show every other window of a symmetric 2D flow as half of it against a wall (`data.halves`).
    halves: bool = False
    statistics_windows: Count = 256  #: windows that the normalisation is measured on

    unroll: Count = 1  #: steps K of the unrolled phase
    unroll_fraction: Fraction = 0.0  #: last part of the budget that is unrolled
    #: Steps in which the unrolled phase asks the model to make up for its drift; see `loss`.
    return_steps: Annotated[float, Field(ge=1, allow_inf_nan=False)] | None = None
    #: Flows that each rank keeps rolling by the model itself in the unrolled phase, in place of K
    #: steps for every window, and the most steps of one; few more than a batch holds, or the model
    #: learns late what it does wrong. See `replay`. 0: none.
    replay: Annotated[int, Field(ge=0)] = 0
    replay_steps: Count = 40
    #: States of those flows that each rank keeps and trains on, in place of those of the moment,
    #: which make it swing: about what the flows make in ten times `replay_steps` turns. 0: none.
    replay_memory: Annotated[int, Field(ge=0)] = 0
    #: `relative_to` of their states, whose way back would drown the rest; none: as of all others.
    replay_relative_to: Positive | None = None
    #: Ask them back to where true grains are, whichever grain is which, and not every grain to its
    #: own place, which takes the tip off a front; see `exchange`.
    replay_exchange: bool = False
    #: Share of the steps that are about them; the others look at true states and keep them right.
    replay_share: Fraction = 0.5
    #: Share of the steps of the unrolled phase, taken before that of `replay`, that train through
    #: whole flows (`flows`): what such a step costs is about `flow_edges`, the edges of this rank's
    #: flows summed over their steps, of which a flow has at most `flow_steps`.
    flow_share: Fraction = 0.0
    flow_steps: Count = 100
    flow_edges: Count = 1_000_000
    #: Let gradients flow through all K steps; else only through each step's own (push-forward).
    backprop_through_unroll: bool = False

    device: Literal["auto", "cpu", "cuda"] = "auto"
    precision: Precision = "float32"  #: of matrix products; "auto": bfloat16 where that is faster
    compile: bool = False  #: the network by torch.compile; on a CPU it needs g++ and a minute
    threads: Count = 1  #: of every CPU rank
    seed: Annotated[int, Field(ge=0)] = 0
    checkpoint_minutes: Positive = 5.0
    validate_minutes: Positive = 15.0

    @model_validator(mode="after")
    def _consistent(self) -> Recipe:
        if (self.steps is None) == (self.minutes is None):
            raise ValueError("give either steps or minutes, one of the two")
        if self.replay and self.return_steps is None:
            raise ValueError(
                "replay needs return_steps: how fast a flow is asked back to the truth"
            )
        if self.acceleration_noise and self.model.history < 2:
            raise ValueError(
                "acceleration_noise needs model.history of at least 2: one velocity tells no "
                "acceleration"
            )
        if 0 < self.model.types <= MOVING:
            raise ValueError(
                f"model.types must be 0 or at least {MOVING + 1}; moving points have type {MOVING}"
            )
        return self

    def unrolled(self, progress: float) -> bool:
        """Whether a step with `progress` in [0, 1] of the budget behind it belongs to the last
        phase, which may ask for errors of states that the model itself made."""
        several = self.unroll > 1 or self.replay > 0 or self.flow_share > 0
        return several and progress >= 1 - self.unroll_fraction

    @classmethod
    def from_toml(cls, path: str | os.PathLike[str]) -> Recipe:
        """Read a recipe.

        Raises:
            RecipeError: if it is missing, is not TOML or is not a recipe; one line.
        """
        return cls.from_dict(read_toml(Path(path), RecipeError), source=str(path))

    def to_toml(self, path: str | os.PathLike[str]) -> None:
        """Write the recipe, as `from_toml` reads it, without what training fills in."""
        values = self.model_dump(mode="json", exclude_none=True, exclude=FILLED_IN)
        write_whole(Path(path), toml_text(values).encode())

    @classmethod
    def from_dict(cls, values: dict[str, Any], source: str = "recipe") -> Recipe:
        """A recipe from plain values.

        Raises:
            RecipeError: one line that names the key, the value and what is allowed.
        """
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            fault = first_fault(error, "recipe", "gns_model/training/recipe.py")
            raise RecipeError(f"{source}: {fault}") from None

"""What a run starts from, checked, and what it writes about itself beside the weights."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gns_model.data.impact import frames_before_impact
from gns_model.data.windows import Source, WindowIndex
from gns_model.learned.config import Limits, ModelConfig
from gns_model.learned.model import LearnedModel
from gns_model.particles import MOVING, STATIONARY
from gns_model.training.distributed import Ranks
from gns_model.training.kinematic import kinematic_spacing
from gns_model.training.recipe import Recipe, RecipeError
from gns_model.training.schedule import MovingAverage
from gns_model.training.state import Position, parse_state, restore
from gns_model.training.statistics import measure
from gns_model.training.transfer import inherit
from gns_model.training.validation import Scores


def open_data(recipe: Recipe, folders: tuple[str, ...], *, learn: bool = False) -> WindowIndex:
    """The windows that `recipe` reads from `folders`, every file checked.

    Args:
        learn: leave out the steps that are no matter of the model: those that the solver takes
            and, with `before_impact`, those at the end. Rollouts are judged on whole flows.

    Raises:
        FileFormatError, RecipeError: as `train`.
    """
    index = WindowIndex(
        folders,
        spacing=recipe.model.spacing,
        dt=recipe.model.dt,
        history=recipe.model.history,
        unroll=recipe.unroll,
        begin=recipe.model.solver_steps if learn else 0,
    )
    if index.dim != recipe.model.dim:
        raise RecipeError(
            f"{folders[0]}: {index.dim}D trajectories, but model.dim = {recipe.model.dim}"
        )
    if recipe.at_rest:
        index.sources = [s for s in index.sources if _begins_at_rest(s)]
        if not index.sources:
            raise RecipeError(f"{folders[0]}: at_rest = true, but every flow in it is thrown")
    for source in index.sources:
        _check_fits(recipe.model, source)
    if learn and recipe.before_impact:
        _stop_at_impacts(index, folders[0])
    return index


def _stop_at_impacts(index: WindowIndex, folder: str) -> None:
    """Shorten every flow to what comes before it strikes a wall, in place."""
    index.sources = [
        replace(s, frames=frames_before_impact(s, index.spacing)) for s in index.sources
    ]
    struck = [s for k, s in enumerate(index.sources) if index.starts(k) < 1]
    index.skipped |= {s.path: "strike a wall at once" for s in struck}
    index.sources = [s for s in index.sources if s.path not in index.skipped]
    if not index.sources:
        raise RecipeError(
            f"{folder}: before_impact = true, but every flow in it strikes a wall at once"
        )


def _begins_at_rest(source: Source) -> bool:
    return not any(any(release.velocity) for release in source.scene.releases)


def _check_fits(model: ModelConfig, source: Source) -> None:
    """Refuse data that holds what the model cannot see.

    Raises:
        RecipeError: naming the file and the key.
    """
    kinds = np.array([MOVING]) if source.particle_type is None else source.particle_type
    if model.types and kinds.max() >= model.types:
        raise RecipeError(
            f"{source.path}: particle type {kinds.max()}, but model.types = {model.types} embeds "
            f"0 to {model.types - 1}"
        )
    if model.baffles == "distance" and (kinds == STATIONARY).any():
        raise RecipeError(
            f'{source.path}: holds kinematic points, but model.baffles = "distance" sees boxes; '
            'use "points"'
        )
    if model.baffles == "none" and source.scene.baffles:
        raise RecipeError(f'{source.path}: has baffles, but model.baffles = "none" sees none')
    known = {"tan_friction_angle"} if source.tan_friction is not None else set()
    missing = sorted(set(model.material_features) - known)
    if source.foreign and missing:
        raise RecipeError(
            f"{source.path}: nothing is known of its {missing[0]}, which model.material_features "
            "asks for"
        )


#: What of a model's configuration the weights do not depend on: it may change on the way.
FREE = {"noise_std", "subcells", "bounds", "solver_steps"}
#: Of the running mean of the gradients, for "descent": the mean of about ten steps.
MOMENTUM = 0.9


def check_resumable(recipe: Recipe, position: Position) -> None:
    """Refuse to go on with another network, optimiser or seed.

    Budget, rate, data and noise may change.

    Raises:
        RecipeError: naming the first key that differs.
    """
    wanted = {**_architecture(recipe), "seed": recipe.seed}
    wanted = {key: value for key, value in wanted.items() if key not in FREE}
    # A state that is older than an option was trained with its default.
    found = {**ModelConfig().model_dump(mode="json"), "optimiser": "adam", **position.architecture}
    found["seed"] = position.seed
    for key in wanted:
        if wanted[key] != found.get(key):
            raise RecipeError(
                f"cannot resume: {key} = {wanted[key]!r}, but the saved state has "
                f"{found.get(key)!r}; use another output folder or start anew"
            )


def _architecture(recipe: Recipe) -> dict[str, Any]:
    """What a state is a state of."""
    return {**recipe.model.model_dump(mode="json"), "optimiser": recipe.optimiser}


@dataclass
class Run:
    """What changes from step to step."""

    model: LearnedModel
    average: MovingAverage
    optimiser: torch.optim.Optimizer
    position: Position


def optimiser_of(recipe: Recipe, model: LearnedModel) -> torch.optim.Optimizer:
    """What `recipe.optimiser` names, for all weights of the model."""
    weights, rate, decay = model.parameters(), recipe.learning_rate, recipe.weight_decay
    if recipe.optimiser == "descent":
        return torch.optim.SGD(
            weights, lr=rate, weight_decay=decay, momentum=MOMENTUM, dampening=MOMENTUM
        )
    return torch.optim.AdamW(weights, lr=rate, weight_decay=decay)


def begin(recipe: Recipe, data: WindowIndex, state_file: Path, ranks: Ranks, resume: bool) -> Run:
    """A new run, or the one that `state_file` holds, the same on all ranks.

    Rank 0 alone reads the file and measures the data; the others need not see its disk.

    Raises:
        FileFormatError, RecipeError: as `train`.
    """
    torch.manual_seed(recipe.seed)
    known = {
        "limits": Limits.of(source.scene for source in data.sources),
        # Several subcells make starts of their own. 0 as soon as one flow is of a lattice.
        "jitter": min(s.jitter for s in data.sources) if recipe.model.subcells == 1 else 0.0,
    }
    config = recipe.model.model_copy(update=known)
    model = LearnedModel(config).to(ranks.device)
    average = MovingAverage(model, recipe.ema_decay)
    optimiser = optimiser_of(recipe, model)
    there = resume and ranks.rank == 0 and state_file.exists()
    content = ranks.share(state_file.read_bytes() if there else None)
    if content:
        position, tensors = parse_state(content, state_file)
        check_resumable(recipe, position)
        restore(tensors, model, average, optimiser, state_file)
        return Run(model, average, optimiser, position)
    measured = None
    if ranks.rank == 0:
        statistics = measure(
            data,
            windows=recipe.statistics_windows,
            radius=config.radius,
            noise_std=config.noise_std,
            subtract_gravity=config.subtract_gravity,
            kinematic=kinematic_spacing(config),
            seed=recipe.seed,
        )
        measured = Position(0, 0.0, None, 0.0, 0.0, statistics, _architecture(recipe), recipe.seed)
    position = Position.from_json(ranks.share(measured.to_json().encode() if measured else None))
    position.statistics.apply(model)
    if recipe.start_from is not None:
        inherit(model, recipe.start_from)
    ranks.follow([*model.parameters(), *model.buffers()])
    return Run(model, MovingAverage(model, recipe.ema_decay), optimiser, position)


def card(
    recipe: Recipe, position: Position, data: WindowIndex, scores: Scores | None
) -> dict[str, Any]:
    """What `save_model` writes beside the weights about how they came to be."""
    about: dict[str, Any] = {
        "name": recipe.name,
        "trained_on": {
            "trajectories": len(data.sources),
            "steps": position.step,
            "minutes": round(position.seconds / 60, 2),
            "recipe": recipe.model_dump(mode="json", exclude={"model"}),
            "torch": torch.__version__,
        },
    }
    if scores is not None:
        about["validation"] = {k: v if math.isfinite(v) else None for k, v in scores.row().items()}
    return about

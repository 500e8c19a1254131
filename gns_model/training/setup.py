"""What a run starts from, checked, and what it writes about itself beside the weights."""

from __future__ import annotations

import math
from typing import Any

import torch

from gns_model.data.windows import WindowIndex
from gns_model.training.recipe import Recipe, RecipeError
from gns_model.training.state import Position
from gns_model.training.validation import Scores


def open_data(recipe: Recipe, folders: tuple[str, ...]) -> WindowIndex:
    """The windows that `recipe` reads from `folders`, every file checked.

    Raises:
        FileFormatError, RecipeError: as `train`.
    """
    index = WindowIndex(
        folders,
        spacing=recipe.model.spacing,
        dt=recipe.model.dt,
        history=recipe.model.history,
        unroll=recipe.unroll,
    )
    if index.dim != recipe.model.dim:
        raise RecipeError(
            f"{folders[0]}: {index.dim}D trajectories, but model.dim = {recipe.model.dim}"
        )
    return index


#: What of a model's configuration the weights do not depend on: it may change on the way.
FREE = {"noise_std", "subcells"}


def check_resumable(recipe: Recipe, position: Position) -> None:
    """Refuse to go on with another network or seed; budget, rate, data and noise may change.

    Raises:
        RecipeError: naming the first key that differs.
    """
    wanted = {**recipe.model.model_dump(mode="json", exclude=FREE), "seed": recipe.seed}
    found = {**position.architecture, "seed": position.seed}
    for key in wanted:
        if wanted[key] != found.get(key):
            raise RecipeError(
                f"cannot resume: {key} = {wanted[key]!r}, but the saved state has "
                f"{found.get(key)!r}; use another output folder or start anew"
            )


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

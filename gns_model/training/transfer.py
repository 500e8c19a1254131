"""Transfer learning: start a model from the weights of another one.

The paper names it among its next steps; here it saves most of the hours: a model that knows how
grains collapse at one friction angle needs few examples more to learn what the angle changes.
"""

from __future__ import annotations

import torch

from gns_model.errors import GnsError
from gns_model.learned.config import ModelConfig
from gns_model.learned.model import LearnedModel
from gns_model.training.recipe import RecipeError

#: What may differ between the two configurations: the weights do not depend on it, or, for the
#: material features, `inherit` makes room.
FREE = {"noise_std", "subcells", "limits", "bounds", "solver_steps", "material_features"}

_FIRST = "network.encode_vertex.layers.0.weight"


@torch.no_grad()
def inherit(model: LearnedModel, start_from: str) -> None:
    """Copy weights and normalisation of the model `start_from` into `model`, in place.

    Material features that only `model` has get weights of zero: it begins by ignoring them, and
    moves points exactly as its parent does.

    Args:
        start_from: a shipped model or a checkpoint folder.

    Raises:
        RecipeError: if there is no such learned model, or its architecture is another one.
    """
    from gns_model.simulator import load_simulator

    try:
        parent = getattr(load_simulator(start_from), "model", None)
    except GnsError as error:
        raise RecipeError(f"start_from: {error}") from None
    if not isinstance(parent, LearnedModel):
        raise RecipeError(f"start_from = {start_from!r} is no learned model")
    mine, theirs = model.config, parent.config
    _check(mine, theirs, start_from)
    state = parent.state_dict()
    own, known = mine.material_features, theirs.material_features
    if own != known:
        weight = state[_FIRST]
        # Inputs of the vertex encoder: motion and surroundings, material, type embedding.
        begin = theirs.vertex_inputs - len(known)
        columns = {name: weight[:, begin + k] for k, name in enumerate(known)}
        material = [columns.get(name, torch.zeros_like(weight[:, 0])) for name in own]
        after = weight[:, begin + len(known) :]
        state[_FIRST] = torch.cat([weight[:, :begin], torch.stack(material, dim=1), after], dim=1)
    model.load_state_dict(state)


def _check(mine: ModelConfig, theirs: ModelConfig, name: str) -> None:
    wanted = mine.model_dump(mode="json", exclude=FREE)
    found = theirs.model_dump(mode="json", exclude=FREE)
    for key, value in wanted.items():
        if value != found[key]:
            raise RecipeError(
                f"start_from = {name!r}: its {key} is {found[key]!r}, the recipe's {value!r}"
            )
    dropped = set(theirs.material_features) - set(mine.material_features)
    if dropped:
        raise RecipeError(
            f"start_from = {name!r}: it sees {', '.join(sorted(dropped))}, which the recipe's "
            "model.material_features leaves out"
        )

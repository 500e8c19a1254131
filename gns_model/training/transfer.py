"""Transfer learning: start a model from the weights of another one.

The paper names it among its next steps; here it saves most of the hours: a model that knows how
grains collapse at one friction angle needs few examples more to learn what the angle changes.

The parent may be of another scale. Friction has no length and no time of its own, so that a flow of
grains without cohesion whose lengths are λ times as large is the same flow in times √λ times as
long (Froude similarity): a model whose lengths are all λ times its parent's moves its points as the
parent does once the speeds that it is normalised by are √λ times the parent's.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gns_model.errors import GnsError
from gns_model.learned.config import ModelConfig
from gns_model.learned.model import LearnedModel
from gns_model.training.recipe import RecipeError

#: What may differ between the two configurations: the weights do not depend on it, or, for the
#: last five, `inherit` makes room.
FREE = {
    "noise_std", "subcells", "limits", "jitter", "bounds", "solver_steps", "crowding_limit",
    "material_features", "depth_range", "strain_unit", "history", "blocks",
}  # fmt: skip

#: What is as long as the scale. What strain and depth are measured in does not grow with it.
LENGTHS = ("spacing", "radius", "wall_range", "baffle_range")
#: By how much a stride may be longer or shorter than similarity asks for [-]. Accelerations hardly
#: depend on the stride over which they are averaged, and a dataset has a stride of its own.
STRIDE_TOLERANCE = 0.1

_FIRST = "network.encode_{}.layers.0.weight"
_BLOCK = "network.blocks."


@torch.no_grad()
def inherit(model: LearnedModel, start_from: str) -> None:
    """Copy weights and normalisation of the model `start_from` into `model`, in place.

    Material, depth and strain features and earlier velocities that only `model` has get weights of
    zero: it begins by ignoring them, and moves points exactly as its parent does, or, if its
    lengths are λ times the parent's, as the parent does a flow of that scale. Where its history is
    the shorter one, it begins as if every point had always moved as in the first velocity that it
    sees. Blocks that it has more of stand between its parent's and pass on what they are given,
    until training gives them something to add: messages then come from farther. A `crowding_limit`
    of its own acts at once.

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
    scale = _scale(mine, theirs, start_from)
    _check(mine, theirs, start_from, similar=scale != 1)
    state = parent.state_dict()
    for name in ("velocity_mean", "velocity_std"):
        state[name] = state[name] * math.sqrt(scale)
    for what, inputs in (("vertex", _vertex_inputs), ("edge", _edge_inputs)):
        own, known = inputs(mine), inputs(theirs)
        if own != known:
            weight = state[_FIRST.format(what)]
            columns = dict(zip(known, weight.unbind(1), strict=True))
            if what == "vertex":
                _shorten(columns, mine, theirs)
            state[_FIRST.format(what)] = torch.stack(
                [columns.get(name, torch.zeros_like(weight[:, 0])) for name in own], dim=1
            )
    model.load_state_dict(_deepen(state, model, theirs.blocks))


def _deepen(state: dict[str, Tensor], model: LearnedModel, known: int) -> dict[str, Tensor]:
    """`state` with its `known` blocks spread evenly over those of `model`.

    The others keep the weights that they were drawn with, but for the LayerNorms at their ends, of
    zero: their messages and updates are nothing, and the residuals hand on what came in.
    """
    origin = {str(k * model.config.blocks // known): k for k in range(known)}
    deeper = {name: value for name, value in state.items() if not name.startswith(_BLOCK)}
    for name, drawn in model.state_dict().items():
        if name.startswith(_BLOCK):
            place, rest = name.removeprefix(_BLOCK).split(".", 1)
            if place in origin:
                deeper[name] = state[f"{_BLOCK}{origin[place]}.{rest}"]
            else:
                deeper[name] = torch.zeros_like(drawn) if ".norm." in name else drawn
    return deeper


def _shorten(columns: dict[str, Tensor], mine: ModelConfig, theirs: ModelConfig) -> None:
    """Add the weights of velocities before the history of `mine` to those of its first, in place.

    Every velocity is normalised alike, so that this is what the parent makes of steady motion.
    """
    for age in range(mine.history, theirs.history):
        for axis in range(mine.dim):
            first = _velocity(mine.history - 1, axis)
            columns[first] = columns[first] + columns.pop(_velocity(age, axis))


def _scale(mine: ModelConfig, theirs: ModelConfig, name: str) -> float:
    """λ, by which the lengths of `mine` exceed those of `theirs`.

    Raises:
        RecipeError: if they are not all in one proportion, the stride does not follow as √λ, or
            the parent sees what does not scale.
    """
    scale = mine.spacing / theirs.spacing
    if math.isclose(scale, 1.0):
        return 1.0
    for key in LENGTHS:
        wanted, found = getattr(mine, key), getattr(theirs, key)
        if not math.isclose(wanted, scale * found, rel_tol=1e-6):
            raise RecipeError(
                f"start_from = {name!r}: its spacing is {theirs.spacing:g}, the recipe's "
                f"{mine.spacing:g}, so {key} must be {scale * found:g}, not {wanted:g}"
            )
    stride = math.sqrt(scale) * theirs.dt
    if abs(mine.dt / stride - 1) > STRIDE_TOLERANCE:
        raise RecipeError(
            f"start_from = {name!r}: at {scale:g} times its scale dt must be within "
            f"{STRIDE_TOLERANCE:.0%} of {stride:.4g}, not {mine.dt:g}"
        )
    if theirs.depth_range or theirs.strain_unit:
        raise RecipeError(
            f"start_from = {name!r}: it sees depths in metres or strain rates, so it can only "
            "start models of its own spacing"
        )
    return scale


def _vertex_inputs(config: ModelConfig) -> list[str]:
    """A name for every input of the vertex encoder, in its order."""
    depth = [f"depth {k}" for k in range(config.dim + 1)] if config.depth_range else []
    strain = [f"strain {k}" for k in range(config.strain_inputs)]
    material = list(config.material_features)
    embedded = config.type_embedding if config.types else 0
    ages, axes = range(config.history - 1, -1, -1), range(config.dim)
    velocities = [_velocity(age, axis) for age in ages for axis in axes]
    known = len(velocities) + len(depth) + len(strain) + len(material)
    surroundings = range(config.vertex_inputs - known)
    return [
        *velocities, *(f"surroundings {k}" for k in surroundings), *depth, *strain, *material,
        *(f"type {k}" for k in range(embedded)),
    ]  # fmt: skip


def _velocity(age: int, axis: int) -> str:
    """The name of a velocity that was the last one `age` steps ago."""
    return f"velocity {axis}, {age} steps ago"


def _edge_inputs(config: ModelConfig) -> list[str]:
    """A name for every input of the edge encoder, in its order."""
    return [f"edge {k}" for k in range(config.edge_inputs)]


def _check(mine: ModelConfig, theirs: ModelConfig, name: str, *, similar: bool) -> None:
    wanted = mine.model_dump(mode="json", exclude=FREE)
    found = theirs.model_dump(mode="json", exclude=FREE)
    settled = {*LENGTHS, "dt"} if similar else set()  # by `_scale`
    for key, value in wanted.items():
        if value != found[key] and key not in settled:
            raise RecipeError(
                f"start_from = {name!r}: its {key} is {found[key]!r}, the recipe's {value!r}"
            )
    if mine.blocks < theirs.blocks:
        raise RecipeError(
            f"start_from = {name!r}: it has {theirs.blocks} blocks, the recipe's only {mine.blocks}"
        )
    if mine.blocks > theirs.blocks and mine.edge_update == "doubled":
        raise RecipeError(
            f"start_from = {name!r}: blocks with edge_update = 'doubled' hand nothing on as it is, "
            f"so the recipe's {mine.blocks} cannot begin as its {theirs.blocks}"
        )
    if theirs.depth_range and mine.depth_range != theirs.depth_range:
        raise RecipeError(
            f"start_from = {name!r}: its depth_range is {theirs.depth_range:g}, the recipe's "
            f"{mine.depth_range:g}"
        )
    if theirs.strain_unit and mine.strain_unit != theirs.strain_unit:
        raise RecipeError(
            f"start_from = {name!r}: its strain_unit is {theirs.strain_unit:g}, the recipe's "
            f"{mine.strain_unit:g}"
        )
    dropped = set(theirs.material_features) - set(mine.material_features)
    if dropped:
        raise RecipeError(
            f"start_from = {name!r}: it sees {', '.join(sorted(dropped))}, which the recipe's "
            "model.material_features leaves out"
        )

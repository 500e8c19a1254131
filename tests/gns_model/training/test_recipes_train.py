"""The small recipes of the examples really train, on data made as they say; the paper's are its."""

from __future__ import annotations

from pathlib import Path

import pytest

from gns_model.data.generate import generate
from gns_model.learned.checkpoint import load_model
from gns_model.learned.config import ModelConfig
from gns_model.training import Recipe, train
from gns_model.training.logs import read_table

RECIPES = Path(__file__).parents[3] / "examples" / "recipes"
#: Recipe, families of the training and of the validation data.
SMALL = {
    "small-column": ("columns", "rectangles"),
    "small-friction": ("friction", "friction"),
    "small-barriers": ("barriers", "barriers"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_a_small_recipe_trains_on_its_own_kind_of_data(name, tmp_path):
    recipe = Recipe.from_toml(RECIPES / f"{name}.toml")
    folders = [str(tmp_path / part) for part in ("train", "valid")]
    for folder, family, seed in zip(folders, SMALL[name], (0, 1), strict=True):
        generate(
            folder, family=family, count=2, seed=seed, spacing=recipe.model.spacing,
            frame_interval=recipe.model.dt, workers=1,
        )  # fmt: skip
    short = {"train": (folders[0],), "valid": (folders[1],), "steps": 40, "statistics_windows": 16}
    short |= {"valid_rollouts": 1, "valid_windows": 4}
    short = recipe.model_copy(update=short)
    train(short.model_copy(update={"steps": 1}), tmp_path / "run")
    trained = train(short, tmp_path / "run")
    assert trained == tmp_path / "run" / "model"
    card = load_model(trained).card
    assert card["trained_on"]["steps"] in (1, 40)  # whichever scored better
    first, check = read_table(tmp_path / "run" / "validation.csv")
    measures = {"energy", "centroid_travel"}
    measures |= {"upstream_depth"} if "barriers" in name else {"runout_max"}
    assert measures <= set(check)
    assert check["diverged"] == 0
    # Forty steps on two flows promise nothing for unseen ones, but the weights have moved and the
    # model still predicts accelerations of the right order.
    assert check["one_step"] != first["one_step"]
    assert check["one_step"] < 10


@pytest.mark.parametrize(
    ("name", "dim", "changes"),
    [
        ("paper-column", 2, {}),
        ("paper-friction", 2, {"spacing": 0.005, "material_features": ("tan_friction_angle",)}),
        ("paper-barriers", 3, {}),
    ],
)
def test_the_recipes_of_the_paper_are_its_network_and_its_schedule(name, dim, changes):
    recipe = Recipe.from_toml(RECIPES / f"{name}.toml")
    assert recipe.model == ModelConfig.paper(dim).model_copy(update={**changes, "solver_steps": 5})
    assert (recipe.schedule, recipe.learning_rate, recipe.decay_steps) == (
        "exponential", 1e-4, 5_000_000,
    )  # fmt: skip
    assert recipe.steps == 5_000_000
    assert not recipe.mirror
    assert recipe.ema_decay == recipe.weight_decay == 0

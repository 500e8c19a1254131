"""A recipe says what is wrong with it in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from gns_model.training import Recipe, RecipeError

RECIPES = sorted((Path(__file__).parents[3] / "examples" / "recipes").glob("*.toml"))


@pytest.mark.parametrize("path", RECIPES, ids=lambda p: p.name)
def test_the_recipes_in_the_examples_can_be_read(path):
    recipe = Recipe.from_toml(path)
    assert recipe.name == path.stem
    assert recipe.valid


def test_there_are_recipes():
    assert RECIPES


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"epochs": 3}, "epochs"),
        ({"train": []}, "train"),
        ({"steps": None}, "steps or minutes"),
        ({"minutes": 5}, "steps or minutes"),
        ({"steps": 0}, "steps"),
        ({"learning_rate": -1}, "learning_rate"),
        ({"learning_rate": float("nan")}, "learning_rate"),
        ({"ema_decay": 1.0}, "ema_decay"),
        ({"schedule": "linear"}, "schedule"),
        ({"model": {"baffles": "points", "types": 5}}, "model.types must be 0 or at least 7"),
        ({"model": {"radius": 0.01}}, "radius"),
        ({"model": {"strain_unit": 0.3, "relative_velocity": False}}, "needs relative_velocity"),
        ({"local_weight": -1.0}, "local_weight"),
        ({"precision": "half"}, "precision = 'half'"),
        ({"model": {"colour": "red"}}, "model.colour"),
    ],
)
def test_a_fault_is_named_in_one_line(tiny, changes, words):
    values = {k: v for k, v in {**tiny, **changes}.items() if v is not None}
    with pytest.raises(RecipeError, match=words) as caught:
        Recipe.from_dict(values, source="r.toml")
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("r.toml: ")


def test_files_that_are_no_recipes(tmp_path):
    with pytest.raises(RecipeError, match=r"no\.toml"):
        Recipe.from_toml(tmp_path / "no.toml")
    (tmp_path / "bad.toml").write_text("steps = = 3")
    with pytest.raises(RecipeError, match="TOML"):
        Recipe.from_toml(tmp_path / "bad.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RecipeError, match="TOML"):
        Recipe.from_toml(tmp_path / "binary.toml")

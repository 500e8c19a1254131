"""A recipe may ask for flows that are let go and leave out those that are thrown."""

import pytest

from gns_model.data.scenes import draw
from gns_model.mpm import MpmSimulator
from gns_model.training import Recipe, RecipeError
from gns_model.training.setup import open_data

SPACING = 0.05


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Six squares of the family "columns", some thrown and some not."""
    path = tmp_path_factory.mktemp("squares")
    scenes = [draw("columns", 0, k).replace(duration=0.05) for k in range(6)]
    for scene, flow in zip(scenes, MpmSimulator(spacing=SPACING).rollout(scenes), strict=True):
        flow.save(path / f"{scene.name}.h5")
    return path


def recipe(folder, **changes):
    model = {"dim": 2, "spacing": SPACING, "dt": 0.01, "radius": 0.11, "history": 2}
    return Recipe(train=(str(folder),), steps=1, model=model, **changes)


def speed(source):
    return max(abs(v) for v in source.scene.releases[0].velocity)


def test_only_squares_at_rest_are_left(folder):
    everything = open_data(recipe(folder), (str(folder),)).sources
    calm = open_data(recipe(folder, at_rest=True), (str(folder),)).sources
    assert 0 < len(calm) < len(everything) == 6
    assert [s.path for s in calm] == [s.path for s in everything if speed(s) == 0]


def test_data_with_nothing_at_rest_are_refused(folder):
    for source in open_data(recipe(folder, at_rest=True), (str(folder),)).sources:
        source.path.unlink()
    with pytest.raises(RecipeError, match="every flow in it is thrown"):
        open_data(recipe(folder, at_rest=True), (str(folder),))

"""A recipe may ask to learn from flows only until they strike a wall."""

import numpy as np
import pytest

from gns_model.data.impact import CLEARANCE, frames_before_impact
from gns_model.mpm import MpmSimulator
from gns_model.scene import Scene
from gns_model.training import Recipe, RecipeError, train
from gns_model.training.setup import open_data
from gns_model.trajectory import Trajectory

SPACING, WIDTH = 0.05, 1.5


def square(left, speed, name):
    return Scene.from_dict(
        {
            "name": name,
            "domain": {"lower": [0.0, 0.0], "upper": [WIDTH, 1.0]},
            "release": [{"lower": [left, 0.0], "upper": [left + 0.3, 0.3], "velocity": [speed, 0]}],
            "duration": 0.3,
        }
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A square that is thrown at the far wall, and one that stands at the near one."""
    path = tmp_path_factory.mktemp("walls")
    scenes = [square(0.9, 2.0, "thrown"), square(0.0, 0.0, "stands")]
    solver = MpmSimulator(spacing=SPACING, frame_interval=0.01)
    for scene, flow in zip(scenes, solver.rollout(scenes), strict=True):
        flow.save(path / f"{scene.name}.h5")
    return path


def recipe(folder, **changes):
    model = {"dim": 2, "spacing": SPACING, "dt": 0.01, "radius": 0.11, "history": 2}
    return Recipe(train=(str(folder),), steps=1, model=model, **changes)


def opened(folder, learn=True, **changes):
    index = open_data(recipe(folder, **changes), (str(folder),), learn=learn)
    return {source.path.stem: source for source in index.sources}


def test_a_flow_ends_where_its_front_comes_to_a_wall(folder):
    whole, cut = opened(folder), opened(folder, before_impact=True)
    # The wall that a square stood at counts for nothing.
    assert whole["stands"].frames == cut["stands"].frames == 31
    frames = cut["thrown"].frames
    assert 2 < frames < whole["thrown"].frames
    front = Trajectory.load(folder / "thrown.h5").positions[..., 0].max(1)
    assert (front[:frames] <= WIDTH - CLEARANCE * SPACING).all()
    assert front[frames] > WIDTH - CLEARANCE * SPACING


def test_rollouts_are_judged_on_whole_flows(folder):
    assert opened(folder, learn=False, before_impact=True)["thrown"].frames == 31


def test_no_window_reads_what_follows(folder):
    index = open_data(recipe(folder, before_impact=True), (str(folder),), learn=True)
    for k, source in enumerate(index.sources):
        last = index.read(k, index.starts(k) - 1, mixture=0)
        assert np.isfinite(last.future).all()
        if source.path.stem == "thrown":
            assert last.future[..., 0].max() <= WIDTH - CLEARANCE * SPACING


def test_flows_that_all_strike_at_once_are_refused(folder, tmp_path, capsys):
    scene = square(WIDTH - 0.5, 2.0, "late")
    [flow] = MpmSimulator(spacing=SPACING, frame_interval=0.01).rollout([scene])
    flow.save(tmp_path / "late.h5")
    [source] = opened(tmp_path).values()
    assert frames_before_impact(source, SPACING) < 5
    too_long = recipe(tmp_path, before_impact=True, unroll=10)
    with pytest.raises(RecipeError, match="strikes a wall at once"):
        open_data(too_long, (str(tmp_path),), learn=True)

    # Beside others it is left out, and said.
    (tmp_path / "stands.h5").symlink_to(folder / "stands.h5")
    index = open_data(too_long, (str(tmp_path),), learn=True)
    assert [source.path.stem for source in index.sources] == ["stands"]
    assert index.skipped == {tmp_path / "late.h5": "strike a wall at once"}
    train(too_long, tmp_path / "run")
    assert "1 trajectories (1 that strike a wall at once left out)" in capsys.readouterr().out

"""Views that say what they should: depth conserves mass, frames differ, baffles stand."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from gns_env.deposit import depth_map
from gns_env.rendering import BAFFLE, Film, PlanView, SideView, rest_image
from gns_env.task import BaffleTask, simulate
from gns_model.measures import upstream_depth_over_time
from gns_model.mpm import MpmSimulator
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory


@pytest.fixture(scope="module")
def spatial(small_flume: Scene) -> Trajectory:
    return MpmSimulator(spacing=0.05).rollout([small_flume])[0]


@pytest.fixture(scope="module")
def plane(plane_scene: Scene) -> Trajectory:
    return MpmSimulator(spacing=0.02).rollout([plane_scene])[0]


@pytest.mark.parametrize("frame", [0, -1])
def test_depth_holds_all_the_mass(spatial: Trajectory, plane: Trajectory, frame: int) -> None:
    assert depth_map(spatial, frame, 0.1).sum() * 0.1**2 == pytest.approx(0.25 * 0.2 * 0.4)
    assert depth_map(plane, frame, 0.1).sum() * 0.1 == pytest.approx(0.2 * 0.3)


def test_depth_is_in_the_right_place(spatial: Trajectory) -> None:
    first, last = depth_map(spatial, 0, 0.05), depth_map(spatial, -1, 0.05)
    assert first.shape == (20, 12)
    # At the start 0.2 m deep wherever the release is, and nothing elsewhere.
    assert first[:5, 2:10].mean() == pytest.approx(0.2)
    assert first[5:].max() == 0
    # The flow went downstream and met the baffle at 0.5 to 0.6 m.
    assert last[5:].max() > 0
    assert last[10:12, 5:7].max() == 0


def test_images_are_fresh_and_show_the_flow_and_the_baffle(spatial: Trajectory) -> None:
    film = Film(spatial)
    first, last = film.image(0), film.image(-1)
    assert first.dtype == np.uint8
    assert first.shape == last.shape
    assert first.shape[2] == 3
    assert not np.shares_memory(first, last)
    assert (first != last).any(axis=2).mean() > 0.02
    colour = np.array([int(BAFFLE[k : k + 2], 16) for k in (1, 3, 5)])
    assert (np.abs(first.astype(int) - colour).max(axis=2) < 4).sum() > 200
    np.testing.assert_array_equal(Film(spatial).image(0), first)


def test_the_deposit_is_drawn_with_the_peak_depth_at_every_baffle(small_flume: Scene) -> None:
    task = BaffleTask(small_flume, MpmSimulator(spacing=0.05), n_baffles=2)
    layout = np.array([[0.65, 0.2], [0.45, 0.4]])  # not in the order of the scene
    whole = task.evaluate([layout], trajectories=True)[0]
    outcome, rest = simulate([(task, layout)], keep="rest")[0]
    state = task.judge(layout, outcome, rest)
    np.testing.assert_allclose(
        np.sort(state.depths), np.sort(upstream_depth_over_time(whole.trajectory).max(axis=0))
    )
    assert state.depths[1] > state.depths[0]  # the one upstream meets the deeper flow
    assert state.depths.max() == pytest.approx(state.measures["upstream_depth"])
    assert len(rest.positions) == 2
    image = rest_image(state, task)
    # The last two frames draw what the whole trajectory does, up to the order of the grains.
    difference = image.astype(int) - rest_image(whole, task)
    assert np.abs(difference).max() <= 2
    film = Film(rest)
    plain = film.image(-1, "the same")
    film.mark_depths(state.depths[[1, 0]])
    marked = film.image(-1, "the same")
    changed = (plain != marked).any(axis=2)
    assert changed.sum() > 100
    blue = np.abs(marked.astype(int) - [0x15, 0x65, 0xA8]).max(axis=2) < 40
    assert (blue & changed).sum() > 40
    with pytest.raises(ValueError, match="last frames"):
        rest_image(task.evaluate([layout])[0], task)


def test_a_plane_scene_has_a_side_view_alone(plane: Trajectory) -> None:
    image = Film(plane).image(-1)
    assert image.shape[0] < image.shape[1]
    with pytest.raises(ValueError, match="no plan"):
        PlanView(Figure().add_subplot(), plane)


def test_views_can_be_drawn_into_any_axes(spatial: Trajectory) -> None:
    figure = Figure()
    above, below = figure.subplots(2)
    plan, side = PlanView(above, spatial), SideView(below, spatial)
    plan.show(3)
    side.show(3)
    assert above.get_xlabel() == "x [m]"
    assert above.get_ylabel() == "z [m]"
    assert below.get_ylabel() == "y [m]"
    before = np.asarray(side.points.get_offsets()).copy(), plan.image.get_array().copy()
    plan.show(-1)
    side.show(-1)
    assert not np.array_equal(side.points.get_offsets(), before[0])
    assert not np.array_equal(plan.image.get_array(), before[1])


def test_speed_is_that_of_the_points(spatial: Trajectory) -> None:
    view = SideView(Figure().add_subplot(), spatial)
    view.show(0)
    np.testing.assert_allclose(view.points.get_array(), 1.5, rtol=0.15)

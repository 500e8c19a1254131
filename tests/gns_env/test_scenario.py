"""Scenarios: what a flow may be, drawn by the seed alone, told to the policy."""

from __future__ import annotations

import math
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from hypothesis import given
from hypothesis import strategies as st

import gns_model
from gns_env.errors import EnvError, InvalidLayout, InvalidScenario
from gns_env.scenario import Scenario, ScenarioSpace
from gns_model.learned.config import Limits
from gns_model.mpm import MpmSimulator
from gns_model.scene import Scene


def make(scene: Scene, simulator: object, **arguments: Any) -> gymnasium.Env:
    return gymnasium.make("GranularBaffle-v0", scene=scene, simulator=simulator, **arguments)


@given(
    ratio=st.floats(0.5, 1.2),
    speed=st.floats(0.5, 3.0),
    angle=st.floats(20.0, 50.0),
    z=st.floats(-0.1, 0.1),
)
def test_a_scene_has_the_flow_of_its_scenario(
    flume: Scene, ratio: float, speed: float, angle: float, z: float
) -> None:
    space = ScenarioSpace(flume)
    own = space.own
    scenario = Scenario(ratio * own.volume, speed, angle, (0.05, z))
    scene = space.apply(scenario)
    release, before = scene.releases[0], flume.releases[0]
    assert math.prod(release.size) == pytest.approx(scenario.volume, rel=1e-6)
    assert release.velocity == pytest.approx((speed, 0.0, 0.0))
    assert scene.material.friction_angle == angle
    assert release.lower[0] == pytest.approx(before.lower[0] + 0.05)
    assert release.lower[1] == before.lower[1]  # it stands on the base as before
    assert release.lower[2] + release.upper[2] == pytest.approx(2.0 + 2 * z)
    np.testing.assert_allclose(np.array(release.size) / before.size, ratio ** (1 / 3), rtol=1e-6)
    assert scene.placement == flume.placement
    assert scene.domain == flume.domain


def test_the_scenes_own_scenario_changes_nothing_and_reads_zero(flume: Scene) -> None:
    space = ScenarioSpace(flume)
    assert space.apply(space.own) is flume
    assert (space.observe(space.own) == 0).all()
    assert space.draw(np.random.default_rng(0), None) == space.own


def test_observations_tell_scenarios_apart(flume: Scene) -> None:
    space = ScenarioSpace(flume, "random")
    rng = np.random.default_rng(3)
    seen = np.array([space.observe(space.draw(rng, None)) for _ in range(20)])
    assert (np.abs(seen) < 1).all()  # never at a bound, where two would look the same
    for column in seen.T:
        assert len(np.unique(column)) == 20
    doubled = Scenario(2 * space.own.volume, 3.0, 45.0, (0.0, -0.45))
    np.testing.assert_allclose(space.observe(doubled), [0.5, 0.5, 0.5, 0.0, -0.5], atol=1e-6)


def test_draws_follow_the_seed_and_stay_in_their_ranges(flume: Scene) -> None:
    ranges = {"speed": (1.0, 2.5), "place": ((0.0, 0.1), (-0.2, 0.2))}
    space = ScenarioSpace(flume, ranges)
    draws = [space.draw(np.random.default_rng(seed), None) for seed in (1, 1, 2)]
    assert draws[0] == draws[1] != draws[2]
    for draw in draws:
        assert 1.0 <= draw.speed <= 2.5
        assert draw.volume == space.own.volume
        assert 0.0 <= draw.place[0] <= 0.1
    mixed = space.draw(np.random.default_rng(1), {"speed": 1.5, "volume": (0.08, 0.1)})
    assert mixed.speed == 1.5
    assert 0.08 <= mixed.volume <= 0.1
    plain = space.draw(np.random.default_rng(1), {"randomise": False, "speed": 1.5})
    assert plain.place == (0.0, 0.0)
    everything = ScenarioSpace(flume).draw(np.random.default_rng(1), {"randomise": True})
    assert everything.friction_angle != 35.0
    assert everything.speed != 2.0


def test_random_keeps_to_what_a_model_was_trained_for(flume: Scene) -> None:
    limits = Limits(max_speed=2.1, friction_angle=(35.0, 35.0), release_height=0.26)
    space = ScenarioSpace(flume, "random", limits)
    rng = np.random.default_rng(0)
    for _ in range(50):
        scenario = space.draw(rng, None)
        assert scenario.friction_angle == 35.0
        assert scenario.speed <= 2.1
        assert scenario.volume <= space.own.volume * (0.26 / 0.25) ** 3 + 1e-9


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"colour": 1}, "unknown key 'colour'"),
        ({"speed": math.nan}, "speed needs a number"),
        ({"speed": "fast"}, "speed needs a number"),
        ({"speed": (2.0, 1.0)}, "ordered"),
        ({"speed": 9.0}, "lie in 0 to 4"),
        ({"volume": 0.0}, "volume"),
        ({"friction_angle": 80.0}, "lie in 15 to 55"),
        ({"place": 0.1}, r"place needs 2 values, place\[x\], place\[z\]"),
        ({"place": (0.0, math.inf)}, r"place\[z\]"),
        ({"place": (0.0, 0.5)}, "leaves the domain"),
        ({"randomise": "yes"}, "randomise must be True or False"),
    ],
)
def test_bad_options_are_refused_by_reset(
    flume: Scene, coarse_mpm: MpmSimulator, options: dict[str, Any], message: str
) -> None:
    single = make(flume, coarse_mpm, disable_env_checker=True)
    many = gymnasium.make_vec("GranularBaffle-v0", 2, scene=flume, simulator=coarse_mpm)
    for env in (single, many):
        with pytest.raises(InvalidScenario, match=message) as caught:
            env.reset(options=options)
        assert isinstance(caught.value, gymnasium.error.Error)
        assert "\n" not in str(caught.value)


def test_ranges_that_no_flow_can_have_are_refused_when_it_is_made(
    small_flume: Scene, coarse_mpm: MpmSimulator
) -> None:
    with pytest.raises(InvalidScenario, match="leaves the domain"):
        make(small_flume, coarse_mpm, scenarios={"place": ((0.0, 0.0), (0.25, 0.3))})


def test_a_flow_that_leaves_no_room_for_baffles_is_refused(
    small_flume: Scene, coarse_mpm: MpmSimulator
) -> None:
    env = make(small_flume, coarse_mpm, n_baffles=9)
    with pytest.raises(EnvError, match="do not fit"):
        env.reset(options={"place": (0.5, 0.0)})
    with pytest.raises(InvalidLayout):
        make(small_flume, coarse_mpm, n_baffles=60)


def test_a_release_too_thin_for_the_points_is_no_flow(
    tiny_scene: Scene, tiny_mpm: MpmSimulator
) -> None:
    with pytest.raises(InvalidScenario, match="thinner than the spacing"):
        make(tiny_scene, MpmSimulator(spacing=0.15), scenarios={"volume": (0.016, 0.02)})
    env = make(tiny_scene, MpmSimulator(spacing=0.19), scenarios={"volume": (0.03, 0.07)})
    for seed in range(5):  # some of these draws had to be drawn again
        assert env.unwrapped.problem.draw(np.random.default_rng(seed), None)[0].volume > 0.054


def test_the_seed_decides_every_episode(tiny_scene: Scene, tiny_mpm: MpmSimulator) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make(tiny_scene, tiny_mpm, n_baffles=1, scenarios="random")
        check_env(env.unwrapped, skip_render_check=True)
    episodes = []
    for seed in (7, None, 7, None, 8):
        observation, info = env.reset(seed=seed)
        step = env.step(np.array([-0.5], np.float32))
        episodes.append((observation, info, step))
    assert data_equivalence(episodes[0], episodes[2], exact=True)
    assert data_equivalence(episodes[1], episodes[3], exact=True)
    speeds = [episode[1]["scenario"]["speed"] for episode in episodes]
    assert len(set(speeds)) == 3
    for observation, info, _ in episodes:
        scenario = info["scenario"]
        expected = (scenario["speed"] - 1.0) / 1.0
        assert observation["scenario"][1] == pytest.approx(expected, abs=1e-6)
        assert info["cost"] == pytest.approx(1.5)


def test_options_hold_for_one_episode_and_move_the_flow(
    tiny_scene: Scene, tiny_mpm: MpmSimulator
) -> None:
    env = make(tiny_scene, tiny_mpm, n_baffles=1)
    own = env.reset(seed=0)[1]
    fast = env.reset(options={"speed": 1.8})[1]
    again = env.reset()[1]
    assert fast["measures"]["centroid_travel"] > 1.2 * own["measures"]["centroid_travel"]
    assert fast["scenario"]["speed"] == 1.8
    assert again["measures"] == own["measures"]


def test_a_flow_that_gives_nothing_to_improve_is_drawn_again(
    tiny_scene: Scene, tiny_mpm: MpmSimulator
) -> None:
    # Slow flows do not reach the placement area, where the free flow's depth is read.
    placement = tiny_scene.placement.model_copy(update={"lower": (0.55,)})
    scene = tiny_scene.replace(placement=placement)
    env = make(scene, tiny_mpm, n_baffles=1, scenarios={"speed": (0.2, 2.0)})
    with pytest.raises(EnvError, match="does not get that far"):
        env.reset(options={"speed": 0.2})
    speeds = [env.reset(seed=seed)[1]["scenario"]["speed"] for seed in range(12)]
    assert min(speeds) > 0.4
    rolled = env.unwrapped.problem.scenarios
    first = [rolled.draw(np.random.default_rng(seed), None).speed for seed in range(12)]
    assert min(first) < 0.4  # some were drawn that had to be drawn again


def test_a_learned_model_warns_once_of_what_it_never_saw(flume: Scene, is_shipped: bool) -> None:
    if not is_shipped:
        pytest.skip("no model is shipped")
    model = gns_model.load_simulator("baffle-lite")
    with pytest.warns(UserWarning, match="friction_angle = .* but trained on 35 to 35"):
        env = make(flume, model, scenarios={"friction_angle": (25.0, 30.0)})
    problem = env.unwrapped.problem
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for seed in range(3):
            assert problem.draw(np.random.default_rng(seed), None)[0].friction_angle < 31
    usual = problem.scenarios.usual  # what "random" draws keeps to the model's limits
    assert usual["friction_angle"] == (35, 35)
    assert usual["speed"][1] <= model.config.limits.max_speed

"""GranularBaffle-v0 as Gymnasium sees it, on the real solver and on the shipped model."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.utils.env_checker import check_env

import gns_env.env
from gns_env.env import MEASURES
from gns_env.objective import Objective, ObjectiveError
from gns_model.errors import GnsError, LayoutError, SceneError, SimulatorError
from gns_model.mpm import MpmSimulator
from gns_model.scene import Scene
from gns_model.simulator import Simulator


def make(scene: Scene | None, simulator: object, **options: object) -> gymnasium.Env:
    return gymnasium.make("GranularBaffle-v0", scene=scene, simulator=simulator, **options)


@pytest.mark.parametrize("render_mode", [None, "rgb_array"])
def test_gymnasium_has_nothing_to_complain_about(
    site: Scene, simulator: Simulator, render_mode: str | None
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make(site, simulator, render_mode=render_mode)
        check_env(env.unwrapped)


def test_nor_about_a_plane_scene(plane_scene: Scene) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make(plane_scene, MpmSimulator(spacing=0.03), n_baffles=2, render_mode="rgb_array")
        check_env(env.unwrapped)
        assert env.action_space.shape == (1,)
        assert env.observation_space["deposit"].shape == (20,)


def test_an_episode_places_its_baffles_and_rewards_what_they_save(
    site: Scene, simulator: Simulator
) -> None:
    env = make(site, simulator, n_baffles=3)
    observation, info = env.reset(seed=1)
    assert info["cost"] == pytest.approx(1.5)
    assert info["centres"].shape == (0, 2)
    assert observation["placed"].sum() == 0
    np.testing.assert_allclose(observation["measures"][:4], 1.0)
    assert 0 < observation["deposit"].max() <= 1
    start, total = info["cost"], 0.0
    actions = np.array([[-0.5, -0.4], [-0.5, 0.4], [0.2, 0.0]], np.float32)
    for k, action in enumerate(actions):
        observation, reward, terminated, truncated, info = env.step(action)
        total += reward
        assert terminated == (k == 2)
        assert not truncated
        np.testing.assert_allclose(observation["layout"][: k + 1], actions[: k + 1], atol=1e-6)
        assert (observation["layout"][k + 1 :] == 0).all()
        np.testing.assert_array_equal(observation["placed"], [1] * (k + 1) + [0] * (2 - k))
        assert info["moved"] == pytest.approx(0.0, abs=1e-9)
    assert total == pytest.approx(start - info["cost"])
    # The same layout through the task, all at once, is the same.
    assert env.unwrapped.task.evaluate([info["centres"]])[0].cost == info["cost"]
    ratio = info["measures"]["centroid_travel"] / env.unwrapped.task.reference["centroid_travel"]
    assert observation["measures"][MEASURES.index("centroid_travel")] == pytest.approx(ratio, 1e-5)
    with pytest.raises(ResetNeeded):
        env.step(actions[0])


def test_the_deposit_is_the_mass_that_was_released(small_flume: Scene) -> None:
    env = make(small_flume, MpmSimulator(spacing=0.05), n_baffles=1)
    observation, _ = env.reset()
    depth = observation["deposit"] * 0.25  # of the height of a baffle
    assert depth.sum() * 0.05**2 == pytest.approx(0.25 * 0.2 * 0.4, rel=1e-5)


def test_a_clash_is_resolved_and_told(small_flume: Scene, coarse_mpm: MpmSimulator) -> None:
    env = make(small_flume, coarse_mpm, n_baffles=2)
    env.reset()
    _, _, _, _, first = env.step(np.zeros(2, np.float32))
    _, _, _, _, second = env.step(np.zeros(2, np.float32))
    assert first["moved"] == 0
    assert second["moved"] == pytest.approx(0.15)  # one width and one gap along x
    np.testing.assert_array_equal(second["centres"][:1], first["centres"])
    assert env.unwrapped.task.space.check(second["centres"]) == []


@pytest.mark.parametrize("how", ["says so", "nan", "explodes", "leaks"])
def test_a_failed_rollout_ends_the_episode_with_finite_numbers(
    small_flume: Scene, faulty: type, how: str
) -> None:
    env = make(small_flume, faulty(how, at_least=2), n_baffles=3, render_mode="rgb_array")
    env.reset()
    _, _, terminated, _, info = env.step(np.array([-0.5, -0.5], np.float32))
    assert not terminated
    assert not info["diverged"]
    observation, reward, terminated, _, info = env.step(np.array([0.5, 0.5], np.float32))
    assert env.render().dtype == np.uint8
    assert terminated
    assert info["diverged"]
    assert -15 < reward < -10
    assert observation in env.observation_space
    assert all(np.isfinite(value).all() for value in observation.values())
    env.reset()
    assert not env.step(np.array([-0.5, -0.5], np.float32))[2]


def test_bad_actions(small_flume: Scene, coarse_mpm: MpmSimulator) -> None:
    env = make(small_flume, coarse_mpm, n_baffles=1, disable_env_checker=True)
    env.reset()
    for action in ([np.nan, 0.0], [0.0], [0.0, 0.0, 0.0]):
        with pytest.raises(InvalidAction):
            env.step(np.array(action))
    _, _, _, _, info = env.step(np.array([7.0, -7.0]))  # clipped to the corner
    space = env.unwrapped.task.space
    np.testing.assert_allclose(info["centres"][0], [space.upper[0], space.lower[1]])


def test_it_is_found_by_its_module_name_in_a_fresh_process() -> None:
    code = (
        "import gymnasium; from gns_model.mpm import MpmSimulator\n"
        "env = gymnasium.make('gns_env:GranularBaffle-v0', simulator='mpm', n_baffles=4)\n"
        "print(env.spec.id, env.unwrapped.task.space.dim, env.unwrapped.task.simulator.name)"
    )
    root = Path(gns_env.__file__).parents[1]
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=root, timeout=120
    )
    assert done.stdout.split() == ["GranularBaffle-v0", "8", "mpm"], done.stderr


def test_many_at_once(small_flume: Scene, coarse_mpm: MpmSimulator) -> None:
    envs = gymnasium.make_vec(
        "GranularBaffle-v0",
        2,
        vectorization_mode="sync",
        scene=small_flume.replace(duration=0.15),
        simulator=coarse_mpm,
        n_baffles=1,
    )
    observations, _ = envs.reset(seed=0)
    assert observations["layout"].shape == (2, 1, 2)
    _, rewards, terminated, _, _ = envs.step(np.array([[0, 0], [0.5, 0.5]], np.float32))
    assert terminated.all()
    assert np.isfinite(rewards).all()
    envs.close()


def test_the_shipped_scene_is_the_example(examples: Path, flume: Scene) -> None:
    shipped = Path(gns_env.__file__).parent / "scenes" / "flume.toml"
    assert shipped.read_bytes() == (examples / "flume.toml").read_bytes()
    assert gns_env.env.flume() == flume


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"simulator": "oracle"}, SimulatorError, "no simulator named 'oracle'"),
        ({"scene": "nowhere.toml"}, SceneError, "nowhere.toml"),
        ({"n_baffles": 500}, LayoutError, "at most"),
        ({"n_baffles": 0}, LayoutError, "1 or more"),
        ({"objective": Objective.pareto()}, ObjectiveError, "one Objective"),
        ({"render_mode": "ansi"}, ValueError, "rgb_array"),
    ],
)
def test_bad_arguments_are_refused_when_it_is_made(
    arguments: dict[str, object], error: type[Exception], message: str
) -> None:
    arguments = {"simulator": "mpm", **arguments}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # gymnasium warns of the render mode before we refuse it
        with pytest.raises(error, match=message) as caught:
            gymnasium.make("GranularBaffle-v0", **arguments)
    assert "\n" not in str(caught.value)


def test_the_default_simulator_is_the_shipped_model_or_one_clear_line(
    is_shipped: bool,
) -> None:
    if is_shipped:
        env = gymnasium.make("GranularBaffle-v0")
        assert env.unwrapped.task.simulator.name == "baffle-lite"
    else:
        with pytest.raises(GnsError, match="no simulator named 'baffle-lite'"):
            gymnasium.make("GranularBaffle-v0")


def test_a_spatial_model_refuses_a_plane_scene(plane_scene: Scene, is_shipped: bool) -> None:
    if not is_shipped:
        pytest.skip("no model is shipped yet")
    with pytest.raises(SimulatorError):
        gymnasium.make("GranularBaffle-v0", scene=plane_scene, n_baffles=1)

"""GranularBaffle-v0 as Gymnasium sees it, on the real solver and on the shipped model."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.utils.env_checker import check_env, data_equivalence

import gns_env.env
from gns_env.cache import RolloutCache
from gns_env.episode import flume as shipped_flume
from gns_env.errors import EnvError, InvalidScenario
from gns_env.objective import Objective, ObjectiveError
from gns_env.observation import MEASURES, ORDER
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
    assert info["centres"] == ()
    assert observation["placed"].sum() == 0
    np.testing.assert_allclose(observation["measures"][:4], 0.5)
    assert (observation["scenario"] == 0).all()
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
    seen = observation["measures"][MEASURES.index("centroid_travel")]
    assert seen == pytest.approx(ratio / (1 + ratio), 1e-5)
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
    assert second["centres"][:1] == first["centres"]
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


@pytest.mark.parametrize("placement", ["sequential", "joint"])
@pytest.mark.parametrize("action", ["continuous", "grid"])
@pytest.mark.parametrize("observation", ["dict", "flat"])
def test_every_kind_of_space(
    tiny_scene: Scene, tiny_mpm: MpmSimulator, placement: str, action: str, observation: str
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make(
            tiny_scene, tiny_mpm, n_baffles=2,
            placement=placement, action=action, observation=observation,
        )  # fmt: skip
        check_env(env.unwrapped)
        env.action_space.seed(5)
        observed, info = env.reset(seed=0)
        steps, over, total, before = 0, False, 0.0, info["cost"]
        while not over:
            observed, reward, over, _, info = env.step(env.action_space.sample())
            steps, total = steps + 1, total + reward
    assert steps == (1 if placement == "joint" else 2)
    assert total == pytest.approx(before - info["cost"])
    assert env.unwrapped.task.space.check(info["centres"]) == []
    assert observed in env.observation_space
    assert len(info["centres"]) == 2


def test_flat_is_the_dict_in_its_order(tiny_scene: Scene, tiny_mpm: MpmSimulator) -> None:
    action = np.array([-0.6, 0.3], np.float32)
    results = []
    for observation in ("dict", "flat"):
        env = make(tiny_scene, tiny_mpm, n_baffles=2, placement="joint", observation=observation)
        env.reset(seed=0, options={"speed": 1.3})
        results.append(env.step(action)[0])
    np.testing.assert_array_equal(
        np.concatenate([results[0][name].ravel() for name in ORDER]), results[1]
    )
    assert results[0]["scenario"][1] == pytest.approx(0.3)


def test_the_grid_names_places(small_flume: Scene, coarse_mpm: MpmSimulator) -> None:
    env = make(small_flume, coarse_mpm, n_baffles=2, action="grid", placement="joint")
    grid, space = env.unwrapped.grid, env.unwrapped.task.space
    assert env.action_space.nvec.tolist() == [len(grid)] * 2
    np.testing.assert_allclose(grid[0], space.lower)
    np.testing.assert_allclose(grid[-1], space.upper)
    env.reset()
    cells = np.array([len(grid) - 1, 0])
    info = env.step(cells)[4]
    np.testing.assert_allclose(info["centres"], grid[cells])
    assert info["moved"] == 0


@pytest.mark.parametrize("placement", ["sequential", "joint"])
def test_what_cannot_be_built_is_moved_and_measured(
    small_flume: Scene, coarse_mpm: MpmSimulator, placement: str
) -> None:
    env = make(small_flume, coarse_mpm, n_baffles=2, placement=placement)
    env.reset()
    if placement == "joint":  # both in the middle: apart by one width and one gap along x
        info = env.step(np.zeros(4, np.float32))[4]
        assert info["moved"] == pytest.approx(0.15 / 2**0.5, rel=1e-4)
    else:  # far outside: drawn in to the corner, the whole way told
        info = env.step(np.array([3.0, 1.0]))[4]
        space = env.unwrapped.task.space
        np.testing.assert_allclose(info["centres"], [space.upper])
        assert info["moved"] == pytest.approx(space.upper[0] - space.lower[0])
        env.step(np.array([np.inf, -np.inf]))
    assert env.unwrapped.task.space.check(info["centres"]) == []


@pytest.mark.parametrize("action", ["continuous", "grid"])
def test_no_action_at_all_is_refused_and_changes_nothing(
    small_flume: Scene, coarse_mpm: MpmSimulator, action: str
) -> None:
    env = make(small_flume, coarse_mpm, n_baffles=1, action=action, disable_env_checker=True)
    env.reset()
    bad = {
        "continuous": ([np.nan, 0.0], [0.0], [0.0, 0.0, 0.0], "up", None),
        "grid": (np.nan, -1, 10_000, 0.5, [1, 1], "up"),
    }[action]
    for wrong in bad:
        with pytest.raises(InvalidAction):
            env.step(wrong)
    _, _, terminated, _, _ = env.step(np.zeros(2) if action == "continuous" else 3)
    assert terminated


def test_known_layouts_are_not_simulated_twice_by_any_env_of_the_process(
    tiny_scene: Scene, faulty: type
) -> None:
    simulator, cache = faulty("not at all"), RolloutCache()
    first, second = (
        make(tiny_scene, simulator, n_baffles=2, cache=cache, render_mode=mode)
        for mode in (None, None)
    )
    for env in (first, second):
        env.reset(seed=0)
        for action in ([-0.5], [0.5]):
            info = env.step(np.array(action, np.float32))[4]
    assert sum(simulator.batches) == len(cache) == 3
    second.reset(seed=0)  # the same layout in the other order; one baffle at 0.5 alone is new
    for action in ([0.5], [-0.5]):
        again = second.step(np.array(action, np.float32))[4]
    assert sum(simulator.batches) == 4
    assert again["cost"] == info["cost"]
    assert again["centres"] == info["centres"][::-1]


def test_copies_go_on_as_the_original(tiny_scene: Scene, tiny_mpm: MpmSimulator) -> None:
    env = make(tiny_scene, tiny_mpm, n_baffles=3, scenarios="random", render_mode="rgb_array")
    env.reset(seed=4)
    env.step(np.array([-0.6], np.float32))
    env.unwrapped.task.space.project([[0.5], [0.52], [0.5]])  # a compiled programme is left behind
    copies = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    for action in ([0.1], [0.9]):
        observation, reward, _, _, info = env.step(np.array(action, np.float32))
        for other in copies:
            theirs = other.step(np.array(action, np.float32))
            assert data_equivalence(theirs[0], observation, exact=True)
            assert theirs[1] == reward
            assert theirs[4]["centres"] == info["centres"]
    expected = env.reset()[1]["scenario"]
    for other in copies:
        assert data_equivalence(other.reset()[1]["scenario"], expected, exact=True)
    assert copies[1].unwrapped.problem.cache is env.unwrapped.problem.cache  # the process's


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


def test_the_shipped_scene_is_the_example(examples: Path, flume: Scene) -> None:
    shipped = Path(gns_env.__file__).parent / "scenes" / "flume.toml"
    assert shipped.read_bytes() == (examples / "flume.toml").read_bytes()
    assert shipped_flume() == flume


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"simulator": "oracle"}, SimulatorError, "no simulator named 'oracle'"),
        ({"scene": "nowhere.toml"}, SceneError, "nowhere.toml"),
        ({"n_baffles": 500}, LayoutError, "at most"),
        ({"n_baffles": 0}, LayoutError, "1 or more"),
        ({"objective": Objective.pareto()}, ObjectiveError, "one Objective"),
        ({"render_mode": "ansi"}, EnvError, "rgb_array"),
        ({"placement": "random"}, EnvError, "'sequential' or 'joint'"),
        ({"action": "discrete"}, EnvError, "'continuous' or 'grid'"),
        ({"observation": "image"}, EnvError, "'dict' or 'flat'"),
        ({"scene": 3}, EnvError, "path of one"),
        ({"workers": 2, "simulator": MpmSimulator()}, EnvError, "given by name"),
        ({"scenarios": "some"}, InvalidScenario, "'random'"),
        ({"scenarios": {"colour": (0, 1)}}, InvalidScenario, "unknown key 'colour'"),
        ({"scenarios": {"speed": (1.0, float("nan"))}}, InvalidScenario, "range"),
        ({"scenarios": {"volume": (1.0, 2.0)}}, InvalidScenario, "0.4"),
    ],
)
def test_bad_arguments_are_refused_when_it_is_made(
    arguments: dict[str, object], error: type[Exception], message: str
) -> None:
    arguments = {"simulator": "mpm", **arguments}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # gymnasium warns of the render mode before we refuse it
        for make_it in (gymnasium.make, gymnasium.make_vec):
            with pytest.raises(error, match=message) as caught:
                make_it("GranularBaffle-v0", **arguments)
            assert isinstance(caught.value, gymnasium.error.Error)
            assert isinstance(caught.value, GnsError)
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
    with pytest.raises(SimulatorError, match="2D") as caught:
        gymnasium.make("GranularBaffle-v0", scene=plane_scene, n_baffles=1)
    assert isinstance(caught.value, gymnasium.error.Error)

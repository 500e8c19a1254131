"""The vector env: the results of single envs, in one batch."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode

import gns_model
from gns_env.cache import RolloutCache
from gns_env.errors import EnvError
from gns_env.vector_env import GranularBaffleVectorEnv
from gns_model.mpm import MpmSimulator
from gns_model.scene import Scene

KINDS = [
    {},
    {"scenarios": "random"},
    {"placement": "joint", "observation": "flat"},
    {"action": "grid", "scenarios": {"speed": (0.8, 1.6)}},
    {"action": "grid", "placement": "joint"},
]


def make_vec(n: int, **arguments: Any) -> gymnasium.vector.VectorEnv:
    return gymnasium.make_vec("GranularBaffle-v0", num_envs=n, **arguments)


def rows(batch: Any, k: int) -> Any:
    return {key: value[k] for key, value in batch.items()} if isinstance(batch, dict) else batch[k]


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_it_does_what_single_envs_do(
    tiny_scene: Scene, tiny_mpm: MpmSimulator, kind: dict[str, Any]
) -> None:
    """Against SyncVectorEnv of single envs, over several episodes, everything compared."""
    arguments = {"scene": tiny_scene, "simulator": tiny_mpm, "n_baffles": 2, **kind}
    ours = make_vec(3, cache=RolloutCache(), **arguments)
    theirs = make_vec(3, vectorization_mode="sync", cache=RolloutCache(), **arguments)
    assert isinstance(ours, GranularBaffleVectorEnv)
    assert ours.single_observation_space == theirs.single_observation_space
    assert ours.action_space == theirs.action_space
    assert ours.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"]
    assert data_equivalence(ours.reset(seed=11), theirs.reset(seed=11), exact=True)
    ours.action_space.seed(2)
    for _ in range(7):
        actions = ours.action_space.sample()
        a, b = ours.step(actions), theirs.step(actions)
        assert a[0] in ours.observation_space
        assert data_equivalence(a, b, exact=True)
    assert data_equivalence(ours.reset(seed=[5, 4, 3]), theirs.reset(seed=[5, 4, 3]), exact=True)


def test_the_same_on_a_learned_model(small_flume: Scene, is_shipped: bool) -> None:
    if not is_shipped:
        pytest.skip("no model is shipped")
    scene = small_flume.replace(duration=0.16)
    model = gns_model.load_simulator("baffle-lite")
    ours = make_vec(3, scene=scene, simulator=model, n_baffles=2, cache=RolloutCache())
    action = np.array([[-0.9, -0.4], [-0.8, 0.0], [-0.7, 0.5]], np.float32)
    observations, _ = ours.reset(seed=0, options={"speed": (1.4, 2.2)})
    stepped = ours.step(action)
    for k in range(3):
        env = gymnasium.make(
            "GranularBaffle-v0", scene=scene, simulator=model, n_baffles=2, cache=RolloutCache()
        )
        observation, _ = env.reset(seed=k, options={"speed": (1.4, 2.2)})
        single = env.step(action[k])
        for batch, one in ((observations, observation), (stepped[0], single[0])):
            for key, value in one.items():
                np.testing.assert_allclose(batch[key][k], value, atol=1e-5, err_msg=key)
        assert stepped[1][k] == pytest.approx(single[1], abs=1e-5)


def test_all_rollouts_of_a_step_are_one_batch(tiny_scene: Scene, faulty: type) -> None:
    simulator = faulty("not at all")
    envs = make_vec(
        4, scene=tiny_scene, simulator=simulator, n_baffles=1,
        scenarios={"speed": (0.9, 1.2)}, cache=RolloutCache(),
    )  # fmt: skip
    envs.reset(seed=0)
    envs.step(np.linspace(-1, 1, 4, dtype=np.float32)[:, None])
    envs.step(np.zeros((4, 1), np.float32))  # begins four new flows
    assert simulator.batches == [4, 4, 4]


def test_an_episode_that_fails_begins_anew_while_the_others_go_on(
    tiny_scene: Scene, faulty: type
) -> None:
    envs = make_vec(2, scene=tiny_scene, simulator=faulty("nan", at_least=2), n_baffles=3)
    envs.reset(seed=0)
    ends = []
    for actions in ([[-0.9], [-0.9]], [[0.0], [0.0]], [[0.5], [0.5]]):
        observations, rewards, terminated, truncated, infos = envs.step(np.array(actions))
        ends.append(terminated.tolist())
        assert not truncated.any()
        assert np.isfinite(rewards).all()
    assert ends == [[False, False], [True, True], [False, False]]
    assert (observations["placed"] == 0).all()
    assert (rewards == 0).all()
    assert infos["status"].tolist() == ["ok", "ok"]


def test_a_bad_action_is_named_and_changes_nothing(
    tiny_scene: Scene, tiny_mpm: MpmSimulator
) -> None:
    envs = make_vec(2, scene=tiny_scene, simulator=tiny_mpm, n_baffles=2)
    with pytest.raises(ResetNeeded):
        envs.step(np.zeros((2, 1)))
    envs.reset(seed=0)
    with pytest.raises(InvalidAction, match=r"sub-environment 1: .*NaN"):
        envs.step(np.array([[0.0], [np.nan]]))
    observations, _, _, _, _ = envs.step(np.array([[0.0], [0.1]]))
    assert observations["placed"].tolist() == [[1, 0], [1, 0]]


def test_a_mask_begins_some_episodes_only(tiny_scene: Scene, tiny_mpm: MpmSimulator) -> None:
    envs = make_vec(3, scene=tiny_scene, simulator=tiny_mpm, n_baffles=2)
    envs.reset(seed=0)
    envs.step(np.full((3, 1), -0.5, np.float32))
    options = {"reset_mask": np.array([False, True, False])}
    observations, infos = envs.reset(seed=5, options=options)
    assert observations["placed"][:, 0].tolist() == [1, 0, 1]
    assert infos["_cost"].tolist() == [False, True, False]
    assert "reset_mask" in options  # the caller's dict is the caller's
    with pytest.raises(EnvError, match="reset_mask"):
        envs.reset(options={"reset_mask": np.zeros(3, bool)})
    with pytest.raises(EnvError, match="3 seeds"):
        envs.reset(seed=[1])


def test_frames_of_all(tiny_scene: Scene, tiny_mpm: MpmSimulator) -> None:
    envs = make_vec(2, scene=tiny_scene, simulator=tiny_mpm, n_baffles=1, render_mode="rgb_array")
    with pytest.raises(ResetNeeded):
        envs.render()
    envs.reset(seed=0)
    envs.step(np.array([[-0.8], [0.8]], np.float32))
    first, second = envs.render()
    assert first.shape == second.shape
    assert (first != second).any()
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    with pytest.raises(EnvError, match="rgb_array"):
        make_vec(2, scene=tiny_scene, simulator=tiny_mpm, render_mode="human")


@pytest.mark.slow
def test_workers_give_the_same(tiny_scene: Scene) -> None:
    results = []
    for workers in (1, 2):
        envs = make_vec(
            2, scene=tiny_scene.replace(duration=0.12), simulator="mpm", n_baffles=1,
            workers=workers, cache=RolloutCache(),
        )  # fmt: skip
        assert envs.unwrapped.problem.simulator.workers == workers
        envs.reset(seed=0)
        results.append(envs.step(np.array([[-0.9], [-0.5]], np.float32)))
        envs.close()
    assert data_equivalence(*results, exact=True)

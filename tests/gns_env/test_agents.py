"""The field's own tools on GranularBaffle-v0: Stable-Baselines3, Optuna, Gymnasium's wrappers."""

from __future__ import annotations

import runpy
import sys
import warnings
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import optuna
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.wrappers import RecordEpisodeStatistics, RecordVideo

import gns_env
from gns_env.env import GranularBaffleEnv
from gns_model.mpm import MpmSimulator
from gns_model.scene import Scene


@pytest.fixture
def make(tiny_scene: Scene, tiny_mpm: MpmSimulator) -> Any:
    """gymnasium.make on the tiny scene with two baffles."""

    def make(**arguments: Any) -> gymnasium.Env:
        return gymnasium.make(
            "GranularBaffle-v0", scene=tiny_scene, simulator=tiny_mpm, n_baffles=2, **arguments
        )

    return make


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["PPO", "SAC"])
def test_stable_baselines_learns_for_2000_steps(make: Any, algorithm: str) -> None:
    sb3 = pytest.importorskip("stable_baselines3", reason="the extra [rl] is not installed")
    scenarios = {"PPO": "random", "SAC": None}[algorithm]
    env = RecordEpisodeStatistics(make(observation="flat", scenarios=scenarios), buffer_length=5000)
    options: dict[str, Any] = {"seed": 0, "device": "cpu", "policy_kwargs": {"net_arch": [32, 32]}}
    if algorithm == "PPO":
        model = sb3.PPO("MlpPolicy", env, n_steps=250, batch_size=125, n_epochs=4, **options)
    else:
        model = sb3.SAC("MlpPolicy", env, learning_starts=200, train_freq=4, **options)
    model.learn(2000)
    assert model.num_timesteps >= 2000
    returns = np.array(env.return_queue)
    assert len(returns) >= 990  # two steps an episode, and no rollout failed
    assert np.isfinite(returns).all()
    assert returns[-200:].mean() > returns[:200].mean()  # it learns
    observation, _ = env.reset(seed=1)
    action, _ = model.predict(observation, deterministic=True)
    assert action in env.action_space


def test_stable_baselines_has_nothing_to_complain_about(make: Any) -> None:
    checker = pytest.importorskip(
        "stable_baselines3.common.env_checker", reason="the extra [rl] is not installed"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(make(observation="flat", scenarios="random"))
        checker.check_env(make(observation="flat", action="grid", placement="joint"))
    checker.check_env(make())  # of the Dict it would have the maps flattened, and says so


def test_an_optuna_study_through_the_env_alone(make: Any) -> None:
    env = make(placement="joint")

    def cost(trial: optuna.Trial) -> float:
        env.reset(seed=0)
        action = [trial.suggest_float(f"x{k}", -1, 1) for k in range(2)]
        _, reward, terminated, _, info = env.step(np.array(action, np.float32))
        assert terminated
        assert info["cost"] == pytest.approx(1.5 - reward)
        return info["cost"]

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=0))
    study.optimize(cost, n_trials=25)
    first = [trial.value for trial in study.trials[:5]]
    assert study.best_value < min(first)
    assert study.best_value < 1.5


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_gymnasiums_own_vector_envs(make: Any, tiny_scene: Scene, mode: str) -> None:
    arguments = {"scene": tiny_scene, "simulator": MpmSimulator(spacing=0.05), "n_baffles": 2}
    actions = np.array([[-0.9], [0.2]], np.float32)
    results = []
    for kind in (mode, None):
        envs = gymnasium.make_vec(
            "GranularBaffle-v0", num_envs=2, vectorization_mode=kind, scenarios="random",
            **arguments,
        )  # fmt: skip
        results.append([envs.reset(seed=3), *(envs.step(actions) for _ in range(4))])
        envs.close()
    assert data_equivalence(*results)


def test_the_passive_checker_is_silent(make: Any) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make(scenarios="random", render_mode="rgb_array")  # make() wraps the checker around
        for seed in range(2):
            env.reset(seed=seed)
            env.render()
            for _ in range(2):
                env.step(env.action_space.sample())


def test_record_video_keeps_a_film_of_the_episode(make: Any, tmp_path: Path) -> None:
    moviepy = pytest.importorskip("moviepy", reason="the extra [rl] is not installed")
    env = RecordVideo(make(render_mode="rgb_array"), str(tmp_path), episode_trigger=lambda k: True)
    env.reset(seed=0)
    for action in ([-0.8], [0.1]):
        env.step(np.array(action, np.float32))
    env.close()
    (film,) = tmp_path.glob("*.mp4")
    with moviepy.VideoFileClip(str(film)) as clip:
        frames = [clip.get_frame(t) for t in (0.1, 0.6, 1.1)]
        assert clip.n_frames == 3
    assert all((a != b).mean() > 0.001 for a, b in pairwise(frames))


def test_human_rendering(make: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pygame", reason="the extra [rl] is not installed")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setitem(GranularBaffleEnv.metadata, "render_fps", 50)
    env = make(render_mode="human")
    env.reset(seed=0)
    shown = env.unwrapped._window._surface
    import pygame

    before = pygame.surfarray.array3d(shown).copy()
    env.step(np.array([-0.8], np.float32))
    assert (pygame.surfarray.array3d(shown) != before).any()
    assert env.render() is None
    env.close()
    assert env.unwrapped._window is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(render_mode="human").unwrapped)


def test_human_rendering_without_pygame_is_one_clear_error(
    make: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(gymnasium.error.DependencyNotInstalled, match="pip install"):
        make(render_mode="human")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("example", "arguments"),
    [
        ("random_agent.py", ["--simulator", "mpm", "--spacing", "0.0625", "--episodes", "3"]),
        ("optuna_env.py", ["--simulator", "mpm", "--spacing", "0.0625", "--rollouts", "24"]),
        (
            "ppo_vector.py",
            ["--rollouts=60", "--spacing=0.08", "--no-verify", "--figure={folder}/curve.png"],
        ),
    ],
)
def test_examples_run_and_check_themselves(
    examples: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, example: str, arguments: list
) -> None:
    gns_env.cache.shared_cache().clear()
    arguments = [word.format(folder=tmp_path) for word in arguments]
    monkeypatch.setattr(sys, "argv", [example, *arguments])
    runpy.run_path(str(examples / example), run_name="__main__")
    if example == "ppo_vector.py":
        assert (tmp_path / "curve.png").stat().st_size > 10_000

"""GranularBaffle-v0 many at once: the rollouts of all sub-environments are one batch."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate
from numpy.typing import NDArray

from gns_env.cache import RolloutCache
from gns_env.env import GranularBaffleEnv
from gns_env.episode import Episode, Problem, play
from gns_env.errors import EnvError
from gns_env.objective import Objective
from gns_env.rendering import rest_image
from gns_model.scene import Scene
from gns_model.simulator import Simulator


class GranularBaffleVectorEnv(VectorEnv[Any, Any, NDArray[Any]]):
    """`num_envs` episodes of GranularBaffle-v0; what `gymnasium.make_vec` makes of that id.

    Spaces, rewards, scenarios and arguments are those of `gns_env.env.GranularBaffleEnv`, and the
    same seeds and actions give the same results as `num_envs` single envs. All rollouts of a `step`
    or `reset` are one batch: one graph on a GPU, and on a CPU one graph or, with `workers`, shared
    by so many one-thread processes.

    `metadata["autoreset_mode"]` is `NEXT_STEP`, as of Gymnasium's own: the step after the end of an
    episode ignores its action, begins the next episode and has reward 0. A seed s of `reset` gives
    sub-environment k the seed s + k; a list gives each its own. `options` hold for all;
    `options["reset_mask"]`, a bool array (num_envs,), begins only the episodes marked.

    Raises:
        EnvError: as the single env.
        InvalidAction: from `step`, before anything changes, naming the sub-environment.
    """

    metadata = {  # noqa: RUF012 (Gymnasium's way)
        "render_modes": ["rgb_array"],
        "render_fps": GranularBaffleEnv.metadata["render_fps"],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        scene: Scene | str | os.PathLike[str] | None = None,
        simulator: Simulator | str | os.PathLike[str] = "baffle-lite",
        n_baffles: int = 3,
        placement: str = "sequential",
        action: str = "continuous",
        observation: str = "dict",
        objective: Objective | None = None,
        scenarios: str | Mapping[str, Any] | None = None,
        device: str = "cpu",
        workers: int = 1,
        cache: RolloutCache | None = None,
        render_mode: str | None = None,
    ) -> None:
        if num_envs < 1:
            raise EnvError(f"num_envs must be 1 or more, got {num_envs}")
        if render_mode not in (None, "rgb_array"):
            raise EnvError(
                f"render_mode of the vector env must be None or 'rgb_array', got {render_mode!r}"
            )
        self.num_envs, self.render_mode = num_envs, render_mode
        self.problem = Problem(
            scene,
            simulator,
            n_baffles=n_baffles,
            placement=placement,
            action=action,
            observation=observation,
            objective=objective,
            scenarios=scenarios,
            device=device,
            workers=workers,
            cache=cache,
        )
        self.single_action_space = self.problem.actions.gym
        self.single_observation_space = self.problem.observer.gym
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.episodes = [Episode(self.problem) for _ in range(num_envs)]
        self._random: list[np.random.Generator | None] = [None] * num_envs

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        if seed is None or isinstance(seed, (int, np.integer)):
            seeds = [None if seed is None else int(seed) + k for k in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise EnvError(f"{self.num_envs} seeds are needed, got {len(seeds)}")
        options = dict(options or {})
        chosen = self._mask(options.pop("reset_mask", np.ones(self.num_envs, bool)))
        for k in np.flatnonzero(chosen):
            if seeds[k] is not None or self._random[k] is None:
                self._random[k], _ = seeding.np_random(seeds[k])
        self._plan_resets(chosen, options)
        self._play()
        return self._observations(), self._infos(chosen)

    def step(
        self, actions: Any
    ) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        ended = np.array([episode.over for episode in self.episodes])
        if any(episode.state is None for episode in self.episodes):
            raise ResetNeeded("the episodes have not begun: call reset() first")
        for k, action in enumerate(iterate(self.action_space, actions)):
            if not ended[k]:
                try:
                    self.episodes[k].plan_step(action)
                except InvalidAction as error:
                    for episode in self.episodes:
                        episode.cancel()
                    raise InvalidAction(f"sub-environment {k}: {error}") from None
        self._plan_resets(ended, None)
        self._play()
        return (
            self._observations(),
            np.array([episode.reward for episode in self.episodes]),
            np.array([episode.over for episode in self.episodes]),
            np.zeros(self.num_envs, bool),
            self._infos(np.ones(self.num_envs, bool)),
        )

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """An image of every sub-environment, each (H, W, 3); None without a render_mode."""
        if self.render_mode is None:
            return None
        if any(episode.state is None for episode in self.episodes):
            raise ResetNeeded("nothing to render yet: call reset() first")
        return tuple(rest_image(e.state, e.task) for e in self.episodes if e.state is not None)

    def close_extras(self, **kwargs: Any) -> None:
        self.problem.close()

    def _plan_resets(self, chosen: NDArray[np.bool_], options: dict[str, Any] | None) -> None:
        try:
            for k in np.flatnonzero(chosen):
                random = self._random[k]
                assert random is not None
                self.episodes[k].plan_reset(random, options)
        except BaseException:
            for episode in self.episodes:
                episode.cancel()
            raise

    def _play(self) -> None:
        play(self.episodes, "nothing" if self.render_mode is None else "rest")

    def _mask(self, mask: Any) -> NDArray[np.bool_]:
        if not isinstance(mask, np.ndarray) or mask.shape != (self.num_envs,) or not mask.any():
            raise EnvError(f"reset_mask must be {self.num_envs} bools, one true, got {mask!r}")
        return mask.astype(bool)

    def _observations(self) -> Any:
        space = self.single_observation_space
        batch: Any = create_empty_array(space, self.num_envs)
        return concatenate(space, [episode.observation() for episode in self.episodes], batch)

    def _infos(self, chosen: NDArray[np.bool_]) -> dict[str, Any]:
        infos: dict[str, Any] = {}
        for k in np.flatnonzero(chosen):
            infos = self._add_info(infos, self.episodes[k].info(), int(k))
        return infos

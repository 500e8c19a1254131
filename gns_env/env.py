"""GranularBaffle-v0: place baffles in the path of a granular flow."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from gns_env.cache import RolloutCache
from gns_env.episode import Episode, Problem, play
from gns_env.errors import EnvError
from gns_env.objective import Objective
from gns_env.rendering import rest_image
from gns_env.task import BaffleTask
from gns_model.scene import Scene
from gns_model.simulator import Simulator


class GranularBaffleEnv(gymnasium.Env[Any, Any]):
    """
    ## Description

    A mass of grains slides down a channel. Place `n_baffles` rigid boxes in its path, so that the
    flow stops earlier without piling up upstream of them. After every placement the whole flow is
    simulated from its release, with the baffles that stand so far.

    The default scene is the flume of Choi & Kumar, "Graph Neural Network-based surrogate model for
    granular flows": a box of 1.8 x 0.8 x 1.8 m and 220 kg of sand released at 2 m/s.

    ## Action Space

    With D the dimension of the scene, 3 or 2 (plane strain), and n = `n_baffles`:

    | `placement`    | `action`       | Space                                                    |
    |----------------|----------------|----------------------------------------------------------|
    | `"sequential"` | `"continuous"` | `Box(-1, 1, (D-1,), float32)`: the next baffle           |
    | `"joint"`      | `"continuous"` | `Box(-1, 1, (n*(D-1),), float32)`: all, one after another |
    | `"sequential"` | `"grid"`       | `Discrete(K)`: cell of the next baffle                   |
    | `"joint"`      | `"grid"`       | `MultiDiscrete([K] * n)`: cell of each                   |

    | Num | Continuous action of one baffle       | Min                | Max                  |
    |-----|---------------------------------------|--------------------|----------------------|
    | 0   | x of the baffle's centre, downstream  | -1 (upstream edge) | 1 (downstream edge)  |
    | 1   | z of the baffle's centre, across (3D) | -1 (low z edge)    | 1 (high z edge)      |

    The edges are those that keep the whole baffle in the placement area of the scene. The K cells
    of the grid lie over the same area in steps of about half a baffle, cell k at x number
    k // (cells across) and z number k % (cells across); `env.unwrapped.grid` holds their centres.

    Numbers outside [-1, 1] are clipped. What cannot be built, because it comes too close to another
    baffle, to a keep-out or to the release, is moved to the nearest layout that can: baffles that
    stand already stay, and the next one keeps away from places that leave no room for the rest.
    `info["moved"]` says how far [m]. Only what is no action at all, NaN, another shape or a cell
    that does not exist, raises `gymnasium.error.InvalidAction`, before anything changes: the
    episode goes on with the next action.

    ## Observation Space

    `observation="dict"`: a `Dict` of `Box`es, all float32. `observation="flat"`: one
    `Box(-1, 1, (length,), float32)`, the same entries, flattened, in the order layout, placed,
    measures, scenario, deposit, with their own bounds.

    | Key        | Shape    | Min | Max | What                                                 |
    |------------|----------|-----|-----|------------------------------------------------------|
    | `deposit`  | (nx, nz) | 0   | 1   | depth in the last frame over the height of a baffle, |
    |            |          |     |     | clipped, in cells of 5 cm of the domain; (nx,) in 2D |
    | `layout`   | (n, D-1) | -1  | 1   | baffles so far, as continuous actions; then zeros    |
    | `placed`   | (n,)     | 0   | 1   | 1 for baffles that stand                             |
    | `measures` | (6,)     | 0   | 1   | r / (1 + r) for r = centroid travel, p99 runout,     |
    |            |          |     |     | upstream depth, energy dissipated, each over that    |
    |            |          |     |     | without baffles (so 0.5 without); then the share of  |
    |            |          |     |     | mass past the section and the share that overtopped  |
    | `scenario` | (3+D-1,) | -1  | 1   | see the next table; all 0 for the scene as it is     |

    | Num | Scenario          | -1                       | 0           | 1                        |
    |-----|-------------------|--------------------------|-------------|--------------------------|
    | 0   | volume            | a quarter                | the scene's | four times (logarithmic) |
    | 1   | speed             | that much slower         | the scene's | the scene's more, or 1   |
    |     |                   |                          |             | m/s if that is larger    |
    | 2   | friction angle    | 20 degrees less          | the scene's | 20 degrees more          |
    | 3   | place along x     | half the domain upstream | the scene's | half the domain          |
    | 4   | place along z, 3D | half the domain          | the scene's | half the domain          |

    ## Rewards

    The decrease of the objective's cost that the new baffles bring, so that the rewards of an
    episode sum to the cost of no baffles less that of the layout. The default cost is
    `centroid_travel / (that without baffles) + 0.5 * upstream_depth / (that without baffles)`, the
    depth counting as no less than that of the free flow (see `gns_env.Objective`): it is
    1.5 without baffles. A rollout that fails (diverges, or leaks grains into baffles) costs 10
    times as much as no baffles, so its reward is finite, between -15 and -12 by default.

    ## Starting State

    No baffles, and the deposit of the free flow of the episode's scenario. By default that is the
    scene's own flow and nothing is random. `scenarios="random"` draws a flow for every episode,
    uniformly: volume 0.6 to 1.4 times and speed 0.6 to 1.25 times the scene's, friction angle 5
    degrees about it, place up to a tenth of the domain off as far as there is room; for a learned
    model no wider than it was trained for (`baffle-lite` saw one friction angle, which therefore
    stays). `scenarios={"speed": (1.0, 2.5)}` draws what it names and leaves the rest. A flow that
    cannot be built or measured is drawn again. The seed of `reset` decides everything.

    `reset(options={...})` holds for one episode: `volume` [m³, in 2D m²], `speed` [m/s],
    `friction_angle` [degrees] and `place` (a shift [m] along x and z) each take a number or a range
    (low, high) to draw from; `randomise=True` draws the keys that are not named as
    `scenarios="random"` does, `False` leaves them as the scene has them. Unknown keys and values
    beyond the table above raise `gns_env.errors.InvalidScenario`. A learned model may be asked for
    a flow that it was not trained for: it warns, once for each limit, and goes on.

    Points fill a release in whole layers of the simulator's spacing, so a coarse one sees volume in
    steps.

    ## Episode End

    Termination: all baffles stand, or a rollout failed (`info["diverged"]`). Never truncated.

    ## Information

    | Key        | What                                                                       |
    |------------|----------------------------------------------------------------------------|
    | `centres`  | of the baffles that stand [m], a tuple of (x, z), in 2D (x,)               |
    | `measures` | dict, SI units, as `gns_model.measures.summary`                            |
    | `cost`     | of the objective, lower is better                                          |
    | `status`   | "ok", or how the rollout failed: "diverged", "leaked", "interrupted"       |
    | `diverged` | whether it failed                                                          |
    | `moved`    | how far the action's baffles stand from where it wanted them [m]: the root |
    |            | of the sum of squares over them                                            |
    | `scenario` | dict: volume, speed, friction_angle and place, in the units of `reset`     |

    ## Arguments

    | Argument      | Default         | What                                                     |
    |---------------|-----------------|----------------------------------------------------------|
    | `scene`       | `None`          | a `gns_model.Scene` or the path of one; None: the flume  |
    | `simulator`   | `"baffle-lite"` | "mpm", a shipped model, the path of a checkpoint, or any |
    |               |                 | object with `name`, `rollout(scenes)` and `check(scene)` |
    | `n_baffles`   | `3`             | baffles to place                                         |
    | `placement`   | `"sequential"`  | or `"joint"`: all baffles in one step                    |
    | `action`      | `"continuous"`  | or `"grid"`                                              |
    | `observation` | `"dict"`        | or `"flat"`                                              |
    | `objective`   | `None`          | `gns_env.Objective`; None: the default one               |
    | `scenarios`   | `None`          | `"random"`, or ranges by key: see Starting State         |
    | `device`      | `"cpu"`         | torch device of a simulator given by name                |
    | `workers`     | `1`             | processes that share a batch of rollouts on the CPU, for |
    |               |                 | a simulator given by name (`make_vec`; a script needs    |
    |               |                 | the guard `if __name__ == "__main__":`)                  |
    | `cache`       | `None`          | `gns_env.RolloutCache`; None: that of the process, so no |
    |               |                 | env of it simulates a known layout again                 |
    | `render_mode` | `None`          | `"rgb_array"` or `"human"`: plan of the deposit and side |
    |               |                 | view with the peak depth at every baffle                 |

    ```python
    >>> import gymnasium, gns_env
    >>> env = gymnasium.make("GranularBaffle-v0", simulator="mpm", n_baffles=4)
    >>> envs = gymnasium.make_vec("GranularBaffle-v0", num_envs=8, scenarios="random")
    ```

    `make_vec` runs the rollouts of all its envs as one batch (`gns_env.vector_env`).

    Arguments and options that cannot be raise one line at construction or in `reset`: a subclass of
    `gymnasium.error.Error`, and also of the matching `gns_model.errors` (see `gns_env.errors`).

    ## Version History

    * v0: first version.
    """

    metadata = {  # noqa: RUF012 (Gymnasium's way)
        "render_modes": ["human", "rgb_array"],
        "render_fps": 2,
    }

    def __init__(
        self,
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
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise EnvError(f"render_mode must be None, 'human' or 'rgb_array', got {render_mode!r}")
        self.render_mode = render_mode
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
        self.action_space = self.problem.actions.gym
        self.observation_space = self.problem.observer.gym
        self.episode = Episode(self.problem)
        self._window: Any = None
        if render_mode == "human":
            from gns_env.window import require_pygame

            require_pygame()

    @property
    def task(self) -> BaffleTask:
        """The task of the current scenario: its scene, layout space, objective and reference."""
        return self.episode.task

    @property
    def grid(self) -> NDArray[np.float64] | None:
        """Centres [m] of the cells of a grid action, shape (K, D-1); None if continuous."""
        grid = self.problem.actions.grid
        return None if grid is None else grid.copy()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.episode.plan_reset(self.np_random, options)
        return self._advance()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.episode.plan_step(action)
        observation, info = self._advance()
        return observation, self.episode.reward, self.episode.over, False, info

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """Plan and side view of where the flow came to rest, shape (H, W, 3); None if human."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() without a render_mode: give make() 'rgb_array'")
            return None
        if self.episode.state is None:
            raise ResetNeeded("nothing to render yet: call reset() first")
        image = rest_image(self.episode.state, self.task)
        if self.render_mode == "rgb_array":
            return image
        if self._window is None:
            from gns_env.window import Window

            self._window = Window("GranularBaffle-v0", self.metadata["render_fps"])
        self._window.show(image)
        return None

    def close(self) -> None:
        if self._window is not None:
            self._window.close()
            self._window = None
        self.problem.close()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_window": None}  # a copy opens a window of its own

    def _advance(self) -> tuple[Any, dict[str, Any]]:
        play([self.episode], "nothing" if self.render_mode is None else "rest")
        if self.render_mode == "human":
            self.render()
        return self.episode.observation(), self.episode.info()

"""GranularBaffle-v0: place baffles one by one in the path of a granular flow."""

from __future__ import annotations

import os
from importlib import resources
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import InvalidAction, ResetNeeded
from numpy.typing import NDArray

from gns_env.objective import Objective, ObjectiveError
from gns_env.rendering import depth_map, frame_image
from gns_env.task import BaffleTask, Evaluation
from gns_model.scene import Scene
from gns_model.simulator import Simulator

#: Side of a cell of the deposit map [m].
CELL = 0.05
#: What the entries of the observation's `measures` are; the first four relative to no baffles.
MEASURES = (
    "centroid_travel",
    "runout_p99",
    "upstream_depth",
    "energy_dissipated",
    "mass_past_section",
    "overtopping",
)
RELATIVE = 4
#: Bound of the observed measures: ten times those of no baffles.
BOUND = 10.0


def flume() -> Scene:
    """The flume of Choi & Kumar, as shipped with the package (examples/flume.toml)."""
    with resources.as_file(resources.files("gns_env") / "scenes" / "flume.toml") as path:
        return Scene.from_toml(path)


class GranularBaffleEnv(gymnasium.Env[dict[str, NDArray[np.float32]], NDArray[np.float32]]):
    """
    ## Description

    A mass of grains slides down a channel. Place `n_baffles` rigid boxes in its path, one at each
    step, so that the flow stops earlier without piling up upstream of them. After every placement
    the whole flow is simulated from its release, with the baffles that stand so far.

    The default scene is the flume of Choi & Kumar, "Graph Neural Network-based surrogate model for
    granular flows": a box of 1.8 x 0.8 x 1.8 m and 220 kg of sand released at 2 m/s.

    ## Action Space

    `Box(-1, 1, (D-1,), float32)`: where the next baffle stands, across the whole placement area of
    the scene; D is 3, or 2 for a plane-strain scene. Values outside are clipped.

    | Num | Action                                | Min                | Max                  |
    |-----|---------------------------------------|--------------------|----------------------|
    | 0   | x of the baffle's centre, downstream  | -1 (upstream edge) | 1 (downstream edge)  |
    | 1   | z of the baffle's centre, across (3D) | -1 (low z edge)    | 1 (high z edge)      |

    A baffle that would come too close to an earlier one, to a keep-out or to the release is moved
    to the nearest buildable place, and away from places that leave no room for the rest;
    `info["moved"]` says how far [m]. Earlier baffles stay where they are.

    ## Observation Space

    `Dict` of `Box`es, all float32 (n = `n_baffles`):

    | Key        | Shape    | Min | Max | What                                                 |
    |------------|----------|-----|-----|------------------------------------------------------|
    | `deposit`  | (nx, nz) | 0   | 1   | depth in the last frame over the height of a baffle, |
    |            |          |     |     | clipped, in cells of 5 cm of the domain; (nx,) in 2D |
    | `layout`   | (n, D-1) | -1  | 1   | baffles so far, as the action says it; then zeros    |
    | `placed`   | (n,)     | 0   | 1   | 1 for baffles that stand                             |
    | `measures` | (6,)     | 0   | 10  | centroid travel, p99 runout, upstream depth, energy  |
    |            |          |     |     | dissipated, each over that without baffles; share of |
    |            |          |     |     | mass past the section; share that overtopped         |

    ## Rewards

    The decrease of the objective's cost that the new baffle brings, so that the rewards of an
    episode sum to the cost of no baffles less that of the layout. The default cost is
    `centroid_travel / (that without baffles) + 0.5 * upstream_depth / (that without baffles)`, the
    depth counting as no less than that of the free flow (see `gns_env.Objective`): it is
    1.5 without baffles. A rollout that fails (diverges, or leaks grains into baffles) costs 10
    times as much as no baffles.

    ## Starting State

    No baffles, and the deposit of the free flow. Nothing is random: the seed of `reset` changes
    nothing but the generator of the action space's user.

    ## Episode End

    Termination: all baffles stand, or a rollout failed (`info["diverged"]`). Never truncated.

    ## Information

    `reset` and `step` return `centres` (k, D-1) [m], `measures` (dict, SI units, as
    `gns_model.measures.summary`), `cost`, `status`, `diverged` and `moved` [m].

    ## Arguments

    | Argument    | Default         | What                                                       |
    |-------------|-----------------|------------------------------------------------------------|
    | `scene`     | `None`          | a `gns_model.Scene` or the path of one; None: the flume    |
    | `simulator` | `"baffle-lite"` | "mpm", a shipped model, the path of a checkpoint, or any   |
    |             |                 | object with `rollout(scenes)` and `check(scene)`           |
    | `n_baffles` | `3`             | baffles to place                                           |
    | `objective` | `None`          | `gns_env.Objective`; None: the default one                 |
    | `device`    | `"cpu"`         | torch device of a learned simulator that is given by name  |

    ```python
    >>> import gymnasium
    >>> env = gymnasium.make("gns_env:GranularBaffle-v0", simulator="mpm", n_baffles=4)
    ```

    Errors come at construction and are subclasses of `gns_model.errors.GnsError`: `SceneError`,
    `SimulatorError`, `FileFormatError`, and `LayoutError` if the baffles do not fit.

    ## Version History

    * v0: first version.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012 (Gymnasium's way)

    def __init__(
        self,
        scene: Scene | str | os.PathLike[str] | None = None,
        simulator: Simulator | str | os.PathLike[str] = "baffle-lite",
        n_baffles: int = 3,
        objective: Objective | None = None,
        device: str = "cpu",
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        if objective is not None and not isinstance(objective, Objective):
            raise ObjectiveError(f"the env takes one Objective, got {objective!r}")
        if scene is None:
            scene = flume()
        elif not isinstance(scene, Scene):
            scene = Scene.from_toml(scene)
        self.render_mode = render_mode
        self.task = BaffleTask(
            scene, simulator, n_baffles=n_baffles, objective=objective, device=device
        )
        d, n = scene.dim - 1, self.task.space.n_baffles
        size = np.array(scene.domain.size)[[0, *range(2, scene.dim)]]
        cells = tuple(int(c) for c in np.maximum(np.rint(size / CELL), 1))
        self.action_space = spaces.Box(-1.0, 1.0, (d,), np.float32)
        self.observation_space = spaces.Dict(  # type: ignore[assignment]
            {
                "deposit": spaces.Box(0.0, 1.0, cells, np.float32),
                "layout": spaces.Box(-1.0, 1.0, (n, d), np.float32),
                "placed": spaces.Box(0.0, 1.0, (n,), np.float32),
                "measures": spaces.Box(0.0, BOUND, (len(MEASURES),), np.float32),
            }
        )
        self._state: Evaluation | None = None
        self._over = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[np.float32]], dict[str, Any]]:
        super().reset(seed=seed)
        self._state = self._simulate(self.task.space.as_centres([]))
        self._over = False
        return self._observe(self._state), self._inform(self._state, 0.0)

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[dict[str, NDArray[np.float32]], float, bool, bool, dict[str, Any]]:
        if self._state is None or self._over:
            raise ResetNeeded("the episode is over or has not begun: call reset() first")
        wish = np.asarray(action, dtype=float)
        if wish.shape != self.action_space.shape or not np.isfinite(wish).all():
            raise InvalidAction(f"expected {self.action_space.shape} finite numbers, got {action}")
        space, before = self.task.space, self._state
        centre = space.decode((np.clip(wish, -1, 1) + 1) / 2)[0]
        place = space.place(centre, before.centres)
        self._state = self._simulate(np.vstack([before.centres, place]))
        self._over = self._state.failed or len(self._state.centres) == space.n_baffles
        reward = before.cost - self._state.cost
        info = self._inform(self._state, float(np.linalg.norm(place - centre)))
        return self._observe(self._state), float(reward), self._over, False, info

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """Plan and side view of where the flow came to rest, shape (H, W, 3)."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() without a render_mode: give make() 'rgb_array'")
            return None
        if self._state is None or self._state.trajectory is None:
            raise ResetNeeded("nothing to render yet: call reset() first")
        return frame_image(self._state.trajectory)

    def _simulate(self, centres: NDArray[np.float64]) -> Evaluation:
        return self.task.evaluate([centres], trajectories=True)[0]

    def _observe(self, state: Evaluation) -> dict[str, NDArray[np.float32]]:
        space, k = self.task.space, len(state.centres)
        layout = np.zeros((space.n_baffles, len(space.lower)), np.float32)
        unit = space.encode(state.centres).reshape(-1, len(space.lower))
        layout[:k] = np.clip(2 * unit - 1, -1, 1)
        placed = np.zeros(space.n_baffles, np.float32)
        placed[:k] = 1
        assert state.trajectory is not None
        depth = depth_map(state.trajectory, -1, CELL) / space.size[1]
        reference = self.task.reference
        values = np.array([state.measures[name] for name in MEASURES])
        scale = np.array([reference[name] for name in MEASURES])
        scale[RELATIVE:] = 1.0
        values = np.divide(values, scale, out=np.zeros_like(values), where=scale > 0)
        return {
            "deposit": np.clip(depth, 0, 1).astype(np.float32),
            "layout": layout,
            "placed": placed,
            "measures": np.clip(values, 0, BOUND).astype(np.float32),
        }

    def _inform(self, state: Evaluation, moved: float) -> dict[str, Any]:
        return {
            "centres": state.centres.copy(),
            "measures": dict(state.measures),
            "cost": state.cost,
            "status": state.status,
            "diverged": state.failed,
            "moved": moved,
        }

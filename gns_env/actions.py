"""Actions: what an agent says, as places for baffles.

`placement` is "sequential", one baffle a step beside those that stand, or "joint", all in one step.
`action` is "continuous", numbers in [-1, 1] across the placement area, or "grid", the number of a
cell of a grid of half-baffle steps over the same area.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from gymnasium.error import InvalidAction
from numpy.typing import NDArray

from gns_env.errors import EnvError
from gns_env.layout import LayoutSpace

Placement = Literal["sequential", "joint"]
#: A continuous action counts as this far outside at most, so that `moved` stays finite.
FAR = 100.0


class Actions:
    """The action space over `space`, and what its elements mean.

    Attributes:
        gym: the Gymnasium space.
        baffles: placed by one action: 1 or all.
        grid: centres [m] by cell, shape (K, D-1); cells run along z first. None if continuous.

    Raises:
        EnvError: if `placement` or `action` is none of those above.
    """

    def __init__(self, space: LayoutSpace, placement: str, action: str) -> None:
        if placement not in ("sequential", "joint"):
            raise EnvError(f"placement must be 'sequential' or 'joint', got {placement!r}")
        if action not in ("continuous", "grid"):
            raise EnvError(f"action must be 'continuous' or 'grid', got {action!r}")
        self.lower, self.upper = space.lower, space.upper
        self.joint = placement == "joint"
        self.baffles = space.n_baffles if self.joint else 1
        self.grid: NDArray[np.float64] | None = None
        self.gym: spaces.Space[Any]
        if action == "continuous":
            self.gym = spaces.Box(-1.0, 1.0, (self.baffles * len(space.lower),), np.float32)
            return
        step = space.size[[0, *range(2, len(space.size))]] / 2
        counts = np.rint((space.upper - space.lower) / step).astype(int) + 1
        axes = [np.linspace(*ends) for ends in zip(space.lower, space.upper, counts, strict=True)]
        self.grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(axes))
        cells = len(self.grid)
        self.gym = (
            spaces.MultiDiscrete([cells] * self.baffles) if self.joint else spaces.Discrete(cells)
        )

    def wish(self, action: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where `action` wants its baffles [m], shape (baffles, D-1), and that inside the area.

        Raises:
            InvalidAction: if it has another shape, is NaN, or names no cell of the grid.
        """
        try:
            values = np.asarray(action, dtype=float)
        except (TypeError, ValueError):
            raise InvalidAction(f"an action must be numbers, got {action!r}") from None
        if values.shape != (self.gym.shape or ()):
            raise InvalidAction(
                f"an action of this env has shape {self.gym.shape or ()}, got {values.shape}"
            )
        if np.isnan(values).any():
            raise InvalidAction(f"an action must not hold NaN, got {values.tolist()}")
        if self.grid is not None:
            cells = np.atleast_1d(values)
            if (cells != np.rint(cells)).any() or not (
                (cells >= 0) & (cells < len(self.grid))
            ).all():
                raise InvalidAction(
                    f"an action names cells 0 to {len(self.grid) - 1}, got {values.tolist()}"
                )
            centres = self.grid[cells.astype(int)]
            return centres, centres
        asked = np.clip(values, -FAR, FAR).reshape(self.baffles, -1)
        return self._centres(asked), self._centres(np.clip(asked, -1, 1))

    def _centres(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        share = (values + 1) / 2
        return (1 - share) * self.lower + share * self.upper

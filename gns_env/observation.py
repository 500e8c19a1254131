"""Observations: what a policy is shown, as a Dict of Boxes or as one flat Box."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from gns_env.deposit import cells
from gns_env.errors import EnvError
from gns_env.layout import LayoutSpace
from gns_env.task import Evaluation
from gns_model.scene import Scene

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
#: Order of the flat observation.
ORDER = ("layout", "placed", "measures", "scenario", "deposit")

Observation = dict[str, NDArray[np.float32]]


class Observer:
    """Turns evaluations into observations of one scene and number of baffles.

    Attributes:
        gym: the Gymnasium space.

    Raises:
        EnvError: if `observation` is neither "dict" nor "flat".
    """

    def __init__(self, scene: Scene, space: LayoutSpace, observation: str) -> None:
        if observation not in ("dict", "flat"):
            raise EnvError(f"observation must be 'dict' or 'flat', got {observation!r}")
        self.flat = observation == "flat"
        self.shape = space.n_baffles, scene.dim - 1
        n, d = self.shape
        self._height = space.size[1]
        boxes = {
            "deposit": spaces.Box(0.0, 1.0, cells(scene), np.float32),
            "layout": spaces.Box(-1.0, 1.0, (n, d), np.float32),
            "placed": spaces.Box(0.0, 1.0, (n,), np.float32),
            "measures": spaces.Box(0.0, 1.0, (len(MEASURES),), np.float32),
            "scenario": spaces.Box(-1.0, 1.0, (3 + d,), np.float32),
        }
        self.gym: spaces.Space[Any] = spaces.Dict(boxes)  # type: ignore[arg-type]
        if self.flat:
            low, high = (
                np.concatenate([getattr(boxes[name], end).ravel() for name in ORDER])
                for end in ("low", "high")
            )
            self.gym = spaces.Box(low, high, dtype=np.float32)

    def observe(
        self,
        state: Evaluation,
        space: LayoutSpace,
        reference: Mapping[str, float],
        scenario: NDArray[np.float32],
    ) -> Observation | NDArray[np.float32]:
        """The observation of `state`; `reference` are the measures of the free flow."""
        n, d = self.shape
        k = len(state.centres)
        layout, placed = np.zeros((n, d), np.float32), np.zeros(n, np.float32)
        if k:
            layout[:k] = np.clip(2 * space.encode(state.centres).reshape(k, d) - 1, -1, 1)
        placed[:k] = 1
        parts = {
            "deposit": np.clip(state.deposit / self._height, 0, 1).astype(np.float32),
            "layout": layout,
            "placed": placed,
            "measures": normalised(state.measures, reference),
            "scenario": scenario.copy(),
        }
        if self.flat:
            return np.concatenate([parts[name].ravel() for name in ORDER])
        return parts


def normalised(
    measures: Mapping[str, float], reference: Mapping[str, float]
) -> NDArray[np.float32]:
    """MEASURES in [0, 1]: r / (1 + r) of the relative ones, so 0.5 without baffles; shares as such.

    A relative measure that is zero without baffles is shown as 0.
    """
    values = np.array([measures[name] for name in MEASURES])
    scale = np.array([reference[name] for name in MEASURES[:RELATIVE]])
    ratio = np.divide(values[:RELATIVE], scale, out=np.zeros_like(scale), where=scale > 0).clip(
        0, 1e6
    )
    values[:RELATIVE] = ratio / (1 + ratio)
    return np.clip(values, 0, 1).astype(np.float32)

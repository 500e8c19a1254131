"""Objective: the measures of a flow as one cost, relative to the same flow without baffles.

The paper's runout, the farthest grain, is noise and no objective here uses it. Centroid travel
answers to the layout and upstream depth tells when baffles dam the flow; the two trade off.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeVar, cast

from gns_model.errors import GnsError

Number = TypeVar("Number")  # a float, or a torch tensor

#: Cost of a rollout that failed, in units of the cost of no baffles: finite, far above any layout.
FAILURE_COST = 10.0

_WORDS = {
    "centroid_travel": "centroid travel",
    "runout_p99": "p99 runout",
    "mass_past_section": "mass past the section",
    "upstream_depth": "upstream depth",
}


class ObjectiveError(GnsError, ValueError):
    """Weights that make no objective, or a reference that nothing can be relative to."""


@dataclass(frozen=True, kw_only=True)
class Objective:
    """cost = runout_weight * R/R0 + depth_weight * max(H, H0)/H0 + mass_weight * M/M0, to be small.

    R is the `runout` measure, H the upstream depth and M the mass past the control section; R0, H0
    and M0 are those of the same scene without baffles, from the same simulator, so the cost of no
    baffles is the sum of the weights.

    Depth below that of the free flow earns nothing: upstream depth is read at the baffles, so with
    a plain H/H0 the best layout would be the one that the flow never reaches (in the paper's flume,
    three baffles at the far end would beat every row in the flow: 1.04 against 1.10).

    Attributes:
        runout_weight, depth_weight, mass_weight: [-], none negative, one at least positive.
        runout: which measure counts as runout.

    Raises:
        ObjectiveError: for a negative or infinite weight, no weight at all, or another runout.
    """

    runout_weight: float = 1.0
    depth_weight: float = 0.5
    mass_weight: float = 0.0
    runout: Literal["centroid_travel", "runout_p99"] = "centroid_travel"

    def __post_init__(self) -> None:
        weights = {name: getattr(self, f"{name}_weight") for name in ("runout", "depth", "mass")}
        for name, weight in weights.items():
            if not (math.isfinite(weight) and weight >= 0):
                raise ObjectiveError(f"{name}_weight must be 0 or more and finite, got {weight}")
        if not any(weights.values()):
            raise ObjectiveError("an objective needs one positive weight at least")
        if self.runout not in ("centroid_travel", "runout_p99"):
            raise ObjectiveError(
                f"runout must be centroid_travel or runout_p99, got {self.runout!r}"
                + (
                    "; the farthest grain is noise, so it is reported and never optimised"
                    if self.runout == "runout_max"
                    else ""
                )
            )

    @classmethod
    def pareto(cls) -> tuple[Objective, Objective]:
        """Runout and upstream depth apart, for a search that returns a Pareto front."""
        return cls(depth_weight=0.0), cls(runout_weight=0.0, depth_weight=1.0)

    @property
    def terms(self) -> dict[str, float]:
        """The measures that count and their weights."""
        weights = {
            self.runout: self.runout_weight,
            "upstream_depth": self.depth_weight,
            "mass_past_section": self.mass_weight,
        }
        return {measure: weight for measure, weight in weights.items() if weight > 0}

    @property
    def baseline(self) -> float:
        """The cost of no baffles."""
        return sum(self.terms.values())

    @property
    def failure_cost(self) -> float:
        """The cost of a rollout that failed: finite."""
        return FAILURE_COST * self.baseline

    def cost(self, measures: Mapping[str, float], reference: Mapping[str, float]) -> float:
        """The cost of hard `measures`; the failure cost if one of them is not finite.

        Args:
            measures: of the layout, as `gns_model.measures.summary` returns them.
            reference: of the same scene without baffles, by the same simulator.

        Raises:
            ObjectiveError: if a measure that counts is zero (or not finite) without baffles.
        """
        if not all(math.isfinite(measures[name]) for name in self.terms):
            return self.failure_cost
        return float(self._weigh(measures, reference))

    def smooth(self, measures: Mapping[str, Number], reference: Mapping[str, float]) -> Number:
        """The same sum of `smooth_measures`, torch scalars: a scalar to differentiate.

        `reference` holds plain numbers: hard measures, or the values of smooth ones.
        """
        return self._weigh(measures, reference)

    def _weigh(self, measures: Mapping[str, Number], reference: Mapping[str, float]) -> Number:
        total: Any = None
        for name, weight in self.terms.items():
            scale = float(reference[name])
            if not (math.isfinite(scale) and scale > 0):
                raise ObjectiveError(
                    f"without baffles the {_WORDS[name]} is {scale:g}: the flow does not get that "
                    "far, so there is nothing to improve on (give the scene a longer duration or "
                    "another placement or section, or this measure no weight)"
                )
            value: Any = measures[name]
            if name == "upstream_depth":
                value = max(value, scale) if isinstance(value, float) else value.clamp(min=scale)
            term = value * (weight / scale)
            total = term if total is None else total + term
        return cast(Number, total)

    def __str__(self) -> str:
        terms = " + ".join(
            ("" if weight == 1 else f"{weight:g} x ")
            + _WORDS[name]
            + (" (at least the free flow's)" if name == "upstream_depth" else "")
            for name, weight in self.terms.items()
        )
        relative = (
            "each relative to no baffles" if len(self.terms) > 1 else "relative to no baffles"
        )
        return f"{terms}, {relative} (no baffles: {self.baseline:g}; lower is better)"

"""What a layout is charged, and what the flow around it may not do.

A price joins the cost: per baffle, and per cubic metre of concrete, both in units of the objective
(no baffles cost the sum of its weights). Limits on the flow can only be found out by a rollout: the
mass that goes over the tops, and the freeboard, by which the tops stand above the deepest flow in
front of them. A layout that breaks one is tried and told like any other, with its excess; whatever
is ranked puts every layout that keeps all limits before those that break one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, cast

from gns_env.objective import Number
from gns_model.errors import GnsError
from gns_model.scene import Scene

#: Cost of an excess of one in a gradient search: 1% of the mass too much over the tops, or 1% of
#: the height too little freeboard, cost 0.02, a few per cent of what baffles gain.
PENALTY = 2.0
#: Excess that a failed rollout counts for.
FAILED = 1.0


class RuleError(GnsError, ValueError):
    """A price or a limit out of its range."""


@dataclass(frozen=True, kw_only=True)
class Rules:
    """Prices and limits on the flow.

    Attributes:
        baffle_cost: of each baffle [-]. concrete_cost: of concrete [1/m³]; in 2D [1/m²].
        max_overtopping: most mass over the baffles' tops, as a share [-]; None: any.
        freeboard: least height of the tops above the peak upstream depth [m]; None: any.

    Raises:
        RuleError: for a negative or infinite value.
    """

    baffle_cost: float = 0.0
    concrete_cost: float = 0.0
    max_overtopping: float | None = None
    freeboard: float | None = None

    def __post_init__(self) -> None:
        for part in fields(self):
            value = getattr(self, part.name)
            if value is not None and not (math.isfinite(value) and value >= 0):
                name = part.name.replace("_", "-")
                raise RuleError(f"--{name} must be 0 or more and finite, got {value:g}")

    @classmethod
    def of(cls, scene: Scene, baffle_cost: float = 0.0, concrete_cost: float = 0.0) -> Rules:
        """The limits of a scene's placement, and prices."""
        limits: dict[str, Any] = {}
        if scene.placement is not None:
            limits = {
                "max_overtopping": scene.placement.max_overtopping,
                "freeboard": scene.placement.freeboard,
            }
        return cls(baffle_cost=baffle_cost, concrete_cost=concrete_cost, **limits)

    @property
    def charges(self) -> bool:
        """Whether layouts have a price."""
        return self.baffle_cost > 0 or self.concrete_cost > 0

    @property
    def limited(self) -> tuple[str, ...]:
        """Names of the limits on the flow."""
        given = ("max_overtopping", "freeboard")
        return tuple(name for name in given if getattr(self, name) is not None)

    def price(self, count: int, volume: Number) -> Number:
        """What so many baffles of that volume together [m³] cost, in units of the objective."""
        concrete: Any = volume
        return cast(Number, self.baffle_cost * count + self.concrete_cost * concrete)

    def excess(self, measures: Mapping[str, Number], height: Any) -> dict[str, Number]:
        """How far each limit is broken, by name; 0 or less where it is kept.

        Of overtopping the share of the mass too much; of the freeboard what is missing, relative to
        the height of the baffles.

        Args:
            measures: hard ones, or smooth tensors.
            height: of the lowest baffle [m], a number or a tensor; None: there is no baffle.
        """
        found: dict[str, Any] = {}
        if self.max_overtopping is not None:
            share: Any = measures["overtopping"]
            found["max_overtopping"] = share - self.max_overtopping
        if self.freeboard is not None:
            depth: Any = measures["upstream_depth"]
            found["freeboard"] = (
                -1.0 if height is None else (depth + self.freeboard - height) / height
            )
        return found

    def __str__(self) -> str:
        parts = []
        if self.baffle_cost:
            parts.append(f"{self.baffle_cost:g} a baffle")
        if self.concrete_cost:
            parts.append(f"{self.concrete_cost:g} a m³ of concrete")
        return " and ".join(parts)

    def failed(self) -> dict[str, float]:
        """The excess of a rollout that failed: whatever was asked, it did not show it."""
        return dict.fromkeys(self.limited, FAILED)


#: Neither price nor limit.
FREE = Rules()


def broken(excess: Mapping[str, float]) -> float:
    """All excesses together; 0 where every limit is kept."""
    return sum(max(value, 0.0) for value in excess.values())

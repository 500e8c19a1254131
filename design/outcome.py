"""What running a layout gave, and a layout that was tried: plain values for every search."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from design.rules import PENALTY, broken


@dataclass(frozen=True)
class Outcome:
    """What running one layout gave.

    Attributes:
        cost: the objective, relative to no baffles [-]; a finite penalty if the rollout failed.
        measures: hard measures, `gns_model.measures.summary`; empty if the rollout failed.
        status: "ok" or how the rollout failed.
        rollouts: forward rollouts spent.
        backwards: backward passes through a rollout spent.
        seconds: spent on it.
        gradient: d(smooth cost)/d(centres) [1/m], shape (n, D-1), if it was asked for.
        costs: one cost for each objective, of a search with several; `cost` is their sum.
        flows: the cost in each scenario, of a robust search; `cost` is their mean or CVaR then.
        excess: by how much each limit on the flow is broken; 0 or less where it is kept.
    """

    cost: float
    measures: dict[str, float]
    status: str = "ok"
    rollouts: int = 1
    backwards: int = 0
    seconds: float = 0.0
    gradient: np.ndarray | None = None
    costs: tuple[float, ...] = ()
    flows: tuple[float, ...] = ()
    excess: dict[str, float] = field(default_factory=dict)

    @property
    def feasible(self) -> bool:
        """Whether the rollout reached its end and every limit is kept."""
        return self.status == "ok" and broken(self.excess) == 0

    @property
    def order(self) -> tuple[float, float]:
        """What layouts are ranked by, least first: what is broken of the limits, then the cost."""
        return broken(self.excess), self.cost

    @property
    def merit(self) -> float:
        """The cost, and a penalty for what is broken of the limits: what a gradient makes small."""
        return self.cost + PENALTY * broken(self.excess)


@dataclass(frozen=True)
class Trial:
    """One layout that was tried: `centres` [m], shape (n, D-1), where it came from, its outcome."""

    number: int
    origin: str
    centres: np.ndarray
    outcome: Outcome

    @property
    def cost(self) -> float:
        """The objective, relative to no baffles [-]."""
        return self.outcome.cost

    @property
    def ok(self) -> bool:
        """Whether the rollout reached its end."""
        return self.outcome.status == "ok"

    @property
    def order(self) -> tuple[float, float]:
        """See `Outcome.order`."""
        return self.outcome.order


def as_record(origin: str, centres: np.ndarray, outcome: Outcome) -> dict[str, Any]:
    """Plain values of a trial, which `from_record` reads back; its gradient is not kept."""
    return {
        "origin": origin,
        "centres": np.asarray(centres).tolist(),
        "cost": outcome.cost,
        "measures": outcome.measures,
        "status": outcome.status,
        "rollouts": outcome.rollouts,
        "backwards": outcome.backwards,
        "seconds": outcome.seconds,
        "costs": list(outcome.costs),
        "flows": list(outcome.flows),
        "excess": outcome.excess,
    }


def from_record(number: int, record: Mapping[str, Any]) -> Trial:
    """The trial of that number."""
    outcome = Outcome(
        cost=float(record["cost"]),
        measures=dict(record["measures"]),
        status=str(record["status"]),
        rollouts=int(record["rollouts"]),
        backwards=int(record["backwards"]),
        seconds=float(record["seconds"]),
        costs=tuple(map(float, record.get("costs", ()))),
        flows=tuple(map(float, record.get("flows", ()))),
        excess={name: float(value) for name, value in record.get("excess", {}).items()},
    )
    return Trial(number, str(record["origin"]), np.array(record["centres"]), outcome)

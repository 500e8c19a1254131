"""What a layout is worth over several flows: the mean of its costs, or the mean of the worst."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from design.outcome import Outcome
from design.rules import Rules
from gns_env.objective import Objective
from gns_model.errors import GnsError

OK = "ok"


class RiskError(GnsError, ValueError):
    """A measure of risk that does not exist."""


@dataclass(frozen=True)
class Risk:
    """Mean, or conditional value at risk: the mean of the worst 1 - `level` of the costs.

    CVaR of equally likely costs after Rockafellar & Uryasev (2000); the share that falls on the
    border counts in part, so it is continuous in `level`: 0 is the mean, near 1 the worst.

    Raises:
        RiskError: for another kind, or a level outside [0, 1).
    """

    kind: Literal["mean", "cvar"] = "mean"
    level: float = 0.8

    def __post_init__(self) -> None:
        if self.kind not in ("mean", "cvar"):
            raise RiskError(f"risk must be mean or cvar, got {self.kind!r}")
        if not 0 <= self.level < 1:
            raise RiskError(f"the CVaR level must be 0 or more and below 1, got {self.level:g}")

    def weights(self, costs: Sequence[float] | np.ndarray) -> np.ndarray:
        """How much each cost counts, shape (n,), not negative, sum 1.

        Also the derivative of `of` by each cost, where no two costs are equal.
        """
        count = len(costs)
        if self.kind == "mean":
            return np.full(count, 1.0 / count)
        tail = (1 - self.level) * count
        ranked = np.clip(tail - np.arange(count), 0.0, 1.0) / tail
        weights = np.empty(count)
        weights[np.argsort(-np.asarray(costs, dtype=float), kind="stable")] = ranked
        return weights

    def of(self, costs: Sequence[float] | np.ndarray) -> float:
        """The risk of equally likely `costs`, shape (n,)."""
        return float(self.weights(costs) @ np.asarray(costs, dtype=float))

    def __str__(self) -> str:
        if self.kind == "mean":
            return "mean"
        return f"CVaR (mean of the worst {100 * (1 - self.level):.3g}%)"


MEAN = Risk()


@dataclass(frozen=True)
class Flow:
    """What one rollout of a layout gave: how it ended, its measures, its cost by each objective,
    and by how much it breaks each limit."""

    status: str
    measures: dict[str, float]
    costs: tuple[float, ...]
    excess: dict[str, float] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        status: str,
        measures: dict[str, float],
        reference: dict[str, float],
        objectives: Sequence[Objective],
        rules: Rules | None = None,
        sizes: Sequence[Sequence[float]] = (),
    ) -> Flow:
        """From measures, relative to those without baffles of the same simulator and scenario.

        `rules` for the baffles that stand, of `sizes` [m]: a price, which joins the first cost, and
        limits.
        """
        rules = rules or Rules()
        if status != OK:
            return cls(status, measures, tuple(o.failure_cost for o in objectives), rules.failed())
        costs = [o.cost(measures, reference) for o in objectives]
        costs[0] += rules.price(len(sizes), sum(map(math.prod, sizes)))
        lowest = min((size[1] for size in sizes), default=None)
        return cls(status, measures, tuple(costs), rules.excess(measures, lowest))


def weigh(flows: Sequence[Flow], risk: Risk, failure_cost: float) -> Outcome:
    """The outcome of a layout in all its flows; it has failed if it failed in one.

    Costs are the risk of those of the flows, and measures their means.
    """
    status = next((f.status for f in flows if f.status != OK), OK)
    costs = np.array([f.costs for f in flows])
    total = costs.sum(axis=1)
    several = costs.shape[1] > 1
    return Outcome(
        cost=risk.of(total) if status == OK else failure_cost,
        measures={
            name: float(np.mean([f.measures[name] for f in flows])) for name in flows[0].measures
        }
        if status == OK
        else {},
        status=status,
        rollouts=len(flows),
        costs=tuple(risk.of(column) for column in costs.T) if several else (),
        flows=tuple(total.tolist()) if len(flows) > 1 else (),
        # A limit is to be kept in every flow.
        excess={name: max(f.excess[name] for f in flows) for name in flows[0].excess},
    )

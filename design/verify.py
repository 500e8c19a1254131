"""The best layouts on the reference solver, and how far the search's simulator was off.

A surrogate's optimum is also where its errors are most flattering, so designs are ranked anew by
the reference solver before one is called best (findings/FIELD.md), and the gap is printed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from design.distinct import apart
from design.form import Form, described
from design.outcome import Outcome, Trial
from design.rules import broken
from gns_model.evaluation import rank_correlation


@dataclass
class Judged:
    """One layout as both simulators see it.

    Attributes:
        origin: which part of the search proposed it; "scene" is the scene's own, "none" no baffles.
        centres: [m], shape (n, D-1).
        surrogate, verified: hard measures by the search's simulator and by the reference solver;
            empty where that one has not run or has failed.
        cost, verified_cost: the objective by each, relative to its own rollout without baffles.
        costs, verified_costs: the same by objective, of a search with several.
        flows, verified_flows: the same by scenario, of a robust search.
        spread: of an ensemble's members over this layout, by measure; see `ensemble`.
        ensemble_cost: mean of the costs that they give it.
        marks: why the simulator that searched may be out of its depth here, in words.
        excess, verified_excess: by how much each limit on the flow is broken.
        form: size and yaw of its baffles, where that is not the scene's.
        model: the refined model that found it, "refined-1" and so on; "": the one that was given.
    """

    origin: str
    centres: np.ndarray
    surrogate: dict[str, float]
    cost: float | None = None
    verified: dict[str, float] | None = None
    verified_cost: float | None = None
    verified_status: str | None = None
    costs: tuple[float, ...] = ()
    verified_costs: tuple[float, ...] = ()
    flows: tuple[float, ...] = ()
    verified_flows: tuple[float, ...] = ()
    spread: dict[str, float] = field(default_factory=dict)
    ensemble_cost: float | None = None
    marks: list[str] = field(default_factory=list)
    model: str = ""
    excess: dict[str, float] = field(default_factory=dict)
    verified_excess: dict[str, float] | None = None
    form: Form | None = None

    @property
    def order(self) -> tuple[bool, float, float]:
        """What layouts are ranked by: verified ones first, then what is broken of the limits."""
        if self.verified_cost is None:
            return True, broken(self.excess), self.cost or 0.0
        return False, broken(self.verified_excess or {}), self.verified_cost

    @property
    def feasible(self) -> bool:
        """Whether every limit is kept, as the reference solver says if it has."""
        known = self.excess if self.verified_excess is None else self.verified_excess
        return broken(known) == 0

    def take(self, outcome: Outcome) -> None:
        """Take in what the reference solver says of all flows."""
        self.verified_status, self.verified_cost = outcome.status, outcome.cost
        self.verified_excess = dict(outcome.excess)
        if outcome.status == "ok":
            self.verified = outcome.measures
            self.verified_costs, self.verified_flows = outcome.costs, outcome.flows

    def as_dict(self) -> dict[str, Any]:
        """Plain values for summary.json."""
        several: dict[str, Any] = {
            name: list(getattr(self, name))
            for name in ("costs", "verified_costs", "flows", "verified_flows", "marks")
            if getattr(self, name)
        }
        if self.spread:
            # What failed in one member has no spread, and infinity is not JSON.
            known = {k: v for k, v in self.spread.items() if math.isfinite(v)}
            several |= {"spread": known, "ensemble_cost": self.ensemble_cost}
        if self.model:
            several["model"] = self.model
        return {
            **described(self.centres, self.form),
            "origin": self.origin,
            "cost": self.cost,
            "surrogate": self.surrogate,
            "verified_cost": self.verified_cost,
            "verified": self.verified,
            "verified_status": self.verified_status,
            **several,
        }


def candidates(
    trials: Sequence[Trial], count: int, least: float, *, avoid: Sequence[np.ndarray] = ()
) -> list[Judged]:
    """The `count` best trials, at least `least` [m] apart from each other and from `avoid`.

    Neighbours of the best would only verify the same thing again.
    """
    ranked = sorted((t for t in trials if t.ok), key=lambda t: (*t.order, t.number))
    chosen = apart([t.centres for t in ranked], least, count, avoid=avoid)
    by_layout = {id(t.centres): t for t in ranked}
    return [as_judged(by_layout[id(c)]) for c in chosen]


def as_judged(trial: Trial) -> Judged:
    """A trial as what the reference solver has not seen yet."""
    o = trial.outcome
    return Judged(
        trial.origin,
        trial.centres,
        dict(o.measures),
        o.cost,
        costs=o.costs,
        flows=o.flows,
        excess=dict(o.excess),
    )


def rank(judged: Sequence[Judged]) -> list[Judged]:
    """Best first: by verified cost, what is not verified behind it by the search's cost.

    Of either, what breaks a limit comes behind all that keep them.
    """
    return sorted(judged, key=lambda j: j.order)


def gap(judged: Sequence[Judged]) -> dict[str, dict[str, float]]:
    """How the two simulators differ over the layouts that both have judged.

    Returns:
        for "cost" and each measure: over how many `layouts`; `mean_relative` and `max_relative` of
        |surrogate - verified| / |verified|; `spearman`, the rank correlation, from three layouts.
    """
    both = [j for j in judged if j.verified and j.surrogate]
    result: dict[str, dict[str, float]] = {}
    names = list(both[0].verified or ()) if both else []
    for name in ["cost", *names]:
        if name == "cost":
            pairs = [(j.cost, j.verified_cost) for j in both if j.origin != "none"]
        else:
            # Without baffles two simulators measure another depth and no overtopping at all.
            pairs = [(j.surrogate.get(name), (j.verified or {}).get(name)) for j in both]
        known = [(s, v) for s, v in pairs if s is not None and v is not None]
        if not known:
            continue
        s, v = np.array(known, dtype=float).T
        relative = np.abs(s - v) / np.maximum(np.abs(v), 1e-12)
        relative = relative[np.abs(v) > 1e-9]
        entry = {"layouts": float(len(known))}
        if len(relative):
            entry |= {
                "mean_relative": float(relative.mean()),
                "max_relative": float(relative.max()),
            }
        correlation = rank_correlation(s, v)
        if correlation is not None:
            entry["spearman"] = correlation
        result[name] = entry
    return result


def verdict(best: Judged | None, paper: Judged | None, none: float) -> tuple[str, str]:
    """One of "better", "not better", "infeasible", "unverified", "no comparison", and a sentence.

    Args:
        best: the best of the search.
        paper: the scene's own layout, if it has one.
        none: the cost of no baffles.
    """
    if best is None:
        return "unverified", "The search found no layout whose rollout reached its end."
    if best.verified_cost is None:
        return "unverified", (
            "No layout was verified on the reference solver: the best is only the best that the "
            f"search's simulator saw (cost {best.cost:.4f})."
        )
    if best.verified is None:
        return "unverified", (
            "Every rollout of a proposed layout on the reference solver failed: nothing found can "
            "be recommended."
        )
    if not best.feasible:
        names = " and ".join(k for k, v in (best.verified_excess or {}).items() if v > 0)
        return "infeasible", (
            f"No verified layout keeps every limit: the best breaks {names}. Allow more there, or "
            "larger or more baffles, or search with a larger budget."
        )
    relative = _change(best.verified_cost, none)
    if paper is None or paper.verified_cost is None:
        return "no comparison", (
            f"Verified cost {best.verified_cost:.4f}, {relative} no baffles; there is no layout of "
            "the scene's own to compare with."
        )
    if not paper.feasible:
        return "better", (
            f"The best layout found keeps every limit, which the scene's own does not: verified "
            f"cost {best.verified_cost:.4f}, {relative} no baffles."
        )
    costs = f"verified cost {best.verified_cost:.4f} against {paper.verified_cost:.4f}"
    if best.verified_cost < paper.verified_cost:
        return "better", (
            f"The best layout found is better than the scene's own: {costs}, {relative} no baffles."
        )
    return "not better", (
        f"NOT better than the scene's own layout: {costs}. Keep the scene's own, or search with a "
        "larger budget."
    )


def _change(value: float, reference: float) -> str:
    share = 100 * (value / reference - 1)
    return f"{abs(share):.1f}% {'below' if share <= 0 else 'above'}"

"""One cost from many measures: what it adds up, what it refuses, and that torch can follow it."""

from __future__ import annotations

import math

import pytest
import torch

from gns_env.objective import FAILURE_COST, Objective, ObjectiveError

REFERENCE = {
    "runout_max": 1.2,
    "runout_p99": 1.0,
    "centroid_travel": 0.6,
    "mass_past_section": 0.15,
    "upstream_depth": 0.1,
}
MEASURES = {
    "runout_max": 1.3,
    "runout_p99": 0.9,
    "centroid_travel": 0.57,
    "mass_past_section": 0.09,
    "upstream_depth": 0.2,
}


def test_the_default_is_centroid_travel_and_half_of_depth_relative_to_no_baffles() -> None:
    objective = Objective()
    assert objective.cost(MEASURES, REFERENCE) == pytest.approx(0.57 / 0.6 + 0.5 * 0.2 / 0.1)
    assert objective.cost(REFERENCE, REFERENCE) == pytest.approx(objective.baseline) == 1.5
    assert str(objective) == (
        "centroid travel + 0.5 x upstream depth (at least the free flow's), each relative to no "
        "baffles (no baffles: 1.5; lower is better)"
    )


def test_baffles_that_the_flow_never_reaches_earn_nothing() -> None:
    unreached = {**REFERENCE, "upstream_depth": 0.0}
    assert Objective().cost(unreached, REFERENCE) == pytest.approx(1.5)
    depth = torch.tensor(0.01, dtype=torch.float64, requires_grad=True)
    travel = torch.tensor(0.6, dtype=torch.float64, requires_grad=True)
    value = Objective().smooth({"centroid_travel": travel, "upstream_depth": depth}, REFERENCE)
    assert value.item() == pytest.approx(1.5)
    value.backward()
    assert (travel.grad, depth.grad) == (pytest.approx(1 / 0.6), 0.0)


def test_other_weights_and_measures() -> None:
    objective = Objective(runout="runout_p99", runout_weight=2, depth_weight=0, mass_weight=0.5)
    assert objective.cost(MEASURES, REFERENCE) == pytest.approx(2 * 0.9 + 0.5 * 0.09 / 0.15)
    assert set(objective.terms) == {"runout_p99", "mass_past_section"}


def test_the_front_is_what_runs_apart_on_a_pareto_front() -> None:
    runout, depth = Objective.pareto()
    assert runout.cost(MEASURES, REFERENCE) == pytest.approx(0.95)
    assert depth.cost(MEASURES, REFERENCE) == pytest.approx(2.0)


def test_smooth_is_the_same_sum_with_its_gradient() -> None:
    objective = Objective(mass_weight=0.3)
    tensors = {
        k: torch.tensor(v, dtype=torch.float64, requires_grad=True) for k, v in MEASURES.items()
    }
    value = objective.smooth(tensors, REFERENCE)
    value.backward()
    assert value.item() == pytest.approx(objective.cost(MEASURES, REFERENCE), rel=1e-12)
    for name in objective.terms:
        step = 1e-6
        moved = objective.cost({**MEASURES, name: MEASURES[name] + step}, REFERENCE)
        slope = (moved - objective.cost(MEASURES, REFERENCE)) / step
        gradient = tensors[name].grad
        assert gradient is not None
        assert gradient.item() == pytest.approx(slope, rel=1e-6)
    assert tensors["runout_max"].grad is None


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_measures_that_are_not_finite_cost_a_failure(bad: float) -> None:
    objective = Objective()
    for name in objective.terms:
        cost = objective.cost({**MEASURES, name: bad}, REFERENCE)
        assert cost == objective.failure_cost == FAILURE_COST * 1.5


@pytest.mark.parametrize("scale", [0.0, math.nan, -1.0])
def test_nothing_is_relative_to_nothing(scale: float) -> None:
    with pytest.raises(ObjectiveError, match="upstream depth"):
        Objective().cost(MEASURES, {**REFERENCE, "upstream_depth": scale})
    # A measure without a weight may be zero.
    Objective(depth_weight=0).cost(MEASURES, {**REFERENCE, "upstream_depth": scale})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"depth_weight": -1}, "depth_weight must be 0 or more"),
        ({"runout_weight": math.nan}, "runout_weight"),
        ({"runout_weight": 0, "depth_weight": 0}, "one positive weight"),
        ({"runout": "runout_max"}, "noise"),
        ({"runout": "speed"}, "must be centroid_travel or runout_p99"),
    ],
)
def test_weights_that_make_no_objective(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ObjectiveError, match=message):
        Objective(**arguments)  # type: ignore[arg-type]

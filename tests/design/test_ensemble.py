"""The spread of an ensemble, and what it says about layouts that may be verified."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from design.ensemble import Ensemble, Panel, beyond_limits, relative_spread
from design.evaluators import SimulatorSpec
from design.outcome import Outcome
from design.store import Rolled
from design.verify import Judged
from gns_model.scene import Scene

A, B, C = (SimulatorSpec(name) for name in "abc")
positive = st.floats(0.1, 10.0)


def outcome(cost, travel, status="ok", **others):
    return Outcome(cost, {"centroid_travel": travel, **others}, status)


@given(st.lists(positive, min_size=2, max_size=4), positive, positive)
def test_a_bias_that_a_member_has_everywhere_is_no_spread(biases, travel, none):
    layout = [outcome(1.2, b * travel) for b in biases]
    bare = [outcome(1.5, b * none) for b in biases]
    spread = relative_spread(layout, bare)
    assert spread["centroid_travel"] == pytest.approx(0.0, abs=1e-9)
    assert spread["cost"] == pytest.approx(0.0, abs=1e-9)


@given(st.permutations([0.9, 1.0, 1.3]), positive)
def test_spread_is_the_deviation_over_the_mean_whoever_comes_first(factors, travel):
    layout = [outcome(f, f * travel) for f in factors]
    bare = [outcome(1.5, travel)] * 3
    expected = np.std(factors, ddof=1) / np.mean(factors)
    assert relative_spread(layout, bare)["centroid_travel"] == pytest.approx(expected)
    assert relative_spread(layout, bare)["cost"] == pytest.approx(expected)


def test_what_failed_in_one_member_is_out_of_depth():
    spread = relative_spread(
        [outcome(1.2, 0.4), outcome(9.0, 0.0, "diverged")], [outcome(1, 1)] * 2
    )
    assert spread == {"cost": math.inf, "centroid_travel": math.inf}
    assert Ensemble((A, B)).marks(spread) == ["a rollout of the ensemble failed"]
    judged = Judged("random", np.zeros((1, 2)), {}, spread=spread)
    assert judged.as_dict()["spread"] == {}  # infinity is not JSON


def test_what_is_nothing_without_baffles_has_no_relative_spread():
    spread = relative_spread(
        [outcome(1.2, 0.4, overtopping=0.1)] * 2, [outcome(1.5, 0.5, overtopping=0.0)] * 2
    )
    assert "overtopping" not in spread


class FromTable:
    """Rollouts by table: (simulator, layout's x or None) -> centroid travel."""

    def __init__(self, travel):
        self.travel, self.asked = travel, []

    def roll(self, spec, layout):
        x = None if layout is None else float(layout.centres[0, 0])
        self.asked.append((spec.name, x))
        return [_Done(self.travel[spec.name, x])]


class _Done:
    job, fraction = None, 1.0

    def __init__(self, travel):
        self.rolled = Rolled("ok", {"centroid_travel": travel}, 0.0, None)

    def result(self):
        return self.rolled


class _Watch:
    def add(self, title, pending):
        pass

    def wait(self, pending):
        pass


def panel(table, searcher, limits=None):
    def weigh(rolled, none):
        (r,), (n,) = rolled, none
        travel = r.measures["centroid_travel"]
        return Outcome(travel / n.measures["centroid_travel"], dict(r.measures))

    ensemble = Ensemble((A, B), limits or {})
    return Panel(ensemble, searcher, table.roll, weigh, _Watch())


def layout(x, cost=0.0, travel=0.0):
    return Judged("random", np.array([[x, 0.0]]), {"centroid_travel": travel}, cost)


TABLE = {
    ("a", None): 1.0, ("b", None): 2.0,
    ("a", 0.1): 0.60, ("b", 0.1): 1.80,
    ("a", 0.2): 0.70, ("b", 0.2): 1.42,
    ("a", 0.3): 0.80, ("b", 0.3): 1.30,
}  # fmt: skip


def test_the_members_choose_together_but_the_best_of_the_search_stays():
    table = FromTable(TABLE)
    judge = panel(table, A, {"cost": 0.1})
    first, second, third = (layout(x, c, c) for x, c in ((0.1, 0.6), (0.2, 0.7), (0.3, 0.8)))
    chosen = judge.choose([first, second, third], 2)
    assert chosen == [first, second]  # mean costs 0.75, 0.705, 0.725
    assert second.ensemble_cost == pytest.approx(0.705)
    assert first.marks
    assert not second.marks
    assert ("a", 0.1) not in table.asked  # the search has rolled it out itself
    assert judge.choose([third, first, second], 2) == [third, second]
    assert judge.choose([], 2) == []


def test_a_refined_searcher_is_not_its_own_judge():
    table = FromTable(TABLE)
    one = layout(0.1, cost=0.2, travel=0.2)
    panel(table, C).judge([one])
    assert {name for name, x in table.asked if x == 0.1} == {"a", "b"}
    assert one.ensemble_cost == pytest.approx(0.75)


def test_the_card_s_limits_are_asked_layout_by_layout():
    scene = Scene.from_toml("examples/flume.toml")
    model = SimulatorSpec("baffle-lite")
    assert beyond_limits(model, scene) == []
    sizes = [b.model_copy(update={"size": (0.15, 0.6, 0.15)}) for b in scene.baffles]
    (line,) = beyond_limits(model, scene.replace(baffles=tuple(sizes)))
    assert "baffle_height = 0.6" in line
    assert beyond_limits(SimulatorSpec("mpm"), scene) == []

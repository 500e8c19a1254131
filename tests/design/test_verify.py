import numpy as np
import pytest

from design.outcome import Outcome, Trial
from design.risk import Flow, Risk, weigh
from design.verify import Judged, candidates, gap, rank, verdict
from gns_env.objective import Objective

NONE = {"centroid_travel": 0.65, "upstream_depth": 0.2}
LAYOUT = np.array([[0.7, 0.5], [0.7, 1.5]])


def trial(number, centres, cost, status="ok"):
    outcome = Outcome(cost, {"centroid_travel": cost}, status)
    return Trial(number, "bayes", np.asarray(centres), outcome)


def judged(cost, travel, *, origin="bayes", status="ok", shift=0.0):
    """A layout that the search thinks costs `cost` and whose verified travel is `travel`."""
    j = Judged(origin, LAYOUT + shift, {"centroid_travel": 0.6, "upstream_depth": 0.2}, cost)
    verified = {"centroid_travel": travel, "upstream_depth": 0.2}
    by = Objective(depth_weight=0.25)
    j.take(weigh([Flow.of(status, verified, NONE, [by])], Risk(), by.failure_cost))
    return j


def test_candidates_are_the_best_distinct_ones():
    near = LAYOUT + 0.01
    trials = [
        trial(0, LAYOUT, 1.10),
        trial(1, near[::-1], 1.05),  # nearly the same layout in another numbering, and better
        trial(2, LAYOUT + 0.2, 1.20),
        trial(3, LAYOUT + 0.4, 0.50, status="diverged"),
        trial(4, LAYOUT - 0.2, 1.30),
    ]
    assert [c.cost for c in candidates(trials, 2, 0.05)] == [1.05, 1.20]
    assert [c.cost for c in candidates(trials, 9, 0.05)] == [1.05, 1.20, 1.30]
    assert [c.cost for c in candidates(trials, 9, 0.05, avoid=[LAYOUT])] == [1.20, 1.30]
    assert candidates([], 3, 0.05) == []


def test_the_best_is_the_best_by_verified_cost():
    flattered, honest = judged(1.00, 0.62), judged(1.05, 0.58)
    failed, waiting = judged(0.9, 0.5, status="diverged"), Judged("bayes", LAYOUT, {}, 0.8)
    assert rank([failed, waiting, flattered, honest]) == [honest, flattered, failed, waiting]


def test_the_verdict_says_plainly_whether_it_is_better():
    own = judged(1.2, 0.60, origin="scene")
    word, sentence = verdict(judged(1.0, 0.58), own, 1.25)
    assert word == "better"
    assert "8.6% below no baffles" in sentence  # 0.58 / 0.65 + 0.25 against 1.25
    word, sentence = verdict(judged(1.0, 0.61), own, 1.25)
    assert word == "not better"
    assert sentence.startswith("NOT better")
    assert verdict(judged(1.0, 0.58), None, 1.25)[0] == "no comparison"
    assert verdict(Judged("bayes", LAYOUT, {}, 1.0), own, 1.25)[0] == "unverified"
    assert verdict(judged(1.0, 0.5, status="diverged"), own, 1.25)[0] == "unverified"
    assert verdict(None, own, 1.25)[0] == "unverified"


def test_the_gap_is_relative_to_the_solver_and_ranks():
    layouts = [judged(1.0 + 0.1 * k, 0.5 + 0.02 * k) for k in range(4)]
    found = gap(layouts)
    assert found["cost"]["spearman"] == pytest.approx(1.0)
    travels = np.array([0.5, 0.52, 0.54, 0.56])
    expected = np.abs(0.6 - travels) / travels
    assert found["centroid_travel"]["mean_relative"] == pytest.approx(expected.mean())
    assert found["centroid_travel"]["max_relative"] == pytest.approx(expected.max())
    assert "spearman" not in found["centroid_travel"]  # the surrogate says 0.6 of all
    assert gap([Judged("bayes", LAYOUT, {}, 1.0)]) == {}

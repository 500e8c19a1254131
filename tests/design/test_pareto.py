"""Pareto fronts: what is on one, which points are verified, and a whole run with its files."""

import csv
import itertools
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import design
from design.objectives import joined, parse, split
from design.outcome import Outcome, Trial
from design.pareto import front, spread, staircase
from design.results import RunResults
from design.run import optimise
from design.settings import Settings
from design.storage import StudyError
from gns_env.objective import Objective, ObjectiveError
from gns_env.task import BaffleTask
from gns_model.errors import SimulatorError
from gns_model.scene import Scene

from .search_kit import FormulaSimulator, formula_scene
from .short_runs import COARSE, short_flume


def trials(costs, statuses=None):
    """Trials of these costs, shape (n, objectives)."""
    return [
        Trial(k, "test", np.full((1, 2), k), Outcome(sum(c), {}, s, costs=tuple(c)))
        for k, (c, s) in enumerate(zip(costs, statuses or ["ok"] * len(costs), strict=True))
    ]


COSTS = st.lists(st.tuples(*[st.integers(0, 6).map(float)] * 2), min_size=1, max_size=25)


@given(COSTS)
def test_a_front_is_what_nobody_beats(costs):
    points = [t.outcome.costs for t in front(trials(costs))]
    for a in costs:  # everybody is beaten or equalled by somebody on the front
        assert any(p[0] <= a[0] and p[1] <= a[1] for p in points)
    for p, q in itertools.permutations(points, 2):  # and nobody there by another
        assert p[0] < q[0] or p[1] < q[1]
    assert points == sorted(points)
    stairs = staircase(np.array(points))
    assert (np.diff(stairs[:, 0]) >= 0).all()
    assert (np.diff(stairs[:, 1]) <= 0).all()


def test_failures_and_single_costs_are_never_on_a_front():
    assert front(trials([(0, 0), (1, 1)], ["diverged", "ok"]))[0].number == 1
    assert front([Trial(0, "x", np.zeros((1, 2)), Outcome(1.0, {}))]) == []
    three = trials([(1, 2, 3), (3, 2, 1), (2, 2, 2), (3, 3, 3)])
    assert [t.number for t in front(three)] == [0, 2, 1]


def test_points_to_verify_are_spread_and_hold_the_recommended_one():
    points = trials([(float(k), 10.0 - k - (k == 3)) for k in range(11)])
    assert [t.number for t in spread(points, 1)] == [3]
    assert {t.number for t in spread(points, 3)} == {3, 0, 10}
    chosen = {t.number for t in spread(points, 5)}
    assert {3, 0, 10} < chosen
    assert max(np.diff(sorted(chosen))) <= 4
    assert spread(points, 99) == points
    assert spread(points, 0) == []


def test_objectives_by_name():
    assert parse("runout, depth") == ("runout", "depth")
    for wrong in ("runout", "runout,runout", "runout,p99", "runout,depht", ""):
        with pytest.raises(ObjectiveError):
            parse(wrong)
    parts = split(("p99", "depth", "mass"), Objective(depth_weight=0.25))
    assert [p.terms for p in parts] == [
        {"runout_p99": 1.0}, {"upstream_depth": 0.25}, {"mass_past_section": 1.0},
    ]  # fmt: skip
    whole = joined(parts)
    assert whole.terms == {"runout_p99": 1.0, "upstream_depth": 0.25, "mass_past_section": 1.0}
    measures = {"runout_p99": 0.8, "upstream_depth": 0.3, "mass_past_section": 0.1}
    none = {"runout_p99": 1.0, "upstream_depth": 0.2, "mass_past_section": 0.2}
    assert sum(p.cost(measures, none) for p in parts) == pytest.approx(whole.cost(measures, none))


@pytest.mark.parametrize("method", ["random", "tpe", "nsga2"])
def test_a_search_in_code_finds_a_front(method):
    objectives = split(("runout", "mass"), Objective())
    task = BaffleTask(formula_scene(), FormulaSimulator(), n_baffles=2, objective=objectives)
    result = design.optimize(task, method=method, budget=30, seed=0)
    assert result.rollouts == 30
    assert result.front
    assert result.best in result.front  # the least sum is never beaten
    for trial in result.trials:
        assert sum(trial.outcome.costs) == pytest.approx(trial.cost)
    again = task.evaluate([t.centres for t in result.front])
    assert [e.costs for e in again] == [t.outcome.costs for t in result.front]


def test_a_failure_is_worse_than_all_that_worked_in_every_objective():
    def fails(scene):
        return any(b.center[1] < 0.6 for b in scene.baffles)

    objectives = split(("runout", "mass"), Objective())
    task = BaffleTask(formula_scene(), FormulaSimulator(fails=fails), n_baffles=1,
                      objective=objectives)  # fmt: skip
    result = design.optimize(task, method="tpe", budget=30)
    assert any(not t.ok for t in result.trials)
    assert all(t.ok for t in result.front)


@pytest.fixture(scope="module")
def done(small_scene, tmp_path_factory):
    """A run with two objectives on the coarse solver, its figures left out."""
    out = tmp_path_factory.mktemp("front") / "run"
    settings = Settings(method="tpe", objectives=("runout", "depth"), budget=24, verify=2,
                        simulator=COARSE, verifier=COARSE, workers=1)  # fmt: skip
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("design.report.write_report", lambda folder: None)
        return out, optimise(small_scene, out, settings), settings


@pytest.fixture(scope="module")
def small_scene():
    return short_flume()  # its row dams the flow


def test_a_run_leaves_every_point_of_its_front(done):
    out, summary, settings = done
    entries = summary["front"]
    assert entries
    assert json.loads((out / "summary.json").read_text())["front"] == entries
    with (out / "front.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(entries)
    assert len(list((out / "layouts").glob("front-*.toml"))) == len(entries)
    with (out / "trials.csv").open(newline="") as file:
        tried = {row["number"]: row for row in csv.DictReader(file)}
    weight = settings.objective.depth_weight
    for entry, row in zip(entries, rows, strict=True):
        placed = Scene.from_toml(out / entry["file"])
        np.testing.assert_allclose([b.center for b in placed.baffles], entry["layout"], atol=1e-6)
        assert float(row["runout"]) == entry["objectives"]["runout"]
        none = summary["no_baffles"]["surrogate"]
        travel = entry["surrogate"]["centroid_travel"] / none["centroid_travel"]
        assert entry["objectives"]["runout"] == pytest.approx(travel)
        whole = entry["objectives"]["runout"] + weight * entry["objectives"]["depth"]
        assert entry["cost"] == pytest.approx(whole)
        trial = tried[str(entry["trial"])]
        assert float(trial["cost_1"]) == entry["objectives"]["runout"]
    verified = [e for e in entries if e["verified_objectives"]]
    assert len(verified) == min(2, len(entries))
    for entry in verified:  # the same solver judges here
        assert entry["verified_objectives"] == pytest.approx(entry["objectives"])
    assert summary["best"]["verified_cost"] == min(e["verified_cost"] for e in verified)


def test_its_report_shows_the_front(done):
    from design.front_figures import front as figure
    from design.front_page import pareto
    from design.theme import LIGHT

    out, summary, _ = done
    run = RunResults(out)
    drawn = figure(run, LIGHT)
    assert drawn is not None
    assert len(drawn.axes) == 1
    text = pareto(run, {})
    for entry in summary["front"]:
        assert entry["file"] in text
        assert f"{entry['objectives']['depth']:.3f}" in text


def test_a_front_is_not_mixed_with_a_search_of_one_objective(done, small_scene):
    out = done[0]
    alone = Settings(budget=30, verify=0, simulator=COARSE, workers=1, resume=True)
    with pytest.raises(StudyError, match="another"):
        optimise(small_scene, out, alone)


def test_gradients_find_no_front(small_scene, tmp_path):
    settings = Settings(method="gradient", objectives=("runout", "depth"), simulator=COARSE)
    with pytest.raises(SimulatorError):
        optimise(small_scene, tmp_path / "run", settings)
    assert not (tmp_path / "run").exists()

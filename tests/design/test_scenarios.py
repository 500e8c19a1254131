"""Robust design: risk, the flows that are drawn, their costs and gradients, and whole runs."""

import csv
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from design.evaluators import InProcess, run
from design.gradient import differentiate_flows
from design.risk import Flow, Risk, RiskError, weigh
from design.run import optimise
from design.scenarios import ScenarioError, Scenarios, parse_range, scenarios_of, scenes, widest
from design.settings import SettingError, Settings
from design.storage import StudyError
from gns_env.objective import Objective
from gns_env.task import BaffleTask
from gns_model.errors import GnsError
from gns_model.learned.config import Limits

from .search_kit import FormulaSimulator, campaign, formula_scene
from .short_runs import COARSE, baffle_at, short_flume

COSTS = st.lists(st.floats(0, 10), min_size=1, max_size=12)


# -- risk ------------------------------------------------------------------------------------------


@given(COSTS, st.floats(0, 0.99))
def test_cvar_lies_between_mean_and_worst_and_grows_with_its_level(costs, level):
    cvar = Risk("cvar", level)
    weights = cvar.weights(costs)
    assert weights.sum() == pytest.approx(1)
    assert (weights >= 0).all()
    assert np.mean(costs) - 1e-9 <= cvar.of(costs) <= max(costs) + 1e-9
    assert cvar.of(costs) <= Risk("cvar", min(level + 0.005, 0.999)).of(costs) + 1e-9
    assert Risk("cvar", 0.0).of(costs) == pytest.approx(Risk("mean").of(costs))
    # Rockafellar & Uryasev: the least over t of t + E[max(c - t, 0)] / (1 - level).
    c = np.array(costs)
    by_definition = min(t + np.maximum(c - t, 0).mean() / (1 - level) for t in c)
    assert cvar.of(costs) == pytest.approx(by_definition, abs=1e-6)


def test_a_risk_that_is_none():
    for wrong in ({"kind": "worst"}, {"kind": "cvar", "level": 1.0}, {"level": -0.1}):
        with pytest.raises(RiskError):
            Risk(**wrong)


def test_a_layout_fails_with_one_of_its_flows():
    good, bad = Flow("ok", {"a": 1.0}, (0.5, 0.2)), Flow("diverged", {}, (10.0, 5.0))
    both = weigh([good, Flow("ok", {"a": 3.0}, (0.7, 0.4))], Risk(), 15.0)
    assert both.cost == pytest.approx(0.9)
    assert both.costs == pytest.approx((0.6, 0.3))
    assert both.flows == pytest.approx((0.7, 1.1))
    assert both.measures == {"a": 2.0}
    assert both.rollouts == 2
    failed = weigh([good, bad], Risk(), 15.0)
    assert (failed.status, failed.cost, failed.measures) == ("diverged", 15.0, {})


# -- what is drawn ---------------------------------------------------------------------------------


def test_flows_fill_their_ranges_evenly(small):
    drawn, notes = Scenarios(count=8, speed=(1.6, 2.4), friction=(30, 40)).draw(small)
    assert notes == []
    for values, low, high in (
        ([d.speed for d in drawn], 1.6, 2.4),
        ([d.friction_angle for d in drawn], 30, 40),
    ):
        parts = np.sort((np.array(values) - low) / (high - low) * 8).astype(int)
        assert parts.tolist() == list(range(8))
    own = float(np.prod(small.releases[0].size))
    shares = [d.volume / own for d in drawn]
    assert 0.8 <= min(shares) < 0.85
    assert 1.15 < max(shares) <= 1.2
    assert drawn == Scenarios(count=8, speed=(1.6, 2.4), friction=(30, 40)).draw(small)[0]
    assert drawn != Scenarios(count=8, speed=(1.6, 2.4), friction=(30, 40), seed=1).draw(small)[0]
    flows = scenes(small, drawn)
    largest = max(range(8), key=lambda k: drawn[k].volume)
    assert widest(flows) == flows[largest]
    assert flows[0].material.friction_angle == drawn[0].friction_angle


def test_default_ranges_keep_to_what_a_simulator_was_trained_for(small):
    limits = Limits(max_speed=2.1, friction_angle=(35.0, 35.0))
    simulator = SimpleNamespace(name="known", config=SimpleNamespace(limits=limits))
    drawn, notes = Scenarios(count=4).draw(small, simulator)
    assert max(d.speed for d in drawn) <= 2.1
    assert {d.friction_angle for d in drawn} == {35.0}
    assert len(notes) == 2
    assert any("friction angle stays at 35" in n for n in notes)
    # Who names a range gets it.
    drawn, notes = Scenarios(count=4, friction=(30, 40), speed=(2, 3)).draw(small, simulator)
    assert max(d.speed for d in drawn) > 2.5
    assert notes == []


def test_scenarios_that_are_none(small):
    for wrong in ({"count": 0}, {"count": 9999}, {"count": 2, "speed": (3.0, 1.0)},
                  {"count": 2, "friction": (float("nan"), 1.0)}):  # fmt: skip
        with pytest.raises(ScenarioError):
            Scenarios(**wrong)
    with pytest.raises(GnsError, match="friction_angle"):
        Scenarios(count=2, friction=(35, 89)).draw(small)
    for text in ("a:b", "1:2:3", ":", ""):
        with pytest.raises(ScenarioError, match="--speed"):
            parse_range("speed", text)
    assert parse_range("speed", "2") == (2.0, 2.0)
    nothing = (None,) * 6
    assert scenarios_of(*nothing, 0) is None
    for k, name in enumerate(("speed", "volume", "friction", "risk"), 1):
        with pytest.raises(ScenarioError, match=f"--{name} .*--scenarios"):
            scenarios_of(*(("1:2" if j == k else None) for j in range(6)), 0)
    with pytest.raises(ScenarioError, match="--risk cvar"):
        scenarios_of(3, None, None, None, None, 0.5, 0)
    with pytest.raises(SettingError, match="a rollout for each scenario"):
        Settings(budget=3, scenarios=Scenarios(count=4))
    assert Settings(scenarios=Scenarios(count=4)).passes == 4 * 48


# -- on a formula ----------------------------------------------------------------------------------


@pytest.fixture
def tasks():
    """The formula's flume with three releases across it."""
    flows = [
        formula_scene(release=[{"lower": [0, 0.35, z], "upper": [0.3, 0.5, z + 0.6],
                                "velocity": [1, 0, 0]}])
        for z in (0.1, 0.5, 0.9)
    ]  # fmt: skip
    simulator, alone = FormulaSimulator(), Objective(depth_weight=0.0)
    return [BaffleTask(flow, simulator, n_baffles=2, objective=alone) for flow in flows]


def test_costs_of_a_batch_are_those_of_the_flows_one_by_one(tasks):
    layouts = [np.array([[0.7, 0.5], [1.2, 1.0]]), np.array([[0.8, 0.3], [0.9, 0.8]])]
    for risk in (Risk(), Risk("cvar", 0.5)):
        for layout, outcome in zip(layouts, run(tasks, layouts, risk), strict=True):
            alone = [task.evaluate([layout])[0] for task in tasks]
            assert outcome.flows == pytest.approx([e.cost for e in alone])
            assert outcome.cost == pytest.approx(risk.of([e.cost for e in alone]))
            travel = np.mean([e.measures["centroid_travel"] for e in alone])
            assert outcome.measures["centroid_travel"] == pytest.approx(travel)
            assert outcome.rollouts == 3


@pytest.mark.parametrize("risk", [Risk(), Risk("cvar", 0.5)])
def test_the_gradient_of_the_risk_is_that_of_central_differences(tasks, risk):
    layout = np.array([[0.7, 0.5], [1.2, 1.0]])
    outcome = differentiate_flows(tasks, [layout], risk)[0]
    assert (outcome.rollouts, outcome.backwards) == (3, 3)
    h, numeric = 1e-3, np.zeros_like(layout)
    for index in np.ndindex(layout.shape):
        step = np.zeros_like(layout)
        step[index] = h
        up, down = run(tasks, [layout + step, layout - step], risk)
        numeric[index] = (up.cost - down.cost) / (2 * h)
    np.testing.assert_allclose(outcome.gradient, numeric, rtol=5e-3, atol=1e-4)


@pytest.mark.parametrize("method", ["rows", "tpe", "hybrid"])
def test_a_search_pays_for_every_flow(tasks, tmp_path, method):
    from design.methods import METHODS

    c = campaign(tmp_path, budget=62, price=3)
    c.evaluator = InProcess(tasks, Risk("cvar", 0.5))
    METHODS[method](c)
    trials = c.log.trials()
    assert 57 <= c.log.spent() <= 62
    assert all(len(t.outcome.flows) == 3 for t in trials)
    assert {t.outcome.rollouts for t in trials} == {3}
    assert any(t.outcome.backwards == 3 for t in trials) == (method == "hybrid")


# -- whole runs ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small():
    """The short flume with baffles out of line, one of them in the flow."""
    return short_flume(
        duration=0.25,
        baffle=[baffle_at(0.7, 0.5), baffle_at(0.9, 0.9)],
        placement={"lower": [0.46, 0.1], "upper": [1.3, 1.1], "gap": 0.1},
    )


def test_a_robust_run_judges_every_flow_and_resumes(small, tmp_path, no_report):
    out = tmp_path / "run"
    values = {"method": "rows", "verify": 1, "simulator": COARSE, "verifier": COARSE, "workers": 1,
              "scenarios": Scenarios(count=2, volume=(0.8, 1.3))}  # fmt: skip
    summary = optimise(small, out, Settings(budget=12, **values))
    assert summary["rollouts"] == 12
    assert summary["reference_rollouts"] == 2 * (1 + 2)
    best = summary["best"]
    assert best["verified_flows"] == pytest.approx(best["flows"])  # the same solver judges here
    assert best["cost"] == pytest.approx(np.mean(best["flows"]))
    own = summary["paper_layout"]
    assert own["flows"][0] != own["flows"][1]
    assert min(own["flows"]) < 1.499  # its baffles were in the flow
    with (out / "trials.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6
    for row in rows:
        flows = [float(row["flow_1"]), float(row["flow_2"])]
        assert float(row["cost"]) == pytest.approx(np.mean(flows))
        # The larger release reaches farther than the scene's own, and no baffle stands in it.
        assert min(float(row["x1"]), float(row["x2"])) - 0.075 > 0.1 + 0.35 * 1.03
    again = optimise(small, out, Settings(budget=16, resume=True, **values))
    assert again["rollouts"] == 16
    other = {**values, "scenarios": Scenarios(count=2, volume=(0.8, 1.2))}
    with pytest.raises(StudyError, match="another set of scenarios"):
        optimise(small, out, Settings(budget=16, resume=True, **other))
    from design.front_page import scenarios
    from design.results import RunResults

    text = scenarios(RunResults(out))
    assert f"{again['scenarios'][1]['friction_angle']:.1f}°" in text
    assert f"{again['best']['verified_flows'][1]:.4f}" in text


def test_an_own_layout_that_a_larger_release_reaches_is_left_out_and_said(
    small, tmp_path, no_report
):
    close = small.with_baffles([[0.54, 0.5], [0.9, 0.9]])
    settings = Settings(method="rows", budget=2, verify=0, simulator=COARSE, workers=1,
                        scenarios=Scenarios(count=2, volume=(1.2, 1.6)))  # fmt: skip
    summary = optimise(close, tmp_path / "run", settings)
    assert summary["paper_layout"] is None
    assert any("own layout does not stand" in note for note in summary["notes"])

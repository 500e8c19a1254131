"""The searches on a formula: constraints, improvement, resuming, failures, budget."""

import numpy as np
import pytest
import torch

import design
from design import bayes, gradient, hybrid
from design.baselines import engineering_layouts, random_layouts, rows
from design.chains import LEAST_STEP, STEP, Adam, Lbfgs
from design.distinct import distance
from design.gradient import differentiate
from design.methods import FOLLOW, METHODS
from design.outcome import Outcome
from design.storage import StudyError
from design.table import table
from design.trials import TrialLog
from gns_env.layout import LayoutSpace
from gns_env.objective import Objective
from gns_env.task import BaffleTask
from gns_model.errors import GnsError, SimulatorError

from .search_kit import FormulaSimulator, PlainFormula, campaign, formula_scene

#: Each at least once, and the slow Gaussian process within `bayes` and `hybrid`.
SOME = [m for m in METHODS if m != "gp"]
#: Two keep-outs, and a gap that rows of three just hold.
CROWDED = {
    "placement": {
        "lower": [0.5, 0.0],
        "upper": [1.3, 1.6],
        "gap": 0.12,
        "keep_out": [[0.8, 0.0, 1.0, 0.7], [0.6, 1.0, 1.1, 1.2]],
    }
}


@pytest.mark.parametrize("method", SOME)
def test_every_layout_that_is_run_is_buildable(tmp_path, method):
    simulator = FormulaSimulator()
    scene = formula_scene(**CROWDED)
    c = campaign(tmp_path, simulator=simulator, scene=scene, n=3, budget=26)
    METHODS[method](c)
    ran = [s for s in simulator.seen if s.baffles]
    assert ran or method in ("gradient", "lbfgs")
    layouts = [np.array([b.center for b in s.baffles]) for s in ran]
    layouts += [t.centres for t in c.log.trials()]
    assert len(layouts) >= 13
    for layout in layouts:
        assert layout.shape == (3, 2)
        assert c.space.check(layout) == []


@pytest.mark.parametrize("method", SOME)
def test_the_budget_is_spent_and_counted(tmp_path, method):
    c = campaign(tmp_path, budget=30)
    seen = []
    c.on_trial = seen.append
    METHODS[method](c)
    trials = c.log.trials()
    assert 29 <= c.log.spent() <= 30  # a gradient costs two, so one may be left
    assert len(seen) == len(trials)
    backwards = sum(t.outcome.backwards for t in trials)
    assert (backwards > 0) == (method in FOLLOW)
    assert sum(t.outcome.rollouts for t in trials) + backwards == c.log.spent()


@pytest.mark.parametrize("method", SOME)
def test_a_search_beats_chance(tmp_path, method):
    if method == "random":
        pytest.skip("it is chance")
    c = campaign(tmp_path, n=2, budget=40, seed=3)
    METHODS[method](c)
    task = c.evaluator.task
    rng = np.random.default_rng(0)
    by_chance = [
        min(e.cost for e in task.evaluate([x for _, x in random_layouts(c.space, 40, rng)]))
        for _ in range(5)
    ]
    assert c.log.best().cost < np.median(by_chance)


def test_a_leap_improves_on_what_it_starts_from(tmp_path):
    c = campaign(tmp_path, budget=60)
    bayes.search(c, until=20)
    before = c.log.best()
    assert before.origin != "gradient"
    hybrid.leap(c)
    after = c.log.best()
    assert after.origin == "gradient"
    assert after.cost < before.cost - 1e-4
    # What was leapt from is not leapt from again.
    leapt = [t.centres for t in c.log.trials() if t.origin == "gradient"]
    hybrid.leap(c)
    later = [t.centres for t in c.log.trials() if t.origin == "gradient"][len(leapt) :]
    assert later
    assert min(distance(later[0], old) for old in leapt) >= STEP


class _Uphill(FormulaSimulator):
    """Its gradients point the wrong way, its rollouts are right."""

    def rollout_tensor(self, scenes, centres=None, **options):
        turned = [2 * c.detach() - c for c in centres]
        return super().rollout_tensor(scenes, turned, **options)


def test_leaps_that_do_not_pay_leave_the_budget_to_optuna(tmp_path):
    passes = {}
    for simulator in (FormulaSimulator(), _Uphill()):
        folder = tmp_path / type(simulator).__name__
        folder.mkdir()
        c = campaign(folder, simulator=simulator, budget=30, batch=4)
        hybrid.search(c)
        passes[type(simulator)] = 2 * sum(t.outcome.backwards for t in c.log.trials())
        assert c.log.spent() in (29, 30)
    assert c.log.best().origin == "bayes"
    assert passes[_Uphill] < passes[FormulaSimulator]


def test_a_resumed_search_is_the_search_that_was_not_interrupted(tmp_path):
    whole, halves = tmp_path / "whole", tmp_path / "halves"
    whole.mkdir()
    halves.mkdir()
    c = campaign(whole, budget=24, seed=5)
    bayes.search(c)
    bayes.search(campaign(halves, budget=24, seed=5), until=16)
    resumed = campaign(halves, budget=24, seed=5, resume=True)
    assert len(resumed.log.trials()) == 16
    bayes.search(resumed)
    costs = [[t.cost for t in s.log.trials()] for s in (c, resumed)]
    assert len(costs[0]) == 24
    assert costs[0] == costs[1]


def test_another_seed_is_another_search(tmp_path):
    costs = []
    for seed in (0, 1):
        (tmp_path / str(seed)).mkdir()
        c = campaign(tmp_path / str(seed), budget=16, seed=seed)
        bayes.search(c)
        costs.append([t.cost for t in c.log.trials() if t.origin == "bayes"])
    assert costs[0] != costs[1]


def test_failures_are_told_with_a_finite_penalty_and_the_search_goes_on(tmp_path):
    def left_half(scene):
        return any(b.center[1] < 0.6 for b in scene.baffles)

    c = campaign(tmp_path, simulator=FormulaSimulator(fails=left_half), n=1, budget=40)
    hybrid.search(c)
    trials = c.log.trials()
    failed = [t for t in trials if not t.ok]
    assert failed
    assert {t.outcome.status for t in failed} <= {"diverged"}
    assert all(np.isfinite(t.cost) and t.outcome.measures == {} for t in failed)
    assert c.log.best().ok
    assert min(t.cost for t in failed) > max(t.cost for t in trials if t.ok)
    # Having learnt where rollouts fail, it goes there less than chance would.
    late = [t for t in trials[20:] if t.origin == "bayes"]
    assert sum(not t.ok for t in late) < 0.35 * len(late)


def test_a_search_without_any_good_rollout_still_ends(tmp_path):
    c = campaign(tmp_path, simulator=FormulaSimulator(fails=lambda s: bool(s.baffles)), budget=12)
    bayes.search(c)
    assert c.log.spent() == 12
    assert c.log.best() is None


def test_an_interrupt_keeps_what_was_told_and_leaves_nothing_waiting(tmp_path):
    c = campaign(tmp_path, budget=32)
    told = []

    def stop(trial):
        told.append(trial)
        if len(told) == 11:
            raise KeyboardInterrupt

    c.on_trial = stop
    with pytest.raises(KeyboardInterrupt):
        bayes.search(c)
    states = [t.state.name for t in c.log.study.get_trials(deepcopy=False)]
    assert "RUNNING" not in states
    resumed = campaign(tmp_path, budget=32, resume=True)
    assert len(resumed.log.trials()) == 11
    bayes.search(resumed)
    assert resumed.log.spent() == 32


def test_trials_left_running_by_a_crash_are_tried_again(tmp_path):
    c = campaign(tmp_path)
    asked = c.log.ask(3, bayes.sampler(c, "gp"), "gp")  # and never told
    resumed = campaign(tmp_path, resume=True)
    assert {t.state.name for t in resumed.log.study.get_trials()} == {"FAIL"}
    resumed.catch_up()
    again = [t.centres for t in resumed.log.trials()]
    np.testing.assert_allclose(again, [p.centres for p in asked], atol=1e-9)


@pytest.mark.parametrize("search", [gradient.search, hybrid.search])
def test_a_simulator_without_gradient_is_refused_before_anything_is_spent(tmp_path, search):
    c = campaign(tmp_path, simulator=PlainFormula())
    with pytest.raises(SimulatorError, match="no gradient"):
        search(c)
    assert c.log.spent() == 0


# -- gradient --------------------------------------------------------------------------------------


def test_the_gradient_is_that_of_central_differences():
    task = BaffleTask(formula_scene(), FormulaSimulator(), n_baffles=2)
    layout = np.array([[0.7, 0.5], [1.2, 1.0]])
    outcome = differentiate(task, [layout])[0]
    assert outcome.status == "ok"
    assert (outcome.rollouts, outcome.backwards) == (1, 1)
    assert outcome.cost == pytest.approx(task.evaluate([layout])[0].cost)
    # Travel is the same smooth or hard, so its differences are exact.
    h, numeric = 1e-3, np.zeros_like(layout)
    travel = BaffleTask(
        formula_scene(), FormulaSimulator(), n_baffles=2, objective=Objective(depth_weight=0.0)
    )
    for index in np.ndindex(layout.shape):
        step = np.zeros_like(layout)
        step[index] = h
        up, down = travel.evaluate([layout + step, layout - step])
        numeric[index] = (up.cost - down.cost) / (2 * h)
    np.testing.assert_allclose(differentiate(travel, [layout])[0].gradient, numeric, rtol=2e-3)


def test_a_batch_of_gradients_is_the_gradients_one_by_one():
    task = BaffleTask(formula_scene(), FormulaSimulator(), n_baffles=2)
    layouts = [np.array([[0.7, 0.5], [1.2, 1.0]]), np.array([[0.8, 0.3], [0.9, 0.8]])]
    together = differentiate(task, layouts)
    for layout, outcome in zip(layouts, together, strict=True):
        alone = differentiate(task, [layout])[0]
        np.testing.assert_allclose(outcome.gradient, alone.gradient)


class _Astray(FormulaSimulator):
    def rollout_tensor(self, scenes, centres=None, **options):
        return [p * torch.tensor(float("nan")) for p in super().rollout_tensor(scenes, centres)]


def test_a_gradient_of_a_rollout_that_went_astray_is_a_failure(tmp_path):
    task = BaffleTask(formula_scene(), _Astray(), n_baffles=2)
    outcome = differentiate(task, [np.array([[0.7, 0.5], [1.2, 1.0]])])[0]
    assert outcome.status == "diverged"
    assert np.isfinite(outcome.cost)
    c = campaign(tmp_path, simulator=_Astray(), budget=24)
    gradient.search(c)  # ends, although every chain dies at once
    assert c.log.best().ok


@pytest.mark.parametrize("kind", [Adam, Lbfgs])
def test_a_chain_descends_a_bowl_and_stops_there(kind):
    space = LayoutSpace(formula_scene(), 1)
    bottom = np.array([[1.1, 0.9]])
    chain, steps = kind(space, np.array([[0.7, 0.4]])), 0
    while chain.step >= LEAST_STEP and steps < 200:
        offset = chain.centres - bottom
        chain.learn(Outcome(float((offset**2).sum()), {}, gradient=2 * offset))
        steps += 1
    assert steps < 200
    np.testing.assert_allclose(chain.centres, bottom, atol=0.02)


@pytest.mark.parametrize("kind", [Adam, Lbfgs])
def test_a_chain_stops_at_a_constraint(kind):
    space = LayoutSpace(formula_scene(), 1)
    chain = kind(space, space.decode(np.array([0.0, 0.5])))
    chain.learn(Outcome(1.0, {}, gradient=np.array([[1.0, 0.0]])))  # downhill is out of bounds
    assert chain.step == 0


@pytest.mark.parametrize("kind", [Adam, Lbfgs])
def test_a_chain_slides_along_a_constraint(kind):
    space = LayoutSpace(formula_scene(), 1)
    bottom = np.array([[0.2, 0.9]])  # out of bounds upstream: the best there is lies at the edge
    chain, steps = kind(space, np.array([[0.7, 0.4]])), 0
    while chain.step >= LEAST_STEP and steps < 200:
        offset = chain.centres - bottom
        chain.learn(Outcome(float((offset**2).sum()), {}, gradient=2 * offset))
        steps += 1
    assert steps < 200
    np.testing.assert_allclose(chain.centres, [[space.lower[0], 0.9]], atol=0.03)


# -- the log ---------------------------------------------------------------------------------------


def test_a_study_is_not_started_twice_and_not_mixed_with_another_task(tmp_path):
    bayes.search(campaign(tmp_path, budget=8))
    with pytest.raises(StudyError, match="--resume"):
        campaign(tmp_path)
    with pytest.raises(StudyError, match="another n"):
        campaign(tmp_path, n=3, resume=True)


@pytest.mark.parametrize(
    "storage",
    ["nonsense", "nosuch://x/y", "sqlite:////nosuch/folder/study.db", "postgresql://u:secret@h/d"],
)
def test_a_storage_that_cannot_be_opened_is_one_error_without_the_password(storage):
    space = LayoutSpace(formula_scene(), 2)
    with pytest.raises(StudyError) as error:
        TrialLog.open(storage, "x", space, {}, resume=False, owned=False)
    assert "secret" not in str(error.value)


def test_a_file_that_is_not_a_database_is_named(tmp_path):
    (tmp_path / "study.db").write_text("not a database, " * 100)
    with pytest.raises(StudyError, match=r"study\.db"):
        campaign(tmp_path)


def test_two_searches_share_a_study(tmp_path):
    first = campaign(tmp_path, budget=12)
    second = campaign(tmp_path, budget=24, resume=True)
    bayes.search(first)
    bayes.search(second)
    assert first.log.spent() == second.log.spent() == 24


def test_the_table_holds_every_trial(tmp_path):
    c = campaign(tmp_path, budget=10)
    bayes.search(c)
    lines = table(c.log.trials()).splitlines()
    header = lines[0].split(",")
    assert len(lines) == 11
    assert {"number", "origin", "cost", "centroid_travel", "x1", "z1", "x2", "z2"} <= set(header)
    row = dict(zip(header, lines[3].split(","), strict=True))
    assert float(row["cost"]) == c.log.trials()[2].cost


# -- baselines -------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 3, 4, 6])
def test_engineering_layouts_are_rows_and_buildable(n):
    space = LayoutSpace(formula_scene(), n)
    layouts = list(engineering_layouts(space))
    assert all(space.check(c) == [] and c.shape == (n, 2) for _, c in layouts)
    single = next(c for name, c in layouts if name == "row")
    assert np.ptp(single[:, 0]) < 1e-9
    gaps = np.diff(np.sort(single[:, 1]))
    assert np.allclose(gaps, gaps[:1])
    if n >= 2:
        staggered = next(c for name, c in layouts if name == "staggered")
        assert len(np.unique(staggered[:, 0].round(6))) == 2


def test_a_plane_scene_has_series(plane_scene):
    space = LayoutSpace(plane_scene, 2)
    layouts = list(engineering_layouts(space))
    assert {name for name, _ in layouts} == {"series"}
    assert all(space.check(c) == [] for _, c in layouts)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 6])
def test_rows_of_every_kind_are_straight_centred_and_buildable(n):
    scene = formula_scene()
    space = LayoutSpace(scene, n)
    layouts = rows(space, 0)
    assert len(layouts) > 2 * n
    middle = (space.lower[1] + space.upper[1]) / 2
    kinds = set()
    for centres in layouts:
        assert space.check(centres) == []
        places, counts = np.unique(centres[:, 0].round(6), return_counts=True)
        assert np.ptp(counts) <= 1
        kinds.add(tuple(counts))
        across = centres[:, 1]
        assert across.min() + across.max() == pytest.approx(2 * middle)
        for x in places:
            gaps = np.diff(np.sort(across[np.isclose(centres[:, 0], x)]))
            assert np.allclose(gaps, gaps[:1])
    assert {len(k) for k in kinds} == set(range(1, min(n, 3) + 1))
    if n == 3:
        assert {(3,), (2, 1), (1, 2), (1, 1, 1)} == kinds
    finer = rows(space, 1)
    assert len(finer) > 1.5 * len(layouts)
    assert len({tuple(c[np.lexsort(c.T)].ravel().round(4)) for c in finer}) == len(finer)


def test_rows_avoid_what_they_must_and_series_are_rows_of_a_plane(plane_scene):
    space = LayoutSpace(formula_scene(**CROWDED), 3)
    assert rows(space, 1)
    assert all(space.check(c) == [] for c in rows(space, 1))
    plane = LayoutSpace(plane_scene, 2)
    assert rows(plane, 0)
    assert all(c.shape == (2, 1) and plane.check(c) == [] for c in rows(plane, 0))


def test_rows_end_when_the_finest_grid_is_tried(tmp_path):
    c = campaign(tmp_path, n=1, budget=100_000, batch=500)
    METHODS["rows"](c)
    trials = c.log.trials()
    assert 15 < len(trials) < 100
    layouts = {tuple(t.centres.ravel().round(4)) for t in trials}
    assert len(layouts) == len(trials)


# -- in code ---------------------------------------------------------------------------------------


@pytest.fixture
def task():
    """The formula with two baffles; travel alone counts."""
    alone = Objective(depth_weight=0.0)
    return BaffleTask(formula_scene(), FormulaSimulator(), n_baffles=2, objective=alone)


@pytest.mark.parametrize("method", ["rows", "gp", "hybrid"])
def test_optimize_returns_what_it_found_and_spent(task, method):
    seen = []
    result = design.optimize(task, method=method, budget=24, seed=1, on_trial=seen.append)
    assert result.method == method
    assert 23 <= result.rollouts + result.backwards <= 24
    assert (result.backwards > 0) == (method == "hybrid")
    assert len(result.trials) == len(seen) == result.rollouts
    assert result.best.cost == min(t.cost for t in result.trials)
    assert task.evaluate([result.best.centres])[0].cost == pytest.approx(result.best.cost)
    assert f"{result.rollouts} rollouts" in str(result)
    assert result.curve[-1].tolist() == [result.rollouts + result.backwards, result.best.cost]
    again = design.optimize(task, method=method, budget=24, seed=1)
    assert [t.cost for t in again.trials] == [t.cost for t in result.trials]


def test_optimize_chooses_a_method_and_refuses_what_cannot_be(task):
    assert design.optimize(task, budget=4).method == "hybrid"
    plain = BaffleTask(formula_scene(), PlainFormula(), n_baffles=2)
    assert design.optimize(plain, budget=4).method == "bayes"
    for method in ("gradient", "hybrid"):
        with pytest.raises(SimulatorError, match="no gradient"):
            design.optimize(plain, method=method)
    with pytest.raises(SimulatorError, match="random, rows"):
        design.optimize(task, method="guess")
    for wrong in ({"budget": 0}, {"batch": 0}, {"seed": -1}):
        with pytest.raises(GnsError, match="or more"):
            design.optimize(task, **wrong)
    several = BaffleTask(
        formula_scene(), FormulaSimulator(), n_baffles=2, objective=Objective.pareto()
    )
    with pytest.raises(SimulatorError, match="Pareto"):
        design.optimize(several, method="hybrid")


def test_cost_and_gradient_are_of_one_function():
    task = BaffleTask(formula_scene(), FormulaSimulator(), n_baffles=2)
    layout = np.array([[1.2, 1.0], [0.7, 0.5]])
    cost, gradient = design.cost_and_gradient(task, layout)
    assert gradient.shape == (2, 2)
    assert cost == pytest.approx(task.evaluate([layout])[0].cost, rel=0.02)
    h, numeric = 1e-5, np.zeros_like(layout)
    for index in np.ndindex(layout.shape):
        step = np.zeros_like(layout)
        step[index] = h
        up, down = (design.cost_and_gradient(task, layout + s * step)[0] for s in (1, -1))
        numeric[index] = (up - down) / (2 * h)
    np.testing.assert_allclose(gradient, numeric, rtol=1e-3, atol=1e-6)
    swapped = design.cost_and_gradient(task, layout[::-1])
    assert swapped[0] == pytest.approx(cost)
    np.testing.assert_allclose(swapped[1], gradient[::-1])
    for simulator in (PlainFormula(), _Astray()):
        with pytest.raises(SimulatorError, match="gradient"):
            design.cost_and_gradient(BaffleTask(formula_scene(), simulator, n_baffles=2), layout)

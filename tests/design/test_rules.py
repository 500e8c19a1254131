"""Prices, limits on the flow, number and form in the searches, on the formula."""

import math

import numpy as np
import pytest
import torch

import design
from design.constraints import constraints, to_blame
from design.evaluators import InProcess, space_of
from design.gradient import differentiate_flows
from design.outcome import Outcome, Trial
from design.risk import Risk
from design.rules import PENALTY, RuleError, Rules
from design.space import built
from design.table import table
from design.verify import Judged, as_judged, rank, verdict
from gns_env.objective import Objective
from gns_env.task import BaffleTask
from gns_model import measures as hard
from gns_model.errors import GnsError
from gns_model.learned import LearnedModel, LearnedSimulator, ModelConfig
from gns_model.smooth_measures import smooth_overtopping

from .search_kit import FormulaSimulator, formula_scene

TRAVEL = Objective(depth_weight=0.0)
#: The grains of the formula fly at 0.35 to 0.5 m: they pass over baffles lower than that.
FREED = {"height": [0.2, 0.55], "across": [0.1, 0.3], "number": [1, 4]}


def freed(vary=FREED, **placement):
    area = {"lower": [0.5, 0.0], "upper": [1.8, 1.6], "gap": 0.1, **placement}
    scene = formula_scene(placement={**area, "vary": vary})
    return BaffleTask(scene, FormulaSimulator(), n_baffles=2, objective=TRAVEL)


@pytest.mark.parametrize("method", ["random", "rows", "tpe", "nsga2", "gradient"])
def test_every_method_searches_number_and_form_within_the_limits(method):
    task = freed(max_volume=0.03, max_overtopping=0.05)
    result = design.optimize(task, method=method, budget=36, seed=1)
    space = space_of(task)
    assert all(space.check(t.centres) == [] for t in result.trials)
    assert len({len(t.centres) for t in result.trials}) > 1
    forms = {space.split(t.centres)[1] for t in result.trials}
    assert len(forms) > 5 or method == "rows"
    best = result.best
    assert best.outcome.feasible
    assert best.outcome.excess["max_overtopping"] <= 0
    cheaper = [t for t in result.trials if t.ok and t.cost < best.cost]
    assert all(t.outcome.excess["max_overtopping"] > 0 for t in cheaper)
    # What the log says is what the task says of the baffles that are built.
    centres, form = space.split(best.centres)
    again = task.with_form(form.size, form.yaw).evaluate([centres])[0]
    assert again.cost == pytest.approx(best.cost)
    volume = len(centres) * math.prod(form.size)
    assert volume <= 0.03 * (1 + 1e-6)
    text = table(result.trials, space).splitlines()
    assert len({line.count(",") for line in text}) == 1
    assert {"height", "across", "x1", "excess_max_overtopping"} <= set(text[0].split(","))


def test_a_price_makes_fewer_baffles():
    counts = []
    for price in (0.0, 0.5):
        result = design.optimize(freed(), method="random", budget=40, baffle_cost=price)
        counts.append(len(result.best.centres))
        t = result.trials[-1]
        space = space_of(freed())
        centres, form = space.split(t.centres)
        plain = freed().with_form(form.size).evaluate([centres])[0].cost
        assert t.cost == pytest.approx(plain + price * len(centres))
    assert counts[0] > counts[1] == 1


def test_rows_are_searched_as_rows_by_what_samples_and_refused_by_what_follows_gradients():
    scene = formula_scene()
    task = BaffleTask(scene, FormulaSimulator(), n_baffles=3, objective=TRAVEL)
    result = design.optimize(task, method="tpe", budget=24, pattern="rows")
    for trial in result.trials:
        counts = np.unique(trial.centres[:, 0].round(6), return_counts=True)[1]
        assert np.ptp(counts) <= 1
    assert design.optimize(task, budget=2, pattern="rows").method == "bayes"
    for method in ("gradient", "hybrid", "lbfgs"):
        with pytest.raises(GnsError, match="keeps no rows"):
            design.optimize(task, method=method, budget=2, pattern="rows")
    with pytest.raises(GnsError, match="free or rows"):
        design.optimize(task, budget=2, pattern="ring")


def test_the_gradient_in_the_form_is_that_of_central_differences():
    # Few baffles of other sizes, a price of concrete, and a limit that is broken.
    task = freed({"across": [0.1, 0.3], "height": [0.2, 0.55]})
    space = space_of(task)
    rules = Rules(concrete_cost=3.0)
    layout = space.join([[0.7, 0.5], [1.2, 1.0]], type(space.form)((0.15, 0.3, 0.2)))
    found = differentiate_flows([task], [layout], Risk(), rules, space)[0]
    assert found.gradient.shape == layout.shape == (2, 4)
    evaluator, h = InProcess(task, rules=rules, space=space), 1e-4
    for column, at in ((2, "height"), (3, "across")):
        assert space.names[column - 2] == at
        step = np.zeros_like(layout)
        step[:, column] = h
        up, down = (o.cost for _, o in evaluator.evaluate([layout + step, layout - step]))
        numeric = (up - down) / (2 * h)
        np.testing.assert_allclose(found.gradient[:, column], numeric, rtol=5e-3)


def test_the_penalty_steers_towards_what_the_limit_asks():
    task = freed({"height": [0.2, 0.55]}, freeboard=0.1)
    space, rules = space_of(task), Rules.of(task.scene)
    layout = space.join([[0.7, 0.5], [1.2, 1.0]], type(space.form)((0.15, 0.3, 0.15)))
    found = differentiate_flows([task], [layout], Risk(), rules, space)[0]
    assert found.excess["freeboard"] > 0
    assert found.merit == pytest.approx(found.cost + PENALTY * found.excess["freeboard"])
    assert (found.gradient[:, 2] < 0).all()  # higher


def test_smooth_overtopping_tends_to_the_hard_one():
    scene = formula_scene().with_baffles([[0.613, 0.587], [0.908, 1.013]])  # where the grains pass
    trajectory = FormulaSimulator().rollout([scene])[0]
    positions = torch.as_tensor(trajectory.positions)
    centres = torch.tensor([b.center for b in scene.baffles], dtype=positions.dtype)
    size = torch.tensor(scene.baffles[0].size, dtype=positions.dtype)
    sharp = [
        float(smooth_overtopping(positions, scene, centres, size, temperature=t))
        for t in (0.02, 0.001)
    ]
    true = hard.overtopping(trajectory)
    assert 0 < true < 1
    assert abs(sharp[1] - true) < 0.02
    assert abs(sharp[1] - true) <= abs(sharp[0] - true) + 1e-9


def test_whatever_keeps_the_limits_is_ranked_before_what_breaks_one():
    def judged(cost, excess, verified=None):
        trial = Trial(0, "x", np.zeros((1, 2)), Outcome(cost, {"a": 1.0}, excess={"m": excess}))
        found = as_judged(trial)
        if verified is not None:
            found.take(Outcome(cost, {"a": 1.0}, excess={"m": verified}))
        return found

    best, dear, wrong = judged(1.0, 0.3), judged(1.4, -0.1), judged(0.9, -0.2, 0.1)
    assert rank([best, dear]) == [dear, best]
    assert rank([best, wrong, judged(1.6, 0.4, -0.1)])[0].cost == 1.6
    word, sentence = verdict(wrong, None, 1.5)
    assert word == "infeasible"
    assert "breaks m" in sentence
    own = judged(0.8, 0.0, 0.2)
    assert verdict(judged(1.2, 0.0, -0.1), own, 1.5)[0] == "better"


def test_the_limit_that_nobody_keeps_is_to_blame():
    rules = Rules(max_overtopping=0.02, freeboard=0.05)

    def outcome(over, depth):
        return Outcome(1.0, {}, excess={"max_overtopping": over, "freeboard": depth})

    line = to_blame(rules, [outcome(0.03, -0.1), outcome(0.05, 0.1)])
    assert "max_overtopping is to blame: the least is 5%" in line
    assert "1 keep freeboard" in line
    together = to_blame(rules, [outcome(0.03, -0.1), outcome(-0.01, 0.1)])
    assert "to blame together" in together
    assert to_blame(rules, [outcome(-0.01, -0.1)]) == ""
    with pytest.raises(RuleError, match="--baffle-cost"):
        Rules(baffle_cost=-1)


def test_the_table_of_constraints_says_value_and_margin():
    task = freed({"height": [0.1, 0.4]}, max_height=0.4, max_volume=0.02, wall_gap=0.1,
                 keep_out=[[0.9, 0.0, 1.1, 0.3]],
                 keep_out_polygons=[[[1, 1.3], [1.2, 1.3], [1, 1.5]]],
                 max_overtopping=0.1)  # fmt: skip
    space = space_of(task)
    layout = space.join([[0.7, 0.3], [0.7, 0.8]], type(space.form)((0.15, 0.3, 0.15)))
    seen = Judged("x", layout, {}, 1.0, excess={"max_overtopping": 0.05})
    rows = constraints(built(task.scene, space, layout), Rules.of(task.scene), seen)
    by_name = {row["name"]: row for row in rows}
    expected = {"gap": 0.35, "placement": 0.125, "wall_gap": 0.225, "keep_out": 0.125,
                "max_height": 0.3, "max_volume": 0.0135, "max_overtopping": 0.15}  # fmt: skip
    assert {name: row["value"] for name, row in by_name.items()} == pytest.approx(expected)
    assert [name for name, row in by_name.items() if not row["holds"]] == ["max_overtopping"]
    assert by_name["max_volume"]["margin"] == pytest.approx(0.0065)
    assert by_name["max_overtopping"]["by"] == "search"


def test_a_learned_simulator_is_differentiated_in_size_and_yaw():
    torch.manual_seed(0)
    config = ModelConfig(spacing=0.0625, radius=0.1, latent=8, blocks=1, dt=0.025)
    scene = formula_scene(
        duration=0.3,
        release=[{"lower": [0, 0, 0.3], "upper": [0.3, 0.25, 1.3], "velocity": [2, 0, 0]}],
        placement={"lower": [0.4, 0.0], "upper": [1.8, 1.6], "gap": 0.1,
                   "vary": {"height": [0.1, 0.4], "across": [0.1, 0.3], "yaw": [-45, 45]}},
    )  # fmt: skip
    simulator = LearnedSimulator(LearnedModel(config))
    task = BaffleTask(scene, simulator, n_baffles=2, objective=TRAVEL)
    space = space_of(task)
    layout = space.join([[0.55, 0.5], [0.6, 1.0]], type(space.form)((0.15, 0.3, 0.2), 20.0))
    found = differentiate_flows([task], [layout], Risk(), Rules(), space)[0]
    assert found.status == "ok"
    assert found.gradient.shape == (2, 5)
    assert np.isfinite(found.gradient).all()
    across, yaw = found.gradient[0, 3:]
    assert across != 0
    assert yaw != 0
    assert (found.gradient[0, 2:] == found.gradient[1, 2:]).all()  # one form for all

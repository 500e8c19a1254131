"""Who holds what of a shared budget: in whatever order workers act, it is spent and no more."""

import numpy as np
import optuna
from hypothesis import given, settings
from hypothesis import strategies as st

from design import ledger
from design.outcome import Outcome
from design.parameters import to_centres
from design.storage import sqlite_url
from design.trials import TrialLog
from gns_env.layout import LayoutSpace

from .search_kit import formula_scene


@settings(max_examples=60)
@given(
    steps=st.lists(
        st.tuples(
            st.integers(0, 2),
            st.sampled_from(["again", "ask", "rows", "steps", "admit", "tell", "die"]),
        ),
        max_size=24,
    ),
    budget=st.integers(4, 20),
)
def test_whoever_asks_tells_or_dies_when_the_budget_is_spent_and_no_more(steps, budget):
    """Whatever three workers do in whatever order, those that are left spend exactly the rest, and
    every layout that was admitted and lost is told."""
    study = optuna.create_study()
    space = LayoutSpace(formula_scene(), 1)
    rows = [("row", np.array([[0.7, z]])) for z in (0.4, 0.8, 1.2)]
    sampler = optuna.samplers.RandomSampler(seed=0)
    logs = [TrialLog(study, space) for _ in range(3)]
    asked, open_, mine = [[] for _ in logs], [[] for _ in logs], set()
    forward, both = Outcome(1.0, {}), Outcome(1.0, {}, backwards=1)

    def admitted(log, proposals):
        return [p for p in log.admit(proposals, budget, 1) if p is not None]

    for k, what in steps:
        log = logs[k]
        if what == "die":
            log.abandon()
            asked[k], open_[k] = [], []
        elif what == "tell":
            for proposal, outcome in open_[k]:
                log.tell(proposal, outcome)
            open_[k] = []
        elif what == "admit":
            for proposals, outcome in asked[k]:
                open_[k] += [(p, outcome) for p in admitted(log, proposals)]
                mine |= {p.number for p, _ in open_[k]}
            asked[k] = []
        elif not asked[k]:  # between asking and being admitted a worker does nothing else
            if what == "again":
                found = log.again(2), forward
            elif what == "ask":
                found = log.ask(2, sampler, "random"), forward
            elif what == "rows":
                found = log.reserve(rows), forward
            else:  # chains of two workers may meet
                layouts = [("gradient", np.array([[0.9, 0.3]]))]
                found = log.reserve(layouts, 2), both
            asked[k].append(found)
        running = sum(o.rollouts + o.backwards for held in open_ for _, o in held)
        assert log.spent() + running <= budget
    for log in logs[1:]:
        log.abandon()
    rest = logs[0]
    rest.abandon()
    while proposals := rest.again(3) or rest.ask(min(3, budget - rest.taken(1)), sampler, "random"):
        for proposal in admitted(rest, proposals):
            rest.tell(proposal, forward)
    assert rest.spent() == rest.taken(1) == budget
    frozen = study.get_trials()
    told = [t for t in rest.trials()]
    again = {
        t.user_attrs.get(ledger.RETRY_OF): t for t in frozen if ledger.DROPPED not in t.user_attrs
    }
    for t in (frozen[n] for n in mine):
        while t.number in again:
            t = again[t.number]
        given_up = t.user_attrs.get(ledger.RETRIES) == ledger.MOST_RETRIES
        origin, layout = t.user_attrs.get(ledger.ORIGIN), to_centres(space, t.params)
        by_other = any(a.origin == origin and np.allclose(a.centres, layout) for a in told)
        assert t.state.name == "COMPLETE" or given_up or by_other
    places = [tuple(t.centres.ravel()) for t in told if t.origin == "row"]
    assert len(places) == len(set(places))


def test_a_trial_without_a_whole_layout_is_let_go(tmp_path):
    """A worker died between two parameters: there is no layout to try again, and no error."""
    space, address = LayoutSpace(formula_scene(), 2), sqlite_url(tmp_path / "s.db")
    log = TrialLog.open(address, "t", space, {"n": 2}, resume=False, owned=True)
    trial = log.study.ask()
    trial.suggest_float("x1", 0.0, 1.0)
    log.close()
    again = TrialLog.open(address, "t", space, {"n": 2}, resume=True, owned=True)
    assert again.again(4) == []
    assert [t.state.name for t in again.study.get_trials()] == ["FAIL"]
    again.close()


def test_a_layout_that_kills_its_worker_is_given_up(tmp_path):
    space = LayoutSpace(formula_scene(), 1)
    log = TrialLog(optuna.create_study(), space)
    (proposal,) = log.reserve([("row", np.array([[0.7, 0.4]]))])
    for _ in range(ledger.MOST_RETRIES):
        log.abandon()
        (proposal,) = log.again(8)
        assert proposal.origin == "row"
    log.abandon()
    assert log.again(8) == []
    assert log.taken(1) == 0


def test_a_worker_that_was_thought_dead_does_not_tell_twice(tmp_path):
    space = LayoutSpace(formula_scene(), 1)
    study = optuna.create_study()
    sleeper, other = TrialLog(study, space), TrialLog(study, space)
    (mine,) = sleeper.reserve([("row", np.array([[0.7, 0.4]]))])
    other._lose(sleeper._asked[mine.number], True)
    (theirs,) = other.again(1)
    other.tell(theirs, Outcome(1.0, {}))
    sleeper.tell(mine, Outcome(1.0, {}))
    assert [t.number for t in other.trials()] == [theirs.number]

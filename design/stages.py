"""The stages of a run: search, verify with all that doubts the search, name the trajectories.

The reference solver starts on the scene without baffles and on its own layout while the search
goes on, in the same pool of one-thread processes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import TYPE_CHECKING

from design.campaign import Campaign
from design.distinct import among
from design.ensemble import POOL, Panel, beyond_limits
from design.evaluators import InProcess, InWorkers, TaskSpec
from design.methods import METHODS
from design.outcome import Trial
from design.pareto import front, spread
from design.references import References, take_in
from design.space import form_of
from design.store import Rolled, RolloutStore, Watch
from design.summary import PARTIAL
from design.trials import worker
from design.verify import Judged, as_judged, rank
from design.verify import candidates as best_of
from gns_model.workers import Workers

if TYPE_CHECKING:
    from design.run import Run


def judge(
    run: Run, store: RolloutStore, workers: Workers, watch: Watch
) -> tuple[References, References]:
    """Search and verify; `run.ranked` holds the layouts then.

    Returns:
        rollouts of no baffles and of the scene's own layout, by the simulator that searched and by
        the reference solver.
    """
    s = run.settings
    searched = References.start(run, store, s.simulator)
    verified = References.start(run, store, s.verifier) if s.verify else References()
    watch.add("search: no baffles, own layout", searched.pending)
    watch.add("verify: no baffles, own layout", verified.pending)
    panel = None
    if run.ensemble and s.verify:
        panel = Panel(
            run.ensemble,
            s.simulator,
            lambda spec, layout: store.roll(spec, run.problem.laid_out(layout), trajectory=False),
            run.problem.weigh,
            watch,
        )
    with run.timed("search"):
        watch.wait(searched.pending)
        _search(run, workers, take_in(run, searched), watch)
    run.write(PARTIAL)
    with run.timed("verify"):
        if s.verify:
            _verify(run, store, verified, panel, watch)
        else:
            run.ranked = rank(candidates(run, 1))
    run.write(PARTIAL)
    return searched, verified


def candidates(run: Run, count: int) -> list[Judged]:
    """The layouts to verify, as the search ranks them: of several objectives, points of the front
    far apart; else the best that are not the same design."""
    space, trials = run.problem.space, run.log.trials()
    if run.settings.objectives:
        chosen = [as_judged(t) for t in spread(front(trials), count)]
    else:
        # Closer than a third of a baffle is one design.
        least = float(min(space.size[[0, *range(2, len(space.size))]])) / 3
        known = [] if run.paper is None else [run.paper.centres]
        known += run.continued.avoid if run.continued else []
        chosen = best_of(trials, count, least, avoid=known)
    for layout in chosen:
        layout.form = form_of(space, layout.centres)
    return chosen


def name_trajectories(
    run: Run, store: RolloutStore, searched: References, verified: References
) -> None:
    """Name what a reader looks at: the scene's own flow, also of a robust design."""
    problem, s = run.problem, run.settings
    named = {p.result().path for p in searched.none}  # a resumed search reads them
    named |= run.kept
    for role, spec, known in (("learned", s.simulator, searched), ("mpm", s.verifier, verified)):
        if not known.pending:
            continue
        shown = {"none": known.none[0], **({"paper": known.own[0]} if known.own else {})}
        if problem.drawn:
            shown = {"none": store.start(spec, problem.bare)}
            if problem.scene.baffles:
                shown["paper"] = store.start(spec, problem.own(problem.bare))
        if run.ranked:
            best = problem.built(problem.bare, run.ranked[0])
            # Whoever found it: a refined model knows more than the one that was given.
            who = run.models[run.ranked[0].model] if role == "learned" else spec
            shown["best"] = store.start(who, best)
        for key, job in shown.items():
            rolled = job.result()
            store.name(rolled, f"{key}-{role}")
            named.add(rolled.path)
    store.prune(named)


def _search(run: Run, workers: Workers, references: Sequence[Rolled], watch: Watch) -> None:
    """Spend the budget, each cost relative to `references`, the flows without baffles."""
    s, log, problem = run.settings, run.log, run.problem
    bar = watch.bar
    title = f"search: {run.method}"
    task = bar.add_task(title, total=s.passes)

    def show(trial: Trial | None = None, waiting: int = 0) -> None:
        tried = log.trials()  # also those of other workers
        good = [t for t in tried if t.ok]
        said = [title]
        if good and s.objectives:
            said.append(f"front of {len(front(good))}")
        if good:
            best = min(good, key=lambda t: t.order)
            limits = "" if best.outcome.feasible else ", which breaks a limit"
            said.append(f"best {best.cost:.4f}{limits}")
        if waiting:
            said.append(f"waiting for {waiting} trials of other workers")
        bar.update(task, description=", ".join(said), completed=log.spent(tried))

    show()
    spec = TaskSpec.of(
        problem.flows,
        problem.baffles,
        s.parts,
        s.simulator,
        [r.path for r in references],
        s.risk,
        problem.rules,
    )
    campaign = Campaign(
        log=log,
        evaluator=InWorkers(workers, spec, watch.update)
        if s.simulator.device == "cpu"
        else InProcess(spec.tasks(), s.risk, problem.rules, spec.space()),
        budget=s.passes,
        seed=s.seed,
        batch=s.batch,
        on_trial=show,
        salt=_salt() if s.storage else 0,
        price=s.flows,
    )
    if run.continued:
        known = [t.centres for t in log.trials()]
        fresh = [c for c in run.continued.first if not among(c, known)]
        campaign.run([("verified", c) for c in fresh])
    METHODS[run.method](campaign)
    # The last trials of a study that is shared may be another worker's, or be left to us.
    while campaign.wait(lambda waiting: show(waiting=waiting)):
        METHODS[run.method](campaign)


def _salt() -> int:
    """A number of this process, for the random numbers of searches that share a study."""
    return int.from_bytes(hashlib.sha256(worker().encode()).digest()[:4], "big")


def _verify(
    run: Run, store: RolloutStore, references: References, panel: Panel | None, watch: Watch
) -> None:
    """Have the reference solver judge the best, no baffles and the scene's own layout."""
    s, problem = run.settings, run.problem
    if panel is None:
        chosen = candidates(run, s.verify)
    else:
        chosen = panel.choose(candidates(run, POOL * s.verify), s.verify)
        panel.judge([run.paper] if run.paper is not None else [])
    for one in chosen:
        one.marks += beyond_limits(s.simulator, problem.built(problem.bare, one))
    pending = [store.roll(s.verifier, problem.laid_out(one), trajectory=False) for one in chosen]
    started = [p for ps in pending for p in ps]
    watch.add(f"verify: best {len(chosen)}", started)
    watch.wait([*references.pending, *started])
    none = references.bare("reference rollout", ": nothing can be verified")
    judged = [(run.none, references.none), (run.paper, references.own)]
    for layout, jobs in (*judged, *zip(chosen, pending, strict=True)):
        if layout is not None and jobs:
            layout.take(problem.weigh([job.result() for job in jobs], none))
    run.candidate_rollouts = len(started)
    run.reference_rollouts = len(started) + len(references.pending)
    run.ranked = rank(chosen)

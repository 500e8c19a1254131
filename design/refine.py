"""`--refine`: verified layouts teach the model that found them, and the search goes on with it.

Round k of a run lives in RUN/refined-k, which is a run folder of its own and the checkpoint of the
refined model at once:

    model.safetensors, card.json   the model; the card says from which and on which layouts
    training/                      state, log and recipe of the training
    summary.json, study.db, ...    the search with that model, and its verification

The gap to the reference solver is told for the layouts that were trained on and, apart from them,
for those that the refined model found afterwards: only the second says whether it has learnt.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from design.distinct import among
from design.ensemble import Ensemble, is_learned
from design.evaluators import SimulatorSpec
from design.lessons import FEW, Lesson, teach, training_files
from design.stages import judge
from design.store import RolloutStore, Watch
from design.summary import COMPLETE, PARTIAL
from design.verify import Judged, gap, rank
from design.wording import count
from gns_model.data.windows import read_source
from gns_model.errors import SimulatorError

if TYPE_CHECKING:
    from design.run import Run
    from gns_model.workers import Workers


@dataclass(frozen=True)
class Continued:
    """What a round takes over from the run that it belongs to.

    Attributes:
        ensemble: of the first round: whether a layout is out of its depth does not depend on what
            the refined model has learnt by heart.
        first: layouts [m], (n, D-1), that are tried before the search: the best known ones.
        avoid: layouts that need no verification any more.
    """

    ensemble: Ensemble
    first: Sequence[np.ndarray]
    avoid: Sequence[np.ndarray]


def check(run: Run) -> None:
    """Refuse, before anything is simulated, what could not be refined afterwards.

    Raises:
        SimulatorError: if the simulator is no learned model, or the reference solver's points or
            frames do not fit it.
    """
    s = run.settings
    if not is_learned(s.simulator):
        raise SimulatorError(
            f"--refine: the simulator {s.simulator.name!r} cannot be refined, only a learned model "
            "such as baffle-lite can"
        )
    if s.verifier.name != "mpm":
        raise SimulatorError(
            f"--refine: {s.verifier.name!r} cannot teach, only the reference solver (mpm) can"
        )
    config: Any = s.simulator.load().config  # type: ignore[attr-defined]
    solver: Any = s.verifier.load()
    fine = solver.chosen.spacing_of(run.problem.scene)
    for what, mine, theirs, unit in (
        ("spacing", config.spacing, fine, "m"),
        ("frame interval", config.dt, solver.chosen.frame_interval, "s"),
    ):
        ratio = mine / theirs
        if round(ratio) < 1 or abs(ratio - round(ratio)) > 0.01 * round(ratio):
            raise SimulatorError(
                f"--refine: the {what} of the reference solver, {theirs:g} {unit}, does not divide "
                f"that of {s.simulator.name}, {mine:g} {unit}"
            )
    if s.refine_data is not None:
        # The first file tells whether the folder is the right one; training looks at them all.
        read_source(training_files(s.refine_data)[0], spacing=config.spacing)


def refine(run: Run, store: RolloutStore, workers: Workers, watch: Watch) -> None:
    """All rounds of `run`; its ranking is of the layouts of all rounds then."""
    from design.run import Run

    s = run.settings
    spec = s.simulator
    known = [j for j in (*run.ranked, run.paper, run.none) if j is not None]
    for number in range(1, s.refine + 1):
        folder = run.out / f"refined-{number}"
        lesson = Lesson.of(run, folder, spec, [j for j in known if j.verified is not None])
        with run.timed(f"refine {number}"):
            refined = teach(run, lesson, store, watch)
        steps = lesson.spent()["steps"]
        if steps < FEW:
            run.note(
                f"{folder.name} was trained for {steps} steps only, and below {FEW} a model rather "
                "gets worse: give --refine-minutes more, or the machine less else to do"
            )
        inner = Run(
            run.problem.scene,
            folder,
            # A refined model is this worker's own, so its search is shared with nobody.
            replace(s, simulator=refined, refine=0, resume=True, storage=None),
            run.command,
            continued=Continued(
                run.ensemble,
                [j.centres for j in rank(known) if j.origin not in ("scene", "none")],
                [j.centres for j in known],
            ),
        )
        inner.open()
        searched, _ = judge(inner, store, workers, watch)
        # A resumed round reads what its search is relative to.
        run.kept |= {p.result().path for p in searched.pending}
        inner.write(COMPLETE)
        inner.close()
        found = [j for j in inner.ranked if not among(j.centres, [k.centres for k in known])]
        for judged in found:
            judged.model = folder.name
        run.models[folder.name] = refined
        run.rounds.append(_told(run, inner, lesson, known, found, store, watch))
        run.reference_rollouts += inner.candidate_rollouts
        run.ranked = rank([*run.ranked, *found])
        known += found
        spec = refined
        run.write(PARTIAL)


def _told(
    run: Run,
    inner: Run,
    lesson: Lesson,
    known: Sequence[Judged],
    found: Sequence[Judged],
    store: RolloutStore,
    watch: Watch,
) -> dict[str, Any]:
    """What summary.json says of a round."""
    taught = [j for j in known if j.verified is not None and among(j.centres, lesson.layouts)]
    new = [j for j in found if j.verified is not None]
    before, after = lesson.start, inner.settings.simulator
    by = {
        (spec, part): list(_seen_by(run, spec, judged, store, watch))
        for spec in (before, after)
        for part, judged in (("same", taught), ("new", new))
    }
    old = rank([j for j in known if j.verified is not None and j.origin != "none"])
    return {
        "model": lesson.folder.name,
        "from": Path(before.name).name,
        **lesson.spent(),
        **{
            part: {
                "layouts": sum(j.origin != "none" for j in judged),
                "before": gap(by[before, part]),
                "after": gap(by[after, part]),
            }
            for part, judged in (("same", taught), ("new", new))
        },
        "best_before": old[0].verified_cost if old else None,
        "best_found": rank(new)[0].verified_cost if new else None,
        "rollouts": inner.summary["rollouts"],
        "backwards": inner.summary["backwards"],
        "reference_rollouts": inner.candidate_rollouts,
    }


def _seen_by(
    run: Run, spec: SimulatorSpec, judged: Sequence[Judged], store: RolloutStore, watch: Watch
) -> Iterator[Judged]:
    """The layouts with the numbers of `spec` in place of those that they were found by."""
    problem = run.problem
    pending = [store.roll(spec, problem.laid_out(j), trajectory=False) for j in judged]
    bare = store.roll(spec, problem.laid_out(None), trajectory=False)
    waiting = [p for ps in (*pending, bare) for p in ps]
    watch.add(f"{Path(spec.name).name}: {count(len(judged), 'layout').lower()}", waiting)
    watch.wait(waiting)
    none = [p.result() for p in bare]
    for j, jobs in zip(judged, pending, strict=True):
        outcome = problem.weigh([p.result() for p in jobs], none)
        if outcome.status == "ok":
            yield replace(j, surrogate=dict(outcome.measures), cost=outcome.cost)

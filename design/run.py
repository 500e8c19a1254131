"""One run of a search, from a scene to a run folder; the whole of `gns-design optimize`.

    summary.json       what was found, in numbers; written again after every stage
    scene.toml         the scene that was given
    trials.csv         every trial; study.db holds the same as an Optuna study
    layouts/           best.toml, rank-2.toml, ...; best.stl and best.glb; with several objectives
                       front-01.toml, ... for every point of the Pareto front
    front.csv          with several objectives: the front as a table
    trajectories/      {best,paper,none}-{mpm,learned}.h5: by the reference solver and by the
                       simulator that searched
    rollouts/          what a rerun with --resume finds again
    refined-1/, ...    with --refine: the refined model and the search with it, see refine.py
    figures/, flow.gif, report.html

What is asked stands in problem.py, the stages between the folder and the report in stages.py, and
what summary.json says in record.py.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from design import refine, stages
from design.ensemble import Ensemble
from design.evaluators import differentiable
from design.folder import claim, release, same_scene
from design.front import write_front
from design.methods import choose
from design.problem import Problem
from design.record import record
from design.settings import Settings
from design.storage import StudyError, public, sqlite_url, storage_errors
from design.store import RolloutStore, Watch
from design.summary import COMPLETE, INTERRUPTED, write_layouts, write_summary, write_trials
from design.trials import TrialLog
from design.verify import Judged
from gns_model.console import progress_bar
from gns_model.scene import Scene
from gns_model.workers import Workers, default_count

if TYPE_CHECKING:
    from rich.progress import Progress

    from design.refine import Continued


#: For whoever loses a worker process.
ADVICE = "go on with --resume and fewer --workers"


def optimise(
    scene: Scene,
    out: str | os.PathLike[str],
    settings: Settings | None = None,
    *,
    command: Sequence[str] = (),
    quiet: bool = True,
) -> dict[str, Any]:
    """Search, verify, and write the run folder `out`.

    Args:
        command: the command line to quote in the report.
        quiet: no progress on stderr.

    Returns:
        what summary.json holds.

    Raises:
        GnsError: for what the user has to change; OSError: for what the machine has to. Whatever
            was finished stands in the run folder then, and `Settings.resume` goes on from it.
        Interrupted: on Ctrl-C, once there is a report of what there is.
    """
    run = Run(scene, Path(out), settings or Settings(), command)
    with storage_errors(run.storage):
        run.open()
        try:
            with progress_bar(quiet=quiet) as bar:
                try:
                    with Workers(run.workers, advice=ADVICE) as workers:
                        try:
                            run.simulate(workers, bar)
                        except BaseException:
                            with contextlib.suppress(Exception):  # the first error is to be told
                                run.write(INTERRUPTED)
                            raise
                except KeyboardInterrupt:
                    if not run.summary.get("best"):
                        raise
                    run.publish(bar, INTERRUPTED)  # a second interrupt ends this too
                    raise Interrupted(run.summary) from None
                run.publish(bar)
        finally:
            run.close()
    return run.summary


class Interrupted(KeyboardInterrupt):
    """A run that was ended; `summary` is what it had found, as summary.json has it."""

    def __init__(self, summary: dict[str, Any]) -> None:
        super().__init__()
        self.summary = summary


class Run:
    """The state of one run; `summary` is what it has so far.

    Attributes:
        problem: what is searched and verified.
        method: the search that was chosen.
        ranked: the layouts found, best first, verified once they are.
        paper, none: the scene's own layout, if it has one, and no baffles.
        ensemble: who says where the simulator is out of its depth; empty for nobody.
        continued: what a round of refinement takes over.
        models: the simulators that searched, by the name of their round; "" is the one given.
        rounds: what each round of refinement gave, as summary.json has it.
        kept: trajectories that are not deleted in the end, though nobody looks at them.
        candidate_rollouts, reference_rollouts: by the reference solver, of the layouts found and
            in all.
        notes: what a reader of the summary should know, in words.
        began, seconds: when it began, and what each stage took.
    """

    def __init__(
        self,
        scene: Scene,
        out: Path,
        settings: Settings,
        command: Sequence[str] = (),
        *,
        continued: Continued | None = None,
    ) -> None:
        self.began = time.perf_counter()
        self.out, self.settings, self.continued = out, settings, continued
        self.problem = Problem.of(scene, settings)
        self.notes = list(self.problem.notes)
        # An address may carry a password, which is no part of a report.
        given = settings.storage or ""
        self.command = [c.replace(given, public(given)) if given else c for c in command]
        self.ranked: list[Judged] = []
        self.paper: Judged | None = None
        self.none: Judged | None = None
        self.seconds: dict[str, float] = {}
        self.summary: dict[str, Any] = {}
        self.reference_rollouts = self.candidate_rollouts = 0
        self.rounds: list[dict[str, Any]] = []
        self.models = {"": settings.simulator}
        self.kept: set[Path] = set()
        self.method = choose(
            settings.method,
            differentiable(settings.simulator.load()),
            len(settings.parts),
            settings.simulator.name,
            settings.pattern,
        )
        self.ensemble = (
            continued.ensemble if continued else Ensemble.of(settings.simulator, settings.ensemble)
        )
        self.ensemble.check([self.problem.scene, *self.problem.flows])
        if settings.refine:
            refine.check(self)
        of_use = max(settings.batch, settings.verify + 2)
        self.workers = settings.workers or max(1, min(default_count(), of_use))
        self.storage = settings.storage or sqlite_url(out / "study.db")
        self._log: TrialLog | None = None
        self._lock: int | None = None

    @property
    def log(self) -> TrialLog:
        """The trials; `open` comes first."""
        if self._log is None:
            raise RuntimeError("the run is not open")
        return self._log

    def open(self) -> None:
        """Make or find the run folder and the study.

        Raises:
            StudyError: if there is a run already and it is not to be resumed, or of another task.
        """
        s = self.settings
        if not s.resume and (self.out / "summary.json").exists():
            raise StudyError(
                f"{self.out} already holds a run: go on with --resume, or choose another --out"
            )
        same_scene(self.out, self.problem.scene)
        new = not self.out.exists()
        if s.storage is None:
            self.out.mkdir(parents=True, exist_ok=True)
        try:
            if s.storage is None:
                self._lock = claim(self.out)
            self._log = TrialLog.open(
                self.storage,
                s.study,
                self.problem.space,
                self.problem.identity(),
                resume=s.resume,
                owned=s.storage is None,
                objectives=len(s.parts),
                grace=s.grace,
            )
            if s.storage is not None:  # a study that is refused leaves no folder
                self.out.mkdir(parents=True, exist_ok=True)
                self._lock = claim(self.out)
        except BaseException:
            if self._log is not None:
                self._log.close()
            if new:
                with contextlib.suppress(OSError):  # not empty
                    self.out.rmdir()
            raise
        if s.storage is not None and (there := len(self.log.trials())):
            self.note(f"joined the study {s.study!r}, which held {there} trials")
        self.problem.scene.to_toml(self.out / "scene.toml")

    def simulate(self, workers: Workers, bar: Progress) -> None:
        """Everything up to the numbers: search, verification, refinement, trajectories."""
        store, watch = RolloutStore(self.out, workers), Watch(bar)
        searched, verified = stages.judge(self, store, workers, watch)
        if self.settings.refine:
            refine.refine(self, store, workers, watch)
        with self.timed("trajectories"):
            stages.name_trajectories(self, store, searched, verified)
        self.write(COMPLETE)

    def publish(self, bar: Progress, status: str = COMPLETE) -> None:
        """Geometry, figures and report, from what stands in the run folder."""
        from design.geometry import write_geometry
        from design.report import write_report

        task = bar.add_task("report", total=1)
        with self.timed("report"):
            for best in self._found()[:1]:
                built = self.problem.built(self.problem.bare, best)
                write_geometry(built, self.out / "layouts", "best")
            write_report(self.out)
        bar.advance(task)
        self.write(status)

    def close(self) -> None:
        """Leave the study and the run folder to others."""
        self.log.close()
        release(self._lock)

    def write(self, status: str) -> None:
        """summary.json, trials.csv and layouts/ from what there is so far."""
        bare, space = self.problem.bare, self.problem.space
        ranked = self._found()
        self.summary = record(self, status, ranked)
        write_summary(self.out, self.summary)
        write_trials(self.out, self.log)
        write_layouts(self.out, bare, space, ranked)
        if self.settings.objectives:
            write_front(self.out, bare, self.summary["front"])

    def _found(self) -> list[Judged]:
        """The layouts found, best first; while nothing is verified, the search's best."""
        return self.ranked or stages.candidates(self, 1)

    def note(self, line: str) -> None:
        """Put a line on the notes of summary.json, once."""
        if line not in self.notes:
            self.notes.append(line)

    @contextlib.contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Write down what a stage takes."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = time.perf_counter() - started

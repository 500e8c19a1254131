"""One run of a search, from a scene to a run folder; the whole of `gns-design optimize`.

    summary.json       what was found, in numbers; written again after every stage
    scene.toml         the scene that was given
    trials.csv         every trial; study.db holds the same as an Optuna study
    layouts/           best.toml, rank-2.toml, ...; best.stl and best.glb
    trajectories/      {best,paper,none}-{mpm,learned}.h5: by the reference solver and by the
                       simulator that searched
    rollouts/          what a rerun with --resume finds again
    figures/, flow.gif, report.html

The reference solver starts on the scene without baffles and on its own layout while the search
goes on, in the same pool of one-thread processes.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import socket
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from design.campaign import Campaign, Evaluator
from design.evaluators import InProcess, InWorkers, KnownReference, SimulatorSpec, TaskSpec
from design.evaluators import differentiable as has_gradient
from design.methods import METHODS, choose
from design.settings import Settings
from design.store import Pending, Rolled, RolloutStore, Watch
from design.summary import (
    COMPLETE,
    INTERRUPTED,
    PARTIAL,
    results,
    versions,
    write_layouts,
    write_summary,
    write_trials,
)
from design.trials import Outcome, StudyError, Trial, TrialLog, sqlite_url, storage_errors
from design.verify import Judged, candidates, rank
from design.workers import Workers, default_count
from gns_env.layout import LayoutSpace
from gns_env.task import BaffleTask
from gns_model.console import progress_bar
from gns_model.errors import SimulatorError
from gns_model.particles import fill
from gns_model.scene import Scene

if TYPE_CHECKING:
    from rich.progress import Progress


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
    """
    run = Run(scene, Path(out), settings or Settings(), command)
    with storage_errors(run.storage):
        run.open()
        with progress_bar(quiet=quiet) as bar:
            with Workers(run.workers) as workers:
                try:
                    run.simulate(workers, bar)
                except BaseException:
                    with contextlib.suppress(Exception):  # the first error is the one to tell
                        run.write(INTERRUPTED)
                    raise
            run.publish(bar)
        run.log.close()
    return run.summary


class Run:
    """The state of one run; `summary` is what it has so far.

    Attributes:
        ranked: the layouts found, best first, verified once they are.
        paper, none: the scene's own layout, if it has one, and no baffles.
        seconds: spent on each stage.
    """

    def __init__(
        self, scene: Scene, out: Path, settings: Settings, command: Sequence[str] = ()
    ) -> None:
        self._began = time.perf_counter()
        self.scene, self.out, self.settings, self.command = scene, out, settings, list(command)
        self.ranked: list[Judged] = []
        self.paper: Judged | None = None
        self.none: Judged | None = None
        self.seconds: dict[str, float] = {}
        self.summary: dict[str, Any] = {}
        self.reference_rollouts = 0
        self.baffles = settings.baffles or len(scene.baffles) or 3
        self.space = LayoutSpace(scene, self.baffles)
        self.bare = scene.replace(baffles=(), placement=self.space.placement)
        self.notes = _check(scene, settings)
        self.method = choose(
            settings.method, has_gradient(settings.simulator.load()), 1, settings.simulator.name
        )
        of_use = max(settings.batch, settings.verify + 2)
        self.workers = settings.workers or max(1, min(default_count(), of_use))
        self.storage = settings.storage or sqlite_url(out / "study.db")
        self._log: TrialLog | None = None

    @property
    def log(self) -> TrialLog:
        """The trials; `open` comes first."""
        if self._log is None:
            raise RuntimeError("the run is not open")
        return self._log

    # -- stages --------------------------------------------------------------------------------

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
        self.out.mkdir(parents=True, exist_ok=True)
        task = {
            "scene": self.bare.to_dict(),
            "number of baffles": self.baffles,
            "objective": asdict(s.objective),
            "simulator": s.simulator.describe(),
        }
        # A storage that is shared holds many studies: the task tells them apart.
        digest = hashlib.sha256(json.dumps(task, sort_keys=True).encode()).hexdigest()[:8]
        name = f"{self.scene.name}-{digest}" if s.storage else "gns-design"
        self._log = TrialLog.open(
            self.storage, name, self.space, task, resume=s.resume, owned=s.storage is None
        )
        self.scene.to_toml(self.out / "scene.toml")

    def simulate(self, workers: Workers, bar: Progress) -> None:
        """Everything up to the numbers: search, verification, trajectories."""
        store = RolloutStore(self.out, workers)
        s = self.settings
        searched = self._references(store, s.simulator)
        verified = self._references(store, s.verifier) if s.verify else {}
        watch = Watch(bar)
        watch.add("search: no baffles, own layout", list(searched.values()))
        watch.add("verify: no baffles, own layout", list(verified.values()))

        with self._timed("search"):
            reference = self._take_in(searched, watch)
            self._search(workers, reference, watch)
        self.write(PARTIAL)
        with self._timed("verify"):
            if s.verify:
                self._verify(store, verified, watch)
            else:
                self.ranked = self._candidates(1)
        with self._timed("trajectories"):
            self._name_trajectories(store, searched, verified)
        self.write(COMPLETE)

    def publish(self, bar: Progress) -> None:
        """Geometry, figures and report, from what stands in the run folder."""
        from design.geometry import write_geometry
        from design.report import write_report

        task = bar.add_task("report", total=1)
        with self._timed("report"):
            if self.ranked:
                best = self.bare.with_baffles(self.ranked[0].centres)
                write_geometry(best, self.out / "layouts", "best")
            write_report(self.out)
        bar.advance(task)
        self.write(COMPLETE)

    def write(self, status: str) -> None:
        """summary.json, trials.csv and layouts/ from what there is so far."""
        s, trials = self.settings, self.log.trials()
        ranked = self.ranked or self._candidates(1)
        total = time.perf_counter() - self._began
        self.summary = {
            "status": status,
            **results(ranked, self.paper, self.none, trials, s.objective),
            "reference_rollouts": self.reference_rollouts,
            "seconds": {k: round(v, 2) for k, v in {**self.seconds, "total": total}.items()},
            "notes": self.notes,
            "command": self.command,
            "settings": {
                "scene": self.scene.name,
                "method": self.method,
                "baffles": self.baffles,
                "budget": s.budget,
                "verify": s.verify,
                "seed": s.seed,
                "batch": s.batch,
                "workers": self.workers,
                "simulator": {**s.simulator.describe(), "device": s.simulator.device},
                "verify_with": s.verifier.describe(),
                "objective": {**asdict(s.objective), "text": str(s.objective)},
                "storage": self.storage.rsplit("@", 1)[-1],
            },
            "versions": versions(),
        }
        write_summary(self.out, self.summary)
        write_trials(self.out, self.log)
        write_layouts(self.out, self.bare, ranked)

    # -- what the stages do --------------------------------------------------------------------

    def _references(self, store: RolloutStore, spec: SimulatorSpec) -> dict[str, Pending]:
        scenes = {"none": self.bare}
        if self.scene.baffles:
            scenes["paper"] = self.scene.replace(placement=self.space.placement)
        return {key: store.start(spec, scene) for key, scene in scenes.items()}

    def _take_in(self, searched: dict[str, Pending], watch: Watch) -> Rolled:
        """What the search's simulator says of no baffles and of the scene's own layout."""
        by = self.settings.objective
        watch.wait(list(searched.values()))
        none = searched["none"].result()
        if none.status != "ok":
            raise SimulatorError(
                f"the rollout of {self.settings.simulator.name} without baffles ended as "
                f"{none.status!r}, so no cost can be relative to it"
            )
        empty = np.zeros((0, self.scene.dim - 1))
        cost = by.cost(none.measures, none.measures)
        self.none = Judged("none", empty, none.measures, cost)
        if "paper" in searched:
            own = searched["paper"].result()
            ok = own.status == "ok"
            self.paper = Judged(
                "scene",
                np.array([baffle.center for baffle in self.scene.baffles], dtype=float),
                own.measures if ok else {},
                by.cost(own.measures, none.measures) if ok else by.failure_cost,
            )
            self._log_own_layout(own)
        return none

    def _log_own_layout(self, rolled: Rolled) -> None:
        """The scene's own layout is a trial too, where the search could have proposed it."""
        own = self.paper
        assert own is not None and own.cost is not None  # noqa: PT018
        same_size = all(np.allclose(b.size, self.space.size) for b in self.scene.baffles)
        if len(own.centres) != self.baffles or not same_size or self.space.check(own.centres):
            return
        if not any(trial.origin == "scene" for trial in self.log.trials()):
            outcome = Outcome(own.cost, own.surrogate, rolled.status, seconds=rolled.seconds)
            self.log.add("scene", own.centres, outcome)

    def _search(self, workers: Workers, reference: Rolled, watch: Watch) -> None:
        s, log = self.settings, self.log
        best = log.best()
        lowest = best.cost if best else float("inf")
        bar = watch.bar
        task = bar.add_task(f"search: {self.method}", total=s.budget, completed=log.spent())

        def on_trial(trial: Trial) -> None:
            nonlocal lowest
            lowest = min(lowest, trial.cost)
            bar.update(task, description=f"search: {self.method}, best {lowest:.4f}")
            bar.advance(task, trial.outcome.rollouts + trial.outcome.backwards)

        METHODS[self.method](
            Campaign(
                log=log,
                evaluator=self._evaluator(workers, reference.path, watch),
                budget=s.budget,
                seed=s.seed,
                batch=s.batch,
                on_trial=on_trial,
                salt=_salt() if s.storage else 0,
            )
        )

    def _evaluator(self, workers: Workers, reference: Path, watch: Watch) -> Evaluator:
        s = self.settings
        if s.simulator.device != "cpu":
            simulator = KnownReference(s.simulator.load(), reference)
            return InProcess(
                BaffleTask(self.bare, simulator, n_baffles=self.baffles, objective=s.objective)
            )
        spec = TaskSpec.of(self.bare, self.baffles, s.objective, s.simulator, reference)
        return InWorkers(workers, spec, watch.update)

    def _candidates(self, count: int) -> list[Judged]:
        # Closer than a third of a baffle is one design.
        least = float(min(self.space.size[[0, *range(2, self.scene.dim)]])) / 3
        own = [] if self.paper is None else [self.paper.centres]
        return candidates(self.log.trials(), count, least, avoid=own)

    def _verify(self, store: RolloutStore, references: dict[str, Pending], watch: Watch) -> None:
        s = self.settings
        chosen = self._candidates(s.verify)
        scenes = [self.bare.with_baffles(judged.centres) for judged in chosen]
        pending = [store.start(s.verifier, scene, trajectory=False) for scene in scenes]
        watch.add(f"verify: best {len(chosen)}", pending)
        watch.wait([*references.values(), *pending])
        none = references["none"].result()
        if none.status != "ok":
            raise SimulatorError(
                f"the reference rollout without baffles ended as {none.status!r}: nothing can be "
                "verified"
            )
        judged = [(self.none, references["none"]), (self.paper, references.get("paper"))]
        for layout, job in (*judged, *zip(chosen, pending, strict=True)):
            if layout is not None and job is not None:
                done = job.result()
                layout.judge(done.status, done.measures, none.measures, s.objective)
        self.reference_rollouts = len(pending) + len(references)
        self.ranked = rank(chosen)

    def _name_trajectories(
        self,
        store: RolloutStore,
        searched: dict[str, Pending],
        verified: dict[str, Pending],
    ) -> None:
        s = self.settings
        roles = {"learned": (s.simulator, dict(searched)), "mpm": (s.verifier, dict(verified))}
        if self.ranked:
            best = self.bare.with_baffles(self.ranked[0].centres)
            for spec, pending in roles.values():
                if pending:
                    pending["best"] = store.start(spec, best)
        named = set()
        for role, (_, pending) in roles.items():
            for key, job in pending.items():
                rolled = job.result()
                store.name(rolled, f"{key}-{role}")
                named.add(rolled.path)
        store.prune(named)

    @contextlib.contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = time.perf_counter() - started


def _check(scene: Scene, settings: Settings) -> list[str]:
    """Refuse what the simulators cannot run; return what they warn of."""
    notes = []
    for spec in (settings.simulator, *([settings.verifier] if settings.verify else [])):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            simulator = spec.load()
            simulator.check(scene)
            spacing = getattr(simulator, "spacing", None)
            if spacing is not None:
                fill(scene, spacing)  # a release thinner than that: say so before the search
        notes += [str(warning.message) for warning in caught]
    return notes


def _salt() -> int:
    """A number of this process, for the random numbers of searches that share a study."""
    place = f"{socket.gethostname()}-{os.getpid()}"
    return int.from_bytes(hashlib.sha256(place.encode()).digest()[:4], "big")

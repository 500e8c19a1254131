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
import importlib.metadata
import json
import os
import platform
import socket
import time
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from design import bayes, gradient, hybrid
from design.campaign import Campaign, Evaluator, Search
from design.evaluators import InProcess, InWorkers, KnownReference, SimulatorSpec, TaskSpec
from design.evaluators import differentiable as has_gradient
from design.store import Pending, Rolled, RolloutStore
from design.trials import Outcome, StudyError, Trial, TrialLog, sqlite_url, storage_errors
from design.verify import Judged, candidates, gap, rank, verdict
from design.workers import Workers, as_completed, default_count
from gns_env.layout import LayoutSpace
from gns_env.objective import Objective
from gns_env.task import BaffleTask
from gns_model.console import progress_bar
from gns_model.errors import GnsError, SimulatorError
from gns_model.scene import Scene, write_whole

if TYPE_CHECKING:
    from rich.progress import Progress

METHODS: dict[str, Search] = {
    "bayes": bayes.search,
    "gradient": gradient.search,
    "hybrid": hybrid.search,
}


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What can be chosen about a run.

    Attributes:
        method: "bayes", "gradient" or "hybrid"; None: hybrid where the simulator has a gradient.
        baffles: how many; None: as many as the scene has, or 3.
        budget: passes through a rollout that the search may spend.
        verify: how many of the best layouts the reference solver judges; 0: none at all.
        seed: of everything random.
        simulator, verifier: who searches and who judges.
        objective: what to make small.
        storage: Optuna storage address; None: SQLite in the run folder.
        resume: go on with what the run folder and the storage hold.
        workers: processes of one thread; None: one a core, as many as are of use.
        batch: layouts proposed at a time.
    """

    method: str | None = None
    baffles: int | None = None
    budget: int = 64
    verify: int = 4
    seed: int = 0
    simulator: SimulatorSpec = SimulatorSpec("baffle-lite")
    verifier: SimulatorSpec = SimulatorSpec("mpm")
    objective: Objective = Objective()
    storage: str | None = None
    resume: bool = False
    workers: int | None = None
    batch: int = 8

    def __post_init__(self) -> None:
        for name, least in (("budget", 1), ("verify", 0), ("batch", 1), ("seed", 0)):
            value = getattr(self, name)
            if value < least:
                raise GnsError(f"{name} must be {least} or more, got {value}")
        if self.workers is not None and self.workers < 1:
            raise GnsError(f"workers must be 1 or more, got {self.workers}")
        if self.method is not None and self.method not in METHODS:
            raise GnsError(f"no method {self.method!r}: give {', '.join(METHODS)}")


def optimise(
    scene: Scene, out: str | os.PathLike[str], settings: Settings | None = None, *, quiet: bool = True
) -> dict[str, Any]:
    """Search, verify, and write the run folder `out`.

    Returns:
        what summary.json holds.

    Raises:
        GnsError: for what the user has to change; OSError: for what the machine has to.
            Whatever was finished is in the run folder then, and `resume` goes on from it.
    """
    run = Run(scene, Path(out), settings or Settings())
    with storage_errors(run.storage):
        with progress_bar(quiet=quiet) as bar, Workers(run.workers) as workers:
            try:
                run.go(workers, bar)
            except BaseException:
                with contextlib.suppress(OSError, GnsError):
                    run.write(complete=False)
                raise
        run.publish()
    return run.summary


@dataclass
class Run:
    """The state of one run; `summary` is what it has so far."""

    scene: Scene
    out: Path
    settings: Settings
    ranked: list[Judged] = field(default_factory=list)
    paper: Judged | None = None
    none: Judged | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    summary: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        s = self.settings
        self.began = time.perf_counter()
        self.n = s.baffles if s.baffles is not None else (len(self.scene.baffles) or 3)
        self.space = LayoutSpace(self.scene, self.n)
        self.bare = self.scene.replace(baffles=(), placement=self.space.placement)
        self.notes: list[str] = []
        for spec in (s.simulator, s.verifier) if s.verify else (s.simulator,):
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                spec.load().check(self.scene)
            self.notes += [str(w.message) for w in caught]
        able = has_gradient(s.simulator.load())
        self.method = s.method or ("hybrid" if able else "bayes")
        if self.method != "bayes" and not able:
            raise SimulatorError(
                f"the simulator {s.simulator.name!r} has no gradient, so --method {self.method} "
                "cannot use it: choose a learned simulator such as baffle-lite, or --method bayes"
            )
        of_use = max(s.batch, s.verify + 2)
        self.workers = s.workers or max(1, min(default_count(), of_use))
        self.storage = s.storage or sqlite_url(self.out / "study.db")
        self.log: TrialLog | None = None
        self.reference_rollouts = 0

    # -- stages --------------------------------------------------------------------------------

    def go(self, workers: Workers, bar: Progress) -> None:
        """Everything up to the numbers: search, verification, trajectories, summary."""
        self._open()
        store = RolloutStore(self.out, workers)
        s = self.settings
        searched = self._start_references(store, s.simulator)
        verified = self._start_references(store, s.verifier) if s.verify else {}
        watched = _Watch(bar, "verify: no baffles, own layout", list(verified.values()))

        with self._timed("search"):
            reference = self._finish(searched["none"], watched, bar)
            self.none = self._judged("none", reference, None)
            if "paper" in searched:
                rolled = self._finish(searched["paper"], watched, bar)
                self.paper = self._judged("scene", rolled, reference)
                self._log_own_layout(rolled)
            self._search(workers, reference, watched, bar)
            self.write(complete=False)
        if s.verify:
            with self._timed("verify"):
                self._verify(store, verified, watched, bar)
        else:
            self.ranked = self._candidates(1)
        with self._timed("trajectories"):
            self._name_trajectories(store, searched, verified)
        self.write(complete=True)

    def publish(self) -> None:
        """Geometry, figures and report, from what stands in the run folder."""
        from design.geometry import write_geometry
        from design.report import write_report

        with self._timed("report"):
            if self.ranked:
                best = self.bare.with_baffles(self.ranked[0].centres)
                write_geometry(best, self.out / "layouts", "best")
            write_report(self.out)
        self.write(complete=True)

    def _open(self) -> None:
        s = self.settings
        if not s.resume and (self.out / "summary.json").exists():
            raise StudyError(
                f"{self.out} already holds a run: go on with --resume, or choose another --out"
            )
        self.out.mkdir(parents=True, exist_ok=True)
        self.scene.to_toml(self.out / "scene.toml")
        task = {
            "scene": self.bare.to_dict(),
            "number of baffles": self.n,
            "objective": asdict(s.objective),
            "simulator": s.simulator.describe(),
        }
        # A storage that is shared holds many studies: the task tells them apart.
        digest = hashlib.sha256(json.dumps(task, sort_keys=True).encode()).hexdigest()[:8]
        name = f"{self.scene.name}-{digest}" if s.storage else "gns-design"
        self.log = TrialLog.open(
            self.storage, name, self.space, task, resume=s.resume, owned=s.storage is None
        )

    def _start_references(self, store: RolloutStore, spec: SimulatorSpec) -> dict[str, Pending]:
        scenes = {"none": self.bare}
        if self.scene.baffles:
            scenes["paper"] = self.scene.replace(placement=self.space.placement)
        return {key: store.start(spec, scene) for key, scene in scenes.items()}

    def _finish(self, pending: Pending, watched: _Watch, bar: Progress) -> Rolled:
        if pending.job is not None:
            task = bar.add_task("search: no baffles, own layout", total=1.0)
            for _ in as_completed(
                [pending.job],
                lambda: (watched(), bar.update(task, completed=pending.fraction))[0],
            ):
                pass
            bar.remove_task(task)
        return pending.result()

    def _judged(self, origin: str, rolled: Rolled, reference: Rolled | None) -> Judged:
        """A rollout by the search's simulator of a layout that it did not propose."""
        by = self.settings.objective
        if rolled.status != "ok" and reference is None:
            raise SimulatorError(
                f"the rollout of {self.settings.simulator.name} without baffles ended as "
                f"{rolled.status!r}, so no cost can be relative to it"
            )
        against = reference.measures if reference else rolled.measures
        ok = rolled.status == "ok"
        cost = by.cost(rolled.measures, against) if ok else by.failure_cost
        centres = [] if origin == "none" else [b.center for b in self.scene.baffles]
        return Judged(
            origin,
            np.array(centres, dtype=float).reshape(-1, self.scene.dim - 1),
            rolled.measures if ok else {},
            cost,
        )

    def _log_own_layout(self, rolled: Rolled) -> None:
        """The scene's own layout is a trial too, where the search could have proposed it."""
        assert self.log is not None and self.paper is not None and self.paper.cost is not None
        own = self.paper
        same_size = all(np.allclose(b.size, self.space.size) for b in self.scene.baffles)
        if len(own.centres) != self.n or not same_size or self.space.check(own.centres):
            return
        if any(t.origin == "scene" for t in self.log.trials()):
            return
        outcome = Outcome(own.cost, own.surrogate, rolled.status, seconds=rolled.seconds)
        self.log.add("scene", own.centres, outcome)

    def _search(
        self, workers: Workers, reference: Rolled, watched: _Watch, bar: Progress
    ) -> None:
        assert self.log is not None
        s, log = self.settings, self.log
        task = bar.add_task(f"search: {self.method}", total=s.budget, completed=log.spent())
        best = log.best()
        lowest = best.cost if best else float("inf")

        def on_trial(trial: Trial) -> None:
            nonlocal lowest
            lowest = min(lowest, trial.cost)
            spent = trial.outcome.rollouts + trial.outcome.backwards
            bar.update(task, description=f"search: {self.method}, best {lowest:.4f}")
            bar.advance(task, spent)

        METHODS[self.method](
            Campaign(
                log=log,
                evaluator=self._evaluator(workers, reference.path, watched),
                budget=s.budget,
                seed=s.seed,
                batch=s.batch,
                on_trial=on_trial,
                salt=_salt() if s.storage else 0,
            )
        )

    def _evaluator(self, workers: Workers, reference: Path, watched: _Watch) -> Evaluator:
        s = self.settings
        if s.simulator.device != "cpu":
            simulator = KnownReference(s.simulator.load(), reference)
            return InProcess(
                BaffleTask(self.bare, simulator, n_baffles=self.n, objective=s.objective)
            )
        spec = TaskSpec.of(self.bare, self.n, s.objective, s.simulator, reference)
        return InWorkers(workers, spec, watched)

    def _candidates(self, count: int) -> list[Judged]:
        assert self.log is not None
        # Closer than a third of a baffle is one design.
        least = float(min(self.space.size[[0, *range(2, self.scene.dim)]])) / 3
        own = [] if self.paper is None else [self.paper.centres]
        return candidates(self.log.trials(), count, least, avoid=own)

    def _verify(
        self,
        store: RolloutStore,
        references: dict[str, Pending],
        watched: _Watch,
        bar: Progress,
    ) -> None:
        s = self.settings
        chosen = self._candidates(s.verify)
        pending = [
            store.start(s.verifier, self.bare.with_baffles(j.centres), trajectory=False)
            for j in chosen
        ]
        watched.add(f"verify: best {len(chosen)}", pending)
        jobs = [p.job for p in (*references.values(), *pending) if p.job is not None]
        for _ in as_completed(jobs, watched):
            pass
        rolled = references["none"].result()
        if rolled.status != "ok":
            raise SimulatorError(
                f"the reference rollout without baffles ended as {rolled.status!r}: nothing can be "
                "verified"
            )
        reference = rolled.measures
        assert self.none is not None
        self.none.judge(rolled.status, rolled.measures, reference, s.objective)
        if self.paper is not None and "paper" in references:
            own = references["paper"].result()
            self.paper.judge(own.status, own.measures, reference, s.objective)
        for judged, job in zip(chosen, pending, strict=True):
            done = job.result()
            judged.judge(done.status, done.measures, reference, s.objective)
        self.reference_rollouts = len(pending) + len(references)
        self.ranked = rank(chosen)

    def _name_trajectories(
        self,
        store: RolloutStore,
        searched: dict[str, Pending],
        verified: dict[str, Pending],
    ) -> None:
        s = self.settings
        searched, verified = dict(searched), dict(verified)
        if self.ranked:
            best = self.bare.with_baffles(self.ranked[0].centres)
            searched["best"] = store.start(s.simulator, best)
            if s.verify:
                verified["best"] = store.start(s.verifier, best)
        named: set[Path] = set()
        for role, pendings in (("learned", searched), ("mpm", verified)):
            for key, pending in pendings.items():
                rolled = pending.result()
                store.name(rolled, f"{key}-{role}")
                named.add(rolled.path)
        store.prune(named)

    # -- what is written -----------------------------------------------------------------------

    def write(self, *, complete: bool) -> None:
        """summary.json, trials.csv and layouts/ from what there is so far."""
        trials = self.log.trials() if self.log is not None else []
        ranked = self.ranked or (self._candidates(1) if trials else [])
        best = ranked[0] if ranked else None
        baseline = self.settings.objective.baseline
        word, sentence = verdict(best, self.paper, baseline)
        self.summary = {
            "complete": complete,
            "verdict": word,
            "verdict_text": sentence,
            "best": best.as_dict() if best else None,
            "paper_layout": _flat(self.paper),
            "no_baffles": _flat(self.none),
            "ranked": [j.as_dict() for j in ranked],
            "gap": gap([j for j in (*ranked, self.paper, self.none) if j is not None]),
            "rollouts": sum(t.outcome.rollouts for t in trials),
            "backwards": sum(t.outcome.backwards for t in trials),
            "reference_rollouts": self.reference_rollouts,
            "failed": sum(not t.ok for t in trials),
            "seconds": {
                **{k: round(v, 2) for k, v in self.seconds.items()},
                "total": round(time.perf_counter() - self.began, 2),
            },
            "notes": self.notes,
            "settings": self._settings(),
            "versions": _versions(),
        }
        text = json.dumps(self.summary, indent=2, allow_nan=False)
        write_whole(self.out / "summary.json", text.encode())
        if self.log is not None:
            self.log.write_csv(self.out / "trials.csv")
        layouts = self.out / "layouts"
        layouts.mkdir(exist_ok=True)
        for k, judged in enumerate(ranked, start=1):
            name = "best.toml" if k == 1 else f"rank-{k}.toml"
            self.bare.with_baffles(judged.centres).to_toml(layouts / name)
        for stale in layouts.glob("rank-*.toml"):
            if int(stale.stem.removeprefix("rank-")) > len(ranked):
                stale.unlink()

    def _settings(self) -> dict[str, Any]:
        s = self.settings
        return {
            "scene": self.scene.name,
            "method": self.method,
            "baffles": self.n,
            "budget": s.budget,
            "verify": s.verify,
            "seed": s.seed,
            "batch": s.batch,
            "workers": self.workers,
            "simulator": {**s.simulator.describe(), "device": s.simulator.device},
            "verify_with": s.verifier.describe(),
            "objective": {**asdict(s.objective), "text": str(s.objective)},
            "storage": self.storage.rsplit("@", 1)[-1],
        }

    @contextlib.contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = time.perf_counter() - started


class _Watch:
    """Shows how far rollouts in workers are; called now and then by whoever waits."""

    def __init__(self, bar: Progress, title: str, pending: list[Pending]) -> None:
        self._bar, self._shown = bar, []
        self.add(title, pending)

    def add(self, title: str, pending: list[Pending]) -> None:
        running = [p for p in pending if p.job is not None]
        if running:
            self._shown.append((self._bar.add_task(title, total=len(running)), running))

    def __call__(self) -> None:
        for task, pending in self._shown:
            self._bar.update(task, completed=sum(p.fraction for p in pending))


def _flat(judged: Judged | None) -> dict[str, Any] | None:
    """Verified measures, with what else is known of the layout beside them."""
    return None if judged is None else {**(judged.verified or {}), **judged.as_dict()}


def _salt() -> int:
    """A number of this process, for the random numbers of searches that share a study."""
    place = f"{socket.gethostname()}-{os.getpid()}"
    return int.from_bytes(hashlib.sha256(place.encode()).digest()[:4], "big")


def _versions() -> dict[str, str]:
    names = ("gns", "torch", "numpy", "numba", "optuna", "cvxpy")
    versions = {"python": platform.python_version(), "machine": platform.machine()}
    for name in names:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions

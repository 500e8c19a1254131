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

The reference solver starts on the scene without baffles and on its own layout while the search
goes on, in the same pool of one-thread processes.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from design import refine
from design.campaign import Campaign, Evaluator
from design.constraints import constraints, to_blame
from design.distinct import among
from design.ensemble import POOL, Ensemble, Panel, beyond_limits
from design.evaluators import InProcess, InWorkers, SimulatorSpec, TaskSpec, failure_cost
from design.evaluators import differentiable as has_gradient
from design.folder import claim, release, same_scene
from design.front import front_entries, relative, write_front
from design.methods import METHODS, choose
from design.pareto import front, spread
from design.risk import Flow, weigh
from design.rows import RowSpace
from design.rules import Rules
from design.scenarios import Scenarios, scenes, widest
from design.settings import Settings
from design.space import DesignSpace, Form, Space, built, design_space, form_of, numbers, split
from design.storage import StudyError, public, sqlite_url, storage_errors
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
from design.trials import Outcome, Trial, TrialLog, worker
from design.verify import Judged, as_judged, candidates, rank
from design.workers import Workers, default_count
from gns_env.scenario import Scenario
from gns_model.console import progress_bar
from gns_model.errors import SceneError, SimulatorError
from gns_model.particles import fill
from gns_model.scene import Scene

if TYPE_CHECKING:
    from rich.progress import Progress

    from design.refine import Continued


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
        try:
            with progress_bar(quiet=quiet) as bar:
                with Workers(run.workers) as workers:
                    try:
                        run.simulate(workers, bar)
                    except BaseException:
                        with contextlib.suppress(Exception):  # the first error is the one to tell
                            run.write(INTERRUPTED)
                        raise
                run.publish(bar)
        finally:
            run.close()
    return run.summary


class Run:
    """The state of one run; `summary` is what it has so far.

    Attributes:
        ranked: the layouts found, best first, verified once they are.
        ensemble: who says where the simulator is out of its depth; empty for nobody.
        models: the simulators that searched, by the name of their round; "" is the one given.
        rounds: what each round of refinement gave, as summary.json has it.
        kept: trajectories that are not deleted in the end, though nobody looks at them.
        paper, none: the scene's own layout, if it has one, and no baffles.
        seconds: spent on each stage.
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
        self._began = time.perf_counter()
        scene = settings.applied(scene)
        self.scene, self.out, self.settings = scene, out, settings
        # An address may carry a password, which is no part of a report.
        given = settings.storage or ""
        self.command = [c.replace(given, public(given)) if given else c for c in command]
        self.ranked: list[Judged] = []
        self.paper: Judged | None = None
        self.none: Judged | None = None
        self.seconds: dict[str, float] = {}
        self.summary: dict[str, Any] = {}
        self.reference_rollouts = self.candidate_rollouts = 0
        self.continued = continued
        self.rounds: list[dict[str, Any]] = []
        self.models = {"": settings.simulator}
        self.kept: set[Path] = set()
        self.drawn: list[Scenario] = []
        self.notes: list[str] = []
        flows = [scene.with_baffles([])]
        if settings.scenarios:
            self.drawn, self.notes = settings.scenarios.draw(scene, settings.simulator.load())
            flows = scenes(flows[0], self.drawn)
        # What is clear of the largest release is clear of all. A scene without a placement keeps
        # its baffles here, for they say how large one is.
        largest = widest(flows)
        if scene.placement is None:
            largest = largest.replace(baffles=scene.baffles)
        else:
            own = {"size": scene.baffle_size, "yaw": scene.baffle_yaw or None}
            largest = largest.replace(placement=scene.placement.model_copy(update=own))
        asked = settings.baffles or len(scene.baffles) or 3
        rows = settings.pattern == "rows"
        self.space: Space = RowSpace(largest, asked) if rows else design_space(largest, asked)
        #: How many; where the number varies, the one to begin with.
        self.baffles = self.space.n_baffles
        #: The scene without baffles, and each flow on it that a layout has to stand.
        self.bare = scene.replace(baffles=(), placement=self.space.placement)
        self.flows = [flow.replace(placement=self.space.placement) for flow in flows]
        self.rules = Rules.of(self.bare, settings.baffle_cost, settings.concrete_cost)
        if isinstance(self.space, DesignSpace):
            self.notes += self.space.notes
        self.notes += _check([scene, *self.flows] if self.drawn else [scene], settings)
        self.method = choose(
            settings.method,
            has_gradient(settings.simulator.load()),
            len(settings.parts),
            settings.simulator.name,
            settings.pattern,
        )
        of_use = max(settings.batch, settings.verify + 2)
        self.ensemble = (
            continued.ensemble if continued else Ensemble.of(settings.simulator, settings.ensemble)
        )
        self.ensemble.check([scene, *self.flows])
        if settings.refine:
            refine.check(self)
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
        task: dict[str, Any] = {
            "scene": self.bare.to_dict(),
            "number of baffles": self.baffles,
            "objective": asdict(s.objective),
            "simulator": s.simulator.describe(),
        }
        if s.objectives:
            task["set of objectives"] = list(s.objectives)
        if s.pattern != "free":
            task["pattern"] = s.pattern
        if self.rules.charges:
            task["price"] = [s.baffle_cost, s.concrete_cost]
        if s.scenarios:
            task["set of scenarios"] = [asdict(flow) for flow in self.drawn]
            task["risk"] = asdict(s.risk)
        same_scene(self.out, self.scene)
        new = not self.out.exists()
        if s.storage is None:
            self.out.mkdir(parents=True, exist_ok=True)
        try:
            if s.storage is None:
                self._lock = claim(self.out)
            self._log = TrialLog.open(
                self.storage,
                s.study,
                self.space,
                task,
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
        self.scene.to_toml(self.out / "scene.toml")

    def simulate(self, workers: Workers, bar: Progress) -> None:
        """Everything up to the numbers: search, verification, trajectories."""
        store, watch = RolloutStore(self.out, workers), Watch(bar)
        searched, verified = self.judge(store, workers, watch)
        if self.settings.refine:
            refine.refine(self, store, workers, watch)
        with self.timed("trajectories"):
            self._name_trajectories(store, searched, verified)
        self.write(COMPLETE)

    def judge(
        self, store: RolloutStore, workers: Workers, watch: Watch
    ) -> tuple[dict[str, list[Pending]], dict[str, list[Pending]]]:
        """Search and verify.

        Returns:
            rollouts of no baffles and of the scene's own layout, by the simulator that searched and
            by the reference solver.
        """
        s = self.settings
        searched = self._references(store, s.simulator)
        verified = self._references(store, s.verifier) if s.verify else {}
        watch.add("search: no baffles, own layout", [p for ps in searched.values() for p in ps])
        watch.add("verify: no baffles, own layout", [p for ps in verified.values() for p in ps])

        panel = self._panel(store, watch) if self.ensemble and s.verify else None

        with self.timed("search"):
            references = self._take_in(searched, watch)
            self._search(workers, references, watch)
        self.write(PARTIAL)
        with self.timed("verify"):
            if s.verify:
                self._verify(store, verified, panel, watch)
            else:
                self.ranked = rank(self._candidates(1))
        self.write(PARTIAL)
        return searched, verified

    def publish(self, bar: Progress) -> None:
        """Geometry, figures and report, from what stands in the run folder."""
        from design.geometry import write_geometry
        from design.report import write_report

        task = bar.add_task("report", total=1)
        with self.timed("report"):
            if self.ranked:
                best = self.built(self.bare, self.ranked[0])
                write_geometry(best, self.out / "layouts", "best")
            write_report(self.out)
        bar.advance(task)
        self.write(COMPLETE)

    def close(self) -> None:
        """Leave the study and the run folder to others."""
        self.log.close()
        release(self._lock)

    def write(self, status: str) -> None:
        """summary.json, trials.csv and layouts/ from what there is so far."""
        s, trials = self.settings, self.log.trials()
        ranked = self.ranked or self._candidates(1)
        total = time.perf_counter() - self._began
        self.summary = {
            "status": status,
            **results(ranked, self.paper, self.none, trials, s.objective),
            **self._kept(ranked, trials),
            **self._several(trials),
            **({"ensemble": self.ensemble.describe()} if self.ensemble else {}),
            **({"refined": self.rounds} if s.refine else {}),
            "reference_rollouts": self.reference_rollouts,
            "seconds": {k: round(v, 2) for k, v in {**self.seconds, "total": total}.items()},
            "notes": self.notes,
            "command": self.command,
            "settings": {
                "scene": self.scene.name,
                "method": self.method,
                "baffles": self.baffles,
                "budget": s.passes,
                "verify": s.verify,
                "seed": s.seed,
                "batch": s.batch,
                "workers": self.workers,
                "simulator": {**s.simulator.describe(), "device": s.simulator.device},
                "verify_with": s.verifier.describe(),
                "objective": {**asdict(s.objective), "text": self._objective_text()},
                **({"objectives": ",".join(s.objectives)} if s.objectives else {}),
                **_freed(s),
                **({"scenarios": _described(s.scenarios)} if s.scenarios else {}),
                **_trusted(s),
                "storage": public(self.storage),
                "study": s.study,
            },
            "versions": versions(),
        }
        for spent in ("rollouts", "backwards"):
            self.summary[spent] += sum(told[spent] for told in self.rounds)
        write_summary(self.out, self.summary)
        write_trials(self.out, self.log)
        write_layouts(self.out, self.bare, self.space, ranked)
        if s.objectives:
            write_front(self.out, self.bare, self.summary["front"])

    def _several(self, trials: Sequence[Trial]) -> dict[str, Any]:
        """What summary.json says of several objectives and of several flows."""
        s = self.settings
        found: dict[str, Any] = {}
        if s.objectives:
            found["objectives"] = [str(part) for part in s.parts]
            found["front"] = front_entries(
                front(trials), s.parts, s.objectives, self.ranked, self.space
            )
            found["tried"] = [
                relative(t.outcome.costs, s.parts, s.objectives) for t in trials if t.ok
            ]
        if s.scenarios:
            found["risk"] = str(s.risk)
            found["scenarios"] = [asdict(flow) for flow in self.drawn]
        return found

    # -- what the stages do --------------------------------------------------------------------

    def _references(self, store: RolloutStore, spec: SimulatorSpec) -> dict[str, list[Pending]]:
        """Rollouts of no baffles and of the scene's own layout, one in each flow."""
        alone = not self.drawn
        found = {}
        found["none"] = [
            store.start(spec, flow, trajectory=alone or spec == self.settings.simulator)
            for flow in self.flows
        ]
        if self.scene.baffles:
            try:
                own = [self._own(flow) for flow in self.flows]
            except SceneError as error:
                self.note(f"the scene's own layout does not stand in every scenario: {error}")
            else:
                found["paper"] = [store.start(spec, flow, trajectory=alone) for flow in own]
        return found

    def _own(self, flow: Scene) -> Scene:
        """A flow with the scene's own layout.

        Raises:
            SceneError: if a release of the flow reaches a baffle.
        """
        return flow.replace(baffles=self.scene.baffles)

    def roll(
        self,
        store: RolloutStore,
        spec: SimulatorSpec,
        layout: Judged | None,
        *,
        trajectory: bool = False,
    ) -> list[Pending]:
        """Start the rollouts of a layout (None: no baffles) by `spec`, one in each flow."""
        if layout is None or layout.origin == "none":
            flows = self.flows
        elif layout.origin == "scene":
            flows = [self._own(flow) for flow in self.flows]
        else:
            flows = [self.built(flow, layout) for flow in self.flows]
        return [store.start(spec, flow, trajectory=trajectory) for flow in flows]

    def _panel(self, store: RolloutStore, watch: Watch) -> Panel:
        return Panel(
            self.ensemble,
            self.settings.simulator,
            lambda spec, layout: self.roll(store, spec, layout),
            self.weigh,
            watch,
        )

    def note(self, line: str) -> None:
        """Put a line on the notes of summary.json, once."""
        if line not in self.notes:
            self.notes.append(line)

    def weigh(self, rolled: Sequence[Rolled], none: Sequence[Rolled]) -> Outcome:
        """One layout in all flows, relative to no baffles in each."""
        s = self.settings
        flows = [
            Flow.of(r.status, r.measures, n.measures, s.parts, self.rules, r.sizes)
            for r, n in zip(rolled, none, strict=True)
        ]
        return weigh(flows, s.risk, failure_cost(s.parts))

    def _take_in(self, searched: dict[str, list[Pending]], watch: Watch) -> list[Rolled]:
        """What the search's simulator says of no baffles and of the scene's own layout."""
        watch.wait([p for pending in searched.values() for p in pending])
        none = [p.result() for p in searched["none"]]
        for rolled in none:
            if rolled.status != "ok":
                raise SimulatorError(
                    f"the rollout of {self.settings.simulator.name} without baffles ended as "
                    f"{rolled.status!r}, so no cost can be relative to it"
                )
        empty = np.zeros((0, self.scene.dim - 1))
        self.none = as_judged(Trial(-1, "none", empty, self.weigh(none, none)))
        if "paper" in searched:
            own = [p.result() for p in searched["paper"]]
            centres = np.array([baffle.center for baffle in self.scene.baffles], dtype=float)
            seconds = sum(r.seconds for r in own)
            outcome = replace(self.weigh(own, none), seconds=seconds)
            self.paper = as_judged(Trial(-1, "scene", centres, outcome))
            self._log_own_layout(centres, outcome)
        return none

    def _log_own_layout(self, centres: np.ndarray, outcome: Outcome) -> None:
        """The scene's own layout is a trial too, where the search could have proposed it."""
        forms = {Form(b.size, b.yaw) for b in self.scene.baffles}
        if len(forms) > 1:
            return
        layout, form = centres, forms.pop()
        if isinstance(self.space, DesignSpace):
            layout = self.space.join(centres, form)
        alike = split(self.space, layout)[1]
        if not np.allclose((*form.size, form.yaw), (*alike.size, alike.yaw)):
            return
        if len(centres) not in numbers(self.space) or self.space.check(layout):
            return
        if not any(trial.origin == "scene" for trial in self.log.trials()):
            self.log.add("scene", layout, outcome)

    def _search(self, workers: Workers, references: Sequence[Rolled], watch: Watch) -> None:
        s, log = self.settings, self.log
        bar = watch.bar
        title = f"search: {self.method}"
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
        campaign = Campaign(
            log=log,
            evaluator=self._evaluator(workers, [r.path for r in references], watch),
            budget=s.passes,
            seed=s.seed,
            batch=s.batch,
            on_trial=show,
            salt=_salt() if s.storage else 0,
            price=s.flows,
        )
        if self.continued:
            known = [t.centres for t in log.trials()]
            fresh = [c for c in self.continued.first if not among(c, known)]
            campaign.run([("verified", c) for c in fresh])
        METHODS[self.method](campaign)
        # The last trials of a study that is shared may be another worker's, or be left to us.
        while campaign.wait(lambda waiting: show(waiting=waiting)):
            METHODS[self.method](campaign)

    def _evaluator(self, workers: Workers, references: list[Path], watch: Watch) -> Evaluator:
        s = self.settings
        spec = TaskSpec.of(
            self.flows, self.baffles, s.parts, s.simulator, references, s.risk, self.rules
        )
        if s.simulator.device != "cpu":
            return InProcess(spec.tasks(), s.risk, self.rules, spec.space())
        return InWorkers(workers, spec, watch.update)

    def _candidates(self, count: int) -> list[Judged]:
        if self.settings.objectives:
            return self._formed([as_judged(t) for t in spread(front(self.log.trials()), count)])
        # Closer than a third of a baffle is one design.
        least = float(min(self.space.size[[0, *range(2, self.scene.dim)]])) / 3
        known = [] if self.paper is None else [self.paper.centres]
        known += self.continued.avoid if self.continued else []
        return self._formed(candidates(self.log.trials(), count, least, avoid=known))

    def _formed(self, layouts: list[Judged]) -> list[Judged]:
        for layout in layouts:
            layout.form = form_of(self.space, layout.centres)
        return layouts

    def built(self, flow: Scene, layout: Judged) -> Scene:
        """`flow` with the baffles of a layout that the search proposed."""
        return built(flow, self.space, layout.centres)

    def _objective_text(self) -> str:
        text = str(self.settings.objective)
        return f"{text}; plus {self.rules}" if self.rules.charges else text

    def _kept(self, ranked: Sequence[Judged], trials: Sequence[Trial]) -> dict[str, Any]:
        """What summary.json says of the constraints of the best, and of those that none keeps."""
        if not ranked:
            return {}
        scene = self.built(self.bare, ranked[0])
        found = {"constraints": constraints(scene, self.rules, ranked[0])}
        line = to_blame(self.rules, [t.outcome for t in trials if t.ok])
        if line:
            self.note(line)
        return found

    def _verify(
        self,
        store: RolloutStore,
        references: dict[str, list[Pending]],
        panel: Panel | None,
        watch: Watch,
    ) -> None:
        s = self.settings
        if panel is None:
            chosen = self._candidates(s.verify)
        else:
            chosen = panel.choose(self._candidates(POOL * s.verify), s.verify)
            panel.judge([j for j in (self.paper,) if j is not None])
        for one in chosen:
            one.marks += beyond_limits(s.simulator, self.built(self.bare, one))
        pending = [self.roll(store, s.verifier, one) for one in chosen]
        started = [p for ps in pending for p in ps]
        watch.add(f"verify: best {len(chosen)}", started)
        watch.wait([*(p for ps in references.values() for p in ps), *started])
        none = [p.result() for p in references["none"]]
        for rolled in none:
            if rolled.status != "ok":
                raise SimulatorError(
                    f"the reference rollout without baffles ended as {rolled.status!r}: nothing "
                    "can be verified"
                )
        judged = [(self.none, references["none"]), (self.paper, references.get("paper"))]
        for layout, jobs in (*judged, *zip(chosen, pending, strict=True)):
            if layout is not None and jobs is not None:
                layout.take(self.weigh([job.result() for job in jobs], none))
        self.candidate_rollouts = len(started)
        self.reference_rollouts = len(started) + sum(map(len, references.values()))
        self.ranked = rank(chosen)

    def _name_trajectories(
        self,
        store: RolloutStore,
        searched: dict[str, list[Pending]],
        verified: dict[str, list[Pending]],
    ) -> None:
        """Name what a reader looks at: the scene's own flow, also of a robust design."""
        s = self.settings
        named = {p.result().path for p in searched["none"]}  # a resumed search reads them
        named |= self.kept
        for role, spec, known in (
            ("learned", s.simulator, searched),
            ("mpm", s.verifier, verified),
        ):
            if not known:
                continue
            shown = {key: pending[0] for key, pending in known.items()}
            if self.drawn:
                shown = {"none": store.start(spec, self.bare)}
                if self.scene.baffles:
                    shown["paper"] = store.start(spec, self._own(self.bare))
            if self.ranked:
                best = self.built(self.bare, self.ranked[0])
                # Whoever found it: a refined model knows more than the one that was given.
                who = self.models[self.ranked[0].model] if role == "learned" else spec
                shown["best"] = store.start(who, best)
            for key, job in shown.items():
                rolled = job.result()
                store.name(rolled, f"{key}-{role}")
                named.add(rolled.path)
        store.prune(named)

    @contextlib.contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Write down what a stage takes."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = time.perf_counter() - started


def _check(flows: Sequence[Scene], settings: Settings) -> list[str]:
    """Refuse what the simulators cannot run; return what they warn of, each limit once."""
    notes = []
    for spec in (settings.simulator, *([settings.verifier] if settings.verify else [])):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            simulator = spec.load()
            for scene in flows:
                simulator.check(scene)
                spacing = getattr(simulator, "spacing", None)
                if spacing is not None:
                    fill(scene, spacing)  # a release thinner than that: say so before the search
        notes += [str(warning.message) for warning in caught]
    return notes


def _described(scenarios: Scenarios) -> dict[str, Any]:
    """The options that drew the scenarios, as words for the same command."""
    ranges = {name: getattr(scenarios, name) for name in ("speed", "volume", "friction")}
    return {
        "count": scenarios.count,
        **{name: f"{r[0]:g}:{r[1]:g}" for name, r in ranges.items() if r is not None},
        "risk": scenarios.risk.kind,
        **({"level": scenarios.risk.level} if scenarios.risk.kind == "cvar" else {}),
    }


def _freed(settings: Settings) -> dict[str, Any]:
    """The options of variables, limits and prices, as words for the same command.

    What they put into the placement stands in scene.toml of the run.
    """
    s = settings
    return {
        **({"pattern": s.pattern} if s.pattern != "free" else {}),
        **({"baffle_cost": s.baffle_cost} if s.baffle_cost else {}),
        **({"concrete_cost": s.concrete_cost} if s.concrete_cost else {}),
    }


def _trusted(settings: Settings) -> dict[str, Any]:
    """The options of ensemble and refinement, as words for the same command."""
    s = settings
    values: dict[str, Any] = {}
    if s.ensemble is not None:
        values["ensemble"] = ",".join(s.ensemble)
    if s.refine:
        values |= {"refine": s.refine, "refine_minutes": s.refine_minutes}
        values |= {"refine_data": str(s.refine_data)} if s.refine_data else {}
    return values


def _salt() -> int:
    """A number of this process, for the random numbers of searches that share a study."""
    return int.from_bytes(hashlib.sha256(worker().encode()).digest()[:4], "big")

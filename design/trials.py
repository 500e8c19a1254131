"""The trials of a search, in an Optuna study: one store for every method, on one machine or many.

Baselines, sampled layouts and gradient steps all end as trials of one study in RDB storage (SQLite
in the run folder by default, PostgreSQL across machines), so a search resumes, is shared and is
looked at with Optuna's own tools, whichever method made the trials.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy import event
from sqlalchemy.exc import SQLAlchemyError

from design.distinct import distance
from design.parameters import distributions, ordered, plan_dim, to_centres, to_parameters
from design.rules import PENALTY, broken
from design.space import FORM, DesignSpace, Space
from gns_model.errors import GnsError

optuna.logging.set_verbosity(optuna.logging.ERROR)


class StudyError(GnsError):
    """A study that cannot be opened, or that belongs to another task."""


@dataclass(frozen=True)
class Outcome:
    """What running one layout gave.

    Attributes:
        cost: the objective, relative to no baffles [-]; a finite penalty if the rollout failed.
        measures: hard measures, `gns_model.measures.summary`; empty if the rollout failed.
        status: "ok" or how the rollout failed.
        rollouts: forward rollouts spent.
        backwards: backward passes through a rollout spent.
        seconds: spent on it.
        gradient: d(smooth cost)/d(centres) [1/m], shape (n, D-1), if it was asked for.
        costs: one cost for each objective, of a search with several; `cost` is their sum.
        flows: the cost in each scenario, of a robust search; `cost` is their mean or CVaR then.
        excess: by how much each limit on the flow is broken; 0 or less where it is kept.
    """

    cost: float
    measures: dict[str, float]
    status: str = "ok"
    rollouts: int = 1
    backwards: int = 0
    seconds: float = 0.0
    gradient: np.ndarray | None = None
    costs: tuple[float, ...] = ()
    flows: tuple[float, ...] = ()
    excess: dict[str, float] = field(default_factory=dict)

    @property
    def feasible(self) -> bool:
        """Whether the rollout reached its end and every limit is kept."""
        return self.status == "ok" and broken(self.excess) == 0

    @property
    def order(self) -> tuple[float, float]:
        """What layouts are ranked by, least first: what is broken of the limits, then the cost."""
        return broken(self.excess), self.cost

    @property
    def merit(self) -> float:
        """The cost, and a penalty for what is broken of the limits: what a gradient makes small."""
        return self.cost + PENALTY * broken(self.excess)


@dataclass(frozen=True)
class Trial:
    """One layout that was tried: `centres` [m], shape (n, D-1), where it came from, its outcome."""

    number: int
    origin: str
    centres: np.ndarray
    outcome: Outcome

    @property
    def cost(self) -> float:
        """The objective, relative to no baffles [-]."""
        return self.outcome.cost

    @property
    def ok(self) -> bool:
        """Whether the rollout reached its end."""
        return self.outcome.status == "ok"

    @property
    def order(self) -> tuple[float, float]:
        """See `Outcome.order`."""
        return self.outcome.order


@dataclass(frozen=True)
class Proposal:
    """A layout that the study waits for: run it, then `tell`."""

    number: int
    origin: str
    centres: np.ndarray


class TrialLog:
    """An Optuna study seen as layouts: ask for some, tell what they gave, look at all."""

    def __init__(self, study: optuna.Study, space: Space) -> None:
        self.study, self.space = study, space
        self.distributions = distributions(space)
        self._asked: dict[int, optuna.Trial] = {}
        self._backend: optuna.storages.RDBStorage | None = None

    @classmethod
    def open(
        cls,
        storage: str,
        name: str,
        space: Space,
        task: dict[str, Any],
        *,
        resume: bool,
        owned: bool,
        objectives: int = 1,
    ) -> TrialLog:
        """Create or resume the study `name` in `storage`.

        Args:
            task: what is searched (scene, number of baffles, objective, simulator), plain values:
                a study of another task is refused.
            resume: go on with a study that exists.
            owned: nobody else uses the storage, so trials left running are leftovers of a crash.
            objectives: how many costs a trial has.

        Raises:
            StudyError: if the storage cannot be reached, the study exists and `resume` is not set,
                or it belongs to another task.
        """
        with storage_errors(storage):
            backend = _backend(storage)
            try:
                study = optuna.create_study(
                    storage=backend,
                    study_name=name,
                    directions=["minimize"] * objectives,
                    load_if_exists=resume,
                )
            except optuna.exceptions.DuplicatedStudyError:
                raise StudyError(
                    f"{storage} already holds the study {name!r}: go on with --resume, or choose "
                    "another --out or --storage"
                ) from None
            known = study.user_attrs.get("task")
            if known is None:
                study.set_user_attr("task", json.dumps(task))
            else:
                _same_task(json.loads(known), json.loads(json.dumps(task)))
            if owned:
                for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
                    study.tell(trial.number, state=TrialState.FAIL)
        log = cls(study, space)
        log._backend = backend
        return log

    def close(self) -> None:
        """Leave the storage; an SQLite file is one file again then."""
        if self._backend is not None:
            self._backend.engine.dispose()

    def ask(self, count: int, sampler: optuna.samplers.BaseSampler, origin: str) -> list[Proposal]:
        """`count` layouts to run: those enqueued first, then the sampler's, all buildable."""
        self.study.sampler = sampler
        proposals = []
        for _ in range(count):
            trial = self.study.ask(self.distributions)
            centres = self.buildable(to_centres(self.space, trial.params))
            source = trial.user_attrs.get("origin", origin)
            self._asked[trial.number] = trial
            proposals.append(Proposal(trial.number, source, centres))
        return proposals

    def enqueue(self, origin: str, centres: np.ndarray) -> None:
        """Have `ask` return a layout before the sampler's own, unless it was tried already."""
        centres = self.buildable(centres)
        if any(distance(t.centres, centres) < 1e-6 for t in self.trials()):
            return
        self.study.enqueue_trial(
            to_parameters(self.space, centres), user_attrs={"origin": origin}, skip_if_exists=True
        )

    def tell(self, proposal: Proposal, outcome: Outcome) -> Trial:
        """Record what a proposal gave. A failure is told with its finite penalty."""
        trial = self._asked.pop(proposal.number)
        trial.set_user_attr("record", _record(proposal.origin, proposal.centres, outcome))
        for name, value in outcome.excess.items():
            trial.set_constraint(name, value)
        self.study.tell(trial, self._values(outcome))
        return Trial(proposal.number, proposal.origin, proposal.centres, outcome)

    def add(self, origin: str, centres: np.ndarray, outcome: Outcome) -> Trial:
        """Record a layout that the study did not ask for, so that its sampler learns from it."""
        centres = self.buildable(centres)
        self.study.add_trial(
            optuna.create_trial(
                params=to_parameters(self.space, centres),
                distributions=self.distributions,
                values=self._values(outcome),
                user_attrs={"record": _record(origin, centres, outcome)},
                constraints=outcome.excess,
            )
        )
        return Trial(len(self.study.get_trials(deepcopy=False)) - 1, origin, centres, outcome)

    def _values(self, outcome: Outcome) -> list[float]:
        """What the sampler is told: a failure is worse than all that worked by their whole spread.

        Its own cost lies so far off that a model of all trials would see nothing else.
        """
        several = len(self.study.directions) > 1
        own = list(outcome.costs) if several else [outcome.cost]
        if outcome.status == "ok":
            return own
        known = [t.outcome.costs if several else (t.cost,) for t in self.trials() if t.ok]
        if len(known) < 2:
            return own
        costs = np.array(known)
        return [float(v) for v in 2 * costs.max(axis=0) - costs.min(axis=0)]

    def abandon(self) -> None:
        """Mark what was asked for and will not be told, so that nobody waits for it."""
        for trial in self._asked.values():
            self.study.tell(trial, state=TrialState.FAIL)
        self._asked.clear()

    def buildable(self, centres: np.ndarray) -> np.ndarray:
        """The nearest layout that holds every constraint, numbered across the flow."""
        centres = np.asarray(centres, dtype=float)
        if self.space.check(centres):
            centres = np.asarray(self.space.project(centres), dtype=float)
        return ordered(centres, plan_dim(self.space))

    def trials(self) -> list[Trial]:
        """Everything that was tried, in the order it was asked for."""
        finished = self.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        return [trial for trial in map(_trial, finished) if trial is not None]

    def best(self) -> Trial | None:
        """The trial of least cost among those whose rollout reached its end, and kept the limits if
        any did."""
        return min((t for t in self.trials() if t.ok), key=lambda t: t.order, default=None)

    def spent(self) -> int:
        """Passes through a rollout so far: forward and backward ones, each counts one."""
        return sum(t.outcome.rollouts + t.outcome.backwards for t in self.trials())


def table(trials: Sequence[Trial], space: Space | None = None) -> str:
    """Trials as CSV text with a header; `space` says what varies beside the places."""
    measures = list(dict.fromkeys(name for t in trials for name in t.outcome.measures))
    axes = ("x", "z")
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    varied = space.names if isinstance(space, DesignSpace) else ()
    plan = trials[0].centres.shape[1] - len(varied) if trials else 0
    most = max((len(t.centres) for t in trials), default=0)
    columns = [f"{axes[j]}{k + 1}" for k in range(most) for j in range(plan)]
    limits = list(trials[0].outcome.excess) if trials else []
    spent = ["rollouts", "backwards", "seconds"]
    parts = [
        *(f"cost_{k + 1}" for k in range(max((len(t.outcome.costs) for t in trials), default=0))),
        *(f"flow_{k + 1}" for k in range(max((len(t.outcome.flows) for t in trials), default=0))),
    ]
    broken_by = [f"excess_{name}" for name in limits]
    writer.writerow(
        ["number", "origin", "status", "cost", *parts, *measures, *broken_by]
        + [*varied, *columns, *spent]
    )
    for t in trials:
        o = t.outcome
        writer.writerow(
            [t.number, t.origin, o.status, repr(float(o.cost))]
            + [repr(float(c)) for c in (*o.costs, *o.flows)]
            + [repr(float(o.measures[m])) if m in o.measures else "" for m in measures]
            + [f"{o.excess.get(name, 0.0):.6f}" for name in limits]
            + [f"{value:.6f}" for value in _form_of(space, t.centres).values()]
            + [f"{c:.6f}" for c in t.centres[:, :plan].ravel()]
            + [""] * ((most - len(t.centres)) * plan)
            + [o.rollouts, o.backwards, f"{o.seconds:.3f}"]
        )
    return text.getvalue()


def _form_of(space: Space | None, layout: np.ndarray) -> dict[str, float]:
    """What varies of the form of a layout, by name: sizes [m], yaw [degrees]."""
    if not isinstance(space, DesignSpace):
        return {}
    _, form = space.split(layout)
    known = {"yaw": form.yaw, **dict(zip(FORM, form.size, strict=False))}
    return {name: known[name] for name in space.names}


@contextlib.contextmanager
def storage_errors(storage: str) -> Iterator[None]:
    """Turn what a database can throw (unreachable, full disk, foreign file) into a StudyError."""
    try:
        yield
    except (SQLAlchemyError, optuna.exceptions.StorageInternalError, ImportError) as error:
        cause: BaseException = error
        while cause.__cause__ is not None:
            cause = cause.__cause__
        # The address may carry a password: name the kind and the place only.
        place = storage.rsplit("@", 1)[-1]
        raise StudyError(f"study storage {place}: {cause or type(cause).__name__}") from error
    except (RuntimeError, ValueError) as error:
        if isinstance(error, GnsError) or "optuna" not in str(error).lower():
            raise
        raise StudyError(f"study storage {storage.rsplit('@', 1)[-1]}: {error}") from error


def _backend(storage: str) -> optuna.storages.RDBStorage:
    if not storage.startswith("sqlite"):
        return optuna.storages.RDBStorage(storage, engine_kwargs={"pool_pre_ping": True})
    backend = optuna.storages.RDBStorage(storage, engine_kwargs={"connect_args": {"timeout": 60}})

    def tune(connection: Any, _: Any) -> None:
        # A trial is about ten commits, each a wait for the disk (30 ms on a busy one) unless the
        # log is written ahead; a power cut may then cost the last trials and never the file.
        with contextlib.suppress(Exception):  # a file system that cannot do it does without
            connection.execute("PRAGMA journal_mode=WAL").fetchone()
            connection.execute("PRAGMA synchronous=NORMAL")

    event.listen(backend.engine, "connect", tune)
    backend.engine.dispose()  # connect anew
    return backend


def sqlite_url(path: str | os.PathLike[str]) -> str:
    """The storage address of an SQLite file."""
    return f"sqlite:///{Path(path).resolve()}"


def _record(origin: str, centres: np.ndarray, outcome: Outcome) -> dict[str, Any]:
    return {
        "origin": origin,
        "centres": np.asarray(centres).tolist(),
        "cost": outcome.cost,
        "measures": outcome.measures,
        "status": outcome.status,
        "rollouts": outcome.rollouts,
        "backwards": outcome.backwards,
        "seconds": outcome.seconds,
        "costs": list(outcome.costs),
        "flows": list(outcome.flows),
        "excess": outcome.excess,
    }


def _trial(frozen: FrozenTrial) -> Trial | None:
    record = frozen.user_attrs.get("record")
    if record is None:
        return None
    outcome = Outcome(
        cost=float(record["cost"]),
        measures=dict(record["measures"]),
        status=str(record["status"]),
        rollouts=int(record["rollouts"]),
        backwards=int(record["backwards"]),
        seconds=float(record["seconds"]),
        costs=tuple(map(float, record.get("costs", ()))),
        flows=tuple(map(float, record.get("flows", ()))),
        excess={name: float(value) for name, value in record.get("excess", {}).items()},
    )
    return Trial(frozen.number, str(record["origin"]), np.array(record["centres"]), outcome)


def _same_task(known: dict[str, Any], asked: dict[str, Any]) -> None:
    for key in [*asked, *(key for key in known if key not in asked)]:
        if known.get(key) != asked.get(key):
            values = known.get(key), asked.get(key)
            plain = not any(isinstance(v, (dict, list)) for v in values)
            detail = f" ({values[0]!r}, now {values[1]!r})" if plain else ""
            raise StudyError(f"the study to resume has another {key}{detail}: choose another --out")

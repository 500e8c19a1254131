"""The trials of a search, in an Optuna study: one store for every method, on one machine or many.

Baselines, sampled layouts and gradient steps all end as trials of one study in RDB storage (SQLite
in the run folder by default, PostgreSQL across machines), so a search resumes, is shared and is
looked at with Optuna's own tools, whichever method made the trials.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState

from design import ledger
from design.distinct import distance
from design.heart import Heart
from design.outcome import Outcome, Trial, as_record, from_record
from design.parameters import distributions, ordered, plan_dim, to_centres, to_parameters
from design.space import Space
from design.storage import Storage, StudyError, open_storage, public, storage_errors
from gns_model.interrupts import postponed

optuna.logging.set_verbosity(optuna.logging.ERROR)


@dataclass(frozen=True)
class Proposal:
    """A layout that the study waits for: run it, then `tell`."""

    number: int
    origin: str
    centres: np.ndarray


class TrialLog:
    """An Optuna study seen as layouts: ask for some, tell what they gave, look at all.

    Several workers may hold one study, each with a log of its own. What a worker leaves behind is
    found by the others: at once if it was interrupted, by its missing signs of life if it was
    killed. An interrupt comes between two trials that are asked for or told, never within one.
    """

    def __init__(self, study: optuna.Study, space: Space, heart: Heart | None = None) -> None:
        self.study, self.space = study, space
        self.distributions = distributions(space)
        self._heart = heart
        self._since = len(self._all())
        #: Number of each trial that this log asked for -> its id in the storage.
        self._asked: dict[int, int] = {}
        self._backend: Storage | None = None

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
        grace: int = 60,
    ) -> TrialLog:
        """Create, join or resume the study `name` in `storage`.

        Args:
            task: what is searched (scene, number of baffles, objective, simulator), plain values:
                a study of another task is refused.
            resume: go on with a study that exists. One that others may work on is always joined.
            owned: nobody else uses the storage, so trials left running are leftovers of a crash.
            objectives: how many costs a trial has.
            grace: seconds without a sign of life after which another worker counts as dead.

        Raises:
            StudyError: if the storage cannot be reached, the study exists and `resume` is not set,
                or it belongs to another task.
        """
        with storage_errors(storage):
            backend = open_storage(storage, None if owned else grace)
            try:
                study = optuna.create_study(
                    storage=backend,
                    study_name=name,
                    directions=["minimize"] * objectives,
                    load_if_exists=resume or not owned,
                )
            except optuna.exceptions.DuplicatedStudyError:
                raise StudyError(
                    f"{public(storage)} already holds the study {name!r}: go on with --resume, or "
                    "choose another --out or --storage"
                ) from None
            if "task" not in study.user_attrs:
                study.set_user_attr("task", json.dumps(task))
            # Read back, for two workers may begin a study at the same time.
            known, own = json.loads(study.user_attrs["task"]), json.loads(json.dumps(task))
            _same_task(known, own, "--out" if owned else "--study")
            log = cls(study, space, None if owned else Heart(backend))
            log._backend = backend
            if owned:
                for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
                    log._lose(trial._trial_id, log._whole(trial))
        return log

    def close(self) -> None:
        """Leave the storage; an SQLite file is one file again then."""
        if self._heart is not None:
            self._heart.stop()
        if self._backend is not None:
            self._backend.engine.dispose()

    # -- asking --------------------------------------------------------------------------------

    def ask(self, count: int, sampler: optuna.samplers.BaseSampler, origin: str) -> list[Proposal]:
        """`count` layouts to run: those enqueued first, then the sampler's, all buildable."""
        self.study.sampler = sampler
        proposals: list[Proposal] = []
        for _ in range(count):
            try:
                trial = self._sample()
            except optuna.exceptions.UpdateFinishedTrialError:
                # This worker counted as dead while it sampled: that trial is gone.
                for number in set(self._asked) - {p.number for p in proposals}:
                    self._let_go(number)
                continue
            centres = self.buildable(to_centres(self.space, trial.params))
            source = trial.user_attrs.get(ledger.ORIGIN, origin)
            proposals.append(Proposal(trial.number, source, centres))
        return proposals

    @postponed()
    def _sample(self) -> optuna.Trial:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # heartbeats without `Study.optimize`: `Heart`
            trial = self.study.ask(self.distributions)
        self.hold(trial.number, trial._trial_id)
        return trial

    @postponed()
    def reserve(self, layouts: Sequence[tuple[str, np.ndarray]], passes: int = 1) -> list[Proposal]:
        """Given layouts (origin, centres [m]) as trials under way, each of that many passes."""
        proposals = []
        for origin, centres in layouts:
            centres = self.buildable(centres)
            attributes = {ledger.ORIGIN: origin, ledger.PASSES: passes}
            number, trial_id = self._create(TrialState.RUNNING, centres, attributes)
            self.hold(number, trial_id)
            proposals.append(Proposal(number, origin, centres))
        return proposals

    @postponed()
    def again(self, count: int) -> list[Proposal]:
        """At most `count` layouts that other workers, or an earlier run, asked for and left."""
        self._note_the_lost()
        proposals: list[Proposal] = []
        for trial in self.study.get_trials(deepcopy=False, states=(TrialState.WAITING,)):
            if len(proposals) == count:
                break
            if ledger.RETRY_OF not in trial.user_attrs or not self._take(trial._trial_id):
                continue
            self.hold(trial.number, trial._trial_id)
            centres = self.buildable(to_centres(self.space, trial.params))
            proposals.append(Proposal(trial.number, trial.user_attrs[ledger.ORIGIN], centres))
        return proposals

    @postponed()
    def admit(
        self, proposals: Sequence[Proposal], budget: int, price: int
    ) -> list[Proposal | None]:
        """`proposals`, None in place of those that another worker's make superfluous: beyond the
        budget [passes], or of a given layout that another runs. `price`: see `ledger.held`.
        """
        trials, numbers = self._all(), [p.number for p in proposals]
        twins = ledger.twins(trials, numbers, self._since)
        trials = [t for t in trials if t.number not in twins]
        dropped = twins | ledger.surplus(trials, numbers, budget, price)
        for number in dropped:
            trial_id = self._asked[number]
            self._mark(trial_id, ledger.DROPPED, ledger.TWIN if number in twins else ledger.SURPLUS)
            self._let_go(number)
        admitted = [None if p.number in dropped else p for p in proposals]
        if self._heart is not None:
            for proposal in filter(None, admitted):
                self._mark(self._asked[proposal.number], ledger.WORKER, worker())
        return admitted

    def enqueue(self, origin: str, centres: np.ndarray) -> None:
        """Have `ask` return a layout before the sampler's own, unless it was tried already."""
        centres = self.buildable(centres)
        if any(distance(t.centres, centres) < 1e-6 for t in self.trials()):
            return
        self.study.enqueue_trial(
            to_parameters(self.space, centres),
            user_attrs={ledger.ORIGIN: origin},
            skip_if_exists=True,
        )

    @postponed()
    def hold(self, number: int, trial_id: int) -> None:
        """This log runs that trial: it will tell it or leave it."""
        if number not in self._asked:
            self._asked[number] = trial_id
            if self._heart is not None:
                self._heart.beat_for(trial_id)

    # -- telling -------------------------------------------------------------------------------

    @postponed()
    def tell(self, proposal: Proposal, outcome: Outcome) -> Trial:
        """Record what a proposal gave. A failure is told with its finite penalty.

        If this worker counted as dead meanwhile, the layout is another's to tell.
        """
        trial_id = self._asked[proposal.number]
        record = as_record(proposal.origin, proposal.centres, outcome) | {"worker": worker()}
        with contextlib.suppress(optuna.exceptions.UpdateFinishedTrialError):
            self.study._storage.set_trial_user_attr(trial_id, ledger.RECORD, record)
            if outcome.excess:
                trial = optuna.trial.Trial(self.study, trial_id)
                for name, value in outcome.excess.items():
                    trial.set_constraint(name, value)
            values = self._values(outcome)
            self.study.tell(proposal.number, values, skip_if_finished=True)
        del self._asked[proposal.number]
        if self._heart is not None:
            self._heart.forget(trial_id)
        return Trial(proposal.number, proposal.origin, proposal.centres, outcome)

    def add(self, origin: str, centres: np.ndarray, outcome: Outcome) -> Trial | None:
        """Record a layout that the study did not ask for, so that its sampler learns from it; None
        if another worker did.
        """
        passes = outcome.rollouts + outcome.backwards
        (proposal,) = self.reserve([(origin, centres)], passes)
        if ledger.twins(self._all(), [proposal.number]):
            self._let_go(proposal.number)
            return None
        return self.tell(proposal, outcome)

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

    @postponed()
    def abandon(self) -> None:
        """Leave what was asked for and will not be told for others, or a later run, to try."""
        for number, trial_id in list(self._asked.items()):
            del self._asked[number]
            if self._heart is not None:
                self._heart.forget(trial_id)
            self._lose(trial_id, self._whole(self.study._storage.get_trial(trial_id)))

    def buildable(self, centres: np.ndarray) -> np.ndarray:
        """The nearest layout that holds every constraint, numbered across the flow."""
        centres = np.asarray(centres, dtype=float)
        if self.space.check(centres):
            centres = np.asarray(self.space.project(centres), dtype=float)
        return ordered(centres, plan_dim(self.space))

    def trials(self) -> list[Trial]:
        """Everything that was tried, in the order it was asked for."""
        finished = self.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        records = ((t.number, t.user_attrs.get(ledger.RECORD)) for t in finished)
        return [from_record(number, record) for number, record in records if record is not None]

    def best(self) -> Trial | None:
        """The trial of least cost among those whose rollout reached its end, and kept the limits if
        any did."""
        return min((t for t in self.trials() if t.ok), key=lambda t: t.order, default=None)

    def spent(self, trials: Sequence[Trial] | None = None) -> int:
        """Passes through a rollout so far: forward and backward ones, each counts one."""
        known = self.trials() if trials is None else trials
        return sum(t.outcome.rollouts + t.outcome.backwards for t in known)

    def taken(self, price: int) -> int:
        """Passes that nobody else may spend: spent, being spent, or kept for what is to be tried
        again. `price`: see `ledger.held`.
        """
        return sum(ledger.held(self._all(), price).values())

    def others(self) -> list[int]:
        """Numbers of the trials that other workers run now."""
        return [t.number for t in self._running()]

    def at_work(self, origin: str) -> list[np.ndarray]:
        """Given layouts [m], (n, D-1), of that origin that are being run."""
        running = [t for t in self._running() if t.user_attrs.get(ledger.ORIGIN) == origin]
        return [self.buildable(to_centres(self.space, t.params)) for t in running]

    # -- the study -----------------------------------------------------------------------------

    def _all(self) -> list[FrozenTrial]:
        return self.study.get_trials(deepcopy=False)

    def _running(self) -> list[FrozenTrial]:
        running = self.study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))
        return [t for t in running if t.number not in self._asked]

    def _create(
        self, state: TrialState, centres: np.ndarray, attributes: dict[str, Any]
    ) -> tuple[int, int]:
        """A trial of a given layout: its number, and its id in the storage."""
        trial = optuna.create_trial(
            state=state,
            params=to_parameters(self.space, centres),
            distributions=self.distributions,
            user_attrs=attributes,
        )
        trial_id = self.study._storage.create_new_trial(self.study._study_id, trial)
        return self.study._storage.get_trial_number_from_id(trial_id), trial_id

    def _take(self, trial_id: int) -> bool:
        """Whether this log is the one that takes a waiting trial."""
        try:
            return self.study._storage.set_trial_state_values(trial_id, TrialState.RUNNING)
        except optuna.exceptions.UpdateFinishedTrialError:
            return False

    def _let_go(self, number: int) -> None:
        """Fail a trial that nobody has to try again."""
        trial_id = self._asked.pop(number)
        if self._heart is not None:
            self._heart.forget(trial_id)
        self._lose(trial_id, False)

    def _mark(self, trial_id: int, name: str, value: object) -> None:
        """Set a user attribute, unless this worker counts as dead and the trial as failed."""
        with contextlib.suppress(optuna.exceptions.UpdateFinishedTrialError):
            self.study._storage.set_trial_user_attr(trial_id, name, value)

    def _lose(self, trial_id: int, again: bool) -> None:
        """Fail a trial whose worker is gone; `again`: it has a layout, to be tried again."""
        with contextlib.suppress(optuna.exceptions.UpdateFinishedTrialError):
            if again:
                self.study._storage.set_trial_user_attr(trial_id, ledger.LOST, True)
            self.study._storage.set_trial_state_values(trial_id, TrialState.FAIL)

    def _whole(self, trial: FrozenTrial) -> bool:
        """Whether a trial has a layout: a worker may die while it writes one parameter by one."""
        return self.distributions.keys() <= trial.params.keys()

    def _note_the_lost(self) -> None:
        """Enqueue what dead workers left: also what one left that died while noting this."""
        if self._heart is not None:
            for trial in self._running():
                self._heart.adopt(trial._trial_id)
            for trial_id in self._heart.stale(self.study._study_id):
                trial = self.study._storage.get_trial(trial_id)
                if trial.number not in self._asked:
                    self._lose(trial_id, self._whole(trial))
        for trial in ledger.lost(self._all()):
            record = trial.user_attrs.get(ledger.RECORD) or {}
            origin = trial.user_attrs.get(ledger.ORIGIN) or record.get("origin") or "again"
            attributes = {
                ledger.ORIGIN: origin,
                ledger.RETRY_OF: trial.number,
                ledger.RETRIES: int(trial.user_attrs.get(ledger.RETRIES, 0)) + 1,
            }
            centres = self.buildable(to_centres(self.space, trial.params))
            self._create(TrialState.WAITING, centres, attributes)


def worker() -> str:
    """The name of this process among the workers of a study."""
    return f"{socket.gethostname()}-{os.getpid()}"


def _same_task(known: dict[str, Any], asked: dict[str, Any], option: str) -> None:
    for key in [*asked, *(key for key in known if key not in asked)]:
        if known.get(key) != asked.get(key):
            values = known.get(key), asked.get(key)
            plain = not any(isinstance(v, (dict, list)) for v in values)
            detail = f" ({values[0]!r}, now {values[1]!r})" if plain else ""
            raise StudyError(
                f"the study to resume has another {key}{detail}: choose another {option}"
            )

"""Signs of life of a worker, so that others know which trials to try again."""

from __future__ import annotations

import contextlib
import threading

import optuna


class Heart:
    """A thread that tells the storage every few seconds which trials this process still runs.

    It ends with the process, however that ends; a process that is stopped for longer than the
    storage's grace counts as dead.
    """

    def __init__(self, storage: optuna.storages.RDBStorage) -> None:
        self._storage = storage
        self._every = storage.get_heartbeat_interval() or 1
        self._trials: set[int] = set()
        self._adopted: set[int] = set()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True, name="heart")
        self._thread.start()

    def beat_for(self, trial_id: int) -> None:
        """This process runs that trial."""
        self._storage.record_heartbeat(trial_id)
        self._trials.add(trial_id)

    def forget(self, trial_id: int) -> None:
        """It no longer does."""
        self._trials.discard(trial_id)

    def adopt(self, trial_id: int) -> None:
        """Start the clock of a trial of another worker, which may have died before its first beat.

        Staleness is judged by the server's clock alone, so this needs no time of ours.
        """
        if trial_id not in self._adopted:
            self._adopted.add(trial_id)
            self._storage.record_heartbeat(trial_id)

    def stale(self, study_id: int) -> list[int]:
        """Trials of workers that count as dead."""
        return list(self._storage._get_stale_trial_ids(study_id))

    def stop(self) -> None:
        """No more beats."""
        self._end.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._end.wait(self._every):
            for trial_id in list(self._trials):
                # A server that is away for a moment: the search itself will say so if it stays.
                with contextlib.suppress(Exception):
                    self._storage.record_heartbeat(trial_id)

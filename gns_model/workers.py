"""Processes of one thread each: how rollouts fill a CPU.

Small matrix products scale badly over threads and well over processes (findings/SPEED.md). Jobs are
plain functions of plain arguments, and may tell how far they are.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import queue
import signal
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from typing import Any

from gns_model.errors import SimulatorError
from gns_model.interrupts import deaf, postponed

_THREADS = {
    name: "1"
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
}
_fractions: Any = None  # in a worker: one double a slot, how far the job in it has come
SLOTS = 256
#: The slot of jobs that found no other free; nobody reads it.
SPARE = SLOTS - 1
#: How often those who wait for jobs look at them [s].
LOOK = 0.5


class WorkerError(SimulatorError):
    """A worker process died, most likely for want of memory."""


class Workers:
    """A pool of one-thread processes whose jobs report how far they are.

    Use as a context manager: leaving it ends the processes, at once if by an error or an interrupt.
    They are spawned, so a script needs the usual `if __name__ == "__main__":` guard.

    Futures are looked at with interrupts held back: one that lands while it takes a future's lock
    would leave that locked, and the pool's own thread would wait for it for ever.
    """

    def __init__(
        self,
        count: int,
        prepare: Callable[..., None] | None = None,
        *arguments: Any,
        advice: str = "use fewer of them",
    ) -> None:
        """
        Args:
            count: of processes; they start when jobs come and then stay.
            prepare: called in each with `arguments` before its first job.
            advice: what to do if one dies, in words.
        """
        self.count = count
        self.advice = advice
        # spawn: a forked process would inherit threads of torch and numba in an unknown state.
        context = multiprocessing.get_context("spawn")
        self._fractions = context.Array("d", SLOTS, lock=False)
        self._free = list(range(SPARE))
        with _environment(_THREADS):
            self._pool = ProcessPoolExecutor(
                count,
                mp_context=context,
                initializer=_start,
                initargs=(self._fractions, prepare, arguments),
            )

    @postponed()
    def submit(self, job: Callable[..., Any], *arguments: Any) -> Job:
        """Queue `job(*arguments, slot)`; a worker calls it with a slot for `report`."""
        slot = self._free.pop(0) if self._free else SPARE
        self._fractions[slot] = 0.0
        try:
            with _environment(_THREADS), deaf():  # it starts a process when a job needs one
                future = self._pool.submit(job, *arguments, slot)
        except BrokenProcessPool:
            raise WorkerError(_DIED.format(self.advice)) from None
        if slot != SPARE:
            future.add_done_callback(lambda _: self._free.append(slot))
        return Job(future, self._fractions, slot, self.advice)

    def end(self) -> None:
        """End the processes, at once and with whatever they are doing."""
        for process in list((self._pool._processes or {}).values()):
            process.terminate()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        if kind is not None:
            self.end()
        self._pool.shutdown(wait=True)


class Job:
    """A job under way."""

    def __init__(self, future: Future[Any], fractions: Any, slot: int, advice: str) -> None:
        self._future, self._fractions, self._slot = future, fractions, slot
        self._advice = advice

    @property
    @postponed()
    def done(self) -> bool:
        """Whether it ended, well or not."""
        return self._future.done()

    @postponed()
    def when_done(self, call: Callable[[], None]) -> None:
        """Call that from another thread when it has ended; at once if it has."""
        self._future.add_done_callback(lambda _: call())

    @property
    def fraction(self) -> float:
        """How far it is, 0 to 1; 0 until it is done if more than `SPARE` jobs wait."""
        if self.done:
            return 1.0
        return 0.0 if self._slot == SPARE else min(float(self._fractions[self._slot]), 1.0)

    def result(self) -> Any:
        """What it returned; waits for it.

        Raises:
            WorkerError: if its process died; else whatever the job raised.
        """
        for _ in as_completed([self]):
            pass
        try:
            with postponed():
                return self._future.result()
        except BrokenProcessPool:
            raise WorkerError(_DIED.format(self._advice)) from None


def as_completed(jobs: list[Job], watch: Callable[[], None] | None = None) -> Iterator[int]:
    """Indices of `jobs` as they end; `watch` is called twice a second meanwhile."""
    ended: queue.SimpleQueue[int] = queue.SimpleQueue()
    for k, job in enumerate(jobs):
        job.when_done(partial(ended.put, k))
    left = len(jobs)
    while left:
        ready = None
        with contextlib.suppress(queue.Empty):
            ready = ended.get(timeout=LOOK)
        if watch is not None:
            watch()
        if ready is not None:
            left -= 1
            yield ready


def results(jobs: list[Job], progress: Callable[[float], None] | None = None) -> list[Any]:
    """What `jobs` return, in their order; waits for all, or for the first that fails.

    Args:
        progress: called with the fraction done, of jobs under way, too.

    Raises:
        WorkerError: if a process died; else whatever a job raised.
    """
    found: dict[int, Any] = {}

    def look() -> None:
        if progress is not None:
            progress(sum(job.fraction for job in jobs) / len(jobs))

    for k in as_completed(jobs, look):
        found[k] = jobs[k].result()
        look()
    return [found[k] for k in range(len(jobs))]


def report(slot: int) -> Callable[[float], None]:
    """In a worker: a progress callback that writes to `slot`."""

    def write(fraction: float) -> None:
        if _fractions is not None:
            _fractions[slot] = fraction

    return write


def default_count() -> int:
    """The cores that this process may use."""
    with contextlib.suppress(AttributeError):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


_DIED = "a worker process died (out of memory?): what was finished is kept; {}"


def _start(fractions: Any, prepare: Callable[..., None] | None, arguments: tuple[Any, ...]) -> None:
    global _fractions
    _fractions = fractions
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what an interrupt means
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    parent = multiprocessing.parent_process()
    if parent is not None:
        # A parent that was killed takes its workers with it.
        threading.Thread(target=_follow, args=(parent,), daemon=True).start()
    warnings.simplefilter("ignore")  # the parent has checked, and says it once
    if prepare is not None:
        prepare(*arguments)


def _follow(parent: Any) -> None:
    parent.join()
    os._exit(1)


@contextlib.contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value

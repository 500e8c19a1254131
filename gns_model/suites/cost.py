"""Seconds and memory of a piece of work, and how much of it a budget still holds."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch

#: Repeats of which the least counts, the least time that one should last [s], and the share of
#: what is left of the budget that they may take.
REPEATS, LEAST_SECONDS, REPEAT_SHARE = 3, 0.5, 0.1
#: Most steps in one repeat.
MOST_STEPS = 20
#: Share of the free memory of a CPU that an estimate may ask for.
MEMORY_SHARE = 0.6

_STATUS = Path("/proc/self/status")


@dataclass
class Cost:
    """What one size cost; `reason` says why there is no number, if there is none."""

    seconds: float | None = None  #: a step [s]
    memory: float | None = None  #: at its peak [bytes]
    reason: str = ""

    @property
    def megabytes(self) -> float | None:
        """`memory` [MiB]."""
        return None if self.memory is None else self.memory / 2**20


def ratio(other: Cost, ours: Cost) -> float | None:
    """How many times the seconds of `ours` another takes; None if one of them is not known."""
    return other.seconds / ours.seconds if other.seconds and ours.seconds else None


@dataclass
class Peak:
    """Result of `peak_memory`; None where the system does not tell."""

    bytes: float | None = None


@contextmanager
def peak_memory(device: str) -> Iterator[Peak]:
    """How much memory the block inside needed at its peak.

    On CUDA all that torch had allocated, weights included; on a CPU the resident memory above that
    before the block (Linux only).
    """
    peak = Peak()
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        yield peak
        peak.bytes = float(torch.cuda.max_memory_allocated())
        return
    before = _reset_peak()
    yield peak
    after = _resident("VmHWM")
    if before is not None and after is not None:
        peak.bytes = max(0.0, after - before)


def _reset_peak() -> float | None:
    """Give freed memory back, start the kernel's peak anew and return what is resident [bytes]."""
    try:
        ctypes.CDLL("libc.so.6").malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")
    except (OSError, AttributeError):
        return None
    return _resident("VmRSS")


def _resident(key: str) -> float | None:
    return _kilobytes(_STATUS, key)


def _kilobytes(file: Path, key: str) -> float | None:
    """The entry `key` of a file such as /proc/meminfo [bytes]."""
    try:
        lines = file.read_text().splitlines()
    except OSError:
        return None
    for line in lines:
        if line.startswith(f"{key}:"):
            return 1024.0 * float(line.split()[1])
    return None


def free_memory() -> float | None:
    """Memory that this machine could still give [bytes]."""
    return _kilobytes(Path("/proc/meminfo"), "MemAvailable")


def clock(device: str, threads: int) -> tuple[str, Callable[[], float]]:
    """What seconds are counted by, by name: "CPU" where one thread of the CPU does the work.

    CPU seconds are those of the wall on an idle machine and stay true on a busy one.
    """
    if device == "cpu" and threads == 1:
        return "CPU", time.process_time
    return "wall", time.perf_counter


class Meter:
    """Measures one kind of work over growing sizes, as long as budget and memory hold.

    Args:
        device: torch device that the work runs on.
        now: returns seconds, see `clock`.
    """

    def __init__(self, device: str, now: Callable[[], float]) -> None:
        self.device = device
        self.now = now
        self._last: tuple[float, Cost] | None = None  # size and cost of the largest so far

    def measure(self, run: Callable[[int], object], size: float, budget: float) -> Cost:
        """The cost of a step of `run`: the least of a few repeats, as noise only ever adds.

        The first size is measured in any case, after one step that does not count: it compiles
        and loads.

        Args:
            run: does so many steps and waits for their end.
            size: what the cost is about proportional to, such as the number of edges.
            budget: seconds that may be spent here.
        """
        if (reason := self._too_much(size, budget)) is not None:
            return Cost(reason=reason)
        try:
            if self._last is None:
                run(1)
            began = self.now()
            with peak_memory(self.device) as peak:
                run(1)
            values = [self.now() - began]
            steps = max(1, min(MOST_STEPS, int(LEAST_SECONDS / max(values[0], 1e-9))))
            for _ in range(REPEATS):
                if self.now() - began + steps * values[0] > REPEAT_SHARE * budget:
                    break  # larger sizes need the time more
                start = self.now()
                run(steps)
                values.append((self.now() - start) / steps)
        except (torch.OutOfMemoryError, MemoryError):
            if self.device == "cuda":
                torch.cuda.empty_cache()
            return Cost(reason="exceeds memory")
        cost = Cost(min(values), peak.bytes)
        self._last = size, cost
        return cost

    def _too_much(self, size: float, budget: float) -> str | None:
        if self._last is None:
            return None
        before, cost = self._last
        growth = size / before
        if cost.seconds is not None and 2 * growth * cost.seconds > budget:
            return "exceeds the time budget"
        free = free_memory() if self.device == "cpu" else None
        if free is None or cost.memory is None:
            return None
        return "exceeds memory" if growth * cost.memory > MEMORY_SHARE * free else None

"""How a run ends when someone asks it to: soon, and with all that it has learned.

SIGINT and SIGTERM only set a flag, so that the step in progress is finished and all ranks stop
after the same one. A step or a frame of a rollout that takes longer than `GRACE` is given up: it
has changed nothing yet, and a resumed run takes it again from the same random numbers.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from gns_model.interrupts import AGAIN, come_back

#: Seconds that a step may still take after the request. Together with the time to save, and with
#: the single operations that Python cannot interrupt, this stays below the 10 s that we promise.
GRACE = 4.0


class Abandoned(BaseException):
    """The step in progress is given up. A BaseException, so that nobody takes it for a fault."""


class Stop:
    """The request to stop, and what it may interrupt."""

    def __init__(self) -> None:
        self.requested = False
        self._late = self._free = False
        self._timer: threading.Timer | None = None

    def request(self, number: int = signal.SIGTERM, _frame: FrameType | None = None) -> None:
        """Ask for the end: a signal handler. A second request does not wait for the step."""
        if not self.requested:
            self.requested = True
            self._come_back(GRACE)
            return
        self._late = True
        if self._free:
            # Raised in a destructor or a callback it would be ignored: then once more.
            self._come_back(AGAIN)
            raise Abandoned

    def _come_back(self, seconds: float) -> None:
        """Come back to the main thread as the same signal would."""
        self.close()
        self._timer = come_back(seconds, signal.SIGTERM)

    @contextmanager
    def may_abandon(self) -> Iterator[None]:
        """What runs in here changes nothing that has to last.

        Raises:
            Abandoned: out of the middle of it, `GRACE` after the request.
        """
        self._free = True
        try:
            if self._late:
                raise Abandoned
            yield
        except SystemError:
            # Compiled code that calls back into Python says so when that raised, as numba does.
            if self._late:
                raise Abandoned from None
            raise
        finally:
            self._free = False

    def close(self) -> None:
        """Forget the timer."""
        if self._timer is not None:
            self._timer.cancel()


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """A `Stop` that SIGINT and SIGTERM request, while this runs in the main thread."""
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, stop.request) for number in numbers]
    try:
        yield stop
    finally:
        stop.close()
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)

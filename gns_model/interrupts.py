"""Interrupts that land in the wrong place: one that Python ignores comes again, and one that would
cut something in two waits for its end.

Python raises KeyboardInterrupt between any two lines of whatever the main thread runs, libraries
included.
"""

from __future__ import annotations

import _thread
import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

#: Seconds until a signal whose exception Python ignored comes once more.
AGAIN = 0.1
#: Seconds after which a second interrupt no longer waits: what it waits for may be dead.
PATIENCE = 1.0


def come_back(seconds: float, number: signal.Signals) -> threading.Timer:
    """Have a signal come to the main thread in some seconds; the timer, to cancel it by."""
    timer = threading.Timer(seconds, _send, (number,))
    timer.daemon = True
    timer.start()
    return timer


def _send(number: signal.Signals) -> None:
    main = threading.main_thread().ident
    if main is not None and hasattr(signal, "pthread_kill"):
        signal.pthread_kill(main, number)  # ends a sleep or a wait too
    else:
        _thread.interrupt_main(number)


@contextlib.contextmanager
def none_lost() -> Iterator[None]:
    """An interrupt that lands in a destructor or in a callback of a weak reference is raised where
    Python ignores what is raised: it comes again a moment later."""
    before = sys.unraisablehook
    timers: list[threading.Timer] = []

    def hook(unraisable: sys.UnraisableHookArgs) -> None:
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            before(unraisable)
            return
        timers.append(come_back(AGAIN, signal.SIGINT))

    sys.unraisablehook = hook
    try:
        yield
    finally:
        for timer in timers:
            timer.cancel()
        sys.unraisablehook = before


@contextlib.contextmanager
def postponed() -> Iterator[None]:
    """Hold SIGINT and SIGTERM back until the end of what runs in here; also a decorator.

    For calls that leave a lock taken or a transaction open when an exception is raised between the
    wrong two lines of a library, so that everybody then waits for a holder who is gone. A second
    interrupt is let through after `PATIENCE` seconds. Does nothing outside the main thread, where
    no interrupt is raised.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    arrived: dict[int, float] = {}
    handlers: dict[int, Callable[[int, FrameType | None], Any]] = {}

    def later(number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if now - arrived.setdefault(number, now) >= PATIENCE:
            del arrived[number]
            handlers[number](number, frame)

    raised: BaseException | None = None
    try:
        for number in map(int, (signal.SIGINT, signal.SIGTERM)):
            handler = signal.getsignal(number)
            if callable(handler):  # neither ignored nor deadly
                handlers[number] = handler
                signal.signal(number, later)
        yield
    finally:
        while True:
            try:
                for number, handler in handlers.items():
                    signal.signal(number, handler)
                break
            except BaseException as error:  # by one that is back, before the other is
                raised = error
        if raised is not None:
            raise raised
        for number in arrived:
            signal.raise_signal(number)


@contextlib.contextmanager
def deaf() -> Iterator[None]:
    """Processes that are started in here do not hear SIGINT, from their first line on: a Ctrl-C in
    a terminal reaches them too, and whoever started them decides what it means."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # starting it later would unblock what is blocked
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)

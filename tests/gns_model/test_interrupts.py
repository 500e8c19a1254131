import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from gns_model import interrupts
from gns_model.interrupts import come_back, postponed

DEAF = """
import os, signal, time
import typer
from gns_model import console

class Deaf:
    def __del__(self):
        os.kill(os.getpid(), signal.{signal})
        for _ in range(1000):  # the interrupt is raised in here, where it is ignored
            pass

app = typer.Typer()

@app.command()
def run():
    Deaf()
    time.sleep(60)
    print("nobody heard")

console.main(app, "deaf")
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_an_interrupt_that_a_destructor_swallows_comes_again(name):
    began = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", DEAF.format(signal=name)],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert time.monotonic() - began < 50  # it ends the sleep
    assert done.returncode == 130
    assert done.stdout == ""
    assert done.stderr == "error: interrupted; what was finished is kept\n"


def interrupt(number: int = signal.SIGINT) -> None:
    os.kill(os.getpid(), number)
    for _ in range(1000):  # where a pending interrupt is raised
        pass


def terminated(number: int, frame: object) -> None:
    raise KeyboardInterrupt("terminated")


@pytest.fixture
def handlers():
    """SIGTERM as `console.main` treats it; both handlers must be there again in the end."""
    own = signal.getsignal(signal.SIGINT)
    before = signal.signal(signal.SIGTERM, terminated)
    yield
    assert signal.getsignal(signal.SIGINT) is own
    assert signal.signal(signal.SIGTERM, before) is terminated


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_waits_for_the_end(handlers, number):
    done = []

    @postponed()
    def outer():
        with postponed():
            interrupt(number)
            done.append("inner")
        done.append("outer")

    with pytest.raises(KeyboardInterrupt):
        outer()
    assert done == ["inner", "outer"]


def test_an_interrupt_is_not_lost_to_an_error(handlers):
    @postponed()
    def fail():
        interrupt()
        raise ValueError

    with pytest.raises(KeyboardInterrupt):
        fail()


def test_a_second_interrupt_a_while_later_is_let_through(handlers, monkeypatch):
    monkeypatch.setattr(interrupts, "PATIENCE", 0.2)
    done = []

    @postponed()
    def wait():
        interrupt()
        interrupt()  # an impatient user
        done.append("first")
        time.sleep(0.3)
        interrupt()
        done.append("second")

    with pytest.raises(KeyboardInterrupt):
        wait()
    assert done == ["first"]


def test_what_is_ignored_stays_ignored(handlers):
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with postponed():
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
            interrupt()
    finally:
        signal.signal(signal.SIGINT, before)


def test_other_threads_have_nothing_to_postpone(handlers):
    own, seen = signal.getsignal(signal.SIGINT), []

    @postponed()
    def look():
        seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    assert seen == [own]


def test_handlers_come_back_whenever_the_interrupts_come(handlers):
    """Also one that comes while they are exchanged, which raises right there."""
    raised, timers = 0, []  # kept: a thread that is freed calls back, where interrupts are ignored
    for k in range(200):
        try:
            timers.append(come_back(k * 1e-6, signal.SIGINT if k % 2 else signal.SIGTERM))
            deadline = time.monotonic() + 5
            while time.monotonic() < deadline:
                with postponed():
                    pass
        except KeyboardInterrupt:
            raised += 1
    assert raised == 200

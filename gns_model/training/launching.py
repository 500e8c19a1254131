"""Local ranks without torchrun: `gns-model train --ranks 4`."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch.distributed as dist

#: Seconds that the other ranks have to save and end when one has failed, or all were told to stop.
PATIENCE = 30.0
#: Seconds of it in which they are left alone: a rank that loses another in the middle of a step
#: says so and saves, unless a SIGTERM comes first and looks like the reason.
GRACE = 5.0

#: Tells a rank which process started it.
LAUNCHER = "GNS_LAUNCHER"


def launch(
    recipe: str | os.PathLike[str],
    out: str | os.PathLike[str],
    ranks: int,
    *,
    resume: bool = True,
    threads: int = 1,
    arguments: Sequence[str] = (),
    log: str | os.PathLike[str] | None = None,
    watch: Callable[[], None] | None = None,
) -> int:
    """Train on `ranks` local processes and wait for them.

    SIGINT and SIGTERM are passed on: every rank finishes its step, the state is saved, and all
    end. If one rank fails, the others save and are ended; one that was killed by a signal is named
    on stderr.

    Args:
        recipe: path of the recipe.
        out: folder for the results.
        ranks: number of processes.
        resume: go on from the state in `out`, if there is one.
        threads: of every rank.
        arguments: further arguments of `python -m gns_model.training`.
        log: file that takes what the ranks would print.
        watch: called ten times a second.

    Returns:
        0, or the exit code of the first rank that failed.
    """
    # The meeting place is ours for as long as the ranks live, as torchrun's agent keeps one: its
    # port is never free for others in between, and no rank that ends takes it away from the rest.
    store = dist.TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
    command = [sys.executable, "-m", "gns_model.training", str(recipe), "--out", str(out)]
    command += ["--resume" if resume else "--no-resume", *arguments]
    root = str(Path(__file__).resolve().parents[2])
    processes = []
    printed = open(log, "ab") if log is not None else None  # noqa: SIM115  (closed below)
    for rank in range(ranks):
        environment = dict(
            os.environ,
            RANK=str(rank),
            LOCAL_RANK=str(rank),
            WORLD_SIZE=str(ranks),
            MASTER_ADDR="127.0.0.1",
            MASTER_PORT=str(store.port),
            TORCHELASTIC_USE_AGENT_STORE="True",
            TORCHELASTIC_RESTART_COUNT="0",
            OMP_NUM_THREADS=str(threads),
            NUMBA_NUM_THREADS=str(threads),
            PYTHONPATH=os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")])),
        )
        environment[LAUNCHER] = str(os.getpid())
        # Its own process group, so that Ctrl-C reaches a rank once: from here.
        processes.append(
            subprocess.Popen(
                command,
                env=environment,
                start_new_session=True,
                stdout=printed,
                stderr=printed and subprocess.STDOUT,
            )
        )
    if printed is not None:
        printed.close()  # the ranks have their own ends of it

    def pass_on(number: int, _frame: object) -> None:
        for process in processes:
            if process.poll() is None:
                process.send_signal(number)

    before = {s: signal.signal(s, pass_on) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        while True:
            codes = [process.poll() for process in processes]
            failed = [code for code in codes if code]
            if failed:
                # One that was killed says nothing itself.
                if log is None and failed[0] < 0:
                    killed_by = signal.Signals(-failed[0]).name
                    print(
                        f"error: rank {codes.index(failed[0])} was killed by {killed_by}",
                        file=sys.stderr,
                        flush=True,
                    )
                _wait(processes, GRACE)
                pass_on(signal.SIGTERM, None)
                _wait(processes, PATIENCE - GRACE)
                for process in processes:
                    process.kill()
                return failed[0]
            if all(code == 0 for code in codes):
                return 0
            if watch is not None:
                watch()
            time.sleep(0.1)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for process in processes:
            if process.poll() is None:
                process.kill()


def _wait(processes: Sequence[subprocess.Popen[bytes]], seconds: float) -> None:
    """Until all have ended, or for `seconds`."""
    deadline = time.monotonic() + seconds
    for process in processes:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(max(0.0, deadline - time.monotonic()))


def end_with_launcher() -> None:
    """Let this rank get a SIGTERM should its launcher die (Linux; elsewhere it goes on alone).

    Otherwise ranks whose launcher was killed would train on unseen, and write into the folder in
    which the next run resumes.
    """
    launcher = os.environ.get(LAUNCHER)
    if launcher is None or not sys.platform.startswith("linux"):
        return
    set_parent_death_signal = 1  # PR_SET_PDEATHSIG of <linux/prctl.h>
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(set_parent_death_signal, int(signal.SIGTERM))
    try:
        os.kill(int(launcher), 0)
    except ProcessLookupError:  # it died before we asked
        os.kill(os.getpid(), signal.SIGTERM)

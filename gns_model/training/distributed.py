"""One process, or several that average their gradients: torchrun's conventions, gloo or NCCL.

The same script runs alone, under `torchrun` on one or more machines, and under `launch`, which
starts local ranks with torchrun's environment variables.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor


@dataclass(frozen=True)
class Ranks:
    """This process among its peers."""

    rank: int
    world: int
    device: torch.device

    def sum(self, values: Tensor) -> Tensor:
        """`values` summed over all ranks, in place; same shape and dtype on every rank."""
        if self.world > 1:
            dist.all_reduce(values)
        return values


@contextlib.contextmanager
def session(device: str = "auto", threads: int = 1) -> Iterator[Ranks]:
    """Join the other ranks, if the environment names any, and leave them at the end.

    Args:
        device: "auto" (CUDA if there is one), "cpu" or "cuda".
        threads: of this process, on a CPU.
    """
    threads_before = torch.get_num_threads()
    world, rank = int(os.environ.get("WORLD_SIZE", 1)), int(os.environ.get("RANK", 0))
    cuda = torch.cuda.is_available() if device == "auto" else device == "cuda"
    if cuda:
        place = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))
        torch.cuda.set_device(place)
    else:
        place = torch.device("cpu")
        torch.set_num_threads(threads)
        torch.set_flush_denormal(True)
        keep_heap()
    started = world > 1 and not dist.is_initialized()
    if started:
        dist.init_process_group("nccl" if cuda else "gloo", rank=rank, world_size=world)
    try:
        yield Ranks(rank, world, place)
    finally:
        if started:
            dist.destroy_process_group()
        if not cuda:
            # Other code of this process expects the arithmetic that it came with.
            torch.set_flush_denormal(False)
            torch.set_num_threads(threads_before)


def keep_heap() -> None:
    """Let glibc keep the memory of freed tensors for the next step.

    By default every large tensor is mapped and unmapped anew, and the page faults cost more than
    the arithmetic: a step with 58K edges took 1.4 to 1.7 s with MALLOC_MMAP_THRESHOLD_ = 4 MB and
    0.65 s so. What fragmentation piles up goes back through `release_heap`.
    """
    mmap_max, trim_threshold = -4, -1  # M_MMAP_MAX, M_TRIM_THRESHOLD of <malloc.h>
    with contextlib.suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        libc.mallopt(mmap_max, 0)
        libc.mallopt(trim_threshold, 2**31 - 1)


def release_heap() -> None:
    """Give free memory back to the system, in the middle of the heap, too (glibc; else nothing)."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def launch(
    recipe: str | os.PathLike[str],
    out: str | os.PathLike[str],
    ranks: int,
    *,
    resume: bool = True,
    threads: int = 1,
    arguments: Sequence[str] = (),
) -> int:
    """Train on `ranks` local processes and wait for them.

    SIGINT and SIGTERM are passed on: every rank finishes its step, the state is saved, and all
    end. If one rank fails, the others are ended.

    Args:
        recipe: path of the recipe.
        out: folder for the results.
        ranks: number of processes.
        resume: go on from the state in `out`, if there is one.
        threads: of every rank.
        arguments: further arguments of `python -m gns_model.training`.

    Returns:
        0, or the exit code of the first rank that failed.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "gns_model.training", str(recipe), "--out", str(out)]
    command += ["--resume" if resume else "--no-resume", *arguments]
    root = str(Path(__file__).resolve().parents[2])
    processes = []
    for rank in range(ranks):
        environment = dict(
            os.environ,
            RANK=str(rank),
            LOCAL_RANK=str(rank),
            WORLD_SIZE=str(ranks),
            MASTER_ADDR="127.0.0.1",
            MASTER_PORT=str(port),
            OMP_NUM_THREADS=str(threads),
            NUMBA_NUM_THREADS=str(threads),
            PYTHONPATH=os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")])),
        )
        # Its own process group, so that Ctrl-C reaches a rank once: from here.
        processes.append(subprocess.Popen(command, env=environment, start_new_session=True))

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
                pass_on(signal.SIGTERM, None)
                deadline = time.monotonic() + 30
                for process in processes:
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        process.wait(max(0.1, deadline - time.monotonic()))
                    process.kill()
                return failed[0]
            if all(code == 0 for code in codes):
                return 0
            time.sleep(0.1)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for process in processes:
            if process.poll() is None:
                process.kill()

"""One run in one folder: a lock while it trains, and no litter of those that were killed."""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

from gns_model.errors import GnsError
from gns_model.training.stopping import Stop

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

#: Seconds to wait for an earlier run, which was told to stop, to leave the folder.
WAIT = 15.0


class TrainingError(GnsError, RuntimeError):
    """Training that cannot go on; what was saved is kept."""


@contextlib.contextmanager
def claim(out: Path, stop: Stop) -> Iterator[None]:
    """Make `out` and lock it against other runs. The lock dies with the process.

    Two runs that save their states in turn into one folder would undo each other's work.

    Raises:
        TrainingError: if another run trains there.
        KeyboardInterrupt: if it is told to stop while it waits.
    """
    out.mkdir(parents=True, exist_ok=True)
    folder = os.open(out, os.O_RDONLY) if fcntl is not None else None
    try:
        deadline = time.monotonic() + WAIT
        while folder is not None and not _locked(folder):
            if stop.requested:
                raise KeyboardInterrupt
            if time.monotonic() > deadline:
                raise TrainingError(f"{out}: another run trains in this folder")
            time.sleep(0.2)
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                out.rmdir()  # only if nothing came of it
    finally:
        if folder is not None:
            os.close(folder)


def _locked(folder: int) -> bool:
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a disk without locks
        return True
    return True


def tidy(out: Path) -> None:
    """Remove what runs that were killed left in `out` under temporary names."""
    for name in ("state.safetensors", "recipe.json", "loss.png", "log.csv", "validation.csv"):
        for leftover in out.glob(f".{name}.*"):
            leftover.unlink(missing_ok=True)
    for name in ("model", "last"):
        for leftover in out.glob(f".{name}.*"):
            shutil.rmtree(leftover, ignore_errors=True)
        for file in ("model.safetensors", "card.json"):
            for leftover in (out / name).glob(f".{file}.*"):
                leftover.unlink(missing_ok=True)

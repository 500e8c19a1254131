"""A run folder belongs to one scene, and to one process at a time."""

from __future__ import annotations

import os
from pathlib import Path

from design.storage import StudyError
from gns_model.errors import GnsError
from gns_model.scene import Scene

try:
    import fcntl
except ImportError:  # Windows: two processes on one folder are not noticed there
    fcntl = None  # type: ignore[assignment]


def claim(folder: Path) -> int | None:
    """Take the folder for this process, however that ends; what `release` takes.

    The lock is on the folder itself, so that no file stays.

    Raises:
        StudyError: if another process works in it.
    """
    if fcntl is None:
        return None
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise StudyError(
            f"another process is at work in {folder}: give every worker an --out of its own"
        ) from None
    except OSError:  # a file system without locks
        os.close(handle)
        return None
    return handle


def release(handle: int | None) -> None:
    """Let others have the folder."""
    if handle is not None:
        os.close(handle)


def same_scene(folder: Path, scene: Scene) -> None:
    """Refuse a folder with a run of another scene.

    Raises:
        StudyError: if it holds one.
    """
    path = folder / "scene.toml"
    if not (folder / "summary.json").exists() or not path.exists():
        return
    try:
        other = Scene.from_toml(path)
    except GnsError:
        return
    if other.replace(baffles=()) != scene.replace(baffles=()):
        raise StudyError(f"{folder} holds a run of another scene: choose another --out")

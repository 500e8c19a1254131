"""Many scenes, a file each: one-thread processes side by side, each writing what it has finished.

A 2D scene is too small for threads, of which four take up to twenty times as long as one
(`benchmarks/mpm.py`), and processes scale.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gns_model.mpm.solver import MpmSimulator
from gns_model.scene import Scene
from gns_model.workers import Workers, report, results


def write_trajectories(
    todo: Sequence[tuple[Path, Scene, Mapping[str, Any]]],
    workers: int,
    *,
    progress: Callable[[float], None],
) -> None:
    """Simulate every scene and write its trajectory to its path, whole, as soon as it is there.

    Args:
        todo: paths of HDF5 files, the scenes that go into them and keyword arguments of
            `MpmSimulator`; a file there is replaced.
        workers: processes, one thread each.
        progress: called with the number of scenes done, parts of scenes included.

    Raises:
        WorkerError: if a process dies.
        SimulatorError, SceneError: if the solver cannot run a scene.
    """
    with Workers(min(workers, len(todo)), advice="a rerun with fewer --workers goes on") as pool:
        jobs = [pool.submit(_write, path, scene, dict(own)) for path, scene, own in todo]
        results(jobs, lambda fraction: progress(fraction * len(jobs)))


def _write(path: Path, scene: Scene, settings: dict[str, Any], slot: int) -> None:
    MpmSimulator(**settings).rollout([scene], progress=report(slot))[0].save(path)

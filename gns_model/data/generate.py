"""Make a dataset: many scenes, a process and a file each; a rerun goes on where it stopped."""

from __future__ import annotations

import json
import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from pathlib import Path

from gns_model.data.scenes import draw
from gns_model.errors import FileFormatError, GnsError
from gns_model.trajectory import open_trajectory


def file_name(family: str, seed: int, index: int) -> str:
    """Name of one trajectory's file."""
    return f"{family}-{seed}-{index:05d}.h5"


def parse_shard(text: str) -> tuple[int, int]:
    """Read "i/n", i from 0 to n - 1: this machine makes every n-th trajectory, from the i-th.

    Raises:
        GnsError: if it is anything else.
    """
    try:
        part, parts = (int(word) for word in text.split("/"))
        if not 0 <= part < parts:
            raise ValueError
    except ValueError:
        raise GnsError(f"--shard {text!r}: give i/n with 0 <= i < n, such as 0/4") from None
    return part, parts


def generate(
    out: str | os.PathLike[str],
    *,
    family: str,
    count: int,
    seed: int = 0,
    spacing: float | None = None,
    frame_interval: float = 0.01,
    workers: int = 1,
    shard: tuple[int, int] = (0, 1),
    progress: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Run scenes `0..count-1` of a family through the reference solver, one file each.

    Files that are there already are checked and kept, so a rerun continues; each file is written
    under a temporary name and renamed, so an interrupt leaves no half file.

    Args:
        out: folder of the dataset.
        family: see `gns_model.data.scenes`.
        count: number of trajectories in all shards together.
        seed: of the scenes.
        spacing: of the solver's points [m]; default: the paper's.
        frame_interval: between stored frames [s].
        workers: processes, one thread each.
        shard: (i, n): make only trajectories i, i + n, i + 2n, ...
        progress: called with (finished, all) of this shard.

    Returns:
        The files of this shard.

    Raises:
        FileFormatError: if a file that is there is truncated, foreign or of another dataset.
    """
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    part, parts = shard
    indices = range(part, count, parts)
    paths = {index: out / file_name(family, seed, index) for index in indices}
    missing = [i for i, path in paths.items() if not _is_there(path, family, seed, i, spacing)]
    finished = len(paths) - len(missing)
    if progress is not None:
        progress(finished, len(paths))
    if not missing:
        return list(paths.values())
    # spawn: a forked process would inherit threads of torch and numba in an unknown state.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(missing)), mp_context=context) as pool:
        jobs = {
            pool.submit(_make, paths[i], family, seed, i, spacing, frame_interval) for i in missing
        }
        try:
            while jobs:
                done, jobs = wait(jobs, return_when=FIRST_COMPLETED)
                for job in done:
                    job.result()
                    finished += 1
                    if progress is not None:
                        progress(finished, len(paths))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return list(paths.values())


def _is_there(path: Path, family: str, seed: int, index: int, spacing: float | None) -> bool:
    if not path.exists():
        return False
    with open_trajectory(path) as file:
        scene = json.loads(file.attrs["scene"])
        made_with = json.loads(file.attrs["settings"]).get("spacing")
    if scene.get("name") != draw(family, seed, index).name:
        raise FileFormatError(f"{path}: holds scene {scene.get('name')!r}, of another dataset")
    if spacing is not None and made_with != spacing:
        raise FileFormatError(f"{path}: made with spacing {made_with} m, not {spacing} m")
    return True


def _make(
    path: Path, family: str, seed: int, index: int, spacing: float | None, interval: float
) -> None:
    from gns_model.mpm import MpmSimulator

    scene = draw(family, seed, index)
    simulator = MpmSimulator(spacing=spacing, frame_interval=interval)
    simulator.rollout([scene])[0].save(path)

"""Make a dataset: many scenes, a file each; a rerun goes on where it stopped.

On CPUs every scene is a job for a one-thread process. A GPU takes a batch of scenes at once and
fills up at about a million points: 128 scenes of the paper's barriers, 32 of its flume, 300 of its
columns. So this makes the paper's dataset of barriers on a GPU machine:

    gns-model generate --family barriers --count 890 --frame-interval 0.0025 \\
        --device cuda --batch 128 --out data/paper-barriers/train
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gns_model.data.scenes import draw
from gns_model.errors import FileFormatError, GnsError, SceneError, SimulatorError
from gns_model.mpm.problem import DEFAULT_SPACING
from gns_model.particles import fill
from gns_model.scene import Scene
from gns_model.trajectory import open_trajectory

#: Solvers of `gns_model.mpm`: on a CPU numba is some ten times faster; torch runs on GPUs.
SOLVERS = ("numba", "torch")


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


def parse_points(text: str) -> tuple[int, float]:
    """Read "least:most", numbers of points; either may be left out.

    Raises:
        GnsError: if it is anything else.
    """
    try:
        least, most = text.split(":")
        bounds = int(least or 0), int(most) if most else math.inf
        if not 0 <= bounds[0] <= bounds[1]:
            raise ValueError
    except ValueError:
        raise GnsError(
            f"--points {text!r}: give least:most, such as 500:3000, :3000 or 500:"
        ) from None
    return bounds


def generate(
    out: str | os.PathLike[str],
    *,
    family: str,
    count: int,
    seed: int = 0,
    spacing: float | None = None,
    frame_interval: float = 0.01,
    jitter: float = 0.0,
    points: tuple[int, float] | None = None,
    workers: int = 1,
    solver: str | None = None,
    device: str = "cpu",
    batch: int = 32,
    shard: tuple[int, int] = (0, 1),
    progress: Callable[[float, int], None] | None = None,
) -> list[Path]:
    """Run the first `count` scenes of a family through the reference solver, one file each.

    Files that are there already are checked and kept, so a rerun continues; each file is written
    under a temporary name and renamed, so an interrupt leaves no half file.

    Args:
        out: folder of the dataset.
        family: see `gns_model.data.scenes`.
        count: number of trajectories in all shards together.
        seed: of the scenes.
        spacing: of the solver's points [m]; default: the paper's.
        frame_interval: between stored frames [s].
        jitter: how far the points of a start are moved off their lattice at random, in spacings,
            every scene's in its own way; see `mpm.problem.Discretisation`.
        points: (least, most): only scenes of as many points, the first `count` of the family.
        workers: processes of the numba solver, one thread each.
        solver: "numba" or "torch"; default: what suits the device. Files agree within round-off.
        device: "cpu", or for the torch solver "cuda".
        batch: scenes that the torch solver advances at once; their files appear together.
        shard: (i, n): make only trajectories i, i + n, i + 2n, ...
        progress: called with (finished, all) of this shard; parts of trajectories count.

    Returns:
        The files of this shard.

    Raises:
        FileFormatError: if a file that is there is truncated, foreign or of another dataset.
        SimulatorError: if there is no such solver or device, or a batch does not fit on it.
        SceneError: if hardly any scene of the family has so many points.
    """
    if solver is None:
        solver = "numba" if device == "cpu" else "torch"
    if solver not in SOLVERS:
        raise SimulatorError(f"no solver {solver!r}: give {' or '.join(SOLVERS)}")
    if solver == "numba" and device != "cpu":
        raise SimulatorError(f"the numba solver runs on the CPU: give torch for device {device!r}")
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    part, parts = shard
    indices = select(count, family, seed, spacing, points)[part::parts]
    paths = {index: out / file_name(family, seed, index) for index in indices}
    settings = {"spacing": spacing, "frame_interval": frame_interval, "jitter": jitter}
    missing = [i for i, path in paths.items() if not _is_there(path, family, seed, i, settings)]
    finished = len(paths) - len(missing)
    if progress is not None:
        progress(finished, len(paths))
    if not missing:
        return list(paths.values())

    def report(made: float) -> None:
        if progress is not None:
            progress(finished + made, len(paths))

    todo = [(paths[i], draw(family, seed, i), i if jitter else 0) for i in missing]
    if solver == "numba":
        from gns_model.mpm.side_by_side import write_trajectories

        write_trajectories(
            [(path, scene, {**settings, "filling": filling}) for path, scene, filling in todo],
            workers,
            progress=report,
        )
    else:
        _by_batches(todo, batch, settings, device, report)
    return list(paths.values())


#: Draws in search of one scene that has as many points as asked for.
DRAWS = 100


def select(
    count: int,
    family: str,
    seed: int,
    spacing: float | None,
    points: tuple[int, float] | None,
) -> Sequence[int]:
    """Indices of the first `count` scenes of a family with (least, most) points at `spacing`.

    Raises:
        SceneError: if hardly any scene of the family has so many.
    """
    if points is None:
        return range(count)
    found: list[int] = []
    for index in range(DRAWS * count):
        scene = draw(family, seed, index)
        size = len(fill(scene, spacing or DEFAULT_SPACING[scene.dim]).positions)
        if points[0] <= size <= points[1]:
            found.append(index)
        if len(found) == count:
            return found
    raise SceneError(
        f"only {len(found)} of the first {DRAWS * count} scenes of {family} have {points[0]} to "
        f"{points[1]} points: ask for fewer, or for a wider range"
    )


def _by_batches(
    todo: Sequence[tuple[Path, Scene, int]],
    batch: int,
    settings: dict[str, Any],
    device: str,
    report: Callable[[float], None],
) -> None:
    from gns_model.mpm.torch_solver import TorchMpmSimulator

    simulator = TorchMpmSimulator(**settings, device=device, batch=batch)
    for first in range(0, len(todo), batch):
        some = todo[first : first + batch]

        def within(fraction: float, first: int = first, size: int = len(some)) -> None:
            report(first + fraction * size)

        _, scenes, fillings = zip(*some, strict=True)
        trajectories = simulator.rollout(scenes, fillings=fillings, progress=within)
        for (path, *_), trajectory in zip(some, trajectories, strict=True):
            trajectory.save(path)


def _is_there(
    path: Path, family: str, seed: int, index: int, wanted: dict[str, float | None]
) -> bool:
    if not path.exists():
        return False
    with open_trajectory(path) as file:
        scene = json.loads(file.attrs["scene"])
        settings = {"jitter": 0.0, **json.loads(file.attrs["settings"])}  # older files say none
    if scene.get("name") != draw(family, seed, index).name:
        raise FileFormatError(f"{path}: holds scene {scene.get('name')!r}, of another dataset")
    for key, value in wanted.items():
        if value is not None and settings.get(key) != value:
            raise FileFormatError(f"{path}: made with {key} {settings.get(key)}, not {value}")
    return True

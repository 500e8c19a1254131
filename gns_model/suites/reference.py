"""Trajectories of our own solver, kept beside the results so that a rerun does not wait for them.

A file counts when its scene, the solver's settings and the solver's own source are those asked
for; anything else, a truncated file too, is simulated anew.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from gns_model import mpm, particles
from gns_model.errors import FileFormatError, SimulatorError
from gns_model.mpm import MpmSimulator
from gns_model.mpm.side_by_side import write_trajectories
from gns_model.scene import Scene
from gns_model.simulator import Progress
from gns_model.trajectory import OK, Trajectory

#: Name of the folder in the results that holds the files.
FOLDER = "reference"


def references(
    scenes: Sequence[Scene],
    folder: Path,
    *,
    interval: float,
    spacing: float | None = None,
    threads: int = 1,
    jitter: float = 0.0,
    filling: int = 0,
    stage: Callable[[str], Progress],
) -> list[Trajectory]:
    """The solver's trajectory of every scene, read from `folder` or simulated and kept there.

    Args:
        interval: between frames [s].
        spacing: of the solver's points [m]; default: the solver's own.
        threads: of the solver, or processes for several scenes; its results do not depend on it.
        jitter, filling: of the solver, see `mpm.problem.Discretisation`.
        stage: opens a progress bar, if there is anything to simulate.

    Raises:
        SimulatorError: if the solver cannot run a scene or diverges on it.
    """
    settings: dict[str, Any] = {
        "spacing": spacing, "frame_interval": interval, "jitter": jitter, "filling": filling,
    }  # fmt: skip
    solver = MpmSimulator(**settings, threads=threads)
    files = [_file(scene, folder / FOLDER, solver) for scene in scenes]
    found = [_load(file, scene) for file, scene in zip(files, scenes, strict=True)]
    missing = [k for k, trajectory in enumerate(found) if trajectory is None]
    if missing:
        progress = stage(f"reference solver, {len(missing)} scene{'s' * (len(missing) > 1)}")
        todo = [(files[k], scenes[k], settings) for k in missing]
        if threads > 1 and len(missing) > 1:
            write_trajectories(todo, threads, progress=lambda done: progress(done / len(todo)))
        else:
            for done, (file, scene, _) in enumerate(todo):

                def advance(fraction: float, done: int = done) -> None:
                    progress((done + fraction) / len(todo))

                solver.rollout([scene], progress=advance)[0].save(file)
        for k in missing:
            trajectory = Trajectory.load(files[k])
            if trajectory.status != OK:
                raise SimulatorError(
                    f"the reference solver {trajectory.status} on scene {scenes[k].name!r}: "
                    "nothing can be held against it"
                )
            found[k] = trajectory
    return [trajectory for trajectory in found if trajectory is not None]


def _file(scene: Scene, folder: Path, solver: MpmSimulator) -> Path:
    """Where the trajectory is kept: the name holds a hash of all that decides what is in it."""
    settings = {k: v for k, v in solver.settings().items() if k not in ("threads", "workers")}
    settings["spacing"] = solver.chosen.spacing_of(scene)
    text = json.dumps([scene.to_dict(), settings, _solver_source()], sort_keys=True)
    return folder / f"{scene.name}-{hashlib.sha256(text.encode()).hexdigest()[:12]}.h5"


def _load(file: Path, scene: Scene) -> Trajectory | None:
    if not file.exists():
        return None
    try:
        trajectory = Trajectory.load(file)
    except FileFormatError:
        return None
    return trajectory if trajectory.scene == scene and trajectory.status == OK else None


@cache
def _solver_source() -> str:
    """Hash of the source that a trajectory follows from: a better solver makes new references."""
    folder = Path(str(mpm.__file__)).parent
    files = [folder / f"{n}.py" for n in ("solver", "problem", "transfer", "material", "contact")]
    content = b"".join(file.read_bytes() for file in [*files, Path(particles.__file__)])
    return hashlib.sha256(content).hexdigest()

"""Rollouts that a run keeps: each is simulated once, in a worker, and found again on a rerun.

    RUN/rollouts/<simulator>-<digest>.json    measures, status, seconds: written last
    RUN/rollouts/<simulator>-<digest>.h5      the trajectory
    RUN/trajectories/<layout>-<role>.h5       names for the ones that are looked at (hard links)

The digest is of the scene and of the simulator with its options and weights.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from design.evaluators import SimulatorSpec
from gns_model import measures as hard
from gns_model.errors import GnsError
from gns_model.files import link_or_copy, write_whole
from gns_model.scene import Scene
from gns_model.workers import Job, Workers, as_completed, report

if TYPE_CHECKING:
    from rich.progress import Progress


@dataclass(frozen=True)
class Rolled:
    """A finished rollout: how it ended, its measures, what it cost [s], its trajectory file, and
    the sizes of its baffles [m]."""

    status: str
    measures: dict[str, float]
    seconds: float
    path: Path
    sizes: tuple[tuple[float, ...], ...] = ()


class Pending:
    """A rollout that was asked for; perhaps it was there already."""

    def __init__(self, path: Path, job: Job | None) -> None:
        self._path, self.job = path, job

    @property
    def fraction(self) -> float:
        """How far it is, 0 to 1."""
        return 1.0 if self.job is None else self.job.fraction

    def result(self) -> Rolled:
        """The rollout; waits for it."""
        if self.job is not None:
            self.job.result()
        found = _read(self._path)
        if found is None:
            raise GnsError(f"{self._path}: was written and cannot be read back")
        return found


class RolloutStore:
    """The rollouts of one run folder."""

    def __init__(self, folder: Path, workers: Workers) -> None:
        self.folder, self._workers = Path(folder), workers
        (self.folder / "rollouts").mkdir(parents=True, exist_ok=True)

    def start(self, spec: SimulatorSpec, scene: Scene, *, trajectory: bool = True) -> Pending:
        """Have `scene` simulated in a worker (on a GPU: here and now), unless it was before.

        `trajectory`: measures alone are not enough."""
        text = json.dumps([scene.to_dict(), spec.describe()], sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()[:12]
        stem = f"{Path(spec.name).name}-{digest}"
        path = self.folder / "rollouts" / f"{stem}.h5"
        if _read(path) is not None and (path.exists() or not trajectory):
            return Pending(path, None)
        values = json.dumps(scene.to_dict())
        if spec.device != "cpu":
            simulate_job(spec, values, path, 0)
            return Pending(path, None)
        return Pending(path, self._workers.submit(simulate_job, spec, values, path))

    def roll(
        self, spec: SimulatorSpec, flows: Sequence[Scene], *, trajectory: bool = True
    ) -> list[Pending]:
        """`start` each of `flows`, such as a layout in several scenarios."""
        return [self.start(spec, flow, trajectory=trajectory) for flow in flows]

    def name(self, rolled: Rolled, stem: str) -> None:
        """Let `trajectories/<stem>.h5` be this rollout's trajectory."""
        link = self.folder / "trajectories" / f"{stem}.h5"
        link.parent.mkdir(parents=True, exist_ok=True)
        temporary = link.with_name(f".{link.name}.{os.getpid()}")
        temporary.unlink(missing_ok=True)
        link_or_copy(rolled.path, temporary)
        os.replace(temporary, link)

    def prune(self, named: set[Path]) -> None:
        """Delete trajectories without a name, tens of megabytes each; their measures stay."""
        for path in (self.folder / "rollouts").glob("*.h5"):
            if path not in named:
                path.unlink()


class Watch:
    """Shows how far rollouts in workers are, while somebody waits for this or for another."""

    def __init__(self, bar: Progress) -> None:
        self.bar = bar
        self._shown: list[tuple[Any, list[Pending]]] = []

    def add(self, title: str, pending: Sequence[Pending]) -> None:
        """Show those of `pending` that were not found finished as one bar."""
        running = [p for p in pending if p.job is not None]
        if running:
            self._shown.append((self.bar.add_task(title, total=len(running)), running))

    def update(self) -> None:
        """Draw what is known now."""
        for task, pending in self._shown:
            self.bar.update(task, completed=sum(p.fraction for p in pending))

    def wait(self, pending: Sequence[Pending]) -> None:
        """Return when all of `pending` have ended."""
        for _ in as_completed([p.job for p in pending if p.job is not None], self.update):
            self.update()


def simulate_job(spec: SimulatorSpec, scene: str, path: Path, slot: int) -> None:
    """In a worker: simulate, write the trajectory, then its measures. `scene` is JSON."""
    started = time.perf_counter()
    trajectory = spec.load().rollout([Scene.from_dict(json.loads(scene))], progress=report(slot))[0]
    values = hard.summary(trajectory)
    trajectory.save(path)
    record = {
        "status": trajectory.status,
        "measures": values,
        "seconds": time.perf_counter() - started,
        "sizes": [baffle.size for baffle in trajectory.scene.baffles],
    }
    write_whole(path.with_suffix(".json"), json.dumps(record, indent=1).encode())


def _read(path: Path) -> Rolled | None:
    try:
        record = json.loads(path.with_suffix(".json").read_text())
        sizes = tuple(tuple(map(float, size)) for size in record["sizes"])
        return Rolled(record["status"], record["measures"], record["seconds"], path, sizes)
    except (OSError, ValueError, KeyError):
        return None

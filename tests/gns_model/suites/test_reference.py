from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gns_model.errors import SimulatorError
from gns_model.mpm import MpmSimulator
from gns_model.suites import reference
from gns_model.suites.reference import references
from gns_model.suites.setup import silent
from gns_model.trajectory import Trajectory


@pytest.fixture
def simulated(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the scenes that the solver really ran."""
    names: list[str] = []
    original = MpmSimulator.rollout

    def rollout(self, scenes, *, progress=None):
        names.extend(scene.name for scene in scenes)
        return original(self, scenes, progress=progress)

    monkeypatch.setattr(MpmSimulator, "rollout", rollout)
    return names


def run(scenes, folder: Path, **options) -> list[Trajectory]:
    return references(
        scenes, folder, **{"interval": 0.05, "spacing": 0.05, "stage": silent, **options}
    )


def test_a_rerun_reads_what_the_first_run_kept(plane_scene, simulated, tmp_path: Path):
    other = plane_scene.with_baffles([]).replace(name="free")
    first = run([plane_scene, other], tmp_path)
    assert simulated == ["plane", "free"]
    again = run([other, plane_scene], tmp_path, threads=2)
    assert simulated == ["plane", "free"]
    np.testing.assert_array_equal(again[1].positions, first[0].positions)
    assert [t.scene for t in again] == [other, plane_scene]


def test_another_scene_or_setting_is_simulated(plane_scene, simulated, tmp_path: Path):
    run([plane_scene], tmp_path)
    longer = plane_scene.replace(duration=0.45)
    assert run([longer], tmp_path)[0].scene == longer
    assert run([plane_scene], tmp_path, interval=0.1)[0].time[1] == pytest.approx(0.1)
    assert run([plane_scene], tmp_path, spacing=0.04)[0].settings["spacing"] == 0.04
    assert len(simulated) == 4


def test_a_better_solver_makes_new_references(plane_scene, simulated, tmp_path, monkeypatch):
    run([plane_scene], tmp_path)
    monkeypatch.setattr(reference, "_solver_source", lambda: "changed")
    run([plane_scene], tmp_path)
    assert len(simulated) == 2


def test_a_truncated_file_is_simulated_anew(plane_scene, simulated, tmp_path: Path):
    (whole,) = run([plane_scene], tmp_path)
    (file,) = (tmp_path / reference.FOLDER).glob("*.h5")
    file.write_bytes(file.read_bytes()[:-1000])
    (again,) = run([plane_scene], tmp_path)
    np.testing.assert_array_equal(again.positions, whole.positions)
    assert len(simulated) == 2


def test_progress_covers_what_is_missing(plane_scene, tmp_path: Path):
    stages: dict[str, list[float]] = {}

    def stage(description: str):
        seen = stages.setdefault(description, [])
        return seen.append

    scenes = [plane_scene, plane_scene.replace(name="other")]
    run(scenes[:1], tmp_path)
    run(scenes, tmp_path, stage=stage)
    ((description, seen),) = stages.items()
    assert description == "reference solver, 1 scene"
    assert seen == sorted(seen)
    assert seen[-1] == 1.0
    run(scenes, tmp_path, stage=stage)
    assert len(stages) == 1


def test_a_reference_that_diverges_is_refused(plane_scene, tmp_path: Path, monkeypatch):
    original = MpmSimulator.rollout

    def rollout(self, scenes, *, progress=None):
        trajectories = original(self, scenes, progress=progress)
        for trajectory in trajectories:
            trajectory.status = "diverged"
        return trajectories

    monkeypatch.setattr(MpmSimulator, "rollout", rollout)
    with pytest.raises(SimulatorError, match="reference solver diverged on scene 'plane'"):
        run([plane_scene], tmp_path)


def test_side_by_side_keeps_the_same_files(plane_scene, simulated, tmp_path: Path):
    """Several missing scenes on several cores: processes of one thread, a file each."""
    scenes = [plane_scene, plane_scene.replace(name="other", duration=0.3)]
    alone = run(scenes, tmp_path / "alone")
    assert simulated == ["plane", "other"]
    seen: list[float] = []
    together = run(scenes, tmp_path / "together", threads=2, stage=lambda _: seen.append)
    assert simulated == ["plane", "other"]  # not in this process
    for one, other in zip(alone, together, strict=True):
        assert one.scene == other.scene
        np.testing.assert_array_equal(one.positions, other.positions)
    assert seen == sorted(seen)
    assert seen[-1] == 1.0
    names = [
        sorted(f.name for f in (tmp_path / who).rglob("*.h5")) for who in ("alone", "together")
    ]
    assert names[0] == names[1]
    run(scenes, tmp_path / "together", threads=2)
    assert simulated == ["plane", "other"]

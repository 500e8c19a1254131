"""A dataset is the same whoever makes it, and a rerun goes on where an earlier one stopped."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from gns_model import cli, console
from gns_model.data.generate import file_name, generate, parse_points
from gns_model.errors import FileFormatError, GnsError, SceneError, SimulatorError
from gns_model.trajectory import Trajectory

WANTED = {"family": "barriers", "count": 3, "seed": 4, "spacing": 0.1, "frame_interval": 0.02}


@pytest.fixture(scope="module")
def by_torch(tmp_path_factory):
    """A folder made by the torch solver in batches of two, and the progress that it told."""
    folder, told = tmp_path_factory.mktemp("torch"), []
    generate(folder, **WANTED, solver="torch", batch=2, progress=lambda *a: told.append(a))
    return folder, told


def test_torch_makes_the_files_that_numba_makes(by_torch, tmp_path):
    folder, told = by_torch
    names = [file_name("barriers", 4, i) for i in range(3)]
    assert sorted(p.name for p in folder.iterdir()) == names
    assert told == sorted(told)
    assert (told[0], told[-1]) == ((0, 3), (3, 3))
    paths = generate(tmp_path, **WANTED, workers=1)
    assert [p.name for p in paths] == names
    for path in paths:
        a, b = Trajectory.load(path), Trajectory.load(folder / path.name)
        assert a.scene == b.scene
        assert (a.status, a.simulator, a.point_volume) == (b.status, b.simulator, b.point_volume)
        np.testing.assert_allclose(a.positions, b.positions, rtol=0, atol=1e-6)
        np.testing.assert_array_equal(a.time, b.time)
        np.testing.assert_array_equal(a.lattice, b.lattice)


def test_an_interrupt_keeps_whole_batches_and_a_rerun_goes_on(by_torch, tmp_path):
    def interrupt(done, total):
        if done > 2:  # within the second batch
            raise KeyboardInterrupt

    wanted = {**WANTED, "solver": "torch", "batch": 2}
    with pytest.raises(KeyboardInterrupt):
        generate(tmp_path, **wanted, progress=interrupt)
    made = sorted(tmp_path.iterdir())
    assert [p.name for p in made] == [file_name("barriers", 4, i) for i in range(2)]
    before = [p.read_bytes() for p in made]
    told = []
    generate(tmp_path, **wanted, progress=lambda *a: told.append(a))
    assert told[0] == (2, 3)
    assert [p.read_bytes() for p in made] == before, "a finished file was made again"
    for path in sorted(tmp_path.iterdir()):
        np.testing.assert_array_equal(
            Trajectory.load(path).positions, Trajectory.load(by_torch[0] / path.name).positions
        )


def test_every_scene_is_filled_in_its_own_way(by_torch, tmp_path):
    for solver in ("torch", "numba"):
        generate(tmp_path / solver, **WANTED, jitter=0.25, solver=solver, batch=2)
    ways = []
    for i in range(3):
        name = file_name("barriers", 4, i)
        lattice = Trajectory.load(by_torch[0] / name)
        a, b = (Trajectory.load(tmp_path / solver / name) for solver in ("numba", "torch"))
        assert a.settings["filling"] == b.settings["filling"] == i
        np.testing.assert_allclose(a.positions, b.positions, rtol=0, atol=1e-6)
        shift = (a.positions[0] - lattice.positions[0]) / WANTED["spacing"]
        assert 0.2 < np.abs(shift).max() <= 0.25 + 1e-6
        ways.append(shift[:20])
    assert not np.allclose(ways[0], ways[1])
    with pytest.raises(SimulatorError, match="jitter"):
        generate(tmp_path / "far", **WANTED, jitter=0.5, workers=1)


@pytest.mark.parametrize("other", [{"spacing": 0.05}, {"frame_interval": 0.01}, {"jitter": 0.1}])
def test_files_of_another_dataset_are_refused(by_torch, other):
    with pytest.raises(FileFormatError, match=next(iter(other))):
        generate(by_torch[0], **{**WANTED, **other}, solver="torch")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"solver": "numba", "device": "cuda"}, "runs on the CPU"),
        ({"solver": "fortran"}, "numba or torch"),
        ({"device": "quantum"}, "quantum"),
        ({"solver": "torch", "batch": 0}, "batch"),
    ],
)
def test_a_solver_or_device_that_is_not_there_is_refused(tmp_path, options, message):
    with pytest.raises(SimulatorError, match=message):
        generate(tmp_path, **WANTED, **options)
    assert issubclass(SimulatorError, GnsError)


def test_the_command_takes_solver_device_and_batch(tmp_path, capsys):
    def run(*more):
        with pytest.raises(SystemExit) as left:
            console.main(
                cli.app,
                "gns-model",
                ["generate", "--out", str(tmp_path), "--family", "barriers", "--count", "1",
                 "--spacing", "0.1", "--frame-interval", "0.2", "--quiet", *more],
            )  # fmt: skip
        return left.value.code, *capsys.readouterr()

    code, out, _ = run("--solver", "torch", "--device", "cpu", "--batch", "4")
    assert code in (0, None)
    assert "1 trajectories" in out
    settings = Trajectory.load(tmp_path / file_name("barriers", 0, 0)).settings
    assert (settings["device"], settings["batch"]) == ("cpu", 4)
    for wrong in (["--solver", "numba", "--device", "cuda"], ["--solver", "magic"]):
        code, _, error = run(*wrong)
        assert code == 2
        assert len(error.splitlines()) == 1


@pytest.mark.slow
def test_ctrl_c_ends_the_command_at_once_and_keeps_whole_files(tmp_path):
    """It used to wait for every scene that was queued."""
    out = tmp_path / "data"
    command = ["generate", "--family", "squares", "--count", "500", "--workers", "2", "--quiet"]
    process = subprocess.Popen(
        [sys.executable, "-m", "gns_model.cli", *command, "--out", str(out)],
        stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    try:
        deadline = time.monotonic() + 200
        while not list(out.glob("*.h5")) and time.monotonic() < deadline:
            time.sleep(0.05)
        began = time.monotonic()
        os.killpg(process.pid, signal.SIGINT)  # a terminal tells the workers too
        _, err = process.communicate(timeout=120)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert time.monotonic() - began < 30
    assert process.returncode == 130
    assert err == "error: interrupted; what was finished is kept\n"
    paths = list(out.glob("*.h5"))
    assert 1 <= len(paths) < 500
    assert all(Trajectory.load(path).status == "ok" for path in paths)


def test_only_scenes_of_as_many_points_as_asked_for(tmp_path):
    """They keep their numbers, so a dataset of small flows is a part of the whole one."""
    coarse = {**WANTED, "count": 4}
    every = [len(Trajectory.load(p).positions[0]) for p in generate(tmp_path / "all", **coarse)]
    bounds = (sorted(every)[1], sorted(every)[2])
    wanted = {**coarse, "count": 2, "points": bounds}
    paths = generate(tmp_path / "some", **wanted, workers=1)
    within = [k for k, points in enumerate(every) if bounds[0] <= points <= bounds[1]][:2]
    assert [p.name for p in paths] == [file_name("barriers", 4, k) for k in within]
    parts = [generate(tmp_path / "some", **wanted, shard=(k, 2)) for k in range(2)]
    assert sorted(parts[0] + parts[1]) == sorted(paths)
    with pytest.raises(SceneError, match="only 0 of the first 100 scenes of barriers have 1 to 2"):
        generate(tmp_path / "none", **{**wanted, "count": 1, "points": (1, 2)})


def test_a_range_of_points_is_read_or_refused_in_one_line():
    assert parse_points("500:3000") == (500, 3000)
    assert parse_points(":3000") == (0, 3000)
    assert parse_points("500:") == (500, np.inf)
    for text in ("3000", "3000:500", "a:b", "1:2:3", "-1:5", ""):
        with pytest.raises(GnsError, match="give least:most"):
            parse_points(text)

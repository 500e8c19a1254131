from __future__ import annotations

import contextlib
import dataclasses
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gns_model.errors import FileFormatError
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory, open_trajectory


@pytest.fixture(scope="module")
def trajectory(small_flume: Scene, trajectory_of) -> Trajectory:
    rng = np.random.default_rng(0)
    positions = rng.uniform(0, 0.5, (7, 50, 3)).astype(np.float32)
    return trajectory_of(
        positions,
        small_flume,
        status="diverged",
        settings={"spacing": 0.05, "seconds": 1.25, "note": 'ä " \\ \n'},
        lattice=rng.integers(0, 9, (50, 3)).astype(np.int32),
    )


@pytest.fixture(scope="module")
def content(trajectory: Trajectory, tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("whole") / "t.h5"
    trajectory.save(path)
    return path.read_bytes()


def test_round_trip(trajectory: Trajectory, tmp_path: Path):
    path = tmp_path / "deep" / "t.h5"
    trajectory.save(path)
    back = Trajectory.load(path)
    for field in dataclasses.fields(Trajectory):
        ours, theirs = getattr(trajectory, field.name), getattr(back, field.name)
        if isinstance(ours, np.ndarray):
            np.testing.assert_array_equal(ours, theirs)
            assert ours.dtype == theirs.dtype
        else:
            assert ours == theirs, field.name
    assert back.point_mass == pytest.approx(1.8)
    assert list(path.parent.iterdir()) == [path]


def test_frames_can_be_read_one_by_one(trajectory: Trajectory, tmp_path: Path):
    trajectory.save(tmp_path / "t.h5")
    with open_trajectory(tmp_path / "t.h5") as file:
        np.testing.assert_array_equal(file["positions"][3], trajectory.positions[3])


def test_without_lattice(trajectory: Trajectory, tmp_path: Path):
    dataclasses.replace(trajectory, lattice=None).save(tmp_path / "t.h5")
    assert Trajectory.load(tmp_path / "t.h5").lattice is None


@given(st.data())
def test_a_truncated_file_is_named(content: bytes, tmp_path_factory, data: st.DataObject):
    path = tmp_path_factory.mktemp("cut") / "cut.h5"
    path.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
    for read in (Trajectory.load, open_trajectory):
        with pytest.raises(FileFormatError) as caught:
            read(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)


# The same bytes every time: libhdf5 itself is not proof against every damage.
@settings(derandomize=True)
@given(st.data())
def test_a_damaged_file_reads_or_is_named(content: bytes, tmp_path_factory, data: st.DataObject):
    """A flipped byte may land in a coordinate; elsewhere the error is ours."""
    path = tmp_path_factory.mktemp("flip") / "flip.h5"
    damaged = bytearray(content)
    for _ in range(data.draw(st.integers(1, 8))):
        damaged[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(damaged)
    with contextlib.suppress(FileFormatError):
        # Any other exception is a traceback that a user would see.
        assert np.ndim(Trajectory.load(path).positions) == 3


def test_foreign_files_are_named(trajectory: Trajectory, tmp_path: Path):
    path = tmp_path / "foreign.h5"
    for content in (b"", b"x,y\n1,2\n", b"\x89PNG\r\n\x1a\n" + bytes(64)):
        path.write_bytes(content)
        with pytest.raises(FileFormatError, match="not an HDF5 file") as caught:
            Trajectory.load(path)
        assert str(path) in str(caught.value)
    with h5py.File(path, "w") as file:
        file["pressure"] = np.zeros(3)
    with pytest.raises(FileFormatError, match="not a gns-trajectory"):
        Trajectory.load(path)
    with pytest.raises(FileFormatError, match="no such file"):
        Trajectory.load(tmp_path / "none.h5")
    with pytest.raises(FileFormatError, match="no such file"):
        Trajectory.load(tmp_path)


@pytest.mark.parametrize(
    ("attribute", "value", "fragment"),
    [
        ("version", 99, "version 99"),
        ("frames", 8, "7 of 8 frames"),
        ("frames", None, "truncated"),
        ("scene", "{", "scene"),
        ("scene", '{"domain": 3}', "domain"),
        ("scene", None, "scene"),
        ("settings", "[", "settings"),
        ("point_volume", "heavy", "point_volume"),
    ],
)
def test_a_wrong_attribute_is_named(
    trajectory: Trajectory, tmp_path: Path, attribute: str, value: object, fragment: str
):
    path = tmp_path / "t.h5"
    trajectory.save(path)
    with h5py.File(path, "a") as file:
        del file.attrs[attribute]
        if value is not None:
            file.attrs[attribute] = value
    with pytest.raises(FileFormatError, match=fragment) as caught:
        Trajectory.load(path)
    assert str(path) in str(caught.value)


def test_a_missing_dataset_is_named(trajectory: Trajectory, tmp_path: Path):
    path = tmp_path / "t.h5"
    for name in ("positions", "time", "particle_type"):
        trajectory.save(path)
        with h5py.File(path, "a") as file:
            del file[name]
        with pytest.raises(FileFormatError, match=name):
            Trajectory.load(path)


def test_a_failed_write_leaves_the_old_file_and_no_half_one(
    trajectory: Trajectory, tmp_path: Path, content: bytes
):
    path = tmp_path / "t.h5"
    trajectory.save(path)
    before = path.read_bytes()
    with pytest.raises(TypeError):
        dataclasses.replace(trajectory, settings={"not": object()}).save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_leaves_no_half_file(trajectory: Trajectory, tmp_path: Path):
    """A limit on the size of files stands in for the disk: the same write fails in the kernel."""
    trajectory.save(tmp_path / "old.h5")
    before = (tmp_path / "old.h5").read_bytes()
    script = (
        "import resource, signal, sys, dataclasses\n"
        "import numpy as np\n"
        "from gns_model.trajectory import Trajectory\n"
        "t = Trajectory.load(sys.argv[1])\n"
        "big = dataclasses.replace(t, positions=np.tile(t.positions, (1, 400, 1)), lattice=None)\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "try:\n"
        "    big.save(sys.argv[1])\n"
        "except OSError as error:\n"
        "    print('OSError', error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path / "old.h5")],
        capture_output=True, text=True, timeout=120, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("OSError")
    assert [p.name for p in tmp_path.iterdir()] == ["old.h5"]
    assert (tmp_path / "old.h5").read_bytes() == before

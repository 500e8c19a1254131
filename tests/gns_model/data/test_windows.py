"""Windows hold what the files hold, and bad files are named."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gns_model.data.windows import WindowIndex
from gns_model.errors import FileFormatError
from gns_model.particles import MOVING, fill
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory

FINE, COARSE, INTERVAL = 0.05, 0.10, 0.01


def scene(**changes) -> Scene:
    values = {
        "domain": {"lower": [0.0, 0.0, 0.0], "upper": [2.0, 1.0, 1.0]},
        "release": [
            {"lower": [0.1, 0.3, 0.1], "upper": [0.5, 0.6, 0.5], "velocity": [1.0, 0.5, -0.25]},
            {"lower": [0.6, 0.3, 0.1], "upper": [0.9, 0.5, 0.4], "velocity": [2.0, 0.0, 0.0]},
        ],
        **changes,
    }
    return Scene.from_dict(values)


def moved(scene: Scene, frames: int = 12, spacing: float = FINE) -> Trajectory:
    """Every point accelerates at its own constant rate, so every window can be recomputed."""
    points = fill(scene, spacing)
    rate = np.random.default_rng(0).normal(size=points.positions.shape)
    t = (np.arange(frames) * INTERVAL)[:, None, None]
    path = points.positions + points.velocities * t + 0.5 * rate * t**2
    return Trajectory(
        positions=path.astype(np.float32),
        time=np.arange(frames) * INTERVAL,
        particle_type=np.full(len(points.positions), MOVING, np.int8),
        scene=scene,
        point_volume=points.volume,
        lattice=points.lattice,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("windows")
    moved(scene()).save(path / "a.h5")
    moved(scene(), frames=7).save(path / "b.h5")
    return path


def index(folder: Path, **changes) -> WindowIndex:
    options = {"spacing": COARSE, "dt": 2 * INTERVAL, "history": 3, "unroll": 2, **changes}
    return WindowIndex([folder], **options)


def test_tracer_sets_share_out_all_points_and_are_lattices(folder):
    windows = index(folder)
    assert windows.residues(0) == 8
    sets = [windows.read(0, 0, r, unroll=1).history[:, -1] for r in range(8)]
    assert sum(map(len, sets)) == len(fill(scene(), FINE).positions)
    together = np.concatenate(sets)
    assert len(np.unique(together.round(4), axis=0)) == len(together)
    for points in sets:
        gaps = np.linalg.norm(points[:, None] - points[None], axis=-1)
        assert gaps[gaps > 0].min() == pytest.approx(COARSE, rel=1e-4)


def test_a_mixture_holds_one_random_point_of_every_cell(folder):
    data = index(folder)
    ratio = round(COARSE / FINE)
    points = fill(data.sources[0].scene, FINE)
    chosen = data.sources[0].mixture(3)
    # The counts of both releases divide by the ratio, so that every cell is whole.
    assert len(chosen) * ratio**3 == len(points.positions)
    release = np.searchsorted(np.cumsum(data.sources[0].counts), chosen, side="right")
    cells = np.column_stack([release, points.lattice[chosen] // ratio])
    assert len(np.unique(cells, axis=0)) == len(chosen)
    assert len(np.unique(data.sources[0].residue[chosen])) == ratio**3
    assert not np.array_equal(chosen, data.sources[0].mixture(4))
    window = data.read(0, 2, mixture=3)
    truth = Trajectory.load(folder / "a.h5").positions
    np.testing.assert_array_equal(window.history[:, -1], truth[2][chosen])


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_a_window_is_what_the_file_holds(folder, data):
    source = data.draw(st.integers(0, 1))
    stride, history = data.draw(st.integers(1, 2)), data.draw(st.integers(1, 5))
    steps = data.draw(st.integers(1, 2))
    windows = index(folder, dt=stride * INTERVAL, history=history)
    frame = data.draw(st.integers(0, windows.starts(source, steps) - 1))
    residue = data.draw(st.integers(0, 7))
    window = windows.read(source, frame, residue, unroll=steps)

    truth = Trajectory.load(folder / f"{'ab'[source]}.h5").positions
    points = fill(scene(), FINE)
    a, b, c = (points.lattice % 2).T
    chosen = (a * 2 + b) * 2 + c == residue
    for k, f in enumerate(range(frame - stride * history, frame + stride * steps + 1, stride)):
        got = window.history[:, k] if k <= history else window.future[:, k - history - 1]
        if f >= 0:
            np.testing.assert_array_equal(got, truth[f, chosen])
        else:
            back = points.positions + points.velocities * (f * INTERVAL)
            np.testing.assert_allclose(got, back[chosen], atol=2e-7)
    assert window.history.dtype == window.future.dtype == np.float32


def test_no_window_begins_in_the_steps_that_a_rollout_leaves_to_the_solver(folder):
    whole, later = index(folder), index(folder, begin=1)
    assert later.starts(0) == whole.starts(0) - 2
    for frame in range(later.starts(0)):
        expected, found = whole.read(0, frame + 2), later.read(0, frame)
        np.testing.assert_array_equal(found.history, expected.history)
        np.testing.assert_array_equal(found.future, expected.future)
    with pytest.raises(FileFormatError, match="need 10, 1 steps at the start left out"):
        index(folder, unroll=2, begin=1, dt=3 * INTERVAL)


def test_frames_outside_are_refused(folder):
    windows = index(folder)
    with pytest.raises(IndexError):
        windows.read(1, windows.starts(1))
    with pytest.raises(IndexError):
        windows.read(0, -1)


def test_a_model_at_the_spacing_of_the_file_sees_all_points(folder):
    windows = index(folder, spacing=FINE)
    assert windows.residues(0) == 1
    assert len(windows.read(0, 0).history) == len(fill(scene(), FINE).positions)


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _foreign(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["x"] = np.zeros(3)


def _text(path: Path) -> None:
    path.write_text("not HDF5")


def _no_frames(path: Path) -> None:
    with h5py.File(path, "a") as file:
        del file.attrs["frames"]


def _no_scene(path: Path) -> None:
    with h5py.File(path, "a") as file:
        file.attrs["scene"] = "{"


def _other_points(path: Path) -> None:
    with h5py.File(path, "a") as file:
        file["lattice"][0] = 99


def _uneven(path: Path) -> None:
    with h5py.File(path, "a") as file:
        file["time"][3] = 0.0341


def _kinematic(path: Path) -> None:
    with h5py.File(path, "a") as file:
        file["particle_type"][0] = 3


@pytest.mark.parametrize(
    "damage",
    [_truncate, _foreign, _text, _no_frames, _no_scene, _other_points, _uneven, _kinematic],
)
def test_a_damaged_file_is_named(tmp_path, damage):
    moved(scene()).save(tmp_path / "good.h5")
    moved(scene()).save(tmp_path / "worse.h5")
    damage(tmp_path / "worse.h5")
    with pytest.raises(FileFormatError, match=r"worse\.h5") as caught:
        index(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"spacing": 0.07}, "spacing"),
        ({"spacing": 0.01}, "spacing"),
        ({"dt": 0.015}, "interval"),
        ({"unroll": 6}, "too few"),
    ],
)
def test_a_model_that_the_files_cannot_serve_is_refused(folder, changes, words):
    with pytest.raises(FileFormatError, match=words) as caught:
        index(folder, **changes)
    assert ".h5" in str(caught.value)


def test_an_empty_or_missing_folder_is_named(tmp_path):
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(FileFormatError, match=folder.name):
            index(folder)


def test_trajectories_that_ended_badly_are_left_out(tmp_path):
    bad = moved(scene())
    bad.status = "diverged"
    bad.save(tmp_path / "bad.h5")
    with pytest.raises(FileFormatError, match="badly"):
        index(tmp_path)
    moved(scene()).save(tmp_path / "good.h5")
    windows = index(tmp_path)
    assert [s.path.name for s in windows.sources] == ["good.h5"]
    assert {p.name: why for p, why in windows.skipped.items()} == {"bad.h5": "ended badly"}


def test_2d_and_3d_do_not_mix(tmp_path):
    moved(scene()).save(tmp_path / "3.h5")
    flat = Scene.from_dict(
        {
            "domain": {"lower": [0.0, 0.0], "upper": [1.0, 1.0]},
            "release": [{"lower": [0.1, 0.1], "upper": [0.5, 0.5], "velocity": [0.0, 0.0]}],
        }
    )
    moved(flat).save(tmp_path / "2.h5")
    with pytest.raises(FileFormatError, match="2D and 3D"):
        index(tmp_path)

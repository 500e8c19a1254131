"""Datasets come in, whole and checked, train, and go out again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from gns_model.data.windows import WindowIndex
from gns_model.errors import FileFormatError, GnsError
from gns_model.interop.dataset import import_dataset, read_dataset
from gns_model.interop.export import export_dataset
from gns_model.interop.releases import point_spacing
from gns_model.learned import Limits
from gns_model.measures import summary
from gns_model.particles import MOVING, fill
from gns_model.scene import Scene
from gns_model.training.recipe import Recipe
from gns_model.training.setup import open_data
from gns_model.trajectory import Trajectory

from .geoelements import metadata

FRAMES, SPACING = 9, 0.02


def blocks(dim: int = 2, frames: int = FRAMES) -> tuple[np.ndarray, np.ndarray]:
    """Two squares that fly apart over a row of stationary points: positions and types."""
    axis = SPACING * np.arange(5)
    square = np.stack(np.meshgrid(*[axis] * dim, indexing="ij"), -1).reshape(-1, dim)
    row = 0.13 + np.zeros((8, dim))
    row[:, 0] += SPACING * np.arange(8)
    start = np.concatenate([square + 0.17, square + 0.37, row])
    kinds = np.repeat([6, 5, 3], [len(square), len(square), len(row)])
    speed = np.zeros_like(start)
    speed[kinds == 6, 0], speed[kinds == 5, 1] = -1e-3, 2e-3
    moved = start + speed * np.arange(frames)[:, None, None]
    return moved.astype(np.float32), kinds


def pair(*parts: Any) -> np.ndarray:
    array = np.empty(len(parts), dtype=object)
    for k, part in enumerate(parts):
        array[k] = part
    return array


def about(folder: Path, dim: int = 2, **changes: Any) -> Path:
    path = folder / "metadata.json"
    bounds = [[0.1, 0.7]] * dim
    path.write_text(json.dumps(metadata(dim, sequence_length=FRAMES, bounds=bounds, **changes)))
    return path


# -- in ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("layout", ["keys", "gns_data", "gns_data of tuples", "hdf5"])
@pytest.mark.parametrize("material", [None, "scalar", "array"])
def test_every_layout_gives_the_same(tmp_path, dim, layout, material):
    positions, kinds = blocks(dim)
    friction = {None: None, "scalar": 0.5, "array": np.linspace(0.2, 0.8, len(kinds))}[material]
    entries = [(positions, kinds), (positions.astype(np.float64), 6)]
    entries = [(*e, friction)[: 2 if material is None else 3] for e in entries]
    path = tmp_path / "train.npz"
    if layout == "keys":
        np.savez_compressed(path, **{f"trajectory_{k}": pair(*e) for k, e in enumerate(entries)})
    elif layout == "gns_data":
        array = np.empty((2, len(entries[0])), dtype=object)
        for k, entry in enumerate(entries):
            for j, part in enumerate(entry):
                array[k, j] = part
        np.savez(path, gns_data=array)
    elif layout == "gns_data of tuples":
        np.savez(path, gns_data=pair(*entries))
    else:
        path = tmp_path / "train.h5"
        with h5py.File(path, "w") as file:
            for k, entry in enumerate(entries):
                names = ("positions", "particle_type", "material_property")
                for name, part in zip(names, entry, strict=False):
                    file[f"trajectory_{k}/{name}"] = part
    first, second = read_dataset(path)
    np.testing.assert_array_equal(first.positions, positions)
    np.testing.assert_array_equal(first.particle_type, kinds)
    np.testing.assert_array_equal(second.particle_type, np.full(len(kinds), 6))
    assert second.positions.dtype == np.float32
    if material is None:
        assert first.material is None
    else:
        np.testing.assert_allclose(first.material, np.broadcast_to(friction, len(kinds)))

    files = import_dataset(path, about(tmp_path, dim), tmp_path / "out")
    assert [f.name for f in files] == ["trajectory-00000.h5", "trajectory-00001.h5"]
    ours = Trajectory.load(files[0])
    np.testing.assert_array_equal(ours.positions, positions)
    np.testing.assert_array_equal(ours.particle_type, kinds)
    np.testing.assert_allclose(ours.time, 0.0025 * np.arange(FRAMES))
    assert (ours.foreign, ours.status) == (True, "ok")
    assert ours.point_volume ** (1 / dim) == pytest.approx(SPACING, rel=1e-4)
    assert (ours.tan_friction is None) == (material is None)


def test_the_scene_of_foreign_points(tmp_path):
    positions, kinds = blocks()
    np.savez(tmp_path / "train.npz", a=pair(positions, kinds, 0.5))
    (path,) = import_dataset(tmp_path / "train.npz", about(tmp_path), tmp_path / "out")
    scene = Trajectory.load(path).scene
    assert scene.domain.lower == (0.1, 0.1)
    assert scene.domain.upper == (0.7, 0.7)
    one, other = sorted(scene.releases, key=lambda r: r.lower)
    np.testing.assert_allclose(one.lower, [0.16, 0.16], atol=1e-4)
    np.testing.assert_allclose(one.upper, [0.26, 0.26], atol=1e-4)
    np.testing.assert_allclose(one.velocity, [-0.4, 0], atol=1e-4)  # m/s, not per step
    np.testing.assert_allclose(other.velocity, [0, 0.8], atol=1e-4)
    assert scene.material.friction_angle == pytest.approx(np.degrees(np.arctan(0.5)))
    assert Limits.of([scene]).max_speed == pytest.approx(0.8, abs=1e-4)
    assert summary(Trajectory.load(path))["centroid_travel"] == pytest.approx(-0.004, abs=1e-4)


def test_a_body_outside_of_the_bounds_and_spray_still_have_a_scene(tmp_path):
    rng = np.random.default_rng(0)
    spray = np.broadcast_to(rng.uniform(0.02, 0.78, (300, 2)), (FRAMES, 300, 2))
    outside = np.broadcast_to([[0.05, 0.3], [0.05, 0.31], [0.4, 0.4]], (FRAMES, 3, 2))
    np.savez(tmp_path / "t.npz", a=pair(spray, 6), b=pair(outside, 6), c=pair(spray, 3))
    spray, few, still = import_dataset(tmp_path / "t.npz", about(tmp_path), tmp_path / "out")
    assert len(Trajectory.load(spray).scene.releases) == 1
    assert Trajectory.load(few).scene.domain.lower == (0.1, 0.1)
    assert Trajectory.load(still).positions.shape == (FRAMES, 300, 2)


def test_spacing_of_points_in_disorder():
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 1, (6400, 2))
    assert point_spacing(points, 0.06) == pytest.approx(1 / 80, rel=0.05)
    assert point_spacing(points[:1], 0.06) is None


def test_deepminds_files_have_one_frame_more(tmp_path):
    positions, kinds = blocks(frames=FRAMES + 1)
    np.savez(tmp_path / "t.npz", a=pair(positions, kinds))
    import_dataset(tmp_path / "t.npz", about(tmp_path), tmp_path / "out")


def test_split_metadata_and_the_frames_without_dt(tmp_path):
    positions, kinds = blocks()
    np.savez(tmp_path / "t.npz", a=pair(positions, kinds))
    plain = json.loads(about(tmp_path).read_text())
    del plain["dt"]
    both = {"train": {**plain, "sequence_length": 5}, "rollout": plain}
    path = tmp_path / "metadata.json"
    path.write_text(json.dumps(both))
    with pytest.raises(FileFormatError, match=r"sequence_length = 5, but 'a' .* has 9 frames"):
        import_dataset(tmp_path / "t.npz", path, tmp_path / "out")
    with pytest.warns(UserWarning, match="has no dt"):
        (file,) = import_dataset(tmp_path / "t.npz", path, tmp_path / "out", section="rollout")
    assert Trajectory.load(file).time[1] == 0.0025
    (file,) = import_dataset(
        tmp_path / "t.npz", path, tmp_path / "two", section="rollout", dt=0.01, spacing=0.021
    )
    found = Trajectory.load(file)
    assert (found.time[1], found.point_volume) == (0.01, pytest.approx(0.021**2))


def test_statistics_per_second_are_noticed(tmp_path):
    positions, kinds = blocks()
    np.savez(tmp_path / "t.npz", a=pair(positions, kinds))
    path = about(tmp_path, vel_std=[0.6, 0.8])
    with pytest.warns(UserWarning, match="perhaps per second"):
        import_dataset(tmp_path / "t.npz", path, tmp_path / "out")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"dim": 3, "bounds": [[0, 1]] * 3} | {k: [0.1] * 3 for k in
          ("vel_mean", "vel_std", "acc_mean", "acc_std")}, "dim = 3, but 'a' in .* is 2D"),
        ({"sequence_length": 100}, "sequence_length = 100, but 'a' in .* has 9 frames"),
        ({"bounds": [[0.1, 0.7], [0.0, 0.1]]}, "bounds of y are 0 to 0.1 m, but .* 0.4"),
        ({"bounds": [[2.0, 3.0], [0.1, 0.7]]}, "bounds of x"),
        ({"vel_mean": [0.0] * 3}, "vel_mean has 3 numbers, but dim = 2"),
        ({"bounds": [[0.1, 0.7]] * 3}, "bounds has 3 pairs, but dim = 2"),
        ({"dt": -1}, "dt = -1"),
    ],
)  # fmt: skip
def test_metadata_that_disagrees_is_one_clear_line(tmp_path, changes, words):
    positions, kinds = blocks()
    np.savez(tmp_path / "train.npz", a=pair(positions, kinds))
    values = {**json.loads(about(tmp_path).read_text()), **changes}
    (tmp_path / "metadata.json").write_text(json.dumps(values))
    with pytest.raises(FileFormatError, match=words) as caught:
        import_dataset(tmp_path / "train.npz", tmp_path / "metadata.json", tmp_path / "out")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out" / "metadata.json").exists()


POSITIONS, KINDS = blocks()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"a": pair(POSITIONS)}, "1 parts"),
        ({"a": pair(POSITIONS, 6, 0.5, 1)}, "4 parts"),
        ({"a": pair(POSITIONS[0], 6)}, "not floats"),
        ({"a": pair(POSITIONS.astype(int), 6)}, "not floats"),
        ({"a": pair(POSITIONS * np.nan, 6)}, "not finite"),
        ({"a": pair(POSITIONS[:, :0], 6)}, "empty"),
        ({"a": pair(POSITIONS, KINDS[:5])}, "there are 58 points"),
        ({"a": pair(POSITIONS, 6.5)}, "must be integers"),
        ({"a": pair(POSITIONS, np.nan)}, "must be integers"),
        ({"a": pair(POSITIONS, -1)}, "0..127"),
        ({"a": pair(POSITIONS, 6, [0.1, 0.2])}, "material property has shape"),
        ({"a": pair(POSITIONS, 6, np.inf)}, "material property is not finite"),
        ({"a": POSITIONS}, "array of numbers"),
        ({"gns_data": POSITIONS}, "no list of trajectories"),
        ({}, "no trajectories"),
    ],
)
def test_arrays_that_are_no_trajectory_are_one_clear_line(tmp_path, content, words):
    np.savez(tmp_path / "t.npz", **content)
    with pytest.raises(FileFormatError, match=words) as caught:
        import_dataset(tmp_path / "t.npz", about(tmp_path), tmp_path / "out")
    assert "\n" not in str(caught.value)


def test_odd_hdf5_files(tmp_path):
    path = tmp_path / "t.h5"
    for key, value, words in (
        ("a", np.zeros(3), "no group"),
        ("a/positions", POSITIONS, "no group with positions and particle_type"),
        ("a/particle_type", "six", "other than numbers"),
    ):
        with h5py.File(path, "w") as file:
            if key == "a/particle_type":
                file["a/positions"] = POSITIONS
            file[key] = value
        with pytest.raises(FileFormatError, match=words):
            list(read_dataset(path))
    path.write_bytes(path.read_bytes()[:600])
    with pytest.raises(FileFormatError, match="truncated"):
        import_dataset(path, about(tmp_path), tmp_path / "out")


def test_a_finished_dataset_is_not_written_over(tmp_path):
    np.savez(tmp_path / "t.npz", a=pair(POSITIONS, KINDS))
    import_dataset(tmp_path / "t.npz", about(tmp_path), tmp_path / "out")
    with pytest.raises(FileFormatError, match="already holds a dataset"):
        import_dataset(tmp_path / "t.npz", about(tmp_path), tmp_path / "out")


# -- training windows ----------------------------------------------------------------------------


def test_windows_of_an_imported_dataset(tmp_path):
    friction = np.linspace(0.2, 0.8, len(KINDS)).astype(np.float32)
    np.savez(tmp_path / "t.npz", a=pair(POSITIONS, KINDS, friction))
    import_dataset(tmp_path / "t.npz", about(tmp_path), tmp_path / "out")
    options = {"spacing": 0.02, "dt": 0.0025, "history": 5}
    index = WindowIndex([tmp_path / "out"], **options)
    assert (index.residues(0), index.first(0), index.starts(0)) == (1, 5, FRAMES - 6)
    for frame in range(index.starts(0)):
        window = index.read(0, frame, mixture=frame)
        whole = np.concatenate([window.history, window.future], axis=1)
        np.testing.assert_array_equal(whole, POSITIONS[frame : frame + 7].transpose(1, 0, 2))
    np.testing.assert_array_equal(window.particle_type, KINDS)
    np.testing.assert_array_equal(window.tan_friction, friction)
    strided = WindowIndex([tmp_path / "out"], spacing=0.021, dt=0.005, history=3)
    assert (strided.first(0), strided.starts(0)) == (6, 1)
    np.testing.assert_array_equal(strided.read(0, 0).history[:, -1], POSITIONS[6])
    with pytest.raises(FileFormatError, match=r"about 0\.02 m apart"):
        WindowIndex([tmp_path / "out"], **{**options, "spacing": 0.04})
    with pytest.raises(FileFormatError, match=r"9 frames are too few, 4 steps .* need 10"):
        WindowIndex([tmp_path / "out"], **options, unroll=4)


def test_a_feature_that_nobody_knows_is_not_trained_on(tmp_path):
    np.savez(tmp_path / "t.npz", a=pair(POSITIONS, KINDS))
    import_dataset(tmp_path / "t.npz", about(tmp_path), tmp_path / "data")
    model = {
        "dim": 2, "spacing": 0.02, "radius": 0.05, "dt": 0.0025, "baffles": "points", "types": 9,
        "material_features": ["tan_friction_angle"],
    }  # fmt: skip
    values = {"train": [str(tmp_path / "data")], "steps": 1, "mirror": False, "model": model}
    with pytest.raises(GnsError, match="nothing is known of its tan_friction_angle"):
        open_data(Recipe.from_dict(values), (str(tmp_path / "data"),))
    model["material_features"] = []
    assert open_data(Recipe.from_dict(values), (str(tmp_path / "data"),)).dim == 2


# -- out -----------------------------------------------------------------------------------------


def test_out_and_in_again_is_the_same(tmp_path):
    friction = np.linspace(0.2, 0.8, len(KINDS)).astype(np.float32)
    np.savez(tmp_path / "t.npz", one=pair(POSITIONS, KINDS, friction), two=pair(POSITIONS, 6, 0.5))
    source = about(tmp_path, boundary_augment=1.5)
    import_dataset(tmp_path / "t.npz", source, tmp_path / "ours")
    assert export_dataset(tmp_path / "ours", tmp_path / "again" / "train.npz")
    told = json.loads((tmp_path / "again" / "metadata.json").read_text())
    assert told == json.loads(source.read_text())
    assert not export_dataset(tmp_path / "ours", tmp_path / "again" / "valid.npz")
    with np.load(tmp_path / "again" / "valid.npz", allow_pickle=True) as file:  # as they read it
        assert file.files == ["one", "two"]
        data = [item for _, item in file.items()]
    for before, after in zip(read_dataset(tmp_path / "t.npz"), data, strict=True):
        np.testing.assert_array_equal(after[0], before.positions)
        np.testing.assert_array_equal(
            np.full(len(KINDS), after[1], dtype=int), before.particle_type
        )
        np.testing.assert_array_equal(np.full(len(KINDS), after[2], dtype=float), before.material)
    first, _ = read_dataset(tmp_path / "again" / "train.npz")
    np.testing.assert_array_equal(first.material, friction)


def own(folder: Path, name: str, scene: Scene, frames: int = 12) -> None:
    points = fill(scene, 0.05)
    t = (0.01 * np.arange(frames))[:, None, None]
    path = points.positions + points.velocities * t - np.array([0, 4.9]) * t**2
    Trajectory(
        positions=path.astype(np.float32),
        time=0.01 * np.arange(frames),
        particle_type=np.full(path.shape[1], MOVING, np.int8),
        scene=scene,
        point_volume=points.volume,
    ).save(folder / f"{name}.h5")


def flat(angle: float = 30.0) -> Scene:
    return Scene.from_dict(
        {
            "domain": {"lower": [0.0, 0.0], "upper": [1.0, 0.5]},
            "release": [{"lower": [0.1, 0.1], "upper": [0.3, 0.3], "velocity": [1.0, 0.0]}],
            "baffle": [{"center": [0.6], "size": [0.1, 0.15]}],
            "material": {"friction_angle": angle},
        }
    )


def test_our_own_trajectories_go_out_with_measured_statistics(tmp_path):
    (tmp_path / "ours").mkdir()
    own(tmp_path / "ours", "a", flat())
    own(tmp_path / "ours", "b", flat())
    export_dataset(tmp_path / "ours", tmp_path / "train.npz")
    one, _ = read_dataset(tmp_path / "train.npz")
    assert one.material is None
    still = one.positions[:, one.particle_type == 3]
    assert still.shape == (12, 2 * 3, 2)  # the baffle in points
    assert ((still >= [0.55, 0.0]) & (still <= [0.65, 0.15])).all()
    told = json.loads((tmp_path / "metadata.json").read_text())
    assert told["bounds"] == [[0.0, 1.0], [0.0, 0.5]]
    assert (told["dt"], told["sequence_length"], told["nnode_in"]) == (0.01, 12, 30)
    np.testing.assert_allclose(told["vel_mean"], [0.01, -4.9e-4 * 11], rtol=1e-3)
    np.testing.assert_allclose(told["acc_mean"], [0, -9.8e-4], rtol=1e-3, atol=1e-8)
    np.testing.assert_allclose(told["vel_std"][1], 9.8e-4 * np.std(np.arange(11)), rtol=1e-3)
    import_dataset(tmp_path / "train.npz", tmp_path / "metadata.json", tmp_path / "back")

    own(tmp_path / "ours", "c", flat(45.0))
    export_dataset(tmp_path / "ours", tmp_path / "two" / "train.npz", radius=0.2)
    *_, third = read_dataset(tmp_path / "two" / "train.npz")
    np.testing.assert_allclose(third.material, 1.0, rtol=1e-6)
    told = json.loads((tmp_path / "two" / "metadata.json").read_text())
    assert (told["nnode_in"], told["default_connectivity_radius"]) == (31, 0.2)


def test_trajectories_that_are_not_one_dataset(tmp_path):
    with pytest.raises(FileFormatError, match="no trajectory files"):
        export_dataset(tmp_path, tmp_path / "t.npz")
    own(tmp_path, "a", flat())
    own(tmp_path, "b", flat(), frames=10)
    with pytest.raises(FileFormatError, match=r"b\.h5: 10 frames .* a\.h5 has 12"):
        export_dataset(tmp_path, tmp_path / "t.npz")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.h5", "b.h5"]


def test_the_first_frames_of_flows_that_last_unequally_long_are_one_dataset(tmp_path):
    (tmp_path / "ours").mkdir()
    own(tmp_path / "ours", "a", flat())
    own(tmp_path / "ours", "b", flat(), frames=10)
    assert export_dataset(tmp_path / "ours", tmp_path / "train.npz", frames=10)
    for each, name in zip(read_dataset(tmp_path / "train.npz"), "ab", strict=True):
        moving = each.positions[:, each.particle_type != 3]
        true = Trajectory.load(tmp_path / "ours" / f"{name}.h5").positions[:10]
        np.testing.assert_array_equal(moving, true)
    assert json.loads((tmp_path / "metadata.json").read_text())["sequence_length"] == 10
    import_dataset(tmp_path / "train.npz", tmp_path / "metadata.json", tmp_path / "back")
    export_dataset(tmp_path / "back", tmp_path / "again" / "train.npz", frames=8)
    told = json.loads((tmp_path / "again" / "metadata.json").read_text())
    assert told["sequence_length"] == 8
    with pytest.raises(FileFormatError, match=r"b\.h5: 10 frames, fewer than the 11 asked for"):
        export_dataset(tmp_path / "ours", tmp_path / "new" / "more.npz", frames=11)
    with pytest.raises(FileFormatError, match="sequence_length = 10, but 9 frames"):
        export_dataset(tmp_path / "ours", tmp_path / "valid.npz", frames=9)
    assert not (tmp_path / "valid.npz").exists()

"""VTKHDF files: the structure that the specification asks for, and the flow that went in."""

import h5py
import numpy as np
import pytest
import trimesh

from gns_model.cli import app
from gns_model.console import main
from gns_model.errors import FileFormatError
from gns_model.trajectory import Trajectory
from gns_model.vtkhdf import CORNER, TOPOLOGIES, check_name, save_vtkhdf


@pytest.fixture
def flow(small_flume, trajectory_of):
    """Seven grains that accelerate, in a scene with one baffle, at uneven times."""
    rng = np.random.default_rng(0)
    start, velocity = rng.uniform(0.1, 0.4, (7, 3)), rng.normal(size=(7, 3))
    time = np.array([0.0, 0.1, 0.3, 0.35])
    found = trajectory_of(start + time[:, None, None] * velocity, small_flume)
    found.time = time
    return found, velocity


def read_step(file: h5py.File, k: int) -> dict[str, np.ndarray]:
    """What a reader makes of frame `k`, by the offsets alone, as the specification says."""
    root = file["VTKHDF"]
    steps = root["Steps"]
    part = steps["PartOffsets"][k]
    assert steps["NumberOfParts"][k] == 1
    count = root["NumberOfPoints"][part]
    begin = steps["PointOffsets"][k]
    found = {"Points": root["Points"][begin : begin + count]}
    for name, values in root["PointData"].items():
        at = steps["PointDataOffsets"][name][k]
        found[name] = values[at : at + count]
        assert len(found[name]) == count
    for column, name in enumerate(TOPOLOGIES):
        cells = root[name]
        n, ids = cells["NumberOfCells"][part], cells["NumberOfConnectivityIds"][part]
        cell, first = steps["CellOffsets"][k, column], steps["ConnectivityIdOffsets"][k, column]
        offsets = cells["Offsets"][cell : cell + n + 1]
        connectivity = cells["Connectivity"][first : first + ids]
        assert len(offsets) == n + 1
        assert offsets[0] == 0
        assert offsets[-1] == ids == len(connectivity)
        assert (np.diff(offsets) > 0).all()
        assert n == 0 or connectivity.max() < count
        found[name] = connectivity
    return found


def test_structure(flow, tmp_path):
    save_vtkhdf(flow[0], tmp_path / "f.vtkhdf")
    with h5py.File(tmp_path / "f.vtkhdf") as file:
        root = file["VTKHDF"]
        assert list(root.attrs["Version"]) == [2, 0]
        assert root.attrs["Type"] == b"PolyData"
        kind = root.attrs.get_id("Type").get_type()
        assert (kind.is_variable_str(), kind.get_size(), kind.get_cset()) == (False, 8, 0)
        steps = root["Steps"]
        assert steps.attrs["NSteps"] == 4
        np.testing.assert_array_equal(steps["Values"], flow[0].time)
        for name in ("CellOffsets", "ConnectivityIdOffsets"):
            assert steps[name].shape == (4, 4)
        assert set(steps["PointDataOffsets"]) == set(root["PointData"])
        assert root["Points"].shape == (4 * (7 + 8), 3)


def test_every_frame_is_the_flow(flow, tmp_path):
    trajectory, velocity = flow
    save_vtkhdf(trajectory, tmp_path / "f.vtkhdf")
    with h5py.File(tmp_path / "f.vtkhdf") as file:
        for k, positions in enumerate(trajectory.positions):
            found = read_step(file, k)
            grains = found["particle_type"] != CORNER
            np.testing.assert_array_equal(found["Points"][grains], positions.astype(np.float32))
            np.testing.assert_allclose(found["velocity"][grains], velocity, atol=1e-5)
            speed = np.linalg.norm(found["velocity"], axis=1)
            np.testing.assert_allclose(found["speed"], speed, rtol=1e-6)
            assert sorted(found["Vertices"]) == np.flatnonzero(grains).tolist()
            assert len(found["Lines"]) == len(found["Strips"]) == 0


def test_baffles_are_closed_boxes_seen_from_outside(flume, trajectory_of, tmp_path):
    save_vtkhdf(trajectory_of(np.ones((2, 1, 3)), flume), tmp_path / "f.vtkhdf")
    with h5py.File(tmp_path / "f.vtkhdf") as file:
        found = read_step(file, 1)
    quads = found["Polygons"].reshape(-1, 4)
    mesh = trimesh.Trimesh(found["Points"], np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]))
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(3 * 0.15 * 0.30 * 0.15)  # negative if seen from inside
    np.testing.assert_allclose(mesh.bounds[0], flume.baffle_boxes()[:, 0].min(axis=0), rtol=1e-6)


def test_plane_strain_and_no_baffles(plane_scene, trajectory_of, tmp_path):
    for scene, corners in ((plane_scene, 4), (plane_scene.with_baffles([]), 0)):
        save_vtkhdf(trajectory_of(np.full((3, 5, 2), 0.2), scene), tmp_path / "f.vtkhdf")
        with h5py.File(tmp_path / "f.vtkhdf") as file:
            found = read_step(file, 2)
        assert len(found["Points"]) == 5 + corners
        assert len(found["Polygons"]) == corners
        assert (found["Points"][:, 2] == 0).all()


def test_one_frame(small_flume, trajectory_of, tmp_path):
    save_vtkhdf(trajectory_of(np.full((1, 5, 3), 0.2), small_flume), tmp_path / "f.vtkhdf")
    with h5py.File(tmp_path / "f.vtkhdf") as file:
        assert (read_step(file, 0)["speed"] == 0).all()


def test_names():
    check_name("flow.vtkhdf")
    with pytest.raises(FileFormatError, match="vtkhdf"):
        check_name("flow.vtu")


def test_simulate_writes_it(plane_scene, tmp_path, capsys):
    scene = tmp_path / "scene.toml"
    plane_scene.replace(duration=0.05).to_toml(scene)
    options = ["--spacing", "0.05", "--threads", "1", "--quiet", "--out", str(tmp_path / "f.h5")]
    with pytest.raises(SystemExit) as left:
        main(app, "gns-model", ["simulate", str(scene), *options, "--vtk", str(tmp_path / "f.txt")])
    assert left.value.code == 2
    assert not (tmp_path / "f.h5").exists()
    with pytest.raises(SystemExit) as left:
        main(
            app,
            "gns-model",
            ["simulate", str(scene), *options, "--vtk", str(tmp_path / "f.vtkhdf")],
        )
    assert left.value.code == 0
    assert "f.vtkhdf" in capsys.readouterr().out
    flow = Trajectory.load(tmp_path / "f.h5")
    with h5py.File(tmp_path / "f.vtkhdf") as file:
        last = read_step(file, len(flow.time) - 1)
    grains = last["particle_type"] != CORNER
    np.testing.assert_array_equal(last["Points"][grains, :2], flow.positions[-1])

"""Layouts and meshes that somebody hands in: taken exactly, or refused in one line."""

import json

import h5py
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from design.cli import app
from design.evaluate import with_layout, with_walls
from design.geometry import Y_UP_TO_Z_UP, write_geometry
from design.walls import WallError, read_walls
from gns_env.objective import Objective
from gns_model import console
from gns_model.errors import FileFormatError, SceneError
from gns_model.measures import summary
from gns_model.mpm import MpmSimulator
from gns_model.scene import Scene


@pytest.fixture
def scene_file(small_flume, tmp_path):
    path = tmp_path / "small.toml"
    small_flume.replace(duration=0.1).to_toml(path)
    return path


def box(lower, upper):
    return trimesh.creation.box(bounds=[lower, upper])


def stl(path, *meshes, up="z"):
    """Write meshes given in the scene's frame as one STL."""
    mesh = trimesh.util.concatenate(list(meshes))
    if up == "z":
        mesh.apply_transform(Y_UP_TO_Z_UP)
    path.write_bytes(mesh.export(file_type="stl"))
    return path


GOOD = ((0.5, 0.0, 0.2), (0.6, 0.25, 0.4))


def test_what_we_write_we_read(flume, tmp_path):
    paths = write_geometry(flume, tmp_path, "layout")
    for path in paths.values():
        assert with_walls(flume.with_baffles([]), path).baffles == flume.baffles


@given(
    x=st.floats(0.30, 0.8), z=st.floats(0.01, 0.4),
    size=st.tuples(*[st.floats(0.02, 0.15)] * 3),
)  # fmt: skip
def test_any_box_survives_single_precision(small_flume, tmp_path, x, z, size):
    lower = np.array([x, 0.0, z])
    path = stl(tmp_path / "w.stl", box(lower, lower + size))
    (baffle,) = read_walls(path, small_flume)
    np.testing.assert_allclose(baffle.size, size, atol=2e-6)
    np.testing.assert_allclose(baffle.center, (lower + np.array(size) / 2)[[0, 2]], atol=2e-6)
    small_flume.replace(baffles=(baffle,))


def test_a_box_flush_with_the_walls_stays_inside(small_flume, tmp_path):
    """0.6 and 0.1 are more, in single precision, than in double."""
    path = stl(
        tmp_path / "w.stl", box((0.5, 0, 0), (0.7, 0.5, 0.1)), box((0.5, 0, 0.5), (1, 0.5, 0.6))
    )
    assert len(with_walls(small_flume, path).baffles) == 2


def test_upward_axis(small_flume, tmp_path):
    path = stl(tmp_path / "w.stl", box(*GOOD), up="y")
    (baffle,) = read_walls(path, small_flume, up="y")
    assert baffle.size == pytest.approx((0.1, 0.25, 0.2))
    with pytest.raises(WallError, match="--up"):
        read_walls(path, small_flume)


def test_in_plane_strain_the_width_is_dropped(plane_scene, tmp_path):
    path = write_geometry(plane_scene, tmp_path, "layout")["stl"]
    assert read_walls(path, plane_scene) == plane_scene.baffles


def tilted():
    mesh = box(*GOOD)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.3, [0, 0, 1]))
    return mesh.apply_translation(np.array([0.5, 0, 0.2]) - mesh.bounds[0])


def yawed(angle):
    mesh = box(*GOOD)
    turn = trimesh.transformations.rotation_matrix(angle, [0, 1, 0], mesh.centroid)
    return mesh.apply_transform(turn)


def open_box():
    mesh = box(*GOOD)
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    return mesh


def wedge():
    return trimesh.convex.convex_hull(
        [
            (0.5, 0, 0.2),
            (0.6, 0, 0.2),
            (0.5, 0, 0.4),
            (0.6, 0, 0.4),
            (0.6, 0.2, 0.2),
            (0.6, 0.2, 0.4),
        ]
    )


@pytest.mark.parametrize(
    ("mesh", "words"),
    [
        (open_box(), "not watertight"),
        (wedge(), "no upright box"),
        (tilted(), "no upright box"),
        (box((0.5, 0.1, 0.2), (0.6, 0.3, 0.4)), "stand on the base: it begins 0.1 m above"),
        (box((0.5, -0.1, 0.2), (0.6, 0.3, 0.4)), "leaves the domain"),
        (box((0.5, 0, 0.2), (1.6, 0.3, 0.4)), "leaves the domain"),
        (box((500, 0, 200), (600, 250, 400)), "units metres"),
        (trimesh.util.concatenate([box(*GOOD), box((0.6, 0, 0.2), (0.7, 0.25, 0.4))]), "touch"),
    ],
)  # fmt: skip
def test_meshes_that_are_no_walls(small_flume, tmp_path, mesh, words):
    path = stl(tmp_path / "w.stl", mesh.copy())
    with pytest.raises(WallError, match=words) as refused:
        read_walls(path, small_flume)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_trace_of_yaw_is_none(small_flume, tmp_path):
    (baffle,) = read_walls(stl(tmp_path / "w.stl", yawed(1e-4)), small_flume)
    assert baffle.center == pytest.approx((0.55, 0.3), abs=1e-4)
    assert baffle.yaw == 0
    # The library's angle turns z towards x.
    (baffle,) = read_walls(stl(tmp_path / "w.stl", yawed(0.3)), small_flume)
    assert baffle.yaw == pytest.approx(-np.degrees(0.3), abs=1e-3)
    assert baffle.size == pytest.approx((0.1, 0.25, 0.2), abs=2e-6)


def test_bodies_that_overlap(small_flume, tmp_path):
    path = stl(tmp_path / "w.stl", box(*GOOD), box((0.55, 0, 0.3), (0.65, 0.2, 0.45)))
    with pytest.raises(SceneError, match="overlaps"):
        with_walls(small_flume, path)
    path = stl(tmp_path / "w.stl", box((0.2, 0, 0.2), (0.4, 0.2, 0.3)))
    with pytest.raises(SceneError, match=r"overlaps release\[0\]"):
        with_walls(small_flume, path)


@pytest.mark.parametrize("name", ["w.stl", "w.glb", "w.obj", "w.ply", "w.off", "w.step"])
@pytest.mark.parametrize("content", [b"", b"\x00" * 84, b"nonsense\n" * 20])
def test_files_that_are_no_meshes(small_flume, tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=name):
        read_walls(path, small_flume)


def test_a_truncated_stl(small_flume, tmp_path):
    path = stl(tmp_path / "w.stl", box(*GOOD))
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(FileFormatError):
        read_walls(path, small_flume)


def test_layout_files(small_flume, tmp_path):
    other = small_flume.with_baffles([[0.7, 0.2], [0.7, 0.4]])
    path = tmp_path / "layout.toml"
    other.to_toml(path)
    assert with_layout(small_flume, path).baffles == other.baffles
    path.write_text("[[baffle]]\ncenter = [0.7, 0.2]\nsize = [0.1, 0.2, 0.1]\n")
    assert with_layout(small_flume, path).baffles[0].size == (0.1, 0.2, 0.1)
    for text, words in (
        ("", "no .*baffle"),
        ("[[baffle]", "not a TOML"),
        ("[[baffle]]\ncenter = [7.0, 0.2]\nsize = [0.1, 0.2, 0.1]\n", "leaves the domain"),
        ("[[baffle]]\ncenter = [0.7]\nsize = [0.1, 0.2, 0.1]\n", "center"),
        ("baffle = [1]", "layout.toml"),
    ):
        path.write_text(text)
        with pytest.raises(SceneError, match=words):
            with_layout(small_flume, path)


def test_evaluate_walls_as_json(scene_file, tmp_path, capsys):
    """Two walls as a mesh measure what the solver says of the same two as a scene."""
    placed = Scene.from_toml(scene_file).with_baffles([[0.5, 0.2], [0.5, 0.42]])
    mesh = write_geometry(placed, tmp_path, "walls")["stl"]
    options = ["--spacing", "0.0625", "--json", "--quiet", "--depth-weight", "1"]
    options += ["--vtk", str(tmp_path / "flow.vtkhdf")]
    with pytest.raises(SystemExit) as left:
        console.main(
            app, "gns-design", ["evaluate", str(scene_file), "--baffles", str(mesh), *options]
        )
    assert left.value.code == 0
    result = json.loads(capsys.readouterr().out)
    solver = MpmSimulator(spacing=0.0625, threads=1)
    scenes = [placed, placed.with_baffles([])]
    own, none = (summary(t) for t in solver.rollout(scenes))
    with h5py.File(tmp_path / "flow.vtkhdf") as file:
        assert file["VTKHDF/Polygons/NumberOfCells"][0] == 12
    assert result["baffles"] == 2
    assert result["measures"] == pytest.approx(own)
    assert result["no_baffles"] == pytest.approx(none)
    assert result["cost"] == pytest.approx(Objective(depth_weight=1.0).cost(own, none))
    assert result["cost_no_baffles"] == 2.0
    assert "upstream depth" in result["objective"]


def test_evaluate_refuses_in_one_line(scene_file, tmp_path, capsys):
    walls = stl(tmp_path / "w.stl", open_box())
    for arguments, words in (
        (["--baffles", walls], "watertight"),
        (["--baffles", tmp_path / "none.stl"], "no such file"),
        (["--layout", tmp_path / "none.toml"], "none.toml"),
        (["--layout", scene_file, "--baffles", walls], "not both"),
        (["--up", "y"], "--up"),
        (["--vtk", "flow.vtu"], "flow.vtu"),
        (["--baffles", walls, "--up", "x"], "--up"),
        (["--depth-weight", "-1", "--layout", scene_file], "depth_weight"),
    ):
        with pytest.raises(SystemExit) as left:
            console.main(app, "gns-design", ["evaluate", str(scene_file), *map(str, arguments)])
        captured = capsys.readouterr()
        assert left.value.code == 2
        assert captured.err.startswith("error: ")
        assert captured.err.count("\n") == 1, captured.err
        assert words in captured.err
        assert captured.out == ""

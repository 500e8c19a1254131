"""Turned baffles in what leaves the house, and in what comes back in."""

from __future__ import annotations

import re

import h5py
import numpy as np
import pytest
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st

from design.drawing import layout_drawing, thumbnail
from design.evaluate import with_walls
from design.geometry import baffle_mesh, write_geometry
from design.viewer import _boxes
from design.walls import TRACE
from gns_env.layout import LayoutSpace
from gns_model import footprint
from gns_model.scene import Scene
from gns_model.vtkhdf import save_vtkhdf

CENTRES, YAWS = [(0.775, 0.475), (1.0, 1.4), (1.3, 0.9)], (20.0, -45.0, 90.0)


@pytest.fixture
def turned(flume: Scene) -> Scene:
    return flume.with_baffles(CENTRES, size=(0.1, 0.3, 0.25), yaw=YAWS)


def same_corners(found: np.ndarray, expected: np.ndarray, atol: float) -> None:
    """Both (B, 4, 2), each footprint's corners in any order."""
    distance = np.abs(found[:, :, None] - expected[:, None]).max(-1)
    assert distance.min(2).max() <= atol


@pytest.mark.parametrize("kind", ["stl", "glb"])
def test_what_we_write_of_turned_baffles_we_read(turned, tmp_path, kind):
    path = write_geometry(turned, tmp_path, "layout")[kind]
    back = with_walls(turned.with_baffles([]), path)
    same_corners(back.footprints(), turned.footprints(), 1e-6)
    assert {b.size[1] for b in back.baffles} == {0.3}
    # 90 comes back as exchanged sides, the others as they were.
    assert {b.yaw for b in back.baffles} == {20.0, 45.0, 0.0}
    assert back.baffles[0] == turned.baffles[0]
    mesh = baffle_mesh(turned)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(3 * 0.1 * 0.3 * 0.25)


@settings(max_examples=25)
@example(x=0.75, z=0.25, size=(0.125, 0.125, 0.1875), yaw=0.0078125)  # as good as along the axes
@given(
    x=st.floats(0.55, 0.75), z=st.floats(0.2, 0.4), size=st.tuples(*[st.floats(0.03, 0.2)] * 3),
    yaw=st.floats(-89.9, 90),
)  # fmt: skip
def test_any_turned_box_survives_single_precision(small_flume, tmp_path, x, z, size, yaw):
    scene = small_flume.with_baffles([(x, z)], size=size, yaw=yaw)
    path = write_geometry(scene, tmp_path, "one")["stl"]
    back = with_walls(small_flume.with_baffles([]), path)
    same_corners(back.footprints(), scene.footprints(), TRACE + 5e-6)
    assert back.baffles[0].size[1] == pytest.approx(size[1], abs=2e-6)


def test_a_corner_at_the_wall_stays_inside(small_flume, tmp_path):
    half = float(footprint.bounding_size((0.1, 0.2), 30)[1]) / 2
    scene = small_flume.with_baffles([(0.6, half)], size=(0.1, 0.2, 0.2), yaw=30)
    path = write_geometry(scene, tmp_path, "one")["stl"]
    assert with_walls(small_flume, path).baffles[0].yaw == 30


def test_paraview_gets_the_corners(turned, trajectory_of, tmp_path):
    cloud = np.full((2, 5, 3), 0.3, np.float32)
    save_vtkhdf(trajectory_of(cloud, turned), tmp_path / "t.vtkhdf")
    with h5py.File(tmp_path / "t.vtkhdf") as file:
        corners = np.array(file["VTKHDF/Points"])[5 : 5 + 24].reshape(3, 8, 3)
    for found, expected in zip(corners, turned.footprints(), strict=True):
        plan = np.unique(found[:, [0, 2]].round(5), axis=0)
        assert len(plan) == 4
        same_corners(plan[None], expected[None], 1e-5)


def test_the_drawing_and_the_viewer_have_them(turned, flume):
    svg = layout_drawing(flume, turned, flume)
    shapes = re.findall(r'<polygon points="([^"]*)"[^>]*class="best"', svg)
    assert len(shapes) == 3
    pixels = np.array([[list(map(float, p.split(","))) for p in s.split()] for s in shapes])
    scale = 520 / 1.8
    metres = np.stack([0.1 + pixels[..., 0] / scale, 1.9 - pixels[..., 1] / scale], -1)
    same_corners(metres, turned.footprints(), 0.1 / scale)
    assert thumbnail(flume, turned, "best").count("<polygon") == 3
    low, high, turn = _boxes(turned)[0]
    np.testing.assert_allclose([low, high], [[0.725, 0.1, 0.35], [0.825, 0.4, 0.6]])
    assert turn == pytest.approx(footprint.turn(20))


def test_a_space_of_turned_baffles_keeps_their_boxes_apart(flume):
    one = {"center": (1.0, 1.0), "size": (0.05, 0.3, 0.3), "yaw": 30.0}
    scene = flume.replace(baffles=(one,), placement={"lower": (0.6, 0.1), "upper": (1.5, 1.9)})
    space = LayoutSpace(scene, 3)
    wide = footprint.bounding_size((0.05, 0.3), 30)
    np.testing.assert_allclose(space.lower, np.array([0.6, 0.1]) + wide / 2)
    layout = space.project([[1.0, 1.0], [1.02, 1.0], [0.6, 0.1]])
    placed = scene.with_baffles(layout)
    assert {b.yaw for b in placed.baffles} == {30.0}
    assert space.placement.yaw == 30
    corners = placed.footprints()
    first, second = np.triu_indices(3, 1)
    assert footprint.separation(corners[first], corners[second]).min() >= space.gap - 1e-9
    bare = scene.replace(baffles=(), placement=space.placement)
    assert bare.with_baffles(layout) == placed.replace(placement=space.placement)


def test_the_solid_faces_outwards(turned):
    mesh = baffle_mesh(turned)
    assert isinstance(mesh, trimesh.Trimesh)
    assert mesh.is_winding_consistent
    assert mesh.volume > 0

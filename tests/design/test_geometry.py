"""Geometry files say the same as the scene."""

import numpy as np
import pytest
import trimesh

from design.geometry import SLICE_WIDTH, baffle_mesh, write_geometry
from gns_model.scene import Scene

CENTRES = [(0.775, 0.375), (0.775, 1.625), (1.275, 1.0)]


def flume(**changes):
    return Scene.from_dict(
        {
            "name": "flume",
            "domain": {"lower": [0.1, 0.1, 0.1], "upper": [1.9, 0.9, 1.9]},
            "release": [
                {"lower": [0.1, 0.1, 0.3], "upper": [0.45, 0.35, 1.7], "velocity": [2.0, 0, 0]}
            ],
            "placement": {"lower": [0.6, 0.1], "upper": [1.5, 1.9], "size": [0.15, 0.30, 0.20]},
            **changes,
        }
    )


@pytest.fixture
def scene():
    return flume().with_baffles(CENTRES)


def test_stl_is_the_baffles_turned_to_z_up(scene, tmp_path):
    mesh = trimesh.load_mesh(write_geometry(scene, tmp_path, "best")["stl"])
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(3 * 0.15 * 0.30 * 0.20, rel=1e-5)
    boxes = scene.baffle_boxes()
    lower, upper = boxes[:, 0].min(0), boxes[:, 1].max(0)
    # Positive volume above means that the turn kept the handedness; here it is spelled out.
    np.testing.assert_allclose(mesh.bounds[0], (lower[0], -upper[2], lower[1]), atol=1e-6)
    np.testing.assert_allclose(mesh.bounds[1], (upper[0], -lower[2], upper[1]), atol=1e-6)
    parts = sorted(mesh.split(), key=lambda part: tuple(part.centroid.round(4)))
    found = [(part.centroid[0], -part.centroid[1]) for part in parts]
    np.testing.assert_allclose(sorted(found), sorted(CENTRES), atol=1e-6)


def test_stl_is_binary_and_names_its_units(scene, tmp_path):
    content = write_geometry(scene, tmp_path, "best")["stl"].read_bytes()
    assert len(content) == 84 + 50 * 12 * len(CENTRES)
    assert not content.startswith(b"solid")
    assert b"metres; z up" in content[:80]


def test_glb_keeps_the_scene_frame(scene, tmp_path):
    graph = trimesh.load_scene(write_geometry(scene, tmp_path, "best")["glb"])
    assert set(graph.geometry) == {"base", "release-1", "baffle-1", "baffle-2", "baffle-3"}
    for k, (lower, upper) in enumerate(scene.baffle_boxes(), start=1):
        baffle = graph.geometry[f"baffle-{k}"]
        np.testing.assert_allclose(baffle.bounds, (lower, upper), atol=1e-6)
        # glTF readers split vertices at edges; welded, the box must be closed again.
        welded = trimesh.Trimesh(baffle.vertices, baffle.faces, process=True)
        assert welded.is_watertight
        assert welded.volume == pytest.approx(np.prod(upper - lower), rel=1e-5)
    base = graph.geometry["base"].bounds
    assert base[1, 1] == pytest.approx(scene.base)
    assert base[0, 1] < scene.base
    np.testing.assert_allclose(base[:, [0, 2]], [[0.1, 0.1], [1.9, 1.9]], atol=1e-6)


def test_plane_strain_is_a_slice_one_metre_wide(tmp_path):
    scene = Scene.from_dict(
        {
            "domain": {"lower": [0.0, 0.0], "upper": [2.0, 1.0]},
            "release": [{"lower": [0.0, 0.0], "upper": [0.3, 0.3], "velocity": [0.0, 0.0]}],
            "baffle": [{"center": [1.0], "size": [0.1, 0.2]}],
        }
    )
    mesh = baffle_mesh(scene)
    assert mesh.volume == pytest.approx(0.1 * 0.2 * SLICE_WIDTH)
    assert set(write_geometry(scene, tmp_path, "slice")) == {"stl", "glb"}


def test_no_baffles_means_no_stl_and_no_leftovers(tmp_path):
    paths = write_geometry(flume(), tmp_path, "none")
    assert set(paths) == {"glb"}
    assert [p.name for p in tmp_path.iterdir()] == ["none.glb"]
    with pytest.raises(ValueError, match="no baffles"):
        baffle_mesh(flume())

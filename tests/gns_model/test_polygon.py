"""Polygons against areas and distances that are known, and against points thrown at random."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gns_model.errors import SceneError
from gns_model.polygon import area, clearance, fault, strips, trapezoids
from gns_model.scene import Placement, Scene

L_SHAPE = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (1.0, 1.0), (1.0, 2.0), (0.0, 2.0)]
SQUARE = np.array([(-0.1, -0.1), (0.1, -0.1), (0.1, 0.1), (-0.1, 0.1)])


def star(seed, corners=7):
    """A polygon that is seen whole from its middle: simple, and mostly not convex."""
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0, 2 * np.pi, corners)) + np.linspace(0, 1e-3, corners)
    radius = rng.uniform(0.2, 1.0, corners)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])


def inside(point, corners):
    """By counting the sides that a ray crosses."""
    a, b = corners, np.roll(corners, -1, axis=0)
    straddles = (a[:, 1] > point[1]) != (b[:, 1] > point[1])
    x = a[:, 0] + (point[1] - a[:, 1]) / np.where(straddles, b[:, 1] - a[:, 1], 1) * (b - a)[:, 0]
    return bool((straddles & (point[0] < x)).sum() % 2)


@given(st.integers(0, 10_000))
def test_pieces_and_strips_are_the_polygon(seed):
    corners = star(seed)
    if fault(corners) is not None:
        return
    pieces = trapezoids(corners)
    assert sum(abs(area(p)) for p in pieces) == pytest.approx(abs(area(corners)), rel=1e-6)
    covering = strips(corners, 0.05)
    rng = np.random.default_rng(seed)
    for point in rng.uniform(-1, 1, (20, 2)):
        held = ((point >= covering[:, 0]) & (point <= covering[:, 1])).all(axis=1).any()
        away = clearance(point + 1e-6 * SQUARE, corners)
        if inside(point, corners):
            assert held
            assert away <= 1e-6
        else:
            assert away >= -1e-6
            assert not held or away < 0.051


def test_distances_that_are_known():
    assert clearance(SQUARE + [1.5, 1.5], L_SHAPE) == pytest.approx(0.4)  # in the corner of the L
    assert clearance(SQUARE + [1.2, 1.5], L_SHAPE) == pytest.approx(0.1)
    assert clearance(SQUARE + [1.1, 1.5], L_SHAPE) == pytest.approx(0.0)
    assert clearance(SQUARE + [1.05, 1.5], L_SHAPE) == pytest.approx(-0.05)
    assert clearance(SQUARE + [-0.4, -0.5], L_SHAPE) == pytest.approx(0.5)
    np.testing.assert_allclose(sum(np.prod(s[1] - s[0]) for s in strips(L_SHAPE, 0.01)), 3.0)


@pytest.mark.parametrize(
    ("corners", "wrong"),
    [
        ([(0, 0), (1, 1)], "three corners"),
        ([(0, 0), (1, 1), (1, 0), (0, 1)], "cross"),
        ([(0, 0), (0, 0), (1, 0), (0, 1)], "one point"),
        ([(0, 0), (2, 0), (2, 1), (1, 0), (0, 1)], "cross"),
        ([(0, 0), (1, 0), (2, 0)], "cross|area"),
    ],
)
def test_what_is_no_polygon_is_refused(corners, wrong):
    with pytest.raises(ValueError, match=wrong):
        Placement(lower=(0.0, 0.0), upper=(2.0, 2.0), keep_out_polygons=[corners])


def test_a_scene_with_every_limit_is_read_back_as_it_was_written(tmp_path):
    values = {
        "domain": {"lower": [0, 0, 0], "upper": [2, 1, 2]},
        "release": [{"lower": [0, 0, 0], "upper": [0.3, 0.3, 2], "velocity": [1, 0, 0]}],
        "placement": {
            "lower": [0.5, 0],
            "upper": [1.8, 2],
            "size": [0.1, 0.2, 0.1],
            "keep_out_polygons": [[[1, 0.5], [1.2, 0.6], [1.0, 0.9]]],
            "wall_gap": 0.05,
            "max_height": 0.4,
            "max_volume": 0.02,
            "max_overtopping": 0.05,
            "freeboard": 0.02,
            "vary": {"height": [0.1, 0.3], "number": [2, 5]},
        },
    }
    scene = Scene.from_dict(values)
    scene.to_toml(tmp_path / "scene.toml")
    assert Scene.from_toml(tmp_path / "scene.toml") == scene
    assert scene.placement.vary.number == (2, 5)
    plain = scene.replace(placement={"lower": [0.5, 0], "upper": [1.8, 2]})
    assert set(plain.to_dict()["placement"]) == {"lower", "upper", "gap", "keep_out"}
    for wrong, said in (
        ({"height": [0.3, 0.1]}, "lowest first"),
        ({"number": [0, 3]}, "1 or more"),
        ({"yaw": [0, 120]}, "degrees"),
        ({"width": [0.1, 0.2]}, "unknown key"),
    ):
        with pytest.raises(SceneError, match=said):
            scene.replace(placement={"lower": [0.5, 0], "upper": [1.8, 2], "vary": wrong})

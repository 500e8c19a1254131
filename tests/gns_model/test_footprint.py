from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gns_model import footprint
from gns_model.errors import SceneError
from gns_model.scene import Baffle, Scene

place = st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
sides = st.tuples(st.floats(0.05, 0.4), st.floats(0.05, 0.4))
yaws = st.floats(-89.9, 90.0)


def test_corners_are_the_documented_formula():
    t, (x, z), (a, b) = math.radians(20), (1.0, 2.0), (0.3, 0.1)
    expected = {
        (
            round(x + u * math.cos(t) - v * math.sin(t), 12),
            round(z + u * math.sin(t) + v * math.cos(t), 12),
        )
        for u in (-a / 2, a / 2)
        for v in (-b / 2, b / 2)
    }
    found = Baffle(center=(x, z), size=(a, 0.5, b), yaw=20).corners
    assert {tuple(c) for c in found.round(12)} == expected
    # From x towards z: the end that lies downstream moves to larger z.
    assert found[np.argmax(found[:, 0]), 1] > z


@given(sides, yaws)
def test_the_bounding_size_is_that_of_the_corners(size, yaw):
    corners = footprint.corners((0, 0), size, yaw)
    np.testing.assert_allclose(np.ptp(corners, axis=0), footprint.bounding_size(size, yaw))


@given(place, sides, yaws, sides, yaws)
def test_separation_agrees_with_dense_points(offset, one, first, other, second):
    a = footprint.corners((0, 0), one, first)
    b = footprint.corners(offset, other, second)
    found = float(footprint.separation(a, b))
    assert found == pytest.approx(float(footprint.separation(b, a)), abs=1e-12)
    share = np.linspace(0, 1, 41)[:, None]
    rims = [
        np.concatenate([c[k] + share * (c[(k + 1) % 4] - c[k]) for k in range(4)]) for c in (a, b)
    ]
    if found > 0:
        nearest = np.linalg.norm(rims[0][:, None] - rims[1][None], axis=-1).min()
        assert nearest - 0.01 <= found <= nearest + 1e-12
    elif found < 0:
        # Moving one of them by that way, in the right direction, and no less, parts them.
        angles = np.radians([first, first + 90, first + 180, first + 270])
        angles = np.concatenate([angles, np.radians([second + 90 * k for k in range(4)])])
        ways = np.stack([np.cos(angles), np.sin(angles)], -1)
        parted = [float(footprint.separation(a, b + w * (1e-9 - found))) for w in ways]
        short = [float(footprint.separation(a, b + w * (-1e-9 - found))) for w in ways]
        assert max(parted) >= 0 > max(short)


@given(st.floats(-720, 720))
def test_wrap_keeps_the_footprint(yaw):
    wrapped = footprint.wrap(yaw)
    assert -90 < wrapped <= 90
    a, b = (footprint.corners((0, 0), (0.3, 0.1), y) for y in (yaw, wrapped))
    assert np.abs(a[:, None] - b[None]).sum(-1).min(1).max() < 1e-9


def test_quarter_turns_are_exact():
    assert [footprint.turn(y) for y in (0, 90, 180, -90)] == [(1, 0), (0, 1), (-1, 0), (0, -1)]
    turned, plain = (
        Baffle(center=(0, 0), size=(0.1, 0.2, 0.3), yaw=90),
        Baffle(center=(0, 0), size=(0.3, 0.2, 0.1)),
    )
    assert turned.box(0.0) == plain.box(0.0)
    assert turned.unturned == (plain.size, 0.0)


def turned(flume: Scene, *baffles: dict) -> Scene:
    return flume.replace(baffles=baffles)


def test_yaw_is_written_only_where_there_is_one(flume: Scene):
    assert "yaw" not in flume.to_toml()
    scene = flume.with_baffles([[0.8, 0.5], [1.2, 1.0]], yaw=[0.0, 30.0])
    assert scene.to_toml().count("yaw") == 1
    assert Scene.from_dict(scene.to_dict()) == scene != flume
    assert (flume.is_turned, scene.is_turned) == (False, True)


def test_with_baffles_gives_one_to_all_or_one_to_each(flume: Scene):
    centres = [[0.8, 0.5], [1.2, 1.0]]
    sizes = [(0.1, 0.3, 0.2), (0.2, 0.2, 0.3)]
    each = flume.with_baffles(centres, size=sizes, yaw=[10, -20])
    assert [(b.size, b.yaw) for b in each.baffles] == [(sizes[0], 10), (sizes[1], -20)]
    assert {b.yaw for b in flume.with_baffles(centres, yaw=45).baffles} == {45}
    for more, fragment in (({"size": sizes[:1]}, "size must"), ({"yaw": [1, 2, 3]}, "yaw must")):
        with pytest.raises(SceneError, match=fragment):
            flume.with_baffles(centres, **more)


def test_an_emptied_scene_still_knows_yaw_and_size(flume: Scene):
    scene = turned(flume, {"center": (1.0, 1.0), "size": (0.1, 0.3, 0.4), "yaw": 25.0})
    assert scene.with_baffles([]).with_baffles([[1.2, 1.0]]).baffles[0].yaw == 25
    assert scene.with_baffles([[1.2, 1.0]]).baffle_yaw == 25
    assert flume.with_baffles([]).placement.yaw is None


@pytest.mark.parametrize(
    ("baffles", "fragment"),
    [
        ([{"center": (1.0, 1.0), "size": (0.1, 0.3, 0.1), "yaw": 91}], "yaw = 91"),
        ([{"center": (1.0, 1.0), "size": (0.1, 0.3, 0.1), "yaw": -90}], "yaw = -90"),
        ([{"center": (1.0, 1.0), "size": (0.1, 0.3, 0.1), "yaw": math.nan}], "finite"),
        # Unturned it would stand 1 cm clear of the wall.
        ([{"center": (1.0, 0.21), "size": (0.2, 0.3, 0.2), "yaw": 45}], "leaves the domain"),
        (
            [
                {"center": (1.0, 1.0), "size": (0.1, 0.3, 0.5), "yaw": 45},
                {"center": (1.05, 1.05), "size": (0.1, 0.3, 0.1), "yaw": 10},
            ],
            r"turned by 10 degrees\) overlaps baffle\[0\]",
        ),
        ([{"center": (0.5, 1.0), "size": (0.1, 0.3, 0.1), "yaw": 45}], r"overlaps release\[0\]"),
    ],
)
def test_a_turned_baffle_that_cannot_stand_is_refused(flume: Scene, baffles, fragment):
    with pytest.raises(SceneError, match=fragment):
        turned(flume, *baffles)


def test_boxes_that_overlap_do_not_refuse_footprints_that_do_not(flume: Scene):
    pair = [
        {"center": (1.0, 1.0), "size": (0.05, 0.3, 0.5), "yaw": 45},
        {"center": (1.15, 1.15), "size": (0.05, 0.3, 0.5), "yaw": 45},
    ]
    boxes = turned(flume, *pair).baffle_boxes()
    assert (boxes[0, 1] > boxes[1, 0]).all()
    assert (boxes[0, 0] < boxes[1, 1]).all()


def test_a_plane_scene_turns_nothing(plane_scene: Scene):
    with pytest.raises(SceneError, match="only a baffle in 3D can be turned, got yaw = 5 in 2D"):
        plane_scene.with_baffles([[0.6]], yaw=5)

"""Walls, polygons, height and volume: every layout that leaves a layout space obeys them."""

import numpy as np
import pytest

from gns_env.layout import LayoutSpace
from gns_env.task import BaffleTask
from gns_model.errors import LayoutError
from gns_model.polygon import clearance
from gns_model.scene import Scene

TRIANGLE = [(0.7, 0.5), (1.3, 0.7), (0.8, 1.2)]


def flume(**placement) -> Scene:
    """An empty flume 2 m x 1.6 m with baffles of 0.15 m to place."""
    return Scene.from_dict(
        {
            "domain": {"lower": [0.0, 0.0, 0.0], "upper": [2.0, 0.6, 1.6]},
            "release": [{"lower": [0, 0, 0.3], "upper": [0.3, 0.3, 1.3], "velocity": [1, 0, 0]}],
            "placement": {
                "lower": [0.5, 0.0],
                "upper": [2.0, 1.6],
                "gap": 0.1,
                "size": [0.15, 0.3, 0.15],
                **placement,
            },
        }
    )


@pytest.mark.parametrize("seed", range(3))
def test_every_projection_keeps_clear_of_walls_and_polygons(seed):
    scene = flume(wall_gap=0.08, keep_out_polygons=[TRIANGLE])
    space, rng = LayoutSpace(scene, 4), np.random.default_rng(seed)
    for wish in (space.random(rng), rng.normal((1.0, 0.8), 0.1, (4, 2))):
        centres = space.project(wish)
        assert space.check(centres) == []
        for baffle in scene.with_baffles(centres).baffles:
            box = baffle.box(0.0)
            assert min(box.lower[2], 1.6 - box.upper[2], 2.0 - box.upper[0]) >= 0.08 - 1e-9
            (x0, _, z0), (x1, _, z1) = box.lower, box.upper
            assert clearance([(x0, z0), (x1, z0), (x1, z1), (x0, z1)], TRIANGLE) >= -1e-9
    grown = space.place((0.9, 0.8), np.zeros((0, 2)))
    assert space.check([grown]) == []


def test_what_is_near_a_polygon_and_clear_of_it_stays_where_it_is():
    space = LayoutSpace(flume(keep_out_polygons=[TRIANGLE]), 1)
    # Clear of the slanting side, although within the box about the triangle.
    near = np.array([[1.2, 1.05]])
    assert space.check(near) == []
    assert (space.project(near) == near).all()
    assert space.check([[0.95, 0.8]]) == ["baffle 0 overlaps keep_out_polygons[0]"]


def test_walls_bound_the_centres():
    space = LayoutSpace(flume(wall_gap=0.2), 2)
    np.testing.assert_allclose([space.lower, space.upper], [[0.575, 0.275], [1.725, 1.325]])
    with pytest.raises(LayoutError, match=r"wall_gap 0\.9 m leaves nothing"):
        LayoutSpace(flume(wall_gap=0.9), 1)


def test_height_and_volume_are_limits_of_the_space_and_so_of_the_task():
    assert LayoutSpace(flume(max_height=0.3, max_volume=0.02025), 3).n_baffles == 3
    with pytest.raises(LayoutError, match=r"max_height 0\.25 m"):
        LayoutSpace(flume(max_height=0.25), 1)
    with pytest.raises(LayoutError, match=r"4 baffles .* take 0\.027 m³, more than max_volume"):
        BaffleTask(flume(max_volume=0.02025), "mpm", n_baffles=4)

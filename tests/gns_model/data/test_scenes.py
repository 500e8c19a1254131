import numpy as np
import pytest

from gns_model.cli import Family
from gns_model.data.column_scenes import PARTS
from gns_model.data.scenes import FAMILIES, draw
from gns_model.errors import SceneError
from gns_model.particles import fill


def test_the_command_knows_every_family():
    assert [family.value for family in Family] == list(FAMILIES)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_scene_is_the_same_everywhere_and_another_for_another_index(family):
    assert draw(family, 3, 5) == draw(family, 3, 5)
    assert len({draw(family, seed, index) for seed in (0, 1) for index in range(4)}) == 8


def test_an_unknown_family_is_refused():
    with pytest.raises(SceneError, match="squares"):
        draw("circles", 0, 0)


def test_squares_are_as_narrow_and_as_high_as_columns_of_other_aspects():
    scenes = [draw("squares", 0, k) for k in range(200)]
    sides = np.array([scene.releases[0].size for scene in scenes])
    np.testing.assert_allclose(sides[:, 0], sides[:, 1])
    assert 0.08 <= sides.min() < 0.09
    assert 0.42 < sides.max() <= 0.45
    lower = np.array([scene.releases[0].lower for scene in scenes])
    assert (lower[:, 1] == 0).all()
    assert 70 < (lower[:, 0] == 0).sum() < 130
    assert all(scene.releases[0].velocity == (0.0, 0.0) for scene in scenes)


@pytest.mark.parametrize("family", ["spreading", "spreading-friction", "pressed"])
def test_what_spreads_is_a_square_that_sinks_by_as_much_as_it_widens(family):
    scenes = [draw(family, 0, k) for k in range(40)]
    for scene in scenes:
        lower = np.min([box.lower for box in scene.releases], axis=0)
        upper = np.max([box.upper for box in scene.releases], axis=0)
        side = upper[1] - lower[1]
        assert upper[0] - lower[0] == pytest.approx(side)
        assert 0.074 < side < 0.451
        assert lower[1] == 0
        assert len(fill(scene, 0.0125).positions) == round((side / 0.0125) ** 2)

        velocity = np.array([b.velocity for b in scene.releases]).reshape(PARTS, PARTS, 2)
        box = side / PARTS
        widens = np.diff(velocity[..., 0], axis=0)[:, 1:-1] / box
        sinks = (velocity[:, 2:, 1] - velocity[:, :-2, 1]) / (2 * box)
        np.testing.assert_allclose(sinks[1:], -widens, rtol=0.03, atol=1e-9)
        still = velocity[:, :, 0].mean(0) * (lower[0] != 0)
        np.testing.assert_allclose(still, 0, atol=1e-9)  # free of the wall it spreads both ways
    assert 10 < sum(scene.releases[0].lower[0] == 0 for scene in scenes) < 30


def test_what_is_pressed_rises_to_heights_of_high_columns():
    rises = []
    for scene in (draw("pressed", 0, k) for k in range(40)):
        size = max(box.upper[1] for box in scene.releases)
        top = max(box.velocity[1] for box in scene.releases)
        rises.append(top**2 / (2 * 9.81) / size)
        assert all(box.velocity[1] > 0 for box in scene.releases)
    assert 0.15 < min(rises) < 0.5
    assert 1.0 < max(rises) < 1.5


def test_a_third_of_what_spreads_at_five_frictions_is_at_rest():
    scenes = [draw("spreading-friction", 0, k) for k in range(60)]
    assert 10 < sum(not any(map(any, (b.velocity for b in s.releases))) for s in scenes) < 30
    assert {s.material.friction_angle for s in scenes} == {15.0, 22.5, 30.0, 37.5, 45.0}


def test_rectangles_at_five_frictions_are_filled_to_their_sides():
    scenes = [draw("rectangles-friction", 1, k) for k in range(60)]
    sides = np.array([scene.releases[0].upper for scene in scenes])
    aspects = sides[:, 1] / sides[:, 0]
    assert 0.35 < aspects.min() < 0.45
    assert 2.2 < aspects.max() < 2.9
    for scene, (length, height) in zip(scenes, sides, strict=True):
        assert scene.releases[0].lower == (0.0, 0.0)
        assert len(fill(scene, 0.0125).positions) == round(length / 0.0125) * round(height / 0.0125)
    assert [s.material.friction_angle for s in scenes[:6]] == [15.0, 22.5, 30.0, 37.5, 45.0, 15.0]


def test_rows_are_tight_and_straight():
    scenes = [draw("rows", 0, k) for k in range(100)]
    for scene in scenes:
        first = min(b.center[0] for b in scene.baffles)
        rows = [
            [b for b in scene.baffles if (b.center[0] - first < 0.05) == near] for near in (1, 0)
        ]
        for row in filter(None, rows):
            assert 2 <= len(row) <= 6
            x, z = np.array(sorted((b.center for b in row), key=lambda c: c[1])).T
            gaps = np.diff(z) - row[0].size[2]
            assert 0.029 < gaps.min() <= gaps.max() < 0.171
            assert np.ptp(gaps) < 0.041
            assert np.ptp(x) <= 0.04
            assert z[0] - row[0].size[2] / 2 >= 0.1 - 1e-9  # within the walls
            assert z[-1] + row[0].size[2] / 2 <= 1.9 + 1e-9


def test_slides_start_on_the_base_and_have_room_before_the_far_wall():
    scenes = [draw("slides", 0, k) for k in range(60)]
    for scene in scenes:
        (block,) = scene.releases
        lower, upper, size = map(np.asarray, (block.lower, block.upper, block.size))
        assert (lower >= np.array(scene.domain.lower) - 1e-9).all()
        assert (upper <= np.array(scene.domain.upper) + 1e-9).all()
        assert lower[1] == scene.domain.lower[1]
        assert 0.1 <= size[1] <= 0.3
        assert scene.domain.upper[0] - upper[0] > 0.9
        for baffle in scene.baffles:
            assert baffle.center[0] - baffle.size[0] / 2 > upper[0]
    assert {len(scene.baffles) for scene in scenes} == {0, 1, 2}
    widths = [scene.domain.upper[2] - scene.domain.lower[2] for scene in scenes]
    fills = [s.releases[0].size[2] > 0.999 * w for s, w in zip(scenes, widths, strict=True)]
    assert 15 < sum(fills) < 45
    for scene in (s for s, full in zip(scenes, fills, strict=True) if full):
        for baffle in scene.baffles:  # which leave a way past
            assert baffle.size[2] <= 0.61 * scene.releases[0].size[2]

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gns_model.errors import SceneError
from gns_model.paper import flume_scene
from gns_model.particles import fill, scatter, shaken
from gns_model.scene import Scene


def block(size: list[float], lower: list[float] | None = None) -> Scene:
    dim = len(size)
    lower = lower or [0.0] * dim
    return Scene.from_dict(
        {
            "domain": {"lower": [v - 10 for v in lower], "upper": [v + 10 for v in lower]},
            "release": [
                {
                    "lower": lower,
                    "upper": [a + b for a, b in zip(lower, size, strict=True)],
                    "velocity": [1.0, -2.0, 3.0][:dim],
                }
            ],
        }
    )


def test_the_papers_densities(flume: Scene, examples):
    # 262,144 points per m³ in 3D and 25,600 per m² in 2D; the table's counts of points.
    assert 1 / fill(flume, 1 / 64).volume == pytest.approx(262_144)
    assert len(fill(flume, 1 / 64).positions) == 22 * 16 * 89
    counts = {"0.5": 1956, "0.8": 1824, "1.0": 2304, "2.0": 1152, "3.0": 1106, "4.0": 576}
    for name, papers in counts.items():
        scene = Scene.from_toml(examples / "columns" / f"a-{name}.toml")
        # The paper drops or adds a row here and there where a box is no multiple of the spacing.
        assert len(fill(scene, 1 / 160).positions) == pytest.approx(papers, rel=0.05)


@given(
    st.lists(st.floats(0.05, 1.0), min_size=2, max_size=3),
    st.floats(0.02, 0.05),
    st.floats(-5, 5),
)
def test_points_fill_the_box_on_a_centred_lattice(size, spacing, shift):
    scene = block(size, [shift] * len(size))
    points = fill(scene, spacing)
    release = scene.releases[0]
    lower, upper = points.positions.min(axis=0), points.positions.max(axis=0)
    # Centred, half a spacing off the faces, and no room left for another layer.
    np.testing.assert_allclose(lower - release.lower, np.array(release.upper) - upper, atol=1e-9)
    assert (lower - release.lower >= spacing / 2 - 1e-6).all()
    assert (lower - release.lower < spacing + 1e-6).all()
    # The lattice coordinates say where every point is.
    np.testing.assert_allclose(points.positions, lower + spacing * points.lattice, atol=1e-9)
    assert len(np.unique(points.lattice, axis=0)) == len(points.positions)
    assert (points.velocities == release.velocity).all()
    assert points.volume == pytest.approx(spacing ** len(size))
    assert points.volume * len(points.positions) <= np.prod(release.size) * (1 + 1e-4)


def test_every_release_keeps_its_velocity():
    scene = Scene.from_dict(
        {
            "domain": {"lower": [0, 0], "upper": [1, 1]},
            "release": [
                {"lower": [0, 0], "upper": [0.2, 0.2], "velocity": [1, 0]},
                {"lower": [0.5, 0], "upper": [0.6, 0.1], "velocity": [-1, 0]},
            ],
        }
    )
    points = fill(scene, 0.05)
    left = points.positions[:, 0] < 0.3
    assert left.sum() == 16
    assert (~left).sum() == 4
    assert (points.velocities[left] == [1, 0]).all()
    assert (points.velocities[~left] == [-1, 0]).all()


def test_every_second_point_is_a_lattice_of_twice_the_spacing(flume: Scene):
    points = fill(flume, 0.05)
    every_second = points.positions[(points.lattice % 2 == 1).all(axis=1)]
    for axis in range(3):
        steps = np.diff(np.unique(every_second[:, axis].round(6)))
        np.testing.assert_allclose(steps, 0.1, atol=1e-5)


def test_a_release_thinner_than_the_spacing_is_refused():
    with pytest.raises(SceneError, match=r"release\[0\].*0\.05.*thinner than the spacing 0.1"):
        fill(block([1.0, 0.05]), 0.1)


@pytest.mark.parametrize("subcells", [1, 2, 3])
def test_scattered_points_stay_in_their_cells_and_keep_their_mean(subcells):
    scene = flume_scene()
    regular = fill(scene, 0.03125)
    moved = scatter(regular, subcells)
    offset = (moved.positions - regular.positions) / regular.spacing
    places = (np.arange(subcells) + 0.5) / subcells - 0.5
    assert np.isin(offset.round(9), places.round(9)).all()
    assert len(np.unique(offset.round(9))) == subcells
    np.testing.assert_allclose(offset.mean(axis=0), 0, atol=0.02)
    np.testing.assert_array_equal(moved.positions, scatter(regular, subcells).positions)


@pytest.mark.parametrize("jitter", [0.0, 0.25, 0.49])
def test_shaken_points_stay_in_their_cells_and_differ_by_draw(jitter):
    regular = fill(flume_scene(), 0.03125)
    moved = shaken(regular, jitter, 1)
    offset = np.abs(moved.positions - regular.positions).max(axis=0) / regular.spacing
    assert (offset <= jitter + 1e-9).all()
    assert (offset >= 0.95 * jitter).all()
    np.testing.assert_array_equal(moved.positions, shaken(regular, jitter, 1).positions)
    assert (jitter == 0) == np.array_equal(moved.positions, shaken(regular, jitter, 2).positions)

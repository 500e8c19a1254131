import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from design.distinct import apart, distance
from design.parameters import names, ordered, to_centres, to_parameters
from gns_env.layout import LayoutSpace
from gns_model.scene import Scene

from .search_kit import formula_scene

SPACES = {n: LayoutSpace(formula_scene(), n) for n in (1, 2, 3, 5)}
unit = st.floats(0.0, 1.0)


@given(st.sampled_from(sorted(SPACES)), st.integers(0, 10_000))
def test_every_layout_is_one_point_whatever_its_numbering(n, seed):
    space, rng = SPACES[n], np.random.default_rng(seed)
    centres = space.random(rng)
    parameters = to_parameters(space, centres)
    assert all(0 <= value <= 1 for value in parameters.values())
    assert to_parameters(space, rng.permutation(centres)) == parameters
    np.testing.assert_allclose(to_centres(space, parameters), ordered(centres), atol=1e-9)


@given(st.sampled_from(sorted(SPACES)), st.data())
def test_every_point_is_one_layout(n, data):
    space = SPACES[n]
    # Below 1: at 1 two baffles stand at one place across, and x decides which is the first.
    parameters = {name: data.draw(st.floats(0.05, 0.999)) for name in names(space)}
    centres = to_centres(space, parameters)
    assert (np.diff(centres[:, -1]) >= 0).all()
    back = to_parameters(space, centres)
    np.testing.assert_allclose([back[k] for k in parameters], list(parameters.values()), atol=1e-6)


def test_uniform_points_are_uniform_places():
    space = SPACES[3]
    rng = np.random.default_rng(0)
    z = np.array(
        [
            to_centres(space, dict(zip(names(space), rng.random(6), strict=True)))[:, 1]
            for _ in range(4000)
        ]
    )
    z = (z - space.lower[1]) / (space.upper[1] - space.lower[1])
    # Means of the order statistics of three uniform numbers are 1/4, 1/2, 3/4.
    np.testing.assert_allclose(z.mean(axis=0), [0.25, 0.5, 0.75], atol=0.01)


def test_plane_strain_has_one_parameter_a_baffle(plane_scene: Scene):
    space = LayoutSpace(plane_scene, 2)
    assert names(space) == ["x1", "x2"]
    centres = np.array([[0.8], [0.5]])
    np.testing.assert_allclose(to_centres(space, to_parameters(space, centres)), [[0.5], [0.8]])


@given(st.integers(0, 10_000))
def test_distance_is_a_metric_on_unnumbered_layouts(seed):
    rng = np.random.default_rng(seed)
    a, b = rng.random((3, 2)), rng.random((3, 2))
    assert distance(a, rng.permutation(a)) == pytest.approx(0)
    assert distance(a, b) == pytest.approx(distance(b, rng.permutation(a)))
    shift = np.array([0.03, 0.04])
    assert distance(a, a + shift) <= 0.05 + 1e-12


def test_apart_keeps_the_first_of_neighbours():
    a = np.array([[0.0, 0.0], [1.0, 1.0]])
    near, far = a + 0.01, a + 0.5
    assert [c is a or c is far for c in apart([a, near, far], 0.05, 5)] == [True, True]
    assert apart([a, near, far], 0.05, 1)[0] is a
    assert apart([a, near, far], 0.05, 5, avoid=[a])[0] is far

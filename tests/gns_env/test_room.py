"""Free rectangles and packings, against a fine raster and against what is known to be optimal."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gns_env.room import _candidates, _greedy, free_rectangles, nearest_free, pack

AREA = np.array([[0.0, 0.0], [10.0, 6.0]])
coordinate = st.integers(-2, 12)


@st.composite
def obstacles(draw: st.DrawFn) -> np.ndarray:
    rectangles = []
    for _ in range(draw(st.integers(0, 4))):
        x, z = draw(coordinate), draw(coordinate)
        w, d = draw(st.integers(1, 6)), draw(st.integers(1, 6))
        rectangles.append([[x, z], [x + w, z + d]])
    return np.array(rectangles, dtype=float).reshape(-1, 2, 2)


def _blocked(points: np.ndarray, blocked: np.ndarray) -> np.ndarray:
    inside = (points[:, None] > blocked[None, :, 0]) & (points[:, None] < blocked[None, :, 1])
    return inside.all(-1).any(1)


def _raster() -> np.ndarray:
    # Quarters hit edges (integers) as well as what lies between them.
    x, z = np.meshgrid(np.arange(0, 10.25, 0.25), np.arange(0, 6.25, 0.25), indexing="ij")
    return np.stack([x.ravel(), z.ravel()], 1)


@given(obstacles())
def test_free_rectangles_cover_what_is_free_and_nothing_else(blocked: np.ndarray) -> None:
    free, points = free_rectangles(AREA, blocked), _raster()
    held = (points[:, None] >= free[None, :, 0]) & (points[:, None] <= free[None, :, 1])
    np.testing.assert_array_equal(held.all(-1).any(1), ~_blocked(points, blocked))


@given(obstacles(), st.tuples(st.floats(-5, 15), st.floats(-5, 15)))
def test_nearest_free_place_is_nearer_than_every_free_raster_point(
    blocked: np.ndarray, wish: tuple[float, float]
) -> None:
    free = free_rectangles(AREA, blocked)
    points = _raster()
    points = points[~_blocked(points, blocked)]
    if len(free) == 0:
        assert len(points) == 0
        return
    place = nearest_free(free, np.array(wish))
    assert not _blocked(place[None], blocked).any()
    distances = np.linalg.norm(points - wish, axis=1)
    assert np.linalg.norm(place - wish) <= distances.min() + 1e-9


@given(obstacles(), st.integers(1, 12), st.integers(2, 4), st.integers(2, 4))
def test_a_packing_keeps_its_distances(
    blocked: np.ndarray, n: int, along: int, across: int
) -> None:
    free, separation = free_rectangles(AREA, blocked), np.array([along, across], dtype=float)
    places, bound = pack(free, separation, n)
    assert len(places) <= bound
    assert not _blocked(places, blocked).any()
    i, j = np.triu_indices(len(places), 1)
    assert (np.abs(places[i] - places[j]) >= separation - 1e-9).any(1).all()


def test_rows_and_columns_when_nothing_is_in_the_way() -> None:
    places, bound = pack(AREA[None], np.array([2.0, 3.0]), 1)
    assert len(places) == bound == 6 * 3


def _most(points: np.ndarray, separation: np.ndarray) -> int:
    """Size of the largest pairwise separated subset, by plain branching."""
    if len(points) == 0:
        return 0
    clear = (np.abs(points - points[0]) >= separation - 1e-9).any(1)
    with_first = 1 + _most(points[clear], separation)
    # Leaving the first out can only help if one of its rivals comes in.
    rest = points[1:]
    return max(with_first, _most(rest, separation)) if (~clear[1:]).any() else with_first


@settings(max_examples=25)
@given(obstacles(), st.integers(2, 3), st.integers(2, 3))
def test_the_bound_is_how_many_really_fit(blocked: np.ndarray, along: int, across: int) -> None:
    # With integers everywhere an optimal packing, pushed to the lower corner, is on integers.
    area, separation = np.array([[0.0, 0.0], [5.0, 3.0]]), np.array([along, across], dtype=float)
    x, z = np.meshgrid(np.arange(6.0), np.arange(4.0), indexing="ij")
    points = np.stack([x.ravel(), z.ravel()], 1)
    points = points[~_blocked(points, blocked)]
    places, bound = pack(free_rectangles(area, blocked), separation, 99)
    assert len(places) == bound == _most(points, separation)


def test_the_exact_search_finds_what_the_greedy_one_misses() -> None:
    # A centre 2 or less from the left fits below the obstacle's top only there and at x = 5
    # exactly; the greedy search takes (3, 1) and with it both places of that last line.
    free = free_rectangles(
        np.array([[0.0, 0.0], [5.0, 3.0]]), np.array([[[2.0, -1.0], [5.0, 1.0]]])
    )
    separation = np.array([3.0, 3.0])
    assert len(_greedy(_candidates(free, separation), separation)) == 3
    places, bound = pack(free, separation, 4)
    assert len(places) == bound == 4
    # Nobody searches longer than for what was asked.
    assert len(pack(free, separation, 3)[0]) == 3


@pytest.mark.parametrize("n", [1, 5])
def test_nowhere_is_no_room(n: int) -> None:
    free = free_rectangles(AREA, np.array([[[-1.0, -1.0], [11.0, 7.0]]]))
    places, bound = pack(free, np.array([1.0, 1.0]), n)
    assert len(places) == bound == 0

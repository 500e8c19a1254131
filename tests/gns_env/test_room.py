"""Free rectangles and packings, against a fine raster and against what is known to be optimal."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gns_env.room import free_rectangles, nearest_free, pack

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


def test_a_packing_that_only_the_exact_search_finds() -> None:
    # One axis, obstacle in the middle: 0..3 and 4.5..7.5 hold two each, 3 apart. The greedy search
    # goes up from 0 and finds them; turned about, with places from both ends, it has to be exact.
    free = free_rectangles(np.array([[0.0], [7.5]]), np.array([[[3.0], [4.5]]]))
    places, bound = pack(free, np.array([3.0]), 5)
    # 0, 3 and 6 fit with 7.5 - 6 < 3 left over: three is the most (0, 3 | 6..7.5).
    assert len(places) == bound == 3


def test_greedy_choice_is_beaten_by_the_exact_one() -> None:
    # The lowest corner first blocks both arms of this plus; without it they hold one each.
    separation = np.array([2.0, 2.0])
    free = np.array([[[0.0, 1.0], [3.0, 1.0]], [[1.5, 0.0], [1.5, 2.5]]])
    places, bound = pack(free, separation, 9)
    # Brute force over a fine raster of the plus.
    raster = np.unique(
        np.concatenate(
            [
                np.stack([np.arange(0, 3.01, 0.25), np.full(13, 1.0)], 1),
                np.stack([np.full(11, 1.5), np.arange(0, 2.51, 0.25)], 1),
            ]
        ),
        axis=0,
    )
    clear = (np.abs(raster[:, None] - raster[None]) >= separation - 1e-9).any(-1)
    most = 0
    for mask in range(3):
        chosen: list[int] = []
        for k in np.roll(np.arange(len(raster)), -mask * 5):
            if all(clear[k, c] for c in chosen):
                chosen.append(int(k))
        most = max(most, len(chosen))
    assert len(places) == bound >= most


@pytest.mark.parametrize("n", [1, 5])
def test_nowhere_is_no_room(n: int) -> None:
    free = free_rectangles(AREA, np.array([[[-1.0, -1.0], [11.0, 7.0]]]))
    places, bound = pack(free, np.array([1.0, 1.0]), n)
    assert len(places) == bound == 0

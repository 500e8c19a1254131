"""Grains of one kind may trade places: what a rolled state is then asked."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gns_model.data.windows import Window
from gns_model.particles import MOVING, STATIONARY
from gns_model.training import exchange
from gns_model.training.exchange import least_way_back
from gns_model.training.replay import wish

from .conftest import cube_scene

BACK = 16.0


def heap(seed: int, points: int, dim: int = 2) -> np.ndarray:
    """Positions [m] of a heap in two frames, shape (N, 2, D): dense behind, thin ahead."""
    rng = np.random.default_rng(seed)
    now = rng.normal(0, 0.05, (points, dim))
    now[:, 0] = rng.exponential(0.1, points)
    before = now - rng.normal(0.005, 0.001, (points, dim))
    return np.stack([before, now], axis=1).astype(np.float32)


def window(history: np.ndarray, **kinds: np.ndarray) -> Window:
    return Window(history, history[:, -1:] + 0.005, cube_scene(), **kinds)


def cost(history: np.ndarray, truth: Window, order: np.ndarray) -> float:
    own, true = (exchange._state(h, BACK) for h in (history, truth.history[order]))
    return float(((own - true) ** 2).sum())


@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.sampled_from([2, 3]))
@settings(max_examples=20, deadline=None)
def test_grains_that_have_traded_places_are_asked_no_way_back(seed, points, dim):
    truth = window(heap(seed, points, dim))
    traded = np.random.default_rng(seed).permutation(points)
    own = truth.history[traded]
    order = least_way_back(own, truth, np.arange(points, dtype=np.int32), BACK)
    np.testing.assert_array_equal(order, traded)
    _, back = wish(own, truth.reordered(order), BACK)
    np.testing.assert_allclose(back, 0.0, atol=1e-9)


@given(st.integers(0, 2**32 - 1), st.integers(2, 80), st.integers(5, 200))
@settings(max_examples=30, deadline=None)
def test_a_pairing_is_one_to_one_within_kinds_and_never_costs_more(seed, points, at_once):
    """Also by slabs, and whatever the pairing so far."""
    rng = np.random.default_rng(seed)
    kinds = np.array([MOVING, MOVING + 1, STATIONARY])[rng.integers(0, 3, points)]
    friction = np.array([0.3, 0.6], np.float32)[rng.integers(0, 2, points)]
    truth = window(heap(seed, points), particle_type=kinds, tan_friction=friction)
    own = heap(seed + 1, points)
    before = np.arange(points, dtype=np.int32)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exchange, "AT_ONCE", at_once)
        for _ in range(2):
            after = least_way_back(own, truth, before, BACK)
            assert sorted(after) == list(range(points))
            np.testing.assert_array_equal(kinds[after], kinds)
            np.testing.assert_array_equal(friction[after], friction)
            still = kinds == STATIONARY
            np.testing.assert_array_equal(after[still], np.flatnonzero(still))
            assert cost(own, truth, after) <= cost(own, truth, before) * (1 + 1e-9)
            before = after


def test_slabs_come_near_to_all_at_once(monkeypatch):
    truth, own = window(heap(0, 400)), heap(1, 400)
    begin = np.arange(400, dtype=np.int32)
    whole = cost(own, truth, least_way_back(own, truth, begin, BACK))
    monkeypatch.setattr(exchange, "AT_ONCE", 130)
    slabs = begin
    for _ in range(4):
        slabs = least_way_back(own, truth, slabs, BACK)
    assert cost(own, truth, slabs) <= 1.5 * whole
    assert 5 * whole < cost(own, truth, begin)


def test_a_front_of_the_right_length_is_left_where_it_is():
    """Two draws of one and the same heap: each grain's own place takes the foremost twentieth back
    into the crowd, the pairing leaves it, and a heap that is too short is asked ahead in full."""
    truth = window(heap(2, 1200))
    for stretch in (1.0, 0.9):
        own = heap(3, 1200)
        own[..., 0] *= stretch
        ahead = np.argsort(own[:, -1, 0])[-60:]
        farthest = np.sort(truth.history[:, -1, 0])[-60:].mean()
        missing = farthest - own[ahead, -1, 0].mean()
        order = least_way_back(own, truth, np.arange(1200, dtype=np.int32), BACK)
        asked = (truth.history[order, -1, 0] - own[:, -1, 0])[ahead].mean()
        its_own = (truth.history[:, -1, 0] - own[:, -1, 0])[ahead].mean()
        assert its_own < -0.2
        assert asked == pytest.approx(missing, abs=0.01)

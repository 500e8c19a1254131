"""Noise, learning rate and moving average, against their formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gns_model.errors import GnsError
from gns_model.training import Recipe
from gns_model.training.noise import SHORTEST, random_walk, shared_acceleration
from gns_model.training.schedule import MovingAverage, learning_rate


@pytest.mark.parametrize("history", [1, 3, 5])
def test_velocity_noise_is_a_random_walk_that_ends_at_its_std(history):
    std = 3e-4
    noise = random_walk(np.random.default_rng(0), 20_000, history, 3, std)
    assert noise.shape == (20_000, history + 1, 3)
    assert noise.dtype == np.float32
    assert not noise[:, 0].any()
    velocity = np.diff(noise, axis=1)
    wanted = std * np.sqrt(np.arange(1, history + 1) / history)
    np.testing.assert_allclose(velocity.std(axis=(0, 2)), wanted, rtol=0.02)
    np.testing.assert_allclose(velocity.mean(axis=(0, 2)), 0, atol=0.02 * std)


SPACING = 0.01


def falling(points=400, history=5, dim=2, seed=0):
    """Positions whose accelerations are 1e-3 m a step², by root mean square over the axes."""
    rng = np.random.default_rng(seed)
    place = rng.uniform(0, 0.5, (points, 1, dim)) + np.zeros((1, history + 1, 1))
    time = np.arange(history + 1)[None, :, None]
    down = np.zeros(dim)
    down[1] = -1e-3 * np.sqrt(dim)
    return place + 0.5 * time**2 * down


@pytest.mark.parametrize("dim", [2, 3])
def test_shared_acceleration_keeps_the_last_velocity_and_is_the_same_at_all_times(dim):
    history = falling(dim=dim)
    noise = shared_acceleration(np.random.default_rng(1), history, SPACING, 0.5)
    assert noise.shape == history.shape
    assert noise.dtype == np.float32
    assert not noise[:, -2:].any()
    added = np.diff(noise.astype(np.float64), n=2, axis=1)
    assert np.abs(added).max() > 1e-4
    np.testing.assert_allclose(added, added[:, -1:].repeat(added.shape[1], 1), atol=1e-9)


def test_shared_acceleration_has_the_share_that_it_is_told_to():
    history = falling(points=100)
    added = [
        np.diff(shared_acceleration(np.random.default_rng(k), history, SPACING, 0.5), 2, axis=1)
        for k in range(1000)
    ]
    assert np.sqrt(np.mean(np.square(added))) == pytest.approx(0.5 * 1e-3, rel=0.05)
    assert np.abs(np.mean(added)) < 0.05 * 1e-3


def test_neighbours_share_it():
    """Over a tenth of the shortest wave no wave turns by more than 0.63; noise of every point by
    itself would differ by 1.4 times its own root mean square."""
    history = falling(points=50)
    both = np.concatenate([history, history + np.array([0.1 * SHORTEST * SPACING, 0.0])])
    for k in range(20):
        noise = shared_acceleration(np.random.default_rng(k), both, SPACING, 0.5)[:, 0]
        apart = noise[:50] - noise[50:]
        assert 0 < np.mean(apart**2) < 0.63**2 * np.mean(noise**2)


def test_a_scene_at_rest_gets_no_shared_acceleration():
    still = np.repeat(np.random.default_rng(0).uniform(0, 1, (30, 1, 2)), 6, axis=1)
    assert not shared_acceleration(np.random.default_rng(1), still, SPACING, 0.5).any()


def test_a_single_velocity_has_no_acceleration_to_hide(tiny):
    values = {**tiny, "acceleration_noise": 0.5, "model": {**tiny["model"], "history": 1}}
    with pytest.raises(GnsError, match=r"acceleration_noise needs model\.history of at least 2"):
        Recipe.from_dict(values)


def test_cosine_warms_up_and_ends_at_zero(tiny):
    recipe = Recipe.from_dict({**tiny, "learning_rate": 1e-3, "warmup": 0.1})
    rates = [learning_rate(recipe, 0, x) for x in np.linspace(0, 1, 101)]
    assert rates[0] == pytest.approx(0.02 * 1e-3)
    assert max(rates) == rates[10] == pytest.approx(1e-3)
    assert rates[55] == pytest.approx(0.5e-3)
    assert rates[-1] == pytest.approx(0, abs=1e-12)
    assert rates[:11] == sorted(rates[:11])
    assert rates[10:] == sorted(rates[10:], reverse=True)


def test_exponential_is_the_papers(tiny):
    recipe = Recipe.from_dict({**tiny, "learning_rate": 1e-4, "schedule": "exponential"})
    assert learning_rate(recipe, 0, 0.7) == 1e-4
    assert learning_rate(recipe, 5_000_000, 0.0) == pytest.approx(1e-5)
    assert learning_rate(recipe, 2_500_000, 0.0) == pytest.approx(1e-4 * math.sqrt(0.1))


def test_moving_average_follows_the_weights():
    module = torch.nn.Linear(2, 1)
    average = MovingAverage(module, 0.99)
    start = average.weights["weight"].clone()
    with torch.no_grad():
        module.weight.fill_(5.0)
    average.update(module, 0)
    torch.testing.assert_close(average.weights["weight"], 0.1 * start + 0.9 * 5.0)
    for step in range(1, 3000):
        average.update(module, step)
    other = torch.nn.Linear(2, 1)
    average.copy_to(other)
    torch.testing.assert_close(other.weight, module.weight)
    before = average.weights["weight"].clone()
    with torch.no_grad():
        module.weight.fill_(6.0)
    average.update(module, 10**6)
    torch.testing.assert_close(average.weights["weight"], before + 0.01 * (6 - before))

"""Noise, learning rate and moving average, against their formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gns_model.training import Recipe
from gns_model.training.noise import random_walk
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

"""Small learned models with random weights, and folders of coarse references that tests share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from gns_model.learned import LearnedModel, LearnedSimulator, ModelConfig

#: Of the solver's points in these tests [m]: the thinnest column is 0.075 m.
SPACING = {2: 0.05, 3: 0.0625}

MakeSimulator = Callable[..., LearnedSimulator]


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder whose coarse references several tests use."""
    return tmp_path_factory.mktemp("suites")


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def tiny() -> MakeSimulator:
    """A small model with random weights that moves points by sane amounts."""

    def make(dim: int = 2, **options: Any) -> LearnedSimulator:
        torch.manual_seed(0)
        values = {
            "dim": dim, "spacing": SPACING[dim], "radius": 1.5 * SPACING[dim], "dt": 0.02,
            "history": 2, "latent": 8, "blocks": 1, **options,
        }  # fmt: skip
        model = LearnedModel(ModelConfig(**values))
        model.set_normalisation(
            velocity_mean=torch.zeros(dim),
            velocity_std=torch.ones(dim),
            acceleration_mean=torch.zeros(dim),
            acceleration_std=torch.full((dim,), 0.1),
        )
        return LearnedSimulator(model, name="tiny")

    return make

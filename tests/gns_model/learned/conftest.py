"""Small scenes and small models with random weights, in both dimensions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from gns_model.learned import LearnedModel, ModelConfig
from gns_model.scene import Scene

MakeModel = Callable[..., LearnedModel]
MakeScene = Callable[..., Scene]


@pytest.fixture(autouse=True)
def _one_thread() -> Any:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def make_model() -> MakeModel:
    """A small model with random weights that moves points by sane amounts."""

    def make(seed: int = 0, dtype: torch.dtype = torch.float32, **options: Any) -> LearnedModel:
        values = {
            "spacing": 0.05, "radius": 0.08, "dt": 0.01, "history": 2, "latent": 16, "blocks": 2,
            **options,
        }  # fmt: skip
        torch.manual_seed(seed)
        model = LearnedModel(ModelConfig(**values))
        dim = model.config.dim
        model.set_normalisation(
            velocity_mean=torch.zeros(dim),
            velocity_std=torch.ones(dim),
            acceleration_mean=torch.zeros(dim),
            acceleration_std=torch.full((dim,), 4.0),
        )
        return model.to(dtype)

    return make


@pytest.fixture
def make_scene() -> MakeScene:
    """A box of grains that runs into two baffles within 20 steps of 0.01 s."""

    def make(dim: int = 3, shift: tuple[float, ...] = (0.0, 0.0, 0.0), **changes: Any) -> Scene:
        def at(*point: float) -> list[float]:
            chosen = point if dim == 3 else point[:2]
            return [p + s for p, s in zip(chosen, shift, strict=False)]

        def plan(*point: float) -> list[float]:
            full = at(point[0], 0.0, point[1])
            return [full[0], *full[2:]]

        values: dict[str, Any] = {
            "domain": {"lower": at(0, 0, 0), "upper": at(0.9, 0.5, 0.4)},
            "release": [
                {
                    "lower": at(0.05, 0.02, 0.1),
                    "upper": at(0.25, 0.22, 0.3),
                    "velocity": [2.0, 0.0, 0.1][:dim],
                }
            ],
            "baffle": [
                {"center": plan(0.42, 0.13), "size": [0.1, 0.15, 0.1][:dim]},
                {"center": plan(0.58, 0.28), "size": [0.08, 0.2, 0.12][:dim]},
            ],
            "duration": 0.1,
        }
        return Scene.from_dict({**values, **changes})

    return make

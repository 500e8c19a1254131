"""What a whole run on real simulators needs to take seconds: a short flume and coarse points."""

from pathlib import Path

import torch

from design.evaluators import SimulatorSpec
from gns_model.learned import LearnedModel, ModelConfig, save_model
from gns_model.scene import Scene

COARSE = SimulatorSpec("mpm", options=(("spacing", 0.0625),))


def short_flume(**changes) -> Scene:
    """A flume of some hundred coarse points with a row of two baffles."""
    values = {
        "name": "short",
        "duration": 0.3,
        "section": 0.8,
        "domain": {"lower": [0.1, 0.1, 0.1], "upper": [1.5, 0.9, 1.1]},
        "release": [{"lower": [0.1, 0.1, 0.3], "upper": [0.45, 0.35, 0.9], "velocity": [2, 0, 0]}],
        "baffle": [baffle_at(0.9, 0.3), baffle_at(0.9, 0.9)],
        "placement": {"lower": [0.55, 0.1], "upper": [1.3, 1.1], "gap": 0.1},
    }
    return Scene.from_dict({**values, **changes})


def baffle_at(x, z):
    """A baffle of the paper's size, as plain values."""
    return {"center": [x, z], "size": [0.15, 0.3, 0.15]}


def tiny_model(folder: Path, *, seed=0, dt=0.025, limits=None, **card) -> Path:
    """The checkpoint of a learned simulator for COARSE's points that has learnt nothing."""
    torch.manual_seed(seed)
    config = ModelConfig(spacing=0.0625, radius=0.1, latent=8, blocks=1, dt=dt, limits=limits or {})
    return save_model(folder, LearnedModel(config), card)

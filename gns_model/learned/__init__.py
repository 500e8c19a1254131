"""The learned simulator: graph, features, network, contact, rollout and checkpoints."""

from __future__ import annotations

from gns_model.learned.checkpoint import load_model, read_card, save_model, shipped_models
from gns_model.learned.config import Limits, ModelConfig
from gns_model.learned.graph import radius_graph
from gns_model.learned.model import LearnedModel
from gns_model.learned.simulator import LearnedSimulator
from gns_model.learned.world import World, baffle_points

__all__ = [
    "LearnedModel",
    "LearnedSimulator",
    "Limits",
    "ModelConfig",
    "World",
    "baffle_points",
    "load_model",
    "radius_graph",
    "read_card",
    "save_model",
    "shipped_models",
]

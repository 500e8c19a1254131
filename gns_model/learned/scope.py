"""What a learned model can run at all; what it was trained for is told by its `Limits`."""

from __future__ import annotations

from gns_model.errors import SimulatorError
from gns_model.learned.config import ModelConfig
from gns_model.particles import MOVING, fill
from gns_model.scene import Scene


def require(config: ModelConfig, name: str, scene: Scene) -> None:
    """Refuse a scene that the model `name` cannot run.

    Raises:
        SimulatorError: if the dimension is another, or it does not see what is there.
        SceneError: if a release is thinner than the spacing of the model.
    """
    if scene.dim != config.dim:
        raise SimulatorError(
            f"{name} is a {config.dim}D model and the scene {scene.name!r} is {scene.dim}D"
        )
    if scene.baffles and config.baffles == "none":
        raise SimulatorError(
            f"{name} does not see baffles, and the scene {scene.name!r} has {len(scene.baffles)}"
        )
    if 0 < config.types <= MOVING:
        raise SimulatorError(
            f"{name} knows particle types 0 to {config.types - 1}, and the points of a scene are "
            f"of type {MOVING}: use predict_positions with types of its own"
        )
    for release in scene.releases:
        if min(release.size) < config.spacing:
            fill(scene, config.spacing)  # raises the error that names the release

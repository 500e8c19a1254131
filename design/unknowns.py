"""What a calibration can look for: a parameter of the scene as a vector.

Each knows where a scene has it, in which range it is looked for, and how it enters a rollout that
autograd differentiates.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, Protocol

import numpy as np
import torch

from design.target import Runout, Target
from gns_model.errors import SceneError
from gns_model.scene import Scene
from gns_model.simulator import Simulator

Parameter = Literal["friction", "velocity"]

#: Range in which a friction angle is looked for where the model names none [degrees].
FRICTION_RANGE = (5.0, 60.0)
#: How far from the scene's a component of the velocity is looked for [m/s], at least.
VELOCITY_REACH = 3.0


class Unknown(Protocol):
    """A parameter of the scene as a vector (P,), in units that a person reads."""

    name: Parameter
    labels: tuple[str, ...]
    unit: str

    def start(self, scene: Scene) -> np.ndarray:
        """The scene's own value, shape (P,)."""
        ...

    def bounds(self, scene: Scene, simulator: Simulator) -> list[tuple[float, float]]:
        """Where it is looked for."""
        ...

    def put(self, scene: Scene, value: np.ndarray) -> Scene:
        """The scene with this value."""
        ...

    def rollout_options(self, scene: Scene, value: torch.Tensor) -> dict[str, Any]:
        """Options of `rollout_tensor` that put `value` (P,) in, differentiably."""
        ...


class FrictionAngle:
    """The angle of internal friction of the material [degrees]."""

    name: Parameter = "friction"
    labels: tuple[str, ...] = ("friction angle",)
    unit = "degrees"

    def start(self, scene: Scene) -> np.ndarray:
        """See `Unknown`."""
        return np.array([scene.material.friction_angle])

    def bounds(self, scene: Scene, simulator: Simulator) -> list[tuple[float, float]]:
        """The range that a learned simulator was trained on; else a wide one."""
        limits = getattr(getattr(simulator, "config", None), "limits", None)
        trained = limits.friction_angle if limits is not None else None
        if trained is not None and trained[1] - trained[0] > 1.0:
            return [trained]
        return [FRICTION_RANGE]

    def put(self, scene: Scene, value: np.ndarray) -> Scene:
        """See `Unknown`."""
        material = scene.material.model_copy(update={"friction_angle": float(value[0])})
        return scene.replace(material=material)

    def rollout_options(self, scene: Scene, value: torch.Tensor) -> dict[str, Any]:
        """See `Unknown`."""
        return {"tan_friction": [torch.tan(torch.deg2rad(value[0]))]}


class ReleaseVelocity:
    """The velocity of all releases in plan [m/s]: along x, and in 3D across, along z.

    Args:
        axes: which of them are unknown; a runout tells of the one along x only.
    """

    name: Parameter = "velocity"
    unit = "m/s"

    def __init__(self, axes: Sequence[int]) -> None:
        self.axes = tuple(axes)
        self.labels = tuple(f"velocity along {'xyz'[a]}" for a in self.axes)

    def start(self, scene: Scene) -> np.ndarray:
        """See `Unknown`; of several releases the mean by volume."""
        volume = [float(np.prod(r.size)) for r in scene.releases]
        mean = np.average([r.velocity for r in scene.releases], axis=0, weights=volume)
        return np.array(mean)[list(self.axes)]

    def bounds(self, scene: Scene, simulator: Simulator) -> list[tuple[float, float]]:
        """As far again as the scene's speed, and at least `VELOCITY_REACH`, to both sides."""
        start = self.start(scene)
        reach = max(VELOCITY_REACH, 2 * float(np.abs(start).max()))
        return [(v - reach, v + reach) for v in start]

    def put(self, scene: Scene, value: np.ndarray) -> Scene:
        """See `Unknown`."""
        releases = []
        for release in scene.releases:
            velocity = list(release.velocity)
            for axis, v in zip(self.axes, value, strict=True):
                velocity[axis] = float(v)
            releases.append(release.model_copy(update={"velocity": tuple(velocity)}))
        return scene.replace(releases=tuple(releases))

    def rollout_options(self, scene: Scene, value: torch.Tensor) -> dict[str, Any]:
        """See `Unknown`; the components that are not looked for are the first release's."""
        parts = list(torch.tensor(scene.releases[0].velocity, dtype=value.dtype).unbind())
        for axis, v in zip(self.axes, value.unbind(), strict=True):
            parts[axis] = v
        return {"velocities": [torch.stack(parts)]}


def unknown(parameter: Parameter, scene: Scene, target: Target) -> Unknown:
    """The unknown of that name which `target` can tell about.

    Raises:
        SceneError: if releases differ in what is not looked for.
    """
    if parameter == "friction":
        return FrictionAngle()
    across = () if isinstance(target, Runout) else range(2, scene.dim)
    axes = [0, *across]
    others = {tuple(v for a, v in enumerate(r.velocity) if a not in axes) for r in scene.releases}
    if len(others) > 1:
        raise SceneError(
            f"the releases of {scene.name!r} differ in a velocity that is not looked for: "
            f"{sorted(others)} m/s"
        )
    return ReleaseVelocity(axes)

"""The derivative of a whole rollout in the layout, by autograd and by central differences."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from gns_model.errors import SimulatorError
from gns_model.learned.adjoint import ADJOINT_LIMIT, ADJOINT_SMOOTHING
from gns_model.scene import Scene
from gns_model.smooth_measures import TEMPERATURE, smooth_measures


@dataclass(frozen=True)
class GradientCheck:
    """Derivative of a smooth measure in the baffle centres, two ways, shape (B, D-1) each.

    `cosine` is that between the two, 1 where they agree in direction; `ratio` is the norm of the
    automatic over that of the central differences.
    """

    measure: str
    step: float
    value: float
    autograd: np.ndarray
    differences: np.ndarray
    seconds: float

    @property
    def cosine(self) -> float:
        norms = np.linalg.norm(self.autograd) * np.linalg.norm(self.differences)
        # A rollout that diverged has a norm of NaN, which agrees with nothing either.
        return float((self.autograd * self.differences).sum() / norms) if norms > 0 else 0.0

    @property
    def ratio(self) -> float:
        norm = np.linalg.norm(self.differences)
        return float(np.linalg.norm(self.autograd) / norm) if norm else math.inf


def gradient_check(
    simulator: Any,
    scene: Scene,
    *,
    measure: str = "centroid_travel",
    step: float = 0.01,
    frames: int | None = None,
    temperature: float = TEMPERATURE,
    dtype: torch.dtype | None = None,
    limit: float | None = ADJOINT_LIMIT,
    smoothing: float = ADJOINT_SMOOTHING,
) -> GradientCheck:
    """Autograd through a whole rollout against central differences in every baffle coordinate.

    Args:
        simulator: a learned simulator, with `rollout_tensor`.
        scene: with at least one baffle, each `step` away from anything it must not touch.
        measure: an entry of `smooth_measures`.
        step: of the central differences [m]. Far below 1 cm they see the round-off of a chaotic
            flow rather than its trend.
        frames: frames to roll out, the start included; default: the whole duration.
        temperature: of the smooth measures [m].
        dtype: of the centres; default: that of the simulator.
        limit, smoothing: of the adjoints, as the gradient search has them; None and 0: the exact
            gradient.

    Raises:
        SimulatorError: if the simulator is not differentiable or the scene has no baffle.
        SceneError: if a baffle cannot move by `step`.
    """
    if not hasattr(simulator, "rollout_tensor"):
        raise SimulatorError(f"{simulator.name!r} is not differentiable: give a learned simulator")
    if not scene.baffles:
        raise SimulatorError(f"scene {scene.name!r} has no baffle to differentiate by")
    began = time.perf_counter()
    device = getattr(simulator, "device", "cpu")
    dtype = dtype or getattr(simulator, "dtype", torch.float32)
    start = np.array([b.center for b in scene.baffles])
    sizes = torch.tensor([b.size for b in scene.baffles], dtype=dtype, device=device)
    centres = torch.tensor(start, dtype=dtype, device=device, requires_grad=True)
    positions = simulator.rollout_tensor(
        [scene], [centres], frames=frames, limit=limit, smoothing=smoothing
    )[0]
    form: dict[str, Any] = {"sizes": sizes, "temperature": temperature}
    if scene.is_turned:
        form["yaws"] = torch.tensor([b.yaw for b in scene.baffles], dtype=dtype, device=device)
    value = smooth_measures(positions, scene, centres, **form)[measure]
    (gradient,) = torch.autograd.grad(value, centres)

    shifted = []
    for index in np.ndindex(*start.shape):
        for sign in (1.0, -1.0):
            moved = start.copy()
            moved[index] += sign * step
            shifted.append(moved)
    # Scenes are built first: a layout that cannot be is refused before any rollout is paid for.
    scenes = [moved_baffles(scene, moved) for moved in shifted]
    values = []
    with torch.no_grad():
        for moved, there in zip(shifted, scenes, strict=True):
            at = torch.tensor(moved, dtype=dtype, device=device)
            positions = simulator.rollout_tensor([there], [at], frames=frames)[0]
            values.append(float(smooth_measures(positions, there, at, **form)[measure]))
    ahead, behind = np.array(values).reshape(-1, 2).T
    return GradientCheck(
        measure=measure,
        step=step,
        value=float(value.detach()),
        autograd=gradient.cpu().numpy().astype(float),
        differences=((ahead - behind) / (2 * step)).reshape(start.shape),
        seconds=time.perf_counter() - began,
    )


def moved_baffles(scene: Scene, centres: np.ndarray) -> Scene:
    """The scene with its own baffles, each with size and yaw, at `centres` [m], shape (B, D-1).

    Raises:
        SceneError: if one of them leaves the domain or overlaps something.
    """
    baffles = tuple(
        {"center": tuple(map(float, c)), "size": b.size, "yaw": b.yaw}
        for c, b in zip(centres, scene.baffles, strict=True)
    )
    return scene.replace(baffles=baffles)

"""When a rollout has failed: non-finite, absurdly fast or far away. Failure is data, not an end."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gns_model.learned.world import World
from gns_model.scene import Scene

#: A grain this many times faster than release and fall could make it has diverged.
SPEED_MARGIN = 4.0


def speed_limit(scene: Scene) -> float:
    """A speed [m/s] that no grain of `scene` can have, by a wide margin.

    Release speed plus that of a fall through the whole diagonal of the domain, times a margin.
    """
    fall = math.sqrt(2 * math.hypot(*scene.gravity) * math.hypot(*scene.domain.size))
    return SPEED_MARGIN * (max(math.hypot(*r.velocity) for r in scene.releases) + fall)


def astray(now: Tensor, after: Tensor, world: World, longest: Tensor) -> set[int]:
    """Indices of the scenes of the batch in which some point went astray in this step.

    Args:
        now, after: positions before and after the step [m], shape (N, D).
        longest: step that no point can make [m], shape (S,).
    """
    size = world.point_upper - world.point_lower
    step = (after - now).square().sum(1).sqrt()
    # Written so that NaN, which compares false, counts as astray.
    sane = (step <= longest[world.batch]) & (
        (after >= world.point_lower - size) & (after <= world.point_upper + size)
    ).all(1)
    if bool(sane.all()):
        return set()
    return set(torch.unique(world.batch[~sane]).tolist())

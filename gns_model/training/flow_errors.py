"""How far a rolled flow is from the truth, as one reads it: its mass, its depth, its crowding.

Each is a square, relative to what the flow does, and weighed by what it may be off. Grains may
trade places: everything is compared in order of size.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gns_model.learned.graph import radius_graph
from gns_model.scene import Scene
from gns_model.smooth_measures import smooth_depth_over_time
from gns_model.training.loss import FRONT

#: What an error may be of the mass and of its front (as shares of the front's way), of the centroid
#: (of its own), of a depth (of the peak) and of the crowding (of its mean): they weigh as the
#: inverse. What a layout is worth hangs on the centroid, which travels a third as far as the front;
#: and with the front at 0.05 both `baffle-lite` and `column-2d` gave 4 % of it away for that.
BODY_AIM, FRONT_AIM, CENTROID_AIM, DEPTH_AIM, CROWDING_AIM = 0.05, 0.025, 0.02, 0.08, 0.2
#: Crowding is looked at in every so many-th frame and the last: each look takes a radius graph.
CROWDING_EVERY = 8


def mass_error(found: Tensor, true: Tensor, begun: Tensor, spacing: float) -> Tensor:
    """How far the mass is from its place in every frame, squared and relative, shape (K,).

        sum over axes of mean_i (x_(i) - x'_(i))² / s²  +  (w_f · mean of the front's x error / s)²
        + (w_c · centroid's x error / s_c)²,

    w = BODY_AIM / their AIM; x_(i) the i-th smallest coordinate; s the way that the true front
    makes, or the mass where that is more; s_c that of the centroid, of a heap that spreads to both
    sides a third of s.

    Args:
        found, true: positions after every step [m], shape (N, K, D).
        begun: positions before the first [m], shape (N, D).
        spacing: of the points [m]; no way counts as less than two of it.
    """
    count = max(1, int(FRONT * len(true)))
    ordered, wanted, begun = (p.sort(0).values for p in (found, true, begun))

    def front(positions: Tensor) -> Tensor:
        return positions[-count:, ..., 0].mean(0)

    def centroid(positions: Tensor) -> Tensor:
        return positions[..., 0].mean(0)

    travel = (wanted[:, -1] - begun).square().sum(1).mean().sqrt()
    way = torch.maximum((front(wanted)[-1] - front(begun)).abs(), travel).clamp_min(2 * spacing)
    mean_way = torch.maximum((centroid(wanted)[-1] - centroid(begun)).abs(), way / 3)
    body = (ordered - wanted).square().mean(0).sum(-1)
    lag = BODY_AIM / FRONT_AIM * (front(ordered) - front(wanted)) / way
    shift = BODY_AIM / CENTROID_AIM * (centroid(ordered) - centroid(wanted)) / mean_way
    return body / way**2 + lag.square() + shift.square()


def depth_error(found: Tensor, true: Tensor, scene: Scene, spacing: float) -> Tensor:
    """Mean over the baffles of the square of the depth's error upstream of each, shape (K,).

    As a share of the largest true depth over baffles and frames, times BODY_AIM / DEPTH_AIM. In
    every frame: of the peak alone, a heap that never slumps again has as good a loss.

    Args:
        found, true: positions after every step [m], shape (N, K, 3).
        scene: its baffles, at least one, and its releases.
        spacing: of the points [m]; no depth counts as less than two of it.
    """
    device = found.device
    centres = torch.tensor([b.center for b in scene.baffles], device=device)
    sizes = torch.tensor([b.size for b in scene.baffles], device=device)
    yaws = torch.tensor([b.yaw for b in scene.baffles], device=device)
    volume = sum(float(np.prod(r.size)) for r in scene.releases) / len(true)
    own, other = (
        smooth_depth_over_time(p.transpose(0, 1), scene, centres, sizes, volume, yaws=yaws)
        for p in (found, true)
    )
    share = (own - other) / other.max().clamp_min(2 * spacing)
    return (BODY_AIM / DEPTH_AIM * share).square().mean(1)


def crowding_error(found: Tensor, true: Tensor, radius: float) -> Tensor:
    """Square of the error of how crowded the grains are, a mean over grains and frames, scalar.

    n_i = sum_j (1 - |x_i - x_j| / R)² over the neighbours of grain i within R; n_(i), sorted, is
    compared as a share of the true mean, times BODY_AIM / CROWDING_AIM. A heap whose grains sink
    into each other can have the right coordinates, and more edges with every step.

    Args:
        found, true: positions after every step [m], shape (N, K, D).
        radius: R [m].
    """
    last = true.shape[1] - 1
    frames = [*range(CROWDING_EVERY - 1, last, CROWDING_EVERY), last]
    squares = []
    for k in frames:
        own, other = (_crowding(p[:, k], radius).sort().values for p in (found, true))
        least = (1 - 1 / 2) ** 2  # of a grain with one neighbour, half a radius away
        squares.append(((own - other) / other.mean().clamp_min(least)).square().mean())
    return (BODY_AIM / CROWDING_AIM) ** 2 * torch.stack(squares).mean()


def _crowding(positions: Tensor, radius: float) -> Tensor:
    """n_i of `crowding_error` for positions (N, D), shape (N,)."""
    senders, receivers = radius_graph(positions.detach(), radius)
    square = (positions[senders] - positions[receivers]).square().sum(1)
    near = 1 - square.clamp_min((1e-6 * radius) ** 2).sqrt() / radius
    return positions.new_zeros(len(positions)).index_add(0, receivers, near.square())

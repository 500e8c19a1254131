"""Smooth measures: differentiable twins of `measures`, to steer a search and never to report.

Every step function of the hard definition becomes a sigmoid and every maximum a soft one, of a
width that `temperature` [m] sets; as it goes to 0 they turn into the hard measures. The gradient
reaches a baffle in two ways: through the positions, where a rollout is differentiable in the
layout, and through the window upstream of the baffle, which moves with it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from gns_model import measures
from gns_model.particles import MOVING
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory

#: Default temperature [m]: about the distance that a search moves a baffle in one step.
TEMPERATURE = 0.01

# Widths as multiples of the temperature. A quantile needs less blur than the edge of a window that
# grains cross one by one; a section is crossed by few points at the end, so it needs more.
_EDGE, _QUANTILE, _MAXIMUM, _SECTION, _GATE = 1.0, 0.5, 0.5, 2.0, 0.2

#: Weight, in points, of a phantom point on the base in every window: an empty window stays finite.
_PHANTOM = 1e-3


def smooth_measures(
    positions: Tensor,
    scene: Scene,
    centres: Tensor,
    sizes: Sequence[float] | Tensor,
    *,
    yaws: float | Tensor = 0.0,
    temperature: float = TEMPERATURE,
    point_volume: float | None = None,
) -> dict[str, Tensor]:
    """Centroid travel, p99 runout, mass past the section and upstream depth, smooth.

    Args:
        positions: moving points over time [m], shape (T, N, D).
        scene: domain and control section; its own baffles are not looked at.
        centres: plan centres of the baffles [m], shape (B, D-1), (x, z) in 3D.
        sizes: of the baffles [m], shape (D,) for all or (B, D).
        yaws: of the baffles [degrees], one for all or shape (B,).
        temperature: blur [m], positive.
        point_volume: of one point [m^D]; default: volume of the releases over N.

    Returns:
        scalars under the names that `measures.summary` uses. With no baffles the upstream depth is
        the hard depth of the free flow, a constant: there is nothing to move.
    """
    if point_volume is None:
        point_volume = sum(float(np.prod(r.size)) for r in scene.releases) / positions.shape[1]
    first, last = positions[0, :, 0], positions[-1, :, 0]
    quantile = measures.FRONT_QUANTILE
    width = _QUANTILE * temperature
    return {
        "centroid_travel": smooth_centroid_travel(positions),
        "runout_p99": smooth_quantile(last, quantile, width)
        - smooth_quantile(first, quantile, width),
        "mass_past_section": torch.sigmoid(
            (last - scene.control_section) / (_SECTION * temperature)
        ).mean(),
        "upstream_depth": smooth_upstream_depth(
            positions,
            scene,
            centres,
            sizes,
            point_volume,
            yaws=yaws,
            temperature=temperature,
        ),
    }


def smooth_centroid_travel(positions: Tensor) -> Tensor:
    """Mean x of the last frame minus that of the first [m]; positions (T, N, D). Exact."""
    return (positions[-1, :, 0] - positions[0, :, 0]).mean()


def smooth_upstream_depth(
    positions: Tensor,
    scene: Scene,
    centres: Tensor,
    sizes: Sequence[float] | Tensor,
    point_volume: float,
    *,
    yaws: float | Tensor = 0.0,
    temperature: float = TEMPERATURE,
) -> Tensor:
    """Soft maximum over frames and baffles of `smooth_depth_over_time` [m], a scalar.

    With no baffles it is the hard depth of the free flow, a constant.
    """
    if len(centres) == 0:
        return _free_depth(positions, scene, point_volume)
    depth = smooth_depth_over_time(
        positions, scene, centres, sizes, point_volume, yaws=yaws, temperature=temperature
    )
    return smooth_maximum(depth.flatten(), _MAXIMUM * temperature)


def smooth_depth_over_time(
    positions: Tensor,
    scene: Scene,
    centres: Tensor,
    sizes: Sequence[float] | Tensor,
    point_volume: float,
    *,
    yaws: float | Tensor = 0.0,
    temperature: float = TEMPERATURE,
) -> Tensor:
    """Depth just upstream of every baffle in every frame [m], shape (T, B).

    The window of `measures.upstream_depth_over_time` gets sigmoid edges, its quantile becomes a
    soft one, and its least filling a sigmoid gate. See `smooth_measures` for the arguments.
    """
    # Frame by frame and baffle by baffle, (T, B, N): 1.1 million numbers for a coarse flume.
    weight = window_weights(positions, centres, sizes, _EDGE * temperature, yaws=yaws)
    size = torch.as_tensor(sizes, dtype=positions.dtype, device=positions.device)
    size = size.expand(len(centres), positions.shape[2])
    turn = _turn(yaws, centres, positions)
    across = size[:, 2:].prod(dim=1) if turn is None else 2 * _half_across(size, turn)
    area = measures.WINDOW_LENGTH * across
    mean_depth = weight.sum(dim=-1) * point_volume / area
    gate = torch.sigmoid((mean_depth - measures.LEAST_DEPTH) / (_GATE * temperature))
    half = measures.half_spacing(point_volume, scene.dim)
    height = (positions[:, None, :, 1] - scene.base + half).expand_as(weight)
    # The phantom keeps the quantile of an empty window defined: it lies on the base.
    height = torch.cat([height, torch.zeros_like(height[..., :1])], dim=-1)
    weight = torch.cat([weight, torch.full_like(weight[..., :1], _PHANTOM)], dim=-1)
    return gate * smooth_quantile(
        height, measures.DEPTH_QUANTILE, _QUANTILE * temperature, weights=weight
    )


def smooth_overtopping(
    positions: Tensor,
    scene: Scene,
    centres: Tensor,
    size: Tensor,
    yaw: float | Tensor = 0.0,
    *,
    temperature: float = TEMPERATURE,
) -> Tensor:
    """Share of the points that went over the top of a baffle in some frame, smooth [-].

    Every face of the column of air over a baffle becomes a sigmoid; of a point the frame and the
    baffle count where it is deepest in such a column.

    Args:
        positions: moving points over time [m], shape (T, N, D).
        scene: its base; its own baffles are not looked at.
        centres: plan centres of the baffles [m], shape (B, D-1).
        size: of the baffles [m], shape (D,); yaw: of all [degrees].
        temperature: blur [m], positive.
    """
    if len(centres) == 0:
        return positions.new_zeros(())
    edge = _EDGE * temperature
    plan = positions[..., [0, *range(2, scene.dim)]][:, None] - centres[:, None]
    if scene.dim == 3:
        turn = torch.deg2rad(torch.as_tensor(yaw).to(positions))
        cosine, sine = torch.cos(turn), torch.sin(turn)
        x, z = plan.unbind(-1)
        plan = torch.stack([x * cosine + z * sine, z * cosine - x * sine], dim=-1)
    half = size[[0, *range(2, scene.dim)]] / 2
    over = torch.sigmoid((positions[:, None, :, 1] - scene.base - size[1]) / edge)
    inside = torch.sigmoid((half - plan.abs()) / edge).prod(dim=-1)
    return (over * inside).amax(dim=(0, 1)).mean()


def window_weights(
    positions: Tensor,
    centres: Tensor,
    sizes: Sequence[float] | Tensor,
    edge: float,
    *,
    yaws: float | Tensor = 0.0,
) -> Tensor:
    """How much every point is in the window upstream of every baffle, 0 to 1, shape (T, B, N).

    Args:
        positions: [m], shape (T, N, D).
        centres: [m], shape (B, D-1).
        sizes: [m], shape (D,) or (B, D).
        edge: width of the sigmoid edges [m].
        yaws: [degrees], one for all or shape (B,).
    """
    size = torch.as_tensor(sizes, dtype=positions.dtype, device=positions.device)
    size = size.expand(len(centres), positions.shape[2])
    turn = _turn(yaws, centres, positions)
    x = positions[:, None, :, 0]
    if turn is None:
        face = (centres[:, 0] - size[:, 0] / 2)[:, None]
    else:
        across = positions[:, None, :, 2] - centres[:, 1, None]
        face = centres[:, 0, None] + _upstream_side(across, size, turn, 2 * edge)
    weight = torch.sigmoid((x - face + measures.WINDOW_LENGTH) / edge) * torch.sigmoid(
        (face - x) / edge
    )
    for axis in range(2, positions.shape[2]):
        offset = positions[:, None, :, axis] - centres[:, axis - 1, None]
        half = size[:, axis, None] / 2 if turn is None else _half_across(size, turn)[:, None]
        weight = weight * torch.sigmoid((half - offset) / edge)
        weight = weight * torch.sigmoid((half + offset) / edge)
    return weight


def _turn(yaws: float | Tensor, centres: Tensor, positions: Tensor) -> tuple[Tensor, Tensor] | None:
    """Cosine and sine of the yaws, shape (B,) each; None if it is a plain 0."""
    if isinstance(yaws, (int, float)) and yaws == 0:
        return None
    angle = torch.deg2rad(torch.as_tensor(yaws, dtype=positions.dtype, device=positions.device))
    angle = angle.expand(len(centres))
    return angle.cos(), angle.sin()


def _half_across(size: Tensor, turn: tuple[Tensor, Tensor]) -> Tensor:
    """Half the extent along z of turned baffles of sizes (B, 3) [m], shape (B,)."""
    cosine, sine = turn
    return (size[:, 0] * sine.abs() + size[:, 2] * cosine.abs()) / 2


def _upstream_side(
    across: Tensor, size: Tensor, turn: tuple[Tensor, Tensor], margin: float
) -> Tensor:
    """`footprint.upstream_side` about the centres, for offsets along z (T, B, N) [m].

    A point nearer to the end of the baffle than `margin`, or past it, is given the side at that
    distance from it. So the window of a baffle that is turned a little is that of one that is not
    turned, moved a little: the end face, by then as steep as the flow is straight, has no part.
    """
    cosine, sine = (part[:, None] for part in turn)
    reach = (_half_across(size, turn)[:, None] - margin).clamp(min=0)
    across = torch.maximum(torch.minimum(across, reach), -reach)
    a, b = size[:, 0, None] / 2, size[:, 2, None] / 2
    tiny = 1e-9  # a side along the flow is infinitely far upstream, where the maximum drops it
    one = -(a + sine * cosine.sign() * across) / cosine.abs().clamp(min=tiny)
    other = -(b - cosine * sine.sign() * across) / sine.abs().clamp(min=tiny)
    return torch.maximum(one, other)


def smooth_quantile(
    values: Tensor, q: float, width: float, *, weights: Tensor | None = None
) -> Tensor:
    """Quantile over the last axis of values blurred by a logistic kernel; shape (...).

    It is the root s of F(s) = sum_i w_i sigmoid((s - v_i) / width) / sum_i w_i - q, found by
    bisection without a gradient; one Newton step that autograd does see then gives the derivative
    of the implicit function, ds = -dF / F'(s), exact in values and weights.

    Args:
        values: shape (..., N).
        q: between 0 and 1, exclusive.
        width: of the kernel, in the unit of `values`.
        weights: shape (..., N), not negative, with a positive sum; default: all equal.
    """
    with torch.no_grad():
        # Beyond the values by what the tail of the kernel can shift the quantile.
        reach = width * (abs(float(np.log(q / (1 - q)))) + 1.0)
        low = values.amin(dim=-1, keepdim=True) - reach
        high = values.amax(dim=-1, keepdim=True) + reach
        for _ in range(30 if values.dtype == torch.float32 else 50):
            middle = (low + high) / 2
            below = torch.sigmoid((middle - values) / width)
            if weights is None:
                share = below.mean(dim=-1, keepdim=True)
            else:
                share = (weights * below).sum(dim=-1, keepdim=True) / weights.sum(
                    dim=-1, keepdim=True
                )
            low = torch.where(share < q, middle, low)
            high = torch.where(share < q, high, middle)
        root = (low + high) / 2
    below = torch.sigmoid((root - values) / width)
    if weights is None:
        excess = below.mean(dim=-1) - q
        slope = (below * (1 - below)).mean(dim=-1) / width
    else:
        excess = (weights * below).sum(dim=-1) / weights.sum(dim=-1) - q
        slope = (weights * below * (1 - below)).sum(dim=-1) / weights.sum(dim=-1) / width
    # Between two clusters many widths apart the blurred CDF is flat and the quantile undefined up
    # to the gap: the floor keeps the step finite there.
    slope = slope.detach().clamp_min(torch.finfo(values.dtype).eps / width)
    return root.squeeze(-1) - excess / slope


def smooth_maximum(values: Tensor, width: float) -> Tensor:
    """Mean of `values` (N,) weighted by softmax(values / width): below the maximum, never above."""
    return (torch.softmax(values / width, dim=0) * values).sum()


def _free_depth(positions: Tensor, scene: Scene, point_volume: float) -> Tensor:
    frames = positions.detach().cpu().numpy()
    trajectory = Trajectory(
        positions=frames,
        time=np.arange(len(frames), dtype=float),
        particle_type=np.full(frames.shape[1], MOVING, dtype=np.int8),
        scene=scene.with_baffles([]),
        point_volume=point_volume,
    )
    depth = measures.upstream_depth_over_time(trajectory).max(initial=0.0)
    return positions.new_tensor(depth)

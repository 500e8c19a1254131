"""What the network sees: of every point and of every edge. Nothing depends on where the origin is.

Everything geometric fades to zero, with its slope, at the end of its range, so that a rollout is
a smooth function of the positions and of the poses of the baffles (except in the paper's own
settings, which clip).
"""

from __future__ import annotations

import torch
from torch import Tensor


def fade(distance: Tensor, reach: float) -> Tensor:
    """(1 - d / reach)², zero beyond `reach` [m] and grown on for d < 0: C1 everywhere."""
    return (1 - distance / reach).clamp(min=0).square()


def envelope(relative_distance: Tensor) -> Tensor:
    """(1 - x⁶)² for x = distance / radius in [0, 1]: flat at 0, zero with its slope at 1.

    The sixth power keeps the nearest shell of a lattice at full weight: 0.88 at x = 0.625.
    """
    return (1 - relative_distance.clamp(max=1) ** 6).square()


def wall_features(
    positions: Tensor, lower: Tensor, upper: Tensor, reach: float, *, clip: float | None = None
) -> Tensor:
    """Nearness to the faces of the domain, first the lower ones, shape (N, 2D).

    Args:
        positions, lower, upper: [m], shape (N, D).
        reach: range [m].
        clip: the paper's distance / reach clipped to [-clip, clip] instead of a value that fades.
    """
    distance = torch.cat([positions - lower, upper - positions], dim=1)
    if clip is not None:
        return (distance / reach).clamp(-clip, clip)
    return fade(distance, reach)


def into_frames(positions: Tensor, frames: Tensor) -> Tensor:
    """Positions as they are seen from boxes turned about the vertical, shape (..., 3) [m].

    Args:
        positions: [m], shape (..., 3).
        frames: middle (x, z) [m], cosine and sine of the yaw, shape (..., 4).
    """
    x, z, cosine, sine = frames.unbind(-1)
    dx, dz = positions[..., 0] - x, positions[..., 2] - z
    y = positions[..., 1].expand_as(x)
    return torch.stack([x + (cosine * dx + sine * dz), y, z + (cosine * dz - sine * dx)], dim=-1)


def out_of_frames(positions: Tensor, frames: Tensor) -> Tensor:
    """The inverse of `into_frames`."""
    x, z, cosine, sine = frames.unbind(-1)
    return into_frames(positions, torch.stack([x, z, cosine, -sine], dim=-1))


def signed_distance(
    positions: Tensor, boxes: Tensor, frames: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Distance to boxes, negative inside, and its gradient, the outward normal.

    Args:
        positions: [m], shape (N, D).
        boxes: corners [m], shape (N, M, 2, D).
        frames: in which the boxes lie along the axes, see `into_frames`, shape (N, M, 4); None:
            they lie along the axes as it is.

    Returns:
        distance [m], shape (N, M), and unit normal, shape (N, M, D). On a face the normal is the
        face's, and beyond an edge or a corner it points away from the nearest point.
    """
    seen = positions[:, None]
    if frames is not None:
        seen = into_frames(seen, frames)
    below = boxes[:, :, 0] - seen
    above = seen - boxes[:, :, 1]
    beyond = torch.maximum(below, above)
    sign = torch.where(above > below, 1.0, -1.0).to(positions.dtype)
    excess = beyond.clamp(min=0)
    squared = excess.square().sum(-1)
    outside = squared > 0
    # The inner `where` keeps the square root away from zero, whose derivative is infinite.
    distance = squared.where(outside, torch.ones_like(squared)).sqrt()
    inner, axis = beyond.max(-1)
    face = torch.nn.functional.one_hot(axis, positions.shape[1]).to(positions.dtype)
    normal = sign * torch.where(outside[..., None], excess / distance[..., None], face)
    if frames is not None:
        along, up, across = normal.unbind(-1)
        cosine, sine = frames[..., 2], frames[..., 3]
        normal = torch.stack(
            [cosine * along - sine * across, up, sine * along + cosine * across], -1
        )
    return torch.where(outside, distance, inner), normal


def baffle_features(
    positions: Tensor, velocity: Tensor, boxes: Tensor, reach: float, frames: Tensor | None = None
) -> Tensor:
    """Sum over the boxes of w(d) · (1, normal, velocity · normal), shape (N, D + 2).

    Args:
        positions: [m], shape (N, D).
        velocity: shape (N, D), in any unit in which 1 is usual.
        boxes: shape (N, M, 2, D).
        reach: where w vanishes [m].
        frames: of the boxes, see `signed_distance`.
    """
    if boxes.shape[1] == 0:
        return positions.new_zeros((len(positions), positions.shape[1] + 2))
    distance, normal = signed_distance(positions, boxes, frames)
    weight = fade(distance, reach)[..., None]
    approach = (normal * velocity[:, None]).sum(-1, keepdim=True)
    return (weight * torch.cat([torch.ones_like(weight), normal, approach], dim=-1)).sum(1)


def edge_features(
    positions: Tensor,
    velocity: Tensor | None,
    senders: Tensor,
    receivers: Tensor,
    radius: float,
) -> tuple[Tensor, Tensor]:
    """Displacement p_i - p_j and its norm over the radius, then v_i - v_j; i receives, j sends.

    Args:
        positions: [m], shape (N, D).
        velocity: normalised, shape (N, D), or None to leave it out.
        senders, receivers: shape (E,).
        radius: [m].

    Returns:
        features, shape (E, D + 1) or (E, 2D + 1), and norm / radius, shape (E, 1).
    """
    displacement = (positions[receivers] - positions[senders]) / radius
    # The tiny term keeps the derivative finite for points that coincide.
    norm = (displacement.square().sum(1, keepdim=True) + 1e-12).sqrt()
    parts = [displacement, norm]
    if velocity is not None:
        parts.append(velocity[receivers] - velocity[senders])
    return torch.cat(parts, dim=1), norm

"""What the network sees: of every point and of every edge. Nothing depends on where the origin is.

Everything geometric fades to zero, with its slope, at the end of its range, so that a rollout is
a smooth function of the positions and of the poses of the baffles (except in the paper's own
settings, which clip).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gns_model.learned.graph import radius_graph

#: Overburden and flow depth are given in this unit [m], of which a bench-scale flow has a few.
DEPTH_UNIT = 0.1


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


def depth_features(
    positions: Tensor, moving: Tensor, batch: Tensor, reach: float, spacing: float
) -> Tensor:
    """Overburden, flow depth and its slope along the base at every point, shape (N, D + 1).

    With material of depth h(x), h = spacing^D / A · Σ_j W(|x_j - x| / reach), where x is the place
    on the base, W(q) = (1 - q²)³ fades with two derivatives and A is its integral: the height of
    the mass that stands on a spot. The overburden counts what lies above the point alone, over a
    soft step of half a spacing. Both are in DEPTH_UNIT; the slope, ∂h/∂x, is a pure number. What
    drives a granular flow is in depth-averaged theory g ∂h/∂x (Savage & Hutter 1989), and its
    friction is that of the overburden; messages would have to carry both through the whole depth.

    Args:
        positions: [m], shape (N, D); axis 1 is height.
        moving: mask of the points that have weight, shape (N,).
        batch: scene of every point, shape (N,).
        reach: of W along the base [m].
        spacing: of the points [m].
    """
    dim = positions.shape[1]
    plan = positions[:, ::2] if dim == 3 else positions[:, :1]
    flat = torch.cat([plan, torch.zeros_like(plan)], dim=1)[:, :2]
    senders, receivers = radius_graph(flat.detach(), reach, batch, self_edges=True)
    carried = moving[senders].to(positions.dtype)
    offset = (plan[receivers] - plan[senders]) / reach
    inside = 1 - offset.square().sum(1)
    # ∫ (1 - q²)³ over the line is 32/35 of the reach, over the disc π/4 of its square.
    area = 32 / 35 * reach if dim == 2 else math.pi / 4 * reach**2
    weight = spacing**dim / area * carried * inside**3
    above = torch.sigmoid((positions[senders, 1] - positions[receivers, 1]) * (4 / spacing))
    steep = (-6 / reach) * (spacing**dim / area * carried * inside**2)[:, None] * offset
    parts = torch.cat(
        [(weight * above / DEPTH_UNIT)[:, None], (weight / DEPTH_UNIT)[:, None], steep], dim=1
    )
    summed = positions.new_zeros((len(positions), dim + 1))
    return summed.index_add(0, receivers, parts)


def strain_features(
    positions: Tensor,
    velocity: Tensor,
    senders: Tensor,
    receivers: Tensor,
    radius: float,
    unit: float,
) -> Tensor:
    """Direction and size of the strain rate and of the velocity, shape (N, D (D + 1) / 2 + D + 1).

    The friction of grains does not depend on how fast they are sheared: the stress of a
    Mohr-Coulomb material, or of mu(I) for small I, is that of its pressure times D / |D|, however
    small the strain rate D, and the friction of the base that of v / |v|. In linear features the
    slow half of a heap, which decides where it stops, is a hair's breadth of all inputs. Here,
    with the velocity gradient by least squares over the neighbours, weighed by (1 - (r / R)²)²,

        D / sqrt(D:D + unit²),   log(1 + D:D / unit²) / 2,   v / sqrt(v² + (unit R)²).

    Args:
        positions: [m], shape (N, D).
        velocity: [m/s], shape (N, D).
        senders, receivers: of all edges, shape (E,).
        radius: R [m].
        unit: rate below which a strain is none [1/s].
    """
    count, dim = positions.shape
    apart = (positions[senders] - positions[receivers]) / radius
    faster = velocity[senders] - velocity[receivers]
    near = (1 - apart.square().sum(1, keepdim=True)).clamp_min(0).square() * apart
    both = torch.cat([apart, faster / (unit * radius)], dim=1)
    products = (both[:, :, None] * near[:, None, :]).flatten(1)
    summed = positions.new_zeros((count, 2 * dim * dim)).index_add(0, receivers, products)
    spread, shear = summed.view(count, 2, dim, dim).unbind(1)
    # The small term holds where a grain has too few neighbours to tell; there D fades to zero.
    few = 0.02 * torch.eye(dim, dtype=positions.dtype, device=positions.device)
    # solve_ex: what has diverged shall end as a status, not in an exception of a library.
    gradient = torch.linalg.solve_ex(spread + few, shear, left=False).result
    rate = (gradient + gradient.transpose(1, 2)) / 2
    square = rate.square().sum((1, 2))[:, None]
    rows, columns = torch.triu_indices(dim, dim, device=positions.device)
    slip = velocity / (unit * radius)
    return torch.cat(
        [
            rate[:, rows, columns] / (square + 1).sqrt(),
            square.log1p() / 2,
            slip / (slip.square().sum(1, keepdim=True) + 1).sqrt(),
        ],
        dim=1,
    )


def edge_features(
    positions: Tensor,
    velocity: Tensor | None,
    senders: Tensor,
    receivers: Tensor,
    radius: float,
    least: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Displacement p_i - p_j and its norm over the radius, then v_i - v_j; i receives, j sends.

    Args:
        positions: [m], shape (N, D).
        velocity: normalised, shape (N, D), or None to leave it out.
        senders, receivers: shape (E,).
        radius: [m].
        least: add the direction of v_i - v_j, of which less than this (in the unit of `velocity`)
            fades; None: leave it out.

    Returns:
        features, shape (E, D + 1), (E, 2D + 1) or (E, 3D + 1), and norm / radius, shape (E, 1).
    """
    displacement = (positions[receivers] - positions[senders]) / radius
    # The tiny term keeps the derivative finite for points that coincide.
    norm = (displacement.square().sum(1, keepdim=True) + 1e-12).sqrt()
    parts = [displacement, norm]
    if velocity is not None:
        relative = velocity[receivers] - velocity[senders]
        parts.append(relative)
        if least is not None:
            parts.append(relative / (relative.square().sum(1, keepdim=True) + least**2).sqrt())
    return torch.cat(parts, dim=1), norm

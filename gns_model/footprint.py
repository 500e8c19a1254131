"""Footprints: the rectangles in plan, (x, z), on which baffles stand turned about the vertical.

A yaw of t degrees turns a footprint from x towards z: counter-clockwise in a plan drawn with x to
the right and z up, as all of ours are, and so clockwise for somebody who looks down from above
with x to the right, since z then points towards him. The corners of a footprint of size (a, b)
about (x, z) are, with (u, v) = (±a/2, ±b/2),

    (x + u cos t - v sin t,  z + u sin t + v cos t).

Everything here takes arrays of any leading shape and returns them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: Signs of u and v at the corners, in order around the footprint.
_AROUND = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def turn(yaw: float) -> tuple[float, float]:
    """Cosine and sine of a yaw [degrees], exact at quarter turns."""
    quarters = yaw / 90
    if quarters == round(quarters):
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[round(quarters) % 4]
    return math.cos(math.radians(yaw)), math.sin(math.radians(yaw))


def wrap(yaw: float) -> float:
    """The same footprint's yaw in (-90, 90] [degrees]: half a turn changes nothing."""
    return yaw if -90 < yaw <= 90 else 90.0 - (90.0 - yaw) % 180.0


def corners(center: ArrayLike, size: ArrayLike, yaw: ArrayLike = 0.0) -> Array:
    """Corners in order around the footprint [m], shape (..., 4, 2).

    Args:
        center: (x, z) [m], shape (..., 2).
        size: plan size (a, b) [m], shape (..., 2).
        yaw: [degrees], shape (...).
    """
    u, v = np.moveaxis(np.asarray(size, float)[..., None, :] / 2 * _AROUND, -1, 0)
    cosine, sine = _turns(np.asarray(yaw, float)[..., None])
    offset = np.stack([u * cosine - v * sine, u * sine + v * cosine], axis=-1)
    return np.asarray(center, float)[..., None, :] + offset


def bounding_size(size: ArrayLike, yaw: ArrayLike = 0.0) -> Array:
    """Extent along x and z of turned footprints of plan size (a, b) [m], shape (..., 2)."""
    a, b = np.moveaxis(np.asarray(size, float), -1, 0)
    cosine, sine = np.abs(_turns(np.asarray(yaw, float)))
    return np.stack([a * cosine + b * sine, a * sine + b * cosine], axis=-1)


def upstream_side(z: ArrayLike, center: ArrayLike, size: ArrayLike, yaw: float) -> Array:
    """x at which a line along x meets a footprint first, coming from upstream [m], shape of `z`.

    Of the two sides that face upstream the one that lies farther downstream, since the footprint
    is convex. Meaningless where `z` [m] passes the footprint, and for quarter turns.
    """
    (a, b), (cosine, sine) = np.asarray(size, float) / 2, turn(yaw)
    across = np.asarray(z, float) - np.asarray(center, float)[1]
    one = -(a + sine * across) / cosine
    other = -(b - math.copysign(cosine, sine) * across) / abs(sine)
    return np.asarray(center, float)[0] + np.maximum(one, other)


def separation(one: ArrayLike, other: ArrayLike) -> Array:
    """Signed distance of footprints given by their corners, (..., 4, 2) each [m], shape (...).

    Where they are apart it is their distance. Where they overlap it is minus the least way by
    which moving one of them would part them: of the gaps along the four normals of their sides the
    largest (the theorem of separating axes).
    """
    first, second = np.broadcast_arrays(np.asarray(one, float), np.asarray(other, float))
    gaps = []
    for owner in (first, second):
        for k in (0, 1):
            side = owner[..., k + 1, :] - owner[..., k, :]
            normal = np.stack([-side[..., 1], side[..., 0]], -1)
            normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
            a = (first * normal[..., None, :]).sum(-1)
            b = (second * normal[..., None, :]).sum(-1)
            gaps += [b.min(-1) - a.max(-1), a.min(-1) - b.max(-1)]
    gap = np.max(gaps, axis=0)
    apart = np.minimum(_corner_to_sides(first, second), _corner_to_sides(second, first))
    return np.where(gap > 0, apart, gap)


def _corner_to_sides(points: Array, rectangle: Array) -> Array:
    """Least distance from any of four points to the sides of a rectangle [m], shape (...)."""
    begin = rectangle[..., None, :, :]
    along = np.roll(rectangle, -1, axis=-2)[..., None, :, :] - begin
    offset = points[..., :, None, :] - begin
    share = np.clip((offset * along).sum(-1) / (along**2).sum(-1), 0, 1)
    distance = np.linalg.norm(offset - share[..., None] * along, axis=-1)
    return distance.min(axis=(-1, -2))


def _turns(yaw: Array) -> tuple[Array, Array]:
    pairs = np.array([turn(float(y)) for y in yaw.ravel()]).reshape(*yaw.shape, 2)
    return pairs[..., 0], pairs[..., 1]

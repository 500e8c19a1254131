"""Polygons in plan, (x, z): zones that no footprint may touch, of any outline.

A simple polygon is cut at the x of each of its corners into trapezoids (some are triangles), which
are convex: whether a footprint touches it is then exact, by the theorem of separating axes. For
whoever needs rectangles along the axes, `strips` covers the polygon by some, not much larger.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: Sides and areas below this are none [m, m²].
NOTHING = 1e-9


def fault(corners: ArrayLike) -> str | None:
    """What keeps `corners` [m], (k, 2), from being a simple polygon; None if nothing does."""
    points = np.asarray(corners, dtype=float)
    if len(points) < 3:
        return f"a polygon needs three corners at least, got {len(points)}"
    following = np.roll(points, -1, axis=0)
    if (np.linalg.norm(following - points, axis=1) < NOTHING).any():
        return "two corners that follow each other are one point"
    sides = list(zip(points, following, strict=True))
    for i, (a, b) in enumerate(sides):
        for j in range(i + 2, len(sides) - (i == 0)):
            if _cross(a, b, *sides[j]):
                return f"its sides {i} and {j} cross"
    if abs(area(points)) < NOTHING:
        return "it has no area"
    return None


def area(corners: ArrayLike) -> float:
    """Signed area of a polygon (k, 2) [m²], positive if it runs counter-clockwise."""
    x, z = np.asarray(corners, dtype=float).T
    return float((x * np.roll(z, -1) - np.roll(x, -1) * z).sum() / 2)


def trapezoids(corners: ArrayLike) -> Array:
    """A simple polygon (k, 2) cut at the x of its corners, shape (T, 4, 2).

    The corners of each piece run around it; two of them coincide where it is a triangle.
    """
    points = np.asarray(corners, dtype=float)
    begin, end = points, np.roll(points, -1, axis=0)
    pieces = []
    for left, right in pairwise(np.unique(points[:, 0])):
        if right - left < NOTHING:
            continue
        across = (np.minimum(begin[:, 0], end[:, 0]) <= left + NOTHING) & (
            np.maximum(begin[:, 0], end[:, 0]) >= right - NOTHING
        )
        a, b = begin[across], end[across]
        slope = (b[:, 1] - a[:, 1]) / (b[:, 0] - a[:, 0])
        low, high = (a[:, 1] + slope * (x - a[:, 0]) for x in (left, right))
        order = np.argsort(low + high)
        # Going up, a line enters the polygon at one side and leaves it at the next.
        for below, above in zip(order[::2], order[1::2], strict=True):
            pieces.append(
                [(left, low[below]), (right, high[below]), (right, high[above]), (left, low[above])]
            )
    return np.array(pieces).reshape(-1, 4, 2)


def strips(corners: ArrayLike, tolerance: float) -> Array:
    """Rectangles along the axes that cover a polygon (k, 2), shape (S, 2, 2): lower, upper corner.

    None reaches farther than about `tolerance` [m] across beyond the polygon. A polygon whose sides
    are along the axes is covered exactly.
    """
    covering = []
    for a, b, c, d in trapezoids(corners):
        rise = max(abs(b[1] - a[1]), abs(c[1] - d[1]))
        count = max(1, int(np.ceil(rise / tolerance - NOTHING)))
        share = np.linspace(0.0, 1.0, count + 1)[:, None]
        low, high = a + share * (b - a), d + share * (c - d)
        for k in range(count):
            covering.append(
                [(low[k, 0], min(low[k : k + 2, 1])), (low[k + 1, 0], max(high[k : k + 2, 1]))]
            )
    return np.array(covering).reshape(-1, 2, 2)


def clearance(footprint: ArrayLike, corners: ArrayLike) -> float:
    """Distance of a convex footprint (m, 2) from a simple polygon (k, 2) [m].

    Negative where they overlap: then it says how deep a piece of the polygon is met.
    """
    outline = np.asarray(footprint, dtype=float)
    return min(_separation(outline, piece) for piece in trapezoids(corners))


def _separation(one: Array, other: Array) -> float:
    gaps = []
    for owner in (one, other):
        sides = np.roll(owner, -1, axis=0) - owner
        sides = sides[np.linalg.norm(sides, axis=1) > NOTHING]
        normals = np.column_stack([-sides[:, 1], sides[:, 0]])
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        a, b = one @ normals.T, other @ normals.T
        gaps += [b.min(0) - a.max(0), a.min(0) - b.max(0)]
    gap = float(np.max(np.concatenate(gaps)))
    if gap <= 0:
        return gap
    return min(_to_sides(one, other), _to_sides(other, one))


def _to_sides(points: Array, outline: Array) -> float:
    """Least distance from any of the points to the sides of an outline."""
    along = np.roll(outline, -1, axis=0) - outline
    offset = points[:, None] - outline
    length = np.maximum((along**2).sum(-1), NOTHING**2)
    share = np.clip((offset * along).sum(-1) / length, 0.0, 1.0)
    return float(np.linalg.norm(offset - share[..., None] * along, axis=-1).min())


def _cross(a: Array, b: Array, c: Array, d: Array) -> bool:
    """Whether the segments a-b and c-d have a point in common."""

    def turn(p: Array, q: Array, r: Array) -> float:
        value = (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])
        return 0.0 if abs(value) < NOTHING**1.5 else float(np.sign(value))

    def within(p: Array, q: Array, r: Array) -> bool:
        return bool((np.minimum(p, q) <= r).all() and (r <= np.maximum(p, q)).all())

    one, two, three, four = turn(a, b, c), turn(a, b, d), turn(c, d, a), turn(c, d, b)
    if one * two < 0 and three * four < 0:
        return True
    touching = ((one, a, b, c), (two, a, b, d), (three, c, d, a), (four, c, d, b))
    return any(side == 0 and within(p, q, r) for side, p, q, r in touching)

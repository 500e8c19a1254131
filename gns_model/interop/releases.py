"""What a foreign trajectory tells of its scene: where its mass began, and how far apart points are.

Foreign data have points and no scene. Measures and limits need one, so the moving points of the
first frame become boxes, one for each body that touches no other, with its mean velocity.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gns_model.interop.metadata import Metadata
from gns_model.scene import Box, Domain, Material, Release, Scene

if TYPE_CHECKING:
    from gns_model.interop.dataset import ForeignTrajectory

#: Points within this many spacings belong to one body.
TOUCH = 2.0

#: With more bodies than this it is spray; one box holds it all.
MOST_BODIES = 32

#: Spread of nearest distances (90th over 10th percentile) up to which points are on a lattice.
LATTICE = 1.1

#: Largest friction angle of a scene [degrees]: a material property may be something else.
STEEPEST = 89.0

#: Points that are asked for their neighbours, at most.
SAMPLE = 5000


def point_spacing(points: np.ndarray, radius: float) -> float | None:
    """Spacing [m] of a lattice as dense as `points`, shape (N, D); None if there are too few.

    Exact for points on a lattice; otherwise from the number of neighbours within `radius` [m].
    """
    count, dim = points.shape
    if count < 2:
        return None
    tree = cKDTree(points)
    asked = points[:: max(1, count // SAMPLE)]
    nearest = tree.query(asked, k=2)[0][:, 1]
    low, middle, high = np.percentile(nearest, [10, 50, 90])
    if low > 0 and high <= LATTICE * low:
        return float(middle)
    inside = np.percentile(tree.query_ball_point(asked, radius, return_length=True), 75)
    volume = math.pi * radius**2 if dim == 2 else 4 / 3 * math.pi * radius**3
    return float((volume / inside) ** (1 / dim))


def scene_of(found: ForeignTrajectory, about: Metadata, spacing: float) -> Scene:
    """A scene with the domain of the metadata and a release for each body of moving points."""
    (x, *others) = zip(*about.bounds, strict=True)
    domain = Domain(lower=x, upper=others[0])
    moving = found.moving if found.moving.any() else np.ones(len(found.moving), bool)
    points = found.positions[0, moving]
    ahead = found.positions[min(1, len(found.positions) - 1), moving]
    material = Material()
    if found.material is not None:
        angle = math.degrees(math.atan(max(0.0, float(found.material[moving].mean()))))
        material = Material(friction_angle=min(angle, STEEPEST))
    return Scene(
        name=found.name,
        domain=domain,
        releases=_releases(points, (ahead - points) / about.stride, domain, spacing),
        material=material,
        duration=max(1, len(found.positions) - 1) * about.stride,
    )


def _releases(
    points: np.ndarray, velocity: np.ndarray, domain: Domain, spacing: float
) -> tuple[Release, ...]:
    pairs = cKDTree(points).query_pairs(TOUCH * spacing, output_type="ndarray")
    ones = np.ones(len(pairs), bool)
    links = coo_matrix((ones, (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    number, body = connected_components(links, directed=False)
    bodies = [np.flatnonzero(body == k) for k in range(number)] if number <= MOST_BODIES else []
    bodies = bodies or [np.arange(len(points))]
    while True:
        boxes = [_box(points[rows], domain, spacing) for rows in bodies]
        clash = next(
            ((j, k) for k in range(len(boxes)) for j in range(k) if boxes[j].overlaps(boxes[k])),
            None,
        )
        if clash is None:
            break
        merged = np.concatenate([bodies[k] for k in clash])
        bodies = [rows for k, rows in enumerate(bodies) if k not in clash] + [merged]
    return tuple(
        Release(lower=box.lower, upper=box.upper, velocity=tuple(map(float, mean)))
        for box, mean in zip(boxes, (velocity[rows].mean(0) for rows in bodies), strict=True)
    )


def _box(points: np.ndarray, domain: Domain, spacing: float) -> Box:
    """The box that `points` fill, half a spacing around them, as far as it lies in the domain."""
    floor, ceiling = np.array(domain.lower), np.array(domain.upper)
    low = np.clip(points.min(0) - spacing / 2, floor, ceiling)
    high = np.clip(points.max(0) + spacing / 2, floor, ceiling)
    # A body outside of the domain lies, for the scene, in a cell at the face that it is near.
    thin = high - low < spacing / 4
    low = np.where(thin, np.minimum(low, ceiling - spacing / 4), low)
    high = np.where(thin, low + spacing / 4, high)
    return Box(lower=tuple(map(float, low)), upper=tuple(map(float, high)))

"""Whether the parts of a scene fit together: dimensions, the domain, nothing in another's way."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gns_model import footprint
from gns_model.parts import TOLERANCE, Baffle, Box, Vector

if TYPE_CHECKING:
    from gns_model.placement import Placement
    from gns_model.scene import Scene


def check(scene: Scene) -> None:
    """Raise ValueError with one line for the first thing that does not fit."""
    dim, domain = scene.dim, scene.domain
    if dim not in (2, 3):
        raise ValueError(f"domain.lower must have 2 or 3 numbers, got {dim}")
    if len(scene.gravity) != dim:
        raise ValueError(f"gravity needs {dim} numbers, got {scene.gravity}")
    _check_releases(scene)
    _check_baffles(scene)
    if scene.section is not None and not domain.lower[0] < scene.section < domain.upper[0]:
        raise ValueError(
            f"section {scene.section:g} must lie inside the domain, "
            f"{domain.lower[0]:g} to {domain.upper[0]:g}"
        )
    if scene.placement is not None:
        _check_placement(scene.placement, domain)


def _check_releases(scene: Scene) -> None:
    dim, domain = scene.dim, scene.domain
    for k, release in enumerate(scene.releases):
        if len(release.lower) != dim or len(release.velocity) != dim:
            raise ValueError(
                f"release[{k}] needs {dim} numbers in lower, upper and velocity, got "
                f"{release.lower}, {release.upper}, {release.velocity}"
            )
        if not domain.contains(release):
            raise ValueError(
                f"release[{k}] {release.lower} to {release.upper} leaves the domain "
                f"{domain.lower} to {domain.upper}"
            )
        for j, earlier in enumerate(scene.releases[:k]):
            if release.overlaps(earlier):
                raise ValueError(
                    f"release[{k}] {_span(release)} overlaps release[{j}] {_span(earlier)}"
                )


def _check_baffles(scene: Scene) -> None:
    dim, domain = scene.dim, scene.domain
    for k, baffle in enumerate(scene.baffles):
        if len(baffle.size) != dim:
            raise ValueError(f"baffle[{k}].size needs {dim} numbers, got {baffle.size}")
        box = baffle.box(scene.base)
        # The corners of a turned baffle touch each face of the box that holds it.
        if not domain.contains(box):
            raise ValueError(
                f"baffle[{k}] {box.lower} to {box.upper}{_turned(baffle)} leaves the domain "
                f"{domain.lower} to {domain.upper}"
            )
        for j, release in enumerate(scene.releases):
            if _overlap(box, release, baffle, None):
                raise ValueError(
                    f"baffle[{k}] {_span(box)}{_turned(baffle)} overlaps release[{j}] "
                    f"{_span(release)}"
                )
        for j, other in enumerate(scene.baffles[:k]):
            other_box = other.box(scene.base)
            if _overlap(box, other_box, baffle, other):
                raise ValueError(
                    f"baffle[{k}] {_span(box)}{_turned(baffle)} overlaps baffle[{j}] "
                    f"{_span(other_box)}{_turned(other)}"
                )


def _check_placement(placement: Placement, domain: Box) -> None:
    plan_lower, plan_upper = _plan(domain.lower), _plan(domain.upper)
    if len(placement.lower) != len(plan_lower):
        raise ValueError(
            f"placement.lower and upper need {len(plan_lower)} numbers, got "
            f"{placement.lower}, {placement.upper}"
        )
    if any(p < d - TOLERANCE for p, d in zip(placement.lower, plan_lower, strict=True)) or any(
        p > d + TOLERANCE for p, d in zip(placement.upper, plan_upper, strict=True)
    ):
        raise ValueError(
            f"placement {placement.lower} to {placement.upper} leaves the "
            f"domain in plan, {plan_lower} to {plan_upper}"
        )


def _plan(vector: Vector) -> Vector:
    return (vector[0], *vector[2:])


def _overlap(a: Box, b: Box, one: Baffle, other: Baffle | None) -> bool:
    """Whether baffle `one` in box `a` shares volume with what is in `b`: baffle `other`, or all."""
    if not a.overlaps(b):
        return False
    if not one.unturned[1] and (other is None or not other.unturned[1]):
        return True
    plan = np.array([[b.lower[0], b.lower[2]], [b.upper[0], b.upper[2]]])
    around = other.corners if other else footprint.corners(plan.mean(0), plan[1] - plan[0])
    return float(footprint.separation(one.corners, around)) < -TOLERANCE


def _turned(baffle: Baffle) -> str:
    return f" (turned by {baffle.yaw:g} degrees)" if baffle.unturned[1] else ""


def _span(box: Box) -> str:
    low, high = (tuple(round(v, 6) for v in corner) for corner in (box.lower, box.upper))
    return f"{low} to {high}"

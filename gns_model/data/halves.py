"""Half of a symmetric flow: the same as the flow of that half against a smooth wall.

Nothing crosses the plane of symmetry and no shear acts on it: so does a wall without friction. So
every free-standing column also shows how one of half its width moves at a wall, at no cost: as with
the mirror (`training.augment`), the symmetry is in the data and not in the network.
"""

from __future__ import annotations

import numpy as np

from gns_model.scene import Scene

#: Places and speeds that differ by less are the same [m], [m/s].
SAME = 1e-6


def plane_of_symmetry(scene: Scene) -> float | None:
    """Where x of the plane lies that halves the flow of a 2D scene [m]; None if there is none.

    The releases have to mirror each other in it and stand on level ground, free of baffles and as
    far from both walls as they are wide, and the walls have to be smooth.
    """
    if scene.dim != 2 or scene.baffles or scene.friction.walls or abs(scene.gravity[0]) > SAME:
        return None
    left = min(r.lower[0] for r in scene.releases)
    right = max(r.upper[0] for r in scene.releases)
    plane = (left + right) / 2
    room = min(left - scene.domain.lower[0], scene.domain.upper[0] - right)
    if room < right - left:
        return None
    ours = [(*r.lower, *r.upper, *r.velocity) for r in scene.releases]
    others = [
        (2 * plane - r.upper[0], r.lower[1], 2 * plane - r.lower[0], r.upper[1],
         -r.velocity[0], r.velocity[1])
        for r in scene.releases
    ]  # fmt: skip
    gaps = np.abs(np.array(ours)[:, None] - np.array(others)[None]).max(axis=2)
    return plane if (gaps.min(axis=1) < SAME).all() else None


def half(scene: Scene, plane: float) -> Scene:
    """The right half of a symmetric scene, with a wall in the plane."""
    releases = tuple(
        r.model_copy(update={"lower": (max(plane, r.lower[0]), *r.lower[1:])})
        for r in scene.releases
        if r.upper[0] > plane + SAME
    )
    lower = (plane, *scene.domain.lower[1:])
    domain = scene.domain.model_copy(update={"lower": lower})
    return scene.model_copy(update={"domain": domain, "releases": releases})

"""Contact with rigid boundaries: Coulomb friction on a velocity, and exact boxes.

Walls and most boxes lie along the axes. A box turned about the vertical through its middle is met
in its own frame, in which it lies along the axes, too.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

#: Boxes are taken this much larger, and the domain smaller [m]: more than float32 rounds off when
#: positions are stored, so that no stored point lies inside a baffle or outside the domain.
SKIN = 1e-6

#: Codes of `solid_nodes` from here on: four for each box, for the sides of turned ones.
TURNED = 6

#: In the frame of a turned box no side is flush with a wall.
_NO_WALL_BELOW, _NO_WALL_ABOVE = np.full(3, -np.inf), np.full(3, np.inf)


@njit(cache=True, inline="always")
def slide(normal, first, second, sign, mu):
    """Velocity after contact with a face: (normal, first, second) components [m/s].

    The face's outward normal has the given `sign` along the first component. An approaching
    velocity loses its normal part, and of the tangential part at most mu times as much (Coulomb).
    """
    approach = -sign * normal
    if approach <= 0.0:
        return normal, first, second
    tangential = math.sqrt(first * first + second * second)
    loss = mu * approach
    if loss >= tangential:
        return 0.0, 0.0, 0.0
    scale = 1.0 - loss / tangential
    return 0.0, first * scale, second * scale


@njit(cache=True, inline="always")
def nearest_face(x, y, z, box, flat, lower, upper):
    """Face of a box through which a point inside leaves by the shortest way, and its depth [m].

    Faces: 1 -x, 2 +x, 3 +y, 4 -z, 5 +z; 0 if the point is outside. The box stands on the base,
    so there is no way out below, nor through a face flush with a wall of the domain.
    """
    depth = math.inf
    face = 0
    if x <= box[0, 0] or x >= box[1, 0] or y >= box[1, 1]:
        return 0, 0.0
    if not flat and (z <= box[0, 2] or z >= box[1, 2]):
        return 0, 0.0
    if x - box[0, 0] < depth and box[0, 0] > lower[0] + SKIN:
        depth, face = x - box[0, 0], 1
    if box[1, 0] - x < depth and box[1, 0] < upper[0] - SKIN:
        depth, face = box[1, 0] - x, 2
    if box[1, 1] - y < depth and box[1, 1] < upper[1] - SKIN:
        depth, face = box[1, 1] - y, 3
    if not flat:
        if z - box[0, 2] < depth and box[0, 2] > lower[2] + SKIN:
            depth, face = z - box[0, 2], 4
        if box[1, 2] - z < depth and box[1, 2] < upper[2] - SKIN:
            depth, face = box[1, 2] - z, 5
    return face, depth


@njit(cache=True, inline="always")
def box_contact(px, py, pz, vx, vy, vz, box, mu, flat, lower, upper):
    """Put a point that entered a box back on its nearest face and apply friction there."""
    face, _ = nearest_face(px, py, pz, box, flat, lower, upper)
    if face == 1:
        px = box[0, 0]
        vx, vy, vz = slide(vx, vy, vz, -1.0, mu)
    elif face == 2:
        px = box[1, 0]
        vx, vy, vz = slide(vx, vy, vz, 1.0, mu)
    elif face == 3:
        py = box[1, 1]
        vy, vx, vz = slide(vy, vx, vz, 1.0, mu)
    elif face == 4:
        pz = box[0, 2]
        vz, vx, vy = slide(vz, vx, vy, -1.0, mu)
    elif face == 5:
        pz = box[1, 2]
        vz, vx, vy = slide(vz, vx, vy, 1.0, mu)
    return px, py, pz, vx, vy, vz


@njit(cache=True, inline="always")
def into_frame(x, z, box, cosine, sine):
    """Plan coordinates [m] in the frame of a box turned about its middle."""
    mx, mz = 0.5 * (box[0, 0] + box[1, 0]), 0.5 * (box[0, 2] + box[1, 2])
    dx, dz = x - mx, z - mz
    return mx + (cosine * dx + sine * dz), mz + (cosine * dz - sine * dx)


@njit(cache=True)
def turned_contact(px, py, pz, vx, vy, vz, box, cosine, sine, mu):
    """`box_contact` with a box turned by an angle of this cosine and sine from x towards z."""
    qx, qz = into_frame(px, pz, box, cosine, sine)
    face, _ = nearest_face(qx, py, qz, box, False, _NO_WALL_BELOW, _NO_WALL_ABOVE)
    if face == 0:
        return px, py, pz, vx, vy, vz
    qx, py, qz, ux, vy, uz = box_contact(
        qx, py, qz, cosine * vx + sine * vz, vy, cosine * vz - sine * vx,
        box, mu, False, _NO_WALL_BELOW, _NO_WALL_ABOVE,
    )  # fmt: skip
    px, pz = into_frame(qx, qz, box, cosine, -sine)
    return px, py, pz, cosine * ux - sine * uz, vy, sine * ux + cosine * uz


@njit(cache=True, inline="always")
def turned_slide(vx, vy, vz, code, turns, mu):
    """Velocity after contact with the side of a turned box that a code of `solid_nodes` names."""
    cosine, sine = turns[(code - TURNED) // 4]
    side = (code - TURNED) % 4
    ux, uz = cosine * vx + sine * vz, cosine * vz - sine * vx
    sign = -1.0 if side % 2 == 0 else 1.0
    if side < 2:
        ux, vy, uz = slide(ux, vy, uz, sign, mu)
    else:
        uz, ux, vy = slide(uz, ux, vy, sign, mu)
    return cosine * ux - sine * uz, vy, sine * ux + cosine * uz


@njit(cache=True)
def solid_nodes(lattice, boxes, turned, turns, margin, lower, upper):
    """For each grid node 0, or the face (1 to 5) of the box that it lies `margin` [m] deep in.

    The sides of turned box b have the codes TURNED + 4 b and following: -x, +x, -z, +z of its own
    frame. See `Problem` for the arrays.

    Only nodes deeper than the margin act on the grid: shallower ones belong to points that touch
    the face exactly, so that a baffle moved by less than a cell acts differently at once.
    """
    solid = np.zeros(lattice.nx * lattice.ny * lattice.nz, np.int16)
    for i in range(lattice.nx):
        for j in range(lattice.ny):
            for k in range(lattice.nz):
                x, y = lattice.ox + i * lattice.dx, lattice.oy + j * lattice.dx
                z = lattice.oz + k * lattice.dx
                for b in range(boxes.shape[0]):
                    face, depth = nearest_face(x, y, z, boxes[b], lattice.flat, lower, upper)
                    if face > 0 and depth > margin:
                        solid[(i * lattice.ny + j) * lattice.nz + k] = face
                for b in range(turned.shape[0]):
                    qx, qz = into_frame(x, z, turned[b], turns[b, 0], turns[b, 1])
                    face, depth = nearest_face(
                        qx, y, qz, turned[b], False, _NO_WALL_BELOW, _NO_WALL_ABOVE
                    )
                    if face > 0 and depth > margin:
                        if face != 3:
                            face = TURNED + 4 * b + (face - 1 if face < 3 else face - 2)
                        solid[(i * lattice.ny + j) * lattice.nz + k] = face
    return solid

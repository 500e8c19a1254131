"""The kernels of a substep: points to grid, grid update, grid to points.

Explicit MLS-MPM (Hu et al. 2018) with quadratic B-splines and AFLIP velocities (Fei et al. 2021):
a point keeps its own velocity plus the change that the grid saw, and leans to the grid's velocity
at a *rate*, so that the result does not depend on the number of substeps.

Plane strain is a slab one node thick: the tuple `layers` holds the stencil's offsets across,
(0, 1, 2) in 3D and (0,) in 2D, and its length is known when the kernel is compiled.

Points are sorted into blocks of 4 cells a side and blocks are coloured like a chess board, so
that blocks of one colour never touch the same node. A node is therefore summed in one order,
whatever the number of threads: results are bit-identical.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np
from numba import njit, prange

from gns_model.mpm.contact import TURNED, box_contact, slide, turned_contact, turned_slide
from gns_model.mpm.material import advance_stress

#: Columns of the point array: position, velocity, affine velocity, stress, log volume strain.
POSITION, VELOCITY, AFFINE, STRESS, STRAIN, COLUMNS = 0, 3, 6, 15, 21, 22
#: Columns of the grid array: mass; momentum, then new velocity; impulse, then old velocity.
MASS, NEW, OLD, NODE_COLUMNS = 0, 1, 4, 8

BLOCK = 4
#: Nodes of padding below the domain's lower faces.
PADDING = 2


class Lattice(NamedTuple):
    """The background grid: node (i, j, k) lies at origin + dx (i, j, k)."""

    dx: float
    ox: float
    oy: float
    oz: float
    nx: int
    ny: int
    nz: int
    wall_x: int  #: first node of the upper wall, along x
    wall_y: int
    wall_z: int
    flat: bool  #: plane strain


@njit(cache=True, inline="always")
def _weights(f):
    """Quadratic B-spline weights of three nodes at distance f in [0.5, 1.5) from the first."""
    return 0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2


@njit(cache=True)
def sort_points(points, ids, spare, spare_ids, lattice):
    """Sort points by block, then by cell, into `spare`; return the block starts by colour.

    Returns:
        starts: first point of each block that holds points, with the total appended, (B + 1,).
        order: those blocks' indices, grouped by colour, shape (B,).
        colours: first entry of each of the 8 colours in `order`, with B appended, (9,).
        bounds: lowest and highest cell in use along each axis, shape (6,).
    """
    n = points.shape[0]
    bx = lattice.nx // BLOCK + 1
    by = lattice.ny // BLOCK + 1
    bz = lattice.nz // BLOCK + 1
    per = BLOCK * BLOCK * (1 if lattice.flat else BLOCK)
    counts = np.zeros(bx * by * bz * per + 1, np.int64)
    keys = np.empty(n, np.int64)
    bounds = np.array([lattice.nx, 0, lattice.ny, 0, lattice.nz, 0])
    inverse = 1.0 / lattice.dx
    for p in range(n):
        i = int((points[p, 0] - lattice.ox) * inverse)
        j = int((points[p, 1] - lattice.oy) * inverse)
        k = 0 if lattice.flat else int((points[p, 2] - lattice.oz) * inverse)
        bounds[0], bounds[1] = min(bounds[0], i), max(bounds[1], i)
        bounds[2], bounds[3] = min(bounds[2], j), max(bounds[3], j)
        bounds[4], bounds[5] = min(bounds[4], k), max(bounds[5], k)
        block = ((i // BLOCK) * by + j // BLOCK) * bz + k // BLOCK
        cell = (i % BLOCK) * BLOCK + j % BLOCK
        if not lattice.flat:
            cell = cell * BLOCK + k % BLOCK
        keys[p] = block * per + cell
        counts[keys[p] + 1] += 1
    for c in range(1, counts.shape[0]):
        counts[c] += counts[c - 1]
    used = 0
    for b in range(bx * by * bz):
        if counts[(b + 1) * per] > counts[b * per]:
            used += 1
    starts = np.empty(used + 1, np.int64)
    colour_of = np.empty(used, np.int64)
    m = 0
    for b in range(bx * by * bz):
        if counts[(b + 1) * per] > counts[b * per]:
            starts[m] = counts[b * per]
            i, j, k = b // (by * bz), (b // bz) % by, b % bz
            colour_of[m] = (i % 2) * 4 + (j % 2) * 2 + k % 2
            m += 1
    starts[used] = n
    order = np.argsort(colour_of, kind="mergesort")
    colours = np.searchsorted(colour_of[order], np.arange(9))
    for p in range(n):
        target = counts[keys[p]]
        counts[keys[p]] += 1
        spare[target] = points[p]
        spare_ids[target] = ids[p]
    return starts, order, colours, bounds


@njit(parallel=True, cache=True)
def points_to_grid(points, grid, lattice, layers, starts, order, first, last, mass, volume, dt):
    """Scatter mass, momentum and stress impulse of the blocks order[first:last], one colour."""
    inverse = 1.0 / lattice.dx
    for slot in prange(first, last):
        block = order[slot]
        for p in range(starts[block], starts[block + 1]):
            x = (points[p, 0] - lattice.ox) * inverse
            y = (points[p, 1] - lattice.oy) * inverse
            i = int(x - 0.5)
            j = int(y - 0.5)
            wx = _weights(x - i)
            wy = _weights(y - j)
            k = 0
            fz = 0.0
            wz = (1.0, 0.0, 0.0)
            if len(layers) == 3:
                z = (points[p, 2] - lattice.oz) * inverse
                k = int(z - 0.5)
                fz = z - k
                wz = _weights(fz)
            fx, fy = x - i, y - j
            # Momentum m (v + C d) and impulse -V (4 / dx^2) sigma d dt, with d = node - point.
            h = lattice.dx
            mx, my, mz = mass * points[p, 3], mass * points[p, 4], mass * points[p, 5]
            s = mass * h
            c00, c01, c02 = s * points[p, 6], s * points[p, 7], s * points[p, 8]
            c10, c11, c12 = s * points[p, 9], s * points[p, 10], s * points[p, 11]
            c20, c21, c22 = s * points[p, 12], s * points[p, 13], s * points[p, 14]
            q = -4.0 * inverse * volume * dt
            sxx, syy, szz = q * points[p, 15], q * points[p, 16], q * points[p, 17]
            sxy, syz, sxz = q * points[p, 18], q * points[p, 19], q * points[p, 20]
            for a in range(3):
                dx = a - fx
                ax, ay, az = mx + c00 * dx, my + c10 * dx, mz + c20 * dx
                tx, ty, tz = sxx * dx, sxy * dx, sxz * dx
                for b in range(3):
                    dy = b - fy
                    wab = wx[a] * wy[b]
                    bx, by, bz = ax + c01 * dy, ay + c11 * dy, az + c21 * dy
                    ux, uy, uz = tx + sxy * dy, ty + syy * dy, tz + syz * dy
                    row = ((i + a) * lattice.ny + j + b) * lattice.nz + k
                    for c in range(len(layers)):
                        dz = c - fz
                        w = wab * wz[c]
                        node = grid[row + c]
                        node[0] += w * mass
                        node[1] += w * (bx + c02 * dz)
                        node[2] += w * (by + c12 * dz)
                        node[3] += w * (bz + c22 * dz)
                        node[4] += w * (ux + sxz * dz)
                        node[5] += w * (uy + syz * dz)
                        node[6] += w * (uz + szz * dz)


@njit(parallel=True, cache=True)
def update_grid(grid, lattice, bounds, gravity, mu_base, mu_walls, mu_baffles, solid, turns, dt):
    """Momentum to velocities, gravity, and contact with base, walls and nodes inside baffles.

    `solid` gives each node 0, or 1 + the outward face of the baffle it lies in (-x, +x, +y, -z,
    +z in this order), or the code of the side of a turned baffle; see `contact.solid_nodes`.
    """
    top_x = min(bounds[1] + 3, lattice.nx)
    for i in prange(max(bounds[0] - 2, 0), top_x):
        for j in range(max(bounds[2] - 2, 0), min(bounds[3] + 3, lattice.ny)):
            for k in range(max(bounds[4] - 2, 0), min(bounds[5] + 3, lattice.nz)):
                index = (i * lattice.ny + j) * lattice.nz + k
                node = grid[index]
                m = node[0]
                if m <= 0.0:
                    continue
                ox, oy, oz = node[1] / m, node[2] / m, node[3] / m
                vx = ox + node[4] / m + dt * gravity[0]
                vy = oy + node[5] / m + dt * gravity[1]
                vz = oz + node[6] / m + dt * gravity[2]
                if solid[index] == 1:
                    vx, vy, vz = slide(vx, vy, vz, -1.0, mu_baffles)
                elif solid[index] == 2:
                    vx, vy, vz = slide(vx, vy, vz, 1.0, mu_baffles)
                elif solid[index] == 3:
                    vy, vx, vz = slide(vy, vx, vz, 1.0, mu_baffles)
                elif solid[index] == 4:
                    vz, vx, vy = slide(vz, vx, vy, -1.0, mu_baffles)
                elif solid[index] == 5:
                    vz, vx, vy = slide(vz, vx, vy, 1.0, mu_baffles)
                elif solid[index] >= TURNED:
                    vx, vy, vz = turned_slide(vx, vy, vz, solid[index], turns, mu_baffles)
                if i <= PADDING:
                    vx, vy, vz = slide(vx, vy, vz, 1.0, mu_walls)
                elif i >= lattice.wall_x:
                    vx, vy, vz = slide(vx, vy, vz, -1.0, mu_walls)
                if not lattice.flat:
                    if k <= PADDING:
                        vz, vx, vy = slide(vz, vx, vy, 1.0, mu_walls)
                    elif k >= lattice.wall_z:
                        vz, vx, vy = slide(vz, vx, vy, -1.0, mu_walls)
                if j <= PADDING:
                    vy, vx, vz = slide(vy, vx, vz, 1.0, mu_base)
                elif j >= lattice.wall_y:
                    vy, vx, vz = slide(vy, vx, vz, -1.0, mu_walls)
                node[1], node[2], node[3] = vx, vy, vz
                node[4], node[5], node[6] = ox, oy, oz


@njit(parallel=True, cache=True)
def clear_grid(grid, lattice, bounds):
    """Zero the part of the grid that points of these bounds can reach."""
    for i in prange(max(bounds[0] - 2, 0), min(bounds[1] + 3, lattice.nx)):
        for j in range(max(bounds[2] - 2, 0), min(bounds[3] + 3, lattice.ny)):
            first = (i * lattice.ny + j) * lattice.nz
            low, high = max(bounds[4] - 2, 0), min(bounds[5] + 3, lattice.nz)
            grid[first + low : first + high] = 0.0


@njit(parallel=True, cache=True)
def grid_to_points(
    points, grid, lattice, layers, starts, keep, constants, boxes, mu_baffles,
    lower, upper, dt, speeds,
):  # fmt: skip
    """Gather velocities, advect, resolve contact with baffles exactly, advance the stress.

    `keep` is the share of its own velocity that a point keeps in this substep. `speeds` receives
    the largest grid-space displacement of each block's points [m].
    """
    inverse = 1.0 / lattice.dx
    for block in prange(starts.shape[0] - 1):
        fastest = 0.0
        for p in range(starts[block], starts[block + 1]):
            x = (points[p, 0] - lattice.ox) * inverse
            y = (points[p, 1] - lattice.oy) * inverse
            i = int(x - 0.5)
            j = int(y - 0.5)
            wx = _weights(x - i)
            wy = _weights(y - j)
            k = 0
            fz = 0.0
            wz = (1.0, 0.0, 0.0)
            if len(layers) == 3:
                z = (points[p, 2] - lattice.oz) * inverse
                k = int(z - 0.5)
                fz = z - k
                wz = _weights(fz)
            fx, fy = x - i, y - j
            vx = vy = vz = 0.0
            ux = uy = uz = 0.0
            c00 = c01 = c02 = c10 = c11 = c12 = c20 = c21 = c22 = 0.0
            for a in range(3):
                dx = a - fx
                for b in range(3):
                    dy = b - fy
                    wab = wx[a] * wy[b]
                    row = ((i + a) * lattice.ny + j + b) * lattice.nz + k
                    sx = sy = sz = 0.0
                    for c in range(len(layers)):
                        node = grid[row + c]
                        w = wab * wz[c]
                        gx, gy, gz = w * node[1], w * node[2], w * node[3]
                        sx += gx
                        sy += gy
                        sz += gz
                        ux += w * node[4]
                        uy += w * node[5]
                        uz += w * node[6]
                        dz = c - fz
                        c02 += gx * dz
                        c12 += gy * dz
                        c22 += gz * dz
                    vx += sx
                    vy += sy
                    vz += sz
                    c00 += sx * dx
                    c10 += sy * dx
                    c20 += sz * dx
                    c01 += sx * dy
                    c11 += sy * dy
                    c21 += sz * dy
            if len(layers) == 1:
                c02 = c12 = c22 = 0.0
            s = 4.0 * inverse
            gradient = (
                s * c00, s * c01, s * c02, s * c10, s * c11, s * c12, s * c20, s * c21, s * c22,
            )  # fmt: skip
            for c in range(9):
                points[p, AFFINE + c] = gradient[c]
            strain = points[p, STRAIN] + dt * (gradient[0] + gradient[4] + gradient[8])
            # Grains that part carry no more strain than the tension cutoff. Kept in full, gaps that
            # points gather by noise leave half of a settled deposit without stress.
            strain = min(strain, constants.tension / constants.bulk)
            points[p, STRAIN] = strain
            (
                points[p, 15], points[p, 16], points[p, 17],
                points[p, 18], points[p, 19], points[p, 20],
            ) = advance_stress(
                points[p, 15], points[p, 16], points[p, 17],
                points[p, 18], points[p, 19], points[p, 20],
                strain, gradient, dt, constants,
            )  # fmt: skip
            px = points[p, 0] + dt * vx
            py = points[p, 1] + dt * vy
            pz = points[p, 2] + dt * vz
            nvx = vx + keep * (points[p, 3] - ux)
            nvy = vy + keep * (points[p, 4] - uy)
            nvz = vz + keep * (points[p, 5] - uz)
            for b in range(boxes.shape[0]):
                px, py, pz, nvx, nvy, nvz = box_contact(
                    px, py, pz, nvx, nvy, nvz, boxes[b], mu_baffles, lattice.flat, lower, upper
                )
            if px < lower[0]:
                px, nvx = lower[0], max(nvx, 0.0)
            elif px > upper[0]:
                px, nvx = upper[0], min(nvx, 0.0)
            if py < lower[1]:
                py, nvy = lower[1], max(nvy, 0.0)
            elif py > upper[1]:
                py, nvy = upper[1], min(nvy, 0.0)
            if len(layers) == 3:
                if pz < lower[2]:
                    pz, nvz = lower[2], max(nvz, 0.0)
                elif pz > upper[2]:
                    pz, nvz = upper[2], min(nvz, 0.0)
            moved = max(abs(px - points[p, 0]), max(abs(py - points[p, 1]), abs(pz - points[p, 2])))
            fastest = max(fastest, moved)
            points[p, 0], points[p, 1], points[p, 2] = px, py, pz
            points[p, 3], points[p, 4], points[p, 5] = nvx, nvy, nvz
        speeds[block] = fastest


@njit(parallel=True, cache=True)
def leave_turned_boxes(points, starts, turned, turns, mu_baffles, lower, upper, speeds):
    """Resolve contact with turned baffles, (B, 2, 3) with turns (B, 2), and the domain once more.

    Apart from `grid_to_points`, which a call would make slower for scenes that turn nothing.
    `speeds` grows by the longest way of each block's points here [m].
    """
    for block in prange(starts.shape[0] - 1):
        farthest = 0.0
        for p in range(starts[block], starts[block + 1]):
            x, y, z = points[p, 0], points[p, 1], points[p, 2]
            for b in range(turned.shape[0]):
                (
                    points[p, 0], points[p, 1], points[p, 2],
                    points[p, 3], points[p, 4], points[p, 5],
                ) = turned_contact(
                    points[p, 0], points[p, 1], points[p, 2],
                    points[p, 3], points[p, 4], points[p, 5],
                    turned[b], turns[b, 0], turns[b, 1], mu_baffles,
                )  # fmt: skip
            way = max(abs(points[p, 0] - x), max(abs(points[p, 1] - y), abs(points[p, 2] - z)))
            if way > 0.0:
                farthest = max(farthest, way)
                for axis in range(3):
                    # Rounding, where a corner touches a wall.
                    points[p, axis] = min(max(points[p, axis], lower[axis]), upper[axis])
        speeds[block] += farthest


@njit(cache=True)
def advance(
    points, ids, spare, spare_ids, grid, lattice, layers, solid, boxes, turned, turns, gravity,
    constants, mass, volume, mu_base, mu_walls, mu_baffles, lower, upper, keep, dt, substeps,
):  # fmt: skip
    """Advance all points by `substeps` substeps of dt [s]; returns the two arrays that hold them.

    Points are sorted again before any of them has drifted half a cell from its block. A drift
    that is not finite ends the advance at once: the caller sees it in the positions.
    """
    done = 0
    while done < substeps:
        starts, order, colours, bounds = sort_points(points, ids, spare, spare_ids, lattice)
        points, spare = spare, points
        ids, spare_ids = spare_ids, ids
        speeds = np.zeros(starts.shape[0] - 1)
        drift = 0.0
        while done < substeps:
            clear_grid(grid, lattice, bounds)
            for colour in range(8):
                if colours[colour + 1] > colours[colour]:
                    points_to_grid(
                        points, grid, lattice, layers, starts, order,
                        colours[colour], colours[colour + 1], mass, volume, dt,
                    )  # fmt: skip
            update_grid(
                grid, lattice, bounds, gravity, mu_base, mu_walls, mu_baffles, solid, turns, dt
            )
            grid_to_points(
                points, grid, lattice, layers, starts, keep, constants, boxes, mu_baffles,
                lower, upper, dt, speeds,
            )  # fmt: skip
            if turned.shape[0] > 0:
                leave_turned_boxes(points, starts, turned, turns, mu_baffles, lower, upper, speeds)
            done += 1
            fastest = 0.0
            for b in range(speeds.shape[0]):
                fastest = max(fastest, speeds[b])
                if not math.isfinite(speeds[b]):
                    fastest = math.inf
            drift += fastest
            if not math.isfinite(drift):
                return points, ids, spare, spare_ids
            if drift + fastest > 0.5 * lattice.dx:
                break
    return points, ids, spare, spare_ids


def _serial(kernel: Any, **kernels: Any) -> Callable[..., Any]:
    """`kernel` without parallel regions, calling `kernels` in place of those of the same name.

    Handing a region to numba's pool wakes a thread even if it is the only one; in 2D, with four
    regions a substep of a hundred microseconds, a rollout then spends more on that than on its
    arithmetic. The arithmetic is the same, and so are its results.
    """
    source = kernel.py_func
    name = f"{source.__name__}_serial"
    twin = FunctionType(source.__code__, {**source.__globals__, **kernels}, name)
    twin.__module__, twin.__qualname__ = source.__module__, name  # a cache file of its own
    return njit(cache=True)(twin)


#: `advance` for one thread.
advance_serial = _serial(
    advance,
    points_to_grid=_serial(points_to_grid),
    update_grid=_serial(update_grid),
    clear_grid=_serial(clear_grid),
    grid_to_points=_serial(grid_to_points),
    leave_turned_boxes=_serial(leave_turned_boxes),
)

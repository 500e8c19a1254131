"""Walls as somebody drew them: a closed mesh (STL, PLY, OBJ, OFF, GLB) as baffles of a scene.

Every connected body of the mesh has to be a box that stands upright on the base, along the axes or
turned about the vertical: that is what both simulators know exactly. Anything else is refused,
since a bounding box in its place would be another wall than the one that was drawn. Coordinates are
metres with the scene's origin. STL, PLY, OBJ and OFF are read with z up, as CAD programs and our
own STL have it, and GLB with y up, as its standard says (design/geometry.py tells how the two
frames relate).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, QhullError

from design.geometry import Y_UP_TO_Z_UP
from gns_model.errors import FileFormatError, GnsError
from gns_model.footprint import bounding_size, turn
from gns_model.scene import Baffle, Scene

Axis = Literal["y", "z"]

#: Which axis is up in a file of this kind.
UP: dict[str, Axis] = {".stl": "z", ".ply": "z", ".obj": "z", ".off": "z", ".glb": "y"}

#: A body is a box if it fills the least upright box around it but for this share of its volume.
BOX_SHARE = 0.01
#: How far above or below the base a body may end and still stand on it [m].
FOOT = 1e-3
#: Coordinates are rounded to this [m], so that an STL's single precision is not taken for meant.
ROUNDING = 1e-6
#: As are yaws to this [degrees].
YAW_ROUNDING = 1e-3
#: A yaw that moves no corner by more than this is not taken for meant, either [m].
TRACE = 2.5e-5


class WallError(GnsError, ValueError):
    """A mesh that cannot be put into the flow: the message names the file, the body and why."""


def read_walls(
    path: str | os.PathLike[str], scene: Scene, *, up: Axis | None = None
) -> tuple[Baffle, ...]:
    """The bodies of a mesh as baffles of `scene`, in the file's order along x, then z.

    Args:
        path: of the mesh.
        scene: gives dimension, base and domain. In 2D a body's extent across the flow is dropped.
        up: the axis of the file that points up; default: by the kind of file, see `UP`.

    Raises:
        FileFormatError: if the file cannot be read as a mesh.
        WallError: if a body is not closed, is no box, leaves the domain or does not stand on the
            base.
    """
    path = Path(path)
    bodies = _bodies(path, up or UP.get(path.suffix.lower(), "z"))
    baffles = [
        _baffle(f"{path}: body {k} of {len(bodies)}", body, scene)
        for k, body in enumerate(bodies, start=1)
    ]
    return tuple(sorted(baffles, key=lambda baffle: baffle.center))


def _bodies(path: Path, up: Axis) -> list[trimesh.Trimesh]:
    """The connected bodies of a mesh file in the scene's frame (y up) [m]."""
    bodies: list[trimesh.Trimesh] = []
    for mesh in _meshes(path):
        if up == "z":
            mesh.apply_transform(np.linalg.inv(Y_UP_TO_Z_UP))
        # A format without shared vertices, such as STL, is a heap of triangles until merged.
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        mesh.update_faces(mesh.nondegenerate_faces())
        if len(mesh.faces) == 0:
            continue
        if not np.isfinite(mesh.vertices).all():
            raise FileFormatError(f"{path}: holds coordinates that are not finite")
        bodies += _closed(path, mesh)
    if not bodies:
        raise FileFormatError(f"{path}: holds no triangle")
    return bodies


def _closed(path: Path, mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """The bodies of a mesh of which every edge is shared by two faces."""
    edges = np.sort(mesh.edges, axis=1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    if (uses % 2).any():
        raise WallError(
            f"{path}: the mesh is not watertight ({int((uses % 2).sum())} of {len(uses)} edges "
            "belong to one face only): close it"
        )
    if (uses > 2).any():
        raise WallError(
            f"{path}: bodies touch along an edge, so that they cannot be told apart: merge them, "
            "leave a gap, or give them as [[baffle]] in a scene file"
        )
    labels = trimesh.graph.connected_component_labels(mesh.face_adjacency, len(mesh.faces))
    bodies = []
    for label in range(labels.max() + 1):
        body = mesh.submesh([np.flatnonzero(labels == label)], append=True)
        bodies.append(body)
    return bodies  # type: ignore[return-value]


def _meshes(path: Path) -> Iterator[trimesh.Trimesh]:
    """The meshes of a file in its own frame; of a file with bodies named "baffle…" only these."""
    kind = path.suffix.lower()
    if kind not in UP:
        raise FileFormatError(f"{path}: give a mesh file, one of {', '.join(UP)}")
    if not path.is_file():
        raise FileFormatError(f"{path}: no such file")
    try:
        scene = trimesh.load_scene(path, file_type=kind[1:])
        names = sorted(scene.graph.nodes_geometry)
        named = [name for name in names if str(name).startswith("baffle")]
        found = []
        for name in named or names:
            transform, geometry = scene.graph[name]
            mesh = scene.geometry[geometry]
            if isinstance(mesh, trimesh.Trimesh):
                found.append(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False))
                found[-1].apply_transform(transform)
    except MemoryError:
        raise
    except Exception as error:  # whatever a dozen readers raise on a damaged file
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FileFormatError(f"{path}: cannot be read as a mesh ({reason})") from None
    yield from found


def _baffle(name: str, body: trimesh.Trimesh, scene: Scene) -> Baffle:
    """A closed body in the scene's frame as a baffle; `name` begins every complaint."""
    if not body.is_winding_consistent:
        trimesh.repair.fix_normals(body)
    exact = np.array(body.bounds, dtype=float)
    span = f"{_point(exact[0])} to {_point(exact[1])} m"
    size = exact[1] - exact[0]
    if min(size) < ROUNDING:
        raise WallError(f"{name} has no volume: it spans {span}")
    lower, upper = (np.round(corner / ROUNDING) * ROUNDING for corner in exact)
    lower, upper = lower[: scene.dim], upper[: scene.dim]
    low, high = np.array(scene.domain.lower), np.array(scene.domain.upper)
    if (lower < low - FOOT).any() or (upper > high + FOOT).any():
        raise WallError(
            f"{name} spans {span} (x downstream, y up, z across) and leaves the domain "
            f"{_point(low)} to {_point(high)}: are its units metres, and is its upward axis --up?"
        )
    middle, sides, yaw = _least_rectangle(np.asarray(body.vertices)[:, [0, 2]])
    area = float(sides.prod()) if scene.dim == 3 and yaw else float(size[0] * size[2])
    filled = abs(float(body.volume)) / (area * float(size[1]))
    if filled < 1 - BOX_SHARE:
        raise WallError(
            f"{name} is no upright box (it fills {100 * filled:.1f}% of the least one around it, "
            f"{span}): only such boxes are simulated exactly; draw it as several of them"
        )
    if abs(lower[1] - scene.base) > FOOT:
        where = "above" if lower[1] > scene.base else "below"
        raise WallError(
            f"{name} does not stand on the base: it begins {abs(lower[1] - scene.base):g} m "
            f"{where} it, at y = {lower[1]:g} m"
        )
    # What reaches a wall within FOOT is meant to reach it.
    if scene.dim == 3 and yaw:
        sides = np.round(sides / ROUNDING) * ROUNDING
        reach, across = bounding_size(sides, yaw) / 2, [0, 2]
        middle = np.clip(
            np.round(middle / ROUNDING) * ROUNDING, low[across] + reach, high[across] - reach
        )
        top = min(float(upper[1]), float(high[1]))
        return Baffle(
            center=(round(float(middle[0]), 7), round(float(middle[1]), 7)),
            size=(
                round(float(sides[0]), 7),
                round(top - scene.base, 7),
                round(float(sides[1]), 7),
            ),
            yaw=yaw,
        )
    lower, upper = np.maximum(lower, low), np.minimum(upper, high)
    plan = [0, *range(2, scene.dim)]
    edges = [upper[0] - lower[0], upper[1] - scene.base, *(upper - lower)[2:]]
    return Baffle(
        center=tuple(round(float(c), 7) for c in (lower + upper)[plan] / 2),
        size=tuple(round(float(s), 7) for s in edges),
    )


def _least_rectangle(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """The least rectangle around points in plan (N, 2): middle, sides (2,) [m] and yaw [degrees].

    One of its sides lies along a side of the convex hull. Of the ways to write it the one with a
    yaw in (-45, 45] is taken.
    """
    try:
        hull = points[ConvexHull(points).vertices]
    except QhullError:  # all in a line
        return points.mean(axis=0), np.zeros(2), 0.0
    sides = np.roll(hull, -1, axis=0) - hull
    yaws = np.degrees(np.arctan2(sides[:, 1], sides[:, 0]))
    yaws = np.round(yaws / YAW_ROUNDING) * YAW_ROUNDING
    yaws = np.unique(np.append(45 - (45 - yaws) % 90, 0.0))
    best = None
    for yaw in sorted(yaws, key=abs):  # of equal ones the straightest
        cosine, sine = turn(float(yaw))
        seen = hull @ np.array([[cosine, -sine], [sine, cosine]])
        low, high = seen.min(axis=0), seen.max(axis=0)
        if best is None or (high - low).prod() < best[0] * (1 - 1e-6):
            middle = (low + high) / 2 @ np.array([[cosine, sine], [-sine, cosine]])
            best = float((high - low).prod()), middle, high - low, round(float(yaw), 3)
    assert best is not None
    _, middle, extent, yaw = best
    # The box along the axes that holds it has corners a whole side times the yaw away.
    if extent.max() * abs(np.radians(yaw)) < TRACE:
        return (points.min(axis=0) + points.max(axis=0)) / 2, np.ptp(points, axis=0), 0.0
    return middle, extent, yaw


def _point(corner: np.ndarray) -> str:
    return "(" + ", ".join(f"{v:.4g}" for v in corner) + ")"

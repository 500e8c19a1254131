"""Walls as somebody drew them: a closed mesh (STL, PLY, OBJ, OFF, GLB) as baffles of a scene.

Every connected body of the mesh has to be a box along the axes that stands on the base: that is
what both simulators know exactly. Anything else is refused, since a bounding box in its place would
be another wall than the one that was drawn. Coordinates are metres with the scene's origin. STL,
PLY, OBJ and OFF are read with z up, as CAD programs and our own STL have it, and GLB with y up, as
its standard says (design/geometry.py tells how the two frames relate).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh

from design.geometry import Y_UP_TO_Z_UP
from gns_model.errors import FileFormatError, GnsError
from gns_model.scene import Baffle, Scene

Axis = Literal["y", "z"]

#: Which axis is up in a file of this kind.
UP: dict[str, Axis] = {".stl": "z", ".ply": "z", ".obj": "z", ".off": "z", ".glb": "y"}

#: A body is a box if it fills its bounding box but for this share of its volume.
BOX_SHARE = 0.01
#: How far above or below the base a body may end and still stand on it [m].
FOOT = 1e-3
#: Coordinates are rounded to this [m], so that an STL's single precision is not taken for meant.
ROUNDING = 1e-6


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
    filled = abs(float(body.volume)) / float(size.prod())
    if filled < 1 - BOX_SHARE:
        raise WallError(
            f"{name} is no box along the axes (it fills {100 * filled:.1f}% of the box {span}): "
            "only such boxes are simulated exactly; draw it as several of them"
        )
    if abs(lower[1] - scene.base) > FOOT:
        where = "above" if lower[1] > scene.base else "below"
        raise WallError(
            f"{name} does not stand on the base: it begins {abs(lower[1] - scene.base):g} m "
            f"{where} it, at y = {lower[1]:g} m"
        )
    # What reaches a wall within FOOT is meant to reach it.
    lower, upper = np.maximum(lower, low), np.minimum(upper, high)
    plan = [0, *range(2, scene.dim)]
    edges = [upper[0] - lower[0], upper[1] - scene.base, *(upper - lower)[2:]]
    return Baffle(
        center=tuple(round(float(c), 7) for c in (lower + upper)[plan] / 2),
        size=tuple(round(float(s), 7) for s in edges),
    )


def _point(corner: np.ndarray) -> str:
    return "(" + ", ".join(f"{v:.4g}" for v in corner) + ")"

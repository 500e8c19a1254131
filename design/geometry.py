"""A layout as solid geometry: STL for engineering tools, GLB for viewers.

Both are in metres and keep the scene's origin, so that a drawing can be checked against the
coordinates in the report; only the axes differ, because the readers of the two formats do.

GLB (glTF 2.0) fixes +y as up, which is the scene's own frame: coordinates are written unchanged.
It holds the baffles, a slab for the base and the release as a translucent block, as named nodes.

STL fixes nothing, but CAD programs, meshers and slicers take z as up, so the scene is turned by
90 degrees about x: (x, y, z) -> (x, -z, y). That is a rotation and not a swap of two axes, which
would mirror the layout. The file holds the baffles alone, as closed boxes: what would be built.

A 2D (plane strain) scene stands for a slice 1 m wide, so it is drawn over 0 <= z <= 1 m.
"""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
import trimesh
from trimesh.visual.material import PBRMaterial

from gns_model.files import write_whole
from gns_model.scene import Scene

#: Scene frame (y up) -> STL frame (z up): a rotation about x, as a 4 x 4 matrix.
Y_UP_TO_Z_UP = np.array(
    [[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]],
)

#: Width [m] that a plane-strain scene is drawn with.
SLICE_WIDTH = 1.0

BAFFLE_COLOUR = (15, 118, 110, 255)
BASE_COLOUR = (203, 198, 188, 255)
RELEASE_COLOUR = (201, 138, 54, 90)


def write_geometry(scene: Scene, folder: Path, stem: str) -> dict[str, Path]:
    """Write `stem`.stl and `stem`.glb of a scene into `folder`, each whole or not at all.

    Returns:
        The paths, under "stl" and "glb". A scene without baffles has no "stl": there is nothing
        to build, and an STL without triangles is refused by most readers.
    """
    paths = {"glb": Path(folder) / f"{stem}.glb"}
    write_whole(paths["glb"], scene_graph(scene).export(file_type="glb"))
    if scene.baffles:
        paths["stl"] = Path(folder) / f"{stem}.stl"
        write_whole(paths["stl"], stl_bytes(baffle_mesh(scene), scene.name))
    return paths


def baffle_mesh(scene: Scene) -> trimesh.Trimesh:
    """The baffles as one mesh of closed boxes in the scene's frame (y up) [m].

    Raises:
        ValueError: if the scene has no baffles.
    """
    if not scene.baffles:
        raise ValueError("the scene has no baffles to draw")
    mesh: trimesh.Trimesh = trimesh.util.concatenate(_baffles(scene))  # type: ignore[assignment]
    return mesh


def scene_graph(scene: Scene) -> trimesh.Scene:
    """Base slab, releases and baffles as named nodes in the scene's frame (y up) [m]."""
    graph = trimesh.Scene()
    lower, upper = _in_3d(np.array([[scene.domain.lower, scene.domain.upper]]))[0]
    thickness = 0.01 * float(max(upper[0] - lower[0], upper[2] - lower[2]))
    slab = _box((lower[0], lower[1] - thickness, lower[2]), (upper[0], lower[1], upper[2]))
    _add(graph, slab, "base", BASE_COLOUR)
    for k, release in enumerate(scene.releases, start=1):
        corners = _in_3d(np.array([[release.lower, release.upper]]))[0]
        _add(graph, _box(*corners), f"release-{k}", RELEASE_COLOUR)
    for k, baffle in enumerate(_baffles(scene), start=1):
        _add(graph, baffle, f"baffle-{k}", BAFFLE_COLOUR)
    return graph


def stl_bytes(mesh: trimesh.Trimesh, name: str) -> bytes:
    """Binary STL of a mesh given in the scene's frame: turned to z up, units told in the header."""
    turned = mesh.copy()
    turned.apply_transform(Y_UP_TO_Z_UP)
    content = io.BytesIO()
    turned.export(content, file_type="stl")
    # The first 80 bytes are free text; "solid" at their start would make readers expect ASCII.
    header = f"baffles of {name}; metres; z up".encode("ascii", "replace")[:80]
    return struct.pack("80s", header) + content.getvalue()[80:]


def _baffles(scene: Scene) -> list[trimesh.Trimesh]:
    """Each baffle as a closed box, turned by its yaw, in the scene's frame [m]."""
    boxes, turns = scene.oriented_boxes()
    meshes = []
    for corners, (cosine, sine) in zip(_in_3d(boxes), turns, strict=True):
        mesh = _box(*corners)
        if sine:
            middle = corners.mean(axis=0)
            turn = np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])
            mesh.vertices = (mesh.vertices - middle) @ turn.T + middle
        meshes.append(mesh)
    return meshes


def _in_3d(boxes: np.ndarray) -> np.ndarray:
    """Corners (B, 2, D) -> (B, 2, 3); a plane-strain box spans the slice."""
    if boxes.shape[-1] == 3:
        return boxes
    across = np.broadcast_to(np.array([[0.0], [SLICE_WIDTH]]), (len(boxes), 2, 1))
    return np.concatenate([boxes, across], axis=-1)


def _box(lower: np.ndarray | tuple, upper: np.ndarray | tuple) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=np.array([lower, upper], dtype=float))


def _add(graph: trimesh.Scene, mesh: trimesh.Trimesh, name: str, colour: tuple[int, ...]) -> None:
    material = PBRMaterial(
        name=name,
        baseColorFactor=colour,
        metallicFactor=0.0,
        roughnessFactor=0.9,
        alphaMode="BLEND" if colour[3] < 255 else "OPAQUE",
    )
    mesh.visual = trimesh.visual.TextureVisuals(material=material)
    graph.add_geometry(mesh, node_name=name, geom_name=name)

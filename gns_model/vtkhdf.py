"""Trajectories for ParaView: VTKHDF files, one temporal PolyData with grains and baffles.

VTKHDF is VTK's own format on HDF5 (https://docs.vtk.org/en/latest/vtk_file_formats/
vtkhdf_file_format/vtkhdf_specifications.html); ParaView 5.12 and newer open it, with the time bar.
The frames lie one after another in flat arrays, and the group `Steps` says where each begins:

    /VTKHDF                    attributes Version = (2, 0), Type = "PolyData"
    /VTKHDF/Points             (T (N + 8 B), 3) float32 [m]: grains, then the baffles' corners
    /VTKHDF/Vertices, Lines, Polygons, Strips
                               cells of each kind: one vertex a grain, six polygons a baffle;
                               written once, since every frame has the same
    /VTKHDF/PointData          velocity [m/s] and speed [m/s], differences of the frames, and
                               particle_type, -1 for a baffle's corners
    /VTKHDF/Steps              Values (T,) float64 [s] and the offsets

Coordinates are the scene's own: x downstream, y up, z across; a 2D flow lies at z = 0 with baffles
as rectangles there. Grains of the paper's kind that stand still (type 3) are in the file too.
"""

from __future__ import annotations

import io
import os
from pathlib import Path

import h5py
import numpy as np

from gns_model.errors import FileFormatError
from gns_model.files import write_whole
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory

VERSION = (2, 0)
#: Kinds of cells of a PolyData, in the order in which VTK counts them.
TOPOLOGIES = ("Vertices", "Lines", "Polygons", "Strips")
#: `particle_type` of the corners of a baffle, which are no grains.
CORNER = -1

#: The faces of a box by its corners, numbered with x slowest and z fastest; seen from outside.
_FACES_3D = np.array(
    [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
)
_FACES_2D = np.array([[0, 2, 3, 1]])


def check_name(path: str | os.PathLike[str]) -> None:
    """Refuse, before a long rollout, a name by which ParaView would not know the format.

    Raises:
        FileFormatError: if it ends in neither .vtkhdf nor .hdf.
    """
    if Path(path).suffix.lower() not in (".vtkhdf", ".hdf"):
        raise FileFormatError(f"{path}: a file for ParaView is to be named *.vtkhdf")


def save_vtkhdf(trajectory: Trajectory, path: str | os.PathLike[str]) -> None:
    """Write a trajectory as a temporal PolyData, whole or not at all.

    Raises:
        OSError: if the file cannot be written.
    """
    frames, grains, dim = trajectory.positions.shape
    corners, faces = _baffles(trajectory.scene)
    points = grains + len(corners)
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = np.array(VERSION, np.int64)
        # The specification wants a fixed-length ASCII string.
        root.attrs.create("Type", b"PolyData", dtype=h5py.string_dtype("ascii", len("PolyData")))
        positions = np.zeros((frames, points, 3), np.float32)
        positions[:, :grains, :dim] = trajectory.positions
        positions[:, grains:] = corners
        root["Points"] = positions.reshape(-1, 3)
        root["NumberOfPoints"] = np.full(frames, points, np.int64)
        for name in TOPOLOGIES:
            cells = {
                "Vertices": np.arange(grains)[:, None],
                "Polygons": grains + faces,
            }.get(name, np.zeros((0, 1), np.int64))
            _write_cells(root.create_group(name), cells, frames)
        data = root.create_group("PointData")
        velocity = _velocity(trajectory, positions[:, :grains])
        velocity = np.concatenate([velocity, np.zeros((frames, len(corners), 3))], axis=1)
        data["velocity"] = velocity.reshape(-1, 3).astype(np.float32)
        data["speed"] = np.linalg.norm(velocity, axis=2).ravel().astype(np.float32)
        types = np.concatenate([trajectory.particle_type, np.full(len(corners), CORNER)])
        data["particle_type"] = types.astype(np.int8)
        _write_steps(root, trajectory.time, points, list(data))
    write_whole(Path(path), buffer.getbuffer())


def _write_cells(group: h5py.Group, cells: np.ndarray, frames: int) -> None:
    """Cells (C, corners of each) into a group, once for all frames: their offsets stay at 0."""
    count, size = cells.shape
    group["Connectivity"] = cells.ravel().astype(np.int64)
    group["Offsets"] = np.arange(count + 1, dtype=np.int64) * size
    group["NumberOfCells"] = np.full(frames, count, np.int64)
    group["NumberOfConnectivityIds"] = np.full(frames, cells.size, np.int64)


def _write_steps(root: h5py.Group, time: np.ndarray, points: int, names: list[str]) -> None:
    """Where each frame begins in the flat arrays."""
    frames = len(time)
    begin = np.arange(frames, dtype=np.int64)
    steps = root.create_group("Steps")
    steps.attrs["NSteps"] = np.int64(frames)
    steps["Values"] = np.asarray(time, np.float64)
    steps["PartOffsets"] = begin
    steps["NumberOfParts"] = np.ones(frames, np.int64)
    steps["PointOffsets"] = begin * points
    still = np.zeros((frames, len(TOPOLOGIES)), np.int64)
    steps["CellOffsets"] = still
    steps["ConnectivityIdOffsets"] = still
    offsets = steps.create_group("PointDataOffsets")
    for name in names:
        offsets[name] = begin * (0 if name == "particle_type" else points)


def _velocity(trajectory: Trajectory, positions: np.ndarray) -> np.ndarray:
    """Central differences over time [m/s], one-sided at both ends, shape (T, N, 3)."""
    if len(positions) < 2:
        return np.zeros(positions.shape)
    return np.gradient(positions.astype(np.float64), np.asarray(trajectory.time), axis=0)


def _baffles(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Corners (P, 3) [m] and faces (F, 4) of the baffles of a scene."""
    boxes, turns = scene.oriented_boxes()
    unit = np.stack(np.meshgrid(*[[0, 1]] * scene.dim, indexing="ij"), -1).reshape(-1, scene.dim)
    corners = np.zeros((len(boxes), len(unit), 3))
    for k, (low, high) in enumerate(boxes):
        corners[k, :, : scene.dim] = np.where(unit == 1, high, low)
        cosine, sine = turns[k]
        if sine:
            middle = (low + high)[[0, 2]] / 2
            x, z = (corners[k][:, [0, 2]] - middle).T
            corners[k][:, 0] = middle[0] + cosine * x - sine * z
            corners[k][:, 2] = middle[1] + sine * x + cosine * z
    each = _FACES_3D if scene.dim == 3 else _FACES_2D
    faces = each[None] + len(unit) * np.arange(len(boxes))[:, None, None]
    return corners.reshape(-1, 3), faces.reshape(-1, 4)

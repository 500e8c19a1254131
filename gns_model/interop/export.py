"""Trajectories of ours, or imported ones, as a dataset that geoelements/gns reads."""

from __future__ import annotations

import io
import json
import math
import os
import pickle
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gns_model.errors import FileFormatError
from gns_model.files import write_whole
from gns_model.interop.metadata import Metadata, read_json
from gns_model.learned.config import ModelConfig
from gns_model.learned.world import baffle_points, baffle_poses
from gns_model.particles import STATIONARY
from gns_model.trajectory import Trajectory, open_trajectory

Progress = Callable[[int, int], None]


def export_dataset(
    folder: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    radius: float | None = None,
    frames: int | None = None,
    progress: Progress | None = None,
) -> bool:
    """Write the trajectories of a folder into one npz, and `metadata.json` beside it.

    Baffles become stationary points, as in the paper. The material property, tan of the friction
    angle, is written where it was imported or where the trajectories differ in it. A metadata file
    that is there already is kept: it has the statistics of the training data, which hold for a
    `valid.npz` too.

    Args:
        folder: of trajectory files (`*.h5`).
        out: the npz to write.
        radius: connectivity radius for the metadata [m]; default: that of an imported dataset, or
            the paper's in proportion to the spacing.
        frames: number of first frames to write of every trajectory; default: all, and then all
            have to have as many, since `sequence_length` holds for the whole dataset.
        progress: called with the number of trajectories done and to do.

    Returns:
        whether it wrote the metadata file.

    Raises:
        FileFormatError: if there are no trajectories, or they differ in dimension, frames or dt,
            or one has fewer frames than `frames`, or the metadata that is kept says another number.
    """
    folder, out = Path(folder), Path(out)
    paths = sorted(p for p in folder.glob("*.h5") if not p.name.startswith("."))
    if not paths:
        raise FileFormatError(f"{folder}: no trajectory files (*.h5) in this folder")
    beside = out.parent / "metadata.json"
    if frames is not None and beside.exists():
        kept = read_json(beside).get("sequence_length")
        if kept != frames:
            raise FileFormatError(
                f"{beside}: sequence_length = {kept}, but {frames} frames asked for"
            )
    material = _with_material(paths)
    sums = _Sums()
    out.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=out.parent, prefix=f".{out.name}.")
    names: set[str] = set()
    try:
        with os.fdopen(handle, "wb") as file, zipfile.ZipFile(file, "w") as archive:
            for number, path in enumerate(paths):
                trajectory = _first_frames(Trajectory.load(path), frames, path)
                positions, kinds, friction = _parts(trajectory)
                sums.add(trajectory, path)
                key = str(trajectory.settings.get("key", path.stem))
                name = path.stem if key in names or not key.isidentifier() else key
                names.add(name)
                parts = [positions, kinds, friction][: 3 if material else 2]
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    member.write(object_array(parts))
                if progress is not None:
                    progress(number + 1, len(paths))
        os.chmod(temporary, 0o644)
        os.replace(temporary, out)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    if beside.exists():
        return False
    if (folder / "metadata.json").exists():
        values = read_json(folder / "metadata.json")
    else:
        values = sums.metadata(radius, material).keys()
    if radius is not None:
        values["default_connectivity_radius"] = radius
    if frames is not None:
        values["sequence_length"] = frames
    write_whole(beside, (json.dumps(values, indent=2) + "\n").encode())
    return True


def _first_frames(trajectory: Trajectory, frames: int | None, path: Path) -> Trajectory:
    """The first `frames` of a trajectory; all of it without.

    Raises:
        FileFormatError: naming the file, if it has fewer.
    """
    if frames is None:
        return trajectory
    if len(trajectory.time) < frames:
        raise FileFormatError(
            f"{path}: {len(trajectory.time)} frames, fewer than the {frames} asked for"
        )
    return replace(
        trajectory, positions=trajectory.positions[:frames], time=trajectory.time[:frames]
    )


def object_array(parts: list[Any]) -> bytes:
    """An npy file of an object array of `parts`, as every NumPy from 1.x on reads it.

    NumPy 2 names functions of `numpy._core` in its pickles, which older versions do not have, while
    all versions know them as `numpy.core`.
    """
    array = np.empty(len(parts), dtype=object)
    for k, part in enumerate(parts):
        array[k] = part
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(array))
    # Protocol 3 writes the name as text, and once: before any array's bytes.
    pickled = pickle.dumps(array, protocol=3)
    name = b"\x80\x03cnumpy.core.multiarray\n"
    file.write(pickled.replace(b"\x80\x03cnumpy._core.multiarray\n", name, 1))
    return file.getvalue()


def _with_material(paths: list[Path]) -> bool:
    """Whether a material property is known of some trajectory, or tells them apart."""
    angles = set()
    for path in paths:
        with open_trajectory(path) as file:
            if "tan_friction" in file:
                return True
            if not file.attrs.get("foreign", False):
                angles.add(json.loads(file.attrs["scene"])["material"]["friction_angle"])
    return len(angles) > 1


def _parts(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (T, N, D), types (N,) and tan of the friction angle (N,), baffles as points."""
    positions, kinds = trajectory.positions, trajectory.particle_type.astype(np.int64)
    friction = trajectory.tan_friction
    if friction is None:
        angle = math.radians(trajectory.scene.material.friction_angle)
        friction = np.full(len(kinds), math.tan(angle), np.float32)
    if trajectory.scene.baffles:
        spacing = trajectory.point_volume ** (1 / trajectory.scene.dim)
        boxes, turns = baffle_poses(trajectory.scene, dtype=torch.float64)
        fixed = baffle_points(boxes, spacing, turns).numpy().astype(np.float32)
        still = np.broadcast_to(fixed, (len(positions), *fixed.shape))
        positions = np.concatenate([positions, still], axis=1)
        kinds = np.concatenate([kinds, np.full(len(fixed), STATIONARY)])
        friction = np.concatenate([friction, np.full(len(fixed), friction[0], np.float32)])
    return positions, kinds, friction


class _Sums:
    """What metadata says of all trajectories together."""

    def __init__(self) -> None:
        self.moments = np.zeros((4, 0))
        self.counts = np.zeros((2, 1))
        self.first: tuple[Path, int, int, float] | None = None
        self.low = self.high = np.zeros(0)
        self.spacing = 0.0

    def add(self, trajectory: Trajectory, path: Path) -> None:
        frames, _, dim = trajectory.positions.shape
        dt = float(trajectory.time[1] - trajectory.time[0]) if frames > 1 else 0.0
        low, high = np.array(trajectory.scene.domain.lower), np.array(trajectory.scene.domain.upper)
        if self.first is None:
            self.first = (path, frames, dim, dt)
            self.moments = np.zeros((4, dim))
            self.low, self.high = low, high
            self.spacing = trajectory.point_volume ** (1 / dim)
        _, *wanted = self.first
        if [frames, dim] != wanted[:2] or abs(dt - self.first[3]) > 1e-6 * self.first[3]:
            raise FileFormatError(
                f"{path}: {frames} frames in {dim}D, {dt:g} s apart, but {self.first[0].name} has "
                f"{self.first[1]} in {self.first[2]}D, {self.first[3]:g} s apart: one dataset "
                "has one of each (frames=N, or --frames N, writes the first N of every one)"
            )
        self.low, self.high = np.minimum(self.low, low), np.maximum(self.high, high)
        moving = trajectory.particle_type != STATIONARY
        velocity = np.diff(trajectory.positions[:, moving].astype(np.float64), axis=0)
        acceleration = np.diff(velocity, axis=0)
        for k, values in enumerate((velocity, acceleration)):
            self.moments[2 * k] += values.sum((0, 1))
            self.moments[2 * k + 1] += np.square(values).sum((0, 1))
            self.counts[k] += values.shape[0] * values.shape[1]

    def metadata(self, radius: float | None, material: bool) -> Metadata:
        """The metadata of all that was added."""
        assert self.first is not None
        path, frames, dim, dt = self.first
        if dt == 0 or not self.counts.all():
            raise FileFormatError(f"{path}: {frames} frames are too few for velocities")
        mean = self.moments[::2] / self.counts
        std = np.sqrt(np.maximum(0, self.moments[1::2] / self.counts - mean**2))
        paper = ModelConfig.paper(dim)  # type: ignore[arg-type]
        return Metadata(
            dim=dim,  # type: ignore[arg-type]
            bounds=tuple(zip(map(float, self.low), map(float, self.high), strict=True)),
            default_connectivity_radius=radius or paper.radius * self.spacing / paper.spacing,
            sequence_length=frames,
            vel_mean=tuple(mean[0]),
            vel_std=tuple(std[0]),
            acc_mean=tuple(mean[1]),
            acc_std=tuple(std[1]),
            dt=dt,
            nnode_in=paper.vertex_inputs + paper.type_embedding + material,
            nedge_in=paper.edge_inputs,
        )

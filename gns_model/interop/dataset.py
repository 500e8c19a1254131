"""Datasets of geoelements/gns: read from npz or HDF5, checked, and made into trajectories of ours.

A trajectory of theirs is positions (T, N, D), a particle type (one, or one a point) and, in some
datasets, a material property (one, or one a point), the tangent of the friction angle. An npz has
one key for each, or a single `gns_data` for all; an HDF5 file has one group for each.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gns_model.errors import FileFormatError
from gns_model.files import write_whole
from gns_model.interop.arrays import count_npz, read_npz
from gns_model.interop.metadata import Metadata, Section, checked
from gns_model.interop.releases import point_spacing, scene_of
from gns_model.particles import STATIONARY
from gns_model.trajectory import Trajectory

#: Positions this part of the longest edge outside of the bounds are not of that domain: noise and
#: moving walls leave it by less.
OUTSIDE = 0.25

#: Statistics this many times off are in another unit.
OTHER_UNIT = 20.0

#: Particle types are stored in a byte.
LARGEST_TYPE = 127


@dataclass(frozen=True)
class ForeignTrajectory:
    """One trajectory of a dataset.

    Attributes:
        name: its key in the file.
        positions: [m], shape (T, N, D) float32.
        particle_type: shape (N,) int64; 3 is stationary.
        material: tan of the friction angle of every point, shape (N,) float32, or None.
    """

    name: str
    positions: np.ndarray
    particle_type: np.ndarray
    material: np.ndarray | None

    @property
    def moving(self) -> np.ndarray:
        """Mask of the points that move, shape (N,)."""
        return self.particle_type != STATIONARY


def import_dataset(
    path: str | os.PathLike[str],
    metadata: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    section: Section = "train",
    dt: float | None = None,
    spacing: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Make every trajectory of a dataset one of ours, in a folder that `gns-model train` reads.

    Args:
        path: `train.npz`, or an HDF5 file.
        metadata: `metadata.json`.
        out: folder to make; gets one file a trajectory and, last, a `metadata.json`.
        section: of a split metadata.
        dt: between frames [s], where the metadata has none.
        spacing: of the points [m]; default: as the first frame shows.
        progress: called with the number of trajectories done and to do.

    Returns:
        the files, in order.

    Raises:
        FileFormatError: one line, if a file cannot be read safely or arrays and metadata disagree.
    """
    about, out = Metadata.read(metadata, section).with_dt(dt), Path(out)
    if spacing is not None:
        checked("spacing", spacing, "m")
    if (out / "metadata.json").exists():
        raise FileFormatError(f"{out}: already holds a dataset; give another folder")
    paths: list[Path] = []
    total = count_dataset(path)
    for number, found in enumerate(read_dataset(path)):
        _check(found, about, path, metadata)
        if number == 0:
            _compare_units(found, about, metadata)
            if about.dt is None:
                warnings.warn(f"{metadata}: has no dt; taken as {about.stride:g} s", stacklevel=2)
            spacing = spacing or point_spacing(
                found.positions[0, found.moving], about.default_connectivity_radius
            )
        ours = _trajectory(found, about, Path(path), spacing or about.usual_spacing)
        paths.append(out / f"trajectory-{number:05d}.h5")
        ours.save(paths[-1])
        if progress is not None:
            progress(number + 1, max(total, number + 1))
    if not paths:
        raise FileFormatError(f"{path}: holds no trajectories")
    text = json.dumps(about.keys(), indent=2) + "\n"
    write_whole(out / "metadata.json", text.encode())
    return paths


def count_dataset(path: str | os.PathLike[str]) -> int:
    """Number of trajectories in a file; for an npz with one key for all, 1.

    Raises:
        FileFormatError: if it is missing, truncated or foreign.
    """
    if not _is_hdf5(path):
        return count_npz(path)
    try:
        with h5py.File(path, "r") as file:
            return len(file)
    except (OSError, RuntimeError):
        raise FileFormatError(f"{path}: truncated, or not HDF5") from None


def read_dataset(path: str | os.PathLike[str]) -> Iterator[ForeignTrajectory]:
    """The trajectories in an npz or HDF5 file, one after the other.

    Raises:
        FileFormatError: one line that names the file and the trajectory.
    """
    entries = _read_hdf5(path) if _is_hdf5(path) else _entries(path)
    for name, parts in entries:
        try:
            yield _foreign(name, parts)
        except (ValueError, TypeError, IndexError) as error:
            raise FileFormatError(f"{path}: trajectory {name!r}: {error}") from None


def _is_hdf5(path: str | os.PathLike[str]) -> bool:
    return Path(path).is_file() and bool(h5py.is_hdf5(path))


def _entries(path: str | os.PathLike[str]) -> Iterator[tuple[str, Any]]:
    """Names and parts of every trajectory in an npz, in either layout."""
    for name, content in read_npz(path):
        if name != "gns_data":
            yield name, content
            continue
        if not isinstance(content, np.ndarray) or content.dtype != object or content.ndim == 0:
            raise FileFormatError(f"{path}: {name!r} is no list of trajectories")
        for k, entry in enumerate(content):
            yield f"{name}[{k}]", entry


def _read_hdf5(path: str | os.PathLike[str]) -> Iterator[tuple[str, Any]]:
    keys = ("positions", "particle_type", "material_property")
    name = ""
    try:
        with h5py.File(path, "r") as file:
            for name in file:
                group = file[name]
                if not isinstance(group, h5py.Group) or not set(keys[:2]) <= set(group):
                    raise FileFormatError(
                        f"{path}: {name!r} is no group with positions and particle_type"
                    )
                parts = [group[key] for key in keys if key in group]
                if not all(isinstance(p, h5py.Dataset) and p.dtype.kind in "biuf" for p in parts):
                    raise FileFormatError(f"{path}: {name!r} holds something other than numbers")
                yield name, [part[()] for part in parts]
    except FileFormatError:
        raise
    except (OSError, RuntimeError, KeyError, ValueError) as error:
        where = f"{name!r} is " if name else ""
        raise FileFormatError(
            f"{path}: {where}truncated, or not HDF5 ({' '.join(str(error).split())[:80]})"
        ) from None


def _foreign(name: str, parts: Any) -> ForeignTrajectory:
    """Check one entry; raises ValueError with what is wrong."""
    if isinstance(parts, np.ndarray) and parts.shape == () and parts.dtype == object:
        parts = parts[()]
    if isinstance(parts, np.ndarray) and parts.dtype != object:
        raise ValueError(
            f"an array of numbers of shape {parts.shape} instead of positions and particle type"
        )
    if not 2 <= len(parts) <= 3:
        raise ValueError(
            f"{len(parts)} parts instead of positions, particle type and perhaps material"
        )
    positions = _dense(parts[0], "positions")
    if positions.ndim != 3 or positions.dtype.kind != "f":
        raise ValueError(
            f"positions are {positions.dtype} of shape {positions.shape}, not floats (T, N, D)"
        )
    positions = np.asarray(positions, np.float32)
    points = positions.shape[1]
    if min(positions.shape) < 1 or not np.isfinite(positions).all():
        raise ValueError(f"positions of shape {positions.shape} are empty or not finite")
    kinds = _per_point(parts[1], points, "particle type")
    if not ((kinds >= 0) & (kinds <= LARGEST_TYPE) & (kinds == np.floor(kinds))).all():
        raise ValueError(f"particle types must be integers in 0..{LARGEST_TYPE}")
    material = None
    if len(parts) == 3:
        material = _per_point(parts[2], points, "material property").astype(np.float32)
        if not np.isfinite(material).all():
            raise ValueError("material property is not finite")
    return ForeignTrajectory(name, positions, kinds.astype(np.int64), material)


def _dense(value: Any, what: str) -> np.ndarray:
    """An array of numbers, also of what NumPy broke up into an array of arrays."""
    array = np.asarray(value)
    if array.dtype == object:
        array = np.stack([np.asarray(row) for row in array.ravel()]) if array.size else array
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{what} holds {array.dtype}, not numbers")
    return array


def _per_point(value: Any, points: int, what: str) -> np.ndarray:
    array = _dense(value, what)
    if array.size == 1:
        return np.full(points, array.reshape(()))
    if array.size != points:
        raise ValueError(f"{what} has shape {array.shape}, but there are {points} points")
    return array.reshape(points)


def _check(
    found: ForeignTrajectory,
    about: Metadata,
    path: str | os.PathLike[str],
    metadata: str | os.PathLike[str],
) -> None:
    """Refuse a trajectory that its metadata does not describe."""

    def disagree(told: str, seen: str) -> FileFormatError:
        return FileFormatError(f"{metadata}: {told}, but {found.name!r} in {path} {seen}")

    frames, _, dim = found.positions.shape
    if dim != about.dim:
        raise disagree(f"dim = {about.dim}", f"is {dim}D")
    # DeepMind's files count steps, with one frame more.
    if frames not in (about.sequence_length, about.sequence_length + 1):
        raise disagree(f"sequence_length = {about.sequence_length}", f"has {frames} frames")
    bounds = np.array(about.bounds)
    slack = OUTSIDE * np.ptp(bounds, axis=1).max()
    low, high = found.positions.min((0, 1)), found.positions.max((0, 1))
    for axis, (lower, upper) in enumerate(bounds):
        if low[axis] < lower - slack or high[axis] > upper + slack:
            raise disagree(
                f"bounds of {'xyz'[axis]} are {lower:g} to {upper:g} m",
                f"reaches from {low[axis]:g} to {high[axis]:g} m",
            )


def _compare_units(
    found: ForeignTrajectory, about: Metadata, metadata: str | os.PathLike[str]
) -> None:
    """Warn of statistics per second, which a converter of geoelements/gns writes."""
    if len(found.positions) < 2 or not found.moving.any():
        return
    shown = float(np.diff(found.positions[:, found.moving], axis=0).std())
    told = float(np.sqrt(np.mean(np.square(about.vel_std))))
    if shown > 0 and told > 0 and not 1 / OTHER_UNIT < told / shown < OTHER_UNIT:
        warnings.warn(
            f"{metadata}: vel_std is {told:.3g} m/step and {found.name!r} shows {shown:.3g}: "
            "perhaps per second? Training measures its own",
            stacklevel=3,
        )


def _trajectory(
    found: ForeignTrajectory, about: Metadata, path: Path, spacing: float
) -> Trajectory:
    return Trajectory(
        positions=found.positions,
        time=np.arange(len(found.positions)) * about.stride,
        particle_type=found.particle_type.astype(np.int8),
        scene=scene_of(found, about, spacing),
        point_volume=spacing**about.dim,
        simulator="imported",
        settings={"file": path.name, "key": found.name, "spacing": spacing},
        tan_friction=found.material,
        foreign=True,
    )

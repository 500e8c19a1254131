"""What a simulator returns: positions over time, and how it went. HDF5 in and out.

File format `gns-trajectory`, version 1 (HDF5; nothing in it is pickled):

    /                attributes: format, version, simulator, status, point_volume [m^D], frames
                     (written last: a file without it is truncated), scene (TOML-like JSON),
                     settings (JSON: spacing, time step, ... of the simulator)
    /positions       (T, N, D) float32 [m], one chunk a frame
    /time            (T,) float64 [s]
    /particle_type   (N,) int8
    /lattice         (N, D) int32, optional: where the point sat in its release
    /tan_friction    (N,) float32, optional: of every point, where it is not the scene's
    /                attribute foreign, optional, true: the points came from elsewhere, and are not
                     those that the scene's releases are filled with
"""

from __future__ import annotations

import io
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gns_model.errors import FileFormatError
from gns_model.files import write_whole
from gns_model.scene import Scene

FORMAT = "gns-trajectory"
VERSION = 1

#: How a rollout ended. Failure is data: a search counts it and goes on.
OK, DIVERGED, INTERRUPTED = "ok", "diverged", "interrupted"


@dataclass
class Trajectory:
    """Positions of material points over time.

    Attributes:
        positions: [m], shape (T, N, D).
        time: [s], shape (T,).
        particle_type: shape (N,); 6 moves.
        scene: what was simulated.
        point_volume: volume of one point, [m³] or in 2D [m²].
        simulator: name of the simulator.
        status: "ok", "diverged" or "interrupted". After a divergence the last finite frame is
            repeated, so that positions are finite always.
        settings: spacing, time step, seconds spent and other matters of the simulator.
        lattice: shape (N, D), where each point sat in its release, or None.
        tan_friction: tan of the friction angle of every point, shape (N,), where it is not the
            scene's, or None.
        foreign: the points are not those that the scene's releases are filled with.
    """

    positions: np.ndarray
    time: np.ndarray
    particle_type: np.ndarray
    scene: Scene
    point_volume: float
    simulator: str = ""
    status: str = OK
    settings: dict[str, Any] = field(default_factory=dict)
    lattice: np.ndarray | None = None
    tan_friction: np.ndarray | None = None
    foreign: bool = False

    @property
    def point_mass(self) -> float:
        """Mass of one point: [kg], in 2D [kg] per metre of width."""
        return self.point_volume * self.scene.material.density

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the trajectory whole: under a temporary name, then renamed.

        The file is composed in memory first: HDF5 crashes the process when a disk fills up under
        an open file, whereas a plain write raises OSError.
        """
        buffer = io.BytesIO()
        with h5py.File(buffer, "w") as file:
            frames = np.ascontiguousarray(self.positions, dtype=np.float32)
            file.create_dataset(
                "positions", data=frames, chunks=(1, *frames.shape[1:]) if frames.size else None
            )
            file["time"] = np.asarray(self.time, dtype=np.float64)
            file["particle_type"] = np.asarray(self.particle_type, dtype=np.int8)
            if self.lattice is not None:
                file["lattice"] = np.asarray(self.lattice, dtype=np.int32)
            if self.tan_friction is not None:
                file["tan_friction"] = np.asarray(self.tan_friction, dtype=np.float32)
            if self.foreign:
                file.attrs["foreign"] = True
            file.attrs.update(
                format=FORMAT,
                version=VERSION,
                simulator=self.simulator,
                status=self.status,
                point_volume=self.point_volume,
                scene=json.dumps(self.scene.to_dict()),
                settings=json.dumps(self.settings),
            )
            file.attrs["frames"] = len(self.time)
        write_whole(Path(path), buffer.getbuffer())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Trajectory:
        """Read a trajectory file.

        Raises:
            FileFormatError: if it is missing, truncated, foreign or of a newer version.
        """
        with open_trajectory(path) as file:
            try:
                return cls(
                    positions=file["positions"][()],
                    time=file["time"][()],
                    particle_type=file["particle_type"][()],
                    scene=Scene.from_dict(_json(file, "scene"), source="scene"),
                    point_volume=_read(file, "point_volume", float),
                    simulator=_read(file, "simulator", str),
                    status=_read(file, "status", str),
                    settings=_json(file, "settings"),
                    lattice=file["lattice"][()] if "lattice" in file else None,
                    tan_friction=file["tan_friction"][()] if "tan_friction" in file else None,
                    foreign=bool(file.attrs.get("foreign", False)),
                )
            except _DAMAGE as error:
                raise FileFormatError(f"{path}: damaged or foreign ({_line(error)})") from None


def open_trajectory(path: str | os.PathLike[str]) -> h5py.File:
    """Open a trajectory file for reading frame by frame, after checking that it is whole.

    Raises:
        FileFormatError: if it is missing, truncated, foreign or of a newer version.
    """
    path = Path(path)
    if not path.is_file():
        raise FileFormatError(f"{path}: no such file")
    try:
        file = h5py.File(path, "r")
    except _DAMAGE:
        raise FileFormatError(f"{path}: truncated, or not an HDF5 file") from None
    try:
        if _read(file, "format", str, default="") != FORMAT:
            raise FileFormatError(f"{path}: an HDF5 file, but not a {FORMAT} file")
        version = _read(file, "version", int)
        if version > VERSION:
            raise FileFormatError(f"{path}: version {version}, this program reads up to {VERSION}")
        frames = _read(file, "frames", int)
        shapes = {name: file[name].shape for name in ("positions", "time", "particle_type")}
        points = shapes["positions"][1:2]
        if shapes["positions"][:1] != (frames,) or shapes["time"] != (frames,):
            raise FileFormatError(
                f"{path}: truncated, holds {shapes['positions'][0]} of {frames} frames"
            )
        if len(shapes["positions"]) != 3 or shapes["particle_type"] != points:
            raise FileFormatError(f"{path}: positions and particle_type do not fit: {shapes}")
    except FileFormatError:
        file.close()
        raise
    except _DAMAGE as error:
        file.close()
        raise FileFormatError(f"{path}: truncated or foreign ({_line(error)})") from None
    return file


#: What HDF5, JSON and NumPy raise on damaged content.
_DAMAGE = (
    OSError,
    KeyError,
    IndexError,
    ValueError,
    TypeError,
    RuntimeError,
    MemoryError,
    AttributeError,
)


def _read(file: h5py.File, name: str, kind: type, **default: Any) -> Any:
    """The attribute `name` as `kind`; a fault names the attribute."""
    if "default" in default and name not in file.attrs:
        return default["default"]
    try:
        return kind(file.attrs[name])
    except _DAMAGE:
        raise ValueError(f"no readable attribute {name!r}") from None


def _json(file: h5py.File, name: str) -> Any:
    try:
        return json.loads(_read(file, name, str))
    except ValueError:
        raise ValueError(f"attribute {name!r} is not readable JSON") from None


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__

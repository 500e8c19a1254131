"""What a simulator returns: positions over time, and how it went. HDF5 in and out.

File format `gns-trajectory`, version 1 (HDF5; nothing in it is pickled):

    /                attributes: format, version, simulator, status, point_volume [m^D], frames
                     (written last: a file without it is truncated), scene (TOML-like JSON),
                     settings (JSON: spacing, time step, ... of the simulator)
    /positions       (T, N, D) float32 [m], one chunk a frame
    /time            (T,) float64 [s]
    /particle_type   (N,) int8
    /lattice         (N, D) int32, optional: where the point sat in its release
"""

from __future__ import annotations

import json
import os
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gns_model.errors import FileFormatError
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

    @property
    def point_mass(self) -> float:
        """Mass of one point: [kg], in 2D [kg] per metre of width."""
        return self.point_volume * self.scene.material.density

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the trajectory whole: under a temporary name, then renamed."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        os.close(handle)
        try:
            with h5py.File(temporary, "w") as file:
                frames = np.ascontiguousarray(self.positions, dtype=np.float32)
                file.create_dataset(
                    "positions", data=frames, chunks=(1, *frames.shape[1:]) if frames.size else None
                )
                file["time"] = np.asarray(self.time, dtype=np.float64)
                file["particle_type"] = np.asarray(self.particle_type, dtype=np.int8)
                if self.lattice is not None:
                    file["lattice"] = np.asarray(self.lattice, dtype=np.int32)
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
            os.chmod(temporary, 0o644)
            os.replace(temporary, path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Trajectory:
        """Read a trajectory file.

        Raises:
            FileFormatError: if it is missing, truncated, foreign or of a newer version.
        """
        with open_trajectory(path) as file:
            attributes = file.attrs
            return cls(
                positions=file["positions"][()],
                time=file["time"][()],
                particle_type=file["particle_type"][()],
                scene=Scene.from_dict(json.loads(attributes["scene"]), source=str(path)),
                point_volume=float(attributes["point_volume"]),
                simulator=str(attributes["simulator"]),
                status=str(attributes["status"]),
                settings=json.loads(attributes["settings"]),
                lattice=file["lattice"][()] if "lattice" in file else None,
            )


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
    except OSError:
        raise FileFormatError(f"{path}: truncated, or not an HDF5 file") from None
    try:
        if file.attrs.get("format") != FORMAT:
            raise FileFormatError(f"{path}: an HDF5 file, but not a {FORMAT} file")
        if int(file.attrs["version"]) > VERSION:
            raise FileFormatError(
                f"{path}: version {file.attrs['version']}, this program reads up to {VERSION}"
            )
        frames = file.attrs.get("frames")
        shape = file["positions"].shape
        if frames is None or shape[0] != frames or file["time"].shape != (frames,):
            raise FileFormatError(f"{path}: truncated, holds {shape[0]} of {frames} frames")
    except (KeyError, FileFormatError) as error:
        file.close()
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(f"{path}: {error.args[0]}, so it is truncated or foreign") from None
    return file

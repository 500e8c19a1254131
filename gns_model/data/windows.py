"""Training windows: short runs of frames, read lazily from a folder of trajectory files.

The files come from the reference solver at a fine spacing; a learned model works at `ratio` times
that spacing and `stride` times their frame interval. The points whose lattice coordinates agree
modulo `ratio` form a lattice of the model's spacing, so every file holds ratio^D sets of tracers
of one and the same flow. They do not travel alike: sets that start half a spacing higher ran up to
15% farther. A mixture of them, one random point of the solver in each cell of the model, moves as
the whole does; that is what training draws.

A window may begin at the first frame: history before t = 0 is the release velocity extended
backwards, exactly as a rollout of the learned simulator begins.

Imported trajectories are foreign: their points are no lattice of a release, so all of them are
used, at the spacing that they have, and nothing is known of the time before the first frame.
Their stationary points are rows like all others.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import h5py
import numpy as np

from gns_model.data import halves
from gns_model.errors import FileFormatError, SceneError
from gns_model.particles import MOVING, STATIONARY, fill
from gns_model.scene import Scene
from gns_model.trajectory import OK, open_trajectory

#: How far a ratio of spacings or intervals may lie from an integer.
INTEGER_TOLERANCE = 0.01

#: How far the spacing of foreign points, which is an estimate, may lie from the model's.
FOREIGN_TOLERANCE = 0.15


@dataclass(frozen=True)
class Window:
    """One piece of training data.

    Attributes:
        history: positions [m], oldest first, one `dt` apart, shape (N, H+1, D) float32.
        future: the true positions [m] of the next K steps, shape (N, K, D) float32.
        scene: what flows, and around what.
        particle_type: shape (N,) int64; 3 is a kinematic point, others move. Default: all move.
        tan_friction: tan of the friction angle of every point, shape (N,) float32. Default: the
            scene's.
    """

    history: np.ndarray
    future: np.ndarray
    scene: Scene
    particle_type: np.ndarray = field(default=None)  # type: ignore[arg-type]
    tan_friction: np.ndarray = field(default=None)  # type: ignore[arg-type]

    def __post_init__(self) -> None:
        points = len(self.history)
        if self.particle_type is None:
            object.__setattr__(self, "particle_type", np.full(points, MOVING, np.int64))
        if self.tan_friction is None:
            tangent = math.tan(math.radians(self.scene.material.friction_angle))
            object.__setattr__(self, "tan_friction", np.full(points, tangent, np.float32))

    def reordered(self, order: np.ndarray) -> Window:
        """The same with its points in another order, shape (N,)."""
        return replace(
            self,
            history=self.history[order],
            future=self.future[order],
            particle_type=self.particle_type[order],
            tan_friction=self.tan_friction[order],
        )


@dataclass(frozen=True)
class Source:
    """One checked trajectory file, and which of its points belong to which tracer set."""

    path: Path
    scene: Scene
    frames: int  #: number of usable frames
    interval: float  #: between frames [s]
    residue: np.ndarray  #: tracer set of every point, shape (N,) uint8
    cell: np.ndarray  #: cell of the model that every point starts in, shape (N,) int32
    counts: tuple[int, ...]  #: points of every release, in order
    foreign: bool = False  #: imported: its points are not those of its scene
    particle_type: np.ndarray | None = None  #: of foreign points, shape (N,) int8
    tan_friction: np.ndarray | None = None  #: of foreign points, shape (N,), if it is known
    plane: float | None = None  #: see `halves.plane_of_symmetry`
    #: How far its points were moved off their lattice, in spacings of the model; 0, too, of foreign
    #: ones, whose lattice is not known.
    jitter: float = 0.0

    def points(self, residue: int) -> int:
        """Number of points in a tracer set."""
        return int(np.count_nonzero(self.residue == residue))

    def mixture(self, seed: int) -> np.ndarray:
        """Indices of one random point in every cell; a cell cut off by a face may have none."""
        sets = int(self.residue.max()) + 1
        pick = np.random.default_rng(seed).integers(0, sets, int(self.cell.max()) + 1)
        return np.flatnonzero(self.residue == pick[self.cell])

    def initial_velocity(self) -> np.ndarray:
        """Velocity of every point at t = 0 [m/s], shape (N, D)."""
        velocity = np.array([r.velocity for r in self.scene.releases], dtype=np.float32)
        return np.repeat(velocity, self.counts, axis=0)


class WindowIndex:
    """All windows of the trajectory files (`*.h5`) in one or more folders.

    Opening checks every file but reads no frames; what stays in memory is one byte a point.
    Trajectories that ended badly (status other than "ok") are left out; `skipped` says why.

    Args:
        folders: where the files are; each must hold at least one.
        spacing: of the model's points [m].
        dt: time step of the model [s].
        history: number of velocities that the model sees, H.
        unroll: number of future steps in a window, K.
        begin: steps of a flow in which no window begins; a rollout leaves them to the solver
            (`ModelConfig.solver_steps`), so a model need not know them. Not of foreign files.

    Raises:
        FileFormatError: for a missing or empty folder, and, naming the file, for one that is
            truncated or foreign, whose points are not those that its scene is filled with, or
            whose spacing or frame interval does not divide the model's.
    """

    def __init__(
        self,
        folders: Sequence[str | os.PathLike[str]],
        *,
        spacing: float,
        dt: float,
        history: int,
        unroll: int = 1,
        begin: int = 0,
    ) -> None:
        self.spacing, self.dt, self.history, self.unroll = spacing, dt, history, unroll
        self.begin = begin
        self.sources: list[Source] = []
        #: What no window is read from, and why.
        self.skipped: dict[Path, str] = {}
        for folder in map(Path, folders):
            paths = sorted(p for p in folder.glob("*.h5") if not p.name.startswith("."))
            if not paths:
                raise FileFormatError(f"{folder}: no trajectory files (*.h5) in this folder")
            for path in paths:
                source = read_source(path, spacing=spacing)
                if source is None:
                    self.skipped[path] = "ended badly"
                    continue
                self._stride(source)
                self.sources.append(source)
        if not self.sources:
            raise FileFormatError(f"{folders[0]}: every trajectory in it ended badly")
        dims = {s.scene.dim for s in self.sources}
        if len(dims) > 1:
            raise FileFormatError(f"{folders[0]}: 2D and 3D trajectories cannot train one model")
        self.dim = dims.pop()
        for k, source in enumerate(self.sources):
            if self.starts(k) < 1:
                needed = source.frames + 1 - self.starts(k)
                raise FileFormatError(
                    f"{source.path}: {source.frames} frames are too few, {unroll} steps of "
                    f"{dt:g} s need {needed}"
                    + (f", {begin} steps at the start left out" if begin else "")
                )

    def _stride(self, source: Source) -> int:
        return _multiple(self.dt, source.interval, source.path, "frame interval", "s")

    def stride(self, source: int) -> int:
        """Frames of a file in one step of the model."""
        return self._stride(self.sources[source])

    def residues(self, source: int) -> int:
        """Number of tracer sets in a file, ratio^D."""
        return int(self.sources[source].residue.max()) + 1

    def starts(self, source: int, unroll: int | None = None) -> int:
        """Number of frames in a file at which a window of `unroll` future steps can begin."""
        steps = self.unroll if unroll is None else unroll
        entry = self.sources[source]
        return entry.frames - self.first(source) - steps * self._stride(entry)

    def first(self, source: int) -> int:
        """The frame of a file that counts as frame 0: a foreign one needs a whole history first."""
        entry = self.sources[source]
        return (self.history if entry.foreign else self.begin) * self._stride(entry)

    def read(
        self,
        source: int,
        frame: int,
        residue: int = 0,
        *,
        mixture: int | None = None,
        unroll: int | None = None,
        half: bool = False,
    ) -> Window:
        """Read one window; only the frames that it needs leave the disk.

        Args:
            source: which file, 0 to len(sources) - 1.
            frame: the current frame, 0 to `starts(source) - 1`, counted from `first(source)`.
            residue: which tracer set, 0 to `residues(source) - 1`.
            mixture: seed of a mixture of the tracer sets, in place of one of them.
            unroll: number of future steps if it is not the index's.
            half: only what lies right of the plane of symmetry, which becomes a wall; see `halves`.

        Raises:
            FileFormatError: if the file has become unreadable since it was indexed.
        """
        entry = self.sources[source]
        steps = self.unroll if unroll is None else unroll
        if not 0 <= frame < self.starts(source, steps):
            raise IndexError(f"frame {frame} of {entry.path} has no {steps} frames after it")
        stride = self._stride(entry)
        if mixture is None:
            chosen = np.flatnonzero(entry.residue == residue)
        else:
            chosen = entry.mixture(mixture)
        frames = self.first(source) + frame + stride * np.arange(-self.history, steps + 1)
        out = np.empty((len(chosen), len(frames), self.dim), dtype=np.float32)
        try:
            with open_trajectory(entry.path) as file:
                positions = file["positions"]
                if half:
                    assert entry.plane is not None
                    chosen = chosen[positions[0][chosen][:, 0] > entry.plane]
                    out = out[: len(chosen)]
                for k in np.flatnonzero(frames >= 0):
                    out[:, k] = positions[frames[k]][chosen]
                if frames[0] < 0:
                    start = positions[0][chosen]
                    velocity = entry.initial_velocity()[chosen]
                    for k in np.flatnonzero(frames < 0):
                        out[:, k] = start + velocity * np.float32(frames[k] * entry.interval)
        except (OSError, KeyError, ValueError) as error:
            if isinstance(error, FileFormatError):
                raise
            raise FileFormatError(f"{entry.path}: unreadable at frame {frame} ({error})") from None
        scene = entry.scene
        if half and entry.plane is not None:
            # Points next to the plane may pass it by a hair, in turn with their mirror images.
            out[..., 0] = entry.plane + np.abs(out[..., 0] - np.float32(entry.plane))
            scene = halves.half(scene, entry.plane)
        split = self.history + 1
        kinds, friction = entry.particle_type, entry.tan_friction
        return Window(
            out[:, :split],
            out[:, split:],
            scene,
            particle_type=None if kinds is None else kinds[chosen].astype(np.int64),  # type: ignore[arg-type]
            tan_friction=None if friction is None else friction[chosen],  # type: ignore[arg-type]
        )


def read_source(path: Path, *, spacing: float) -> Source | None:
    """Check one file against its scene; None if the simulation in it ended badly.

    Raises:
        FileFormatError: see `WindowIndex`.
    """
    with open_trajectory(path) as file:
        try:
            if file.attrs["status"] != OK:
                return None
            scene = _scene_of(file, path)
            time = file["time"][()]
            shape = file["positions"].shape
            lattice = file["lattice"][()] if "lattice" in file else None
            kinds = file["particle_type"][()]
            volume = float(file.attrs["point_volume"])
            jitter = float(json.loads(file.attrs["settings"]).get("jitter", 0.0))
            foreign = bool(file.attrs.get("foreign", False))
            friction = file["tan_friction"][()] if "tan_friction" in file else None
        except (KeyError, OSError, TypeError, ValueError) as error:
            raise FileFormatError(f"{path}: truncated or foreign ({error})") from None
    if len(shape) != 3 or shape[2] != scene.dim or volume <= 0:
        raise FileFormatError(f"{path}: positions {shape} do not fit a {scene.dim}D scene")
    intervals = np.diff(time)
    if len(intervals) == 0 or intervals[0] <= 0 or np.ptp(intervals) > 1e-3 * intervals[0]:
        raise FileFormatError(f"{path}: its frames are not evenly spaced in time")
    file_spacing = volume ** (1 / scene.dim)
    if foreign:
        _check_foreign(path, kinds, friction, file_spacing, spacing)
        return Source(
            path=path,
            scene=scene,
            frames=shape[0],
            interval=float(intervals.mean()),
            residue=np.zeros(shape[1], np.uint8),
            cell=np.arange(shape[1], dtype=np.int32),
            counts=(shape[1],),
            foreign=True,
            particle_type=kinds,
            tan_friction=friction,
        )
    if (kinds != MOVING).any():
        raise FileFormatError(f"{path}: holds points that do not move; none can be trained on")
    try:
        points = fill(scene, file_spacing)
    except SceneError as error:
        raise FileFormatError(f"{path}: {error}") from None
    if len(points.positions) != shape[1] or (
        lattice is not None and not np.array_equal(lattice, points.lattice)
    ):
        raise FileFormatError(
            f"{path}: its {shape[1]} points are not those of its scene at {file_spacing:g} m, "
            f"which holds {len(points.positions)}"
        )
    ratio = _multiple(spacing, file_spacing, path, "spacing", "m")
    counts = tuple(
        len(fill(scene.model_copy(update={"releases": (release,)}), file_spacing).positions)
        for release in scene.releases
    )
    residue = np.zeros(shape[1], dtype=np.int64)
    release = np.repeat(np.arange(len(counts)), counts)
    corner = np.column_stack([release, points.lattice // ratio])
    cell = np.unique(corner, axis=0, return_inverse=True)[1].ravel()
    for axis in range(scene.dim):
        residue = residue * ratio + points.lattice[:, axis] % ratio
    if ratio**scene.dim > 256:
        raise FileFormatError(f"{path}: {ratio} times its spacing is too coarse a model")
    return Source(
        path=path,
        scene=scene,
        frames=shape[0],
        interval=float(intervals.mean()),
        residue=residue.astype(np.uint8),
        cell=cell.astype(np.int32),
        counts=counts,
        plane=halves.plane_of_symmetry(scene),
        jitter=jitter / ratio,
    )


def _check_foreign(
    path: Path, kinds: np.ndarray, friction: np.ndarray | None, has: float, wanted: float
) -> None:
    if (kinds == STATIONARY).all() or (friction is not None and friction.shape != kinds.shape):
        raise FileFormatError(f"{path}: particle_type and tan_friction do not fit a moving mass")
    if abs(has / wanted - 1) > FOREIGN_TOLERANCE:
        raise FileFormatError(
            f"{path}: imported points are about {has:.3g} m apart, and the model's {wanted:g} m: "
            "foreign points cannot be thinned out, so the model has to take their spacing"
        )


def _scene_of(file: h5py.File, path: Path) -> Scene:
    try:
        return Scene.from_dict(json.loads(file.attrs["scene"]), source=str(path))
    except (ValueError, SceneError) as error:
        raise FileFormatError(f"{path}: its scene cannot be read ({error})") from None


def _multiple(large: float, small: float, path: Path, what: str, unit: str) -> int:
    """How often `small` goes into `large`, which must be a whole number."""
    ratio = large / small
    whole = round(ratio)
    if whole < 1 or abs(ratio - whole) > INTEGER_TOLERANCE * whole:
        raise FileFormatError(
            f"{path}: its {what}, {small:g} {unit}, does not divide the model's, {large:g} {unit}"
        )
    return whole

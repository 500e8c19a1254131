"""The target of a calibration: where the material came to rest, or how far it ran.

A deposit is a cloud of points of equal mass: the last frame of a trajectory file (HDF5), or a CSV
file with the columns x, y, z in metres (x, y in plane strain), as a survey of the deposit's body
gives it. Two deposits are compared by their distributions along each axis, whatever the number of
their points:

    d² = sum over axes of the mean over p in (0, 1) of (Q(p) - Q*(p))²     [m²]

with Q the quantile function: the squared 2-Wasserstein distance of the projections (Peyré & Cuturi
2019, section 2.6). It weighs every grain alike, so that a few stray ones do not decide, and is
smooth enough for a gradient. A runout is that of 99% of the material (`measures`: runout_p99).
"""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gns_model.errors import FileFormatError, GnsError
from gns_model.measures import FRONT_QUANTILE, moving_positions
from gns_model.scene import Scene
from gns_model.smooth_measures import TEMPERATURE, smooth_quantile
from gns_model.trajectory import OK, Trajectory

#: Levels at which quantile functions are compared.
LEVELS = 200
#: A deposit may reach this far beyond the domain [m]: a survey's scatter.
OUTSIDE = 0.02
#: A deposit narrower than this share of what was released is in another unit.
LEAST_SPREAD = 0.05
#: How many of a unit make a metre. The largest unit in which the numbers fit is the best guess.
UNITS = {"kilometres": 1e-3, "feet": 1 / 0.3048, "centimetres": 100.0, "millimetres": 1000.0}


class TargetError(GnsError, ValueError):
    """A target that is of another scene or in other units: the message says which and why."""


@dataclass(frozen=True)
class Deposit:
    """Quantiles of the deposit along each axis [m], shape (LEVELS, D); `points` it is made of."""

    quantiles: np.ndarray
    points: int
    source: str

    def residuals(self, positions: Tensor) -> Tensor:
        """Of the last frame of `positions` (T, N, D) [m], shape (LEVELS * D,): d² is their sum
        of squares.
        """
        wanted = torch.as_tensor(self.quantiles).to(positions)
        return ((quantiles(positions[-1]) - wanted) / math.sqrt(LEVELS)).flatten()

    def __str__(self) -> str:
        return f"the deposit of {self.points} points in {self.source}"


@dataclass(frozen=True)
class Runout:
    """How far the front of 99% of the material travels [m]."""

    metres: float

    def residuals(self, positions: Tensor) -> Tensor:
        """Runout - target of `positions` (T, N, D) [m], shape (1,)."""
        first, last = (
            smooth_quantile(positions[k, :, 0], FRONT_QUANTILE, TEMPERATURE / 2) for k in (0, -1)
        )
        return (last - first - self.metres).reshape(1)

    def __str__(self) -> str:
        return f"a runout of {self.metres:g} m"


Target = Deposit | Runout


def quantiles(points: Tensor) -> Tensor:
    """Quantiles of points (N, D) along each axis at the middles of `LEVELS` equal shares."""
    ordered = points.sort(dim=0).values
    level = (torch.arange(LEVELS).to(points) + 0.5) / LEVELS
    place = (level * len(points) - 0.5).clamp(0, len(points) - 1)
    low = place.floor().long()
    share = (place - low)[:, None]
    high = (low + 1).clamp(max=len(points) - 1)
    return ordered[low] * (1 - share) + ordered[high] * share


def read_runout(metres: float, scene: Scene) -> Runout:
    """A runout [m] that the domain of `scene` has room for.

    Raises:
        TargetError: if it is negative or leaves the domain.
    """
    room = scene.domain.upper[0] - scene.front
    if not (math.isfinite(metres) and 0 <= metres <= room):
        raise TargetError(
            f"a runout of {metres:g} is not possible in this domain, which leaves {room:g} m "
            f"before the front{_unit(metres, lambda m: 0 < m <= room)}"
        )
    return Runout(metres)


def read_deposit(path: str | os.PathLike[str], scene: Scene) -> tuple[Deposit, float | None]:
    """A deposit from a trajectory file (.h5, .hdf5) or a CSV of points.

    Returns:
        the deposit, and the time of a trajectory's last frame [s], None for a CSV.

    Raises:
        FileFormatError: if the file cannot be read.
        TargetError: if it is of another scene, or in other units than metres.
    """
    path = Path(path)
    time = None
    if path.suffix.lower() in (".h5", ".hdf5"):
        trajectory = Trajectory.load(path)
        _same_scene(path, trajectory, scene)
        points, time = moving_positions(trajectory)[-1].astype(float), float(trajectory.time[-1])
    elif path.suffix.lower() == ".csv":
        points = _read_csv(path, scene.dim)
    else:
        raise FileFormatError(f"{path}: give a trajectory file (.h5) or a table of points (.csv)")
    _in_metres(path, points, scene)
    found = quantiles(torch.from_numpy(points)).numpy()
    return Deposit(found, len(points), str(path)), time


def _same_scene(path: Path, trajectory: Trajectory, scene: Scene) -> None:
    """Refuse the deposit of a flow that differs in more than velocity and material."""
    if trajectory.status != OK:
        raise TargetError(f"{path}: that rollout ended as {trajectory.status!r}: no deposit")
    other = trajectory.scene
    same = {
        "domain": (other.domain, scene.domain),
        "gravity": (other.gravity, scene.gravity),
        "baffles": (sorted(map(str, other.baffles)), sorted(map(str, scene.baffles))),
        "releases": (
            [(r.lower, r.upper) for r in other.releases],
            [(r.lower, r.upper) for r in scene.releases],
        ),
    }
    for what, (theirs, ours) in same.items():
        if theirs != ours:
            raise TargetError(
                f"{path}: that flow has another {what.removesuffix('s')} than the scene "
                f"{scene.name!r}: only velocity and friction may differ"
            )


def _read_csv(path: Path, dim: int) -> np.ndarray:
    """Points (N, D) [m] from the columns x, y, z of a CSV file."""
    axes = "xyz"[:dim]
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = csv.DictReader(file)
            names = {(name or "").strip().lower(): name for name in rows.fieldnames or ()}
            missing = [axis for axis in axes if axis not in names]
            if missing:
                other = [n for n in names if n[:1] in axes and n[1:2] in ("_", " ", "[", "(")]
                hint = f" (found {', '.join(sorted(other))}: is it in metres?)" if other else ""
                raise FileFormatError(
                    f"{path}: no column {missing[0]!r}; the first line is to name "
                    f"{', '.join(axes)}, in metres{hint}"
                )
            points = []
            for row in rows:
                try:
                    points.append([float(row[names[axis]]) for axis in axes])
                except (TypeError, ValueError):
                    raise FileFormatError(f"{path}: line {rows.line_num} is no point") from None
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read ({error.strerror})") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise FileFormatError(f"{path}: not a CSV file ({error})") from None
    found = np.array(points, dtype=float).reshape(-1, dim)
    if len(found) < 10:
        raise FileFormatError(f"{path}: {len(found)} points are no deposit: give 10 or more")
    if not np.isfinite(found).all():
        raise FileFormatError(f"{path}: holds numbers that are not finite")
    return found


def _in_metres(path: Path, points: np.ndarray, scene: Scene) -> None:
    """Refuse points (N, D) that do not lie in the domain, or lie in one spot of it."""
    lower, upper = np.array(scene.domain.lower), np.array(scene.domain.upper)

    def fits(scale: float) -> bool:
        scaled = points * scale
        # A few percent of strays are a survey's; all others have to be inside.
        inside = ((scaled >= lower - OUTSIDE) & (scaled <= upper + OUTSIDE)).all(axis=1)
        return bool(inside.mean() > 0.95 and np.ptp(scaled[:, 0]) > LEAST_SPREAD * length)

    length = max(r.size[0] for r in scene.releases)
    if fits(1.0):
        return
    low, high = points.min(axis=0), points.max(axis=0)
    span = f"{_point(low)} to {_point(high)}"
    raise TargetError(
        f"{path}: the points span {span}, which is no deposit in the domain {_point(lower)} to "
        f"{_point(upper)} m{_unit(1.0, fits)}"
    )


def _unit(value: float, fits: Callable[[float], bool]) -> str:
    """A guess at the unit in which `value` would fit, as the end of a sentence."""
    found = [name for name, per_metre in UNITS.items() if fits(value / per_metre)]
    return f": is it in {found[0]}? Give metres" if found else ": give metres"


def _point(corner: np.ndarray) -> str:
    return "(" + ", ".join(f"{v:.4g}" for v in corner) + ")"

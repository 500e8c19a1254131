"""`metadata.json`: what geoelements/gns and DeepMind's learning_to_simulate say about a dataset.

Either one set of keys, or one for `train` and one for `rollout`. All lengths are metres; velocities
and accelerations are per step and per step squared, whatever `dt` is.
"""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from gns_model.errors import FileFormatError, first_fault
from gns_model.learned.config import ModelConfig

Section = Literal["train", "rollout"]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Vector = tuple[float, ...]

#: Stride of a dataset whose metadata has no `dt` [s]: that of the paper's and of DeepMind's.
USUAL_DT = 0.0025

_STATISTICS = ("vel_mean", "vel_std", "acc_mean", "acc_std")


class Metadata(BaseModel):
    """The keys that matter here; others are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    dim: Literal[2, 3]
    bounds: tuple[tuple[float, float], ...]  #: lowest and highest coordinate of each axis [m]
    default_connectivity_radius: Positive  #: [m]
    sequence_length: Annotated[int, Field(ge=1)]  #: frames of a trajectory
    vel_mean: Vector  #: [m/step]
    vel_std: Vector
    acc_mean: Vector  #: [m/step²]
    acc_std: Vector
    dt: Positive | None = None  #: [s]
    boundary_augment: Positive = 1.0  #: where distances to walls are clipped, in radii
    nnode_in: int | None = None
    nedge_in: int | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Metadata:
        if len(self.bounds) != self.dim:
            raise ValueError(f"bounds has {len(self.bounds)} pairs, but dim = {self.dim}")
        for low, high in self.bounds:
            if low >= high:
                raise ValueError(f"bounds must be ordered, got [{low:g}, {high:g}]")
        for name in _STATISTICS:
            values = getattr(self, name)
            if len(values) != self.dim:
                raise ValueError(f"{name} has {len(values)} numbers, but dim = {self.dim}")
            if name.endswith("std") and min(values) < 0:
                raise ValueError(f"{name} must not be negative, got {list(values)}")
        return self

    @property
    def stride(self) -> float:
        """`dt`, or the usual one where the file has none [s]."""
        return USUAL_DT if self.dt is None else self.dt

    @property
    def usual_spacing(self) -> float:
        """Spacing of points [m] that goes with the radius in the paper; the file has none."""
        paper = ModelConfig.paper(self.dim)
        return paper.spacing * self.default_connectivity_radius / paper.radius

    @classmethod
    def read(cls, path: str | os.PathLike[str], section: Section = "rollout") -> Metadata:
        """Read one section of a metadata file, or its only one.

        Raises:
            FileFormatError: one line that names the file, the key and what is wrong with it.
        """
        values = read_json(path)
        if "train" in values or "rollout" in values:
            if not isinstance(values.get(section), dict):
                raise FileFormatError(f"{path}: split into sections, but has no {section!r}")
            values = values[section]
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            fault = first_fault(error, "metadata", "gns_model/interop/metadata.py")
            raise FileFormatError(f"{path}: {fault}") from None

    def with_dt(self, dt: float | None) -> Metadata:
        """The same with another `dt` [s], unless it is None.

        Raises:
            FileFormatError: if it is not positive.
        """
        if dt is None:
            return self
        return self.model_copy(update={"dt": checked("dt", dt, "s")})

    def keys(self) -> dict[str, Any]:
        """Plain values to write into a metadata file."""
        return self.model_dump(mode="json", exclude_none=True)


def checked(name: str, value: float, unit: str) -> float:
    """`value` if it is positive and finite.

    Raises:
        FileFormatError: if it is not.
    """
    if not 0 < value < math.inf:
        raise FileFormatError(f"{name} must be positive, got {value} {unit}")
    return value


def read_json(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        FileFormatError: if it is missing, is not JSON or holds anything else.
    """
    try:
        values = json.loads(Path(path).read_bytes())
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError):
        raise FileFormatError(f"{path}: truncated, or not JSON") from None
    if not isinstance(values, dict):
        raise FileFormatError(f"{path}: not a metadata file, which holds one JSON object")
    return values

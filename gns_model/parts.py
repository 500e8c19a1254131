"""What a scene is made of: boxes, material, friction, grains that are let go, and baffles."""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_serializer, model_validator

from gns_model import footprint

Vector = tuple[float, ...]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]

#: Slack for comparing coordinates that were typed with a few decimals [m].
TOLERANCE = 1e-9


class Part(BaseModel):
    """A part of a scene: frozen, and nothing in it but what it knows."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Box(Part):
    """An axis-aligned box: `lower` and `upper` corners [m], shape (D,)."""

    lower: Vector
    upper: Vector

    @model_validator(mode="after")
    def _ordered(self) -> Box:
        if len(self.lower) != len(self.upper):
            raise ValueError(f"lower has {len(self.lower)} numbers and upper {len(self.upper)}")
        if any(u - lo <= TOLERANCE for lo, u in zip(self.lower, self.upper, strict=True)):
            raise ValueError(f"every upper must exceed its lower, got {self.lower} to {self.upper}")
        return self

    @property
    def size(self) -> Vector:
        """Edge lengths [m], shape (D,)."""
        return tuple(u - lo for lo, u in zip(self.lower, self.upper, strict=True))

    def contains(self, other: Box) -> bool:
        """Whether `other` lies inside this box, touching allowed."""
        return all(
            a <= c + TOLERANCE and d <= b + TOLERANCE
            for a, b, c, d in zip(self.lower, self.upper, other.lower, other.upper, strict=True)
        )

    def overlaps(self, other: Box) -> bool:
        """Whether the two boxes share volume; touching faces do not."""
        return all(
            a < d - TOLERANCE and c < b - TOLERANCE
            for a, b, c, d in zip(self.lower, self.upper, other.lower, other.upper, strict=True)
        )


class Domain(Box):
    """The box that holds the flow; its lower y face is the base, its other faces are walls."""


class Friction(Part):
    """Coulomb coefficients [-] of the boundaries."""

    base: NonNegative = 0.7
    walls: NonNegative = 0.0
    baffles: NonNegative = 0.7


class Material(Part):
    """Mohr-Coulomb soil. E defaults to 2 MPa: stiffer gives the same runout for 10-30x the cost."""

    density: Positive = 1800.0  #: [kg/m³]
    youngs_modulus: Positive = 2.0e6  #: [Pa]
    poisson_ratio: Annotated[float, Field(ge=0, lt=0.5)] = 0.3
    friction_angle: Annotated[float, Field(ge=0, lt=90)] = 35.0  #: [degrees]
    cohesion: NonNegative = 0.0  #: [Pa]
    tension_cutoff: NonNegative = 0.0  #: [Pa]

    @model_validator(mode="after")
    def _cutoff_below_apex(self) -> Material:
        tangent = math.tan(math.radians(self.friction_angle))
        if tangent > 0 and self.tension_cutoff > self.cohesion / tangent + TOLERANCE:
            raise ValueError(
                f"tension_cutoff {self.tension_cutoff:g} Pa lies beyond the apex of the cone, "
                f"cohesion / tan(friction_angle) = {self.cohesion / tangent:g} Pa"
            )
        return self


class Release(Box):
    """A box of grains that starts with one `velocity` [m/s], shape (D,)."""

    velocity: Vector


#: Turn of a baffle about the vertical [degrees]; half a turn changes nothing.
Yaw = Annotated[float, Field(gt=-90, le=90, allow_inf_nan=False)]


class Baffle(Part):
    """A rigid box that stands on the base: plan `center` [m] and `size` [m], height second.

    In 3D it may be turned about the vertical through its centre, by `yaw` degrees from x towards
    z: counter-clockwise in a plan with x to the right and z up. With t = yaw, the corners of its
    footprint are center + (u cos t - v sin t, u sin t + v cos t), where u = ±size[0]/2 and
    v = ±size[2]/2.
    """

    center: Vector
    size: Annotated[Vector, Field(min_length=2)]
    yaw: Yaw = 0.0

    @model_validator(mode="after")
    def _shape(self) -> Baffle:
        if len(self.center) != len(self.size) - 1:
            raise ValueError(
                f"size {self.size} has {len(self.size)} numbers, so center needs "
                f"{len(self.size) - 1}, got {self.center}"
            )
        if min(self.size) <= 0:
            raise ValueError(f"size must be positive, got {self.size}")
        if self.yaw != 0 and len(self.size) != 3:
            raise ValueError(f"only a baffle in 3D can be turned, got yaw = {self.yaw:g} in 2D")
        return self

    @model_serializer(mode="wrap")
    def _without_no_yaw(self, plain: Any) -> dict[str, Any]:
        # Files and keys of scenes that turn nothing are what they were before there was a yaw.
        values = plain(self)
        if not self.yaw:
            values.pop("yaw")
        return values

    @property
    def corners(self) -> np.ndarray:
        """Corners of the footprint in order around it [m], shape (4, 2), (x, z); 3D only."""
        return footprint.corners(self.center, (self.size[0], self.size[2]), self.yaw)

    @property
    def unturned(self) -> tuple[Vector, float]:
        """Size and yaw, where a quarter turn is written as exchanged sizes and no yaw."""
        if self.yaw == 90:
            return (self.size[2], self.size[1], self.size[0]), 0.0
        return self.size, self.yaw

    def box(self, base: float) -> Box:
        """The box along the axes that holds it when it stands on a base at height `base` [m].

        Unturned, or by a quarter turn, the baffle fills it.
        """
        size = self.unturned[0]
        half = (size[0] / 2, *(s / 2 for s in size[2:]))
        if self.unturned[1]:
            plan = footprint.bounding_size((size[0], size[2]), self.yaw)
            half = (float(plan[0]) / 2, float(plan[1]) / 2)
        low = [c - h for c, h in zip(self.center, half, strict=True)]
        high = [c + h for c, h in zip(self.center, half, strict=True)]
        return Box(lower=(low[0], base, *low[1:]), upper=(high[0], base + self.size[1], *high[1:]))

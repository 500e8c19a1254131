"""A scene: the physical situation, in SI units, that every simulator starts from.

Axes: x runs downstream, y up and z across; a 2D scene (plane strain) has x and y only. A scene
knows nothing of spacing, time step or any other matter of a simulator. It is frozen, compares by
value, and is read from and written to TOML.

    [domain]                        # the box that holds everything; its floor is the base
    lower = [0.1, 0.1, 0.1]
    upper = [1.9, 0.9, 1.9]
    [[release]]                     # one or more boxes of grains and their velocity
    lower = [0.1, 0.1, 0.3]
    upper = [0.45, 0.35, 1.7]
    velocity = [2.0, 0.0, 0.0]
    [[baffle]]                      # none or more rigid boxes that stand on the base
    center = [0.775, 0.375]         # (x, z); in 2D [x]
    size = [0.15, 0.30, 0.15]       # (along x, height, along z); in 2D (along x, height)
    yaw = 20.0                      # optional, 3D only: turned by so many degrees from x towards z
    [placement]                     # optional: where a search may put baffles
    lower = [0.6, 0.1]
    upper = [1.5, 1.9]
"""

from __future__ import annotations

import json
import math
import os
import tempfile
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    model_serializer,
    model_validator,
)

from gns_model import footprint, polygon
from gns_model.errors import SceneError

Vector = tuple[float, ...]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Range = tuple[Positive, Positive]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]

#: Slack for comparing coordinates that were typed with a few decimals [m].
TOLERANCE = 1e-9


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Box(_Part):
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


class Friction(_Part):
    """Coulomb coefficients [-] of the boundaries."""

    base: NonNegative = 0.7
    walls: NonNegative = 0.0
    baffles: NonNegative = 0.7


class Material(_Part):
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


class Baffle(_Part):
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


class Vary(_Part):
    """What a search may choose beside the places: ranges (lowest, highest), one form for all.

    What has no range is as the placement's `size` and `yaw` say, and `number` as the search is
    told. Sizes in m, yaw in degrees.
    """

    along: Range | None = None
    height: Range | None = None
    across: Range | None = None
    yaw: tuple[float, float] | None = None
    number: tuple[int, int] | None = None

    @model_validator(mode="after")
    def _ordered(self) -> Vary:
        for name, ends in self:
            if ends is not None and ends[0] > ends[1]:
                raise ValueError(f"{name} must be a range, lowest first, got {ends}")
        if self.number is not None and self.number[0] < 1:
            raise ValueError(f"number must be 1 or more, got {self.number}")
        if self.yaw is not None and not -90 <= self.yaw[0] <= self.yaw[1] <= 90:
            raise ValueError(f"yaw must lie between -90 and 90 degrees, got {self.yaw}")
        return self


class Placement(_Part):
    """Where a search may put baffles, in plan: (x, z) in 3D, (x,) in 2D; and what else they obey.

    Whole footprints stay inside the rectangle `lower`..`upper`, `gap` clear of each other and
    outside every rectangle of `keep_out` (x0, z0, x1, z1; in 2D x0, x1) and every polygon of
    `keep_out_polygons` (3D only). The last two limits are on the flow: a search can only find out.
    """

    lower: Vector
    upper: Vector
    gap: NonNegative = 0.05
    size: Vector | None = None  #: size of a baffle to place [m]; default: the scene's first
    yaw: Yaw | None = None  #: yaw of a baffle to place [degrees]; default: the scene's first, or 0
    keep_out: tuple[Vector, ...] = ()
    #: Outlines of any shape, each a list of corners (x, z) [m].
    keep_out_polygons: tuple[tuple[tuple[float, float], ...], ...] = ()
    wall_gap: NonNegative = 0.0  #: least distance of a footprint to the walls of the domain [m]
    max_height: Positive | None = None  #: of a baffle [m]
    max_volume: Positive | None = None  #: of all baffles together [m³]; in 2D [m²]
    max_overtopping: NonNegative | None = None  #: most mass over the baffles' tops, as a share [-]
    freeboard: NonNegative | None = None  #: least height of the tops above the peak depth [m]
    vary: Vary | None = None  #: what else a search may choose; default: places only

    @model_serializer(mode="wrap")
    def _without_what_is_not_limited(self, plain: Any) -> dict[str, Any]:
        # Files and keys of scenes stay what they were before there were these limits.
        values: dict[str, Any] = plain(self)
        for name in ("wall_gap", "keep_out_polygons"):
            if not getattr(self, name):
                values.pop(name, None)
        return values

    @model_validator(mode="after")
    def _ordered(self) -> Placement:
        n = len(self.lower)
        if len(self.upper) != n or any(
            u <= lo for lo, u in zip(self.lower, self.upper, strict=True)
        ):
            raise ValueError(f"every upper must exceed its lower, got {self.lower} to {self.upper}")
        if self.size is not None and (len(self.size) != n + 1 or min(self.size) <= 0):
            raise ValueError(f"size needs {n + 1} positive numbers, got {self.size}")
        if self.yaw and n != 2:
            raise ValueError(f"only a baffle in 3D can be turned, got yaw = {self.yaw:g} in 2D")
        for k, r in enumerate(self.keep_out):
            if len(r) != 2 * n or any(r[i] >= r[i + n] for i in range(n)):
                raise ValueError(
                    f"keep_out[{k}] needs lower and upper corner, {2 * n} ordered numbers, got {r}"
                )
        if self.keep_out_polygons and n != 2:
            raise ValueError("keep_out_polygons are for 3D; in 2D give intervals in keep_out")
        for k, corners in enumerate(self.keep_out_polygons):
            wrong = polygon.fault(corners)
            if wrong:
                raise ValueError(f"keep_out_polygons[{k}]: {wrong}")
        if self.vary is not None and n != 2 and (self.vary.across or self.vary.yaw):
            raise ValueError("in 2D a baffle has neither a size across nor a yaw to vary")
        return self


class Scene(_Part):
    """Domain, gravity, material, friction, releases and baffles of one flow. See the module."""

    name: str = "scene"
    domain: Domain
    gravity: Vector = ()  #: [m/s²], shape (D,); tilt it for a slope. Default: 9.81 downwards.
    friction: Friction = Friction()
    material: Material = Material()
    releases: Annotated[tuple[Release, ...], Field(alias="release", min_length=1)]
    baffles: tuple[Baffle, ...] = Field(default=(), alias="baffle")
    duration: Positive = 1.0  #: [s]
    #: x of the control section for `mass_past_section` [m]; default: 60% of the domain.
    section: float | None = None
    placement: Placement | None = None

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, populate_by_name=True
    )

    @model_validator(mode="before")
    @classmethod
    def _default_gravity(cls, values: Any) -> Any:
        if isinstance(values, dict) and not values.get("gravity"):
            domain = values.get("domain")
            if isinstance(domain, dict):
                lower = domain.get("lower")
            else:
                lower = getattr(domain, "lower", None)
            if isinstance(lower, (list, tuple)):
                dim = len(lower)
                values = {**values, "gravity": tuple(-9.81 if i == 1 else 0.0 for i in range(dim))}
        return values

    @model_validator(mode="after")
    def _consistent(self) -> Scene:
        dim = self.dim
        if dim not in (2, 3):
            raise ValueError(f"domain.lower must have 2 or 3 numbers, got {dim}")
        if len(self.gravity) != dim:
            raise ValueError(f"gravity needs {dim} numbers, got {self.gravity}")
        for k, release in enumerate(self.releases):
            if len(release.lower) != dim or len(release.velocity) != dim:
                raise ValueError(
                    f"release[{k}] needs {dim} numbers in lower, upper and velocity, got "
                    f"{release.lower}, {release.upper}, {release.velocity}"
                )
            if not self.domain.contains(release):
                raise ValueError(
                    f"release[{k}] {release.lower} to {release.upper} leaves the domain "
                    f"{self.domain.lower} to {self.domain.upper}"
                )
            for j, earlier in enumerate(self.releases[:k]):
                if release.overlaps(earlier):
                    raise ValueError(
                        f"release[{k}] {_span(release)} overlaps release[{j}] {_span(earlier)}"
                    )
        for k, baffle in enumerate(self.baffles):
            if len(baffle.size) != dim:
                raise ValueError(f"baffle[{k}].size needs {dim} numbers, got {baffle.size}")
            box = baffle.box(self.base)
            # The corners of a turned baffle touch each face of the box that holds it.
            if not self.domain.contains(box):
                raise ValueError(
                    f"baffle[{k}] {box.lower} to {box.upper}{_turned(baffle)} leaves the domain "
                    f"{self.domain.lower} to {self.domain.upper}"
                )
            for j, release in enumerate(self.releases):
                if _overlap(box, release, baffle, None):
                    raise ValueError(
                        f"baffle[{k}] {_span(box)}{_turned(baffle)} overlaps release[{j}] "
                        f"{_span(release)}"
                    )
            for j, other in enumerate(self.baffles[:k]):
                other_box = other.box(self.base)
                if _overlap(box, other_box, baffle, other):
                    raise ValueError(
                        f"baffle[{k}] {_span(box)}{_turned(baffle)} overlaps baffle[{j}] "
                        f"{_span(other_box)}{_turned(other)}"
                    )
        if self.section is not None and not (
            self.domain.lower[0] < self.section < self.domain.upper[0]
        ):
            raise ValueError(
                f"section {self.section:g} must lie inside the domain, "
                f"{self.domain.lower[0]:g} to {self.domain.upper[0]:g}"
            )
        if self.placement is not None:
            plan_lower, plan_upper = self._plan(self.domain.lower), self._plan(self.domain.upper)
            if len(self.placement.lower) != dim - 1:
                raise ValueError(
                    f"placement.lower and upper need {dim - 1} numbers, got "
                    f"{self.placement.lower}, {self.placement.upper}"
                )
            if any(
                p < d - TOLERANCE for p, d in zip(self.placement.lower, plan_lower, strict=True)
            ) or any(
                p > d + TOLERANCE for p, d in zip(self.placement.upper, plan_upper, strict=True)
            ):
                raise ValueError(
                    f"placement {self.placement.lower} to {self.placement.upper} leaves the "
                    f"domain in plan, {plan_lower} to {plan_upper}"
                )
        return self

    @staticmethod
    def _plan(vector: Vector) -> Vector:
        return (vector[0], *vector[2:])

    @property
    def dim(self) -> int:
        """Number of axes: 2 (plane strain) or 3."""
        return len(self.domain.lower)

    @property
    def base(self) -> float:
        """Height of the base [m]."""
        return self.domain.lower[1]

    @property
    def front(self) -> float:
        """Initial x of the flow front [m]: the paper measures runout from here."""
        return max(r.upper[0] for r in self.releases)

    @property
    def control_section(self) -> float:
        """x beyond which mass counts as past the control section [m]."""
        if self.section is not None:
            return self.section
        return self.domain.lower[0] + 0.6 * self.domain.size[0]

    @property
    def baffle_size(self) -> Vector:
        """Size [m] of the baffles that a search places: the placement's, or the first baffle's.

        Raises:
            SceneError: if the scene names neither.
        """
        if self.placement is not None and self.placement.size is not None:
            return self.placement.size
        if self.baffles:
            return self.baffles[0].size
        raise SceneError("the scene has no baffle and no placement.size: which size to place?")

    @property
    def baffle_yaw(self) -> float:
        """Yaw [degrees] of the baffles that a search places: the placement's, the first's, or 0."""
        if self.placement is not None and self.placement.yaw is not None:
            return self.placement.yaw
        return self.baffles[0].yaw if self.baffles else 0.0

    @property
    def is_turned(self) -> bool:
        """Whether a baffle stands askew to the axes."""
        return any(baffle.unturned[1] for baffle in self.baffles)

    def baffle_boxes(self) -> np.ndarray:
        """Lower and upper corners of the boxes along the axes that hold the baffles [m].

        Shape (B, 2, D). An unturned baffle fills its box; of turned ones `oriented_boxes` tells.
        """
        if not self.baffles:
            return np.zeros((0, 2, self.dim))
        boxes = [baffle.box(self.base) for baffle in self.baffles]
        return np.array([[box.lower, box.upper] for box in boxes])

    def oriented_boxes(self) -> tuple[np.ndarray, np.ndarray]:
        """The baffles as boxes turned about the vertical through their middle.

        Returns:
            lower and upper corners as they would stand unturned [m], shape (B, 2, D); and cosine
            and sine of the yaw, shape (B, 2): (1, 0) for a baffle along the axes, which a baffle
            by a quarter turn also is, with its sizes exchanged.
        """
        boxes, turns = self.baffle_boxes(), np.zeros((len(self.baffles), 2))
        for k, baffle in enumerate(self.baffles):
            yaw = baffle.unturned[1]
            turns[k] = footprint.turn(yaw)
            if yaw:
                boxes[k] = _corners(baffle.model_copy(update={"yaw": 0.0}).box(self.base))
        return boxes, turns

    def footprints(self) -> np.ndarray:
        """Corners of the baffles in plan, in order around each [m], (x, z), shape (B, 4, 2).

        Raises:
            SceneError: in 2D.
        """
        if self.dim != 3:
            raise SceneError("a 2D scene has no plan")
        return np.array([baffle.corners for baffle in self.baffles]).reshape(-1, 4, 2)

    def with_baffles(
        self,
        centres: Sequence[Sequence[float]] | np.ndarray,
        size: Sequence[float] | Sequence[Sequence[float]] | np.ndarray | None = None,
        yaw: float | Sequence[float] | np.ndarray | None = None,
    ) -> Scene:
        """The same scene with baffles at `centres` [m], shape (n, D-1), (x, z) in 3D.

        Args:
            centres: in plan.
            size: [m], shape (D,) for all or (n, D); default: `baffle_size`.
            yaw: [degrees], one for all or shape (n,); default: `baffle_yaw`.

        Raises:
            SceneError: if a baffle leaves the domain or overlaps a release or another baffle, or
                sizes or yaws are not one for all nor one for each.
        """
        centres = np.asarray(centres, dtype=float)
        if centres.size == 0:
            centres = np.zeros((0, self.dim - 1))
        if centres.ndim != 2 or centres.shape[1] != self.dim - 1:
            raise SceneError(f"centres must have shape (n, {self.dim - 1}), got {centres.shape}")
        if not np.isfinite(centres).all():
            raise SceneError(f"centres must be finite, got {centres.tolist()}")
        if size is None and len(centres):
            size = self.baffle_size
        sizes = _for_each(
            size if len(centres) else np.zeros(self.dim), centres, (self.dim,), "size"
        )
        yaws = _for_each(self.baffle_yaw if yaw is None else yaw, centres, (), "yaw")
        baffles = tuple(
            {"center": tuple(map(float, c)), "size": tuple(map(float, s)), "yaw": float(y)}
            for c, s, y in zip(centres, sizes, yaws, strict=True)
        )
        placement = self.placement
        if placement is not None and self.baffles:
            # An emptied scene still knows what to place.
            first = {"size": self.baffles[0].size, "yaw": self.baffles[0].yaw or None}
            unknown = {k: v for k, v in first.items() if getattr(placement, k) is None}
            placement = placement.model_copy(update=unknown)
        return self._replaced(baffles=baffles, placement=placement)

    def replace(self, **changes: Any) -> Scene:
        """The same scene with fields changed, checked again."""
        return self._replaced(**changes)

    def _replaced(self, **changes: Any) -> Scene:
        values = {name: getattr(self, name) for name in type(self).model_fields}
        values.update(changes)
        return self.from_dict(_plain(values))

    # -- files ---------------------------------------------------------------------------------

    @classmethod
    def from_dict(cls, values: dict[str, Any], source: str = "scene") -> Scene:
        """A scene from plain values, as in TOML.

        Raises:
            SceneError: one line that names the key, the value and what is allowed.
        """
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            raise SceneError(f"{source}: {first_fault(error)}") from None

    @classmethod
    def from_toml(cls, path: str | os.PathLike[str]) -> Scene:
        """Read a scene file.

        Raises:
            SceneError: if it is missing, is not TOML or is not a scene.
        """
        path = Path(path)
        try:
            values = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise SceneError(f"{path}: cannot be read ({error.strerror})") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise SceneError(f"{path}: not a TOML file ({error})") from None
        return cls.from_dict(values, source=str(path))

    def to_dict(self) -> dict[str, Any]:
        """Plain values that `from_dict` reads back."""
        return self.model_dump(by_alias=True, exclude_none=True, mode="json")

    def to_toml(self, path: str | os.PathLike[str] | None = None) -> str:
        """The scene as TOML text; also written to `path`, whole or not at all, if one is given."""
        text = toml_text(self.to_dict())
        if path is not None:
            write_whole(Path(path), text.encode())
        return text


def write_whole(path: Path, content: bytes | memoryview) -> None:
    """Write a file under a temporary name and rename it, so that nobody ever meets half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def _for_each(values: Any, centres: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    """One value of the given shape for every centre, from such values or from one for all."""
    array = np.asarray(values, dtype=float)
    if array.shape not in (shape, (len(centres), *shape)):
        raise SceneError(
            f"{name} must have shape {shape} for all {len(centres)} baffles or "
            f"{(len(centres), *shape)}, got {array.shape}"
        )
    return np.broadcast_to(array, (len(centres), *shape))


def _overlap(a: Box, b: Box, one: Baffle, other: Baffle | None) -> bool:
    """Whether baffle `one` in box `a` shares volume with what is in `b`: baffle `other`, or all."""
    if not a.overlaps(b):
        return False
    if not one.unturned[1] and (other is None or not other.unturned[1]):
        return True
    plan = np.array([[b.lower[0], b.lower[2]], [b.upper[0], b.upper[2]]])
    around = other.corners if other else footprint.corners(plan.mean(0), plan[1] - plan[0])
    return float(footprint.separation(one.corners, around)) < -TOLERANCE


def _turned(baffle: Baffle) -> str:
    return f" (turned by {baffle.yaw:g} degrees)" if baffle.unturned[1] else ""


def _corners(box: Box) -> np.ndarray:
    return np.array([box.lower, box.upper])


def _span(box: Box) -> str:
    low, high = (tuple(round(v, 6) for v in corner) for corner in (box.lower, box.upper))
    return f"{low} to {high}"


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return value.model_dump(by_alias=True)
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (tuple, list)):
        return tuple(_plain(v) for v in value)
    return value


def first_fault(
    error: ValidationError, whole: str = "scene", keys: str = "gns_model/scene.py"
) -> str:
    """One line on the first thing that is wrong with a `whole`, whose keys stand in file `keys`."""
    fault = error.errors()[0]
    key = ".".join(str(part) for part in fault["loc"]) or whole
    message = fault["msg"].removeprefix("Value error, ")
    if fault["type"] == "extra_forbidden":
        return f"unknown key {key!r} (value {fault['input']!r}); see the keys in {keys}"
    if fault["type"] == "missing":
        return f"key {key!r} is missing"
    if fault["type"] == "value_error":
        return message if key == whole else f"{key}: {message}"
    return f"{key} = {fault['input']!r}: {message}"


def toml_text(values: dict[str, Any]) -> str:
    """Plain values as TOML: keys first, then tables and lists of tables, one level deep."""
    lines: list[str] = []
    tables: list[str] = []
    for key, value in values.items():
        if isinstance(value, dict):
            tables += ["", f"[{key}]", *(f"{k} = {_literal(v)}" for k, v in value.items())]
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for entry in value:
                tables += ["", f"[[{key}]]", *(f"{k} = {_literal(v)}" for k, v in entry.items())]
        elif value != []:
            lines.append(f"{key} = {_literal(value)}")
    return "\n".join(lines + tables) + "\n"


def _literal(value: Any) -> str:
    if isinstance(value, str):
        # JSON escapes what TOML does, except that TOML also forbids a bare DEL.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_literal(v) for v in value) + "]"
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_literal(v)}" for k, v in value.items()) + " }"
    return repr(value)

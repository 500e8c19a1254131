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

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from gns_model import consistency, footprint
from gns_model.errors import SceneError, first_fault
from gns_model.files import write_whole
from gns_model.parts import (
    Baffle,
    Box,
    Domain,
    Friction,
    Material,
    Part,
    Positive,
    Release,
    Vector,
)
from gns_model.placement import Placement
from gns_model.toml import read_toml, toml_text


class Scene(Part):
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
        consistency.check(self)
        return self

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
        return cls.from_dict(read_toml(path, SceneError), source=str(path))

    def to_dict(self) -> dict[str, Any]:
        """Plain values that `from_dict` reads back."""
        return self.model_dump(by_alias=True, exclude_none=True, mode="json")

    def to_toml(self, path: str | os.PathLike[str] | None = None) -> str:
        """The scene as TOML text; also written to `path`, whole or not at all, if one is given."""
        text = toml_text(self.to_dict())
        if path is not None:
            write_whole(Path(path), text.encode())
        return text


def _for_each(values: Any, centres: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    """One value of the given shape for every centre, from such values or from one for all."""
    array = np.asarray(values, dtype=float)
    if array.shape not in (shape, (len(centres), *shape)):
        raise SceneError(
            f"{name} must have shape {shape} for all {len(centres)} baffles or "
            f"{(len(centres), *shape)}, got {array.shape}"
        )
    return np.broadcast_to(array, (len(centres), *shape))


def _corners(box: Box) -> np.ndarray:
    return np.array([box.lower, box.upper])


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return value.model_dump(by_alias=True)
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (tuple, list)):
        return tuple(_plain(v) for v in value)
    return value

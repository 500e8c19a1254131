"""Where a search may put baffles, what it may choose of them, and what limits they obey."""

from __future__ import annotations

from typing import Any

from pydantic import model_serializer, model_validator

from gns_model import polygon
from gns_model.parts import NonNegative, Part, Positive, Vector, Yaw

Range = tuple[Positive, Positive]


class Vary(Part):
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


class Placement(Part):
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

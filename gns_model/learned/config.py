"""What a learned simulator is built like, and what it was trained for."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from gns_model.scene import Scene

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Range = tuple[float, float]

#: Number of particle types in geoelements/gns; 6 moves and 3 is stationary.
PAPER_TYPES = 9


class Limits(BaseModel):
    """The range of scenes that a model was trained on; outside it, it guesses.

    Every field is None (no limit known) or an upper bound, or a (lowest, highest) pair.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    max_speed: float | None = None  #: of a release [m/s]
    release_height: float | None = None  #: highest top of a release over the base [m]
    gravity: Range | None = None  #: magnitude [m/s²]
    slope: Range | None = None  #: angle of gravity to -y [degrees]
    friction_angle: Range | None = None  #: [degrees]
    cohesion: Range | None = None  #: [Pa]
    base_friction: Range | None = None  #: [-]
    wall_friction: Range | None = None  #: [-]
    baffle_friction: Range | None = None  #: [-]
    baffle_height: Range | None = None  #: [m]
    baffle_width: Range | None = None  #: both plan sizes [m]
    #: [degrees], of turned baffles; None with a known baffle_height: all stood along the axes
    baffle_yaw: Range | None = None

    @classmethod
    def of(cls, scenes: Iterable[Scene]) -> Limits:
        """The limits that just hold `scenes`, to be written into a card after training on them."""
        seen = [_extent(scene) for scene in scenes]
        limits: dict[str, float | Range] = {}
        for name in cls.model_fields:
            values = [v for extent in seen for v in extent.get(name, ())]
            if values:
                single = name in ("max_speed", "release_height")
                limits[name] = max(values) if single else (min(values), max(values))
        return cls.model_validate(limits)

    def widened(self, scenes: Iterable[Scene]) -> Limits:
        """These limits, as far as there are any, and what else holds `scenes`."""
        seen = Limits.of(scenes)
        wider: dict[str, float | Range | None] = {}
        for name in type(self).model_fields:
            mine, other = getattr(self, name), getattr(seen, name)
            if mine is None or other is None:
                wider[name] = mine
            elif isinstance(mine, tuple):
                wider[name] = min(mine[0], other[0]), max(mine[1], other[1])
            else:
                wider[name] = max(mine, other)
        return Limits.model_validate(wider)

    def broken_by(self, scene: Scene) -> list[str]:
        """One line for every limit that `scene` lies outside of, naming it, value and range."""
        lines = []
        for name, values in _extent(scene).items():
            limit = getattr(self, name)
            if name == "baffle_yaw" and limit is None and self.baffle_height is not None:
                steepest = max(values, key=abs)
                lines.append(
                    f"{name} = {steepest:g} degrees, but trained on baffles along the axes"
                )
            if limit is None:
                continue
            low, high = limit if isinstance(limit, tuple) else (0.0, limit)
            slack = 1e-6 + 0.01 * max(abs(low), abs(high))
            worst = max(values, key=lambda v: max(low - v, v - high))
            if not low - slack <= worst <= high + slack:
                lines.append(f"{name} = {worst:.4g}, but trained on {low:.4g} to {high:.4g}")
        return lines


def _extent(scene: Scene) -> dict[str, list[float]]:
    gravity = math.hypot(*scene.gravity)
    extent = {
        "max_speed": [math.hypot(*r.velocity) for r in scene.releases],
        "release_height": [r.upper[1] - scene.base for r in scene.releases],
        "gravity": [gravity],
        "friction_angle": [scene.material.friction_angle],
        "cohesion": [scene.material.cohesion],
        "base_friction": [scene.friction.base],
        "wall_friction": [scene.friction.walls],
    }
    if gravity > 0:
        cosine = min(1.0, max(-1.0, -scene.gravity[1] / gravity))
        extent["slope"] = [math.degrees(math.acos(cosine))]
    if scene.baffles:
        extent["baffle_friction"] = [scene.friction.baffles]
        extent["baffle_height"] = [b.size[1] for b in scene.baffles]
        extent["baffle_width"] = [s for b in scene.baffles for s in (b.size[0], *b.size[2:])]
        if scene.is_turned:
            extent["baffle_yaw"] = [b.unturned[1] for b in scene.baffles]
    return extent


class ModelConfig(BaseModel):
    """Architecture, resolution and stride of a graph network simulator.

    The defaults are `baffle-lite`'s; `ModelConfig.paper(dim)` is the network of Choi & Kumar.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    dim: Literal[2, 3] = 3
    spacing: Positive = 0.03125  #: of the points that it moves [m]
    #: A point starts in the middle of a random one of subcells^D equal parts of its cell.
    subcells: Annotated[int, Field(ge=1)] = 1
    dt: Positive = 0.0125  #: stride of one step [s]
    radius: Positive = 0.05  #: points closer than this are joined by an edge [m]
    #: Number of past velocities that it sees. With one it cannot repeat its last acceleration,
    #: errors included (`gns_model.training.noise`); the paper's sees five.
    history: Annotated[int, Field(ge=1)] = 3

    #: Points are their own neighbours, too, as in geoelements/gns.
    self_edges: bool = False

    latent: Annotated[int, Field(ge=1)] = 64
    hidden: Annotated[int, Field(ge=1)] | None = None  #: width of hidden layers; default: latent
    hidden_layers: Annotated[int, Field(ge=1)] = 2  #: of every MLP
    blocks: Annotated[int, Field(ge=1)] = 5  #: message-passing blocks, own weights each
    activation: Literal["silu", "relu"] = "silu"
    #: How an edge goes on to the next block: "residual": plus its message. "doubled": times two,
    #: a fault of geoelements/gns before December 2024 that weights of that time were trained with.
    edge_update: Literal["residual", "doubled"] = "residual"
    #: Multiply messages by a smooth function of distance that vanishes at `radius`.
    envelope: bool = True
    #: Give edges the relative velocity beside the displacement.
    relative_velocity: bool = True

    #: Predict a - g, so that free flight comes free.
    subtract_gravity: bool = True
    #: "fade": smooth, vanishes at `wall_range`. "clip": the paper's distance / radius in [-1, 1].
    walls: Literal["fade", "clip"] = "fade"
    wall_range: Positive = 0.05  #: [m]
    wall_clip: Positive = 1.0  #: where "clip" clips, in radii
    #: "distance": signed distance and normal to the exact boxes. "points": the paper's kinematic
    #: points, which need `types`. "none": it sees no baffles, and refuses scenes that have some.
    baffles: Literal["distance", "points", "none"] = "distance"
    baffle_range: Positive = 0.1  #: where the influence of a baffle on the features ends [m]
    #: Give vertices the overburden, the flow depth and its slope, of the mass within this distance
    #: along the base [m]; 0: leave them out, as the paper does. See `features.depth_features`.
    depth_range: NonNegative = 0.0
    #: Give vertices the direction of the strain rate and of the velocity beside their size, and
    #: edges that of the relative velocity: friction knows only directions. Rates below this fade
    #: [1/s]; 0: leave them out, as the paper does. Needs `relative_velocity`. See
    #: `features.strain_features`.
    strain_unit: NonNegative = 0.0
    #: Push points out of the boxes and into the domain after every step.
    project: bool = True

    #: Push points apart after every step where they are denser than this many times their lattice;
    #: 0: nowhere, as in the paper. See `crowding.spread`.
    crowding_limit: NonNegative = 0.0

    #: First steps of a rollout that the reference solver takes. A column that was just let go is a
    #: perfect lattice at rest: how it will start follows from faces that lie many neighbours away,
    #: while one step later velocities tell. The paper's rollouts begin with six frames of its MPM.
    solver_steps: Annotated[int, Field(ge=0)] = 0

    #: How far the points of a start are moved off their lattice, in spacings: as in the flows that
    #: it was trained on, from which training fills this in. The farthest grain of a lattice
    #: stops short of that of shaken points; what a model does on one tells little of the other.
    jitter: Annotated[float, Field(ge=0, lt=0.5)] = 0.0

    types: Annotated[int, Field(ge=0)] = 0  #: number of particle types to embed; 0: none
    type_embedding: Annotated[int, Field(ge=1)] = 16
    #: Properties of the scene that every vertex sees, in this order.
    material_features: tuple[Literal["tan_friction_angle", "base_friction"], ...] = ()

    noise_std: NonNegative = 3e-4  #: of the random walk on the input positions in training [m]
    limits: Limits = Limits()
    #: Lowest and highest coordinate of the domain [m], one pair an axis: where `predict_positions`
    #: has the walls unless it is told otherwise.
    bounds: tuple[Range, ...] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> ModelConfig:
        if self.baffles == "points" and self.types == 0:
            raise ValueError('baffles = "points" needs types > 0 to tell them from moving points')
        if self.solver_steps and self.subcells > 1:
            raise ValueError("solver_steps needs the solver's own points: subcells = 1")
        if 0 < self.crowding_limit <= 1:
            raise ValueError(
                "crowding_limit must exceed 1, the density of a release, "
                f"got {self.crowding_limit:g}"
            )
        if self.strain_unit and not self.relative_velocity:
            raise ValueError("strain_unit needs relative_velocity = true")
        if self.radius <= self.spacing:
            raise ValueError(
                f"radius {self.radius:g} m must exceed the spacing {self.spacing:g} m, "
                "or no two points are joined"
            )
        if self.bounds is not None and (
            len(self.bounds) != self.dim or any(low >= high for low, high in self.bounds)
        ):
            raise ValueError(f"bounds must be {self.dim} ordered pairs, got {self.bounds}")
        return self

    def foreign_start(self, jitter: float) -> str | None:
        """Why points that are moved by `jitter` spacings are no start that it was trained on."""
        if self.subcells > 1 or bool(jitter) == bool(self.jitter):
            return None
        return f"jitter = {jitter:g}, but trained on starts moved by {self.jitter:g} spacings"

    @property
    def hidden_width(self) -> int:
        """Width of the hidden layers of every MLP."""
        return self.hidden or self.latent

    @property
    def strain_inputs(self) -> int:
        """Width of `features.strain_features`, if vertices are given them."""
        return self.dim * (self.dim + 1) // 2 + 1 + self.dim if self.strain_unit else 0

    @property
    def vertex_inputs(self) -> int:
        """Width of the vertex features, without the type embedding."""
        width = self.history * self.dim + 2 * self.dim + len(self.material_features)
        width += self.dim + 1 if self.depth_range else 0
        width += self.strain_inputs
        return width + (self.dim + 2 if self.baffles == "distance" else 0)

    @property
    def edge_inputs(self) -> int:
        """Width of the edge features."""
        relative = int(self.relative_velocity) + int(self.strain_unit > 0)
        return self.dim + 1 + relative * self.dim

    @classmethod
    def paper(cls, dim: Literal[2, 3] = 2) -> ModelConfig:
        """The GNS of Choi & Kumar: 1,591,826 parameters in 2D and 1,592,979 in 3D."""
        return cls(
            dim=dim,
            spacing=0.00625 if dim == 2 else 0.015625,
            dt=0.0025,
            radius=0.030 if dim == 2 else 0.025,
            history=5,
            latent=128,
            blocks=10,
            activation="relu",
            envelope=False,
            relative_velocity=False,
            subtract_gravity=False,
            walls="clip",
            baffles="points",
            project=False,
            types=PAPER_TYPES,
            noise_std=6.7e-4,
        )

"""A scene as both solvers see it: points, grid, obstacles, material constants and time step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from gns_model.errors import SimulatorError
from gns_model.mpm.contact import SKIN, solid_nodes
from gns_model.mpm.material import MaterialConstants, material_constants, wave_speed
from gns_model.mpm.transfer import PADDING, Lattice
from gns_model.particles import MOVING, Points, check_filling, fill, shaken
from gns_model.scene import Scene
from gns_model.trajectory import DIVERGED, OK, Trajectory

#: Points along one edge of an element of the grid.
POINTS_PER_EDGE = 2
#: Spacings that give the paper's elements, 0.025 m in 2D and 0.03125 m in 3D. (In 3D its points
#: too, 262,144/m³; in 2D it has 4 along an edge, which runs some 10% farther at equal friction.)
DEFAULT_SPACING = {2: 0.0125, 3: 0.015625}
#: Rate at which a point's velocity leans to the grid's [1/s] (findings: results then depend on
#: neither the number of substeps nor E).
DAMPING_RATE = 50.0
#: A point this many times faster than gravity can make it has left physics: the rollout diverged.
ABSURD = 10.0
#: Nodes of the largest grid.
MOST_NODES = 2e8


@dataclass(frozen=True)
class Discretisation:
    """What a user chooses about the solution of a scene, on any device.

    Attributes:
        spacing: distance between material points [m]; an element of the grid is two of them
            wide. None: 0.015625 in 3D and 0.0125 in 2D, which gives the paper's elements.
        frame_interval: time between stored frames [s].
        cfl: share of the stable substep that is used.
        damping_rate: see DAMPING_RATE [1/s].
        jitter: how far the points of the start are moved off their lattice along each axis, in
            spacings; below a half of one. See `particles.shaken`.
        filling: which of the many ways to move them.

    Raises:
        SimulatorError: if a value makes no sense.
    """

    spacing: float | None = None
    frame_interval: float = 0.01
    cfl: float = 0.4
    damping_rate: float = DAMPING_RATE
    jitter: float = 0.0
    filling: int = 0

    def __post_init__(self) -> None:
        require_positive(
            spacing=self.spacing, frame_interval=self.frame_interval, cfl=self.cfl
        )  # fmt: skip
        if not self.damping_rate >= 0:
            raise SimulatorError(f"damping_rate must not be negative, got {self.damping_rate}")
        check_filling(self.jitter, self.filling)

    def spacing_of(self, scene: Scene) -> float:
        """The spacing that `scene` is solved at [m]."""
        return self.spacing or DEFAULT_SPACING[scene.dim]

    def check(self, scene: Scene) -> None:
        """Raise SimulatorError if `scene` would not fit in memory."""
        dx = POINTS_PER_EDGE * self.spacing_of(scene)
        nodes = math.prod(s / dx + 5 for s in scene.domain.size)
        if nodes > MOST_NODES:
            raise SimulatorError(
                f"a grid of {nodes:.0f} nodes ({dx:g} m apart) is too large: raise the spacing"
            )


def require_positive(**values: float | None) -> None:
    """Raise SimulatorError if one of the named values is given and not positive."""
    for key, value in values.items():
        if value is not None and not value > 0:
            raise SimulatorError(f"{key} must be positive, got {value}")


@dataclass(frozen=True)
class Problem:
    """One scene, discretised. Vectors have three components, the third 0 in 2D.

    Attributes:
        scene: what is simulated.
        start: its points at t = 0.
        lattice: the background grid.
        lower, upper: where points may be [m], shape (3,).
        boxes: corners of the baffles along the axes, SKIN larger [m], shape (B, 2, 3).
        turned: corners of the turned baffles as they would stand unturned, likewise (K, 2, 3).
            The top of one that reaches the lid is infinitely high: no way leads out there.
        turns: cosine and sine of their yaw, shape (K, 2).
        solid: for each grid node 0, or the face of the baffle that it lies in, see `solid_nodes`.
        gravity: [m/s²], shape (3,).
        constants: of the material.
        frame_interval: [s].
        frames: number of frames after the first.
        substeps: of one frame.
        keep: share of its own velocity that a point keeps in a substep.
        limit: a point faster than this has left physics [m/s].
    """

    scene: Scene
    start: Points
    lattice: Lattice
    lower: np.ndarray
    upper: np.ndarray
    boxes: np.ndarray
    turned: np.ndarray
    turns: np.ndarray
    solid: np.ndarray
    gravity: np.ndarray
    constants: MaterialConstants
    frame_interval: float
    frames: int
    substeps: int
    keep: float
    limit: float

    @property
    def count(self) -> int:
        """Number of points."""
        return len(self.start.positions)

    @property
    def dt(self) -> float:
        """The substep [s]."""
        return self.frame_interval / self.substeps

    @property
    def point_mass(self) -> float:
        """Mass of one point: [kg], in 2D [kg] per metre of width."""
        return self.scene.material.density * self.start.volume

    def trajectory(
        self, positions: np.ndarray, bad_frame: int | None, settings: dict[str, Any]
    ) -> Trajectory:
        """The result of a rollout.

        Args:
            positions: [m], shape (frames + 1, N, D), float32; from `bad_frame` on they are
                overwritten by the last good frame.
            bad_frame: the first frame in which a point had left physics, or None.
            settings: of the simulator; spacing, element and substep are added.
        """
        if bad_frame is not None:
            positions[bad_frame:] = positions[bad_frame - 1]
        return Trajectory(
            positions=positions,
            time=np.arange(self.frames + 1) * self.frame_interval,
            particle_type=np.full(self.count, MOVING, np.int8),
            scene=self.scene,
            point_volume=self.start.volume,
            simulator="mpm",
            status=OK if bad_frame is None else DIVERGED,
            settings={
                **settings, "spacing": self.start.spacing, "dx": self.lattice.dx,
                "substep": self.dt,
            },
            lattice=self.start.lattice,
        )  # fmt: skip


def pose(scene: Scene, chosen: Discretisation) -> Problem:
    """Discretise a scene.

    The substep is the same for every device and batch: a whole part of the frame interval, at
    most `cfl` of what a compression wave and the fastest possible grain need for an element.
    """
    dim = scene.dim
    spacing = chosen.spacing_of(scene)
    lattice, lower, upper = _lattice(scene, POINTS_PER_EDGE * spacing)
    boxes = np.zeros((len(scene.baffles), 2, 3))
    boxes[:, :, :dim], turns = scene.oriented_boxes()
    boxes[:, 0] -= SKIN
    boxes[:, 1] += SKIN
    askew = turns[:, 1] != 0
    boxes, turned, turns = boxes[~askew], boxes[askew], turns[askew]
    turned[turned[:, 1, 1] >= upper[1] - SKIN, 1, 1] = math.inf
    gravity = np.zeros(3)
    gravity[:dim] = scene.gravity
    fastest = _fastest(scene)
    stable = chosen.cfl * lattice.dx / (wave_speed(scene.material) + fastest)
    substeps = math.ceil(chosen.frame_interval / stable)
    return Problem(
        scene=scene,
        start=shaken(fill(scene, spacing), chosen.jitter, chosen.filling),
        lattice=lattice,
        lower=lower,
        upper=upper,
        boxes=boxes,
        turned=turned,
        turns=turns,
        solid=solid_nodes(lattice, boxes, turned, turns, 0.5 * lattice.dx, lower, upper),
        gravity=gravity,
        constants=material_constants(scene.material),
        frame_interval=chosen.frame_interval,
        frames=max(1, round(scene.duration / chosen.frame_interval)),
        substeps=substeps,
        keep=math.exp(-chosen.damping_rate * (chosen.frame_interval / substeps)),
        limit=ABSURD * fastest,
    )


def _fastest(scene: Scene) -> float:
    """The fastest that grains can get by falling through the whole domain [m/s]."""
    start = max(math.hypot(*release.velocity) for release in scene.releases)
    return math.sqrt(start**2 + 2 * math.hypot(*scene.gravity) * math.hypot(*scene.domain.size))


def _lattice(scene: Scene, dx: float) -> tuple[Lattice, np.ndarray, np.ndarray]:
    """Grid with nodes on the lower faces of the domain, and where points may be, shape (3,)."""
    dim = scene.dim
    lower, upper = np.zeros(3), np.zeros(3)
    lower[:dim] = np.asarray(scene.domain.lower) + SKIN
    upper[:dim] = np.asarray(scene.domain.upper) - SKIN
    origin = lower - SKIN - PADDING * dx
    walls = [PADDING + math.ceil(s / dx - 1e-9) for s in scene.domain.size]
    if dim == 2:
        origin[2] = 0.0
        walls.append(1)
    counts = [w + PADDING + 1 for w in walls[:dim]] + ([1] if dim == 2 else [])
    ox, oy, oz = map(float, origin)
    lattice = Lattice(dx, ox, oy, oz, *counts, *walls, dim == 2)  # type: ignore[arg-type, call-arg]
    return lattice, lower, upper

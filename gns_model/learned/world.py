"""What surrounds the points of a batch: domains, gravity, baffles and material of its scenes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from gns_model.particles import MOVING, STATIONARY
from gns_model.scene import Scene

#: A face this close to a domain wall counts as flush with it: no point passes there [m].
FLUSH = 1e-6

#: Where boxes that fill up a ragged batch stand [m]: beyond every range, and finite.
_FAR = 1e6

#: Columns of `World.material` and `World.point_material`.
MATERIAL_FEATURES = ("tan_friction_angle", "base_friction")


@dataclass(frozen=True)
class World:
    """The surroundings of N points in S scenes with K baffles altogether.

    Attributes:
        batch: scene of every point, int64, shape (N,).
        lower, upper: corners of the domains [m], shape (S, D).
        gravity: [m/s²], shape (S, D).
        boxes: lower and upper corner of every baffle [m], shape (K, 2, D); may require grad.
        box_batch: scene of every baffle, int64, shape (K,).
        material: tan of the friction angle and base friction [-], shape (S, 2).
        particle_type: shape (N,); 6 moves, 3 is a kinematic point of a baffle.
        tan_friction: of every point, shape (N,), where it is not its scene's.
        point_material: `material` of every point, shape (N, 2).
        point_boxes: the baffles that each point may meet [m], shape (N, M, 2, D), M the most of
            any scene. Faces flush with the domain reach far beyond it: what is not a way out for
            a grain is not near for it either. Scenes with fewer have the rest far away.
    """

    batch: Tensor
    lower: Tensor
    upper: Tensor
    gravity: Tensor
    boxes: Tensor
    box_batch: Tensor
    material: Tensor
    particle_type: Tensor
    tan_friction: Tensor | None = None
    point_boxes: Tensor = field(init=False)
    point_lower: Tensor = field(init=False)
    point_upper: Tensor = field(init=False)
    point_gravity: Tensor = field(init=False)
    point_material: Tensor = field(init=False)

    def __post_init__(self) -> None:
        put = object.__setattr__  # the class is frozen; these follow from the other fields
        put(self, "point_boxes", self._scene_boxes()[self.batch])
        put(self, "point_lower", self.lower[self.batch])
        put(self, "point_upper", self.upper[self.batch])
        put(self, "point_gravity", self.gravity[self.batch])
        material = self.material[self.batch]
        if self.tan_friction is not None:
            material = torch.cat([self.tan_friction[:, None], material[:, 1:]], dim=1)
        put(self, "point_material", material)

    def _scene_boxes(self) -> Tensor:
        """Boxes by scene with flush faces extended, shape (S, M, 2, D)."""
        scenes, dim = self.lower.shape
        if len(self.boxes) == 0:
            return self.boxes.new_zeros((scenes, 0, 2, dim))
        low, high = self.boxes[:, 0], self.boxes[:, 1]
        low = torch.where(low - self.lower[self.box_batch] < FLUSH, low - _FAR, low)
        high = torch.where(self.upper[self.box_batch] - high < FLUSH, high + _FAR, high)
        count = torch.bincount(self.box_batch, minlength=scenes)
        order = self.box_batch.argsort(stable=True)
        first = count.cumsum(0) - count
        slot = torch.empty_like(order)
        slot[order] = torch.arange(len(order), device=order.device) - first[self.box_batch[order]]
        far = self.boxes.new_full((scenes, int(count.max()), 2, dim), _FAR)
        return far.index_put((self.box_batch, slot), torch.stack([low, high], dim=1))

    @property
    def moving(self) -> Tensor:
        """Mask of the points that the simulator moves, shape (N,)."""
        return self.particle_type != STATIONARY

    @classmethod
    def from_scenes(
        cls,
        scenes: Sequence[Scene],
        counts: Sequence[int],
        *,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
        centres: Sequence[Tensor] | None = None,
        particle_type: Tensor | None = None,
        tan_friction: Tensor | None = None,
    ) -> World:
        """The world of a block-diagonal batch.

        Args:
            scenes: S scenes of one dimension.
            counts: number of points of each, in the order in which the batch holds them.
            centres: replaces the plan centres [m] of the baffles, one tensor (B, D-1) a scene;
                everything that is computed in this world is then differentiable in them.
            particle_type: shape (N,); default: all points move.
            tan_friction: tan of the friction angle of every point, shape (N,), in place of the
                scenes' angles.
        """
        if centres is not None and len(centres) != len(scenes):
            raise ValueError(f"{len(scenes)} scenes, but centres for {len(centres)}")

        def tensor(values: object) -> Tensor:
            return torch.tensor(values, dtype=dtype, device=device)

        def corner(values: object) -> Tensor:
            return torch.tensor(values, dtype=torch.float64, device=device)

        boxes = []
        for k, scene in enumerate(scenes):
            own = centres[k] if centres is not None else None
            boxes.append(baffle_boxes(scene, own, device=device, dtype=dtype))
        number = torch.tensor([len(b) for b in boxes], device=device)
        per_point = torch.tensor(list(counts), device=device)
        index = torch.arange(len(scenes), device=device)
        batch = torch.repeat_interleave(index, per_point)
        if particle_type is None:
            particle_type = torch.full_like(batch, MOVING)
        if tan_friction is not None:
            tan_friction = tan_friction.to(device=device, dtype=dtype)
        return cls(
            batch=batch,
            lower=_rounded(corner([s.domain.lower for s in scenes]), dtype, up=True),
            upper=_rounded(corner([s.domain.upper for s in scenes]), dtype, up=False),
            gravity=tensor([s.gravity for s in scenes]),
            boxes=torch.cat(boxes),
            box_batch=torch.repeat_interleave(index, number),
            material=tensor(
                [
                    [math.tan(math.radians(s.material.friction_angle)), s.friction.base]
                    for s in scenes
                ]
            ),
            particle_type=particle_type.to(device),
            tan_friction=tan_friction,
        )

    @classmethod
    def from_bounds(
        cls,
        bounds: Sequence[Sequence[float]],
        particle_type: Tensor,
        *,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
        tan_friction: Tensor | None = None,
    ) -> World:
        """A domain without a scene, for points that came from elsewhere.

        Gravity is 9.81 m/s² downwards, the friction of the base is not known and there are no
        baffles but kinematic points.

        Args:
            bounds: lowest and highest coordinate [m], shape (D, 2).
            particle_type: shape (N,).
            tan_friction: of every point, shape (N,), if it is known.
        """
        corners = torch.tensor(bounds, dtype=torch.float64, device=device)
        dim = len(corners)
        gravity = torch.zeros((1, dim), dtype=dtype, device=device)
        gravity[0, 1] = -9.81
        particle_type = particle_type.to(device)
        return cls(
            batch=torch.zeros_like(particle_type, dtype=torch.int64),
            lower=_rounded(corners[None, :, 0], dtype, up=True),
            upper=_rounded(corners[None, :, 1], dtype, up=False),
            gravity=gravity,
            boxes=torch.zeros((0, 2, dim), dtype=dtype, device=device),
            box_batch=torch.zeros(0, dtype=torch.int64, device=device),
            material=torch.full((1, 2), math.nan, dtype=dtype, device=device),
            particle_type=particle_type,
            tan_friction=(
                None if tan_friction is None else tan_friction.to(device=device, dtype=dtype)
            ),
        )


def baffle_boxes(
    scene: Scene,
    centres: Tensor | None = None,
    *,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Corners of the baffles of `scene` [m], shape (B, 2, D), differentiable in `centres` (B, D-1).

    Raises:
        ValueError: if `centres` is not one plan centre for every baffle of the scene.
    """
    shape = (len(scene.baffles), scene.dim - 1)
    if centres is None:
        exact = torch.tensor(scene.baffle_boxes(), dtype=torch.float64, device=device)
    elif tuple(centres.shape) != shape:
        raise ValueError(f"centres must have shape {shape}, got {tuple(centres.shape)}")
    else:
        centres = centres.to(device=device, dtype=torch.float64)
        size = torch.tensor([b.size for b in scene.baffles], dtype=torch.float64, device=device)
        base = torch.full_like(centres[:, :1], scene.base)
        half = torch.cat([size[:, :1], size[:, 2:]], dim=1) / 2
        low, high = centres - half, centres + half
        exact = torch.stack(
            [
                torch.cat([low[:, :1], base, low[:, 1:]], dim=1),
                torch.cat([high[:, :1], base + size[:, 1:2], high[:, 1:]], dim=1),
            ],
            dim=1,
        )
    return torch.stack(
        [_rounded(exact[:, 0], dtype, up=False), _rounded(exact[:, 1], dtype, up=True)], dim=1
    )


def _rounded(exact: Tensor, dtype: torch.dtype, *, up: bool) -> Tensor:
    """Float64 corners in `dtype`, rounded up or down, so that boxes only grow and domains shrink.

    A point on a face is then never inside the exact baffle, nor outside the exact domain.
    """
    near = exact.to(dtype)
    with torch.no_grad():
        wrong = near.double() < exact if up else near.double() > exact
        beyond = torch.nextafter(near, torch.full_like(near, math.inf if up else -math.inf))
        shift = torch.where(wrong, beyond - near, torch.zeros_like(near))
    return near + shift


def baffle_points(boxes: Tensor, spacing: float) -> Tensor:
    """The paper's kinematic points: boxes filled with a lattice about `spacing` [m] apart.

    Args:
        boxes: lower and upper corners [m], shape (B, 2, D); may require grad.

    Returns:
        positions [m], shape (P, D), differentiable in the boxes.
    """
    points = []
    for low, high in boxes:
        size = high - low
        counts = [max(1, round(float(s) / spacing)) for s in size.detach()]
        axes = [(torch.arange(n, device=boxes.device, dtype=boxes.dtype) + 0.5) / n for n in counts]
        unit = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, len(counts))
        points.append(low + unit * size)
    return torch.cat(points) if points else boxes.new_zeros((0, boxes.shape[-1]))

"""What surrounds the points of a batch: domains, gravity, baffles and material of its scenes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from gns_model import footprint
from gns_model.learned.features import out_of_frames
from gns_model.particles import MOVING, STATIONARY
from gns_model.scene import Scene

#: A face this close to a domain wall counts as flush with it: no point passes there [m].
FLUSH = 1e-6

#: Where boxes that fill up a ragged batch stand [m]: beyond every range, and finite.
_FAR = 1e6

#: Turned boxes are taken larger by this many round-offs of the largest coordinate.
ROUNDED = 4

#: Columns of `World.material` and `World.point_material`.
MATERIAL_FEATURES = ("tan_friction_angle", "base_friction")


@dataclass(frozen=True)
class World:
    """The surroundings of N points in S scenes with K baffles altogether.

    Attributes:
        batch: scene of every point, int64, shape (N,).
        lower, upper: corners of the domains [m], shape (S, D).
        gravity: [m/s²], shape (S, D).
        boxes: lower and upper corner of every baffle, as it would stand unturned [m], shape
            (K, 2, D); may require grad.
        box_batch: scene of every baffle, int64, shape (K,).
        material: tan of the friction angle and base friction [-], shape (S, 2).
        particle_type: shape (N,); 6 moves, 3 is a kinematic point of a baffle.
        tan_friction: of every point, shape (N,), where it is not its scene's.
        turns: cosine and sine of the yaw of every baffle about the vertical through its middle,
            shape (K, 2); None: all lie along the axes.
        point_material: `material` of every point, shape (N, 2).
        point_boxes: the baffles that each point may meet [m], shape (N, M, 2, D), M the most of
            any scene. Faces flush with the domain reach far beyond it: what is not a way out for
            a grain is not near for it either. Scenes with fewer have the rest far away.
        point_frames: their middle (x, z) [m], cosine and sine, shape (N, M, 4), or None as `turns`.
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
    turns: Tensor | None = None
    point_boxes: Tensor = field(init=False)
    point_frames: Tensor | None = field(init=False)
    point_lower: Tensor = field(init=False)
    point_upper: Tensor = field(init=False)
    point_gravity: Tensor = field(init=False)
    point_material: Tensor = field(init=False)

    def __post_init__(self) -> None:
        put = object.__setattr__  # the class is frozen; these follow from the other fields
        boxes, frames = self._scene_boxes()
        put(self, "point_boxes", boxes[self.batch])
        put(self, "point_frames", None if frames is None else frames[self.batch])
        put(self, "point_lower", self.lower[self.batch])
        put(self, "point_upper", self.upper[self.batch])
        put(self, "point_gravity", self.gravity[self.batch])
        material = self.material[self.batch]
        if self.tan_friction is not None:
            material = torch.cat([self.tan_friction[:, None], material[:, 1:]], dim=1)
        put(self, "point_material", material)

    def _scene_boxes(self) -> tuple[Tensor, Tensor | None]:
        """Boxes by scene with flush faces extended, shape (S, M, 2, D), and frames (S, M, 4)."""
        scenes, dim = self.lower.shape
        if len(self.boxes) == 0:
            return self.boxes.new_zeros((scenes, 0, 2, dim)), None
        low, high = self.boxes[:, 0], self.boxes[:, 1]
        below = low - self.lower[self.box_batch] < FLUSH
        above = self.upper[self.box_batch] - high < FLUSH
        if self.turns is not None:
            # Of a turned baffle only the bottom, and a top at the lid, can be flush.
            flat = torch.tensor([False, True, False], device=low.device)
            flat = flat | (self.turns[:, 1:] == 0)
            below, above = below & flat, above & flat
        middle = (low + high)[:, ::2] / 2
        low = torch.where(below, low - _FAR, low)
        high = torch.where(above, high + _FAR, high)
        count = torch.bincount(self.box_batch, minlength=scenes)
        order = self.box_batch.argsort(stable=True)
        first = count.cumsum(0) - count
        slot = torch.empty_like(order)
        slot[order] = torch.arange(len(order), device=order.device) - first[self.box_batch[order]]
        far = self.boxes.new_full((scenes, int(count.max()), 2, dim), _FAR)
        boxes = far.index_put((self.box_batch, slot), torch.stack([low, high], dim=1))
        if self.turns is None:
            return boxes, None
        frames = self.boxes.new_tensor([0.0, 0.0, 1.0, 0.0]).expand(*far.shape[:2], 4)
        own = torch.cat([middle, self.turns], dim=1)
        return boxes, frames.clone().index_put((self.box_batch, slot), own)

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
        sizes: Sequence[Tensor] | None = None,
        yaws: Sequence[Tensor] | None = None,
        particle_type: Tensor | None = None,
        tan_friction: Tensor | None = None,
    ) -> World:
        """The world of a block-diagonal batch.

        Args:
            scenes: S scenes of one dimension.
            counts: number of points of each, in the order in which the batch holds them.
            centres: replaces the plan centres [m] of the baffles, one tensor (B, D-1) a scene;
                everything that is computed in this world is then differentiable in them.
            sizes: likewise the sizes [m], one tensor (B, D) a scene.
            yaws: likewise the yaws [degrees], one tensor (B,) a scene.
            particle_type: shape (N,); default: all points move.
            tan_friction: tan of the friction angle of every point, shape (N,), in place of the
                scenes' angles.
        """
        own = {"centres": centres, "sizes": sizes, "yaws": yaws}
        for name, given in own.items():
            if given is not None and len(given) != len(scenes):
                raise ValueError(f"{len(scenes)} scenes, but {name} for {len(given)}")

        def tensor(values: object) -> Tensor:
            return torch.tensor(values, dtype=dtype, device=device)

        def corner(values: object) -> Tensor:
            return torch.tensor(values, dtype=torch.float64, device=device)

        poses = []
        askew = yaws is not None or any(scene.is_turned for scene in scenes)
        for k, scene in enumerate(scenes):
            of_scene: dict[str, Any] = {
                name: given[k] for name, given in own.items() if given is not None
            }
            poses.append(baffle_poses(scene, **of_scene, turned=askew, device=device, dtype=dtype))
        boxes = [box for box, _ in poses]
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
            turns=torch.cat([turn for _, turn in poses]) if askew else None,  # type: ignore[misc]
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


def baffle_poses(
    scene: Scene,
    centres: Tensor | None = None,
    sizes: Tensor | None = None,
    yaws: Tensor | None = None,
    *,
    turned: bool | None = None,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> tuple[Tensor, Tensor | None]:
    """The baffles of `scene` as boxes and their turns, differentiable in what is given.

    Args:
        centres: plan centres [m], shape (B, D-1); default: the scene's, as with all three.
        sizes: [m], shape (B, D).
        yaws: [degrees], shape (B,).
        turned: whether to return turns; default: where a baffle stands, or may stand, askew.

    Returns:
        corners as the baffles would stand unturned [m], shape (B, 2, D); and cosine and sine of
        their yaws, shape (B, 2), or None.

    Raises:
        ValueError: if a tensor does not hold one row for every baffle of the scene.
    """
    count = len(scene.baffles)
    exact: dict[str, Any] = {"dtype": torch.float64, "device": device}
    shapes = {"centres": (count, scene.dim - 1), "sizes": (count, scene.dim), "yaws": (count,)}
    for (name, shape), given in zip(shapes.items(), (centres, sizes, yaws), strict=True):
        if given is not None and tuple(given.shape) != shape:
            raise ValueError(f"{name} must have shape {shape}, got {tuple(given.shape)}")
    # With neither sizes nor yaws to go by, a quarter turn is a box along the axes.
    own = sizes is not None or yaws is not None
    poses = [(b.size, b.yaw) if own else b.unturned for b in scene.baffles]
    if turned is None:
        turned = yaws is not None or any(yaw for _, yaw in poses)
    if centres is None and not own:
        corners = torch.tensor(scene.oriented_boxes()[0], **exact)
    else:
        if centres is None:
            centres = torch.tensor([b.center for b in scene.baffles], **exact)
        if sizes is None:
            sizes = torch.tensor([size for size, _ in poses], **exact)
        corners = _corners(centres.to(**exact), sizes.to(**exact), scene.base)
    if not turned:
        low, high = corners[:, 0], corners[:, 1]
        return (
            torch.stack([_rounded(low, dtype, up=False), _rounded(high, dtype, up=True)], dim=1),
            None,
        )
    if yaws is None:
        turns = torch.tensor([footprint.turn(yaw) for _, yaw in poses], **exact).reshape(-1, 2)
    else:
        angle = torch.deg2rad(yaws.to(**exact))
        turns = torch.stack([angle.cos(), angle.sin()], dim=1)
    # Larger by more than turning to and fro rounds off, so that no point on a face is inside.
    reach = max(map(abs, (*scene.domain.lower, *scene.domain.upper)))
    skin = ROUNDED * torch.finfo(dtype).eps * reach
    grown = torch.stack([corners[:, 0] - skin, corners[:, 1] + skin], dim=1)
    return grown.to(dtype), turns.to(dtype)


def baffle_boxes(
    scene: Scene,
    centres: Tensor | None = None,
    *,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """The corners alone of `baffle_poses` [m], shape (B, 2, D)."""
    return baffle_poses(scene, centres, device=device, dtype=dtype)[0]


def _corners(centres: Tensor, sizes: Tensor, base: float) -> Tensor:
    """Corners of boxes along the axes [m], shape (B, 2, D)."""
    foot = torch.full_like(centres[:, :1], base)
    half = torch.cat([sizes[:, :1], sizes[:, 2:]], dim=1) / 2
    low, high = centres - half, centres + half
    return torch.stack(
        [
            torch.cat([low[:, :1], foot, low[:, 1:]], dim=1),
            torch.cat([high[:, :1], foot + sizes[:, 1:2], high[:, 1:]], dim=1),
        ],
        dim=1,
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


def baffle_points(boxes: Tensor, spacing: float, turns: Tensor | None = None) -> Tensor:
    """The paper's kinematic points: boxes filled with a lattice about `spacing` [m] apart.

    Args:
        boxes: lower and upper corners [m], shape (B, 2, D); may require grad.
        turns: cosine and sine of their yaws, shape (B, 2); see `baffle_poses`.

    Returns:
        positions [m], shape (P, D), differentiable in boxes and turns.
    """
    points = []
    for k, (low, high) in enumerate(boxes):
        size = high - low
        counts = [max(1, round(float(s) / spacing)) for s in size.detach()]
        axes = [(torch.arange(n, device=boxes.device, dtype=boxes.dtype) + 0.5) / n for n in counts]
        unit = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, len(counts))
        lattice = low + unit * size
        if turns is not None:
            frame = torch.cat([(low + high)[::2] / 2, turns[k]])
            lattice = out_of_frames(lattice, frame.expand(len(lattice), 4))
        points.append(lattice)
    return torch.cat(points) if points else boxes.new_zeros((0, boxes.shape[-1]))

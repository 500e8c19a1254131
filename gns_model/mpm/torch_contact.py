"""The contact laws of `contact.py` for all points and nodes of a batch at once, in torch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gns_model.mpm.contact import SKIN, TURNED
from gns_model.mpm.problem import Problem
from gns_model.mpm.transfer import PADDING

#: Axis and sign of the outward normals of a baffle's faces, in the order of `nearest_face`; in 2D
#: the first three. A baffle stands on the base: there is no way out below.
FACES = ((0, -1.0), (0, 1.0), (1, 1.0), (2, -1.0), (2, 1.0))
#: Least divisor.
TINY = 1e-300


def slide(velocity: Tensor, normal: Tensor, mu: Tensor | None) -> Tensor:
    """Velocities [m/s], shape (K, D), after contact with faces: Coulomb friction.

    Args:
        normal: outward unit normals, or 0 for no contact, shape (K, D).
        mu: shape (K, 1); None for smooth faces.
    """
    approach = (velocity * normal).sum(1, keepdim=True).clamp_(max=0.0)
    velocity = torch.addcmul(velocity, approach, normal, value=-1.0)
    if mu is None:
        return velocity
    speed = torch.linalg.vector_norm(velocity, dim=1, keepdim=True).clamp_(min=TINY)
    # Friction takes mu times what the normal component lost, but not more than there is.
    return velocity * (1.0 + approach * mu / speed).clamp_(min=0.0)


@dataclass(frozen=True)
class NodeContact:
    """Nodes on which one kind of boundary acts: index (K,), outward normal (K, D), mu (K, 1)."""

    index: Tensor
    normal: Tensor
    mu: Tensor | None  #: None if all are smooth

    def apply(self, velocity: Tensor) -> None:
        """Resolve the contact of nodal velocities [m/s], shape (G, D), in place."""
        after = slide(velocity.index_select(0, self.index), self.normal, self.mu)
        velocity.index_copy_(0, self.index, after)


def node_contacts(problems: Sequence[Problem], device: torch.device) -> list[NodeContact]:
    """What acts on the nodes of all scenes, in the order in which `transfer.update_grid` has it:
    nodes inside baffles, walls across x, walls across z, base and lid."""
    stages: list[list[tuple[np.ndarray, ...]]] = [[], [], [], []]
    first = 0
    for problem in problems:
        friction, dim = problem.scene.friction, problem.scene.dim
        normals = np.zeros((len(FACES) + 1, 3))
        for face, (axis, sign) in enumerate(FACES, start=1):
            normals[face, axis] = sign
        normals = np.concatenate([normals, _side_normals(problem.turns)])
        inside = np.flatnonzero(problem.solid)
        found = [
            (inside, normals[problem.solid[inside]], np.full(len(inside), friction.baffles)),
            _walls(problem, 0, friction.walls),
            _walls(problem, 2, friction.walls),
            _walls(problem, 1, friction.base),
        ]
        for stage, (index, normal, mu) in zip(stages, found, strict=True):
            stage.append((index + first, normal[:, :dim], mu[:, None]))
        first += len(problem.solid)
    joined = ([np.concatenate(column) for column in zip(*s, strict=True)] for s in stages)
    return [
        NodeContact(
            torch.tensor(index, device=device),
            torch.tensor(normal, device=device),
            torch.tensor(mu, device=device) if mu.any() else None,
        )
        for index, normal, mu in joined
        if len(index)
    ]


def _side_normals(turns: np.ndarray) -> np.ndarray:
    """Outward normals of the sides -x, +x, -z, +z of turned boxes, (B, 2), shape (4 B, 3)."""
    assert len(FACES) + 1 == TURNED, "sides of turned boxes have the codes after all faces"
    (cosine, sine), none = turns.T, np.zeros(len(turns))
    along, across = np.stack([cosine, none, sine], 1), np.stack([-sine, none, cosine], 1)
    return np.stack([-along, along, -across, across], axis=1).reshape(-1, 3)


def _walls(problem: Problem, axis: int, mu_low: float) -> tuple[np.ndarray, ...]:
    """Index, normal and friction of the nodes on and beyond both faces of the domain on `axis`."""
    lattice = problem.lattice
    wall = (lattice.wall_x, lattice.wall_y, lattice.wall_z)[axis]
    along = np.indices((lattice.nx, lattice.ny, lattice.nz))[axis].ravel()
    low, high = along <= PADDING, along >= wall
    index = np.flatnonzero((low | high) & (axis < problem.scene.dim))
    normal = np.zeros((len(index), 3))
    normal[:, axis] = np.where(low[index], 1.0, -1.0)
    return index, normal, np.where(low[index], mu_low, problem.scene.friction.walls)


@dataclass(frozen=True)
class BoxContact:
    """Baffles that no point can be inside two of: at most B in a scene, with F faces each.

    Attributes:
        axes, inwards: axis of every face and sign of its inward normal, shape (F,).
        normals: outward normals of the faces of B baffles, shape (B F, D).
        offset: depth of the origin below every face [m], shape (P, B, F): minus infinity where
            the point's scene has fewer baffles.
        closed: infinity where a face is flush with a wall, so that no way leads out; else 0.
        mu: shape (P, 1).
    """

    axes: Tensor
    inwards: Tensor
    normals: Tensor
    offset: Tensor
    closed: Tensor
    mu: Tensor

    def apply(self, position: Tensor, velocity: Tensor) -> tuple[Tensor, Tensor]:
        """Put points that entered a baffle back on its nearest face, with friction there."""
        along = position.index_select(1, self.axes)
        depth = torch.addcmul(self.offset, along[:, None, :], self.inwards)
        outside = (depth <= 0.0).any(2, keepdim=True)
        depth = (depth + self.closed).masked_fill_(outside, math.inf)
        nearest, face = depth.flatten(1).min(1, keepdim=True)
        touched = nearest < math.inf
        normal = self.normals.index_select(0, face[:, 0])
        return (
            torch.where(touched, torch.addcmul(position, normal, nearest), position),
            torch.where(touched, slide(velocity, normal, self.mu), velocity),
        )


@dataclass(frozen=True)
class TurnedContact:
    """As `BoxContact`, for baffles that are turned about the vertical.

    Attributes:
        middle, half: of every baffle in plan [m], shape (P, B, 2): half is minus infinity where
            the point's scene has fewer baffles.
        top: height of the top [m], infinite where it is flush with the lid, shape (P, B).
        turns: cosine and sine of the yaw, shape (P, B, 2).
        normals: outward normals of the faces in a baffle's frame, shape (5, 3).
        mu: shape (P, 1).
    """

    middle: Tensor
    half: Tensor
    top: Tensor
    turns: Tensor
    normals: Tensor
    mu: Tensor

    def apply(self, position: Tensor, velocity: Tensor) -> tuple[Tensor, Tensor]:
        """Put points that entered a baffle back on its nearest face, with friction there."""
        cosine, sine = self.turns.unbind(2)
        x, z = position[:, :1] - self.middle[..., 0], position[:, 2:] - self.middle[..., 1]
        u, v = cosine * x + sine * z, cosine * z - sine * x
        a, b = self.half.unbind(2)
        depth = torch.stack([u + a, a - u, self.top - position[:, 1:2], v + b, b - v], dim=2)
        depth = depth.masked_fill_((depth <= 0.0).any(2, keepdim=True), math.inf)
        nearest, face = depth.flatten(1).min(1, keepdim=True)
        touched = nearest < math.inf
        along, up, across = self.normals.index_select(0, face[:, 0] % len(FACES)).T
        own = torch.div(face, len(FACES), rounding_mode="floor")
        cosine, sine = cosine.gather(1, own)[:, 0], sine.gather(1, own)[:, 0]
        normal = torch.stack(
            [cosine * along - sine * across, up, sine * along + cosine * across], 1
        )
        nearest = nearest.masked_fill(~touched, 0.0)
        return (
            torch.where(touched, torch.addcmul(position, normal, nearest), position),
            torch.where(touched, slide(velocity, normal, self.mu), velocity),
        )


def box_contacts(
    problems: Sequence[Problem], counts: Tensor, device: torch.device
) -> list[BoxContact]:
    """The baffles along the axes of all scenes, which have `counts` points, shape (S,).

    The numba solver takes baffles one by one; where two touch, a point can be put from one into
    the other. So baffles that lie apart are resolved together, and those that touch in turn.
    """
    dim = problems[0].scene.dim
    faces = FACES[: 2 * dim - 1]
    axes = np.array([axis for axis, _ in faces])
    signs = np.array([sign for _, sign in faces])
    normals = np.zeros((len(faces), dim))
    normals[np.arange(len(faces)), axes] = signs
    friction = [p.scene.friction.baffles for p in problems]
    contacts = []
    for now in _rounds([problem.boxes[:, :, :dim] for problem in problems]):
        chosen = [p.boxes[n] for n, p in zip(now, problems, strict=True)]
        most = max(map(len, chosen))
        offset = np.full((len(problems), most, len(faces)), -math.inf)
        closed = np.zeros_like(offset)
        for row, (problem, boxes) in enumerate(zip(problems, chosen, strict=True)):
            face = boxes[:, (signs > 0).astype(int), axes]
            bound = signs * np.where(signs > 0, problem.upper[axes], problem.lower[axes])
            offset[row, : len(boxes)] = signs * face
            closed[row, : len(boxes)][signs * face >= bound - SKIN] = math.inf
        contacts.append(
            BoxContact(
                axes=torch.tensor(axes, device=device),
                inwards=torch.tensor(-signs, device=device),
                normals=torch.tensor(np.tile(normals, (most, 1)), device=device),
                offset=torch.tensor(offset, device=device).repeat_interleave(counts, 0),
                closed=torch.tensor(closed, device=device).repeat_interleave(counts, 0),
                mu=torch.tensor(friction, dtype=torch.float64, device=device)
                .repeat_interleave(counts)
                .unsqueeze(1),
            )
        )
    return contacts


def turned_contacts(
    problems: Sequence[Problem], counts: Tensor, device: torch.device
) -> list[TurnedContact]:
    """As `box_contacts`, for the turned baffles."""
    rounds = _rounds([_holding(p.turned, p.turns) for p in problems])
    return [_turned_contact(problems, now, counts, device) for now in rounds]


def _turned_contact(
    problems: Sequence[Problem], chosen: list[np.ndarray], counts: Tensor, device: torch.device
) -> TurnedContact:
    """The chosen ones of the turned baffles of each scene."""
    most = max(int(mask.sum()) for mask in chosen)
    middle, half, turns = np.zeros((3, len(problems), most, 2))
    top = np.zeros((len(problems), most))
    half[:] = -math.inf
    for row, (problem, mask) in enumerate(zip(problems, chosen, strict=True)):
        low, high = problem.turned[mask][:, :, [0, 2]].swapaxes(0, 1)
        n = len(low)
        middle[row, :n], half[row, :n] = (low + high) / 2, (high - low) / 2
        top[row, :n], turns[row, :n] = problem.turned[mask][:, 1, 1], problem.turns[mask]
    normals = np.zeros((len(FACES), 3))
    normals[np.arange(len(FACES)), [axis for axis, _ in FACES]] = [sign for _, sign in FACES]
    friction = np.array([[p.scene.friction.baffles] for p in problems])

    def by_point(values: np.ndarray) -> Tensor:
        return torch.tensor(values, dtype=torch.float64, device=device).repeat_interleave(counts, 0)

    return TurnedContact(
        middle=by_point(middle),
        half=by_point(half),
        top=by_point(top),
        turns=by_point(turns),
        normals=torch.tensor(normals, device=device),
        mu=by_point(friction),
    )


def _holding(turned: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Corners of boxes along the axes that hold turned ones, shape (B, 2, 3) [m]."""
    low, high = turned[:, :, [0, 2]].swapaxes(0, 1)
    middle, (a, b) = (low + high) / 2, (high - low).T / 2
    cosine, sine = np.abs(turns).T
    reach = np.stack([a * cosine + b * sine, a * sine + b * cosine], axis=1)
    boxes = turned.copy()
    boxes[:, :, [0, 2]] = np.stack([middle - reach, middle + reach], axis=1)
    return boxes


def _rounds(boxes: Sequence[np.ndarray]) -> list[list[np.ndarray]]:
    """Which boxes of each scene, (B, 2, D) each, are resolved in each round, as masks (B,): every
    one after all that come before it in its scene and touch it."""
    number = []
    for own in boxes:
        rounds: list[int] = []
        for n, box in enumerate(own):
            touching = ((own[:n, 0] <= box[1]) & (own[:n, 1] >= box[0])).all(1)
            rounds.append(1 + max((rounds[k] for k in np.flatnonzero(touching)), default=-1))
        number.append(np.array(rounds, dtype=int))
    last = max((int(n.max(initial=-1)) for n in number), default=-1)
    return [[n == k for n in number] for k in range(last + 1)]

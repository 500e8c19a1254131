"""Scenes side by side: their points and nodes as rows of flat tensors, each with its own grid.

Every point carries its scene's constants (element, substep, mass, ...), so that scenes of any
size, domain, material and substep advance together and none knows of the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from gns_model.mpm.problem import Problem
from gns_model.mpm.torch_contact import (
    BoxContact,
    NodeContact,
    TurnedContact,
    box_contacts,
    node_contacts,
    turned_contacts,
)
from gns_model.mpm.torch_material import Materials, voigt_rows

#: Nodes of a B-spline's support along an axis.
SUPPORT = 3
#: Its weights at nodes 0, 1, 2 are SCALE (f - CENTRE)² + HEIGHT, with f in [0.5, 1.5) the distance
#: of the point from node 0 in elements. Squares, so that no weight is rounded below 0.
CENTRE, SCALE, HEIGHT = (1.5, 1.0, 0.5), (0.5, -1.0, 0.5), (0.0, 0.75, 0.0)


@dataclass
class State:
    """What changes in a substep, of all points of a batch. Advanced in place.

    Attributes:
        position: [m], shape (P, D).
        velocity: [m/s], shape (P, D).
        affine: velocity gradient [1/s], shape (P, D, D).
        stress: three normal, then three shear stresses in Voigt's order [Pa], shape (6, P).
        strain: logarithmic volume strain [-], shape (P,).
    """

    position: Tensor
    velocity: Tensor
    affine: Tensor
    stress: Tensor
    strain: Tensor

    @classmethod
    def start(cls, problems: Sequence[Problem], device: torch.device) -> State:
        """The points at t = 0."""
        position = np.concatenate([p.start.positions for p in problems])
        velocity = np.concatenate([p.start.velocities for p in problems])
        count, dim = position.shape

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(shape, dtype=torch.float64, device=device)

        return cls(
            position=torch.tensor(position, device=device),
            velocity=torch.tensor(velocity, device=device),
            affine=zeros(count, dim, dim),
            stress=zeros(6, count),
            strain=zeros(count),
        )

    def pick(self, parts: Sequence[slice]) -> State:
        """The points of some scenes only, given the slices that they fill."""

        def of(values: Tensor, axis: int = 0) -> Tensor:
            return torch.cat([values.narrow(axis, s.start, s.stop - s.start) for s in parts], axis)

        return State(
            of(self.position),
            of(self.velocity),
            of(self.affine),
            of(self.stress, 1),
            of(self.strain),
        )

    def tensors(self) -> list[Tensor]:
        """The tensors of all attributes."""
        return [getattr(self, field.name) for field in fields(self)]


@dataclass(frozen=True)
class Batch:
    """What does not change: constants of every point, shape (P, ...), and of every node.

    Attributes:
        parts: the slice of the points that each scene fills.
        inverse, start: 1/dx [1/m], (P, 1), and -x/dx of node 0, (P, D).
        zero: the number 0.
        last: highest first node of a support, (P, D): whatever a position holds, even NaN, its
            scene reads and writes its own nodes.
        stride, support: node index = (first node) . stride + support, (P, D) and (P, K).
        lower, upper: where the point may be [m], (P, D).
        dt: substep [s], (P, 1).
        keep: share of its own velocity that the point keeps in a substep, (P, 1).
        mass: [kg], (P, 1).
        mass_dx: mass times element [kg m], (P, 1, 1).
        impulse: -4 V dt / dx, stress to impulse [m² s], (P, 1, 1).
        slope: 4 / dx, moments of velocity to its gradient [1/m], (P, 1, 1).
        fall: gravity times substep at every node [m/s], (G, D).
        spline: CENTRE, SCALE and HEIGHT, each of shape (1, 3, 1).
        offsets: place of every node in its support, (K, D).
        matrix_rows: see `voigt_rows`.
        basis, coefficients, grid, gradient: memory that a substep works in, (P, K, 1 + D),
            (P, 1 + D, 1 + 2 D), (G, 2 D) and (3, 3, P); what it does not write is constant.
    """

    parts: list[slice]
    inverse: Tensor
    start: Tensor
    zero: Tensor
    last: Tensor
    stride: Tensor
    support: Tensor
    lower: Tensor
    upper: Tensor
    dt: Tensor
    keep: Tensor
    mass: Tensor
    mass_dx: Tensor
    impulse: Tensor
    slope: Tensor
    fall: Tensor
    spline: tuple[Tensor, Tensor, Tensor]
    offsets: Tensor
    matrix_rows: Tensor
    basis: Tensor
    coefficients: Tensor
    grid: Tensor
    gradient: Tensor
    materials: Materials
    nodes: list[NodeContact]
    boxes: list[BoxContact]
    turned: list[TurnedContact]

    @classmethod
    def of(cls, problems: Sequence[Problem], device: torch.device) -> Batch:
        """Lay out scenes of one dimension."""
        dim = problems[0].scene.dim
        counts = torch.tensor([p.count for p in problems], device=device)
        ends = np.cumsum([p.count for p in problems])
        total = int(ends[-1])

        def tensor(values: object) -> Tensor:
            return torch.tensor(np.asarray(values), device=device)

        def points(value: Callable[[Problem], object]) -> Tensor:
            return tensor([value(p) for p in problems]).repeat_interleave(counts, 0)

        sizes = [(p.lattice.nx, p.lattice.ny, p.lattice.nz)[:dim] for p in problems]
        strides = [np.cumprod((1, *size[:0:-1]))[::-1] for size in sizes]
        stencil = np.indices((SUPPORT,) * dim).reshape(dim, -1).T
        first = np.cumsum([0] + [len(p.solid) for p in problems])[:-1]
        support = tensor([f + stencil @ s for f, s in zip(first, strides, strict=True)])

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(shape, dtype=torch.float64, device=device)

        nodes = sum(len(p.solid) for p in problems)
        coefficients = zeros(total, 1 + dim, 1 + 2 * dim)
        mass = points(lambda p: [p.point_mass])
        coefficients[:, 0, 0] = mass[:, 0]
        return cls(
            parts=[slice(int(e) - p.count, int(e)) for e, p in zip(ends, problems, strict=True)],
            inverse=points(lambda p: [1.0 / p.lattice.dx]),
            start=points(
                lambda p: -np.array([p.lattice.ox, p.lattice.oy, p.lattice.oz])[:dim] / p.lattice.dx
            ),
            zero=torch.tensor(0, device=device),
            last=tensor(np.array(sizes) - SUPPORT).repeat_interleave(counts, 0),
            stride=tensor(np.array(strides)).repeat_interleave(counts, 0),
            support=support.repeat_interleave(counts, 0),
            lower=points(lambda p: p.lower[:dim]),
            upper=points(lambda p: p.upper[:dim]),
            dt=points(lambda p: [p.dt]),
            keep=points(lambda p: [p.keep]),
            mass=mass,
            mass_dx=points(lambda p: [[p.point_mass * p.lattice.dx]]),
            impulse=points(lambda p: [[-4.0 / p.lattice.dx * p.start.volume * p.dt]]),
            slope=points(lambda p: [[4.0 / p.lattice.dx]]),
            fall=tensor([p.dt * p.gravity[:dim] for p in problems]).repeat_interleave(
                torch.tensor([len(p.solid) for p in problems], device=device), 0
            ),
            spline=(
                tensor(CENTRE).view(1, SUPPORT, 1),
                tensor(SCALE).view(1, SUPPORT, 1),
                tensor(HEIGHT).view(1, SUPPORT, 1),
            ),
            offsets=tensor(stencil.astype(float)),
            matrix_rows=tensor(voigt_rows(dim)),
            coefficients=coefficients,
            basis=zeros(total, len(stencil), 1 + dim),
            grid=zeros(nodes, 2 * dim),
            gradient=zeros(3, 3, total),
            materials=Materials.of(
                [p.constants for p in problems], [p.dt for p in problems], counts, device
            ),
            nodes=node_contacts(problems, device),
            boxes=box_contacts(problems, counts, device),
            turned=turned_contacts(problems, counts, device),
        )

"""The material law of `material.py` for all points of a batch at once, in torch.

Three normal and three shear stresses are rows of tensors, shape (3, P), in Voigt's order: a shear
stress stands in the row of the axis that it does not touch (yz, xz, xy). Written that way the
Jaumann rate is a cross product and the invariants are sums and products over rows, so that a
substep needs few kernel launches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gns_model.mpm.material import THIRD_TURN, MaterialConstants

#: Where the velocity gradient's nine rows (row-major) hold d v_j / d x_k and d v_k / d x_j, for
#: (j, k) = (y, z), (z, x), (x, y).
FORWARD, BACKWARD = (5, 6, 1), (7, 2, 3)
#: Angles from the largest principal stress to each, in the octahedral plane.
TURNS = (0.0, -THIRD_TURN, THIRD_TURN)
#: Least divisor: differences of equal principal stresses are 0, and so is the deviator at rest.
TINY = 1e-300


@dataclass(frozen=True)
class Materials:
    """Constants of every point's material and its substep, each of shape (P,), and of the law."""

    dt: Tensor  #: [s]
    half_dt: Tensor
    bulk: Tensor  #: [Pa]
    shear_dt: Tensor  #: shear modulus times substep [Pa s]
    twice_shear_dt: Tensor
    sin_phi: Tensor
    cohesion_term: Tensor  #: 2 c cos(phi) [Pa]
    half_cohesion_term: Tensor
    half_less_sin: Tensor  #: (1 - sin(phi)) / 2
    tension: Tensor  #: [Pa]
    apex: Tensor  #: [Pa]
    strain_limit: Tensor  #: logarithmic volume strain at the tension cutoff [-]
    upper: tuple[Tensor, Tensor]  #: on the edge t1 = t2 they are slope * trace + offset
    lower: tuple[Tensor, Tensor]  #: on the edge t2 = t3 they are slope * trace + offset
    forward: Tensor
    backward: Tensor
    turns: Tensor  #: (3, 1)

    @classmethod
    def of(
        cls,
        constants: Sequence[MaterialConstants],
        dt: Sequence[float],
        counts: Tensor,
        device: torch.device,
    ) -> Materials:
        """Constants of scenes with `counts` points each, shape (S,), and substeps `dt` [s]."""
        bulk, shear, sine, cohesion, tension, apex = np.array(constants, dtype=float).T
        step = np.array(dt)

        def points(values: np.ndarray) -> Tensor:
            return torch.tensor(values, device=device).repeat_interleave(counts)

        return cls(
            dt=points(step),
            half_dt=points(0.5 * step),
            bulk=points(bulk),
            shear_dt=points(shear * step),
            twice_shear_dt=points(2.0 * shear * step),
            sin_phi=points(sine),
            cohesion_term=points(cohesion),
            half_cohesion_term=points(0.5 * cohesion),
            half_less_sin=points(0.5 * (1.0 - sine)),
            tension=points(tension),
            apex=points(apex),
            strain_limit=points(tension / bulk),
            upper=(points((1.0 - sine) / (3.0 - sine)), points(cohesion / (3.0 - sine))),
            lower=(points((1.0 + sine) / (3.0 + sine)), points(-cohesion / (3.0 + sine))),
            forward=torch.tensor(FORWARD, device=device),
            backward=torch.tensor(BACKWARD, device=device),
            turns=torch.tensor(TURNS, dtype=torch.float64, device=device).unsqueeze(1),
        )


def return_principal(principal: Tensor, trace: Tensor, m: Materials) -> Tensor:
    """Return ordered principal stresses [Pa], shape (3, P), to the yield surface.

    At a given trace the yield surface gives the largest and the smallest for a middle one, and
    the two edges bound the middle one: so the three cases of `material.return_principal` are one.

    Args:
        trace: their sum [Pa], shape (P,).
    """
    s1, s2, s3 = principal
    upper = torch.addcmul(m.upper[1], trace, m.upper[0])
    lower = torch.addcmul(m.lower[1], trace, m.lower[0])
    t2 = torch.clamp(s2, lower, upper)
    others = trace - t2
    t1 = torch.addcmul(m.half_cohesion_term, others, m.half_less_sin)
    on_surface = torch.stack([t1, t2, others - t1])
    on_surface = torch.where(trace >= 3.0 * m.apex, m.apex, on_surface)
    beyond = torch.addcmul(s1 - s3, s1 + s3, m.sin_phi) > m.cohesion_term
    return torch.minimum(torch.where(beyond, on_surface, principal), m.tension)


def return_stress(normal: Tensor, shear: Tensor, m: Materials) -> tuple[Tensor, Tensor]:
    """Return trial stresses [Pa], two tensors of shape (3, P), to the yield surface."""
    trace = normal.sum(0)
    mean = trace / 3.0
    deviator = normal - mean
    square = shear * shear
    shear_square = square.sum(0)
    third_of_j2 = torch.add(shear_square, (deviator * deviator).sum(0), alpha=0.5) / 3.0
    half_j3 = torch.add(
        shear.prod(0), deviator.prod(0) - (deviator * square).sum(0), alpha=0.5
    )  # fmt: skip
    radius = third_of_j2.sqrt()
    # Without a deviator this is 0 / TINY, and all principal stresses are the mean.
    lode = (half_j3 / (radius * third_of_j2).clamp(min=TINY)).clamp(-1.0, 1.0)
    directions = torch.add(m.turns, lode.acos(), alpha=1.0 / 3.0).cos()
    principal = torch.addcmul(mean, radius, directions, value=2.0)
    returned = return_principal(principal, trace, m)
    # The interpolation polynomial of `material.return_stress`.
    s1, s2, s3 = principal
    slopes = (returned[:2] - returned[1:]) / (principal[:2] - principal[1:]).clamp(min=TINY)
    b12, b23 = slopes.clamp(0.0, 1.0)
    b123 = (b12 - b23) / (s1 - s3).clamp(min=TINY)
    a = normal - s1
    turned = cyclic(shear)
    new_normal = torch.addcmul(
        torch.addcmul(returned[0], b12, a),
        b123,
        torch.addcmul(shear_square - square, a, normal - s2),
    )
    # s3 - normal: the sum of the other two normal stresses, less s1 + s2.
    new_shear = torch.addcmul(
        b12 * shear, b123, torch.addcmul(turned[1:4] * turned[2:5], shear, s3 - normal)
    )
    unchanged = (returned == principal).all(0)
    return (
        torch.where(unchanged, normal, new_normal),
        torch.where(unchanged, shear, new_shear),
    )


def advance_stress(
    stress: Tensor, strain: Tensor, gradient: Tensor, m: Materials
) -> tuple[Tensor, Tensor]:
    """Advance the stresses over a substep; returns normal and shear stresses [Pa], (3, P) each.

    Args:
        stress: three normal, then three shear stresses [Pa], shape (6, P).
        strain: accumulated logarithmic volume strain [-], after this substep, shape (P,).
        gradient: velocity gradient [1/s], shape (3, 3, P).
    """
    normal, shear = stress[:3], stress[3:]
    rows = gradient.flatten(0, 1)
    forward, backward = rows.index_select(0, m.forward), rows.index_select(0, m.backward)
    stretch = gradient.diagonal(dim1=0, dim2=1).T
    twice_spin = forward - backward
    turn, turned = cyclic(twice_spin * shear), cyclic(normal)
    trial_normal = torch.addcmul(normal - normal.mean(0), m.bulk, strain)
    trial_normal.addcmul_(m.dt, turn[2:5] - turn[1:4])
    trial_normal.addcmul_(m.twice_shear_dt, stretch - stretch.mean(0))
    twice_rate = torch.linalg.cross(twice_spin, shear, dim=0)
    twice_rate.addcmul_(twice_spin, turned[2:5] - turned[1:4])
    trial_shear = torch.addcmul(shear, m.half_dt, twice_rate)
    trial_shear.addcmul_(m.shear_dt, forward + backward)
    return return_stress(trial_normal, trial_shear, m)


def cyclic(rows: Tensor) -> Tensor:
    """Rows 0, 1, 2, 0, 1, shape (5, P): its slices 1:4 and 2:5 are the next row and the last."""
    return torch.cat([rows, rows[:2]])


def voigt_rows(dim: int) -> tuple[int, ...]:
    """Rows of the six stresses that fill a matrix of shape (dim, dim), row-major."""
    full = ((0, 5, 4), (5, 1, 3), (4, 3, 2))
    return tuple(full[i][j] for i in range(dim) for j in range(dim))

"""Mohr-Coulomb with cohesion and tension cutoff, in rate form: what a point's stress becomes.

The stress has an isotropic part from the accumulated logarithmic volume strain, which stops at
the tension cutoff, and a deviatoric part from the Jaumann rate.
The trial stress is returned to the yield surface in principal space at constant mean stress
(non-associated flow without dilation; de Souza Neto, Peric & Owen 2008, ch. 8). Tension positive.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from numba import njit

from gns_model.scene import Material

THIRD_TURN = 2.0 * math.pi / 3.0


class MaterialConstants(NamedTuple):
    """What the kernels need of a `Material`."""

    bulk: float  #: bulk modulus [Pa]
    shear: float  #: shear modulus [Pa]
    sin_phi: float
    cohesion_term: float  #: 2 c cos(phi) [Pa]
    tension: float  #: largest principal stress allowed [Pa]
    apex: float  #: mean stress at the apex of the cone [Pa]


def material_constants(material: Material) -> MaterialConstants:
    """Constants of the yield surface and of linear elasticity."""
    young, nu = material.youngs_modulus, material.poisson_ratio
    phi = math.radians(material.friction_angle)
    apex = material.cohesion / math.tan(phi) if phi > 0 else math.inf
    # tension_cutoff 0 with cohesion means no tension at all, as in the paper's tables.
    return MaterialConstants(
        bulk=young / (3 * (1 - 2 * nu)),
        shear=young / (2 * (1 + nu)),
        sin_phi=math.sin(phi),
        cohesion_term=2 * material.cohesion * math.cos(phi),
        tension=material.tension_cutoff,
        apex=apex,
    )


def wave_speed(material: Material) -> float:
    """Speed of a compression wave [m/s]: it bounds the time step."""
    constants = material_constants(material)
    return math.sqrt((constants.bulk + 4 / 3 * constants.shear) / material.density)


@njit(cache=True, inline="always")
def return_principal(s1, s2, s3, constants):
    """Return ordered principal stresses s1 >= s2 >= s3 [Pa] to the yield surface."""
    sin_phi = constants.sin_phi
    excess = (s1 - s3) + (s1 + s3) * sin_phi - constants.cohesion_term
    t1, t2, t3 = s1, s2, s3
    if excess > 0.0:
        total = s1 + s2 + s3
        if total >= 3.0 * constants.apex:
            t1 = t2 = t3 = constants.apex
        else:
            t1 = s1 - 0.5 * excess
            t3 = s3 + 0.5 * excess
            if t2 > t1:  # beyond the edge where the two largest meet
                t1 = (total * (1.0 - sin_phi) + constants.cohesion_term) / (3.0 - sin_phi)
                t2 = t1
                t3 = total - 2.0 * t1
            elif t2 < t3:  # beyond the edge where the two smallest meet
                t3 = (total * (1.0 + sin_phi) - constants.cohesion_term) / (3.0 + sin_phi)
                t2 = t3
                t1 = total - 2.0 * t3
    cut = constants.tension
    return min(t1, cut), min(t2, cut), min(t3, cut)


@njit(cache=True, inline="always")
def return_stress(xx, yy, zz, xy, yz, xz, constants):
    """Return a trial stress (6 components) [Pa] to the yield surface."""
    mean = (xx + yy + zz) / 3.0
    dx, dy, dz = xx - mean, yy - mean, zz - mean
    j2 = 0.5 * (dx * dx + dy * dy + dz * dz) + xy * xy + yz * yz + xz * xz
    if j2 < 1e-12:  # hydrostatic: principal directions do not matter
        limit = min(constants.tension, constants.apex)
        shift = min(mean, limit) - mean
        return xx + shift, yy + shift, zz + shift, xy, yz, xz
    j3 = dx * (dy * dz - yz * yz) - xy * (xy * dz - yz * xz) + xz * (xy * yz - dy * xz)
    radius = math.sqrt(j2 / 3.0)
    lode = max(-1.0, min(1.0, 0.5 * j3 / (radius * radius * radius)))
    angle = math.acos(lode) / 3.0
    s1 = mean + 2.0 * radius * math.cos(angle)
    s3 = mean + 2.0 * radius * math.cos(angle + THIRD_TURN)
    s2 = 3.0 * mean - s1 - s3
    t1, t2, t3 = return_principal(s1, s2, s3, constants)
    if t1 == s1 and t2 == s2 and t3 == s3:
        return xx, yy, zz, xy, yz, xz
    # The returned stress is an isotropic function of the trial one, so it is its interpolation
    # polynomial t1 + b12 (s - s1) + b123 (s - s1)(s - s2): no eigenvectors. The map keeps the
    # order of principal stresses and never spreads them, so the slopes lie in [0, 1]; the clip
    # keeps them there where two principal stresses coincide.
    b12 = max(0.0, min(1.0, (t1 - t2) / max(s1 - s2, 1e-300)))
    b23 = max(0.0, min(1.0, (t2 - t3) / max(s2 - s3, 1e-300)))
    b123 = (b12 - b23) / max(s1 - s3, 1e-300)
    ax, ay, az = xx - s1, yy - s1, zz - s1
    bx, by, bz = xx - s2, yy - s2, zz - s2
    return (
        t1 + b12 * ax + b123 * (ax * bx + xy * xy + xz * xz),
        t1 + b12 * ay + b123 * (xy * xy + ay * by + yz * yz),
        t1 + b12 * az + b123 * (xz * xz + yz * yz + az * bz),
        b12 * xy + b123 * (ax * xy + xy * by + xz * yz),
        b12 * yz + b123 * (xy * xz + ay * yz + yz * bz),
        b12 * xz + b123 * (ax * xz + xy * yz + xz * bz),
    )


@njit(cache=True, inline="always")
def advance_stress(xx, yy, zz, xy, yz, xz, volume_strain, gradient, dt, constants):
    """Advance one point's stress over a substep.

    Args:
        xx..xz: Cauchy stress [Pa].
        volume_strain: accumulated logarithmic volume strain [-], after this substep.
        gradient: velocity gradient [1/s], nine numbers, row-major.
        dt: substep [s].
    """
    g00, g01, g02, g10, g11, g12, g20, g21, g22 = gradient
    third = (g00 + g11 + g22) / 3.0
    # Jaumann rate: sigma' = W sigma - sigma W + 2 G dev D, with spin W = skew(grad v).
    w01, w02, w12 = 0.5 * (g01 - g10), 0.5 * (g02 - g20), 0.5 * (g12 - g21)
    rxx = 2.0 * (w01 * xy + w02 * xz)
    ryy = 2.0 * (w12 * yz - w01 * xy)
    rzz = -2.0 * (w02 * xz + w12 * yz)
    rxy = w01 * (yy - xx) + w02 * yz + w12 * xz
    ryz = w12 * (zz - yy) - w01 * xz - w02 * xy
    rxz = w02 * (zz - xx) + w01 * yz - w12 * xy
    two_g = 2.0 * constants.shear
    shift = constants.bulk * volume_strain - (xx + yy + zz) / 3.0
    return return_stress(
        xx + shift + dt * (rxx + two_g * (g00 - third)),
        yy + shift + dt * (ryy + two_g * (g11 - third)),
        zz + shift + dt * (rzz + two_g * (g22 - third)),
        xy + dt * (rxy + 0.5 * two_g * (g01 + g10)),
        yz + dt * (ryz + 0.5 * two_g * (g12 + g21)),
        xz + dt * (rxz + 0.5 * two_g * (g02 + g20)),
        constants,
    )

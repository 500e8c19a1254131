"""Laws of the yield surface, checked against principal stresses from an eigenvalue solver."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gns_model.mpm.material import advance_stress, material_constants, return_stress
from gns_model.scene import Material

COMPONENTS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))
stresses = arrays(float, 6, elements=st.floats(-1e5, 1e5, allow_subnormal=False))
materials = st.sampled_from(
    [
        Material(friction_angle=35),
        Material(friction_angle=30, cohesion=100, tension_cutoff=50),
        Material(friction_angle=15, cohesion=1000, tension_cutoff=0),
        Material(friction_angle=0, cohesion=500, tension_cutoff=1e4),
    ]
)


def matrix(stress):
    full = np.zeros((3, 3))
    for value, (i, j) in zip(stress, COMPONENTS, strict=True):
        full[i, j] = full[j, i] = value
    return full


def excess(full, material):
    """Mohr-Coulomb yield function and tension over its cutoff [Pa]: positive is not allowed."""
    s3, _, s1 = np.linalg.eigvalsh(full)
    phi = math.radians(material.friction_angle)
    shear = (s1 - s3) + (s1 + s3) * math.sin(phi) - 2 * material.cohesion * math.cos(phi)
    return max(shear, s1 - material.tension_cutoff)


@given(stresses, materials)
def test_returned_stress_is_allowed_and_returning_again_changes_nothing(stress, material):
    constants = material_constants(material)
    returned = np.array(return_stress(*stress, constants))
    scale = 1 + np.abs(stress).max()
    assert excess(matrix(returned), material) <= 1e-5 * scale
    again = np.array(return_stress(*returned, constants))
    np.testing.assert_allclose(again, returned, atol=1e-5 * scale)


@given(stresses, materials)
def test_return_keeps_an_allowed_stress_and_the_principal_directions(stress, material):
    constants = material_constants(material)
    returned = np.array(return_stress(*stress, constants))
    if excess(matrix(stress), material) < -1e-6 * (1 + np.abs(stress).max()):
        np.testing.assert_array_equal(returned, stress)
    commutator = matrix(stress) @ matrix(returned) - matrix(returned) @ matrix(stress)
    assert np.abs(commutator).max() <= 1e-6 * (1 + np.abs(stress).max()) ** 2


@given(stresses)
def test_shear_return_keeps_the_mean_stress(stress):
    material = Material(friction_angle=35, cohesion=1e6, tension_cutoff=1e6)
    sheared = stress * [1, 1, 1, 50, 50, 50]
    returned = return_stress(*sheared, material_constants(material))
    tension_free = np.linalg.eigvalsh(matrix(returned))[2] < 1e6 - 1
    if tension_free:
        assert sum(returned[:3]) == pytest.approx(sum(sheared[:3]), abs=1e-3)


@given(stresses, st.floats(-math.pi, math.pi))
def test_return_does_not_know_the_axes(stress, angle):
    material = Material(friction_angle=30, cohesion=100, tension_cutoff=50)
    constants = material_constants(material)
    c, s = math.cos(angle), math.sin(angle)
    about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    turn = about_z @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    turned = turn @ matrix(stress) @ turn.T
    returned = turn @ matrix(return_stress(*stress, constants)) @ turn.T
    direct = matrix(return_stress(*[turned[i, j] for i, j in COMPONENTS], constants))
    # Principal stresses of nearly equal size are known to the square root of round-off only.
    np.testing.assert_allclose(direct, returned, atol=1e-6 * (1 + np.abs(stress).max()))


def test_elastic_step_is_hookes_law():
    material = Material(youngs_modulus=1e6, poisson_ratio=0.25, friction_angle=35, cohesion=1e9)
    constants = material_constants(material)
    gradient = (-1e-3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # uniaxial strain
    stress = advance_stress(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1e-3, gradient, 1.0, constants)
    lame = 1e6 * 0.25 / (1.25 * 0.5)
    shear = 1e6 / 2.5
    assert stress[0] == pytest.approx(-1e-3 * (lame + 2 * shear))
    assert stress[1] == pytest.approx(-1e-3 * lame)
    assert stress[3:] == (0.0, 0.0, 0.0)

"""The material law in torch gives what the one in numba gives, point by point."""

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gns_model.mpm import material as by_numba
from gns_model.mpm import torch_material as by_torch
from gns_model.scene import Material

MATERIALS = [
    Material(friction_angle=35),
    Material(friction_angle=30, cohesion=100, tension_cutoff=50, youngs_modulus=2e7),
    Material(friction_angle=15, cohesion=1000, tension_cutoff=0),
    Material(friction_angle=0, cohesion=500, tension_cutoff=1e4, poisson_ratio=0.2),
]
CONSTANTS = [by_numba.material_constants(m) for m in MATERIALS]
#: Components of `material.py` (xx, yy, zz, xy, yz, xz) in the rows of `torch_material.py`.
ROWS = [0, 1, 2, 4, 5, 3]
DT = [1e-4, 2e-4, 3e-4, 5e-4]
# Of a size that makes every branch happen, with exact zeros and repeated values among them.
values = st.one_of(st.floats(-1e5, 1e5, allow_subnormal=False), st.sampled_from([0.0, 50.0, -1e3]))
stresses = arrays(float, (len(MATERIALS), 6), elements=values)


def constants():
    return by_torch.Materials.of(
        CONSTANTS, DT, torch.ones(len(CONSTANTS), dtype=torch.long), torch.device("cpu")
    )


def assert_close(found, expected):
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * (1 + np.abs(expected).max()))


@given(stresses)
def test_returned_stress_is_numbas(stress):
    rows = torch.tensor(stress.T[ROWS])
    normal, shear = by_torch.return_stress(rows[:3], rows[3:], constants())
    expected = np.array(
        [by_numba.return_stress(*s, c) for s, c in zip(stress, CONSTANTS, strict=True)]
    )
    assert_close(torch.cat([normal, shear]).numpy(), expected.T[ROWS])


@given(
    stresses,
    arrays(float, (len(MATERIALS), 9), elements=st.floats(-50, 50)),
    arrays(float, len(MATERIALS), elements=st.floats(-1e-2, 0)),
)
def test_advanced_stress_is_numbas(stress, gradient, strain):
    normal, shear = by_torch.advance_stress(
        torch.tensor(stress.T[ROWS].copy()),
        torch.tensor(strain),
        torch.tensor(gradient.T.copy()).view(3, 3, -1),
        constants(),
    )
    expected = np.array(
        [
            by_numba.advance_stress(*s, e, tuple(g), dt, c)
            for s, e, g, dt, c in zip(stress, strain, gradient, DT, CONSTANTS, strict=True)
        ]
    )
    assert_close(torch.cat([normal, shear]).numpy(), expected.T[ROWS])

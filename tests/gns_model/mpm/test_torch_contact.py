"""Contact in torch gives what contact in numba gives, point by point and node by node."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gns_model.mpm import contact as by_numba
from gns_model.mpm import torch_contact as by_torch
from gns_model.mpm.problem import Discretisation, pose
from gns_model.scene import Scene

from .node_contact import slide_nodes

CPU = torch.device("cpu")
SPEEDS = st.one_of(st.floats(-5, 5, allow_subnormal=False), st.just(0.0))
#: Baffles that touch, that stand in a corner, reach the lid or span the whole width.
CROWDED = Scene.from_dict(
    {
        "domain": {"lower": (0.0, 0.0, 0.0), "upper": (1.0, 0.4, 0.5)},
        "release": [{"lower": (0.0,) * 3, "upper": (0.2,) * 3, "velocity": (0.0,) * 3}],
        "baffle": [
            {"center": (0.45, 0.25), "size": (0.1, 0.3, 0.1)},
            {"center": (0.55, 0.25), "size": (0.1, 0.2, 0.1)},
            {"center": (0.5, 0.35), "size": (0.12, 0.25, 0.1)},
            {"center": (0.3, 0.05), "size": (0.1, 0.4, 0.1)},
            {"center": (0.95, 0.25), "size": (0.1, 0.1, 0.5)},
        ],
        "friction": {"base": 0.5, "walls": 0.2, "baffles": 0.6},
    }
)
FLAT = Scene.from_dict(
    {
        "domain": {"lower": (0.0, 0.0), "upper": (1.0, 0.4)},
        "release": [{"lower": (0.0, 0.0), "upper": (0.2, 0.2), "velocity": (0.0, 0.0)}],
        "baffle": [
            {"center": (0.45,), "size": (0.1, 0.3)},
            {"center": (0.95,), "size": (0.1, 0.1)},
        ],
        "friction": {"base": 0.5, "walls": 0.0, "baffles": 0.6},
    }
)


@given(
    arrays(float, (6, 3), elements=SPEEDS),
    arrays(float, 6, elements=st.sampled_from([0.0, 0.3, 2.0])),
)
def test_slide_is_numbas(velocity, mu):
    normals = np.concatenate([np.eye(3), -np.eye(3)])
    expected = np.empty_like(velocity)
    for k, (v, n, m) in enumerate(zip(velocity, normals, mu, strict=True)):
        axis = int(np.abs(n).argmax())
        others = [a for a in range(3) if a != axis]
        expected[k, [axis, *others]] = by_numba.slide(v[axis], *v[others], n[axis], m)
    tensors = [torch.tensor(a) for a in (velocity, normals, mu[:, None])]
    np.testing.assert_allclose(by_torch.slide(*tensors).numpy(), expected, rtol=0, atol=1e-14)
    smooth = by_torch.slide(*tensors[:2], None)
    tensors[2].zero_()
    np.testing.assert_array_equal(smooth.numpy(), by_torch.slide(*tensors).numpy())


@pytest.mark.parametrize("scene", [CROWDED, FLAT], ids=["3d", "2d"])
def test_baffles_put_points_where_numba_puts_them(scene):
    problem, dim = pose(scene, Discretisation(spacing=0.05)), scene.dim
    rng = np.random.default_rng(0)
    count = 4000
    position = np.zeros((count, 3))
    position[:, :dim] = rng.uniform(problem.lower[:dim], problem.upper[:dim], (count, dim))
    # Half of the points lie in a baffle, a tenth of them exactly on a face.
    box = problem.boxes[rng.integers(len(problem.boxes), size=count // 2)]
    share = rng.uniform(size=(count // 2, 3))
    share[: count // 20] = share[: count // 20].round()
    position[: count // 2] = box[:, 0] + share * (box[:, 1] - box[:, 0])
    velocity = np.zeros((count, 3))
    velocity[:, :dim] = rng.normal(size=(count, dim))
    expected = np.empty((count, 6))
    for k in range(count):
        state = (*position[k], *velocity[k])
        for box in problem.boxes:
            state = by_numba.box_contact(
                *state, box, scene.friction.baffles, dim == 2, problem.lower, problem.upper
            )
        expected[k] = state
    x, v = torch.tensor(position[:, :dim]), torch.tensor(velocity[:, :dim])
    contacts = by_torch.box_contacts([problem], torch.tensor([count]), CPU)
    assert len(contacts) == (3 if dim == 3 else 1), "touching baffles are taken in turn"
    for contact in contacts:
        x, v = contact.apply(x, v)
    assert np.abs(expected[:, :3] - position).max() > 0.01, "no point lay inside a baffle"
    np.testing.assert_allclose(x.numpy(), expected[:, :dim], rtol=0, atol=1e-14)
    np.testing.assert_allclose(v.numpy(), expected[:, 3 : 3 + dim], rtol=0, atol=1e-13)


@pytest.mark.parametrize("scene", [CROWDED, FLAT], ids=["3d", "2d"])
def test_nodes_slide_as_numbas(scene):
    problem = pose(scene, Discretisation(spacing=0.0125))
    assert problem.solid.any(), "no node lies in a baffle"
    _, by_loops, by_tensors = slide_nodes(scene, problem)
    np.testing.assert_allclose(by_tensors, by_loops, rtol=0, atol=1e-14)

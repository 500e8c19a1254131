"""Baffles turned about the vertical, in both solvers."""

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from gns_model import footprint, measures
from gns_model.mpm import MpmSimulator, solver
from gns_model.mpm import contact as by_numba
from gns_model.mpm import torch_contact as by_torch
from gns_model.mpm.problem import Discretisation, pose
from gns_model.scene import Scene

from .node_contact import slide_nodes

CPU = torch.device("cpu")
#: Turned baffles that touch each other, that touch a wall with a corner, and that reach the lid.
CROWDED = Scene.from_dict(
    {
        "domain": {"lower": (0.0, 0.0, 0.0), "upper": (1.0, 0.4, 0.8)},
        "release": [{"lower": (0.0,) * 3, "upper": (0.2,) * 3, "velocity": (0.0,) * 3}],
        "baffle": [
            {"center": (0.45, 0.4), "size": (0.1, 0.3, 0.2), "yaw": 30.0},
            # Against the first one, face to face.
            {
                "center": (
                    0.45 + 0.1 * np.cos(np.radians(30.0)),
                    0.4 + 0.1 * np.sin(np.radians(30.0)),
                ),
                "size": (0.1, 0.2, 0.1),
                "yaw": 30.0,
            },
            {"center": (0.3, 0.1 * np.sqrt(0.5)), "size": (0.1, 0.25, 0.1), "yaw": 45.0},
            {"center": (0.8, 0.6), "size": (0.05, 0.4, 0.3), "yaw": -70.0},
            {"center": (0.75, 0.15), "size": (0.1, 0.3, 0.1)},
        ],
        "friction": {"base": 0.5, "walls": 0.2, "baffles": 0.6},
    }
)


def shaken(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and velocities all over the crowded scene, half of the points in turned baffles."""
    problem, rng = pose(CROWDED, Discretisation(spacing=0.05)), np.random.default_rng(0)
    position = rng.uniform(problem.lower, problem.upper, (count, 3))
    chosen = rng.integers(4, size=count // 2)
    for k, b in enumerate(chosen):
        corners = CROWDED.baffles[b].corners
        u, v, up = rng.uniform(size=3)
        plan = corners[0] + u * (corners[1] - corners[0]) + v * (corners[3] - corners[0])
        position[k] = plan[0], up * CROWDED.baffles[b].size[1], plan[1]
    return position, rng.normal(size=(count, 3))


def test_torch_puts_points_where_numba_puts_them():
    problem = pose(CROWDED, Discretisation(spacing=0.05))
    position, velocity = shaken(2000)
    expected = np.empty((len(position), 6))
    for k in range(len(position)):
        state = (*position[k], *velocity[k])
        for box, (cosine, sine) in zip(problem.turned, problem.turns, strict=True):
            state = by_numba.turned_contact(*state, box, cosine, sine, 0.6)
        expected[k] = state
    x, v = torch.tensor(position), torch.tensor(velocity)
    contacts = by_torch.turned_contacts([problem], torch.tensor([len(x)]), CPU)
    assert len(contacts) == 2, "touching baffles are taken in turn"
    for contact in contacts:
        x, v = contact.apply(x, v)
    moved = (expected[:, :3] != position).any(1)
    assert 0.3 < moved.mean() < 0.9
    np.testing.assert_allclose(x.numpy(), expected[:, :3], rtol=0, atol=1e-14)
    np.testing.assert_allclose(v.numpy(), expected[:, 3:], rtol=0, atol=1e-13)
    # Points outside come back as they were, to the last bit; no point goes out through the lid.
    np.testing.assert_array_equal(x.numpy()[~moved], position[~moved])
    assert (x[:, 1] <= 0.4).all()
    again = x
    for contact in contacts:
        again, _ = contact.apply(again, v)
    # Where two touch, a face of one lies in the skin of the other.
    assert (again - x).abs().max() < 5e-6


def test_nodes_slide_along_turned_faces_in_both():
    problem = pose(CROWDED, Discretisation(spacing=0.0125))
    inside = problem.solid >= by_numba.TURNED
    assert inside.sum() > 100
    assert len(np.unique(problem.solid[inside])) > 12, "few sides have nodes behind them"
    before, by_loops, by_tensors = slide_nodes(CROWDED, problem)
    np.testing.assert_allclose(by_tensors, by_loops, rtol=0, atol=1e-14)
    # Away from walls no node behind the side of baffle 0 moves into it any more.
    side = problem.solid == by_numba.TURNED  # -x of the first
    lattice = problem.lattice
    _, j, k = (a.ravel() for a in np.indices((lattice.nx, lattice.ny, lattice.nz)))
    side &= (j > 2) & (k > 2) & (k < lattice.wall_z)
    normal = -np.array([np.cos(np.radians(30.0)), 0.0, np.sin(np.radians(30.0))])
    assert (before[side] @ normal).min() < -0.5
    assert (by_loops[side] @ normal).min() > -1e-12


@given(
    st.tuples(*[st.floats(-0.3, 0.3)] * 3),
    st.tuples(*[st.floats(-2, 2)] * 3),
    st.tuples(*[st.floats(0.05, 0.3)] * 3),
)
def test_a_quarter_turn_by_rotation_is_the_box_with_exchanged_sides(point, velocity, size):
    def box(a: float, h: float, b: float) -> np.ndarray:
        return np.array([[-a / 2, -0.1, -b / 2], [a / 2, h, b / 2]])

    a, h, b = size
    x, y, z = point
    ways = sorted([a / 2 - z, a / 2 + z, b / 2 - x, b / 2 + x, h - y])
    assume(ways[0] < 0 or ways[1] - ways[0] > 1e-9)  # else which face is nearest is anybody's guess
    nowhere = np.full(3, np.inf)
    one = by_numba.turned_contact(*point, *velocity, box(a, h, b), *footprint.turn(90), 0.5)
    other = by_numba.box_contact(
        *point, *velocity, box(b, h, a), 0.5, False, -nowhere, nowhere
    )  # fmt: skip
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)


@pytest.fixture(scope="module")
def block() -> Scene:
    """A coarse block that slides onto one long baffle askew and slides off it sideways."""
    return Scene.from_dict(
        {
            "duration": 0.3,
            "domain": {"lower": (0.0, 0.0, 0.0), "upper": (1.0, 0.5, 0.6)},
            "release": [
                {"lower": (0, 0, 0.1), "upper": (0.25, 0.2, 0.5), "velocity": (2.0, 0.0, 0.0)}
            ],
            "baffle": [{"center": (0.5, 0.3), "size": (0.06, 0.3, 0.3), "yaw": 35.0}],
        }
    )


def test_a_turned_baffle_deflects_the_flow_and_its_mirror_image_the_other_way(block):
    simulator = MpmSimulator(spacing=0.0375)  # elements of 0.075 m fit the width eight times
    other = block.with_baffles([(0.5, 0.3)], yaw=-35.0)
    plain = block.with_baffles([(0.5, 0.3)], yaw=0.0)
    a, b, c = simulator.rollout([block, other, plain])
    for trajectory in (a, b):
        assert trajectory.status == "ok"
        assert measures.points_inside_baffles(trajectory, slack=0.0) == 0
    across = [float(t.positions[-1, :, 2].mean() - 0.3) for t in (a, b, c)]
    # Turned from x towards z, the face looks back along +z: -x cos t - z sin t is its normal.
    assert across[0] < -0.005 < 0.005 < across[1]
    assert across[0] == pytest.approx(-across[1], rel=0.02)
    assert abs(across[2]) < 1e-3
    x = [measures.summary(t)["centroid_travel"] for t in (a, b)]
    assert x[0] == pytest.approx(x[1], rel=2e-3)


def test_a_quarter_turn_is_exchanged_sides_to_the_last_bit(block):
    simulator = MpmSimulator(spacing=0.05)
    turned = block.with_baffles([(0.5, 0.3)], size=(0.06, 0.3, 0.3), yaw=90.0)
    plain = block.with_baffles([(0.5, 0.3)], size=(0.3, 0.3, 0.06), yaw=0.0)
    a, b = simulator.rollout([turned.replace(duration=0.1), plain.replace(duration=0.1)])
    np.testing.assert_array_equal(a.positions, b.positions)


def test_threads_agree_to_the_last_bit(block, monkeypatch):
    monkeypatch.setattr(solver, "THREAD_POINTS", 0)  # or so small a scene would have one thread
    short = block.replace(duration=0.15)
    one, two = (MpmSimulator(spacing=0.05, threads=n).rollout([short])[0] for n in (1, 2))
    assert np.abs(one.positions[-1] - one.positions[0]).max() > 0.1
    np.testing.assert_array_equal(one.positions, two.positions)

"""Laws of the reference solver: motion, momentum, friction, statics, contact, reproducibility."""

import hashlib
import os
import subprocess
import sys

import numba
import numpy as np
import pytest

from gns_model import measures
from gns_model.data.scenes import draw
from gns_model.errors import SimulatorError
from gns_model.mpm import MpmSimulator, solver
from gns_model.scene import Scene

STIFF = {"youngs_modulus": 2e6, "friction_angle": 35.0, "cohesion": 1e4, "tension_cutoff": 1e4}


def scene(**changes):
    values = {
        "domain": {"lower": (0.0, 0.0), "upper": (4.0, 4.0)},
        "release": [{"lower": (1.0, 1.0), "upper": (1.5, 1.4), "velocity": (0.0, 0.0)}],
        "duration": 0.2,
    }
    return Scene.from_dict({**values, **changes})


@pytest.fixture
def final_points(monkeypatch):
    """The solver's own point arrays after every frame, by point: kept["points"] is the last."""
    kept = {"frames": []}
    advance = solver.advance_serial

    def spy(*arguments):
        result = advance(*arguments)
        kept["points"] = result[0][np.argsort(result[1])]
        kept["frames"].append(kept["points"])
        return result

    monkeypatch.setattr(solver, "advance_serial", spy)
    return kept


@pytest.mark.parametrize("dim", [2, 3])
def test_free_fall_is_exact(dim):
    velocity, box = (0.7, 1.5, -0.4)[:dim], ((1.0,) * dim, (1.3,) * dim)
    falling = scene(
        domain={"lower": (0.0,) * dim, "upper": (4.0,) * dim},
        release=[{"lower": box[0], "upper": box[1], "velocity": velocity}],
    )
    trajectory = MpmSimulator(spacing=0.05).rollout([falling])[0]
    t = trajectory.time[:, None, None]
    gravity = np.array(falling.gravity)
    substep = trajectory.settings["substep"]
    # Symplectic Euler: x = v t + g t (t + dt) / 2.
    exact = trajectory.positions[0] + t * np.array(velocity) + 0.5 * gravity * t * (t + substep)
    np.testing.assert_allclose(trajectory.positions, exact, atol=1e-6)


def test_momentum_is_conserved_without_contact(final_points):
    colliding = scene(
        gravity=(1e-12, 0.0),
        release=[
            {"lower": (1.0, 1.0), "upper": (1.4, 1.4), "velocity": (2.0, 0.3)},
            {"lower": (1.5, 1.1), "upper": (1.8, 1.6), "velocity": (-1.0, -0.5)},
        ],
    )
    simulator = MpmSimulator(spacing=0.025)
    trajectory = simulator.rollout([colliding])[0]
    points = final_points["points"]
    first = np.repeat([r.velocity for r in colliding.releases], [16 * 16, 12 * 20], axis=0).mean(
        axis=0
    )
    collided = np.abs(
        points[:, 3:5]
        - np.repeat([r.velocity for r in colliding.releases], [16 * 16, 12 * 20], axis=0)
    ).max()
    assert collided > 0.5, "the blocks never met: the test would show nothing"
    np.testing.assert_allclose(points[:, 3:5].mean(axis=0), first, atol=1e-10)
    np.testing.assert_allclose(
        trajectory.positions[-1].mean(axis=0) - trajectory.positions[0].mean(axis=0),
        first * colliding.duration,
        atol=1e-6,
    )


@pytest.mark.parametrize("degrees", [10, 15, 20, 25, 40])
def test_block_slides_or_holds_by_base_friction(degrees):
    mu, angle, t = 0.3, np.radians(degrees), 0.5
    tilted = scene(
        domain={"lower": (0.0, 0.0), "upper": (4.0, 0.5)},
        gravity=(9.81 * np.sin(angle), -9.81 * np.cos(angle)),
        friction={"base": mu, "walls": 0.0},
        material=STIFF,
        release=[{"lower": (0.2, 0.0), "upper": (0.7, 0.05), "velocity": (0.0, 0.0)}],
        duration=t,
    )
    trajectory = MpmSimulator(spacing=0.0125).rollout([tilted])[0]
    moved = float((trajectory.positions[-1] - trajectory.positions[0])[:, 0].mean())
    exact = 0.5 * 9.81 * max(0.0, np.sin(angle) - mu * np.cos(angle)) * t**2
    assert moved == pytest.approx(exact, rel=0.02, abs=0.004)


def test_settled_column_carries_hydrostatic_stress(final_points):
    height = 0.4
    column = scene(
        domain={"lower": (0.0, 0.0), "upper": (0.3, 0.6)},
        friction={"base": 0.3, "walls": 0.0},
        release=[{"lower": (0.0, 0.0), "upper": (0.3, height), "velocity": (0.0, 0.0)}],
        duration=2.0,
    )
    MpmSimulator(spacing=0.0125).rollout([column])
    # The column rings like a bell of elastic sand; its mean over the last second is at rest.
    points = np.mean(final_points["frames"][-100:], axis=0)
    assert np.abs(points[:, 3:5]).max() < 1e-3
    depth = height - points[:, 1]
    vertical = -points[:, 16]
    slope = np.linalg.lstsq(depth[:, None], vertical, rcond=None)[0][0]
    assert slope == pytest.approx(1800 * 9.81, rel=0.03)


@pytest.mark.slow
def test_no_point_ever_enters_a_baffle_or_leaves_the_domain():
    scenes = [draw(("random", "flume")[i % 2], 7, i).replace(duration=0.5) for i in range(50)]
    for trajectory in MpmSimulator(spacing=0.04).rollout(scenes):
        domain = trajectory.scene.domain
        assert trajectory.status == "ok"
        assert (trajectory.positions >= np.float32(domain.lower)).all()
        assert (trajectory.positions <= np.float32(domain.upper)).all()
        assert measures.points_inside_baffles(trajectory, slack=0.0) == 0


def test_layout_moves_the_flow_smoothly():
    """Exact contact: a baffle moved by a fraction of an element has a fraction of the effect."""
    simulator = MpmSimulator(spacing=0.04)
    base = draw("layouts", 3, 0).replace(duration=0.4)
    centroid = []
    for shift in (0.0, 0.01, 0.02, 0.03, 0.04):
        moved = base.with_baffles([[0.80 + shift, 0.7], [0.80 + shift, 1.1]])
        centroid.append(measures.summary(simulator.rollout([moved])[0])["centroid_travel"])
    steps = np.diff(centroid)
    assert (np.abs(steps) > 1e-6).all(), "a step changed nothing: contact is a staircase"
    assert np.abs(steps).max() < 0.7 * np.abs(steps).sum()


def test_mirror_image_of_a_scene_gives_the_mirror_image():
    simulator = MpmSimulator(spacing=0.0375)  # elements of 0.075 m fit the width 24 times
    one = draw("layouts", 3, 1).replace(duration=0.3)
    centres = np.array([b.center for b in one.baffles])
    mirrored = one.with_baffles(np.column_stack([centres[:, 0], 2.0 - centres[:, 1]]))
    a, b = simulator.rollout([one, mirrored])
    assert measures.summary(a)["centroid_travel"] == pytest.approx(
        measures.summary(b)["centroid_travel"], rel=2e-3
    )


def test_plane_strain_is_a_wide_3d_flow_without_side_friction():
    flat = scene(
        domain={"lower": (0.0, 0.0), "upper": (1.2, 0.4)},
        release=[{"lower": (0.0, 0.0), "upper": (0.3, 0.24), "velocity": (0.0, 0.0)}],
        friction={"base": 0.4, "walls": 0.0},
        duration=0.5,
    )
    wide = scene(
        domain={"lower": (0.0, 0.0, 0.0), "upper": (1.2, 0.4, 0.24)},
        release=[
            {"lower": (0.0, 0.0, 0.0), "upper": (0.3, 0.24, 0.24), "velocity": (0.0, 0.0, 0.0)}
        ],
        friction={"base": 0.4, "walls": 0.0},
        duration=0.5,
    )
    simulator = MpmSimulator(spacing=0.02)
    a, b = (measures.summary(simulator.rollout([s])[0]) for s in (flat, wide))
    assert a["centroid_travel"] == pytest.approx(b["centroid_travel"], rel=0.05)


PROGRAM = """
import hashlib, sys
from gns_model.data.scenes import draw
from gns_model.mpm import MpmSimulator, solver
solver.THREAD_POINTS = 0  # or a small scene would have one thread
scene = draw("layouts", 5, 0).replace(duration=0.1)
positions = MpmSimulator(spacing=0.03, threads=int(sys.argv[1])).rollout([scene])[0].positions
print(hashlib.sha256(positions.tobytes()).hexdigest())
"""


def test_one_and_four_threads_agree_to_the_last_bit():
    # In processes of their own: numba fixes its largest number of threads when it is imported.
    def digest(threads):
        run = subprocess.run(
            [sys.executable, "-c", PROGRAM, str(threads)],
            env={**os.environ, "NUMBA_NUM_THREADS": "4", "OMP_WAIT_POLICY": "PASSIVE"},
            capture_output=True,
            text=True,
            check=True,
        )
        return run.stdout.strip()

    one, four = digest(1), digest(4)
    assert len(one) == len(hashlib.sha256().hexdigest())
    assert one == four


def test_a_small_scene_has_one_thread():
    """Threads that meet in every substep of a small scene take many times as long as one."""
    simulator = MpmSimulator(threads=4)
    assert simulator.threads_for(solver.THREAD_POINTS - 1) == 1
    assert simulator.threads_for(solver.THREAD_POINTS) == min(4, numba.config.NUMBA_NUM_THREADS)


def test_workers_return_what_one_process_returns():
    scenes = [draw("layouts", 5, i).replace(duration=0.05) for i in range(2)]
    alone = MpmSimulator(spacing=0.05).rollout(scenes)
    side_by_side = MpmSimulator(spacing=0.05, workers=2).rollout(scenes)
    for a, b in zip(alone, side_by_side, strict=True):
        assert a.scene == b.scene
        np.testing.assert_array_equal(a.positions, b.positions)


def test_the_solver_leaves_torchs_threads_alone():
    """With numba's OpenMP layer a learned rollout after this one would be many times slower."""
    MpmSimulator(spacing=0.1).rollout([scene(duration=0.05)])
    assert numba.threading_layer() == "workqueue"


def test_progress_reaches_one_and_an_interrupt_passes_through():
    seen = []
    MpmSimulator(spacing=0.1).rollout([scene(duration=0.05)], progress=seen.append)
    assert seen == sorted(seen)
    assert seen[-1] == 1.0

    def interrupt(fraction):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        MpmSimulator(spacing=0.1).rollout([scene(duration=0.05)], progress=interrupt)


def test_another_filling_starts_elsewhere_and_flows_alike():
    column = scene(duration=0.2)
    usual, shaken, other = (
        MpmSimulator(spacing=0.05, jitter=jitter, filling=filling).rollout([column])[0]
        for jitter, filling in [(0.0, 0), (0.25, 0), (0.25, 1)]
    )
    for trajectory in (shaken, other):
        moved = np.abs(trajectory.positions[0] - usual.positions[0])
        assert 0.01 < moved.max() <= 0.0125 + 1e-6
        assert trajectory.status == "ok"
        assert trajectory.settings["jitter"] == 0.25
    assert not np.array_equal(shaken.positions[0], other.positions[0])
    centroids = [t.positions[-1].mean(axis=0) for t in (usual, shaken, other)]
    np.testing.assert_allclose(centroids[1:], centroids[:1] * 2, atol=0.005)


@pytest.mark.parametrize(
    "bad",
    [{"spacing": 0.0}, {"cfl": -1.0}, {"workers": 0}, {"jitter": 0.5}, {"filling": -1}],
)
def test_options_that_make_no_sense_are_refused(bad):
    with pytest.raises(SimulatorError, match=next(iter(bad))):
        MpmSimulator(**bad)


def test_a_grid_that_cannot_fit_is_refused():
    with pytest.raises(SimulatorError, match="too large"):
        MpmSimulator(spacing=0.0001).check(scene())


def test_a_diverged_rollout_is_marked_and_finite():
    # Twenty times the stable substep: the explicit scheme blows up.
    trajectory = MpmSimulator(spacing=0.05, cfl=20.0, frame_interval=0.05).rollout(
        [
            scene(
                domain={"lower": (0.0, 0.0), "upper": (4.0, 2.0)},
                duration=1.0,
                release=[{"lower": (1.0, 0.0), "upper": (1.5, 0.8), "velocity": (3.0, 0.0)}],
            )
        ]
    )[0]
    assert np.isfinite(trajectory.positions).all()
    assert trajectory.status == "diverged"

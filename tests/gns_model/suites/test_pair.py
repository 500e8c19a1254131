from __future__ import annotations

import math

import numpy as np
import pytest

from gns_model import measures, paper
from gns_model.mpm import MpmSimulator
from gns_model.particles import fill
from gns_model.suites import collapse, flume
from gns_model.suites.pair import Pair, energies, outside, relative, squared_errors


@pytest.fixture(scope="module")
def column():
    return paper.column_scene(paper.COLUMNS[2])


def test_squared_errors_are_those_of_the_same_points(column, trajectory_of):
    start = fill(column, 0.05).positions
    drift = np.linspace(0, 0.2, 5)[:, None, None] * np.array([1.0, 0.0])
    reference = trajectory_of(start + drift, column)
    predicted = trajectory_of(start + drift + np.arange(5)[:, None, None] * [0.03, 0.04], column)
    errors = squared_errors(Pair(predicted, reference))
    assert errors.shape == (5, len(start))
    np.testing.assert_allclose(errors, (0.05 * np.arange(5)[:, None]) ** 2 + 0 * errors, atol=1e-12)
    # Where points correspond this is the measure that `measures` has.
    np.testing.assert_allclose(
        errors.mean(axis=1), measures.position_error(predicted, reference), atol=1e-12
    )


def test_squared_errors_match_points_by_where_they_start(column, trajectory_of):
    """Another filling, another order and other times: a common motion has no error."""

    def slide(spacing: float, times: np.ndarray) -> np.ndarray:
        start = fill(column, spacing).positions
        return start + times[:, None, None] * [0.3, -0.1]

    coarse = trajectory_of(slide(0.06, np.arange(5) * 0.1), column, interval=0.1)
    shuffled = slide(0.02, np.arange(3) * 0.2)
    np.random.default_rng(0).shuffle(shuffled, axis=1)
    fine = trajectory_of(shuffled, column, interval=0.2)
    assert squared_errors(Pair(coarse, fine)).max() < 1e-12
    faster = trajectory_of(slide(0.06, np.arange(5) * 0.11), column, interval=0.1)
    mean = squared_errors(Pair(faster, fine)).mean(axis=1)
    np.testing.assert_allclose(mean, (np.arange(5) * 0.01) ** 2 * 0.1, atol=1e-12)


def test_energies_add_up_and_start_at_one(column):
    trajectory = MpmSimulator(spacing=0.05, frame_interval=0.05).rollout([column])[0]
    shares = energies(trajectory)
    np.testing.assert_allclose(sum(shares.values()), 1.0)
    assert shares["potential"][0] == 1.0
    assert shares["kinetic"][-1] < 0.01
    assert shares["dissipated"][-1] == pytest.approx(
        measures.energy_dissipated(trajectory) / measures.potential_energy(trajectory)[0]
    )


def test_curves_of_a_column_end_where_its_measures_say(column):
    trajectory = MpmSimulator(spacing=0.05, frame_interval=0.05).rollout([column])[0]
    runout = collapse.runout_over_time(trajectory)
    assert runout[-1] == pytest.approx(measures.normalised_runout(trajectory))
    assert runout[0] == pytest.approx(-0.025 / 0.3, abs=1e-6)
    assert collapse.height_over_time(trajectory)[0] == pytest.approx(0.275 / 0.3, abs=1e-6)
    assert collapse.critical_time(trajectory) == pytest.approx(math.sqrt(0.30 / 9.81))


def test_energy_of_points_sums_to_that_of_the_flow(small_flume):
    trajectory = MpmSimulator(spacing=0.05, frame_interval=0.03).rollout([small_flume])[0]
    whole = measures.potential_energy(trajectory) + measures.kinetic_energy(trajectory)
    found = [flume.point_energies(trajectory, t).sum() for t in range(len(trajectory.time))]
    np.testing.assert_allclose(found, whole, rtol=1e-5)


def test_energy_held_back_is_upstream_minus_downstream(small_flume, trajectory_of):
    """Three points at rest at one height: before, beside and behind the baffle at x 0.5 to 0.6."""
    points = np.array([[[0.2, 0.1, 0.3], [0.55, 0.1, 0.1], [0.9, 0.1, 0.3]]] * 3)
    scene = small_flume.replace(
        releases=({"lower": (0.0, 0.0, 0.1), "upper": (0.25, 0.2, 0.5), "velocity": (0, 0, 0)},)
    )
    held = flume.held_back(trajectory_of(points, scene))
    np.testing.assert_allclose(held, 0.0, atol=1e-12)
    points[1, 2, 0] = 0.55  # the last one is still between
    held = flume.held_back(trajectory_of(points[1:2], scene))
    np.testing.assert_allclose(held, 1 / 3)


def test_rows_of_baffles_are_told_apart_by_their_faces():
    assert flume.baffle_rows(paper.flume_scene()) == [[0, 1], [2]]


def test_relative_error_keeps_its_sign():
    assert relative(0.9, 1.0) == pytest.approx(-0.1)
    assert relative(-0.9, -1.0) == pytest.approx(0.1)
    assert math.isnan(relative(1.0, 0.0))


def test_scenes_outside_the_limits_are_named_once(column, tiny):
    limits = {"friction_angle": (30.0, 30.0), "release_height": 0.31}
    simulator = tiny(limits=limits)
    tall = column.replace(
        name="tall",
        releases=({"lower": (0.0, 0.0), "upper": (0.1, 0.4), "velocity": (0.0, 0.0)},),
    )
    (line,) = outside(simulator, [column, tall, tall.replace(name="again")])
    assert "'tall'" in line
    assert "release_height = 0.4" in line
    assert outside(tiny(), [tall]) == outside(MpmSimulator(), [tall]) == []

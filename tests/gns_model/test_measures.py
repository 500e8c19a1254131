from __future__ import annotations

import dataclasses
import math
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gns_model import measures
from gns_model.errors import SimulatorError
from gns_model.particles import STATIONARY, fill
from gns_model.scene import Scene


def shifted(scene: Scene, offset: np.ndarray) -> Scene:
    """The same scene somewhere else."""

    def move(corner):
        return tuple(float(a + b) for a, b in zip(corner, offset, strict=True))

    plan = [offset[0], *offset[2:]]
    return scene.replace(
        domain={"lower": move(scene.domain.lower), "upper": move(scene.domain.upper)},
        releases=tuple(
            {"lower": move(r.lower), "upper": move(r.upper), "velocity": r.velocity}
            for r in scene.releases
        ),
        baffles=tuple(
            {"center": tuple(np.add(b.center, plan).tolist()), "size": b.size}
            for b in scene.baffles
        ),
        section=scene.control_section + float(offset[0]),
        placement=None,
    )


def mirrored(scene: Scene) -> Scene:
    """The scene seen in the plane z = middle of the domain."""
    total = scene.domain.lower[2] + scene.domain.upper[2]

    def flip(box):
        low = (box.lower[0], box.lower[1], total - box.upper[2])
        return low, (box.upper[0], box.upper[1], total - box.lower[2])

    releases = []
    for release in scene.releases:
        low, up = flip(release)
        velocity = (*release.velocity[:2], -release.velocity[2])
        releases.append({"lower": low, "upper": up, "velocity": velocity})
    baffles = [
        {"center": (b.center[0], total - b.center[1]), "size": b.size} for b in scene.baffles
    ]
    return scene.replace(releases=tuple(releases), baffles=tuple(baffles), placement=None)


def random_cloud(scene: Scene, seed: int, frames: int = 5, points: int = 400) -> np.ndarray:
    return np.random.default_rng(seed).uniform(
        scene.domain.lower, scene.domain.upper, (frames, points, scene.dim)
    )


# -- known answers ---------------------------------------------------------------------------------


def test_travel_of_a_block_that_slides(flume: Scene, trajectory_of):
    start = fill(flume, 0.05).positions
    steps = np.array([0.0, 0.3, 0.8, 0.7])  # runs out and rebounds
    positions = start + np.stack([steps, 0 * steps, 0 * steps], axis=1)[:, None, :]
    trajectory = trajectory_of(positions, flume)
    result = measures.summary(trajectory)
    assert list(result) == list(measures.UNITS)
    assert result["runout_max"] == pytest.approx(0.8)
    assert result["runout_p99"] == pytest.approx(0.7)
    assert result["centroid_travel"] == pytest.approx(0.7)
    # Seven columns at x = 0.125 .. 0.425; 0.425 + 0.7 alone is past x = 1.1.
    assert result["mass_past_section"] == pytest.approx(1 / 7)
    centroid = measures.centroid_over_time(trajectory)[:, 0] - start[:, 0].mean()
    median = measures.runout_over_time(trajectory, quantile=0.5)
    for travel in (measures.runout_over_time(trajectory), median, centroid):
        np.testing.assert_allclose(travel, steps, atol=1e-12)
    np.testing.assert_allclose(measures.height_over_time(trajectory), 0.225)


def test_runout_max_follows_one_grain_and_p99_does_not(plane_scene: Scene, trajectory_of):
    positions = np.zeros((2, 1000, 2)) + 0.1
    positions[1, 0, 0] = 0.9
    result = measures.summary(trajectory_of(positions, plane_scene))
    assert result["runout_max"] == pytest.approx(0.8)
    assert result["runout_p99"] == 0.0
    assert result["centroid_travel"] == pytest.approx(0.8 / 1000)


def test_normalised_runout_is_measured_from_the_wall(plane_scene: Scene, trajectory_of):
    positions = np.array([[[0.1, 0.1]], [[0.5, 0.1]]])
    assert measures.normalised_runout(trajectory_of(positions, plane_scene)) == pytest.approx(1.5)


def test_arrival_time_is_linear_between_frames(plane_scene: Scene, trajectory_of):
    x = np.array([0.2, 0.4, 0.8, 0.7])
    positions = np.stack([np.stack([x, x - 0.1], axis=1), np.full((4, 2), 0.1)], axis=2)
    trajectory = trajectory_of(positions, plane_scene)  # a frame every 0.1 s
    assert measures.arrival_time(trajectory, 0.3) == pytest.approx(0.05)
    assert measures.arrival_time(trajectory, 0.7) == pytest.approx(0.175)
    assert measures.arrival_time(trajectory, 0.1) == 0.0
    assert measures.arrival_time(trajectory, 0.9) is None
    assert measures.arrival_time(trajectory, 0.7, quantile=0.0) == pytest.approx(0.2)


@pytest.mark.parametrize("by", ["runout_p99", "runout_max", "kinetic_energy"])
def test_rest_time_of_a_flow_that_decays(plane_scene: Scene, trajectory_of, by: str):
    t = np.arange(200) * 0.01
    x = 0.1 + 0.5 * (1 - np.exp(-t / 0.1))
    positions = np.stack([x, np.full_like(x, 0.05)], axis=1)[:, None, :]
    trajectory = trajectory_of(positions, plane_scene, interval=0.01)
    rest = measures.rest_time(trajectory, by=by, fraction=0.01)
    # exp(-t / tau) = 1%, and the energy decays twice as fast, from the first frame that moves.
    expected = 0.1 * math.log(100) * (0.5 if by == "kinetic_energy" else 1.0)
    assert rest == pytest.approx(expected, abs=0.02)
    moving = dataclasses.replace(trajectory, positions=positions[:20], time=trajectory.time[:20])
    assert measures.rest_time(moving, by=by) is None


def test_depth_is_read_in_the_window_upstream_of_the_face(flume: Scene, trajectory_of):
    # Baffle 0: face x = 0.70, z 0.30 to 0.45. A heap of 0.2 m in its window, filled 0.02 m apart.
    x, y, z = np.meshgrid(
        np.arange(0.61, 0.70, 0.02), np.arange(0.11, 0.30, 0.02), np.arange(0.31, 0.45, 0.02)
    )
    heap = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    volume = 0.1 * 0.15 * 0.2 / len(heap)
    trajectory = trajectory_of(heap[None], flume, point_volume=volume)
    depth = measures.upstream_depth_over_time(trajectory)
    assert depth.shape == (1, 3)
    expected = np.quantile(heap[:, 1] - 0.1, 0.98) + volume ** (1 / 3) / 2
    np.testing.assert_allclose(depth, [[expected, 0, 0]])
    np.testing.assert_allclose(
        measures.upstream_depth_over_time(trajectory, quantile=0.5)[0, 0], 0.11, atol=0.011
    )
    # Just beside, behind or too far upstream of the window nothing is seen.
    for offset in ([0, 0, 0.16], [0.11, 0, 0], [-0.11, 0, 0]):
        elsewhere = dataclasses.replace(trajectory, positions=heap[None] + offset)
        assert not measures.upstream_depth_over_time(elsewhere).any()
    # Ten centimetres further up it is, for a window of twice the length.
    far = dataclasses.replace(trajectory, positions=heap[None] + [-0.1, 0, 0])
    assert measures.upstream_depth_over_time(far, window=0.2)[0, 0] == pytest.approx(expected)
    assert measures.summary(trajectory)["upstream_depth"] == pytest.approx(expected)


@pytest.mark.parametrize("spacing", [0.05, 0.025, 0.0125])
def test_depth_of_a_block_is_its_height_at_any_spacing(flume: Scene, trajectory_of, spacing):
    block = fill(
        flume.replace(
            releases=({"lower": (0.4, 0.1, 0.25), "upper": (0.7, 0.3, 0.5), "velocity": (0, 0, 0)},)
        ),
        spacing,
    )
    trajectory = trajectory_of(block.positions[None], flume, point_volume=block.volume)
    assert measures.summary(trajectory)["upstream_depth"] == pytest.approx(0.2)


def test_a_thin_spray_is_no_depth(flume: Scene, trajectory_of):
    """2 cm of mean depth in the window are needed: here exactly 300 points."""
    length = measures.WINDOW_LENGTH
    volume = 0.02 * length * 0.15 / 300
    rng = np.random.default_rng(0)
    cloud = rng.uniform([0.70 - length, 0.1, 0.30], [0.70, 0.4, 0.45], (1, 300, 3))
    full = trajectory_of(cloud, flume, point_volume=volume)
    assert measures.summary(full)["upstream_depth"] > 0.28
    thin = trajectory_of(cloud[:, 1:], flume, point_volume=volume)
    assert measures.summary(thin)["upstream_depth"] == 0.0


@given(st.integers(0, 10_000))
def test_depth_agrees_with_the_definition_spelled_out(flume: Scene, trajectory_of, seed: int):
    volume, length = 2e-4, measures.WINDOW_LENGTH
    trajectory = trajectory_of(random_cloud(flume, seed), flume, point_volume=volume)
    depth = measures.upstream_depth_over_time(trajectory)
    for t, frame in enumerate(trajectory.positions):
        for b, (lower, upper) in enumerate(flume.baffle_boxes()):
            inside = (
                (frame[:, 0] >= lower[0] - length) & (frame[:, 0] <= lower[0])
                & (frame[:, 2] >= lower[2]) & (frame[:, 2] <= upper[2])
            )  # fmt: skip
            enough = inside.sum() * volume >= 0.02 * length * 0.15
            tops = np.clip(frame[inside, 1] - 0.1 + volume ** (1 / 3) / 2, 0, 0.8)
            expected = np.quantile(tops, 0.98) if enough else 0.0
            assert depth[t, b] == pytest.approx(expected, abs=1e-9)


@given(st.integers(0, 10_000))
def test_free_depth_tiles_the_placement_area(flume: Scene, trajectory_of, seed: int):
    bare = flume.with_baffles([])
    trajectory = trajectory_of(random_cloud(bare, seed), bare, point_volume=1e-3)
    depth = measures.upstream_depth_over_time(trajectory, window=0.10)
    assert depth.shape == (5, 9 * 12)  # 0.9 m by 0.10 m, 1.8 m by 0.15 m
    frame = trajectory.positions[2]
    for i, k in ((0, 0), (4, 7), (8, 11)):
        x, z = 0.6 + 0.1 * i, 0.1 + 0.15 * k
        inside = (frame[:, 0] >= x) & (frame[:, 0] < x + 0.1)
        inside &= (frame[:, 2] >= z) & (frame[:, 2] < z + 0.15)
        tops = np.clip(frame[inside, 1] - 0.1 + 0.05, 0, 0.8)
        expected = np.quantile(tops, 0.98) if inside.any() else 0.0
        assert depth[2, 12 * i + k] == pytest.approx(expected, abs=1e-9)


def test_free_depth_without_placement_lies_downstream_of_the_front(plane_scene: Scene):
    bare = plane_scene.replace(baffles=())
    lower, size, counts = measures.depth_tiles(bare, window=0.1)
    assert lower == pytest.approx([0.2])
    assert size == pytest.approx([0.1])
    assert counts == [8]


def test_the_front_of_fewer_points_is_the_mean_of_many_draws(flume: Scene, trajectory_of):
    """By drawing; of all points it is the front itself, and of fewer it is less far."""
    cloud = random_cloud(flume, 3, frames=2)
    trajectory = trajectory_of(cloud, flume)
    rng = np.random.default_rng(0)
    for points in (200, 50):
        drawn = [cloud[:, rng.random(400) < points / 400, 0].max(axis=1) for _ in range(3000)]
        found = measures.thinned_front_over_time(trajectory, points)
        scale = cloud[..., 0].std()
        np.testing.assert_allclose(found, np.mean(drawn, axis=0), atol=0.005 * scale)
        assert (found < measures.front_over_time(trajectory)).all()
    whole = measures.thinned_front_over_time(trajectory, 400)
    np.testing.assert_allclose(whole, measures.front_over_time(trajectory))
    np.testing.assert_allclose(measures.thinned_front_over_time(trajectory, 10**6), whole)


def test_overtopping_counts_a_point_once(flume: Scene, trajectory_of):
    frames = np.array(
        [
            # over baffle 0; never over one; over baffle 2 later; beside baffle 0
            [[0.75, 0.45, 0.40], [0.3, 0.2, 0.5], [0.9, 0.2, 1.0], [0.75, 0.8, 0.5]],
            [[0.75, 0.40, 0.35], [0.3, 0.2, 0.5], [1.25, 0.6, 1.0], [0.69, 0.8, 0.4]],
        ]
    )
    assert measures.overtopping(trajectory_of(frames, flume)) == 0.5
    assert measures.overtopping(trajectory_of(frames, flume.with_baffles([]))) == 0.0
    assert measures.points_inside_baffles(trajectory_of(frames, flume)) == 0


def test_points_inside_a_baffle_are_counted_once(flume: Scene, trajectory_of):
    inside = np.array([[[0.75, 0.2, 0.4], [1.0, 0.2, 0.4]], [[0.76, 0.2, 0.4], [1.0, 0.2, 0.4]]])
    trajectory = trajectory_of(inside, flume)
    assert measures.points_inside_baffles(trajectory) == 1
    # They leaked in: they did not come over the top.
    assert measures.overtopping(trajectory) == 0.0
    on_the_face = np.array([[[0.70, 0.2, 0.4], [0.75, 0.40, 0.4]]])
    assert measures.points_inside_baffles(trajectory_of(on_the_face, flume)) == 0


def test_energy_of_a_free_fall_is_kept(flume: Scene, trajectory_of):
    points = fill(flume, 0.05)
    t = np.arange(10) * 0.01
    fall = np.array([2.0, 0, 0]) * t[:, None] + np.array([0, -0.5 * 9.81, 0]) * t[:, None] ** 2
    positions = points.positions + fall[:, None, :]
    trajectory = trajectory_of(positions, flume, interval=0.01, point_volume=points.volume)
    mass = 1800 * points.volume * len(points.positions)
    potential, kinetic = measures.potential_energy(trajectory), measures.kinetic_energy(trajectory)
    np.testing.assert_allclose(
        potential, mass * 9.81 * (points.positions[:, 1].mean() - 0.1 + fall[:, 1])
    )
    speed2 = 4.0 + (9.81 * t) ** 2
    # Central differences of a parabola are exact; the last frame is half an interval behind.
    np.testing.assert_allclose(kinetic[:-1], 0.5 * mass * speed2[:-1])
    assert kinetic[-1] == pytest.approx(0.5 * mass * (4.0 + (9.81 * 0.085) ** 2))
    assert abs(measures.energy_dissipated(trajectory)) < 0.02 * kinetic[-1]


def test_all_kinetic_energy_of_a_block_that_stops_is_dissipated(flume: Scene, trajectory_of):
    points = fill(flume, 0.05)
    positions = np.repeat(points.positions[None], 3, axis=0)
    trajectory = trajectory_of(positions, flume, point_volume=points.volume)
    mass = trajectory.point_mass * len(points.positions)
    assert measures.energy_dissipated(trajectory) == pytest.approx(0.5 * mass * 4.0)


def test_energy_on_a_slope_falls_along_gravity(plane_scene: Scene, trajectory_of):
    slope = plane_scene.replace(gravity=(9.81 * 0.6, -9.81 * 0.8))
    positions = np.array([[[0.1, 0.1]], [[0.4, 0.1]]])
    trajectory = trajectory_of(positions, slope, point_volume=1.0)
    potential = measures.potential_energy(trajectory)
    assert potential[0] - potential[1] == pytest.approx(1800 * 9.81 * 0.6 * 0.3)


def test_every_release_starts_with_its_velocity(plane_scene: Scene):
    two = plane_scene.replace(
        releases=(
            {"lower": (0, 0), "upper": (0.2, 0.3), "velocity": (1.0, 0.0)},
            {"lower": (0.3, 0), "upper": (0.4, 0.3), "velocity": (-3.0, 1.0)},
        )
    )
    points = fill(two, 0.05)
    velocity = measures.release_velocity(two, points.positions.astype(np.float32))
    np.testing.assert_array_equal(velocity, points.velocities)


def test_position_error(plane_scene: Scene, trajectory_of):
    cloud = random_cloud(plane_scene, 0)
    a = trajectory_of(cloud, plane_scene)
    b = trajectory_of(np.add(cloud, [0.03, 0.04]), plane_scene)
    np.testing.assert_allclose(measures.position_error(a, b), 0.0025)
    # Half the frames of a linear motion: the reference is interpolated to them.
    line = np.linspace(0, 1, 9)[:, None, None] * np.ones((9, 3, 2))
    fine = trajectory_of(line, plane_scene, interval=0.05)
    odd = trajectory_of(line[1::2], plane_scene, interval=0.1)
    odd.time = odd.time + 0.05
    np.testing.assert_allclose(measures.position_error(odd, fine), 0.0, atol=1e-15)
    with pytest.raises(SimulatorError, match=r"covers 0.05 to 0.35 s"):
        measures.position_error(fine, odd)
    with pytest.raises(SimulatorError, match=r"400.*against 3"):
        measures.position_error(a, fine)


# -- laws ------------------------------------------------------------------------------------------


@given(st.integers(0, 10_000), st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_measures_do_not_see_where_the_scene_is(flume: Scene, trajectory_of, seed, offset):
    cloud = random_cloud(flume, seed)
    here = measures.summary(trajectory_of(cloud, flume))
    moved = shifted(flume, np.array(offset))
    there = measures.summary(trajectory_of(cloud + offset, moved))
    assert there == pytest.approx(here, rel=1e-6, abs=1e-6)


@given(st.integers(0, 10_000))
def test_measures_do_not_see_a_mirror(flume: Scene, trajectory_of, seed: int):
    lopsided = flume.with_baffles([[0.775, 0.5], [1.2, 1.3]])
    cloud = random_cloud(flume, seed)
    flipped = cloud * [1, 1, -1] + [0, 0, 2.0]
    here = measures.summary(trajectory_of(cloud, lopsided))
    there = measures.summary(trajectory_of(flipped, mirrored(lopsided)))
    assert there == pytest.approx(here, rel=1e-9, abs=1e-9)


@given(st.integers(0, 10_000))
def test_measures_do_not_see_the_order_of_points(flume: Scene, trajectory_of, seed: int):
    cloud = random_cloud(flume, seed)
    order = np.random.default_rng(seed).permutation(cloud.shape[1])
    here = measures.summary(trajectory_of(cloud, flume))
    there = measures.summary(trajectory_of(cloud[:, order], flume))
    assert there == pytest.approx(here, rel=1e-9)


def test_a_2d_scene_has_all_measures(plane_scene: Scene, trajectory_of):
    cloud = random_cloud(plane_scene, 1)
    result = measures.summary(trajectory_of(cloud, plane_scene))
    assert all(math.isfinite(v) for v in result.values())
    assert 0.45 < result["upstream_depth"] < 0.5
    assert result["overtopping"] > 0.1
    bare = trajectory_of(cloud, plane_scene.replace(baffles=()))
    assert measures.summary(bare)["upstream_depth"] > 0.45


# -- trouble ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
@pytest.mark.parametrize("baffles", [True, False])
def test_a_diverged_trajectory_has_finite_measures(
    flume: Scene, trajectory_of, bad: float, baffles: bool
):
    scene = flume if baffles else flume.with_baffles([])
    positions = random_cloud(scene, 3).astype(np.float32)
    positions[3, 7, 1] = bad
    positions[4] = bad
    result = measures.summary(trajectory_of(positions, scene, status="diverged"))
    assert all(math.isfinite(v) for v in result.values())
    if not math.isfinite(bad):
        good = measures.summary(trajectory_of(positions[[0, 1, 2, 2, 2]], scene))
        assert result == good


def test_no_finite_frame_or_no_moving_point_is_an_input_error(flume: Scene, trajectory_of):
    with pytest.raises(SimulatorError, match=r"first frame .* not finite"):
        measures.summary(trajectory_of(np.full((2, 4, 3), np.nan), flume))
    still = trajectory_of(np.zeros((2, 4, 3)), flume)
    still.particle_type[:] = STATIONARY
    with pytest.raises(SimulatorError, match="no moving point"):
        measures.summary(still)


def test_only_moving_points_count(flume: Scene, trajectory_of):
    cloud = random_cloud(flume, 5)
    wanted = measures.summary(trajectory_of(cloud[:, :300], flume))
    mixed = trajectory_of(cloud, flume)
    mixed.particle_type[300:] = STATIONARY
    assert measures.summary(mixed) == pytest.approx(wanted)


def test_one_frame_is_enough(flume: Scene, trajectory_of):
    result = measures.summary(trajectory_of(random_cloud(flume, 6, frames=1), flume))
    assert result["centroid_travel"] == 0.0
    assert result["energy_dissipated"] == 0.0


def test_a_fine_flume_is_summed_up_quickly(flume: Scene, trajectory_of):
    """91 frames of 31,000 points: a tenth of a second or two, so a loop over points would show."""
    cloud = random_cloud(flume, 7, frames=91, points=31_328).astype(np.float32)
    for scene in (flume, flume.with_baffles([])):
        trajectory = trajectory_of(cloud, scene)
        began = time.process_time()
        measures.summary(trajectory)
        assert time.process_time() - began < 2.0

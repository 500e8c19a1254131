"""What is measured at baffles turned about the vertical."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gns_model import footprint, measures
from gns_model.scene import Scene
from gns_model.smooth_measures import smooth_measures, window_weights

CENTRES = [(0.8, 0.5), (1.2, 1.3)]
SIZES = [(0.1, 0.3, 0.3), (0.2, 0.2, 0.15)]
VOLUME = 1e-3


def scene_of(flume: Scene, *yaws: float) -> Scene:
    return flume.with_baffles(CENTRES, size=SIZES, yaw=yaws)


def tensors(scene: Scene) -> tuple[torch.Tensor, ...]:
    return tuple(
        torch.tensor([getattr(b, name) for b in scene.baffles], dtype=torch.float64)
        for name in ("center", "size", "yaw")
    )


def cloud_of(scene: Scene, seed: int, frames: int, points: int) -> torch.Tensor:
    lower, upper = np.array(scene.domain.lower), np.array(scene.domain.upper)
    cloud = np.random.default_rng(seed).uniform(lower, upper, (frames, points, 3))
    cloud[..., 1] = lower[1] + (cloud[..., 1] - lower[1]) ** 2
    return torch.tensor(cloud)


@given(st.floats(-0.3, 0.3), st.floats(-89, 89).filter(lambda y: abs(y) > 1))
def test_the_upstream_side_is_where_a_ray_enters(z, yaw):
    size = (0.1, 0.3)
    half = footprint.bounding_size(size, yaw)[1] / 2
    if abs(z) > half - 1e-6:
        return
    x = float(footprint.upstream_side(z + 0.5, (0.8, 0.5), size, yaw)) - 0.8
    cosine, sine = footprint.turn(yaw)

    def inside(x: float) -> bool:
        u, v = cosine * x + sine * z, cosine * z - sine * x
        return abs(u) < size[0] / 2 and abs(v) < size[1] / 2

    assert not inside(x - 1e-9)
    assert not any(inside(s) for s in np.linspace(-0.5, x - 1e-9, 50))
    assert inside(x + 1e-9)


def test_the_depth_is_read_before_the_slanted_face(flume, trajectory_of):
    scene = scene_of(flume, 40.0, 0.0)
    corners = scene.baffles[0].corners
    side = corners[3] - corners[0]  # the side that looks upstream
    normal = np.array([-np.cos(np.radians(40)), -np.sin(np.radians(40))])
    rng = np.random.default_rng(0)
    along, away = rng.uniform(0.05, 0.95, (2, 4000))
    for first, expected in ((0.002, True), (0.09, False)):
        # A layer 0.2 m deep along the whole face: at it, or 9 cm away from it.
        plan = corners[0] + along[:, None] * side + (first + 0.02 * away[:, None]) * normal
        cloud = np.stack([plan[:, 0], 0.1 + 0.2 * rng.uniform(size=4000), plan[:, 1]], -1)[None]
        depth = measures.upstream_depth_over_time(trajectory_of(cloud, scene, point_volume=1e-6))
        assert depth.shape == (1, 2)
        assert (0.19 < depth[0, 0] < 0.21) == expected
        assert depth[0, 1] == 0


def test_overtopping_and_insides_follow_the_footprint(flume, trajectory_of):
    scene = scene_of(flume, 45.0, -30.0)
    rng = np.random.default_rng(1)
    cloud = rng.uniform((0.6, 0.1, 0.3), (1.4, 0.6, 1.6), (1, 4000, 3))
    over, within = np.zeros((2, 4000), bool)
    for baffle in scene.baffles:
        c, corners = cloud[0][:, [0, 2]], baffle.corners
        left = [
            (b - a)[0] * (c - a)[:, 1] - (b - a)[1] * (c - a)[:, 0] > 0
            for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
        ]
        plan = np.all(left, axis=0)
        above = cloud[0, :, 1] > 0.1 + baffle.size[1]
        over |= plan & above
        within |= plan & ~above
    trajectory = trajectory_of(cloud, scene)
    assert over.sum() > 20 < within.sum()
    assert measures.points_inside_baffles(trajectory, slack=0.0) == within.sum()
    assert measures.overtopping(trajectory) == pytest.approx(over.mean(), abs=3e-3)


@settings(max_examples=5)
@example(21, 0.0, 0.0)  # of 6,000 points the window holds too few for a quantile
@given(st.integers(0, 1000), st.floats(-80, 80), st.floats(-80, 80))
def test_smooth_becomes_hard_as_the_temperature_falls(flume, trajectory_of, seed, one, other):
    scene = scene_of(flume, one, other)
    cloud = cloud_of(scene, seed, 1, 30_000)
    centres, sizes, yaws = tensors(scene)
    hard = measures.summary(trajectory_of(cloud.numpy(), scene, point_volume=VOLUME / 50))
    smooth = smooth_measures(
        cloud, scene, centres, sizes, yaws=yaws, temperature=1e-6, point_volume=VOLUME / 50
    )
    assert float(smooth["upstream_depth"]) == pytest.approx(hard["upstream_depth"], rel=0.1)


def test_no_yaw_is_no_yaw_and_a_little_changes_little(flume):
    scene = scene_of(flume, 0.0, 0.0)
    cloud = cloud_of(scene, 3, 2, 3000)
    centres, sizes, _ = tensors(scene)
    plain = window_weights(cloud, centres, sizes, 0.01)
    for yaws, atol in ((0.0, 0.0), (torch.zeros(2), 1e-12), (torch.tensor([1e-4, -1e-4]), 1e-3)):
        weights = window_weights(cloud, centres, sizes, 0.01, yaws=yaws)
        torch.testing.assert_close(weights, plain, rtol=0, atol=atol)
    # A quarter turn is exchanged sides.
    quarter = window_weights(cloud, centres, sizes, 0.01, yaws=90.0)
    exchanged = window_weights(cloud, centres, sizes[:, [2, 1, 0]], 0.01)
    torch.testing.assert_close(quarter, exchanged, rtol=0, atol=1e-9)


def test_gradients_in_place_size_and_yaw_equal_central_differences(flume):
    scene = scene_of(flume, 35.0, -20.0)
    cloud = cloud_of(scene, 2, 3, 400)

    def value(centres, sizes, yaws):
        smooth = smooth_measures(cloud, scene, centres, sizes, yaws=yaws, point_volume=VOLUME)
        return smooth["upstream_depth"]

    values = tensors(scene)
    wanted = [v.clone().requires_grad_() for v in values]
    gradients = torch.autograd.grad(value(*wanted), wanted)
    for which, gradient in enumerate(gradients):
        numeric = torch.zeros_like(gradient)
        for index in np.ndindex(*gradient.shape):
            ends = []
            for sign in (1, -1):
                moved = [v.clone() for v in values]
                moved[which][index] += sign * 1e-6
                ends.append(float(value(*moved)))
            numeric[index] = (ends[0] - ends[1]) / 2e-6
        assert numeric.norm() > 1e-6
        assert (gradient - numeric).norm() <= 1e-5 * numeric.norm()

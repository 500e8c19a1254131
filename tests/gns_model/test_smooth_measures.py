from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gns_model import measures
from gns_model.scene import Scene
from gns_model.smooth_measures import (
    smooth_maximum,
    smooth_measures,
    smooth_quantile,
    window_weights,
)

VOLUME = 1e-3


def cloud_of(scene: Scene, seed: int, frames: int = 4, points: int = 800) -> torch.Tensor:
    lower, upper = np.array(scene.domain.lower), np.array(scene.domain.upper)
    cloud = np.random.default_rng(seed).uniform(lower, upper, (frames, points, scene.dim))
    # The flow is a layer: heights thin out, and the front lies inside the domain.
    cloud[..., 1] = lower[1] + (cloud[..., 1] - lower[1]) ** 2
    return torch.tensor(cloud, dtype=torch.float64)


def layout_of(scene: Scene) -> tuple[torch.Tensor, torch.Tensor]:
    centres = torch.tensor([b.center for b in scene.baffles], dtype=torch.float64)
    return centres, torch.tensor([b.size for b in scene.baffles], dtype=torch.float64)


@given(st.integers(0, 10_000), st.sampled_from(["flume", "plane_scene"]))
def test_smooth_becomes_hard_as_the_temperature_falls(request, trajectory_of, seed, name):
    scene: Scene = request.getfixturevalue(name)
    cloud = cloud_of(scene, seed)
    centres, sizes = layout_of(scene)
    hard = measures.summary(trajectory_of(cloud.numpy(), scene, point_volume=VOLUME))
    errors = []
    for temperature in (1e-2, 1e-3, 1e-6):
        smooth = smooth_measures(
            cloud, scene, centres, sizes, temperature=temperature, point_volume=VOLUME
        )
        errors.append({key: abs(float(value) - hard[key]) for key, value in smooth.items()})
    assert all(e["centroid_travel"] < 1e-12 for e in errors)
    for warm, bound in zip(errors, (0.02, 0.012, 0.005), strict=True):
        # A quantile of few points is known to the gap between two of them.
        assert warm["mass_past_section"] < bound
        assert warm["runout_p99"] < bound * scene.domain.size[0]
    assert errors[-1]["upstream_depth"] < 0.15 * hard["upstream_depth"]


def test_a_deep_heap_has_its_depth(flume: Scene):
    """Many points, as in a real flow: at the default temperature within a centimetre."""
    cloud = cloud_of(flume, 1, frames=3, points=40_000)
    centres, sizes = layout_of(flume)
    columns = cloud[:, :, 0] < 1.2
    cloud[..., 1] = 0.1 + (cloud[..., 1] - 0.1) * columns
    smooth = smooth_measures(cloud, flume, centres, sizes, point_volume=1e-4)
    face = (cloud[..., 0] >= 0.7 - measures.WINDOW_LENGTH) & (cloud[..., 0] <= 0.7)
    inside = face & (cloud[..., 2] >= 0.3) & (cloud[..., 2] <= 0.45)
    depths = [
        torch.quantile(frame[there, 1] - 0.1, 0.98)
        for frame, there in zip(cloud, inside, strict=True)
    ]
    hard = float(max(depths)) + 1e-4 ** (1 / 3) / 2
    assert float(smooth["upstream_depth"]) == pytest.approx(hard, abs=0.03)


@pytest.mark.parametrize("name", ["flume", "plane_scene"])
@pytest.mark.parametrize("key", ["centroid_travel", "runout_p99", "mass_past_section",
                                 "upstream_depth"])  # fmt: skip
def test_gradients_equal_central_differences(request, name: str, key: str):
    scene: Scene = request.getfixturevalue(name)
    cloud = cloud_of(scene, 2, frames=3, points=200)
    centres, sizes = layout_of(scene)

    def value(positions: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
        return smooth_measures(positions, scene, where, sizes, point_volume=VOLUME)[key]

    inputs = (cloud.requires_grad_(), centres.requires_grad_())
    gradients = torch.autograd.grad(value(*inputs), inputs, allow_unused=True)
    generator = torch.Generator().manual_seed(0)
    for index, gradient in enumerate(gradients):
        if gradient is None:
            assert index == 1
            assert key != "upstream_depth"
            continue
        for _ in range(4):
            direction = torch.randn(inputs[index].shape, generator=generator, dtype=torch.float64)
            step = 1e-6 * direction
            ends = []
            for sign in (1, -1):
                moved = [v.detach().clone() for v in inputs]
                moved[index] += sign * step
                ends.append(float(value(*moved)))
            numeric = (ends[0] - ends[1]) / 2e-6
            assert float((gradient * direction).sum()) == pytest.approx(numeric, rel=1e-4, abs=1e-7)


def test_float32_agrees_with_float64(flume: Scene):
    cloud, (centres, sizes) = cloud_of(flume, 3), layout_of(flume)
    double = smooth_measures(cloud, flume, centres, sizes)
    single = smooth_measures(cloud.float(), flume, centres.float(), sizes.float())
    for key in double:
        assert single[key].dtype == torch.float32
        assert float(single[key]) == pytest.approx(float(double[key]), rel=1e-4, abs=1e-5)


@given(st.integers(0, 1000), st.floats(0.02, 0.98))
@settings(max_examples=100)
def test_smooth_quantile_is_a_quantile(seed: int, q: float):
    values = torch.tensor(np.random.default_rng(seed).normal(size=(3, 501)))
    soft = smooth_quantile(values, q, 1e-4)
    hard = torch.quantile(values, q, dim=-1)
    torch.testing.assert_close(soft, hard, atol=0.3, rtol=0)
    # Exactly: so much of the blurred mass lies below it.
    share = torch.sigmoid((soft[:, None] - values) / 1e-4).mean(dim=-1)
    torch.testing.assert_close(share, torch.full_like(share, q), atol=2e-3, rtol=0)
    # Shifted and stretched values have a shifted and stretched quantile.
    # (Wider: where q falls in a gap of many widths, any s in the gap is a quantile.)
    wide = smooth_quantile(values, q, 0.05)
    torch.testing.assert_close(smooth_quantile(3 * values - 1, q, 0.15), 3 * wide - 1)
    # A weight of two is the point twice.
    twice = smooth_quantile(torch.cat([values, values[:, :9]], dim=1), q, 0.05)
    weights = torch.ones_like(values)
    weights[:, :9] = 2
    torch.testing.assert_close(smooth_quantile(values, q, 0.05, weights=weights), twice)


def test_smooth_quantile_moves_with_all_values():
    values = torch.linspace(0, 1, 50, dtype=torch.float64).requires_grad_()
    (gradient,) = torch.autograd.grad(smooth_quantile(values, 0.9, 0.05), values)
    assert float(gradient.sum()) == pytest.approx(1.0)
    assert (gradient >= 0).all()


def test_smooth_maximum_never_exceeds():
    values = torch.tensor([0.1, 0.5, 0.49], dtype=torch.float64)
    assert 0.45 < float(smooth_maximum(values, 0.05)) < 0.5
    assert float(smooth_maximum(values, 1e-4)) == pytest.approx(0.5)


def test_window_is_one_inside_half_on_the_edge_and_zero_outside(flume: Scene):
    centres, sizes = layout_of(flume)
    x = 0.70 - measures.WINDOW_LENGTH / 2  # the middle of the window of the first baffle
    points = torch.tensor([[[x, 0.2, 0.375], [0.70, 0.2, 0.375], [x, 0.2, 0.30],
                            [0.80, 0.2, 0.375], [x, 0.2, 0.6]]], dtype=torch.float64)  # fmt: skip
    weights = window_weights(points, centres, sizes, 5e-4)
    assert weights.shape == (1, 3, 5)
    np.testing.assert_allclose(weights[0, 0], [1, 0.5, 0.5, 0, 0], atol=1e-9)


def test_empty_windows_are_finite_and_shallow(flume: Scene):
    cloud = cloud_of(flume, 4)
    cloud[..., 0] = 0.2
    centres, sizes = layout_of(flume)
    for dtype in (torch.float32, torch.float64):
        positions = cloud.to(dtype).requires_grad_()
        where = centres.to(dtype).requires_grad_()
        depth = smooth_measures(positions, flume, where, sizes.to(dtype))["upstream_depth"]
        gradients = torch.autograd.grad(depth, (positions, where))
        assert 0 <= float(depth.detach()) < 1e-3
        assert all(torch.isfinite(g).all() for g in gradients)


def test_without_baffles_the_depth_is_that_of_the_free_flow(flume: Scene, trajectory_of):
    cloud, bare = cloud_of(flume, 5), flume.with_baffles([])
    smooth = smooth_measures(
        cloud, flume, torch.zeros((0, 2)), flume.baffle_size, point_volume=VOLUME
    )
    hard = measures.summary(trajectory_of(cloud.numpy(), bare, point_volume=VOLUME))
    assert float(smooth["upstream_depth"]) == pytest.approx(hard["upstream_depth"])


def test_moving_a_baffle_into_a_heap_raises_the_depth(flume: Scene):
    """The window's own gradient: a heap just upstream of the window draws the baffle's depth up."""
    rng = np.random.default_rng(6)
    heap = torch.tensor(rng.uniform([0.55, 0.1, 0.9], [0.65, 0.4, 1.1], (1, 500, 3)))
    face = 0.66 + measures.WINDOW_LENGTH
    centres = torch.tensor([[face + 0.075, 1.0]], dtype=torch.float64, requires_grad=True)
    depth = smooth_measures(heap, flume, centres, (0.15, 0.3, 0.15), point_volume=1e-5)
    (gradient,) = torch.autograd.grad(depth["upstream_depth"], centres)
    assert gradient[0, 0] < 0

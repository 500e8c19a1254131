"""From windows to a step's batch: mirror, statistics, draws."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gns_model.data.windows import WindowIndex
from gns_model.learned.graph import radius_graph
from gns_model.scene import Scene
from gns_model.training import Recipe
from gns_model.training.augment import mirror_positions, mirrored
from gns_model.training.batches import DRAW, draw, generator, read
from gns_model.training.distributed import Ranks
from gns_model.training.feeding import Feeder
from gns_model.training.statistics import measure

SPACING, DT, RADIUS = 0.0625, 0.02, 0.1


def index(folder, unroll=2):
    return WindowIndex([folder], spacing=SPACING, dt=DT, history=3, unroll=unroll)


def statistics(windows, **changes):
    options = {"windows": 64, "radius": RADIUS, "noise_std": 0.0, "subtract_gravity": True}
    return measure(windows, **{**options, **changes})


# -- mirror ----------------------------------------------------------------------------------------


def placed_scene() -> Scene:
    return Scene.from_dict(
        {
            "domain": {"lower": [0.1, 0.1, 0.2], "upper": [1.9, 0.9, 1.7]},
            "gravity": [1.0, -9.0, 0.5],
            "release": [
                {"lower": [0.1, 0.1, 0.3], "upper": [0.4, 0.3, 1.0], "velocity": [2, 0, 0.3]}
            ],
            "baffle": [{"center": [0.8, 0.5], "size": [0.1, 0.3, 0.2]}],
            "placement": {
                "lower": [0.6, 0.2],
                "upper": [1.5, 1.6],
                "keep_out": [[1.0, 0.2, 1.2, 0.5]],
            },
        }
    )


def test_a_mirrored_scene_is_a_scene_and_two_mirrors_undo_each_other():
    scene = placed_scene()
    other = mirrored(scene)
    assert Scene.from_dict(other.to_dict()) == other  # passes every check of a scene
    assert other.baffles[0].center == pytest.approx((0.8, 1.4))
    assert other.releases[0].velocity == (2, 0, -0.3)
    assert other.gravity == (1.0, -9.0, -0.5)
    back = mirrored(other)
    np.testing.assert_allclose(back.baffle_boxes(), scene.baffle_boxes(), atol=1e-12)
    np.testing.assert_allclose(back.releases[0].lower, scene.releases[0].lower, atol=1e-12)
    np.testing.assert_allclose(back.placement.keep_out, scene.placement.keep_out, atol=1e-12)
    points = np.random.default_rng(0).uniform(0.3, 0.8, (5, 4, 3)).astype(np.float32)
    np.testing.assert_allclose(
        mirror_positions(mirror_positions(points, scene), other), points, atol=1e-6
    )


def test_a_mirror_keeps_distances_to_baffles_and_walls():
    from gns_model.learned.features import signed_distance

    scene, rng = placed_scene(), np.random.default_rng(0)
    points = rng.uniform(scene.domain.lower, scene.domain.upper, (50, 3))
    seen = mirror_positions(points, scene)

    def distances(points, scene):
        boxes = torch.tensor(scene.baffle_boxes())[None].expand(len(points), -1, -1, -1)
        return signed_distance(torch.tensor(points), boxes)[0]

    # The mirror plane is rounded to float32, as positions are.
    torch.testing.assert_close(
        distances(points, scene), distances(seen, mirrored(scene)), atol=1e-6, rtol=0
    )


# -- statistics ------------------------------------------------------------------------------------


def test_statistics_of_free_flight_are_those_of_a_parabola(free_flight):
    plain = statistics(index(free_flight), subtract_gravity=False)
    known = statistics(index(free_flight))
    assert plain.velocity_mean[0] == pytest.approx(1.0, abs=1e-3)
    assert plain.velocity_mean[2] == plain.acceleration_mean[2] == 0
    # Windows that begin at t = 0 see half of gravity, since there was none before.
    assert -9.82 < plain.acceleration_mean[1] < -0.5 * 9.81
    np.testing.assert_allclose(
        np.subtract(known.acceleration_mean, plain.acceleration_mean), [0, 9.81, 0], atol=1e-6
    )


def test_noise_widens_the_statistics_as_it_widens_the_data(slides):
    windows, noise = index(slides), 1e-3
    plain, noisy = statistics(windows), statistics(windows, noise_std=noise)
    assert noisy.velocity_std == pytest.approx(np.hypot(plain.velocity_std, noise / DT), rel=1e-3)
    assert noisy.acceleration_std == pytest.approx(
        np.hypot(plain.acceleration_std, noise / DT**2), rel=1e-3
    )


# -- batches ---------------------------------------------------------------------------------------


def test_draws_are_shared_out_evenly_and_repeat(slides):
    windows = index(slides)
    about = statistics(windows)

    def parts(step):
        return draw(
            windows,
            generator(0, DRAW, step),
            ranks=3,
            edges_per_batch=4000,
            statistics=about,
            mirror=True,
        )

    assert parts(7) == parts(7)
    assert parts(7) != parts(8)
    sizes = np.array([[sum(d.edges for d in part) for part in parts(k)] for k in range(20)])
    assert sizes.mean() == pytest.approx(4000, rel=0.1)
    assert (sizes.max(axis=1) / sizes.min(axis=1)).mean() < 1.5
    flips = [d.mirror for k in range(20) for part in parts(k) for d in part]
    assert 0.3 < np.mean(flips) < 0.7


def test_expected_edges_are_near_the_real_ones(slides):
    windows = index(slides)
    about = statistics(windows)
    parts = draw(
        windows,
        np.random.default_rng(0),
        ranks=1,
        edges_per_batch=60_000,
        statistics=about,
        mirror=False,
    )
    real = sum(
        len(radius_graph(torch.from_numpy(read(windows, d).history[:, -1].copy()), RADIUS)[0])
        for d in parts[0]
    )
    assert real == pytest.approx(sum(d.edges for d in parts[0]), rel=0.1)


def test_a_rank_gets_a_window_even_if_it_is_too_large(slides):
    windows = index(slides)
    parts = draw(
        windows,
        np.random.default_rng(0),
        ranks=4,
        edges_per_batch=1,
        statistics=statistics(windows),
        mirror=False,
    )
    assert [len(part) for part in parts] == [1] * 4


def test_early_windows_are_drawn_as_often_as_asked(slides):
    windows = index(slides)
    measured = statistics(windows)

    def share(early):
        draws = [
            item
            for seed in range(150)
            for item in draw(
                windows,
                np.random.default_rng(seed),
                ranks=1,
                edges_per_batch=1,
                statistics=measured,
                mirror=False,
                early=early,
                early_steps=8,
            )[0]
        ]
        early_frames = 8 * windows.stride(0)
        assert all(0 <= item.frame < windows.starts(item.source, 1) for item in draws)
        return np.mean([item.frame < early_frames for item in draws])

    uniform = share(0.0)
    assert share(1.0) == 1.0
    assert share(0.5) == pytest.approx(0.5 + uniform / 2, abs=0.12)
    assert uniform < 0.95


def test_windows_read_ahead_are_those_that_would_be_read(slides, tiny):
    """Also where the next step is not the one that was expected."""
    recipe = Recipe.from_dict(
        {**tiny, "unroll": 3, "unroll_fraction": 0.5, "edges_per_batch": 3000}
    )
    windows, ranks = index(slides, unroll=3), Ranks(0, 2, torch.device("cpu"))
    about = statistics(windows)
    plain = Feeder(windows, recipe, about, ranks, ahead=False)
    ahead = Feeder(windows, recipe, about, ranks, ahead=True)
    for step, progress in ((0, 0.1), (1, 0.4), (2, 0.6), (3, 0.6), (7, 0.9), (8, 0.95)):
        one, two = plain.take(step, progress), ahead.take(step, progress)
        assert one[1] == two[1]
        assert len(one[0]) == len(two[0]) > 1
        for a, b in zip(one[0], two[0], strict=True):
            np.testing.assert_array_equal(a.history, b.history)
            np.testing.assert_array_equal(a.future, b.future)
            assert a.future.shape[1] == plain.unroll(step, progress)
    ahead.close()

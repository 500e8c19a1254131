"""Half of a symmetric flow is the flow of that half against a smooth wall."""

from __future__ import annotations

import numpy as np
import pytest

from gns_model.data.halves import half, plane_of_symmetry
from gns_model.data.scenes import draw
from gns_model.data.windows import WindowIndex
from gns_model.mpm import MpmSimulator
from gns_model.scene import Scene
from gns_model.training.batches import Draw, read
from gns_model.training.batches import draw as draw_windows
from gns_model.training.statistics import Statistics

SPACING, INTERVAL = 0.0125, 0.01


def column(**changes) -> Scene:
    values = {
        "name": "free-standing",
        "domain": {"lower": [0.0, 0.0], "upper": [1.0, 0.6]},
        "release": [{"lower": [0.4, 0.0], "upper": [0.6, 0.2], "velocity": [0.0, 0.0]}],
        "friction": {"base": 0.265, "walls": 0.0},
        "material": {"friction_angle": 30.0},
        "duration": 0.3,
        **changes,
    }
    return Scene.from_dict(values)


def release(low: float, high: float, speed: float) -> dict:
    return {"lower": [low, 0.0], "upper": [high, 0.2], "velocity": [speed, -0.1]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("halves")
    MpmSimulator(spacing=SPACING, frame_interval=INTERVAL).rollout([column()])[0].save(
        path / "whole.h5"
    )
    return path


@pytest.fixture(scope="module")
def windows(folder):
    return WindowIndex([folder], spacing=SPACING, dt=INTERVAL, history=3, unroll=1)


@pytest.mark.parametrize(
    ("changes", "plane"),
    [
        ({}, 0.5),
        ({"release": [release(0.4, 0.5, -0.3), release(0.5, 0.6, 0.3)]}, 0.5),
        ({"release": [release(0.4, 0.5, 0.3), release(0.5, 0.6, 0.3)]}, None),
        ({"release": [release(0.4, 0.5, 0.0), release(0.55, 0.6, 0.0)]}, None),
        ({"release": [release(0.0, 0.2, 0.0)]}, None),  # against the wall
        ({"release": [release(0.1, 0.3, 0.0)]}, None),  # and too near to it
        ({"friction": {"base": 0.265, "walls": 0.3}}, None),
        ({"gravity": [1.0, -9.7]}, None),
        ({"baffle": [{"center": [0.8], "size": [0.05, 0.1]}]}, None),
    ],
)
def test_which_flows_are_symmetric(changes, plane):
    assert plane_of_symmetry(column(**changes)) == (None if plane is None else pytest.approx(plane))


def test_every_family_of_squares_has_symmetric_flows():
    for family in ("squares", "spreading", "pressed"):
        planes = [plane_of_symmetry(draw(family, 0, k)) for k in range(40)]
        assert 5 <= sum(plane is not None for plane in planes) <= 25
    assert plane_of_symmetry(draw("layouts", 0, 0)) is None


def test_a_half_moves_as_the_solver_moves_it_against_a_wall(windows):
    scene = windows.read(0, 0, half=True).scene
    assert scene == half(column(), 0.5)
    assert (scene.domain.lower, scene.releases[0].lower) == ((0.5, 0.0), (0.5, 0.0))
    truth = MpmSimulator(spacing=SPACING, frame_interval=INTERVAL).rollout([scene])[0].positions
    moved = np.abs(truth[-1] - truth[0]).mean()
    for frame in (0, 10, 29):
        window = windows.read(0, frame, half=True)
        assert window.history.shape == (len(truth[0]), 4, 2)
        error = np.abs(window.history[:, -1] - truth[frame]).mean()
        assert error < 0.03 * moved, frame


def test_the_same_points_are_kept_in_every_frame(windows):
    first, later = (windows.read(0, frame, half=True) for frame in (5, 6))
    np.testing.assert_array_equal(first.future[:, 0], later.history[:, -1])
    assert (later.history[..., 0] >= 0.5).all()
    whole = windows.read(0, 6)
    assert 2 * len(later.history) == len(whole.history)


def test_a_half_can_stand_in_the_mirror(windows):
    plain = read(windows, Draw(0, 10, 0, False, 0.0, half=True))
    flipped = read(windows, Draw(0, 10, 0, True, 0.0, half=True))
    total = sum(box[0] for box in (plain.scene.domain.lower, plain.scene.domain.upper))
    np.testing.assert_allclose(flipped.history[..., 0], total - plain.history[..., 0], atol=1e-6)
    assert flipped.scene.releases[0].upper[0] == pytest.approx(1.0)


def test_halves_are_drawn_only_where_asked_for(windows):
    statistics = Statistics((0.0, 0.0), 1.0, (0.0, 0.0), 1.0, (10.0,) * 8)

    def drawn(**options):
        rng = np.random.default_rng(0)
        [part] = draw_windows(
            windows, rng, ranks=1, edges_per_batch=60_000, statistics=statistics, mirror=False,
            **options,
        )  # fmt: skip
        return part

    assert not any(item.half for item in drawn())
    some = drawn(halves=True)
    assert 0 < sum(item.half for item in some) < len(some)
    edges = {item.half: item.edges for item in some}
    assert edges[True] == pytest.approx(edges[False] / 2, rel=0.1)

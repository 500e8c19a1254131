"""From windows to the loss: mirror, statistics, batches, and the target behind the noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from gns_model.data.windows import WindowIndex
from gns_model.learned.config import ModelConfig
from gns_model.learned.graph import radius_graph
from gns_model.learned.model import LearnedModel
from gns_model.scene import Scene
from gns_model.training import Recipe
from gns_model.training.augment import mirror_positions, mirrored
from gns_model.training.batches import DRAW, collate, draw, generator, read
from gns_model.training.distributed import Ranks
from gns_model.training.feeding import Feeder
from gns_model.training.loss import CELL, FRONT, Emphasis, step_error, unrolled_loss
from gns_model.training.statistics import measure

SPACING, DT, RADIUS = 0.0625, 0.02, 0.1


def index(folder, unroll=2):
    return WindowIndex([folder], spacing=SPACING, dt=DT, history=3, unroll=unroll)


def statistics(windows, **changes):
    options = {"windows": 64, "radius": RADIUS, "noise_std": 0.0, "subtract_gravity": True}
    return measure(windows, **{**options, **changes})


def model(**changes) -> LearnedModel:
    torch.manual_seed(0)
    config = ModelConfig(spacing=SPACING, dt=DT, radius=RADIUS, latent=8, blocks=2, **changes)
    return LearnedModel(config)


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


# -- loss ------------------------------------------------------------------------------------------


def ballistic(folder, noise_std=0.0, unroll=3):
    """A model that predicts a = g, and a batch of free flight whose last velocity knows gravity."""
    net = model(noise_std=noise_std)
    with torch.no_grad():
        for p in net.network.decode.parameters():
            p.zero_()
    windows = index(folder, unroll)
    batch = collate(
        [windows.read(0, frame) for frame in (2, 3, 4)],
        noise_std=noise_std,
        rng=np.random.default_rng(0),
        device=torch.device("cpu"),
    )
    return net, batch


@pytest.mark.parametrize("backprop", [False, True])
@pytest.mark.parametrize("steps", [1, 3])
def test_free_flight_costs_nothing_when_gravity_is_known(free_flight, steps, backprop):
    net, batch = ballistic(free_flight)
    with torch.no_grad():
        loss = unrolled_loss(net, batch, steps=steps, backprop=backprop)
        # What float32 positions leave of an acceleration of 9.81 m/s² is below 0.01 m/s².
        assert float(loss) < 1e-4
        net.acceleration_mean[1] = 1.0
        assert float(unrolled_loss(net, batch, steps=steps, backprop=backprop)) > 0.3


def test_the_target_is_corrected_for_the_noise(free_flight):
    """A step that reproduces the true displacement costs nothing whatever the noise, and a model
    that trusts the noisy velocity is wrong by exactly the noise of that velocity."""
    noise_std = 1e-3
    net, noisy = ballistic(free_flight, noise_std)
    _, clean = ballistic(free_flight)
    torch.testing.assert_close(noisy.moves, clean.moves)
    after = noisy.history[:, -1] + noisy.moves[:, 0]
    assert float(step_error(net, noisy.history, after, noisy.moves[:, 0])) < 1e-4
    history = noisy.history
    gravity = torch.tensor([0, -9.81, 0]) * DT**2
    trusting = history[:, -1] + (history[:, -1] - history[:, -2]) + gravity
    found = float(step_error(net, history, trusting, noisy.moves[:, 0]))
    assert found == pytest.approx((noise_std / DT**2) ** 2, rel=0.25)


def test_push_forward_and_backprop_agree_on_one_step_only(slides):
    windows = index(slides)
    net = model()
    statistics(windows).apply(net)
    rng = np.random.default_rng(0)
    batch = collate([windows.read(0, 3)], noise_std=0.0, rng=rng, device=torch.device("cpu"))

    def gradient(steps, backprop):
        net.zero_grad()
        unrolled_loss(net, batch, steps=steps, backprop=backprop).backward()
        return torch.cat([p.grad.flatten() for p in net.parameters() if p.grad is not None])

    torch.testing.assert_close(gradient(1, False), gradient(1, True))
    assert not torch.allclose(gradient(2, False), gradient(2, True), rtol=1e-2)


def test_the_loss_turns_linear_where_asked(free_flight):
    net, batch = ballistic(free_flight)
    history, move = batch.history, batch.moves[:, 0]
    scale = DT**2 * net.acceleration_std

    def cost(error, beyond):
        after = history[:, -1] + move + error * scale
        return float(step_error(net, history, after, move, Emphasis(linear_beyond=beyond)))

    assert cost(1.0, None) == pytest.approx(1.0, rel=1e-2)
    assert cost(0.5, 10.0) == pytest.approx(0.25, rel=1e-2)
    assert cost(100.0, 2.0) == pytest.approx(2 * 4 * ((1 + 2500) ** 0.5 - 1), rel=1e-2)


def test_an_error_that_a_scene_shares_weighs_more(free_flight):
    net, batch = ballistic(free_flight)
    history, move = batch.history, batch.moves[:, 0]
    count = len(history)
    scene = torch.arange(count) % 2
    scale = DT**2 * net.acceleration_std
    exact = history[:, -1] + move

    def cost(error, weight):
        emphasis = Emphasis(momentum_weight=weight)
        after = exact + error[:, None] * scale
        return float(step_error(net, history, after, move, emphasis, batch=scene))

    shared = torch.where(scene == 0, 1.0, -1.0)
    # +1 in every point of one scene, -1 in the other: each scene's mean error is one.
    assert cost(shared, 3.0) == pytest.approx(1 + 3, rel=1e-2)
    # +1 and -1 in turn within each scene: the means vanish.
    order = torch.arange(count) // 2 % 2
    even = torch.where(order == 0, 1.0, -1.0)
    even[2 * (count // 4) * 2 :] = 0.0
    assert cost(even, 1000.0) < 1.2


def test_an_error_that_neighbours_share_weighs_more(free_flight):
    """Grains are laid out in cells of ten: one error all over a cell, or one that changes sign from
    grain to grain within it."""
    net, batch = ballistic(free_flight)
    count = len(batch.history) // 10 * 10
    history, move = batch.history[:count].clone(), batch.moves[:count, 0]
    cell, number = torch.arange(count) // 10, torch.arange(count) % 10
    side = CELL * net.config.spacing
    place = torch.stack([cell + 0.05 + 0.09 * number, torch.full((count,), 0.5)], dim=1)
    place = torch.cat([place, place[:, 1:]], dim=1) if history.shape[2] == 3 else place
    history += (place * side)[:, None] - history[:, -1:]
    scale = DT**2 * net.acceleration_std

    def cost(error, weight):
        after = history[:, -1] + move + error[:, None] * scale
        return float(step_error(net, history, after, move, Emphasis(local_weight=weight)))

    by_cell = torch.where(cell % 2 == 0, 1.0, -1.0)
    by_grain = torch.where(number % 2 == 0, 1.0, -1.0)
    assert cost(by_cell, 3.0) == pytest.approx(1 + 3, rel=1e-2)
    assert cost(by_grain, 3.0) == pytest.approx(1, rel=1e-2)


def test_an_error_of_the_front_weighs_more(free_flight):
    """The same error in as many points: at the front of one of two scenes, and anywhere in it."""
    net, batch = ballistic(free_flight)
    history, move = batch.history.clone(), batch.moves[:, 0]
    history[..., 0] += 1e-4 * torch.arange(len(history))[:, None]  # no two at one place
    scene = torch.arange(len(history)) % 2
    scale = DT**2 * net.acceleration_std
    place = history[:, -1, 0].where(scene == 0, -1.0)
    count = 1 + int(FRONT * int((scene == 0).sum()))
    order = place.argsort(descending=True)

    def cost(rows, weight):
        emphasis = Emphasis(front_weight=weight)
        error = torch.zeros(len(history))
        error[rows] = 1.0
        after = history[:, -1] + move + error[:, None] * scale
        return float(step_error(net, history, after, move, emphasis, batch=scene))

    rear = order[int((scene == 0).sum()) - count : int((scene == 0).sum())]
    share = count / len(history)
    assert cost(rear, 8.0) == pytest.approx(share, rel=1e-2, abs=1e-4)
    # The front's mean error is one in this scene and nothing in the other.
    assert cost(order[:count], 8.0) == pytest.approx(share + 8 / 2, rel=1e-2)


def test_an_error_that_strains_weighs_more(free_flight):
    """One that all points share strains nothing; one that grows with x does, and hardly any more
    when the same values are dealt out at random."""
    net, batch = ballistic(free_flight)
    history, move = batch.history, batch.moves[:, 0]
    scale = DT**2 * net.acceleration_std
    x = history[:, -1, 0]
    values = (x - x.mean()) / x.std(correction=0)

    def cost(values, weight):
        error = torch.zeros_like(move)
        error[:, 0] = values
        after = history[:, -1] + move + error * scale
        return float(step_error(net, history, after, move, Emphasis(strain_weight=weight)))

    plain = 1 / move.shape[1]
    assert cost(values, 0.0) == pytest.approx(plain, rel=1e-2)
    assert cost(torch.ones_like(values), 8.0) == pytest.approx(plain, rel=1e-2)
    assert cost(values, 8.0) > 8.9 * plain
    shuffled = values[torch.randperm(len(values), generator=torch.Generator().manual_seed(0))]
    assert cost(shuffled, 8.0) < 2 * plain


def test_neighbours_that_close_in_weigh_more(free_flight):
    """Cells that shrink, each about its middle, in a scene that keeps its size as a whole."""
    net, batch = ballistic(free_flight)
    side = torch.arange(4 * CELL) + 0.5
    place = torch.cartesian_prod(side, side, side)
    off = place.remainder(CELL) - CELL / 2
    history = (SPACING * place)[:, None].repeat(1, batch.history.shape[1], 1)
    still = torch.zeros_like(place)

    def cost(error, weight):
        after = history[:, -1] + error / error.square().mean().sqrt() * DT**2 * net.acceleration_std
        return float(step_error(net, history, after, still, Emphasis(strain_weight=weight)))

    assert cost(-off, 0.0) == pytest.approx(1, rel=1e-3)
    # A sixteenth of it is seen as a strain of the whole scene: cells are a quarter of its width.
    assert cost(-off, 8.0) == pytest.approx(1 + 8 * (1 + 1 / 16), rel=0.02)
    assert cost(off.roll(1, 1), 8.0) == pytest.approx(1 + 8 / 16, rel=0.05)  # a shear: nothing else


def test_a_small_scene_can_count_as_much_as_a_large_one(free_flight):
    net, batch = ballistic(free_flight)
    count = len(batch.history)
    scene = (torch.arange(count) >= count // 4).long()
    error = torch.where(scene == 0, 1.0, 0.0)
    after = batch.history[:, -1] + batch.moves[:, 0]
    after = after + error[:, None] * DT**2 * net.acceleration_std

    def cost(batch_of=None, **emphasis):
        move, weighing = batch.moves[:, 0], Emphasis(**emphasis)
        return float(step_error(net, batch.history, after, move, weighing, batch=batch_of))

    share = count // 4 / count
    assert cost(scene) == pytest.approx(share, rel=1e-2)
    assert cost(scene, scenes_alike=True) == pytest.approx(1 / 2, rel=1e-2)
    assert cost(scenes_alike=True) == pytest.approx(share, rel=1e-2)


def test_errors_count_relative_to_what_accelerates_the_scene(free_flight):
    """Two scenes with the same error: nothing happens in one, and the other has been braking at 3
    deviations and goes on; with q = 4 they count (1/4)² and (1/5)²."""
    net, batch = ballistic(free_flight)
    places = batch.history.double()
    count, steps = places.shape[:2]
    scene = (torch.arange(count) >= count // 2).long()
    unit = (DT**2 * net.acceleration_std).double()
    time = torch.arange(steps, dtype=torch.float64)[None, :, None]
    fall = -1.5 * time**2 * unit * scene[:, None, None]
    history = places[:, :1] + time * unit + fall
    move = history[:, -1] - history[:, -2] - 3.0 * unit * scene[:, None]

    def cost(error, **emphasis):
        after, weighing = history[:, -1] + move + error * unit, Emphasis(**emphasis)
        return float(step_error(net, history, after, move, weighing, batch=scene)) / error**2

    assert cost(1.0) == pytest.approx(1.0, rel=1e-2)
    expected = (1 / 16 + 1 / 25) / 2
    assert cost(0.01, relative_to=4.0, scenes_alike=True) == pytest.approx(expected, rel=1e-2)
    alone = cost(0.01, relative_to=4.0, scenes_alike=True, momentum_weight=1.0)
    assert alone == pytest.approx(2 * expected, rel=1e-2)


def test_what_no_state_foretells_leaves_the_motion_as_it_is(free_flight):
    """Scenes that brake at 1 deviation on average, some harder, some less, by chance or because
    they have drifted ahead or behind: what costs least is to brake at 1. Weighed by what is asked,
    those that hardly brake count for more than those that brake hard, and 0.2 would cost less."""
    net, batch = ballistic(free_flight)
    history = batch.history[:1].expand_as(batch.history)
    now, before = history[:, -1], history[:, -2]
    scene = torch.arange(len(now))
    unit = DT**2 * net.acceleration_std
    chance = torch.linspace(-1.5, 1.5, len(now))[:, None] * unit
    move = now - before - unit + chance

    def settles(back):
        """Where the gradient leads: the braking at which it changes sign."""

        def slope(braking):
            given = torch.tensor(braking, requires_grad=True)
            after, weighing = now + (now - before) - given * unit, Emphasis(relative_to=0.3)
            step_error(net, history, after, move, weighing, batch=scene, back=back).backward()
            return float(given.grad)

        return brentq(slope, -0.5, 3.0)

    assert settles(chance) == pytest.approx(1.0, abs=0.05)
    assert settles(None) == pytest.approx(1.0, abs=0.05)


def test_noise_of_the_history_does_not_weigh_its_scene(free_flight):
    """Scenes that brake at 1, whose histories say otherwise by noise of which the model repeats
    half: what costs least is to brake at 1 beside. Were the noise a part of what a scene counts by,
    those whose noise cancels the braking would count most, and to brake harder would cost less."""
    net, batch = ballistic(free_flight)
    scene = torch.arange(len(batch.history))
    unit = DT**2 * net.acceleration_std
    back = torch.arange(batch.history.shape[1] - 1, -1, -1.0)
    triangle = (back * (back - 1) / 2)[None, :, None] * unit
    still = batch.history[:, -1:].expand_as(batch.history)
    noise = torch.linspace(-1.5, 1.5, len(scene))[:, None]
    shared = noise[..., None] * triangle
    history = still - triangle + shared
    last = history[:, -1] - history[:, -2]

    def settles(shared):
        def slope(braking):
            given = torch.tensor(braking, requires_grad=True)
            after = history[:, -1] + last + (0.5 * noise - given) * unit
            move = last - unit
            weighing = Emphasis(relative_to=0.3)
            step_error(net, history, after, move, weighing, batch=scene, shared=shared).backward()
            return float(given.grad)

        return brentq(slope, -0.5, 3.0)

    # What the model repeats in the step that it gives still counts, as one of several steps.
    assert settles(shared) == pytest.approx(1.0, abs=0.12)
    assert settles(None) > 1.3


@pytest.mark.parametrize("steps", [1, 2, 3])
@pytest.mark.parametrize("backprop", [False, True])
def test_noise_that_neighbours_share_is_known_and_leaves_the_target(free_flight, steps, backprop):
    """A model that knows gravity and looks at no history loses nothing by it, in any step."""
    net, _ = ballistic(free_flight)
    windows = [index(free_flight, 3).read(0, frame) for frame in (2, 3, 4)]
    plain, noisy = (
        collate(
            windows,
            noise_std=0.0,
            rng=np.random.default_rng(0),
            device=torch.device("cpu"),
            spacing=SPACING,
            acceleration_noise=share,
        )
        for share in (0.0, 0.5)
    )
    assert plain.shared is None
    assert noisy.shared.abs().max() > 0.1 * DT**2 * 9.81
    torch.testing.assert_close(noisy.history - noisy.shared, plain.history, rtol=0, atol=1e-7)
    with torch.no_grad():
        loss = unrolled_loss(net, noisy, Emphasis(relative_to=0.3), steps=steps, backprop=backprop)
        assert float(loss) < 1e-4


def test_a_drift_is_asked_back(free_flight):
    """Falling too fast by c: the displacement of the third step is off by 3 c dt², after a drift of
    (1 + 2) c dt². To lose 1/R of that drift, the error to mend is 3 c dt² (1 + 1/R)."""
    net, batch = ballistic(free_flight)
    with torch.no_grad():
        net.acceleration_mean[1] = -1.0
        plain = float(unrolled_loss(net, batch, steps=3))
        assert plain == pytest.approx(3.0**2 / 3, rel=0.02)  # one axis of three
        for steps_back in (1.0, 5.0):
            found = float(unrolled_loss(net, batch, steps=3, return_steps=steps_back))
            assert found == pytest.approx(plain * (1 + 1 / steps_back) ** 2, rel=0.02)
        # A first step has drifted nowhere.
        assert float(unrolled_loss(net, batch, steps=1, return_steps=2.0)) == pytest.approx(
            float(unrolled_loss(net, batch, steps=1))
        )


def test_every_point_is_asked_back_by_itself(free_flight):
    """Half of the points drift up by d and half of them down: the scene as a whole drifts nowhere,
    and each point is still asked to make up for d / R in its next step."""
    net, batch = ballistic(free_flight)
    drift, steps_back = 1e-3, 4.0
    signs = torch.where(torch.arange(len(batch.moves)) % 2 == 0, 1.0, -1.0)
    moves = batch.moves.clone()
    moves[:, 0, 1] -= signs * drift
    apart = replace(batch, moves=moves)
    with torch.no_grad():
        assert float(unrolled_loss(net, apart, steps=2)) < 1e-3
        found = float(unrolled_loss(net, apart, steps=2, return_steps=steps_back))
        scale = net.config.dt**2 * float(net.acceleration_std[1])
    assert found == pytest.approx((drift / steps_back / scale) ** 2 / 3, rel=0.02)


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

"""The loss of a step: the target behind the noise, and what its errors weigh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from gns_model.data.windows import WindowIndex
from gns_model.learned.config import ModelConfig
from gns_model.learned.model import LearnedModel
from gns_model.training.batches import collate
from gns_model.training.loss import CELL, FRONT, TIP, Emphasis, step_error, unrolled_loss
from gns_model.training.statistics import measure

SPACING, DT = 0.0625, 0.02


def index(folder, unroll=2):
    return WindowIndex([folder], spacing=SPACING, dt=DT, history=3, unroll=unroll)


def model(**changes) -> LearnedModel:
    torch.manual_seed(0)
    config = ModelConfig(spacing=SPACING, dt=DT, radius=0.1, latent=8, blocks=2, **changes)
    return LearnedModel(config)


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
    measure(windows, windows=64, radius=0.1, noise_std=0.0, subtract_gravity=True).apply(net)
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


@pytest.mark.parametrize(("name", "part"), [("front_weight", FRONT), ("tip_weight", TIP)])
def test_an_error_of_the_front_weighs_more(name, part, free_flight):
    """The same error in as many points: at the front of one of two scenes, and anywhere in it."""
    net, batch = ballistic(free_flight)
    history, move = batch.history.clone(), batch.moves[:, 0]
    history[..., 0] += 1e-4 * torch.arange(len(history))[:, None]  # no two at one place
    scene = torch.arange(len(history)) % 2
    scale = DT**2 * net.acceleration_std
    place = history[:, -1, 0].where(scene == 0, -1.0)
    count = 1 + int(part * int((scene == 0).sum()))
    order = place.argsort(descending=True)

    def cost(rows, weight):
        emphasis = Emphasis(**{name: weight})
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


def test_noise_that_neighbours_share_needs_to_know_how_near_they_are(free_flight):
    window = index(free_flight).read(0, 2)
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="spacing"):
        collate(
            [window], noise_std=0.0, rng=rng, device=torch.device("cpu"), acceleration_noise=0.5
        )

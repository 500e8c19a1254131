"""Training through whole flows: what their error sees, its gradient, and who rolls which."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch

from gns_model.data.windows import WindowIndex
from gns_model.learned.config import ModelConfig
from gns_model.learned.model import LearnedModel
from gns_model.training import Recipe, batches, flow_errors, flows, train
from gns_model.training.flow_errors import crowding_error, depth_error, mass_error
from gns_model.training.flows import (
    agreement,
    draw_flows,
    flow_error,
    flow_gradient,
)
from gns_model.training.statistics import measure

SPACING, DT, RADIUS = 0.0625, 0.02, 0.1
CPU = torch.device("cpu")


def index(folder, **changes):
    options = {"spacing": SPACING, "dt": DT, "history": 3, "unroll": 1}
    return WindowIndex([folder], **{**options, **changes})


def statistics(windows):
    return measure(windows, windows=64, radius=RADIUS, noise_std=0.0, subtract_gravity=True)


def model(ballistic: bool = False, **changes) -> LearnedModel:
    """Random weights; or one that predicts a = g."""
    torch.manual_seed(0)
    options = {"spacing": SPACING, "dt": DT, "radius": RADIUS, "latent": 8, "blocks": 2}
    net = LearnedModel(ModelConfig(**{**options, **changes}))
    if ballistic:
        with torch.no_grad():
            for p in net.network.decode.parameters():
                p.zero_()
    return net


@pytest.fixture
def window(slides):
    """Eight steps of a slide in float64; no two of its grains have a coordinate in common."""
    found = index(slides).read(0, 0, mixture=1, unroll=8)
    apart = np.random.default_rng(0).uniform(-0.01, 0.01, (len(found.history), 1, 3))
    return replace(found, history=found.history + apart, future=found.future + apart)


# -- the error of a flow ---------------------------------------------------------------------------


def test_a_model_that_knows_the_law_has_no_error(free_flight):
    """From the second step on, whose history knows gravity; and less of it is an error."""
    windows = index(free_flight, spacing=SPACING, dt=0.01)
    window = windows.read(0, 2, unroll=6)
    net = model(ballistic=True, dt=0.01)
    with torch.no_grad():
        assert float(flow_error(net, window, CPU)) < 1e-4
        net.acceleration_mean[1] = 5.0
        assert float(flow_error(net, window, CPU)) > 0.01


def test_grains_that_trade_places_cost_nothing(window):
    """The truth with its grains in another order is the same heap."""
    net, rng = model().double(), np.random.default_rng(0)
    other = replace(window, future=window.future[rng.permutation(len(window.future))])
    with torch.no_grad():
        found, same = (float(flow_error(net, w, CPU)) for w in (window, other))
        moved = replace(window, future=window.future + 0.05)
        assert float(flow_error(net, moved, CPU)) > 1.2 * found
    assert same == pytest.approx(found, rel=1e-4)


def rolled_by(monkeypatch, shift):
    """Let `roll` return the truth, moved by `shift(positions (N, K, D))`."""

    def roll(model, batch, steps):
        true = batch.history[:, -1:] + batch.moves.cumsum(1)
        return true + shift(true)

    monkeypatch.setattr(flows, "roll", roll)


def test_a_front_that_lags_is_seen_by_itself(window, monkeypatch):
    """As many grains off by as much: at the front, and in the middle of the heap. Their way is
    that of the front from the start to the end of the window."""
    last = window.future[:, -1, 0]
    count = max(1, int(flow_errors.FRONT * len(last)))
    order = torch.from_numpy(np.argsort(last))
    lag = 1e-6  # they keep their order

    def error(rows):
        def shift(true):
            out = torch.zeros_like(true)
            out[rows, :, 0] = -lag
            return out

        rolled_by(monkeypatch, shift)
        return float(flow_error(model(), window, CPU))

    front, middle = error(order[-count:]), error(order[len(order) // 2 :][:count])
    assert front > 5 * middle
    way = np.sort(last)[-count:].mean() - np.sort(window.history[:, -1, 0])[-count:].mean()
    travel = np.sort(window.future[:, -1], axis=0) - np.sort(window.history[:, -1], axis=0)
    way = max(way, np.sqrt(np.square(travel).sum(1).mean()), 2 * SPACING)
    weight = (flow_errors.BODY_AIM / flow_errors.FRONT_AIM) ** 2
    square = lag**2 * (weight + count / len(last)) / way**2
    expected = np.sqrt(square + flows.RIGHT**2) - flows.RIGHT
    assert front == pytest.approx(expected, rel=0.05)


def test_the_depth_upstream_of_a_baffle_counts(window, monkeypatch):
    """A heap that is higher just upstream of a baffle, and one that is so elsewhere."""
    scene = window.scene
    x, z = (float(np.median(window.future[:, -1, k])) for k in (0, 2))
    size = scene.baffles[0].size

    def error(place):
        [baffle] = scene.baffles
        moved = scene.replace(baffles=(baffle.model_copy(update={"center": place}),))
        rolled_by(monkeypatch, lambda true: 0.02 * torch.tensor([0.0, 1.0, 0.0]))
        return float(flow_error(model(), replace(window, scene=moved), CPU))

    assert error((x + 0.05 + size[0] / 2, z)) > 1.02 * error((0.7, 0.75))


def test_a_heap_that_never_slumps_again_is_an_error(window):
    """It has the same peak. And one that is as much too low counts as much."""
    scene = window.scene
    [baffle] = scene.baffles
    face = baffle.center[0] - baffle.size[0] / 2
    rng = np.random.default_rng(0)
    x = rng.uniform(face - 0.05, face, 2000)
    z = rng.uniform(-0.5, 0.5, 2000) * baffle.size[2] + baffle.center[1]
    height = 0.2 * rng.uniform(0, 1, 2000)

    def heap(*depths):
        """Frames (N, K, 3) with these depths as shares of the first."""
        frames = [np.stack([x, scene.base + share * height, z], 1) for share in depths]
        return torch.from_numpy(np.stack(frames, 1))

    slumps = heap(1.0, 0.75, 0.5)
    error = depth_error(heap(1.0, 1.0, 1.0), slumps, scene, SPACING)
    expected = np.array([0, 0.25, 0.5]) * flow_errors.BODY_AIM / flow_errors.DEPTH_AIM
    # The top of a point is half a spacing above it, the same in both.
    assert error.sqrt().numpy() == pytest.approx(expected, rel=0.1, abs=1e-9)
    assert float(depth_error(slumps, slumps, scene, SPACING).max()) == 0
    low = depth_error(heap(1.0, 0.5, 0.0), slumps, scene, SPACING)[1]
    assert float(low) == pytest.approx(float(error[1]), rel=0.05)


def test_a_shift_of_the_whole_mass_costs_more_than_as_wide_a_scatter():
    """The same squares of the coordinates, in one direction or in both."""
    rng = np.random.default_rng(0)
    begun = torch.from_numpy(rng.uniform(0, 1, (400, 3)))
    true = (begun + torch.tensor([0.5, 0, 0]))[:, None]
    order = true[:, 0, 0].argsort().argsort()
    push = torch.zeros_like(true)
    push[..., 0] = 1e-7
    scatter = push * torch.where(order % 2 == 0, 1.0, -1.0)[:, None, None]
    shifted, scattered = (
        float(mass_error(true + p, true, begun, SPACING).sqrt()) for p in (push, scatter)
    )
    # Of the shift: body, front and centroid, whose way is that of all.
    squares = [
        1,
        (flow_errors.BODY_AIM / flow_errors.FRONT_AIM) ** 2,
        (flow_errors.BODY_AIM / flow_errors.CENTROID_AIM) ** 2,
    ]
    assert shifted == pytest.approx(1e-7 / 0.5 * np.sqrt(sum(squares)), rel=1e-3)
    assert scattered == pytest.approx(1e-7 / 0.5, rel=0.05)


def test_grains_that_sink_into_each_other_are_seen():
    """A lattice, and the same lattice with every grain moved onto its neighbour: nearly the same
    coordinates, twice the density. Points in one place have a finite gradient."""
    grid = torch.stack(
        torch.meshgrid(*[torch.arange(8.0, dtype=torch.float64)] * 3, indexing="ij"), -1
    )
    true = grid.reshape(-1, 1, 3)
    paired = true.clone()
    paired[..., 1] = 2 * torch.floor(paired[..., 1] / 2) + 0.5
    paired.requires_grad_()
    scale, radius = flow_errors.BODY_AIM / flow_errors.CROWDING_AIM, 1.2
    error = crowding_error(paired, true, radius)
    # Each has one neighbour at distance 0; nobody had any nearer than 1, and 6 of those at most.
    least = 1 - 6 * (1 - 1 / radius) ** 2
    assert float(error.detach()) > (scale * least / 0.25) ** 2
    [gradient] = torch.autograd.grad(error, paired)
    assert gradient.isfinite().all()
    assert float(crowding_error(true, true, radius)) == 0


def test_what_is_too_crowded_is_pushed_apart():
    """Down the gradient the error falls."""
    rng = np.random.default_rng(0)
    true = torch.from_numpy(rng.uniform(0, 1, (300, 2, 3)))
    tight = (0.8 * true).requires_grad_()
    error = crowding_error(tight, true, 0.2)
    [gradient] = torch.autograd.grad(error, tight)
    step = tight.detach() - 1e-3 * gradient / gradient.norm() * len(true) ** 0.5
    assert float(crowding_error(step, true, 0.2)) < 0.99 * float(error.detach())


def test_its_gradient_is_that_of_differences(window, monkeypatch):
    """In float64 with nothing limited or shared, over eight steps; the limits are another test."""
    monkeypatch.setattr(flows, "LIMIT", None)
    monkeypatch.setattr(flows, "SMOOTHING", 0.0)
    net = model().double()
    weights = (
        [net.network.decode[-1].bias]
        if hasattr(net.network.decode, "__getitem__")
        else [list(net.network.decode.parameters())[-1]]
    )
    [found] = torch.autograd.grad(flow_error(net, window, CPU), weights)
    [weight] = weights
    step = 1e-6
    for axis in (0, 1):
        values = []
        for sign in (1, -1):
            with torch.no_grad():
                weight[axis] += sign * step
                values.append(float(flow_error(net, window, CPU)))
                weight[axis] -= sign * step
        expected = (values[0] - values[1]) / (2 * step)
        assert float(found[axis]) == pytest.approx(expected, rel=1e-3)


def test_a_step_down_the_gradient_makes_flows_better(slides):
    windows, net = index(slides), model()
    statistics(windows).apply(net)
    some = [windows.read(k, 0, mixture=k, unroll=9) for k in (0, 1)]
    parameters = list(net.parameters())

    def descend():
        return flow_gradient(
            net, some, parameters, clip_norm=1.0, context=nullcontext(), device=CPU
        )

    first = float(descend())
    for _ in range(20):
        with torch.no_grad():
            for p in parameters:
                p -= 0.5 * p.grad
        last = float(descend())
    assert last < 0.9 * first


def test_agreement_helps_the_flow_that_the_mean_makes_worse(monkeypatch):
    """Three say "farther" along one axis and one the contrary; each has a little of its own."""
    rng = np.random.default_rng(0)
    gradients = torch.zeros(4, 50, dtype=torch.float64)
    gradients[:, 0] = torch.tensor([1.0, 1.0, 1.0, -1.0])
    gradients[:, 1:] = 0.1 * torch.from_numpy(rng.normal(size=(4, 49)))
    scales = torch.tensor([1.0, 30.0, 0.1, 5.0], dtype=torch.float64)
    unit = gradients / gradients.norm(dim=1, keepdim=True)
    mean = unit.mean(0) / unit.mean(0).norm()

    def worst():
        """What a step does for the flow that it helps least."""
        direction = agreement(gradients * scales[:, None], torch.ones(4))
        assert float(direction.norm()) == pytest.approx(1)
        return float((unit @ direction).min())

    assert float((unit @ mean).min()) < 0
    assert worst() > float((unit @ mean).min()) + 0.1
    monkeypatch.setattr(flows, "RIDGE", 0.01)
    assert worst() > 0.1


def test_agreement_asks_more_where_the_error_is_larger():
    rng = np.random.default_rng(0)
    gradients = torch.from_numpy(rng.normal(size=(3, 1000)))  # nearly orthogonal
    direction = agreement(gradients, torch.tensor([1.0, 2.0, 4.0]))
    parts = (gradients / gradients.norm(dim=1, keepdim=True)) @ direction
    assert (parts / parts[0]).numpy() == pytest.approx([1, 2, 4], rel=0.2)


def test_agreement_of_one_is_its_gradient_and_nothing_finite_comes_of_what_is_not():
    one = torch.tensor([[3.0, 4.0]])
    assert agreement(one, torch.tensor([0.2]))[0].item() == pytest.approx(0.6)
    broken = torch.tensor([[3.0, 4.0], [1.0, float("nan")]])
    assert not agreement(broken, torch.ones(2)).isfinite().all()


def test_no_flow_has_more_than_its_vote(slides):
    windows, net = index(slides), model()
    some = [windows.read(k, 0, mixture=k, unroll=9) for k in (0, 1)]
    parameters = list(net.parameters())

    def length(clip_norm):
        flow_gradient(net, some, parameters, clip_norm=clip_norm, context=nullcontext(), device=CPU)
        return float(torch.cat([p.grad.flatten() for p in parameters]).norm())

    free = length(1e9)
    assert length(1e-3 * free) <= 1.0001e-3 * free


# -- who rolls what --------------------------------------------------------------------------------


def test_every_rank_gets_flows_of_about_as_many_edges(slides, tiny):
    windows = index(slides)
    about = statistics(windows)
    recipe = Recipe.from_dict({**tiny, "flow_steps": 7, "flow_edges": 40_000, "mirror": True})

    def parts(step):
        rng = batches.generator(0, batches.FLOWS, step)
        return draw_flows(windows, rng, recipe, about, ranks=3)

    assert parts(3) == parts(3)
    assert parts(3) != parts(4)
    found = [[sum(f.edges for f in part) for part in parts(k)] for k in range(20)]
    assert np.mean(found) == pytest.approx(40_000, rel=0.2)
    every = [f for k in range(20) for part in parts(k) for f in part]
    assert all(1 <= f.steps <= 7 for f in every)
    assert 0.4 < np.mean([f.draw.frame == 0 for f in every]) < 0.9
    assert {f.draw.mirror for f in every} == {True, False}
    for flow in every[:10]:  # none is asked for frames that its file does not have
        assert batches.read(windows, flow.draw, unroll=flow.steps).future.shape[1] == flow.steps


def test_a_flow_that_is_too_dear_is_cut_short(slides, tiny):
    windows = index(slides)
    recipe = Recipe.from_dict({**tiny, "flow_steps": 9, "flow_edges": 3000})
    rng = np.random.default_rng(0)
    parts = draw_flows(windows, rng, recipe, statistics(windows), ranks=2)
    assert [len(part) for part in parts] == [1, 1]
    assert all(f.steps < 9 and f.edges <= 3000 for part in parts for f in part)


# -- in a run --------------------------------------------------------------------------------------


def test_flow_steps_are_what_the_recipe_asks_for(tiny, tmp_path, monkeypatch):
    """None where the share is 0; in the unrolled phase only where it is 1."""
    seen = []

    def counted(*args, **options):
        seen.append(1)
        return flow_gradient(*args, **options)

    monkeypatch.setattr("gns_model.training.loop.flow_gradient", counted)
    values = {**tiny, "valid": [], "steps": 6, "flow_steps": 2, "flow_edges": 2000}
    train(Recipe.from_dict(values), tmp_path / "none")
    assert not seen
    train(Recipe.from_dict({**values, "flow_share": 1.0}), tmp_path / "half")
    assert len(seen) == 3

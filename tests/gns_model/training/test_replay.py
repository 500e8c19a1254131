"""Flows that the model keeps rolling: what is asked of them, how they go on, what a file keeps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gns_model.data.windows import Window
from gns_model.learned.model import LearnedModel
from gns_model.training import Recipe, RecipeError
from gns_model.training import replay as replay_module
from gns_model.training.distributed import session
from gns_model.training.loss import step_error
from gns_model.training.replay import Replay, wish
from gns_model.training.setup import open_data
from gns_model.training.statistics import measure

from .conftest import cube_scene, fly, trajectory


def straight(frames: int, speed: float = 0.01) -> np.ndarray:
    """Places of one point that moves evenly [m], shape (1, frames, 3)."""
    return (np.arange(frames)[None, :, None] * np.array([speed, 0.0, 0.0])).astype(np.float32)


@given(st.floats(-0.05, 0.05), st.floats(-0.01, 0.01), st.floats(3.0, 12.0))
def test_a_point_that_gets_its_wish_comes_back_and_hardly_overshoots(offset, drift, back):
    """Off by `offset` and leaving at `drift` a step: critically damped, it is back in a few
    `return_steps`; and a point on its true path is asked for nothing but that path."""
    frames = round(10 * back) + 6
    truth = straight(frames)
    own = list((truth[:, :4] + offset + drift * np.arange(-3, 1)[None, :, None]).swapaxes(0, 1))
    errors = []
    for frame in range(3, frames - 1):
        window = Window(truth[:, frame - 3 : frame + 1], truth[:, frame + 1 :][:, :1], cube_scene())
        move, _ = wish(np.stack(own[-4:], axis=1), window, back)
        own.append(own[-1] + move)
        errors.append(float((own[-1] - truth[:, frame + 1]).max()))
    largest = abs(offset) + back * abs(drift)
    assert max(map(abs, errors)) <= 1.5 * largest + 1e-6
    assert abs(errors[-1]) <= 0.01 * largest + 1e-5
    window = Window(truth[:, :4], truth[:, 4:5], cube_scene())
    move, part = wish(truth[:, :4], window, back)
    np.testing.assert_allclose(move, truth[:, 4] - truth[:, 3], atol=1e-7)
    np.testing.assert_allclose(part, 0.0, atol=1e-7)


@pytest.fixture(scope="module")
def flight(free_scene, tmp_path_factory):
    """A recipe on points that fly where nothing pulls them, and a model that knows that law."""
    folder = tmp_path_factory.mktemp("weightless")
    weightless = free_scene.replace(gravity=(0.0, 0.0, 0.0))
    trajectory(weightless, fly, 11).save(folder / "flight.h5")
    recipe = Recipe.from_dict(
        {
            "train": [str(folder)],
            "steps": 5,
            "edges_per_batch": 5000,
            "replay": 3,
            "replay_steps": 3,
            "return_steps": 5,
            "mirror": False,
            "model": {
                "spacing": 0.0625, "dt": 0.01, "radius": 0.1, "latent": 8, "blocks": 2,
                "noise_std": 0.0,
            },
        }
    )  # fmt: skip
    data = open_data(recipe, recipe.train)
    statistics = measure(data, windows=16, radius=0.1, noise_std=0.0, subtract_gravity=True, seed=0)
    net = LearnedModel(recipe.model)
    with torch.no_grad():
        for p in net.network.decode.parameters():
            p.zero_()
    return recipe, data, statistics, net


def started(flight) -> Replay:
    recipe, data, statistics, _ = flight
    with session("cpu") as ranks:
        return Replay(data, recipe, statistics, ranks)


def advance(replay: Replay, net: LearnedModel, step: int) -> float:
    batch, _ = replay.take(step)
    with torch.no_grad():
        after = net.step(batch.history, batch.world)
        loss = step_error(net, batch.history, after, batch.moves[:, 0], batch=batch.world.batch)
    replay.advanced(after)
    return float(loss)


def test_a_perfect_model_keeps_its_flows_on_the_truth(flight):
    replay, net = started(flight), flight[3]
    ages = set()
    for step in range(12):
        assert advance(replay, net, step) < 1e-4
        replay.keep()
        ages |= {f.left for f in replay.flows if f.history is not None}
    assert len(replay.flows) == 3
    assert replay.drawn > 6, "flows end after three steps at most, and others begin"
    assert ages == {1, 2}


def test_a_step_that_is_abandoned_leaves_no_trace(flight):
    replay, net = started(flight), flight[3]
    advance(replay, net, 0)
    replay.keep()
    first, _ = replay.take(1)
    advance(replay, net, 1)  # and not kept
    again, _ = replay.take(1)
    torch.testing.assert_close(again.history, first.history, rtol=0, atol=0)
    torch.testing.assert_close(again.moves, first.moves, rtol=0, atol=0)


def test_a_flow_that_goes_astray_is_let_go(flight):
    replay, net = started(flight), flight[3]
    batch, _ = replay.take(0)
    before = replay.drawn
    replay.advanced(batch.history[:, -1] + float("nan"))
    replay.keep()
    assert replay.drawn > before
    assert all(f.history is None for f in replay.flows)
    assert np.isfinite(advance(replay, net, 1))


def test_a_file_keeps_the_flows_of_its_step_only(flight, tmp_path):
    replay, net = started(flight), flight[3]
    for step in range(3):
        advance(replay, net, step)
        replay.keep()
    replay.save(tmp_path, 3)

    def restored(step: int) -> Replay:
        other = started(flight)
        other.restore(tmp_path, step)
        return other

    same = restored(3)
    assert same.drawn == replay.drawn
    assert [dataclasses.astuple(f.draw) for f in same.flows] == [
        dataclasses.astuple(f.draw) for f in replay.flows
    ]
    torch.testing.assert_close(same.take(3)[0].history, replay.take(3)[0].history, rtol=0, atol=0)
    # Another step, half a file, no file: new flows, and no error.
    assert restored(2).flows == []
    whole = (tmp_path / "replay-0.safetensors").read_bytes()
    (tmp_path / "replay-0.safetensors").write_bytes(whole[: len(whole) // 2])
    assert restored(3).flows == []
    (tmp_path / "replay-0.safetensors").unlink()
    assert restored(3).flows == []


def remembering(flight, room: int) -> Replay:
    recipe, data, statistics, _ = flight
    with session("cpu") as ranks:
        recipe = recipe.model_copy(update={"replay_memory": room})
        return Replay(data, recipe, statistics, ranks)


def test_states_are_remembered_until_others_take_their_place(flight):
    replay, net = remembering(flight, 4), flight[3]
    assert replay.recall(0) is None
    seen = []
    for step in range(8):
        advance(replay, net, step)
        assert len(replay.memories) == min(4, replay.remembered), "nothing before it is kept"
        replay.keep()
        seen += [m for m in replay.memories if not any(m is other for other in seen)]
    assert replay.remembered > 8
    assert len(replay.memories) == 4
    assert len(seen) > 4
    batch, edges = replay.recall(8)
    assert edges > 0
    # A perfect model's states are the truth, which asks them for no way back.
    after = net.step(batch.history, batch.world)
    loss = step_error(net, batch.history, after, batch.moves[:, 0], batch=batch.world.batch)
    assert float(loss) < 1e-4
    torch.testing.assert_close(batch.back, torch.zeros_like(batch.back), rtol=0, atol=1e-6)


def test_a_file_keeps_what_is_remembered(flight, tmp_path):
    replay, net = remembering(flight, 4), flight[3]
    for step in range(5):
        advance(replay, net, step)
        replay.keep()
    replay.save(tmp_path, 5)
    same, smaller = remembering(flight, 4), remembering(flight, 2)
    for other in (same, smaller):
        other.restore(tmp_path, 5)
    assert len(smaller.memories) == 2
    for step in range(5, 8):  # and both go on alike
        a, b = replay.recall(step)[0], same.recall(step)[0]
        torch.testing.assert_close(a.history, b.history, rtol=0, atol=0)
        torch.testing.assert_close(a.moves, b.moves, rtol=0, atol=0)
        for one in (replay, same):
            advance(one, net, step)
            one.keep()


def test_a_recipe_with_fewer_flows_goes_on_with_the_first_of_them(flight, tmp_path):
    replay, net = started(flight), flight[3]
    advance(replay, net, 0)
    replay.keep()
    replay.save(tmp_path, 1)
    recipe, data, statistics, _ = flight
    with session("cpu") as ranks:
        other = Replay(data, recipe.model_copy(update={"replay": 2}), statistics, ranks)
    other.restore(tmp_path, 1)
    assert [f.draw for f in other.flows] == [f.draw for f in replay.flows[:2]]


def test_replay_needs_a_way_back(tiny):
    with pytest.raises(RecipeError, match="return_steps"):
        Recipe.from_dict({**tiny, "replay": 4})


def test_flows_of_other_data_begin_again(flight, free_scene, tmp_path):
    """Their numbers may fit, and even their points: the flow that a number means is another."""
    replay, net = remembering(flight, 4), flight[3]
    for step in range(3):
        advance(replay, net, step)
        replay.keep()
    replay.save(tmp_path, 3)
    recipe, _, statistics, _ = flight

    def restored(gravity: float) -> Replay:
        folder = tmp_path / f"{gravity:.0f}"
        scene = free_scene.replace(gravity=(0.0, gravity, 0.0))
        trajectory(scene, fly, 11).save(folder / "flight.h5")
        with session("cpu") as ranks:
            wished = recipe.model_copy(update={"replay_memory": 4})
            other = Replay(open_data(recipe, [str(folder)]), wished, statistics, ranks)
        other.restore(tmp_path, 3)
        return other

    moved, changed = restored(0.0), restored(-9.81)
    assert len(moved.flows) == len(replay.flows), "where files are kept is no matter"
    assert len(moved.memories) == len(replay.memories) > 0
    assert (changed.flows, changed.memories) == ([], [])
    assert np.isfinite(advance(changed, net, 3))


def test_grains_that_trade_places_are_asked_nothing_if_the_recipe_says_so(flight, tmp_path):
    """All grains of a flow swapped in pairs: with `replay_exchange` they stand for each other from
    the next pairing on, and a file keeps that."""
    recipe, data, statistics, net = flight
    found = {}
    for exchange in (False, True):
        wanted = recipe.model_copy(
            update={"replay_exchange": exchange, "replay": 1, "replay_memory": 4}
        )
        with session("cpu") as ranks:
            replay, other = (Replay(data, wanted, statistics, ranks) for _ in range(2))
        replay.take(0)
        first = dataclasses.replace(replay.flows[0].draw, frame=0)
        replay.flows[0] = replay_module.Rolling(first, replay_module.EXCHANGE)
        batch, _ = replay.take(0)
        traded = np.random.default_rng(0).permutation(len(batch.history))
        moved = batch.history[torch.from_numpy(traded)]
        replay.flows[0].history = moved.numpy()
        replay.advanced(net.step(moved, batch.world))
        replay.keep()
        replay.save(tmp_path, 1)
        other.restore(tmp_path, 1)
        for one in (replay, other):
            back = one.take(1)[0].back
            found[exchange] = float(back.abs().max())
            assert found[exchange] == pytest.approx(float(one.recall(1)[0].back.abs().max()))
    assert found[True] < 1e-6
    assert found[False] > 1e-3

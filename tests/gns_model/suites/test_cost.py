from __future__ import annotations

import csv
import json
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from gns_model.learned import LearnedModel, ModelConfig
from gns_model.learned.graph import radius_graph
from gns_model.mpm import MpmSimulator
from gns_model.particles import fill
from gns_model.suites import speed, training
from gns_model.suites.block import block_scene
from gns_model.suites.cost import Cost, Meter, clock, peak_memory, ratio
from gns_model.suites.plain import plain
from gns_model.suites.setup import Setup


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("points", [120, 1_000, 6_900])
def test_a_block_has_about_the_points_asked_for(dim: int, points: int):
    scene = block_scene(dim, points, 0.01)
    assert len(fill(scene, 0.01).positions) == pytest.approx(points, rel=0.15)
    MpmSimulator(spacing=0.01).check(scene)


@pytest.mark.parametrize("changes", [{}, {"activation": "relu", "envelope": False}])
def test_the_plain_network_computes_the_same(tiny, changes):
    simulator = tiny(latent=16, blocks=3, **changes)
    batch = training.block_batch(simulator.config, 500, "cpu")
    with torch.no_grad():
        ours = simulator.model.step(batch.history, batch.world)
        plainly = plain(simulator.model).step(batch.history, batch.world)
        moved = (ours - batch.history[:, -1]).norm(dim=1)
    assert moved.min() > 0
    torch.testing.assert_close(plainly, ours, rtol=0, atol=1e-6)


def test_the_plain_network_has_its_own_copy_of_the_weights(tiny):
    model = tiny().model
    copied = plain(model)
    count = sum(p.numel() for p in copied.parameters())
    assert count == sum(p.numel() for p in model.parameters())
    with torch.no_grad():
        next(copied.parameters()).fill_(1.0)
    assert not torch.equal(next(copied.parameters()), next(model.parameters()))


@pytest.mark.parametrize("dim", [2, 3])
def test_a_training_batch_has_the_edges_asked_for(dim):
    config = ModelConfig.paper(dim)
    batch = training.block_batch(config, 20_000, "cpu")
    senders, _ = radius_graph(batch.history[:, -1], config.radius, batch.world.batch)
    assert len(senders) == pytest.approx(20_000, rel=0.1)
    assert int(batch.world.batch.max()) == training.GRAPHS - 1


def test_peak_memory_sees_what_was_given_back():
    size = 64 * 2**20
    with peak_memory("cpu") as peak:
        np.ones(size, np.uint8).sum()
    if peak.bytes is None:
        pytest.skip("this system does not tell")
    assert 0.9 * size < peak.bytes < 1.5 * size
    with peak_memory("cpu") as quiet:
        pass
    assert quiet.bytes is not None
    assert quiet.bytes < 0.2 * size


def test_a_meter_counts_the_seconds_of_a_step():
    meter = Meter("cpu", time.perf_counter)
    cost = meter.measure(lambda count: time.sleep(0.02 * count), 1, 10.0)
    assert cost.seconds == pytest.approx(0.02, rel=0.5)


def test_a_meter_measures_the_first_size_and_stops_within_its_budget():
    calls: list[int] = []

    def run(count: int) -> None:
        calls.append(count)
        time.sleep(0.01)

    meter = Meter("cpu", time.perf_counter)
    assert meter.measure(run, 100, 0.0).seconds is not None
    before = len(calls)
    assert meter.measure(run, 100_000, 1.0) == Cost(reason="exceeds the time budget")
    assert len(calls) == before
    assert meter.measure(run, 200, 1.0).seconds is not None


def test_a_meter_stops_before_memory_is_full(monkeypatch: pytest.MonkeyPatch):
    kept: list[np.ndarray] = []

    def run(count: int) -> None:
        kept[:] = [np.ones(32 * 2**20, np.uint8)]

    def exhausted(count: int) -> None:
        raise MemoryError

    meter = Meter("cpu", time.perf_counter)
    if meter.measure(run, 1, 10.0).memory is None:
        pytest.skip("this system does not tell")
    assert meter.measure(run, 1e6, 1e9).reason == "exceeds memory"
    assert Meter("cpu", time.perf_counter).measure(exhausted, 1, 10.0).reason == "exceeds memory"


def test_one_thread_counts_cpu_seconds():
    assert clock("cpu", 1) == ("CPU", time.process_time)
    assert clock("cpu", 4) == clock("cuda", 1) == ("wall", time.perf_counter)


def test_ratio_needs_both():
    assert ratio(Cost(6.0), Cost(2.0)) == 3.0
    assert ratio(Cost(None), Cost(2.0)) is ratio(Cost(2.0), Cost(reason="left out")) is None


def test_speed_of_a_small_model(tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(speed, "SIZES", {2: (60, 120)})
    monkeypatch.setattr(speed, "PAPER", {2: {120: (5e3, 40.0, 6.0, 0.05)}})
    small = ModelConfig.paper(2).model_copy(update={"latent": 8, "blocks": 1})
    monkeypatch.setattr(ModelConfig, "paper", classmethod(lambda cls, dim: small))
    simulator = tiny()
    device = simulator.device
    result = speed.run(simulator, Setup(tmp_path, budget=20.0))
    result.write_tables(tmp_path)
    assert simulator.device == device
    names = [row["network"] for row in result.rows]
    assert names == ["tiny"] * 2 + ["paper's 2D"] * 2
    for row in result.rows:
        assert row["seconds"] > 0
        assert row["seconds_mpm"] > 0
        assert row["over_plain"] == pytest.approx(row["seconds_plain"] / row["seconds"])
        assert row["over_mpm"] == pytest.approx(row["seconds_mpm"] / row["seconds"])
        assert row["counted"] == "CPU"
    edges = [row["edges"] for row in result.rows[:2]]
    assert edges == sorted(set(edges))
    told = [row["paper_gpu"] for row in result.rows]
    assert told == [None, None, None, 0.05]
    with open(tmp_path / "speed.csv", newline="") as file:
        assert [int(row["points"]) for row in csv.DictReader(file)] == [
            row["points"] for row in result.rows
        ]
    assert (tmp_path / "speed.png").stat().st_size > 10_000
    json.dumps(result.to_dict(), allow_nan=False)


def test_speed_is_that_of_the_network_where_a_rollout_begins_with_the_solver(
    tiny, tmp_path, monkeypatch
):
    """Three models in this repository do; a short rollout of theirs is the solver's alone."""

    def called(*args):
        raise AssertionError("the solver's steps are timed")

    monkeypatch.setattr("gns_model.learned.start.solver_frames", called)
    monkeypatch.setattr(speed, "SIZES", {2: (60,)})
    simulator = tiny(solver_steps=5)
    series = speed.series_of(simulator)[:1]
    monkeypatch.setattr(speed, "series_of", lambda simulator: series)
    [row] = speed.run(simulator, Setup(tmp_path, budget=20.0)).rows
    assert row["seconds"] > 0
    assert simulator.model.config.solver_steps == 5


def test_speed_leaves_out_what_the_budget_does_not_hold(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(speed, "SIZES", {2: (60, 240, 480)})
    series = speed.series_of(tiny())[:1]
    monkeypatch.setattr(speed, "series_of", lambda simulator: series)
    rows = speed.run(tiny(), Setup(tmp_path, budget=1e-6)).rows
    assert [row["points"] for row in rows] == [60, 242]
    assert rows[0]["seconds"] > 0
    assert rows[1]["seconds"] is rows[1]["over_plain"] is rows[1]["seconds_mpm"] is None
    assert rows[1]["left_out"].count("exceeds the time budget") == 4


def test_cost_of_a_training_step(tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The paper's networks at full size, on graphs of two thousand edges."""
    told = {dim: (2_000, *values[1:]) for dim, values in training.PAPER.items()}
    monkeypatch.setattr(training, "PAPER", told)
    simulator = tiny()
    before = [p.clone() for p in simulator.model.parameters()]
    result = training.run(simulator, Setup(tmp_path, budget=0.1))
    assert [row["parameters"] for row in result.rows[:2]] == [1_591_826, 1_592_979]
    assert [row["paper_parameters"] for row in result.rows[:2]] == [1_591_826, 1_592_979]
    for row in result.rows:
        assert row["edges"] == pytest.approx(2_000, rel=0.3)
        assert row["seconds"] > 0
        assert row["over_plain"] == pytest.approx(row["seconds_plain"] / row["seconds"])
    assert result.rows[2]["network"] == "tiny"
    assert result.rows[2]["paper_seconds"] is None
    after = list(simulator.model.parameters())
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))
    assert (tmp_path / "training.png").stat().st_size > 10_000


def test_a_training_step_trains(tiny):
    """What is timed is a step that lowers the loss, in both precisions."""
    model = tiny().model
    batch = training.block_batch(model.config, 400, "cpu")
    for short in (False, True):
        steps = training.stepper(model, batch, short=short)
        first = steps(1)
        assert steps(20) < first


def test_settings_of_the_solver_are_the_papers_alone():
    names = [setting.name for setting in training.settings_of(MpmSimulator())]
    assert names == ["paper's 2D", "paper's 3D"]
    assert [s.name for s in speed.series_of(MpmSimulator())] == names
    assert isinstance(training.settings_of(MpmSimulator())[0].model, LearnedModel)

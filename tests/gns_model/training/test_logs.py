"""What a run writes down: tables, TensorBoard's events and the loss history."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from gns_model.training import Recipe, progress, train
from gns_model.training.distributed import Ranks
from gns_model.training.logs import Events, Table, read_table
from gns_model.training.loss_figure import plot, smoothed


def scalars(folder) -> dict[str, list[tuple[int, float]]]:
    """Step and value of all scalars, as TensorBoard shows them."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder))
    events.Reload()
    return {
        tag: [(event.step, event.value) for event in events.Scalars(tag)]
        for tag in events.Tags()["scalars"]
    }


def test_tensorboard_reads_what_the_tables_hold_also_after_a_resume(tiny, tmp_path):
    recipe = Recipe.from_dict(tiny)
    train(recipe.model_copy(update={"steps": 3}), tmp_path)
    train(recipe, tmp_path)
    found = scalars(tmp_path / "tensorboard")
    log, checks = (read_table(tmp_path / name) for name in ("log.csv", "validation.csv"))
    assert [row["step"] for row in checks] == [3, 6]
    train_tags = ("loss", "learning_rate", "gradient_norm", "edges_per_second", "steps_per_second")
    for tag in train_tags:
        expected = [(row["step"], pytest.approx(row[tag], rel=1e-5)) for row in log]
        assert found[f"train/{tag}"] == expected
    for tag in ("score", "one_step", "centroid_travel", "upstream_depth", "energy"):
        expected = [(row["step"], pytest.approx(row[tag], rel=1e-5, abs=1e-9)) for row in checks]
        assert found[f"validation/{tag}"] == expected


def test_events_beyond_the_step_that_is_resumed_at_are_gone(tmp_path):
    first = Events(tmp_path, step=0)
    for step in range(1, 6):
        first.add("train", step, {"loss": float(step)})
    first.close()
    second = Events(tmp_path, step=3)
    second.add("train", 4, {"loss": 40.0})
    second.close()
    assert scalars(tmp_path)["train/loss"] == [(1, 1.0), (2, 2.0), (3, 3.0), (4, 40.0)]


def test_without_tensorboard_one_line_says_so_and_the_tables_go_on(
    tiny, tmp_path, monkeypatch, capsys
):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)  # as if it were missing
    train(Recipe.from_dict({**tiny, "valid": [], "steps": 1}), tmp_path)
    lines = [line for line in capsys.readouterr().out.splitlines() if "TensorBoard" in line]
    assert len(lines) == 1
    assert "gns-baffles[train]" in lines[0]
    assert not (tmp_path / "tensorboard").exists()
    assert len(read_table(tmp_path / "log.csv")) == 1


def test_a_table_drops_what_lies_beyond_and_a_row_that_was_cut_short(tmp_path):
    path = tmp_path / "t.csv"
    table = Table(path, step=0)
    for step in (1, 2, 3, 4):
        table.add({"step": step, "loss": 0.5 * step})
    with path.open("a") as file:
        file.write("5,")
    table = Table(path, step=3)
    assert [row["step"] for row in read_table(path)] == [1, 2, 3]
    # Other columns: the file is written anew, and what a row lacks stays empty.
    table.add({"step": 4, "depth": 0.25})
    assert read_table(path) == [
        {"step": 1, "loss": 0.5}, {"step": 2, "loss": 1.0}, {"step": 3, "loss": 1.5},
        {"step": 4, "depth": 0.25},
    ]  # fmt: skip
    assert not Table(path, step=0).path.exists()


@pytest.mark.parametrize(("unroll", "share"), [(1, 0.0), (2, 0.5)])
def test_the_log_says_which_share_of_the_steps_was_of_the_unrolled_phase(
    unroll, share, tiny, tmp_path
):
    settings = {"steps": 6, "unroll": unroll, "unroll_fraction": 0.5}
    train(Recipe.from_dict({**tiny, "valid": [], **settings}), tmp_path)
    rows = read_table(tmp_path / "log.csv")
    assert np.mean([row["unrolled"] for row in rows]) == pytest.approx(share)


def test_smoothing_is_a_mean_of_the_past():
    assert smoothed(np.full(50, 3.0)) == pytest.approx(np.full(50, 3.0))
    noisy = np.random.default_rng(0).normal(1.0, 0.5, 2000)
    assert smoothed(noisy)[500:].std() < 0.3 * noisy.std()
    late = np.zeros(100)
    late[60] = 1.0
    assert not smoothed(late)[:60].any()
    assert smoothed(late)[60] > 0


def test_the_loss_history_is_drawn_with_and_without_validation(tmp_path):
    from matplotlib.image import imread

    plot(tmp_path)
    assert not (tmp_path / "loss.png").exists()
    log = Table(tmp_path / "log.csv", step=0)
    for step in range(1, 200):
        log.add({"step": step, "loss": 1 / step, "unrolled": step > 100})
    plot(tmp_path)
    low = imread(tmp_path / "loss.png").shape
    checks = Table(tmp_path / "validation.csv", step=0)
    for step in (100, 199):
        checks.add({"step": step, "seconds": step, "score": 3.0, "one_step": 0.1, "energy": 0.2})
    plot(tmp_path)
    assert imread(tmp_path / "loss.png").shape[0] > 1.5 * low[0]


def test_the_time_left_of_a_resumed_run_counts_from_where_it_resumed(tmp_path, monkeypatch, capsys):
    """A tenth of a minute in six seconds: the 37.1 that are left of 50 take 37.1 minutes."""
    now = iter([0.0, 6.0, 6.0])
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: next(now)))
    monkeypatch.setattr(progress, "EVERY", 5.0)
    ranks = Ranks(0, 1, torch.device("cpu"))
    values = {"loss": 1.0, "learning_rate": 1e-3, "edges_per_second": 1e5}
    display = progress.Display(tmp_path, ranks, step=100, done=12.8, total=50.0, unit="minutes")
    display.step(101, 774.0, 12.9, values)
    assert "0:37:0" in capsys.readouterr().out

"""Training as a whole: it learns, resumes bit for bit, alone and on two ranks, and stops well."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from gns_model.data.generate import generate
from gns_model.data.windows import WindowIndex
from gns_model.errors import FileFormatError
from gns_model.learned.checkpoint import load_model
from gns_model.learned.world import World
from gns_model.training import Recipe, RecipeError, TrainingError, train
from gns_model.training.progress import Display
from gns_model.training.state import read_position
from gns_model.trajectory import Trajectory

ROOT = Path(__file__).parents[3]


def validations(out: Path) -> list[dict[str, float]]:
    with (out / "validation.csv").open() as file:
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]


def test_a_run_leaves_a_simulator_that_runs(tiny, tmp_path, slides):
    folder = train(Recipe.from_dict(tiny), tmp_path / "run")
    assert folder == tmp_path / "run" / "model"
    names = {p.name for p in (tmp_path / "run").iterdir()}
    assert names == {
        "model", "last", "state.safetensors", "recipe.json",
        "log.csv", "validation.csv", "loss.png", "tensorboard",
    }  # fmt: skip
    simulator = load_model(folder)
    card = simulator.card
    assert card["trained_on"]["steps"] == 6
    assert card["validation"]["score"] > 0
    assert simulator.config.limits.max_speed == pytest.approx((1.4**2 + 0.01) ** 0.5)
    truth = Trajectory.load(slides / "000.h5")
    result = simulator.rollout([truth.scene])[0]
    assert result.positions.shape == (11, 64, 3)
    # The saved weights are the moving average, not the last ones.
    state = load_file(tmp_path / "run" / "state.safetensors")
    last = load_model(tmp_path / "run" / "last").model.state_dict()
    key = "network.decode.layers.0.weight"
    assert torch.equal(last[key], state[f"average.{key}"])
    assert not torch.equal(last[key], state[f"model.{key}"])


def test_a_model_starts_as_the_flows_that_it_learned_from(tiny, tmp_path):
    for name, jitter in (("lattice", 0.0), ("shaken", 0.3)):
        generate(
            tmp_path / name, family="columns", count=1, spacing=0.05, frame_interval=0.02,
            jitter=jitter, workers=1,
        )  # fmt: skip
    chosen = {"dim": 2, "spacing": 0.05, "radius": 0.08}
    values = {**tiny, "steps": 1, "valid": [], "model": {**tiny["model"], **chosen}}

    def trained(*folders: str, **options: int) -> float:
        wanted = {"train": [str(tmp_path / f) for f in folders]}
        model = {**values["model"], **options}
        recipe = Recipe.from_dict({**values, **wanted, "model": model})
        return load_model(train(recipe, tmp_path / "-".join([*folders, *options]))).jitter

    assert trained("shaken") == 0.3
    assert trained("lattice") == trained("shaken", "lattice") == 0.0
    assert trained("shaken", subcells=2) == 0.0  # its starts are drawn in another way


def test_training_learns_a_law_of_motion(tiny, tmp_path):
    """Grains slow down at a rate that the network has to find; then rollouts end near the truth."""

    def last_validation(steps: int) -> dict[str, float]:
        train(Recipe.from_dict({**tiny, "steps": steps, "unroll_fraction": 0.2}), tmp_path)
        return validations(tmp_path)[-1]

    untrained, trained = last_validation(1), last_validation(200)
    assert trained["one_step"] < 0.5 * untrained["one_step"]
    assert trained["centroid_travel"] < 0.7 * untrained["centroid_travel"]
    assert trained["diverged"] == 0


def test_with_noise_on_its_accelerations_a_model_repeats_less(tiny, tmp_path, slides):
    """What changes of the next acceleration if those of the history are taken away, the last
    velocity as it is. Slides brake at a rate that their velocity tells, too, and so gently that it
    takes a large share to hide it."""

    def repeats(share: float) -> float:
        options = {"steps": 300, "unroll": 1, "acceleration_noise": share}
        out = tmp_path / str(share)
        simulator = load_model(train(Recipe.from_dict({**tiny, **options}), out))
        config, squares = simulator.config, 0.0
        windows = WindowIndex(
            [slides], spacing=config.spacing, dt=config.dt, history=config.history
        )
        for source in range(len(windows.sources)):
            window = windows.read(source, 8, mixture=0)
            history = torch.from_numpy(window.history)
            last = history[:, -1:] - history[:, -2:-1]
            steps = torch.arange(config.history, -1, -1)[None, :, None]
            even = history[:, -1:] - steps * last
            world = World.from_scenes([window.scene], [len(history)], device=history.device)
            with torch.no_grad():
                change = simulator.model.step(history, world) - simulator.model.step(even, world)
            squares += float(change.square().mean())
        return squares**0.5 / len(windows.sources)

    assert repeats(20.0) < 0.5 * repeats(0.0)


def test_nothing_is_learned_from_the_steps_that_a_rollout_leaves_to_the_solver(tiny, tmp_path):
    recipe = Recipe.from_dict({**tiny, "model": {**tiny["model"], "solver_steps": 40}})
    with pytest.raises(FileFormatError, match="40 steps at the start left out"):
        train(recipe, tmp_path)


def test_the_best_model_is_kept(tiny, tmp_path):
    """Each of six steps is followed by a validation; `model` is that of the lowest score."""
    train(Recipe.from_dict({**tiny, "validate_minutes": 1e-6, "learning_rate": 0.3}), tmp_path)
    checks = validations(tmp_path)
    assert [row["step"] for row in checks] == [1, 2, 3, 4, 5, 6, 6]
    card = json.loads((tmp_path / "model" / "card.json").read_text())
    best = min(checks, key=lambda row: row["score"])
    assert card["validation"]["score"] == pytest.approx(best["score"], rel=1e-5)
    assert card["trained_on"]["steps"] == best["step"]


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"replay": 5, "replay_steps": 3, "return_steps": 4, "unroll_fraction": 1.0},
        {
            "replay": 5,
            "replay_steps": 3,
            "replay_memory": 3,
            "replay_relative_to": 0.5,
            "return_steps": 4,
            "relative_to": 0.1,
            "unroll_fraction": 1.0,
        },
        {"flow_share": 0.7, "flow_steps": 4, "flow_edges": 3000, "unroll_fraction": 1.0},
        {"optimiser": "descent", "learning_rate": 0.1},
    ],
    ids=["windows", "replay", "memory", "flows", "descent"],
)
def test_resume_is_bit_exact_after_a_signal(tiny, tmp_path, monkeypatch, same_state, options):
    """Six steps at once, and three, SIGTERM, three: the same weights, average and moments."""
    recipe = Recipe.from_dict({**tiny, **options})
    train(recipe, tmp_path / "whole")

    step = Display.step

    def step_and_kill(self, number, *rest):
        step(self, number, *rest)
        if number == 2:  # noticed in step 3
            os.kill(os.getpid(), signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(Display, "step", step_and_kill)
        train(recipe, tmp_path / "parts")
    assert read_position(tmp_path / "parts" / "state.safetensors").step == 3
    assert not same_state(tmp_path / "whole", tmp_path / "parts")
    assert signal.getsignal(signal.SIGTERM) != signal.SIG_IGN
    train(recipe, tmp_path / "parts")
    assert read_position(tmp_path / "parts" / "state.safetensors").step == 6
    assert same_state(tmp_path / "whole", tmp_path / "parts")


def test_descent_moves_the_weights_by_its_rate_where_all_agree(tiny, tmp_path):
    """At once, as the mean of one gradient is that one; no longer, however steep the loss."""
    recipe = Recipe.from_dict(
        {
            **tiny,
            "valid": [],
            "optimiser": "descent",
            "learning_rate": 0.05,
            "clip_norm": 1e-3,  # every gradient is steeper
            "schedule": "exponential",
            "warmup": 0.0,
            "weight_decay": 0.0,
        }
    )

    def weights(steps):
        out = tmp_path / str(steps)
        train(recipe.model_copy(update={"steps": steps}), out)
        tensors = load_file(out / "state.safetensors")
        names = sorted(k for k in tensors if k.startswith("model.") and "mean" not in k)
        return np.concatenate([tensors[k].numpy().ravel() for k in names if "std" not in k])

    one, two, three = (weights(k) for k in (1, 2, 3))
    length = 0.05 * 1e-3
    assert np.linalg.norm(two - one) <= 1.001 * length
    assert np.linalg.norm(three - two) <= 1.001 * length
    assert np.linalg.norm(three - one) > 1.5 * length  # these two agree


def test_starting_anew_forgets_the_state(tiny, tmp_path, same_state):
    recipe = Recipe.from_dict({**tiny, "valid": []})
    assert train(recipe, tmp_path / "a") == tmp_path / "a" / "last"
    train(recipe, tmp_path / "b")
    train(recipe.model_copy(update={"steps": 3}), tmp_path / "a", resume=False)
    assert read_position(tmp_path / "a" / "state.safetensors").step == 3
    train(recipe, tmp_path / "a", resume=False)
    assert same_state(tmp_path / "a", tmp_path / "b")


def test_a_finished_run_is_left_as_it_is(tiny, tmp_path):
    recipe = Recipe.from_dict(tiny)
    train(recipe, tmp_path / "run")
    before = (tmp_path / "run" / "model" / "model.safetensors").read_bytes()
    assert train(recipe, tmp_path / "run") == tmp_path / "run" / "model"
    assert (tmp_path / "run" / "model" / "model.safetensors").read_bytes() == before
    assert read_position(tmp_path / "run" / "state.safetensors").step == 6


@pytest.mark.parametrize(
    "change",
    [
        {"seed": 1},
        {"optimiser": "descent"},
        {"model": {"radius": 0.11}},
        {"model": {"latent": 16}},
    ],
)
def test_a_state_of_another_run_is_refused(tiny, tmp_path, change):
    train(Recipe.from_dict({**tiny, "valid": [], "steps": 1}), tmp_path)
    values = {**tiny, **change, "model": {**tiny["model"], **change.get("model", {})}}
    with pytest.raises(RecipeError, match="cannot resume"):
        train(Recipe.from_dict(values), tmp_path)


def test_a_loss_that_is_not_finite_ends_the_run(tiny, tmp_path):
    recipe = Recipe.from_dict({**tiny, "valid": [], "steps": 100})
    train(recipe.model_copy(update={"steps": 2}), tmp_path)
    state = load_file(tmp_path / "state.safetensors")
    from safetensors import safe_open
    from safetensors.torch import save_file

    with safe_open(tmp_path / "state.safetensors", framework="pt") as file:
        metadata = file.metadata()
    state["model.network.decode.layers.0.bias"][0] = float("nan")
    save_file(state, tmp_path / "state.safetensors", metadata=metadata)
    with pytest.raises(TrainingError, match="not finite"):
        train(recipe, tmp_path)


@pytest.mark.parametrize("options", [{"precision": "bfloat16"}, {"backprop_through_unroll": True}])
def test_other_ways_to_train_run(tiny, tmp_path, options):
    recipe = Recipe.from_dict({**tiny, **options, "unroll_fraction": 1.0, "linear_beyond": 2.0})
    train(recipe, tmp_path)
    with (tmp_path / "log.csv").open() as file:
        assert all(float(row["loss"]) < 20 for row in csv.DictReader(file))


@pytest.mark.parametrize(
    ("recipe", "words"),
    [
        ('train = ["nowhere"]\nsteps = 1', "nowhere: no trajectory files"),
        ("steps = 1", "'train' is missing"),
        (None, "cannot be read"),
    ],
)
def test_the_command_ends_in_one_line_and_code_2(tmp_path, recipe, words):
    path = tmp_path / "r.toml"
    if recipe is not None:
        path.write_text(recipe)
    result = subprocess.run(
        [sys.executable, "-m", "gns_model.training", str(path), "--out", str(tmp_path / "o")],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert result.returncode == 2
    assert words in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1

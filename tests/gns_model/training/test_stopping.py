"""Runs that are told to stop, at whatever moment, and runs that get no time to."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from gns_model.learned.checkpoint import load_model
from gns_model.training import Recipe, TrainingError, stopping, train
from gns_model.training.claim import claim
from gns_model.training.progress import Display
from gns_model.training.state import read_position
from gns_model.training.stopping import Abandoned, Stop, stop_on_signals

HERE, ROOT = Path(__file__).parent, Path(__file__).parents[3]


def terminate_after(seconds: float) -> threading.Timer:
    timer = threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGTERM))
    timer.start()
    return timer


def wait(seconds: float) -> None:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        time.sleep(0.01)


def test_a_request_waits_for_the_step_and_then_gives_it_up(monkeypatch):
    monkeypatch.setattr(stopping, "GRACE", 0.3)
    with stop_on_signals() as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.requested
        began = time.monotonic()
        with pytest.raises(Abandoned), stop.may_abandon():
            wait(10)
        assert 0.2 < time.monotonic() - began < 5
        with pytest.raises(Abandoned), stop.may_abandon():
            pytest.fail("nothing new is begun")


def as_compiled_code_says(function, *arguments) -> None:
    try:
        function(*arguments)
    except Abandoned as error:
        raise SystemError("returned a result with an exception set") from error


def test_compiled_code_may_hide_that_a_step_was_given_up(monkeypatch):
    """Numba turns what a signal handler raises inside of it into a SystemError; one that comes
    without a request stays what it is."""
    monkeypatch.setattr(stopping, "GRACE", 0.05)
    with stop_on_signals() as stop:
        with pytest.raises(SystemError), stop.may_abandon():
            raise SystemError("a fault of its own")
        os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(Abandoned), stop.may_abandon():
            as_compiled_code_says(wait, 10)


def test_what_has_to_last_is_never_interrupted(monkeypatch):
    monkeypatch.setattr(stopping, "GRACE", 0.05)
    with stop_on_signals() as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        wait(0.3)
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.requested
    assert signal.getsignal(signal.SIGTERM) is not stop.request


def test_a_step_that_takes_too_long_is_given_up_and_nothing_is_lost(tiny, tmp_path, monkeypatch):
    """A step of some thousand windows takes minutes; the state of the step before is saved."""
    monkeypatch.setattr(stopping, "GRACE", 0.3)
    recipe = Recipe.from_dict({**tiny, "valid": [], "unroll_fraction": 0.0, "steps": 2})
    train(recipe, tmp_path)
    endless = recipe.model_copy(update={"steps": 4, "edges_per_batch": 10**7})
    timer = terminate_after(2.0)
    began = time.monotonic()
    train(endless, tmp_path)
    assert time.monotonic() - began < 12
    timer.join()
    assert read_position(tmp_path / "state.safetensors").step == 2
    train(recipe.model_copy(update={"steps": 3}), tmp_path)
    assert read_position(tmp_path / "state.safetensors").step == 3


def test_a_request_that_somebody_swallows_comes_again(monkeypatch):
    """A signal may arrive in a destructor, where Python ignores what is raised."""
    monkeypatch.setattr(stopping, "GRACE", 0.0)
    monkeypatch.setattr(stopping, "AGAIN", 0.05)
    with stop_on_signals() as stop:
        timer = terminate_after(0.05)

        def deaf() -> None:
            with stop.may_abandon():
                with contextlib.suppress(Abandoned):
                    wait(20.0)
                wait(20.0)

        with pytest.raises(Abandoned):
            deaf()
        timer.join()


def test_a_stop_in_the_middle_of_a_validation_saves_and_ends(tiny, tmp_path, monkeypatch):
    recipe = Recipe.from_dict({**tiny, "validate_minutes": 1e-6})

    def kill(_self, _fraction):
        os.kill(os.getpid(), signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(Display, "validating", kill)
        assert train(recipe, tmp_path) == tmp_path / "last"
    assert read_position(tmp_path / "state.safetensors").step == 1
    assert not (tmp_path / "validation.csv").exists()
    assert train(recipe, tmp_path) == tmp_path / "model"


def test_a_stop_before_the_first_step_is_an_interrupt(tiny, tmp_path, monkeypatch):
    # Cut in the middle of an import, torch would stay half imported for the tests to come.
    train(Recipe.from_dict({**tiny, "valid": [], "steps": 1}), tmp_path / "first")
    monkeypatch.setattr(stopping, "GRACE", 0.0)
    endless = Recipe.from_dict({**tiny, "statistics_windows": 10**6})
    timer = terminate_after(1.0)
    with pytest.raises(KeyboardInterrupt):
        train(endless, tmp_path / "run")
    timer.join()
    assert not (tmp_path / "run").exists()


def test_two_runs_cannot_train_in_one_folder(tiny, tmp_path, monkeypatch):
    import gns_model.training.claim as module

    monkeypatch.setattr(module, "WAIT", 0.3)
    with claim(tmp_path / "run", Stop()):
        with pytest.raises(TrainingError, match="another run trains"):
            train(Recipe.from_dict(tiny), tmp_path / "run")
        (tmp_path / "run" / "kept").touch()
    train(Recipe.from_dict({**tiny, "valid": [], "steps": 1}), tmp_path / "run")


@pytest.mark.slow
def test_kill_9_at_random_moments_leaves_checkpoints_that_load(tiny, tmp_path, write_recipe):
    """Twenty processes that save after every step are killed; see `killed_runs.py`."""
    values = {
        **{k: v for k, v in tiny.items() if k != "steps"},
        "minutes": 60,
        "checkpoint_minutes": 1e-9,
        "validate_minutes": 0.01,
        "unroll": 1,
    }
    recipe = write_recipe(tmp_path / "r.toml", values)
    result = subprocess.run(
        [sys.executable, str(HERE / "killed_runs.py"), str(recipe), str(tmp_path / "run"), "20"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=1200,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    steps = [int(word) for word in result.stdout.split()]
    assert len(steps) == 20
    assert steps == sorted(steps)  # no kill loses a state that was saved
    assert steps[-1] >= 20
    # And training goes on from there, leaving none of the litter.
    finish = Recipe.from_dict({**tiny, "unroll": 1, "steps": steps[-1] + 2})
    train(finish, tmp_path / "run")
    assert read_position(tmp_path / "run" / "state.safetensors").step == steps[-1] + 2
    litter = [p.name for p in (tmp_path / "run").rglob(".*")]
    assert not litter
    load_model(tmp_path / "run" / "model")

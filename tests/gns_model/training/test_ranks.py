"""Several ranks: under the launcher and under torchrun, and what they make of one batch."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from gns_model.training import Recipe, launch, train
from gns_model.training.distributed import RankError, session
from gns_model.training.state import read_position

ROOT = Path(__file__).parents[3]
BIN = Path(sys.executable).parent
STATE = "state.safetensors"
#: Seconds after which something hangs, also where many processes share few cores.
PATIENCE = 500


def torchrun(*arguments: str) -> list[str]:
    return [str(BIN / "torchrun"), "--standalone", "--nproc-per-node", "2", *arguments]


def start(command: list[str]) -> subprocess.Popen[str]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        command,
        cwd=ROOT,
        env=environment,
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def terminate_once_training(process: subprocess.Popen[str], out: Path) -> tuple[int, float]:
    """Exit code after SIGTERM, and the seconds that the end took."""
    try:
        deadline = time.monotonic() + PATIENCE
        while not (out / STATE).exists() and time.monotonic() < deadline:
            assert process.poll() is None, process.communicate()
            time.sleep(0.1)
        process.send_signal(signal.SIGTERM)
        began = time.monotonic()
        process.communicate(timeout=PATIENCE)
        return process.returncode, time.monotonic() - began
    finally:
        process.kill()


def slowdown() -> float:
    """How much slower this machine is now than one where importing torch takes four seconds."""
    began = time.monotonic()
    subprocess.run([sys.executable, "-c", "import torch"], check=True)
    return max(1.0, (time.monotonic() - began) / 4)


def test_one_process_is_a_rank_of_one(monkeypatch):
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    with session("cpu") as ranks:
        assert (ranks.rank, ranks.world) == (0, 1)
        values = torch.ones(3)
        assert ranks.sum(values) is values
        assert ranks.share(b"abc") == b"abc"
        assert ranks.share(None) == b""


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_named(tiny, tmp_path):
    with pytest.raises(RankError, match="needs GPU 0, there are 0"):
        train(Recipe.from_dict({**tiny, "device": "cuda"}), tmp_path)


@pytest.mark.slow
def test_two_ranks_average_resume_bit_exactly_and_torchrun_does_what_the_launcher_does(
    tiny, tmp_path, write_recipe, same_state
):
    values = {
        **tiny, "valid": [], "schedule": "exponential", "unroll_fraction": 0.0, "mirror": False,
        "model": {**tiny["model"], "noise_std": 0.0},
    }  # fmt: skip
    first = write_recipe(tmp_path / "first.toml", {**values, "steps": 1})
    whole = write_recipe(tmp_path / "whole.toml", {**values, "steps": 4})
    assert launch(first, tmp_path / "parts", 2) == 0
    # Two ranks with half a batch each are one with the whole: after one step the averaged
    # gradients, as the optimiser got them, are those of the whole batch.
    alone = {**values, "steps": 1, "edges_per_batch": 2 * values["edges_per_batch"]}
    train(Recipe.from_dict(alone), tmp_path / "alone")
    one, two = (load_file(tmp_path / name / STATE) for name in ("alone", "parts"))
    moments = [key for key in one if key.endswith("exp_avg")]
    assert len(moments) > 10
    for key in moments:
        torch.testing.assert_close(two[key], one[key], rtol=1e-4, atol=1e-7)
    assert max(float(one[key].abs().max()) for key in moments) > 1e-3
    # Going on from there, and all four steps at once under torchrun: the same state.
    assert launch(whole, tmp_path / "parts", 2) == 0
    module = start(
        torchrun("-m", "gns_model.cli", "train", str(whole), "--out", str(tmp_path / "t"))
    )
    output, errors = module.communicate(timeout=PATIENCE)
    assert module.returncode == 0, errors
    assert output.strip().splitlines()[-1] == str(tmp_path / "t" / "last")
    assert same_state(tmp_path / "parts", tmp_path / "t")


@pytest.mark.slow
@pytest.mark.parametrize("way", ["torchrun", "launcher"])
def test_sigterm_saves_and_ends(tiny, tmp_path, write_recipe, way):
    """To torchrun's agent, around the installed command, and to our own launcher."""
    values = {k: v for k, v in tiny.items() if k != "steps"}
    values |= {"minutes": 5, "checkpoint_minutes": 0.01}
    recipe, out = write_recipe(tmp_path / "long.toml", values), tmp_path / "run"
    train_it = [str(BIN / "gns-model"), "train", str(recipe), "--out", str(out)]
    command = torchrun(*train_it) if way == "torchrun" else [*train_it, "--ranks", "2"]
    code, seconds = terminate_once_training(start(command), out)
    # torchrun reports the signal that ended it; our launcher, that all went well.
    assert code == 0 if way == "launcher" else code != 0
    assert seconds < 10 * slowdown()
    position = read_position(out / STATE)
    assert position.step > 0
    assert position.seconds < 300


@pytest.mark.slow
def test_a_rank_that_dies_ends_the_run_with_what_was_learned(tiny, tmp_path, write_recipe):
    """Rank 1 is killed: rank 0 saves the last whole step, and both lines say what happened."""
    values = {k: v for k, v in tiny.items() if k != "steps"} | {"minutes": 5, "valid": []}
    recipe, out = write_recipe(tmp_path / "long.toml", values), tmp_path / "run"
    command = [str(BIN / "gns-model"), "train", str(recipe), "--out", str(out), "--ranks", "2"]
    process = start(command)
    try:
        deadline = time.monotonic() + PATIENCE
        while not (out / "log.csv").exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        for child in _children(process.pid):
            if b"RANK=1" in Path(f"/proc/{child}/environ").read_bytes().split(b"\0"):
                os.kill(child, signal.SIGKILL)
        _, errors = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
    assert process.returncode != 0
    assert "error: rank 1 was killed by SIGKILL" in errors
    assert "error: lost the connection to another rank" in errors
    assert "Traceback" not in errors
    assert read_position(out / STATE).step > 0


def _children(pid: int) -> list[int]:
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]

"""Train in child processes, kill -9 each at a random moment, and read what it left every time.

    python killed_runs.py RECIPE OUT COUNT

prints the step of the state after every kill. Children are forked from this process, which has
loaded all that is slow to load, so that twenty of them take seconds and not minutes.
"""

from __future__ import annotations

import os
import random
import signal
import sys
import tempfile
import time
from pathlib import Path

import torch
import torch.utils.tensorboard

from gns_model.learned.checkpoint import load_model
from gns_model.learned.graph import radius_graph
from gns_model.training import Recipe, train
from gns_model.training.launching import LAUNCHER
from gns_model.training.logs import Table
from gns_model.training.loss_figure import LOG, VALIDATION, plot
from gns_model.training.state import read_position


def load_all() -> None:
    """Load what is only loaded when it is used: matplotlib and numba's kernels."""
    radius_graph(torch.zeros((2, 3)), 1.0)
    with tempfile.TemporaryDirectory() as folder:
        for name in (LOG, VALIDATION):
            row = {"step": 1.0, "loss": 1.0, "one_step": 1.0, "score": 1.0}
            Table(Path(folder) / name, step=0).add(row)
        plot(Path(folder))


def main(recipe_file: str, folder: str, count: str) -> None:
    torch.set_num_threads(1)
    load_all()
    recipe, out, chance = Recipe.from_toml(recipe_file), Path(folder), random.Random(0)
    state = out / "state.safetensors"
    os.environ[LAUNCHER] = str(os.getpid())  # no child outlives us
    for k in range(int(count)):
        before = state.stat().st_mtime_ns if state.exists() else 0
        child = os.fork()
        if child == 0:
            log = os.open(os.devnull, os.O_WRONLY)
            os.dup2(log, 1)
            train(recipe, out)
            os._exit(1)
        deadline = time.monotonic() + 300
        while not (state.exists() and state.stat().st_mtime_ns > before):
            if time.monotonic() > deadline:
                raise SystemExit(f"child {k} saved nothing")
            time.sleep(0.005)
        time.sleep(chance.uniform(0.0, 0.3))
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        if not os.WIFSIGNALED(status):
            raise SystemExit(f"child {k} ended by itself: {status}")
        print(read_position(state).step, flush=True)
        for name in ("last", "model"):
            if (out / name).exists():
                load_model(out / name)


if __name__ == "__main__":
    main(*sys.argv[1:])

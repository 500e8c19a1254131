"""How much of a step is told by the state, and how much repeats the step before.

    python benchmarks/copying.py column-2d baffle-3d

On the reference solver's own states (the paper's columns in 2D, its flume in 3D), for the first,
second, ... part of a flow: by how much the accelerations that a model gives to points are off, as
a share of the standard deviation of the true ones; by how much those of the step before are; and
k, the part of a change of the accelerations in the history (all of them times 1.2, the last
velocity as it is) that the model gives on to the next one. In a rollout the history is the model's
own, so an error that all points share is repeated 1 / (1 - k) times: a model may have small errors
here and still be off there (`gns_model/training/noise.py`). A model whose history is one velocity
sees no acceleration, and its k is zero. Two minutes a model.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gns_model import load_simulator, paper
from gns_model.console import print_table
from gns_model.data.windows import Window, WindowIndex
from gns_model.errors import GnsError
from gns_model.learned.model import LearnedModel
from gns_model.learned.simulator import LearnedSimulator
from gns_model.learned.world import World

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("models", nargs="+", help="shipped models, or checkpoint folders")
parser.add_argument("--every", type=int, default=4, help="look at one step in so many")

CHANGE = 0.2
#: Parts of a flow that are told apart [s]; columns and flumes are at rest after the last.
TIMES = (0.0, 0.1, 0.2, 0.3, 0.45, 0.6)


def with_other_accelerations(history: Tensor, factor: float) -> Tensor:
    """`history` (N, H+1, D) with its accelerations times `factor`; the last position and velocity
    stay."""
    velocity = history.diff(dim=1)
    change = (factor - 1) * velocity.diff(dim=1)
    # Velocities differ by what has yet to come, positions by the sum of that.
    earlier = torch.cat([change.flip(1).cumsum(1).flip(1), torch.zeros_like(change[:, :1])], 1)
    moved = earlier.flip(1).cumsum(1).flip(1)
    return history + torch.cat([moved, torch.zeros_like(history[:, :1])], 1)


def of_step(model: LearnedModel, window: Window) -> np.ndarray:
    """What the ratios are made of, summed over points and axes: squares of the true acceleration,
    of the error and of that of repeating the last one; given times its change; given squared."""
    history, after = torch.from_numpy(window.history), torch.from_numpy(window.future[:, 0])
    world = World.from_scenes([window.scene], [len(history)], device=history.device)
    velocity = history.diff(dim=1)
    last, before = velocity[:, -1], velocity[:, -2]
    true = after - history[:, -1] - last
    with torch.no_grad():
        given, other = (
            model.step(h[:, -model.config.history - 1 :], world) - history[:, -1] - last
            for h in (history, with_other_accelerations(history, 1 + CHANGE))
        )
    change = (other - given) / CHANGE
    off = (true - true.mean(0), given - true, last - before - true, change * given, given**2)
    squares = [part.square() for part in off[:3]] + list(off[3:])
    return np.array([float(part.sum()) for part in squares])


def main() -> None:
    arguments = parser.parse_args()
    for name in arguments.models:
        try:
            simulator = load_simulator(name)
        except GnsError as error:
            parser.error(str(error))
        if not isinstance(simulator, LearnedSimulator):
            parser.error(f"{name}: not a learned simulator")
        config = simulator.config
        flat = config.dim == 2
        history = max(config.history, 2)  # the step before is told from two velocities
        scenes = [paper.column_scene(c) for c in paper.COLUMNS] if flat else [paper.flume_scene()]
        spacing = config.spacing / config.subcells
        # From the points that the model would start from; several subcells draw their own.
        solver = load_simulator(
            "mpm", spacing=spacing, frame_interval=config.dt, jitter=simulator.jitter
        )
        total = np.zeros((len(TIMES) - 1, 5))
        with tempfile.TemporaryDirectory() as folder:
            for k, scene in enumerate(scenes):
                [true] = solver.rollout([scene.replace(duration=TIMES[-1] + config.dt)])
                true.save(Path(folder) / f"{k}.h5")
            index = WindowIndex([folder], spacing=config.spacing, dt=config.dt, history=history)
            for source in range(len(scenes)):
                for frame in range(history, index.starts(source), arguments.every):
                    part = np.searchsorted(TIMES, frame * config.dt, side="right") - 1
                    if part < len(total):
                        window = index.read(source, frame, mixture=0)
                        total[part] += of_step(simulator.model, window)
        rows = [
            [
                f"{begin:g} to {end:g} s",
                f"{np.sqrt(error / spread):.2f}",
                f"{np.sqrt(copied / spread):.2f}",
                f"{change / square:.2f}",
            ]
            for (begin, end), (spread, error, copied, change, square) in zip(
                itertools.pairwise(TIMES), total, strict=True
            )
        ]
        print_table(
            f"{name} on the solver's states of {'six columns' if flat else 'the flume'}",
            ["time", "error of a step", "of the step before", "k"],
            rows,
        )


if __name__ == "__main__":
    main()

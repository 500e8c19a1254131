"""Why high columns run short: what a model gives a column in its first fifth of a second.

    python benchmarks/first_steps.py column-2d

For the columns of the paper, by aspect ratio: the speed that the front (the twentieth of the points
farthest along x) gains in the solver from the first step that the model takes until 0.2 s, what the
model's steps add up to if each begins from the solver's state, and what they come to in a rollout;
and the speed at which the top fifth falls. A step that gives too little on true states has not seen
such states; one that is right on those and wrong in a rollout drifts away from them. About a minute
a model.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch

from gns_model import load_simulator, paper
from gns_model.console import print_table
from gns_model.errors import GnsError
from gns_model.learned.simulator import LearnedSimulator
from gns_model.learned.world import World
from gns_model.trajectory import Trajectory

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("models", nargs="+", help="shipped models of 2D columns, or checkpoint folders")

FRONT, TOP = 0.05, 0.2
UNTIL = 0.2  # s


def groups(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Masks of the front and of the top of `positions` (N, 2)."""
    x, y = positions.T
    return x >= np.quantile(x, 1 - FRONT), y >= np.quantile(y, 1 - TOP)


def gained(true: Trajectory, simulator: LearnedSimulator) -> tuple[np.ndarray, np.ndarray]:
    """Speeds [m/s] gained along x by the front and along y by the top, in the solver and by the
    model's steps from the solver's states."""
    config = simulator.config
    positions = true.positions
    points = positions.shape[1]
    world = World.from_scenes([true.scene], [points], device=torch.device("cpu"))
    ours, given = np.zeros(2), np.zeros(2)
    for k in range(config.history, round(UNTIL / config.dt)):
        history = torch.from_numpy(positions[k - config.history : k + 1].swapaxes(0, 1).copy())
        with torch.no_grad():
            after = simulator.model.step(history, world).numpy()
        front, top = groups(positions[k])
        for total, next_ in ((ours, positions[k + 1]), (given, after)):
            change = (next_ - 2 * positions[k] + positions[k - 1]) / config.dt
            total += change[front, 0].mean(), change[top, 1].mean()
    return ours, given


def rolled_out(trajectory: Trajectory, first: int) -> np.ndarray:
    """As `gained`, of the front and the top as they are in frame `first` and in the last one."""
    positions, interval = trajectory.positions, float(trajectory.time[1] - trajectory.time[0])
    speeds = []
    for k in (first, round(UNTIL / interval)):
        velocity = (positions[k] - positions[k - 1]) / interval
        front, top = groups(positions[k])
        speeds.append([velocity[front, 0].mean(), velocity[top, 1].mean()])
    return np.array(speeds[1]) - speeds[0]


def main() -> None:
    arguments = parser.parse_args()
    for name in arguments.models:
        try:
            simulator = load_simulator(name)
        except GnsError as error:
            parser.error(str(error))
        if not isinstance(simulator, LearnedSimulator) or simulator.config.dim != 2:
            parser.error(f"{name}: not a learned simulator of 2D columns")
        config = simulator.config
        start = {"jitter": simulator.jitter, "filling": simulator.filling}
        solver = load_simulator(
            "mpm", spacing=config.spacing, frame_interval=config.dt, threads=1, **start
        )
        rows = []
        for column in paper.COLUMNS:
            scene = paper.column_scene(column).replace(duration=UNTIL + config.dt)
            [true], [rolled] = solver.rollout([scene]), simulator.rollout([scene])
            ours, given = gained(true, simulator)
            kept = rolled_out(rolled, config.history) - rolled_out(true, config.history)
            values = np.stack([ours, given - ours, kept], axis=1).ravel()
            rows.append([f"{column.aspect:g}", *(f"{v:+.2f}" for v in values)])
        print_table(
            f"{name}: speeds gained until {UNTIL:g} s, and how far off, in m/s",
            ["aspect", "front", "from true states", "rolled out",
             "top", "from true states", "rolled out"],
            rows,
        )  # fmt: skip


if __name__ == "__main__":
    main()

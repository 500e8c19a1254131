"""How far the front of a rolled flow is asked ahead: grain by grain, and by the least way back.

    python benchmarks/way_back.py column-2d --family squares --points 324: --scenes 12
    python benchmarks/way_back.py baffle-3d --family slides --points :3000 --scenes 8

`replay` trains on states that a model rolled itself, and asks them back to the truth
(`gns_model/training/replay.py`). For flows of a family, after 0.2, 0.4 and 0.6 s, of the model's
foremost fiftieth along x, the mean way [mm]
    missing     to the foremost fiftieth of the truth: what the front is short of;
    own places  to where these very grains are in the truth;
    paired      to the true grains that `replay_exchange` pairs them with.
Flows are left out once the truth has come to the far wall. Two minutes of a core in 2D, six in 3D.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch

from gns_model import load_simulator
from gns_model.console import print_table
from gns_model.data.generate import parse_points, select
from gns_model.data.scenes import draw
from gns_model.data.windows import Window
from gns_model.errors import GnsError
from gns_model.learned.simulator import LearnedSimulator
from gns_model.training.exchange import least_way_back
from gns_model.training.loss import TIP
from gns_model.trajectory import Trajectory

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("model", help="a shipped model, or a checkpoint folder")
parser.add_argument("--family", default="squares")
parser.add_argument("--points", default=":", help="least:most")
parser.add_argument("--scenes", type=int, default=12)
parser.add_argument("--seed", type=int, default=1)
parser.add_argument("--return-steps", type=float, default=16.0)

TIMES = (0.2, 0.4, 0.6)  # s


def ways(true: Trajectory, rolled: Trajectory, frame: int, back: float) -> list[float]:
    """The module's three ways of the tip along x [m] at a frame."""
    own, truth = (t.positions[frame - 1 : frame + 1].swapaxes(0, 1) for t in (rolled, true))
    begin = np.arange(len(own), dtype=np.int32)
    order = least_way_back(own, Window(truth, truth[:, :0], true.scene), begin, back)
    x, x_true = own[:, -1, 0], truth[:, -1, 0]
    count = max(1, round(TIP * len(x)))
    tip = np.argsort(x)[-count:]
    places = (np.sort(x_true)[-count:], x_true[tip], x_true[order[tip]])
    return [float(place.mean() - x[tip].mean()) for place in places]


def main() -> None:
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    try:
        simulator = load_simulator(arguments.model)
        bounds = parse_points(arguments.points)
        chosen = select(arguments.scenes, arguments.family, arguments.seed, None, bounds)
    except GnsError as error:
        parser.error(str(error))
    if not isinstance(simulator, LearnedSimulator):
        parser.error(f"{arguments.model}: not a learned simulator")
    config, found = simulator.config, {time: [] for time in TIMES}
    for index in chosen:
        scene = draw(arguments.family, arguments.seed, index)
        start = {"jitter": simulator.jitter, "filling": index if simulator.jitter else 0}
        solver = load_simulator(
            "mpm", spacing=config.spacing, frame_interval=config.dt, threads=1, **start
        )
        [true], [rolled] = solver.rollout([scene]), simulator.refilled(**start).rollout([scene])
        for time in TIMES:
            frame = round(time / config.dt)
            wall = scene.domain.upper[0] - 2 * config.spacing
            if frame < len(true.positions) and true.positions[frame, :, 0].max() < wall:
                found[time].append(ways(true, rolled, frame, arguments.return_steps))
    print_table(
        f"{arguments.model}: mean way of the foremost {TIP:.0%} along x (mm)",
        ["after", "flows", "missing", "own places", "paired"],
        [
            [f"{time:g} s", str(len(rows)), *(f"{1e3 * v:+.1f}" for v in np.mean(rows, axis=0))]
            for time, rows in found.items()
            if rows
        ],
    )


if __name__ == "__main__":
    main()

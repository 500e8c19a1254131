"""What keeping grains apart is worth: a model with other limits of crowding, and with none.

    python benchmarks/crowding.py baffle-3d --scenes 6
    python benchmarks/crowding.py baffle-3d --family barriers      # thrown cubes

Rolls a model out on flows that it has not seen (`--family slides`, seed 1) beside the reference
solver, with each of the limits, and prints by how much it is off at the end: edges of the radius
graph (which grow as grains sink into each other), mean height of the mass over the base, its mean
distance from its own middle in plan, and the place of the middle. Without a limit the graph of
the `baffle-3d` for which it was made grew to more than twice its size, which takes as much longer;
that of today has learned with it.
"""

from __future__ import annotations

import argparse
import os

import numpy as np
import torch

from gns_model import load_simulator
from gns_model.console import print_table
from gns_model.data.scenes import draw
from gns_model.learned import LearnedSimulator
from gns_model.learned.graph import radius_graph
from gns_model.trajectory import Trajectory

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("model", nargs="?", default="baffle-3d")
parser.add_argument("--limits", type=float, nargs="+", default=[0.0, 1.15, 1.3, 1.5])
parser.add_argument("--family", default="slides")
parser.add_argument("--scenes", type=int, default=6)
parser.add_argument("--seed", type=int, default=1)


def with_limit(simulator: LearnedSimulator, limit: float) -> LearnedSimulator:
    """`simulator` with another limit of crowding, 0 for none; its own weights."""
    model = simulator.model
    model.config = model.config.model_copy(update={"crowding_limit": limit})
    return simulator


def read(trajectory: Trajectory, radius: float) -> dict[str, float | np.ndarray]:
    """What is compared, at the end of a flow [m]."""
    positions = np.asarray(trajectory.positions[-1], dtype=np.float32)
    middle = positions.mean(axis=0)
    plan = (positions - middle)[:, ::2]
    return {
        "edges": float(len(radius_graph(torch.from_numpy(positions), radius)[0])),
        "height": float(middle[1] - trajectory.scene.base),
        "spread": float(np.linalg.norm(plan, axis=1).mean()),
        "middle": middle,
    }


def main() -> None:
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    scenes = [draw(arguments.family, arguments.seed, k) for k in range(arguments.scenes)]
    simulator = load_simulator(arguments.model, precision="auto")
    config = simulator.config
    solver = load_simulator(
        "mpm", spacing=config.spacing, frame_interval=config.dt, workers=os.cpu_count() or 1
    )
    true = [(t.positions[0].mean(axis=0), read(t, config.radius)) for t in solver.rollout(scenes)]
    rows = []
    for limit in arguments.limits:
        found = [read(t, config.radius) for t in with_limit(simulator, limit).rollout(scenes)]
        cells = [f"{limit:g}" if limit else "none"]
        for name in ("edges", "height", "spread"):
            off = [f[name] / t[name] - 1 for f, (_, t) in zip(found, true, strict=True)]
            cells += [f"{np.mean(off):+.0%}", f"{np.abs(off).mean():.0%}"]
        off = [
            np.linalg.norm(f["middle"] - t["middle"]) / np.linalg.norm(t["middle"] - begun)
            for f, (begun, t) in zip(found, true, strict=True)
        ]
        rows.append([*cells, f"{np.mean(off):.0%}"])
    print_table(
        f"{arguments.model} on {len(scenes)} unseen flows against the solver: mean error, and mean "
        "size of it",
        ["limit", "edges", "", "height", "", "spread", "", "middle, of its way"],
        rows,
    )


if __name__ == "__main__":
    main()

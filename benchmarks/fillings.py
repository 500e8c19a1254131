"""How far the filling of a release decides what the reference solver says.

    python benchmarks/fillings.py

Points start on a lattice; real grains do not. The paper's six columns and its flume with three
layouts, each from the lattice and from several fillings whose points are moved off it at random:
what the mean over the fillings changes, and by how much they differ among each other (standard
deviation), in per cent of the lattice's value. A model that differs from the solver by less than
that cannot be told from it by that measure. Two layouts are compared on the lattice, so what the
change differs from one to the other is what their comparison may be off by: REPEATABILITY in
`design/wording.py`. Twenty CPU minutes, shared by the processes. Learned models from the same
fillings: `gns-model evaluate MODEL --suite columns --fillings 8`.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np

from gns_model import load_simulator, measures, paper
from gns_model.console import print_table
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--jitter", type=float, default=0.25, help="largest shift, in spacings")
parser.add_argument("--fillings", type=int, default=8)
parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)

FLUME = Scene.from_toml(Path(__file__).parent.parent / "examples" / "flume.toml")
FLUMES = {
    "no baffles": FLUME.with_baffles([]),
    "paper's": FLUME,
    "tight row": FLUME.with_baffles([(0.757, 0.696), (0.757, 0.971), (0.757, 1.247)]),  # make demo
}
MEASURES = ("runout_max", "runout_p99", "centroid_travel", "upstream_depth", "mass_past_section")


def column_measures(trajectory: Trajectory) -> dict[str, float]:
    """Of a column: how far its farthest point, its last hundredth and its centroid went."""
    last = measures.front_over_time(trajectory, quantile=0.99)[-1]
    return {
        "farthest point": measures.normalised_runout(trajectory),
        "p99": last - trajectory.scene.front,
        "centroid": measures.centroid_travel(trajectory),
    }


def cells(values: list[dict[str, float]], name: str) -> list[str]:
    """Change of the mean and standard deviation, of the first value; fillings follow it."""
    lattice, *rest = (value[name] for value in values)
    changes = 100 * (np.array(rest) / lattice - 1)
    return [f"{changes.mean():+.1f}", f"{changes.std(ddof=1):.1f}"]


def main() -> None:
    arguments = parser.parse_args()
    scenes = [*(paper.column_scene(column) for column in paper.COLUMNS), *FLUMES.values()]
    runs = [
        load_simulator("mpm", workers=arguments.workers, jitter=jitter, filling=k).rollout(scenes)
        for k, jitter in enumerate([0.0] + [arguments.jitter] * arguments.fillings)
    ]
    by_scene = list(zip(*runs, strict=True))
    title = f"{arguments.fillings} fillings, up to {arguments.jitter:g} spacings off the lattice"
    rows = []
    for column, found in zip(paper.COLUMNS, by_scene, strict=False):
        values = [column_measures(trajectory) for trajectory in found]
        rows.append([f"{column.aspect:g}", *(c for name in values[0] for c in cells(values, name))])
    print_table(
        f"Columns, {title}: change and standard deviation of the travel, in %",
        ["aspect", "farthest", "sd", "p99", "sd", "centroid", "sd"],
        rows,
    )
    flumes = [[measures.summary(run) for run in found] for found in by_scene[len(paper.COLUMNS) :]]
    print_table(
        f"Flume, {title}: change and standard deviation, in %",
        ["measure", *(cell for name in FLUMES for cell in (name, "sd"))],
        [[name, *(c for values in flumes for c in cells(values, name))] for name in MEASURES],
    )


if __name__ == "__main__":
    main()

"""How far the filling of a release decides what the reference solver says.

    python benchmarks/fillings.py

Points start on a lattice; real grains do not. The paper's six columns and its flume with three
layouts, each from the lattice and from several fillings whose points are moved off it at random:
what the mean over the fillings changes, and by how much they differ among each other (standard
deviation), in per cent of the lattice's value. A model that differs from the solver by less than
that cannot be told from it by that measure. Two layouts are compared on the lattice, so what the
change differs from one to the other is what their comparison may be off by: REPEATABILITY in
`design/wording.py`. Twenty CPU minutes, shared by the processes.

    python benchmarks/fillings.py --models column-2d

asks learned models of columns for the same columns from the same fillings, and says how far they
are off on the lattice, and in the mean over the fillings: five minutes.
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
parser.add_argument("--models", nargs="+", default=(), help="learned models of columns")

FLUME = Scene.from_toml(Path(__file__).parent.parent / "examples" / "flume.toml")
FLUMES = {
    "no baffles": FLUME.with_baffles([]),
    "paper's": FLUME,
    "tight row": FLUME.with_baffles([(0.757, 0.696), (0.757, 0.971), (0.757, 1.247)]),  # make demo
}
MEASURES = ("runout_max", "runout_p99", "centroid_travel", "upstream_depth", "mass_past_section")


def column_measures(trajectory: Trajectory) -> dict[str, float]:
    """Of a column: how far its farthest point, its last hundredth and its centroid went."""
    front, travelled = trajectory.scene.front, measures.centroid_over_time(trajectory)
    last = measures.front_over_time(trajectory, quantile=0.99)[-1]
    return {
        "farthest point": measures.normalised_runout(trajectory),
        "p99": last - front,
        "centroid": travelled[-1, 0] - travelled[0, 0],
    }


def cells(values: list[dict[str, float]], name: str) -> list[str]:
    """Change of the mean and standard deviation, of the first value; fillings follow it."""
    lattice, *rest = (value[name] for value in values)
    changes = 100 * (np.array(rest) / lattice - 1)
    return [f"{changes.mean():+.1f}", f"{changes.std(ddof=1):.1f}"]


def runs_of(
    name: str, scenes: list[Scene], arguments: argparse.Namespace
) -> list[list[Trajectory]]:
    """All scenes from the lattice, then from every filling."""
    ways = [(0.0, 0)] + [(arguments.jitter, k + 1) for k in range(arguments.fillings)]
    runs = []
    for jitter, filling in ways:
        simulator = load_simulator(name, workers=arguments.workers, jitter=jitter, filling=filling)
        runs.append(simulator.rollout(scenes))
        if name != "mpm":
            simulator.close()  # type: ignore[attr-defined]
    return runs


def held_against(
    references: list[list[Trajectory]],
    columns: list[Scene],
    title: str,
    arguments: argparse.Namespace,
) -> None:
    """Errors of learned models, lattice against lattice and mean against mean."""
    true = [[column_measures(trajectory) for trajectory in run] for run in references]
    for name in arguments.models:
        runs = runs_of(name, columns, arguments)
        found = [[column_measures(trajectory) for trajectory in run] for run in runs]
        rows = []
        for measure in true[0][0]:
            a, b = (
                np.array([[column[measure] for column in run] for run in some])
                for some in (found, true)
            )
            for start, error in (
                ("lattice", a[0] / b[0] - 1),
                ("mean of fillings", a[1:].mean(0) / b[1:].mean(0) - 1),
            ):
                cells = [f"{100 * e:+.1f}" for e in error]
                rows.append([measure, start, *cells, f"{100 * np.abs(error).mean():.1f}"])
        print_table(
            f"{name} against the solver, {title}: error of the travel, in %",
            ["measure", "start", *(f"a={c.aspect:g}" for c in paper.COLUMNS), "mean |.|"],
            rows,
        )


def main() -> None:
    arguments = parser.parse_args()
    title = f"{arguments.fillings} fillings, up to {arguments.jitter:g} spacings off the lattice"
    columns = [paper.column_scene(column) for column in paper.COLUMNS]
    if arguments.models:
        held_against(runs_of("mpm", columns, arguments), columns, title, arguments)
        return
    runs = runs_of("mpm", [*columns, *FLUMES.values()], arguments)
    by_scene = list(zip(*runs, strict=True))
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

"""How well does `column-2d-friction` know columns that nobody chose?

    python benchmarks/friction_columns.py [--model MODEL] [--count 25]

Columns of random width and aspect (0.4 to 2.5) at the paper's five friction angles, at rest against
a wall, by the reference solver at the model's spacing and by the model. Prints for each how far off
its farthest grain, the p99, the centroid's way and the mean height are, and the means of their
magnitudes.
"""

from __future__ import annotations

import argparse
import math
from typing import Any

import numpy as np

from gns_model import load_simulator, measures, paper
from gns_model.console import print_table
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--model", default="column-2d-friction")
parser.add_argument("--count", type=int, default=25)

#: Of the widths and heights [m]: two spacings of the models.
STEP = 0.025
COLUMNS = ("farthest grain", "p99", "centroid", "height")


def column(rng: np.random.Generator, angle: float) -> Scene:
    """A column of 0.03 to 0.10 m²."""
    aspect = math.exp(rng.uniform(math.log(0.4), math.log(2.5)))
    area = rng.uniform(0.03, 0.10)
    width = round(math.sqrt(area / aspect) / STEP) * STEP
    height = round(math.sqrt(area * aspect) / STEP) * STEP
    values = paper.column_scene(paper.COLUMNS[2], friction_angle=angle).to_dict()
    values["name"] = f"{angle:g}°, {width:.3f} x {height:.3f} m"
    values["domain"]["upper"] = [2.0, 0.8]
    values["release"][0].update(lower=[0.0, 0.0], upper=[width, height])
    values["duration"] = max(1.0, 5 * math.sqrt(height / 9.81))
    return Scene.from_dict(values)


def errors(found: Trajectory, true: Trajectory) -> np.ndarray:
    """Of `COLUMNS`, relative: the p99 and the centroid to the way that they make, shape (4,)."""
    begun, wanted, got = true.positions[0], true.positions[-1], found.positions[-1]
    reach, p99 = np.quantile(wanted[:, 0], 0.99), np.quantile(got[:, 0], 0.99)
    way = wanted[:, 0].mean() - begun[:, 0].mean()
    return np.array(
        [
            measures.normalised_runout(found) / measures.normalised_runout(true) - 1,
            (p99 - reach) / (reach - begun[:, 0].max()),
            (got[:, 0].mean() - wanted[:, 0].mean()) / way,
            got[:, 1].mean() / wanted[:, 1].mean() - 1,
        ]
    )


def main() -> None:
    arguments = parser.parse_args()
    model: Any = load_simulator(arguments.model)
    solver = load_simulator("mpm", spacing=model.config.spacing, frame_interval=model.config.dt)
    rng = np.random.default_rng(77)
    rows, found = [], []
    for k in range(arguments.count):
        scene = column(rng, paper.FRICTION_ANGLES[k % len(paper.FRICTION_ANGLES)])
        [true], [flow] = solver.rollout([scene]), model.rollout([scene])
        found.append(errors(flow, true))
        rows.append([scene.name, *(f"{e:+.1%}" for e in found[-1])])
    rows.append(["mean magnitude", *(f"{e:.1%}" for e in np.abs(found).mean(0))])
    print_table(f"{arguments.model} on unseen columns", ["", *COLUMNS], rows)


if __name__ == "__main__":
    main()

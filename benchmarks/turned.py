"""Turned baffles, which no shipped model has seen: the learned simulator against the solver.

    python benchmarks/turned.py

The paper's three baffles turned by 0, 20 and 45 degrees, and a wall of 0.6 m across the flow by 0
and 30: centroid travel by both, the model's error, and what turning does by each. The solver takes
some 35 CPU seconds a scene.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

from gns_model import load_simulator, measures
from gns_model.console import print_table
from gns_model.scene import Scene

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--model", default="baffle-lite", help="a shipped model or a path")

FLUME = Path(__file__).parent.parent / "examples" / "flume.toml"
WALL = [{"center": [0.8, 1.0], "size": [0.10, 0.30, 0.60]}]


def scenes() -> list[tuple[str, float, Scene]]:
    """Name, degrees and scene of every case; the first of a name is not turned."""
    flume = Scene.from_toml(FLUME)
    values = flume.to_dict()
    found = []
    for name, baffles, angles in (
        ("the paper's three", values["baffle"], (0.0, 20.0, 45.0)),
        ("a wall of 0.6 m", WALL, (0.0, 30.0)),
    ):
        for angle in angles:
            turned = [{**b, "yaw": angle} for b in baffles]
            found.append((name, angle, Scene.from_dict({**values, "baffle": turned})))
    return found


def main() -> None:
    warnings.simplefilter("ignore")  # the model says of every scene that it never saw it
    arguments = parser.parse_args()
    cases = scenes()
    travel = [
        [
            measures.summary(t)["centroid_travel"]
            for t in load_simulator(name).rollout([scene for *_, scene in cases])
        ]
        for name in ("mpm", arguments.model)
    ]
    straight: dict[str, tuple[float, float]] = {}
    rows = []
    for (name, angle, _), true, found in zip(cases, *travel, strict=True):
        first = straight.setdefault(name, (true, found))
        turning = "" if angle == 0 else f"{true - first[0]:+.4f}, {found - first[1]:+.4f}"
        rows.append(
            [name, f"{angle:g}", f"{true:.4f}", f"{found:.4f}", f"{found / true - 1:+.1%}", turning]
        )
    print_table(
        "Centroid travel [m] with turned baffles",
        ["", "degrees", "mpm", arguments.model, "error", "turning: mpm, model [m]"],
        rows,
    )


if __name__ == "__main__":
    main()

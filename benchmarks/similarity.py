"""A site of another size: is a flow at λ times the lengths the same flow (Froude similarity)?

    python benchmarks/similarity.py --lengths 4 10

The reference solver runs the paper's flume with all lengths, and the spacing of its points, λ times
as large, speeds and times √λ times, and prints what it measures over λ beside the flume itself.
Once with the stiffness λ times as large, which is the same problem but for the damping of the
solver, and once with that of the flume, as the grains are the same on a larger site. Some 35 CPU
seconds a flow.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

from gns_model import load_simulator, measures
from gns_model.console import print_table
from gns_model.scene import Scene

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--lengths", type=float, nargs="+", default=[4.0, 10.0], help="λ, each")

FLUME = Path(__file__).parent.parent / "examples" / "flume.toml"
#: What is read off [m or a share of the mass]; depths are read in windows of a fixed length.
READ = {"centroid_travel": 1, "runout_p99": 1, "mass_past_section": 0}


def enlarged(scene: Scene, lengths: float, stiffer: float) -> Scene:
    """`scene` with all lengths times `lengths`, and its stiffness times `stiffer`."""
    values = scene.to_dict()
    times = math.sqrt(lengths)

    def scale(box: dict[str, Any], *keys: str) -> dict[str, Any]:
        return {**box, **{k: [lengths * v for v in box[k]] for k in keys}}

    values["domain"] = scale(values["domain"], "lower", "upper")
    values["release"] = [
        {**scale(r, "lower", "upper"), "velocity": [times * v for v in r["velocity"]]}
        for r in values["release"]
    ]
    values["baffle"] = [scale(b, "center", "size") for b in values["baffle"]]
    values["duration"] *= times
    values["section"] *= lengths
    values["material"]["youngs_modulus"] *= stiffer
    values.pop("placement", None)
    return Scene.from_dict(values)


def main() -> None:
    arguments = parser.parse_args()
    flume = Scene.from_toml(FLUME)
    cases = [("the flume", 1.0, 1.0)]
    for lengths in arguments.lengths:
        cases += [
            (f"{lengths:g} times, as much stiffer", lengths, lengths),
            (f"{lengths:g} times, the same stiffness", lengths, 1.0),
        ]
    rows, first = [], {}
    for name, lengths, stiffer in cases:
        solver = load_simulator(
            "mpm", spacing=lengths * 0.015625, frame_interval=0.01 * math.sqrt(lengths)
        )
        [flow] = solver.rollout([enlarged(flume, lengths, stiffer)])
        found = measures.summary(flow)
        cells = []
        for key, power in READ.items():
            value = found[key] / lengths**power
            cells.append(f"{value:.4f} ({value / first.setdefault(key, value) - 1:+.1%})")
        rows.append([name, *cells])
    print_table("Measures over λ", ["", *(k.replace("_", " ") for k in READ)], rows)


if __name__ == "__main__":
    main()

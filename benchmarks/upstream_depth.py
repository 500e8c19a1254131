"""What decides the peak upstream depth of the paper's flume (nearly 0.3 m there)?

Runs the flume with one thing changed at a time and prints the depth by three definitions.
`python benchmarks/upstream_depth.py` (some 5 CPU minutes; `--quick` on coarse points)."""

from __future__ import annotations

import argparse

from gns_model import measures, paper
from gns_model.mpm import MpmSimulator

#: (window along x [m], quantile of heights): the default measure, a long window, the highest point.
DEFINITIONS = {
    "0.05 m, 98%": (0.05, 0.98),
    "0.10 m, 98%": (0.10, 0.98),
    "0.05 m, highest": (0.05, 1.0),
}


def friction(base=0.7, baffles=0.7):
    """The flume with other Coulomb coefficients, until after the peak."""
    scene = paper.flume_scene()
    changed = scene.friction.model_copy(update={"base": base, "baffles": baffles})
    return scene.replace(friction=changed, duration=0.5)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="twice the spacing everywhere")
    spacing = 0.015625 * (2 if parser.parse_args().quick else 1)
    cases = {
        "as the paper says": (friction(), spacing),
        "baffles without friction": (friction(baffles=0.0), spacing),
        "base friction 0.5": (friction(base=0.5), spacing),
        "points 1.5 times as far apart": (friction(), spacing * 1.5),
        "points 0.75 times as far apart": (friction(), spacing * 0.75),
    }
    print(f"{'':32s}" + "".join(f"{name:>18s}" for name in DEFINITIONS))
    for name, (scene, points) in cases.items():
        trajectory = MpmSimulator(spacing=points).rollout([scene])[0]
        depths = [
            measures.upstream_depth_over_time(trajectory, window=w, quantile=q).max()
            for w, q in DEFINITIONS.values()
        ]
        print(f"{name:32s}" + "".join(f"{d:17.3f}m" for d in depths), flush=True)


if __name__ == "__main__":
    main()

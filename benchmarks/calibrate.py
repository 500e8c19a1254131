"""Inverse problems: what velocity, or what friction angle, made this deposit?

    python benchmarks/calibrate.py [--only velocity|friction]

The release velocity of the flume by baffle-lite, and the friction angle of a small column by
column-2d-friction. Every target is made twice: by the model itself (an identical twin: what the
search can do) and by the reference solver (what the model's own error makes of it). Every one is
searched by gradient and by forward differences under the same stopping rule, and every rollout and
backward pass is counted as it is run. Ends with 1 if a twin's value is not found again, or if a
search ends further from its target than it began.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from design.inverse import Found, calibrate
from design.target import read_deposit
from design.unknowns import Parameter, unknown
from gns_model import load_simulator
from gns_model.scene import Release, Scene

EXAMPLES = Path(__file__).parents[1] / "examples"


@dataclass(frozen=True)
class Case:
    """A parameter of a scene, from where it is looked for, and what counts as found again.

    `changes` to the scene keep the search to minutes.
    """

    scene: str
    model: str
    start: tuple[float, ...]
    enough: float
    changes: dict[str, Any] = field(default_factory=dict)


CASES: dict[Parameter, Case] = {
    "velocity": Case("flume.toml", "baffle-lite", (1.4, 0.0), 0.02),
    "friction": Case(
        "columns/a-1.0.toml",
        "column-2d-friction",
        (24.0,),
        0.3,
        {"duration": 0.5, "releases": (Release(lower=(0, 0), upper=(0.2, 0.2), velocity=(0, 0)),)},
    ),
}


def search(parameter: Parameter, case: Case, folder: Path) -> bool:
    """Print what is found for every target and method; whether that is as it should be."""
    true = Scene.from_toml(EXAMPLES / case.scene).replace(**case.changes)
    model: Any = load_simulator(case.model)
    solver = load_simulator("mpm", spacing=model.config.spacing, threads=1)
    good = True
    for by in (model, solver):
        path = folder / f"{parameter}-{by.name}.h5"
        by.rollout([true])[0].save(path)
        target, time = read_deposit(path, true)
        wanted = unknown(parameter, true, target)
        truth = wanted.start(true)
        start = wanted.put(true, np.array(case.start)).replace(duration=time)
        for method in ("gradient", "differences"):
            found = calibrate(start, model, target, parameter, method=method)  # type: ignore[arg-type]
            _tell(parameter, by.name, method, found, truth, wanted.unit)
            twin = by is model
            good &= found.distance < found.start_distance
            good &= not twin or bool(np.abs(found.value - truth).max() <= case.enough)
    return good


def _tell(parameter: str, by: str, method: str, found: Found, truth: np.ndarray, unit: str) -> None:
    value, true, began = (
        "(" + ", ".join(f"{v:.3f}" for v in vector) + ")"
        for vector in (found.value, truth, found.start)
    )
    print(
        f"{parameter} from a deposit by {by}, {method} ({found.method} in the end): {value} "
        f"{unit}, true {true}, from {began}; {1000 * found.start_distance:.1f} -> "
        f"{1000 * found.distance:.1f} mm; {found.evaluations} values, {found.rollouts} rollouts, "
        f"{found.backwards} backward passes, {found.seconds:.0f} s; {found.status}",
        flush=True,
    )


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=list(CASES), help="one of the two; default: both")
    only = parser.parse_args().only
    chosen = [only] if only else list(CASES)
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        good = [search(name, CASES[name], Path(folder)) for name in chosen]
    print("found again" if all(good) else "NOT found again")
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())

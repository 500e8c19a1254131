"""The same columns from starts off their lattice: what of a runout is the filling's doing.

Real grains stand on no lattice, and where the farthest of them comes to rest is a matter of chance
by some per cent (`benchmarks/fillings.py`). A model is held against the solver filling by filling,
both from the same points where their spacings are the same, and the means are compared.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gns_model import measures
from gns_model.errors import SimulatorError
from gns_model.scene import Scene
from gns_model.simulator import Simulator
from gns_model.suites.collapse import runout_aims
from gns_model.suites.pair import Pair, relative, simulate
from gns_model.suites.result import Aim, Row
from gns_model.suites.setup import Setup

#: How far points are moved off their lattice along each axis, in spacings.
JITTER = 0.25

SHOWN = (
    ("fillings_mpm", "fillings: our MPM", ".3f"),
    ("fillings_mpm_sd", "its sd", ".3f"),
    ("fillings", "learned", ".3f"),
    ("fillings_error", "error", "+.1%"),
    ("fillings_centroid_error", "centroid", "+.1%"),
)


def simulate_fillings(
    simulator: Simulator, scenes: Sequence[Scene], setup: Setup
) -> list[tuple[Pair, ...]]:
    """Of every scene a pair for each of `setup.fillings` fillings, none if that is 0.

    Raises:
        SimulatorError: if the simulator cannot start from another filling, or cannot run a scene.
    """
    if not setup.fillings:
        return [() for _ in scenes]
    if not hasattr(simulator, "refilled"):
        raise SimulatorError(
            f"{simulator.name} cannot start from another filling: it has no method `refilled`"
        )
    runs = []
    for filling in range(1, setup.fillings + 1):
        other = simulator.refilled(JITTER, filling)
        runs.append(simulate(other, scenes, setup, jitter=JITTER, filling=filling))
        if hasattr(other, "close"):
            other.close()
    return list(zip(*runs, strict=True))


def filling_columns(pairs: Sequence[Pair]) -> Row:
    """Mean runouts of one column over its fillings and the error between them; the standard
    deviation tells by how much one filling of the solver's differs from another."""
    if not pairs:
        return {}
    learned = [measures.normalised_runout(pair.predicted) for pair in pairs]
    solved = [measures.normalised_runout(pair.reference) for pair in pairs]
    centroids = (
        float(np.mean([measures.centroid_travel(trajectory) for trajectory in some]))
        for some in zip(*((pair.predicted, pair.reference) for pair in pairs), strict=True)
    )
    mean, true = float(np.mean(learned)), float(np.mean(solved))
    return {
        "fillings_mpm": true,
        "fillings_mpm_sd": float(np.std(solved, ddof=1)) if len(solved) > 1 else None,
        "fillings": mean,
        "fillings_error": relative(mean, true),
        "fillings_centroid_error": relative(*centroids),
    }


def filling_aims(rows: Sequence[Row], pairs: Sequence[Sequence[Pair]], over: str) -> list[Aim]:
    """The aims of the runouts, for the means over fillings; none if there are no fillings."""
    if not pairs or not pairs[0]:
        return []
    return runout_aims(
        rows,
        [pair for some in pairs for pair in some],
        f"{over}, means of {len(pairs[0])} fillings",
        "fillings_error",
    )

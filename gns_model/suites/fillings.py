"""The same columns from several fillings: what of a runout is the filling's doing.

Where the farthest grain comes to rest is a matter of chance by some per cent
(`benchmarks/fillings.py`), and a lattice, on which no real grain stands, is one chance among them.
A model is held against the solver filling by filling, both from the same points where their
spacings are the same, and the means are compared. The paper's authors shake their points, too: by
up to 0.35 to 0.45 spacings (yjchoi1/gns-mpm, `mpm_input_gen`, `randomness` 0.7 to 0.9).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gns_model import measures
from gns_model.errors import SimulatorError
from gns_model.scene import Scene
from gns_model.simulator import Simulator, can_refill
from gns_model.suites.collapse import collapse_row, runout_aims
from gns_model.suites.pair import RUNOUTS, Pair, outside, relative, simulate
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

_FIRST, *_REST = RUNOUTS


@dataclass(frozen=True)
class Starts:
    """Some columns, each from its usual start and from other fillings.

    Attributes:
        pairs: from the start that the simulator chooses, one a scene.
        fillings: of every scene a pair for each filling; empty where none were asked for.
        warnings: what the model was not trained for.
    """

    pairs: list[Pair]
    fillings: list[tuple[Pair, ...]]
    warnings: list[str]

    @classmethod
    def simulate(cls, simulator: Simulator, scenes: Sequence[Scene], setup: Setup) -> Starts:
        """Run simulator and reference from the usual start and from `setup.fillings` others.

        Raises:
            SimulatorError: if the simulator cannot start from another filling, or cannot run a
                scene.
            SceneError: if one of them cannot run a scene.
        """
        pairs, warnings = simulate(simulator, scenes, setup), outside(simulator, scenes)
        if not setup.fillings:
            return cls(pairs, [() for _ in scenes], warnings)
        if not can_refill(simulator):
            raise SimulatorError(
                f"{simulator.name} cannot start from another filling: it has no method `refilled`"
            )
        runs = []
        for filling in range(1, setup.fillings + 1):
            other = simulator.refilled(JITTER, filling)
            runs.append(simulate(other, scenes, setup, jitter=JITTER, filling=filling))
            warnings += [line for line in outside(other, scenes) if line not in warnings]
            if hasattr(other, "close"):
                other.close()
        return cls(pairs, list(zip(*runs, strict=True)), warnings)

    @property
    def count(self) -> int:
        """Number of fillings."""
        return len(self.fillings[0])

    def row(self, scene: int) -> Row:
        """What a table says of one scene: of its usual start, and of its fillings, if any."""
        return {**collapse_row(self.pairs[scene]), **filling_columns(self.fillings[scene])}

    def shown(self, *closing: tuple[str, str, str]) -> tuple[tuple[str, str, str], ...]:
        """Columns of a table: the runouts, and `closing` where fillings do not fill the line."""
        if not self.count:
            return (*RUNOUTS, *closing)
        key, heading, form = _FIRST
        return (*SHOWN, (key, f"one start: {heading}", form), *_REST)

    @property
    def key(self) -> str:
        """The error that is judged: of the means, where there are fillings."""
        return "fillings_error" if self.count else "runout_error"

    @property
    def judged(self) -> str:
        """What the name of an aim says about that."""
        return f", means of {self.count} fillings" if self.count else ""

    def aims(self, rows: Sequence[Row], over: str) -> list[Aim]:
        """The aims of the runouts in `rows`."""
        pairs = [pair for some in self.fillings for pair in some] or self.pairs
        return runout_aims(rows, pairs, f"{over}{self.judged}", self.key)


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

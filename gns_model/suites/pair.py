"""One scene twice, by a simulator and by the reference, and what is read off the two."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from gns_model import measures
from gns_model.scene import Scene
from gns_model.simulator import Simulator
from gns_model.suites.reference import references
from gns_model.suites.setup import Setup, stride
from gns_model.trajectory import OK, Trajectory

#: What tables of columns show: (entry of a row, heading, format).
RUNOUTS = (
    ("runout_mpm", "our MPM", ".3f"),
    ("runout", "learned", ".3f"),
    ("runout_error", "error", "+.1%"),
    ("centroid_error", "centroid", "+.1%"),
)
PAPERS_RUNOUTS = (
    ("paper_mpm", "paper's MPM", ".3f"),
    ("paper_gns", "paper's GNS", ".3f"),
    ("paper_error", "its error", "+.1%"),
)
CLOSING = (
    ("position_mse", "position MSE [m²]", ".1e"),
    ("seconds", "seconds", ".1f"),
    ("status", "status", "s"),
)


@dataclass(frozen=True)
class Pair:
    """A prediction and its reference."""

    predicted: Trajectory
    reference: Trajectory

    @property
    def scene(self) -> Scene:
        """What both simulated."""
        return self.reference.scene

    @property
    def good(self) -> bool:
        """Whether the prediction came to its end."""
        return self.predicted.status == OK

    def both(self) -> tuple[tuple[str, Trajectory], tuple[str, Trajectory]]:
        """The two with the suffix that their columns have in a table."""
        return ("", self.predicted), ("_mpm", self.reference)

    def facts(self) -> dict[str, object]:
        """Columns that every table of pairs ends with."""
        return {
            "status": self.predicted.status,
            "points": int(self.predicted.positions.shape[1]),
            "points_mpm": int(self.reference.positions.shape[1]),
            "seconds": self.predicted.settings.get("seconds"),
            "seconds_mpm": self.reference.settings.get("seconds"),
        }


def simulate(
    simulator: Simulator,
    scenes: Sequence[Scene],
    setup: Setup,
    *,
    jitter: float | None = None,
    filling: int = 0,
) -> list[Pair]:
    """Run the simulator and, where it is not kept already, the reference on every scene.

    Args:
        jitter, filling: of the reference, see `mpm.problem.Discretisation`; default: as the
            simulator fills its own starts.

    Raises:
        SimulatorError, SceneError: if one of them cannot run a scene.
    """
    for scene in scenes:
        simulator.check(scene)
    if jitter is None:
        jitter = getattr(simulator, "jitter", 0.0)
        filling = getattr(simulator, "filling", 0) if jitter else 0
    true = references(
        scenes,
        setup.out,
        interval=stride(simulator),
        spacing=setup.spacing,
        threads=setup.threads,
        jitter=jitter,
        filling=filling,
        stage=setup.stage,
    )
    progress = setup.stage(f"{simulator.name}, {len(scenes)} scene{'s' * (len(scenes) > 1)}")
    predicted = simulator.rollout(list(scenes), progress=progress)
    progress(1.0)
    return [Pair(p, r) for p, r in zip(predicted, true, strict=True)]


def outside(simulator: Simulator, scenes: Sequence[Scene]) -> list[str]:
    """A sentence for every limit of the simulator's training that a scene passes, none repeated."""
    broken = getattr(simulator, "outside", None)
    if broken is None:
        return []
    first: dict[str, str] = {}
    for scene in scenes:
        for line in broken(scene):
            first.setdefault(line, scene.name)
    return [
        f"scene {name!r} is outside what {simulator.name} was trained on: {line}"
        for line, name in first.items()
    ]


def relative(value: float, true: float) -> float:
    """Signed error of `value` in shares of `true` [-]; nan if that is 0."""
    return (value - true) / abs(true) if true else math.nan


def squared_errors(pair: Pair) -> np.ndarray:
    """|p - p_reference|^2 of every point over time [m^2], shape (T, N), at the prediction's times.

    A point is held against the reference's point nearest to it at the start, by displacement:
    where both fill the scene alike these are the same points and this is the paper's squared
    error. The reference is interpolated linearly between its frames.
    """
    ours = measures.moving_positions(pair.predicted)
    theirs = measures.moving_positions(pair.reference)
    _, nearest = cKDTree(theirs[0]).query(ours[0])
    last = len(theirs) - 1
    place = np.interp(pair.predicted.time, pair.reference.time, np.arange(last + 1))
    errors = np.empty(ours.shape[:2])
    for t, where in enumerate(place):
        k = min(int(where), last)
        share = where - k
        there = theirs[k].astype(float) - theirs[0]
        if share > 0:
            there += share * (theirs[k + 1] - theirs[k])
        difference = (ours[t].astype(float) - ours[0]) - there[nearest]
        errors[t] = np.square(difference).sum(axis=1)
    return errors


def energies(trajectory: Trajectory) -> dict[str, np.ndarray]:
    """Potential, kinetic and dissipated energy over time, in shares of the first frame's sum [-].

    E_p = sum m g h, E_k = 1/2 sum m v^2, E_d = E_0 - E_p - E_k with E_0 = E_p(0) + E_k(0); of a
    column at rest E_0 is its potential energy (Choi & Kumar). Each has shape (T,).
    """
    potential = measures.potential_energy(trajectory)
    kinetic = measures.kinetic_energy(trajectory)
    whole = potential[0] + kinetic[0]
    return {
        "potential": potential / whole,
        "kinetic": kinetic / whole,
        "dissipated": 1 - (potential + kinetic) / whole,
    }


def at_times(trajectory: Trajectory, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """`values` (T,) of the frames of `trajectory`, linear at `times` [s]."""
    return np.interp(times, trajectory.time, values)

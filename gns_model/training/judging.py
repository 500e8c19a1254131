"""What a rollout is judged by: measures that mean something in its scene, against the solver's.

A flow among barriers is read by how far it went and how deep it stood; a column has nothing to
stand against and is read by the paper's runout, its farthest point. Both by their energies.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from gns_model import measures
from gns_model.scene import Scene
from gns_model.trajectory import OK, Trajectory

#: Measures that a model is judged by, the relative error that counts as 1, and the smallest true
#: value that an error is relative to (a share of mass may be zero). "energy" is `energy_error`.
AIMS: dict[str, tuple[float, float]] = {
    "runout_max": (0.03, 0.05),
    "centroid_travel": (0.01, 0.05),
    "runout_p99": (0.025, 0.05),
    "upstream_depth": (0.08, 0.02),
    "mass_past_section": (0.15, 0.02),
    "energy": (0.05, 0.05),
}

#: The error of a rollout that diverged, and the most that any counts for.
WORST = 1.0


def judged_by(scene: Scene) -> tuple[str, ...]:
    """Names of the measures that a rollout of `scene` is judged by, the leading one first.

    Without barriers there is no upstream depth, and without a named section no mass past it.
    """
    if not scene.baffles and scene.placement is None:
        return ("runout_max", "centroid_travel", "energy")
    return ("centroid_travel", "runout_p99", "upstream_depth", "mass_past_section", "energy")


def judged_by_all(scenes: Iterable[Scene]) -> tuple[str, ...]:
    """Names for a set of scenes, each once, those of the first scene first."""
    return tuple(dict.fromkeys(name for scene in scenes for name in judged_by(scene)))


@dataclass(frozen=True)
class Facts:
    """What is read off one trajectory.

    Attributes:
        measures: `measures.summary`.
        energies: E_p and E_k of a kilogram at every frame [J/kg], shape (T, 2).
    """

    measures: dict[str, float]
    energies: np.ndarray

    @classmethod
    def of(cls, trajectory: Trajectory, stride: int = 1) -> Facts:
        """The facts of `trajectory`; energies of every `stride`-th frame only.

        Velocities are differences between frames, so that energies compare at equal intervals.
        """
        kept = replace(
            trajectory, positions=trajectory.positions[::stride], time=trajectory.time[::stride]
        )
        mass = trajectory.point_mass * measures.moving_positions(kept).shape[1]
        energies = [measures.potential_energy(kept), measures.kinetic_energy(kept)]
        return cls(measures.summary(trajectory), np.stack(energies, axis=1) / mass)


def energy_error(found: np.ndarray, truth: np.ndarray) -> float:
    """Mean over time of |E_p - E_p'| + |E_k - E_k'|, relative to the energy that is dissipated.

    Args:
        found, truth: as `Facts.energies`, shape (T, 2); the shorter of both counts.
    """
    frames = min(len(found), len(truth))
    difference = np.abs(found[:frames] - truth[:frames]).sum(axis=1).mean()
    dissipated = truth[0].sum() - truth.sum(axis=1).min()
    return float(difference / max(dissipated, AIMS["energy"][1]))


def errors(names: Iterable[str], truth: Facts, result: Trajectory) -> dict[str, float]:
    """Relative error of `result` in each of `names`, at most WORST, which a divergence counts."""
    if result.status != OK:
        return dict.fromkeys(names, WORST)
    found, out = Facts.of(result), {}
    for name in names:
        if name == "energy":
            error = energy_error(found.energies, truth.energies)
        else:
            true = truth.measures[name]
            error = abs(found.measures[name] - true) / max(abs(true), AIMS[name][1])
        out[name] = min(WORST, error)
    return out

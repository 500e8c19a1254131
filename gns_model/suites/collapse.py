"""A column that collapses, as the paper reads it: runout, height and energy against t / tau_c."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gns_model import measures
from gns_model.paper import Column
from gns_model.suites.pair import Pair, at_times, energies, relative, squared_errors
from gns_model.suites.result import Aim, Row
from gns_model.trajectory import Trajectory

#: Aims for the runout of unseen columns: of every one, and on average [-].
RUNOUT_AIM, MEAN_RUNOUT_AIM = 0.05, 0.03


def critical_time(trajectory: Trajectory) -> float:
    """tau_c = sqrt(H_0 / g) [s], by which the flow is fully mobilised (Choi & Kumar)."""
    scene = trajectory.scene
    height = max(release.upper[1] for release in scene.releases) - scene.base
    return math.sqrt(height / math.hypot(*scene.gravity))


def runout_over_time(trajectory: Trajectory) -> np.ndarray:
    """(L_t - L_0) / L_0 of a column against the left wall [-], shape (T,).

    L_t reaches to the farthest material point and L_0 is the nominal length, so that the first
    value is not 0 but minus half a spacing over L_0. The last is `measures.normalised_runout`.
    """
    wall = trajectory.scene.domain.lower[0]
    length = trajectory.scene.front - wall
    return (measures.front_over_time(trajectory) - wall - length) / length


def height_over_time(trajectory: Trajectory) -> np.ndarray:
    """H_t / L_0 of a column against the left wall [-], shape (T,)."""
    length = trajectory.scene.front - trajectory.scene.domain.lower[0]
    return measures.height_over_time(trajectory) / length


def collapse_row(pair: Pair) -> Row:
    """Runout and what else there is to say of one column, learned and by our own solver."""
    row: Row = {
        "runout": measures.normalised_runout(pair.predicted),
        "runout_mpm": measures.normalised_runout(pair.reference),
    }
    row["runout_error"] = relative(row["runout"], row["runout_mpm"])
    row["centroid_error"] = relative(*(measures.centroid_travel(t) for _, t in pair.both()))
    for suffix, trajectory in pair.both():
        row[f"height{suffix}"] = float(height_over_time(trajectory)[-1])
        row[f"dissipated{suffix}"] = float(energies(trajectory)["dissipated"][-1])
    mean = squared_errors(pair).mean(axis=1)
    row["position_mse"] = float(mean[-1])
    row["position_mse_peak"] = float(mean.max())
    return row


def paper_columns(column: Column) -> Row:
    """What the paper says of a column: its MPM, its GNS, and the error of the second."""
    return {
        "paper_mpm": column.runout_mpm,
        "paper_gns": column.runout_gns,
        "paper_error": relative(column.runout_gns, column.runout_mpm),
    }


def collapse_curves(pair: Pair, **labels: float) -> list[Row]:
    """Runout, height, energies and position error of one column over time, a row a frame."""
    time = np.asarray(pair.predicted.time, float)
    columns: dict[str, np.ndarray] = {
        "time": time,
        "t_over_tau": time / critical_time(pair.reference),
    }
    for name, curve in (("runout", runout_over_time), ("height", height_over_time)):
        for suffix, trajectory in pair.both():
            columns[name + suffix] = at_times(trajectory, curve(trajectory), time)
    for suffix, trajectory in pair.both():
        for name, values in energies(trajectory).items():
            columns[name + suffix] = at_times(trajectory, values, time)
    columns["position_mse"] = squared_errors(pair).mean(axis=1)
    names = list(columns)
    return [
        {**labels, **{name: float(columns[name][t]) for name in names}} for t in range(len(time))
    ]


def runout_aims(
    rows: Sequence[Row], pairs: Sequence[Pair], over: str, key: str = "runout_error"
) -> list[Aim]:
    """The aims for the errors `key` in `rows`; a rollout that diverged misses both."""
    errors = [abs(row[key]) for row in rows]
    good = all(pair.good for pair in pairs)
    return [
        Aim(f"runout error, the largest over {over}", max(errors) if good else None, RUNOUT_AIM),
        Aim(
            f"runout error, mean over {over}",
            float(np.mean(errors)) if good else None,
            MEAN_RUNOUT_AIM,
        ),
    ]

"""The paper's flume: runout, upstream depth and energy over time, with its three baffles."""

from __future__ import annotations

import math

import numpy as np

from gns_model import measures, paper
from gns_model.scene import Scene
from gns_model.simulator import Simulator
from gns_model.suites import flume_figures, frames
from gns_model.suites.pair import (
    Pair,
    at_times,
    energies,
    outside,
    relative,
    simulate,
    squared_errors,
)
from gns_model.suites.result import Aim, Row, SuiteResult
from gns_model.suites.setup import Setup
from gns_model.trajectory import Trajectory

FRONT_AIM, CENTROID_AIM, DEPTH_AIM = 0.05, 0.02, 0.08

#: The front of as many points of the solver as the model has.
ALIKE = "front of as many points"

#: Times of the paper's pictures of the flow [s]; the last frame follows.
TIMES = (0.0, 0.15, 0.34, 0.63)

SHOWN = (
    ("measure", "at the end, or the peak", "s"),
    ("mpm", "our MPM", ".3f"),
    ("learned", "learned", ".3f"),
    ("error", "error", "+.1%"),
    ("most_off", "most off over time", ".3f"),
    ("unit", "unit", "s"),
)


def run(simulator: Simulator, setup: Setup) -> SuiteResult:
    """Roll out the paper's flume, 0.9 s.

    Raises:
        SimulatorError, SceneError: if the simulator cannot run it.
    """
    (pair,) = simulate(simulator, [paper.flume_scene()], setup)
    time = np.asarray(pair.predicted.time, float)
    points = min(t.positions.shape[1] for _, t in pair.both())
    curves = {
        key: at_times(trajectory, values, time)
        for suffix, trajectory in pair.both()
        for key, values in over_time(trajectory, points, suffix).items()
    }
    curves["position_mse"] = squared_errors(pair).mean(axis=1)
    rows = table(curves, row_count(pair.scene))
    by_measure = {row["measure"]: row for row in rows}
    aims = [
        _aim(by_measure["front"], "front runout error", FRONT_AIM, pair),
        _aim(by_measure[ALIKE], "front runout error, of as many points", FRONT_AIM, pair),
        _aim(by_measure["centroid"], "centroid travel error", CENTROID_AIM, pair),
        *(
            _aim(row, f"peak upstream depth error, {row['measure'][6:]}", DEPTH_AIM, pair)
            for row in rows
            if row["measure"].startswith("depth ")
        ),
    ]
    table_of_curves = [
        {"time": float(t), **{key: float(values[k]) for key, values in curves.items()}}
        for k, t in enumerate(time)
    ]
    out, name = setup.out, simulator.name
    flume_figures.evolution(table_of_curves, pair, name, out / "flume.png")
    times = [t for t in TIMES if t < time[-1]] + [float(time[-1])]
    frames.plan_views(pair, times, name, out / "flume-frames.png")
    return SuiteResult(
        suite="flume",
        title=f"The paper's flume with three baffles: {name} beside our MPM",
        rows=rows,
        warnings=outside(simulator, [pair.scene]),
        shown=SHOWN,
        aims=aims,
        facts={**pair.facts(), **arrivals(pair)},
        notes=[
            "Upstream depth by measures.upstream_depth_over_time (window 0.05 m, 98% of the "
            "heights), the deepest baffle of a row. Energy held back: E_p + E_k of what is "
            "upstream of the first row minus that of what is past the last, in shares of E_0.",
            "The front is the farthest point, and that of fewer points is less far: so it is told "
            "for as many of the solver's points as the model has, too.",
        ],
        curves={"flume-curves": table_of_curves},
        files=["flume.png", "flume-frames.png"],
    )


def baffle_rows(scene: Scene) -> list[list[int]]:
    """Indices of the baffles of every row, rows by their upstream face, first row first."""
    faces = scene.baffle_boxes()[:, 0, 0]
    return [np.flatnonzero(np.isclose(faces, x)).tolist() for x in np.unique(np.round(faces, 6))]


def row_count(scene: Scene) -> int:
    """Number of rows of baffles."""
    return len(baffle_rows(scene))


def over_time(trajectory: Trajectory, points: int, suffix: str = "") -> dict[str, np.ndarray]:
    """What the paper draws of a flume over time, each of shape (T,), keys ending in `suffix`; and
    the front of `points` of its points."""
    centroid = measures.centroid_over_time(trajectory)[:, 0]
    alike = measures.thinned_front_over_time(trajectory, points)
    out = {
        "front": measures.runout_over_time(trajectory),
        "front_alike": alike - alike[0],
        "p99": measures.runout_over_time(trajectory, quantile=measures.FRONT_QUANTILE),
        "centroid": centroid - centroid[0],
    }
    depth = measures.upstream_depth_over_time(trajectory)
    for number, members in enumerate(baffle_rows(trajectory.scene), start=1):
        out[f"depth_row_{number}"] = depth[:, members].max(axis=1)
    out.update(energies(trajectory))
    out["held_back"] = held_back(trajectory)
    return {key + suffix: values for key, values in out.items()}


def held_back(trajectory: Trajectory) -> np.ndarray:
    """E_p + E_k upstream of the baffles minus that downstream of them, in shares of E_0, (T,).

    Choi & Kumar take this difference for the energy that the baffles dissipate. Upstream is where
    x lies before the face of the first row, downstream where it lies past the back of the last.
    """
    boxes = trajectory.scene.baffle_boxes()
    first, last = boxes[:, 0, 0].min(), boxes[:, 1, 0].max()
    positions = measures.moving_positions(trajectory)
    out = np.empty(len(positions))
    for t in range(len(positions)):
        energy, x = point_energies(trajectory, t), positions[t, :, 0]
        out[t] = energy[x < first].sum() - energy[x > last].sum()
    return out / point_energies(trajectory, 0).sum()


def point_energies(trajectory: Trajectory, t: int) -> np.ndarray:
    """E_p + E_k of every moving point in frame `t` [J], shape (N,).

    Velocities as in `measures.kinetic_energy`, heights as in `measures.potential_energy`, so that
    the sum over the points is the sum of those two.
    """
    scene, positions = trajectory.scene, measures.moving_positions(trajectory)
    time = np.asarray(trajectory.time, float)
    if t == 0:
        velocity = measures.release_velocity(scene, positions[0])
    else:
        after = min(t + 1, len(time) - 1)
        velocity = (positions[after] - positions[t - 1]).astype(float) / (time[after] - time[t - 1])
    arm = positions[t].astype(float) - np.array(scene.domain.lower)
    energy = 0.5 * np.square(velocity).sum(axis=1) - arm @ np.array(scene.gravity)
    return trajectory.point_mass * energy


def table(curves: dict[str, np.ndarray], rows_of_baffles: int) -> list[Row]:
    """Values at the end or at the peak, by both, with the errors."""

    def last(values: np.ndarray) -> float:
        return float(values[-1])

    def peak(values: np.ndarray) -> float:
        return float(values.max())

    entries = [
        ("front", "front", peak, "m"),
        (ALIKE, "front_alike", peak, "m"),
        ("p99", "p99", last, "m"),
        ("centroid", "centroid", last, "m"),
        *((f"depth row {n}", f"depth_row_{n}", peak, "m") for n in range(1, rows_of_baffles + 1)),
        ("kinetic energy, peak", "kinetic", peak, "E0"),
        ("potential energy", "potential", last, "E0"),
        ("dissipated energy", "dissipated", last, "E0"),
        ("energy held back by the baffles", "held_back", last, "E0"),
    ]
    out = []
    for measure, key, pick, unit in entries:
        learned, true = pick(curves[key]), pick(curves[f"{key}_mpm"])
        out.append(
            {
                "measure": measure,
                "mpm": true,
                "learned": learned,
                "error": relative(learned, true),
                "most_off": float(np.abs(curves[key] - curves[f"{key}_mpm"]).max()),
                "unit": unit,
            }
        )
    return out


def arrivals(pair: Pair) -> Row:
    """When the front meets the rows and the flow rests [s], None where it does not."""
    out: Row = {}
    boxes = pair.scene.baffle_boxes()
    for number, members in enumerate(baffle_rows(pair.scene), start=1):
        for suffix, trajectory in pair.both():
            face = float(boxes[members[0], 0, 0])
            out[f"row_{number}_arrival{suffix}"] = measures.arrival_time(trajectory, face)
    for suffix, trajectory in pair.both():
        out[f"rest{suffix}"] = measures.rest_time(trajectory)
        out[f"points_inside_baffles{suffix}"] = measures.points_inside_baffles(trajectory)
    return out


def _aim(row: Row, name: str, most: float, pair: Pair) -> Aim:
    error = abs(row["error"])
    return Aim(name, error if pair.good and math.isfinite(error) else None, most)

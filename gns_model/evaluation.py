"""Learned against reference: how well a simulator answers to the layout, and how far it is off.

A mean error of 1% hides a simulator that gives every layout the same answer (findings: one did).
So beside mean errors stand the slope of predicted on true, the rank correlation and the spread of
both over the scenes.

The truth of a scene is read off ALL points of its reference trajectory, also where the simulator
fills the scene with fewer. Points are compared by their displacement from the nearest reference
point at the start, and the deposits by the mass that would have to move to another cell.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table
from scipy.spatial import cKDTree
from scipy.stats import spearmanr

from gns_model import measures
from gns_model.errors import SimulatorError
from gns_model.files import write_whole
from gns_model.scene import Scene
from gns_model.simulator import Progress, Simulator, can_refill
from gns_model.trajectory import OK, Trajectory

#: The measures that are judged, and the least denominator of their relative error: below it a
#: share or a length is too small to divide by.
JUDGED = {
    "centroid_travel": 0.01,
    "runout_p99": 0.01,
    "upstream_depth": 0.02,
    "mass_past_section": 0.01,
}

#: What a shipped model aims at over unseen layouts: (least, most) of an entry of `aggregate`.
AIMS: dict[str, tuple[float, float]] = {
    "centroid_travel.error": (0.0, 0.01),
    "runout_p99.error": (0.0, 0.025),
    "upstream_depth.error": (0.0, 0.08),
    "mass_past_section.error": (0.0, 0.15),
    "centroid_travel.slope": (0.85, 1.15),
    "centroid_travel.spearman": (0.9, 1.0),
    "points_inside": (0.0, 0.0),
}

#: Edge of a cell of the deposit map [m]: several points of a coarse filling.
CELL = 0.05


@dataclass(frozen=True)
class SceneResult:
    """One scene, by the simulator (`predicted`) and by the reference (`true`).

    Attributes:
        scene: what was simulated.
        predicted, true: `measures.summary` of both.
        status: how the prediction ended.
        points: number of points of the prediction.
        points_inside: how many of them were ever inside a baffle.
        point_rmse: root mean square over points of the difference in final displacement [m].
        deposit_error: share of the mass that lies in another cell of the plan at the end [-].
        seconds, reference_seconds: of the rollouts [s]; the reference's None if not recorded.
        deposit, reference_deposit: mean depth in the cells of the plan [m], see `deposit_map`.
    """

    scene: Scene
    predicted: dict[str, float]
    true: dict[str, float]
    status: str
    points: int
    points_inside: int
    point_rmse: float
    deposit_error: float
    seconds: float
    reference_seconds: float | None
    deposit: np.ndarray = field(repr=False)
    reference_deposit: np.ndarray = field(repr=False)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers; the deposit maps are left out."""
        return {
            "scene": self.scene.name,
            "layout": [list(b.center) for b in self.scene.baffles],
            "predicted": self.predicted,
            "true": self.true,
            "status": self.status,
            "points": self.points,
            "points_inside": self.points_inside,
            "point_rmse": self.point_rmse,
            "deposit_error": self.deposit_error,
            "seconds": self.seconds,
            "reference_seconds": self.reference_seconds,
        }


@dataclass(frozen=True)
class Comparison:
    """A simulator against a reference over scenes. See `compare`."""

    simulator: str
    reference: str
    results: tuple[SceneResult, ...]

    def values(self, measure: str) -> tuple[np.ndarray, np.ndarray]:
        """Predicted and true values of a measure over the scenes, shape (S,) each."""
        pairs = [(r.predicted[measure], r.true[measure]) for r in self.results]
        predicted, true = np.array(pairs).T
        return predicted, true

    def aggregate(self) -> dict[str, float | None]:
        """Errors over the scenes; None where too few scenes, or a constant, define nothing.

        `MEASURE.error` is the mean absolute relative error, `.bias` the mean signed one, `.slope`
        the least-squares slope of predicted on true, `.spearman` the rank correlation and `.spread`
        and `.spread_true` the standard deviations. `points_inside` is a share of all points;
        `speedup` is seconds of the reference over seconds of the simulator.
        """
        out: dict[str, float | None] = {}
        for name, least in JUDGED.items():
            predicted, true = self.values(name)
            relative = (predicted - true) / np.maximum(np.abs(true), least)
            out[f"{name}.error"] = float(np.abs(relative).mean())
            out[f"{name}.bias"] = float(relative.mean())
            out[f"{name}.slope"] = _slope(true, predicted)
            out[f"{name}.spearman"] = rank_correlation(true, predicted)
            out[f"{name}.spread"] = float(predicted.std())
            out[f"{name}.spread_true"] = float(true.std())
        out["points_inside"] = sum(r.points_inside for r in self.results) / sum(
            r.points for r in self.results
        )
        out["point_rmse"] = float(np.mean([r.point_rmse for r in self.results]))
        out["deposit_error"] = float(np.mean([r.deposit_error for r in self.results]))
        out["diverged"] = float(np.mean([r.status != OK for r in self.results]))
        seconds = float(np.mean([r.seconds for r in self.results]))
        out["seconds"] = seconds
        known = [r.reference_seconds for r in self.results if r.reference_seconds is not None]
        out["speedup"] = float(np.mean(known)) / max(seconds, 1e-9) if known else None
        return out

    @property
    def aims(self) -> dict[str, tuple[float, float]]:
        """AIMS, which are for layouts: none over scenes without a baffle."""
        return AIMS if any(r.scene.baffles for r in self.results) else {}

    def verdicts(self) -> dict[str, bool | None]:
        """Which of the aims are met; None where the number is undefined."""
        numbers = self.aggregate()
        return {name: _met(numbers[name], bounds) for name, bounds in self.aims.items()}

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, as they stand on a model's card."""
        return {
            "simulator": self.simulator,
            "reference": self.reference,
            "scenes": len(self.results),
            "aggregate": self.aggregate(),
            "aims": {name: list(bounds) for name, bounds in self.aims.items()},
            "met": self.verdicts(),
            "results": [r.to_dict() for r in self.results],
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write `to_dict` as JSON, whole or not at all."""
        write_whole(Path(path), (json.dumps(self.to_dict(), indent=2) + "\n").encode())

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Write one row a scene: predicted and true measures, whole or not at all."""
        text = io.StringIO(newline="")
        writer = csv.writer(text)
        extra = (
            "status",
            "points",
            "points_inside",
            "point_rmse",
            "deposit_error",
            "seconds",
            "reference_seconds",
        )
        names = list(measures.UNITS)
        columns = [f"{n}.{who}" for n in names for who in ("predicted", "true")]
        writer.writerow(["scene", "layout", *columns, *extra])
        for result in self.results:
            row = result.to_dict()
            numbers = [row[who][n] for n in names for who in ("predicted", "true")]
            writer.writerow(
                [row["scene"], json.dumps(row["layout"]), *numbers, *(row[k] for k in extra)]
            )
        write_whole(Path(path), text.getvalue().encode())

    def table(self) -> Table:
        """The aggregate for a terminal, with the aims beside it."""
        numbers, aims = self.aggregate(), self.aims
        table = Table(
            title=f"{self.simulator} against {self.reference} over {len(self.results)} scenes"
        )
        table.add_column("measure", no_wrap=True)
        headings = ["error", "bias", "slope", "Spearman", "std", "std true"]
        if aims:
            headings.insert(1, "aim")
        for heading in headings:
            table.add_column(heading, justify="right", no_wrap=True)
        for name in JUDGED:
            cells = [
                _cell(numbers[f"{name}.{key}"], form, aims.get(f"{name}.{key}"))
                for key, form in (
                    ("error", ".1%"), ("bias", "+.1%"), ("slope", ".2f"), ("spearman", ".2f"),
                    ("spread", ".3f"), ("spread_true", ".3f"),
                )
            ]  # fmt: skip
            if aims:
                cells.insert(1, f"{aims[f'{name}.error'][1]:.1%}")
            table.add_row(name, *cells)
        speedup = numbers["speedup"]
        ratio = "" if speedup is None else f", {speedup:.2g} times the reference's speed"
        slope, rank = AIMS["centroid_travel.slope"], AIMS["centroid_travel.spearman"]
        of_layouts = (
            f"aims for the centroid: slope {slope[0]:g} to {slope[1]:g}, "
            f"Spearman at least {rank[0]:g}\n"
            f"points inside a baffle {numbers['points_inside']:.2%} (aim 0) · "
        )
        table.caption = (
            (of_layouts if aims else "") + f"final points off by {numbers['point_rmse']:.3f} m · "
            f"mass in another {CELL * 100:g} cm cell {numbers['deposit_error']:.1%} · "
            f"{numbers['seconds']:.2f} s a rollout{ratio}"
        )
        return table


def compare(
    simulator: Simulator,
    references: Sequence[Trajectory],
    *,
    batch: int = 8,
    progress: Progress | None = None,
) -> Comparison:
    """Roll `simulator` out on the scenes of `references` and set the two side by side.

    A simulator that can start from other fillings (`refilled`) starts from that of each reference,
    if its points are as far apart.

    Args:
        simulator: what is judged.
        references: trajectories of the reference, one a scene.
        batch: scenes in one rollout; the seconds of a scene are those of its batch over its size.
        progress: called with the fraction done.

    Raises:
        SimulatorError: if there is no reference, or the simulator cannot run one of its scenes.
    """
    if not references:
        raise SimulatorError("nothing to compare with: give at least one reference trajectory")
    scenes = [r.scene for r in references]
    for scene in scenes:
        simulator.check(scene)
    results: list[SceneResult] = []
    for start in range(0, len(scenes), batch):
        chunk = references[start : start + batch]
        began = time.perf_counter()
        predictions = _from_the_same_starts(simulator, chunk)
        seconds = (time.perf_counter() - began) / len(chunk)
        for prediction, reference in zip(predictions, chunk, strict=True):
            results.append(_result(prediction, reference, seconds))
        if progress is not None:
            progress(len(results) / len(scenes))
    return Comparison(
        simulator=simulator.name, reference=references[0].simulator, results=tuple(results)
    )


def _from_the_same_starts(
    simulator: Simulator, references: Sequence[Trajectory]
) -> list[Trajectory]:
    """Rollouts of the scenes of `references`, together where their fillings are the simulator's.

    A model of another spacing has other points, whose lattice is not theirs: it starts as it does.
    """
    own = getattr(simulator, "jitter", 0.0), getattr(simulator, "filling", 0)
    starts = [
        (float(r.settings.get("jitter", 0)), r.settings.get("filling", 0)) for r in references
    ]
    config = getattr(simulator, "config", None)
    alike = config is None or all(
        math.isclose(r.point_volume, config.spacing**config.dim, rel_tol=1e-6) for r in references
    )
    usual = all(s == own or s[0] == own[0] == 0 for s in starts)
    if usual or not alike or not can_refill(simulator):
        return simulator.rollout([r.scene for r in references])
    predictions = []
    for reference, start in zip(references, starts, strict=True):
        predictions += simulator.refilled(*start).rollout([reference.scene])
    return predictions


def _result(prediction: Trajectory, reference: Trajectory, seconds: float) -> SceneResult:
    deposit, true_deposit = deposit_map(prediction), deposit_map(reference)
    known = reference.settings.get("seconds")
    return SceneResult(
        scene=reference.scene,
        predicted=measures.summary(prediction),
        true=measures.summary(reference),
        status=prediction.status,
        points=measures.moving_positions(prediction).shape[1],
        points_inside=measures.points_inside_baffles(prediction),
        point_rmse=point_rmse(prediction, reference),
        deposit_error=deposit_error(deposit, true_deposit),
        seconds=seconds,
        reference_seconds=None if known is None else float(known),
        deposit=deposit,
        reference_deposit=true_deposit,
    )


def deposit_map(trajectory: Trajectory, *, cell: float = CELL) -> np.ndarray:
    """Mean depth of the deposit in the last frame, over square cells of the plan [m].

    Every point is spread over the cells around it with bilinear weights, so that a coarse filling
    does not look speckled. Shape (X, Z) in 3D and (X,) in 2D, from the lower corner of the domain.
    """
    domain, dim = trajectory.scene.domain, trajectory.scene.dim
    plan = [0, *range(2, dim)]
    lower, upper = np.array(domain.lower)[plan], np.array(domain.upper)[plan]
    shape = np.maximum(1, np.ceil((upper - lower) / cell - 1e-9)).astype(int)
    points = measures.moving_positions(trajectory)[-1][:, plan]
    place = np.clip((points - lower) / cell - 0.5, 0, shape - 1)
    corner = np.minimum(place.astype(int), np.maximum(shape - 2, 0))
    share = place - corner
    volume = np.zeros(shape)
    for offset in np.ndindex(*(2,) * len(plan)):
        weight = np.where(offset, share, 1 - share).prod(axis=1)
        index = np.minimum(corner + offset, shape - 1)
        np.add.at(volume, tuple(index.T), weight)
    return volume * trajectory.point_volume / cell ** len(plan)


def deposit_error(deposit: np.ndarray, reference: np.ndarray) -> float:
    """Share of the mass that lies in another cell, half the L1 difference of the two maps [-]."""
    return float(0.5 * np.abs(deposit / deposit.sum() - reference / reference.sum()).sum())


def point_rmse(prediction: Trajectory, reference: Trajectory) -> float:
    """Root mean square over points of the difference in displacement, first to last frame [m].

    A point of the prediction is held against the reference's point nearest to it at the start.
    """
    ours, theirs = measures.moving_positions(prediction), measures.moving_positions(reference)
    _, nearest = cKDTree(theirs[0]).query(ours[0])
    difference = (ours[-1] - ours[0]).astype(float) - (theirs[-1] - theirs[0])[nearest]
    return float(np.sqrt(np.square(difference).sum(axis=1).mean()))


def _slope(true: np.ndarray, predicted: np.ndarray) -> float | None:
    spread = true - true.mean()
    square = float((spread**2).sum())
    if len(true) < 2 or square <= 1e-18:
        return None
    return float((spread * predicted).sum() / square)


def rank_correlation(a: np.ndarray, b: np.ndarray) -> float | None:
    """Spearman's of two samples (n,), or None below three or where one is constant."""
    if len(a) < 3 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return None
    value = float(spearmanr(a, b).statistic)
    return value if math.isfinite(value) else None


def _met(value: float | None, bounds: tuple[float, float]) -> bool | None:
    return None if value is None else bool(bounds[0] <= value <= bounds[1])


def _cell(value: float | None, form: str, aim: tuple[float, float] | None) -> str:
    if value is None:
        return "-"
    text = format(value, form)
    return text if aim is None else f"[{'green' if _met(value, aim) else 'red'}]{text}[/]"

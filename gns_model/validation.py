"""The reference solver against the paper: its column table and the facts of its flume."""

from __future__ import annotations

from typing import Any

import numpy as np

from gns_model import measures, paper
from gns_model.simulator import Progress
from gns_model.trajectory import Trajectory

#: A column may differ from the paper's MPM by this share.
COLUMN_TOLERANCE = 0.08
#: When the paper's figure marks the runout of the flume [s].
RUNOUT_TIMES = (0.10, 0.15, 0.25, 0.34, 0.45, 0.63, 0.87)


def validate(
    *, workers: int = 1, flume_spacing: float | None = None, progress: Progress | None = None
) -> dict[str, Any]:
    """Run the paper's six columns and its flume.

    Args:
        workers: processes, one thread each.
        flume_spacing: of the flume's points [m]; default: the paper's.
        progress: called with the fraction done.

    Returns:
        {"columns": [row, ...], "flume": facts, "base_friction": value, "passed": bool}
    """
    from gns_model.mpm import MpmSimulator

    columns = [paper.column_scene(column) for column in paper.COLUMNS]
    # The flume costs as much as all columns: it goes first, so that no worker waits for it alone.
    if flume_spacing is None:
        flume, *collapsed = MpmSimulator(workers=workers).rollout(
            [paper.flume_scene(), *columns], progress=progress
        )
    else:
        flume = MpmSimulator(spacing=flume_spacing).rollout([paper.flume_scene()])[0]
        collapsed = MpmSimulator(workers=workers).rollout(columns, progress=progress)
    rows = [
        column_row(column, trajectory)
        for column, trajectory in zip(paper.COLUMNS, collapsed, strict=True)
    ]
    facts = flume_facts(flume)
    return {
        "base_friction": paper.COLUMN_BASE_FRICTION,
        "columns": rows,
        "flume": facts,
        "passed": all(row["within"] for row in rows) and facts["within"],
    }


def column_row(column: paper.Column, trajectory: Trajectory) -> dict[str, Any]:
    """One row of the table: normalised runout of the solver beside the paper's MPM."""
    runout = measures.normalised_runout(trajectory)
    error = runout / column.runout_mpm - 1
    return {
        "aspect": column.aspect,
        "height": column.height,
        "length": column.length,
        "points": int(trajectory.positions.shape[1]),
        "runout": runout,
        "paper_mpm": column.runout_mpm,
        "error": error,
        "within": bool(abs(error) <= COLUMN_TOLERANCE),
        "seconds": trajectory.settings["seconds"],
    }


def flume_facts(trajectory: Trajectory) -> dict[str, Any]:
    """When the flow meets the rows and rests, and how deep it gets, by several definitions."""
    boxes = trajectory.scene.baffle_boxes()
    faces = sorted({float(box[0, 0]) for box in boxes})
    facts: dict[str, Any] = {
        "row_1_arrival": measures.arrival_time(trajectory, faces[0]),
        "row_2_arrival": measures.arrival_time(trajectory, faces[1]),
        "rest": measures.rest_time(trajectory),
    }
    facts["within"] = all(
        facts[key] is not None and low <= facts[key] <= high
        for key, (low, high) in paper.FLUME_FACTS.items()
    )
    runout = measures.runout_over_time(trajectory)
    facts["runout"] = {
        f"{t:.2f}": float(np.interp(t, trajectory.time, runout)) for t in RUNOUT_TIMES
    }
    facts["upstream_depth"] = depth_by_definition(trajectory)
    facts["points_inside_baffles"] = measures.points_inside_baffles(trajectory)
    facts["measures"] = measures.summary(trajectory)
    facts["points"] = int(trajectory.positions.shape[1])
    facts["seconds"] = trajectory.settings["seconds"]
    return facts


def depth_by_definition(trajectory: Trajectory) -> dict[str, float]:
    """Peak upstream depth [m] by length of the window and quantile of the heights in it.

    A long window catches the block that slides by before it has met the baffle, and the highest
    point is a splash: which of them one calls "the depth" moves it by a third.
    """
    return {
        f"window {window:.2f} m, quantile {quantile:g}": float(
            measures.upstream_depth_over_time(trajectory, window=window, quantile=quantile).max(
                initial=0.0
            )
        )
        for window in (0.03, 0.05, 0.10)
        for quantile in (0.90, 0.98, 1.0)
    }

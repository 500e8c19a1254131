"""The Pareto front in the space of the objectives, each relative to no baffles."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from design.pareto import staircase
from design.results import RunResults
from design.theme import WIDTH, Theme

#: What an objective is called on an axis.
AXES = {
    "runout": "centroid travel",
    "p99": "p99 runout",
    "depth": "upstream depth",
    "mass": "mass past the section",
}


def front(run: RunResults, theme: Theme) -> Figure | None:
    """The points of the front by both simulators, and the layouts that they beat."""
    entries = run.summary.get("front")
    names = list(entries[0]["objectives"]) if entries else []
    if not entries or len(names) < 2:
        return None
    pairs = list(combinations(names, 2))
    figure = Figure(figsize=(WIDTH, 4.4 if len(pairs) == 1 else 3.6), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(pairs)))
    for axes, (across, up) in zip(panels, pairs, strict=True):
        _panel(axes, run, theme, entries, across, up, alone=len(names) == 2)
    handles = [
        Line2D([], [], marker="o", ls="", mfc=theme.paper, mec=theme.best, mew=1.6, ms=7),
        Line2D([], [], marker="o", ls="", color=theme.best, ms=8),
        Line2D([], [], marker="o", ls="", color=theme.muted, alpha=0.5, ms=4),
    ]
    labels = [f"front, by the {run.searcher}", "the same layout, by the solver", "beaten layouts"]
    seen = any(e["verified_objectives"] for e in entries)
    figure.legend(
        handles if seen else handles[::2],
        labels if seen else labels[::2],
        ncols=3,
        loc="outside upper left",
        handletextpad=0.3,
    )
    return figure


def _panel(
    axes: Axes,
    run: RunResults,
    theme: Theme,
    entries: list[dict[str, Any]],
    across: str,
    up: str,
    *,
    alone: bool,
) -> None:
    points = np.array([[e["objectives"][across], e["objectives"][up]] for e in entries])
    cloud = _cloud(run, across, up)
    if len(cloud):
        # What is far above the front would press it into a corner.
        far = points.max(axis=0) + 1.5 * np.maximum(np.ptp(points, axis=0), 0.05)
        cloud = cloud[(cloud <= far).all(axis=1)]
        axes.scatter(
            cloud[:, 0], cloud[:, 1], s=14, color=theme.muted, alpha=0.45, linewidths=0, zorder=2
        )
    if alone:
        axes.plot(*staircase(points).T, color=theme.best, lw=1.2, alpha=0.7, zorder=3)
    for entry, point in zip(entries, points, strict=True):
        verified = entry["verified_objectives"]
        if verified:
            solver = verified[across], verified[up]
            axes.plot(*zip(point, solver, strict=True), color=theme.best, lw=0.9, alpha=0.6)
            axes.plot(*solver, "o", color=theme.best, ms=8, zorder=5)
    axes.plot(*points.T, "o", ls="", mfc=theme.paper, mec=theme.best, mew=1.6, ms=7, zorder=4)
    span = np.maximum(np.ptp(points, axis=0), 1e-9)
    last: np.ndarray | None = None
    for entry, point in zip(entries, points, strict=True):
        # Numbers that would lie on each other are left out; the table has them all.
        if last is not None and np.abs((point - last) / span).max() < 0.06:
            continue
        last = point
        axes.annotate(
            str(entry["point"]),
            point,
            xytext=(-5, -5),
            textcoords="offset points",
            ha="right",
            va="top",
            color=theme.ink,
            fontsize=8.5,
            zorder=6,
        )
    axes.margins(0.09)
    axes.set(
        xlabel=f"{AXES[across]}, relative to no baffles [-]",
        ylabel=f"{AXES[up]}, relative to no baffles [-]",
    )


def _cloud(run: RunResults, across: str, up: str) -> np.ndarray:
    """The objectives of every trial that reached its end, shape (n, 2)."""
    tried = run.summary.get("tried") or []
    return np.array([[t[across], t[up]] for t in tried], dtype=float).reshape(-1, 2)

"""The flow itself, our solver beside the learned one: columns from the side, a flume from above."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from matplotlib.collections import PathCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Polygon

from gns_model import measures
from gns_model.evaluation_figures import save_figure
from gns_model.suites.collapse import critical_time
from gns_model.suites.pair import Pair
from gns_model.trajectory import Trajectory

Path = str | os.PathLike[str]

#: Colours of heights: without the palest, which would not show on white.
HEIGHTS = ListedColormap(matplotlib.colormaps["YlOrBr"](np.linspace(0.15, 1, 256)))
#: Normalised times at which the paper shows a collapse; the last frame follows.
TIMES = (0.0, 1.0, 1.5, 2.5)


def deposits(pairs: Mapping[float, Pair], name: str, path: Path) -> None:
    """Final deposits of columns by aspect ratio, one a row: our solver and the learned one."""
    rows = [(f"a = {aspect:g}", pair, pair.predicted.time[-1]) for aspect, pair in pairs.items()]
    _side_views(rows, name, path)


def collapse(pair: Pair, name: str, path: Path) -> None:
    """One column over time, as the paper shows it: rows are times, our solver and the learned."""
    tau = critical_time(pair.reference)
    end = float(pair.predicted.time[-1])
    times = [t * tau for t in TIMES if t * tau < end] + [end]
    _side_views([(rf"$t/\tau_c$ = {t / tau:.1f}", pair, t) for t in times], name, path)


def _side_views(rows: Sequence[tuple[str, Pair, float]], name: str, path: Path) -> None:
    """Points from the side, coloured by displacement; a row is a label, a pair and a time [s]."""
    views = [
        [(trajectory, frame_at(trajectory, time)) for _, trajectory in reversed(pair.both())]
        for _, pair, time in rows
    ]
    travel = [[_travel(trajectory, k) for trajectory, k in row] for row in views]
    top = max(float(t.max()) for row in travel for t in row) or 1.0
    wall, base = rows[0][1].scene.domain.lower
    width = 1.06 * max(float(t.positions[k, :, 0].max()) for row in views for t, k in row) - wall
    height = 1.1 * max(float(t.positions[k, :, 1].max()) for row in views for t, k in row) - base
    figure = Figure(
        figsize=(10.5, (4.9 * height / width + 0.12) * len(rows) + 1.1),
        layout=ConstrainedLayoutEngine(h_pad=0.08, compress=True),
    )
    grid = figure.subplots(len(rows), 2, squeeze=False, sharex=True, sharey=True)
    dots: PathCollection | None = None
    for line, (label, _, _), row, moved in zip(grid, rows, views, travel, strict=True):
        for axes, (trajectory, k), colour in zip(line, row, moved, strict=True):
            x, y = trajectory.positions[k].T
            # The area of a point is that of its share of the page, so that the mass looks solid.
            share = 4.9 * 72 * np.sqrt(trajectory.point_volume) / width
            dots = axes.scatter(
                x, y, s=(0.9 * share) ** 2, c=colour, cmap="viridis", vmin=0, vmax=top,
                linewidths=0,
            )  # fmt: skip
            axes.set(xlim=(wall, wall + width), ylim=(base, base + height), aspect="equal")
            axes.text(0.98, 0.92, label, transform=axes.transAxes, ha="right", va="top")
        line[0].set_ylabel("y [m]")
    grid[0, 0].set_title("our MPM", fontsize=11)
    grid[0, 1].set_title(name, fontsize=11)
    for axes in grid[-1]:
        axes.set_xlabel("x [m]")
    assert dots is not None
    figure.colorbar(
        dots, ax=grid.ravel().tolist(), label="displacement [m]", location="bottom", shrink=0.5,
        aspect=40, pad=0.02,
    )  # fmt: skip
    save_figure(figure, path)


def _travel(trajectory: Trajectory, frame: int) -> np.ndarray:
    """Displacement of every point since the first frame [m], shape (N,)."""
    return np.linalg.norm(trajectory.positions[frame] - trajectory.positions[0], axis=1)


def plan_views(pair: Pair, times: Sequence[float], name: str, path: Path) -> None:
    """A flume from above at some times [s], coloured by height: our solver over the learned."""
    scene = pair.scene
    width, _, depth = scene.domain.size
    figure = Figure(
        figsize=(2.75 * len(times) + 0.5, 2.75 * 2 * depth / width + 1.5),
        layout=ConstrainedLayoutEngine(h_pad=0.08, compress=True),
    )
    grid = figure.subplots(2, len(times), squeeze=False, sharex=True, sharey=True)
    top = 0.0
    for _, trajectory in pair.both():
        top = max(top, float(np.quantile(trajectory.positions[0, :, 1], 0.99)) - scene.base)
    titles = ("our MPM", name)
    dots: PathCollection | None = None
    for line, title, (_, trajectory) in zip(grid, titles, reversed(pair.both()), strict=True):
        positions = measures.moving_positions(trajectory)
        for axes, time in zip(line, times, strict=True):
            points = positions[frame_at(trajectory, time)]
            points = points[np.argsort(points[:, 1])]  # the highest is what one sees from above
            share = 2.5 * 72 * trajectory.point_volume ** (1 / 3) / width
            dots = axes.scatter(
                points[:, 0], points[:, 2], s=share**2, c=points[:, 1] - scene.base,
                cmap=HEIGHTS, vmin=0.0, vmax=1.1 * top, linewidths=0,
            )  # fmt: skip
            for corners in scene.footprints():
                axes.add_patch(Polygon(corners, facecolor="0.35", edgecolor="black"))
            axes.set(
                xlim=(scene.domain.lower[0], scene.domain.upper[0]),
                ylim=(scene.domain.lower[2], scene.domain.upper[2]),
                aspect="equal",
            )
            if title == titles[0]:
                axes.set_title(f"t = {time:.2f} s", fontsize=11)
        line[0].set_ylabel(f"{title}\nz [m]")
    for axes in grid[-1]:
        axes.set_xlabel("x [m]")
    assert dots is not None
    figure.colorbar(
        dots, ax=grid.ravel().tolist(), label="height of the points [m]", location="bottom",
        shrink=0.4, aspect=40,
    )  # fmt: skip
    save_figure(figure, path)


def frame_at(trajectory: Trajectory, time: float) -> int:
    """Index of the frame nearest to `time` [s]."""
    return int(np.abs(np.asarray(trajectory.time) - time).argmin())

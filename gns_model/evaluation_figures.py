"""Figures of a comparison: learned against reference, and deposits side by side."""

from __future__ import annotations

import io
import os
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from gns_model.evaluation import CELL, JUDGED, Comparison
from gns_model.files import write_whole
from gns_model.measures import UNITS
from gns_model.scene import Scene

_TITLES = {
    "centroid_travel": "centroid travel",
    "runout_p99": "p99 runout",
    "upstream_depth": "peak upstream depth",
    "mass_past_section": "mass past the section",
}


def scatter_figure(comparison: Comparison, path: str | os.PathLike[str]) -> None:
    """Predicted against true for the four judged measures, one dot a scene; a PNG at `path`."""
    figure = Figure(figsize=(9.6, 8.6), layout="constrained")
    numbers = comparison.aggregate()
    for axes, name in zip(figure.subplots(2, 2).flat, JUDGED, strict=True):
        predicted, true = comparison.values(name)
        low = min(predicted.min(), true.min())
        high = max(predicted.max(), true.max())
        margin = 0.08 * (high - low) or 0.05 * max(abs(high), 0.1)
        limits = (low - margin, high + margin)
        axes.plot(limits, limits, color="0.6", linewidth=1, zorder=1)
        axes.scatter(true, predicted, s=28, color="#1f6f8b", edgecolor="white", zorder=2)
        axes.set(xlim=limits, ylim=limits, aspect="equal")
        unit = "" if UNITS[name] == "-" else f" [{UNITS[name]}]"
        axes.set_xlabel(f"{comparison.reference}{unit}")
        axes.set_ylabel(f"{comparison.simulator}{unit}")
        parts = [f"error {numbers[f'{name}.error']:.1%}"]
        for key, label in (("slope", "slope"), ("spearman", "Spearman")):
            if numbers[f"{name}.{key}"] is not None:
                parts.append(f"{label} {numbers[f'{name}.{key}']:.2f}")
        axes.set_title(f"{_TITLES[name]}\n{', '.join(parts)}", fontsize=11)
        axes.grid(color="0.92")
        axes.set_axisbelow(True)
    figure.suptitle(f"{len(comparison.results)} scenes; the line is perfect agreement")
    save_figure(figure, path)


def deposit_figure(
    comparison: Comparison, path: str | os.PathLike[str], *, scenes: int = 3
) -> None:
    """Final deposits of the first `scenes` scenes: reference, simulator and their difference.

    Depth over the plan in 3D, a profile along x in 2D; a PNG at `path`.
    """
    results = comparison.results[:scenes]
    if results[0].scene.dim == 2:
        _profiles(comparison, path, scenes)
        return
    top = max(max(r.deposit.max(), r.reference_deposit.max()) for r in results)
    gap = max(np.abs(r.deposit - r.reference_deposit).max() for r in results) or 1e-3
    width, _, depth = results[0].scene.domain.size
    figure = Figure(
        figsize=(11, (2.9 * depth / width + 0.6) * len(results) + 0.9), layout="constrained"
    )
    grid = figure.subplots(len(results), 3, squeeze=False, sharex=True, sharey=True)
    for row, result in zip(grid, results, strict=True):
        difference = result.deposit - result.reference_deposit
        panels = (
            (result.reference_deposit, f"{result.scene.name}: {comparison.reference}", "YlOrBr"),
            (result.deposit, comparison.simulator, "YlOrBr"),
            (difference, f"difference: {result.deposit_error:.1%} of the mass", "RdBu_r"),
        )
        for axes, (values, title, colours) in zip(row, panels, strict=True):
            low, high = (-gap, gap) if colours == "RdBu_r" else (0.0, top)
            _plan(axes, result.scene, values, colours, low, high)
            axes.set_title(title, fontsize=10)
        row[0].set_ylabel("z [m]")
    for axes in grid[-1]:
        axes.set_xlabel("x [m]")
    # One scale for all scenes, so that depths compare down the page as well as across it.
    for columns, label in ((grid[:, :2], "depth [m]"), (grid[:, 2], "difference [m]")):
        figure.colorbar(
            columns.flat[0].images[0], ax=columns.ravel().tolist(), label=label,
            location="bottom", shrink=0.6, aspect=40 if columns.ndim == 2 else 20,
        )  # fmt: skip
    save_figure(figure, path)


def _plan(
    axes: Axes, scene: Scene, values: np.ndarray, colours: str, low: float, high: float
) -> None:
    x, z = scene.domain.lower[0], scene.domain.lower[2]
    extent = (x, x + values.shape[0] * CELL, z, z + values.shape[1] * CELL)
    axes.imshow(
        values.T,
        origin="lower",
        extent=extent,
        cmap=colours,
        vmin=low,
        vmax=high,
        interpolation="nearest",
    )
    for corners in scene.footprints():
        axes.add_patch(Polygon(corners, facecolor="0.35", edgecolor="black"))
    axes.axvline(scene.control_section, color="0.3", linewidth=0.8, linestyle="--")


def _profiles(comparison: Comparison, path: str | os.PathLike[str], scenes: int) -> None:
    results = comparison.results[:scenes]
    figure = Figure(figsize=(9, 2.6 * len(results) + 0.4), layout="constrained")
    for axes, result in zip(
        figure.subplots(len(results), 1, squeeze=False)[:, 0], results, strict=True
    ):
        x = result.scene.domain.lower[0] + CELL * (np.arange(len(result.deposit)) + 0.5)
        axes.plot(x, result.reference_deposit, color="0.4", label=comparison.reference)
        axes.plot(x, result.deposit, color="#c2571a", label=comparison.simulator)
        axes.set(title=result.scene.name, ylabel="depth [m]", ylim=(0, None))
        for lower, upper in result.scene.baffle_boxes():
            axes.axvspan(lower[0], upper[0], color="0.8")
        axes.legend(frameon=False)
    axes.set_xlabel("x [m]")
    save_figure(figure, path)


def save_figure(figure: Figure, path: str | os.PathLike[str], *, dpi: int = 120) -> None:
    """Write a figure as PNG, whole or not at all."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    write_whole(Path(path), buffer.getvalue())

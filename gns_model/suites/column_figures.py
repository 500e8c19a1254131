"""Figures of collapsing columns: runout by aspect ratio and friction angle, evolution, errors."""

from __future__ import annotations

import os
from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, NullFormatter, ScalarFormatter

from gns_model.evaluation_figures import save_figure
from gns_model.suites.collapse import MEAN_RUNOUT_AIM, RUNOUT_AIM, critical_time
from gns_model.suites.pair import Pair
from gns_model.suites.result import Row

Path = str | os.PathLike[str]

#: Colours of the two that are compared, the same in every figure.
OURS, LEARNED, PAPER = "0.25", "#c2571a", "#1f6f8b"
#: Labels of axes.
TIME, ASPECT = r"$t/\tau_c$", "aspect ratio $a = H_0/L_0$"
RUNOUT = "normalised runout $(L_f - L_0)/L_0$"

ENERGIES = {"potential": "#1f6f8b", "kinetic": "#c2571a", "dissipated": "#5a8f3c"}


def curve(rows: Sequence[Row], key: str) -> np.ndarray:
    """One column of a table, shape (T,)."""
    return np.array([row[key] for row in rows], float)


def solved_and_learned(rows: Sequence[Row]) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """The runouts that are judged: of our MPM, of the model, and the deviation of the first over
    its fillings, where there are several."""
    if "fillings" not in rows[0]:
        return curve(rows, "runout_mpm"), curve(rows, "runout"), None
    spread = None if rows[0]["fillings_mpm_sd"] is None else curve(rows, "fillings_mpm_sd")
    return curve(rows, "fillings_mpm"), curve(rows, "fillings"), spread


def tidy(axes: Axes) -> None:
    """A light grid behind everything."""
    axes.grid(color="0.92")
    axes.set_axisbelow(True)


def runout_by_aspect(rows: Sequence[Row], name: str, path: Path) -> None:
    """Normalised runout over aspect ratio beside the paper's, and the errors with the aims."""
    figure = Figure(figsize=(10.5, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1))
    aspect = curve(rows, "aspect")
    solved, learned, spread = solved_and_learned(rows)
    hollow = {"color": PAPER, "mfc": "white"}
    for values, label, style in (
        (curve(rows, "paper_mpm"), "paper's MPM", {"marker": "s", **hollow}),
        (curve(rows, "paper_gns"), "paper's GNS", {"marker": "^", "ls": ":", **hollow}),
        (solved, "our MPM", {"color": OURS, "marker": "s"}),
        (learned, name, {"color": LEARNED, "marker": "o", "ls": "--"}),
    ):
        left.plot(aspect, values, label=label, markersize=6, linewidth=1.3, **style)
    if spread is not None:
        left.errorbar(
            aspect, solved, spread, fmt="none", color=OURS, capsize=3, linewidth=1,
            label="our MPM over fillings (deviation)",
        )  # fmt: skip
    left.set(
        xscale="log", yscale="log", xlabel=ASPECT,
        ylabel=RUNOUT,
    )  # fmt: skip
    left.xaxis.set_major_locator(FixedLocator(list(aspect)))
    left.yaxis.set_major_locator(FixedLocator([0.5, 1, 2, 3, 4, 6, 8]))
    for axis in (left.xaxis, left.yaxis):
        axis.set_major_formatter(ScalarFormatter())
        axis.set_minor_formatter(NullFormatter())
    tidy(left)
    left.legend(frameon=False)

    place = np.arange(len(rows))
    judged = "fillings_error" if "fillings" in rows[0] else "runout_error"
    ours, theirs = 100 * curve(rows, judged), 100 * curve(rows, "paper_error")
    right.axhspan(-100 * RUNOUT_AIM, 100 * RUNOUT_AIM, color="0.93")
    right.axhline(0, color="0.4", linewidth=0.8)
    right.bar(place - 0.2, ours, 0.38, color=LEARNED, label=f"{name} against our MPM")
    right.bar(place + 0.2, theirs, 0.38, color=PAPER, alpha=0.6, label="paper's GNS, its MPM")
    right.set_xticks(place, [f"{a:g}" for a in aspect])
    low = min(-100 * RUNOUT_AIM, ours.min(), theirs.min())
    high = max(100 * RUNOUT_AIM, ours.max(), theirs.max())
    room = 0.1 * (high - low)  # and three times that on top, for the legend
    right.set(xlabel="aspect ratio $a$", ylabel="runout error [%]")
    right.set_ylim(low - room, high + 3 * room)
    right.set_title(
        f"mean {np.abs(ours).mean():.1f}% (aim {100 * MEAN_RUNOUT_AIM:g}%), "
        f"largest {np.abs(ours).max():.1f}% (aim {100 * RUNOUT_AIM:g}%, grey)",
        fontsize=10,
    )
    right.legend(frameon=False, loc="upper left", fontsize=9)
    save_figure(figure, path)


def evolution(curves: Sequence[Sequence[Row]], name: str, path: Path) -> None:
    """Runout, height and energies over t / tau_c of some columns, one a column of panels."""
    figure = Figure(figsize=(4.1 * len(curves) + 0.6, 6.8), layout="constrained")
    grid = figure.subplots(2, len(curves), squeeze=False, sharex="row")
    for (top, bottom), rows in zip(grid.T, curves, strict=True):
        top.set_title(f"a = {rows[0]['aspect']:g}")
        geometry_panel(top, rows, name, legend=rows is curves[-1])
        energy_panel(bottom, rows, curve(rows, "t_over_tau"), name, legend=rows is curves[-1])
        bottom.set_xlabel(TIME)
        if rows is not curves[0]:
            top.set_ylabel("")
            bottom.set_ylabel("")
    save_figure(figure, path)


def geometry_panel(axes: Axes, rows: Sequence[Row], name: str, *, legend: bool) -> None:
    """Normalised runout and height over t / tau_c, solid by our solver and dashed learned."""
    time = curve(rows, "t_over_tau")
    for key, colour in (("runout", LEARNED), ("height", PAPER)):
        axes.plot(time, curve(rows, f"{key}_mpm"), color=colour, linewidth=1.6)
        axes.plot(time, curve(rows, key), color=colour, linewidth=1.6, linestyle=(0, (3, 2)))
    axes.set_ylabel(r"runout $(L_t - L_0)/L_0$,  height $H_t/L_0$")
    tidy(axes)
    if legend:
        marks = [
            Line2D([], [], color=LEARNED, label="runout"),
            Line2D([], [], color=PAPER, label="height"),
            *_who(name),
        ]
        axes.legend(handles=marks, frameon=False, fontsize=9)


def energy_panel(
    axes: Axes, rows: Sequence[Row], time: np.ndarray, name: str, *, legend: bool
) -> None:
    """The three energies in shares of the first, solid by our solver and dashed learned."""
    for key, colour in ENERGIES.items():
        axes.plot(time, curve(rows, f"{key}_mpm"), color=colour, linewidth=1.6)
        axes.plot(time, curve(rows, key), color=colour, linewidth=1.6, linestyle=(0, (3, 2)))
    axes.set(ylabel=r"energy / $E_0$", ylim=(min(-0.02, axes.get_ylim()[0]), 1.05))
    tidy(axes)
    if legend:
        labels = {"potential": "$E_p$", "kinetic": "$E_k$", "dissipated": "$E_d$"}
        marks = [Line2D([], [], color=ENERGIES[k], label=labels[k]) for k in ENERGIES]
        axes.legend(handles=[*marks, *_who(name)], frameon=False, fontsize=9)


def _who(name: str) -> list[Line2D]:
    return [
        Line2D([], [], color="0.3", label="our MPM"),
        Line2D([], [], color="0.3", linestyle=(0, (3, 2)), label=name),
    ]


def position_errors(curves: Sequence[Sequence[Row]], name: str, path: Path) -> None:
    """Mean squared position error over time, one line a column."""
    figure = Figure(figsize=(6.6, 4.4), layout="constrained")
    axes = figure.subplots()
    colours = matplotlib.colormaps["viridis"](np.linspace(0, 0.9, len(curves)))
    for rows, colour in zip(curves, colours, strict=True):
        label = f"a = {rows[0]['aspect']:g}"
        axes.plot(curve(rows, "time"), curve(rows, "position_mse"), color=colour, label=label)
    axes.set(xlabel="t [s]", ylabel="mean squared position error [m²]", ylim=(0, None))
    axes.set_title(f"{name} against our MPM", fontsize=11)
    axes.ticklabel_format(axis="y", scilimits=(-2, 2))
    tidy(axes)
    axes.legend(frameon=False, ncols=2)
    save_figure(figure, path)


def upscaled(
    large: Sequence[Row],
    small: Sequence[Row],
    errors: np.ndarray,
    pair: Pair,
    name: str,
    path: Path,
) -> None:
    """The up-scaled column: evolution, energies, error beside the small one's, error by point.

    Args:
        errors: squared position errors of the points of the large one [m²], shape (T, N).
    """
    figure = Figure(figsize=(10.5, 7.6), layout="constrained")
    (a, b), (c, d) = figure.subplots(2, 2)
    geometry_panel(a, large, name, legend=True)
    energy_panel(b, large, curve(large, "t_over_tau"), name, legend=True)
    for rows, label, colour in ((large, "up-scaled", LEARNED), (small, "small", PAPER)):
        c.plot(curve(rows, "time"), curve(rows, "position_mse"), color=colour, label=label)
    c.set(xlabel="t [s]", ylabel="mean squared position error [m²]", ylim=(0, None))
    c.ticklabel_format(axis="y", scilimits=(-2, 2))
    c.legend(frameon=False)
    tidy(c)
    time = np.asarray(pair.predicted.time) / critical_time(pair.reference)
    travel = np.linalg.norm(pair.predicted.positions[-1] - pair.predicted.positions[0], axis=1)
    order = np.argsort(travel)
    lines = LineCollection(
        [np.column_stack([time, errors[:, k]]) for k in order],
        array=travel[order], cmap="viridis", linewidths=0.5, alpha=0.6,
    )  # fmt: skip
    d.add_collection(lines)
    d.set(xlim=(0, time[-1]), ylim=(0, 1.05 * errors.max() or 1e-12))
    d.set(xlabel=TIME, ylabel="squared position error of a point [m²]")
    d.ticklabel_format(axis="y", scilimits=(-2, 2))
    tidy(d)
    figure.colorbar(lines, ax=d, label="final displacement [m]")
    for axes in (a, b):
        axes.set_xlabel(TIME)
    save_figure(figure, path)


def runout_by_friction(rows: Sequence[Row], name: str, path: Path) -> None:
    """Runout over friction angle, a line an aspect ratio; and over aspect ratio, one an angle."""
    figure = Figure(figsize=(10.5, 4.4), layout="constrained")
    panels = (
        ("friction_angle", "aspect", "friction angle φ [°]", "a = {:g}"),
        ("aspect", "friction_angle", ASPECT, "φ = {:g}°"),
    )
    for axes, (along, each, label, form) in zip(figure.subplots(1, 2), panels, strict=True):
        values = sorted({row[each] for row in rows})
        colours = matplotlib.colormaps["viridis"](np.linspace(0, 0.85, len(values)))
        for value, colour in zip(values, colours, strict=True):
            line = [row for row in rows if row[each] == value]
            x = curve(line, along)
            solved, learned, spread = solved_and_learned(line)
            axes.errorbar(
                x, solved, spread, color=colour, marker="s", markersize=5, capsize=3, linewidth=1.5
            )
            axes.plot(
                x, learned, color=colour, marker="o", markersize=6, mfc="white",
                linestyle=(0, (3, 2)),
            )  # fmt: skip
        marks = [
            Line2D([], [], color=colour, label=form.format(value))
            for value, colour in zip(values, colours, strict=True)
        ]
        axes.legend(handles=[*marks, *_who(name)], frameon=False, fontsize=9)
        axes.set(xlabel=label, ylabel=RUNOUT, ylim=(0, None))
        tidy(axes)
    save_figure(figure, path)

"""The two simulators against each other: measures of every layout judged twice, and the deposit."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D

from design import views, wording
from design.results import LEARNED, SOLVER, RunResults
from design.theme import WIDTH, Theme, layout_colour
from gns_model.trajectory import Trajectory

#: Measures that are compared, and what a small panel calls them.
COMPARED = {
    "centroid_travel": "Centroid",
    "runout_p99": "Runout p99",
    "upstream_depth": "Upstream depth",
    "mass_past_section": "Mass past",
}

#: Where contours of the deposit are drawn [m].
LEVELS = (0.01, 0.04, 0.08)


def agreement(run: RunResults, theme: Theme) -> Figure | None:
    """Each measure by the learned simulator against the solver, with the 1:1 line."""
    designs = list(run.compared())
    if not designs:
        return None
    figure = Figure(figsize=(WIDTH, 3.15), layout=ConstrainedLayoutEngine(h_pad=0.08))
    known = {q.name: q for q in wording.quantities(run.scene)}
    panels = figure.subplots(1, len(COMPARED))
    for axes, (name, short) in zip(panels, COMPARED.items(), strict=True):
        quantity = known[name]
        pairs = [
            (d, d.verified[name] * quantity.factor, d.surrogate[name] * quantity.factor)
            for d in designs
            if name in d.verified and name in d.surrogate
        ]
        if not pairs:
            axes.set_axis_off()
            continue
        values = np.array([p[1:] for p in pairs])
        low, high = values.min(), values.max()
        margin = 0.16 * (high - low) or 0.1 * abs(high) or 1.0
        low, high = low - margin, high + margin
        axes.plot([low, high], [low, high], color=theme.muted, lw=0.9)
        ends = np.array([low, high])
        axes.fill_between(ends, 0.95 * ends, 1.05 * ends, color=theme.line, alpha=0.55, lw=0)
        for design, solver, learned in pairs:
            axes.plot(
                solver,
                learned,
                "o",
                ms=7,
                color=layout_colour(theme, design.key),
                mec=theme.paper,
                mew=0.8,
                zorder=4,
            )
        gap = np.mean([abs(wording.relative(p, s) or 0.0) for _, s, p in pairs])
        axes.set(
            xlim=(low, high), ylim=(low, high), aspect="equal", xlabel=f"solver [{quantity.unit}]"
        )
        axes.set_title(f"{short}  ±{100 * gap:.1f} %")
        axes.locator_params(nbins=4)
        if axes is panels[0]:
            axes.set_ylabel(run.searcher)
    handles = [
        Line2D([], [], marker="o", ls="", color=layout_colour(theme, key), ms=6, label=label)
        for key, label in (
            ("best", "Best found"),
            ("rank-2", "Other ranked layouts"),
            ("paper", "Scene's own layout"),
            ("none", "No baffles"),
        )
        if any(d.key == key for d in designs)
    ]
    figure.legend(handles=handles, ncols=4, loc="outside lower center")
    return figure


def deposit(run: RunResults, theme: Theme) -> Figure | None:
    """The final deposit of the best layout by both simulators: contours, or the profile in 2D."""
    solver, learned = run.trajectory("best", SOLVER), run.trajectory("best", LEARNED)
    if solver is None or learned is None:
        return None
    scene = solver.scene
    if scene.dim == 2:
        figure = Figure(figsize=(WIDTH, 3.0), layout="constrained")
        axes = figure.subplots()
        _profiles(axes, solver, learned, theme)
    else:
        figure = Figure(figsize=(WIDTH, 4.5), layout="constrained")
        plan, profile = figure.subplots(1, 2, width_ratios=[1.0, 1.25])
        cell = max(views.spacing(solver), views.spacing(learned), 0.03)
        for flow, colour, style, width in _pair(solver, learned, theme):
            drawn = views.plan_map(flow, -1, cell=cell)
            left, right, bottom, top = drawn.extent
            nx, nz = drawn.values.shape
            x = left + (np.arange(nx) + 0.5) * (right - left) / nx
            z = bottom + (np.arange(nz) + 0.5) * (top - bottom) / nz
            plan.contour(
                x,
                z,
                drawn.values.T,
                levels=LEVELS,
                colors=colour,
                linestyles=[style],
                linewidths=width,
            )
        views.draw_plan(plan, scene, theme, theme.muted)
        plan.set_title("Depth contours at 1, 4 and 8 cm")
        plan.set(xlabel="x [m]", ylabel="z [m]")
        _profiles(profile, solver, learned, theme)
    handles = [
        Line2D([], [], color=colour, ls=style, lw=width, label=label)
        for (_, colour, style, width), label in zip(
            _pair(solver, learned, theme), ("reference solver", run.searcher), strict=True
        )
    ]
    figure.legend(handles=handles, ncols=2, loc="outside lower center")
    return figure


def _profiles(axes: Axes, solver: Trajectory, learned: Trajectory, theme: Theme) -> None:
    cell = max(views.spacing(solver), views.spacing(learned), 0.03)
    for flow, colour, style, width in _pair(solver, learned, theme):
        x, depth = views.surface(flow, -1, cell=cell)
        axes.plot(x, depth, color=colour, ls=style, lw=width)
        if flow is solver:
            axes.fill_between(x, depth, color=theme.sand[1], alpha=0.35, lw=0)
    axes.axvline(solver.scene.control_section, color=theme.muted, lw=0.8, ls=(0, (1, 2)))
    axes.set(
        xlabel="x [m]",
        ylabel="depth, mean over the width [m]",
        xlim=(solver.scene.domain.lower[0], solver.scene.domain.upper[0]),
    )
    axes.set_ylim(bottom=0)
    axes.set_title("Deposit along the channel")


def _pair(
    solver: Trajectory, learned: Trajectory, theme: Theme
) -> tuple[tuple[Trajectory, str, Any, float], ...]:
    """Each flow with the colour, dash and width of its line."""
    return ((solver, theme.sand[3], "-", 1.8), (learned, theme.origins[1], (0, (4, 1.6)), 1.5))

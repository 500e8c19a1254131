"""The figures of a run, each a function of what the run folder holds and a theme.

Every function returns a matplotlib Figure, or None where the run does not hold what it shows.
`write_figures` writes the light ones as PNG into the folder; the report also embeds dark ones.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

from design import views, wording
from design.results import LEARNED, SOLVER, Design, RunResults
from design.theme import LIGHT, Theme
from gns_model.scene import write_whole
from gns_model.trajectory import Trajectory

#: Width of a full figure [inch]; at DPI it is sharp on a page about 1080 CSS pixels wide.
WIDTH, DPI = 10.4, 170

#: Shares of the time until the flow rests at which it is shown, before the end.
INSTANTS = (0.3, 0.6, 0.9)

#: Measures in which the two simulators are compared, as the brief of the surrogate names them.
COMPARED = ("centroid_travel", "runout_p99", "upstream_depth", "mass_past_section")


def write_figures(run: RunResults, theme: Theme = LIGHT) -> dict[str, Path]:
    """Write every figure that the run has the data for as figures/{name}.png; return the paths."""
    paths = {}
    for name in FIGURES:
        content = png(run, name, theme)
        if content is not None:
            paths[name] = run.folder / "figures" / f"{name}.png"
            write_whole(paths[name], content)
    return paths


def png(run: RunResults, name: str, theme: Theme) -> bytes | None:
    """One figure as PNG bytes with a palette (a third of the size), or None without data."""
    with mpl.rc_context(theme.rc()):
        figure = FIGURES[name](run, theme)
        if figure is None:
            return None
        raw = io.BytesIO()
        figure.savefig(raw, dpi=DPI, format="png")
    picture = Image.open(raw).convert("RGB")
    small = io.BytesIO()
    picture.quantize(256, dither=Image.Dither.NONE).save(small, "PNG", optimize=True)
    return small.getvalue()


# -- the flow over time ----------------------------------------------------------------------------


def plan_over_time(run: RunResults, theme: Theme) -> Figure | None:
    """Depth in plan at four instants: the best layout above what it is compared with."""
    return _over_time(run, theme, views.plan_map, views.draw_plan, "z [m]", "depth [m]", 3)


def side_over_time(run: RunResults, theme: Theme) -> Figure | None:
    """The same from the side: share of the width that is filled."""
    return _over_time(
        run, theme, views.side_map, views.draw_side, "y [m]", "share of the width filled", 2
    )


def _over_time(run, theme, to_map, draw, ylabel, quantity, least_dim) -> Figure | None:
    rows = shown_flows(run)
    if not rows or rows[0][1].scene.dim < least_dim:
        return None
    scene = rows[0][1].scene
    side = to_map is views.side_map
    height = (views.side_top(scene) - scene.base) if side else scene.domain.size[-1]
    panel = (WIDTH - 1.35) / (len(INSTANTS) + 1)
    row = panel * height / scene.domain.size[0]
    figure = Figure(figsize=(WIDTH, len(rows) * (row + 0.27) + 0.4), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.03, h_pad=0.05, wspace=0.01, hspace=0.02)
    grid = figure.subplots(len(rows), len(INSTANTS) + 1, squeeze=False, sharex=True, sharey=True)
    times = _instants(rows[0][1])
    maps = [[to_map(flow, views.frame_at(flow, t)) for t in times] for _, flow in rows]
    # The block as released is deeper than all that follows: let it saturate.
    everything = np.concatenate([m.values.ravel() for line in maps for m in line[1:]])
    top = float(np.quantile(everything[everything > views.LEAST_SHOWN], 0.99))
    for r, (design, flow) in enumerate(rows):
        colour = layout_colour(theme, design.key)
        for c, t in enumerate(times):
            axes = grid[r, c]
            image = views.draw_map(axes, maps[r][c], theme, top)
            draw(axes, flow.scene, theme, colour)
            title = f"{_label(design, flow)} · {t:.2f} s" if c == 0 else f"{t:.2f} s"
            axes.set_title(title, color=colour if c == 0 else theme.muted)
            if r == len(rows) - 1:
                axes.set_xlabel("x [m]")
        grid[r, 0].set_ylabel(ylabel)
    bar = figure.colorbar(image, ax=grid, aspect=38 if len(rows) > 1 else 20,
                          pad=0.012, shrink=0.9, extend="max")
    bar.set_label(quantity)
    bar.outline.set_visible(False)
    return figure


def shown_flows(run: RunResults) -> list[tuple[Design, Trajectory]]:
    """The best layout's flow and one to compare it with: the scene's own, else no baffles."""
    found = []
    for key in ("best", "paper", "none"):
        design, flow = run.design(key), run.flow(key)
        if design is not None and flow is not None and len(found) < 2:
            found.append((design, flow))
    # Side by side only by the same simulator: the difference must be the layout's.
    if len(found) == 2 and found[0][1].simulator != found[1][1].simulator:
        key = found[1][0].key
        learned = run.trajectory("best", LEARNED), run.trajectory(key, LEARNED)
        if all(learned):
            found = [(found[0][0], learned[0]), (found[1][0], learned[1])]
        else:
            found = found[:1]
    return found


def _instants(flow: Trajectory) -> list[float]:
    """Four times of the flow [s]; the last is its end, the others lie before it rests."""
    x = views.moving_positions(flow)[:, :, 0].mean(axis=1)
    travelled = (x - x[0]) / max(float(x[-1] - x[0]), 1e-9)
    rest = float(flow.time[min(int(np.searchsorted(travelled, 0.985)), len(x) - 1)])
    return [share * rest for share in INSTANTS] + [float(flow.time[-1])]


# -- the search ------------------------------------------------------------------------------------


def history(run: RunResults, theme: Theme) -> Figure | None:
    """Objective of every rollout by where it came from, and the best so far."""
    trials = [t for t in run.trials if t.cost is not None]
    if not trials:
        return None
    figure = Figure(figsize=(WIDTH, 3.5), layout="constrained")
    axes = figure.subplots()
    number = np.array([t.number for t in trials]) + 1
    cost = np.array([t.cost for t in trials], dtype=float)
    # One diverged or absurd rollout must not press the rest into a line.
    ceiling = max(float(np.quantile(cost, 0.95)), 0.0)
    span = ceiling - cost.min()
    top = cost.max() if cost.max() < ceiling + span else ceiling + 0.15 * span
    origins = list(dict.fromkeys(t.origin for t in trials))
    for origin, colour in zip(origins, _cycle(theme.origins, len(origins)), strict=True):
        chosen = np.array([t.origin == origin for t in trials])
        axes.scatter(number[chosen], np.minimum(cost[chosen], top), s=17, color=colour,
                     alpha=0.85, linewidths=0, label=origin, zorder=3)
    axes.step(number, np.minimum.accumulate(cost), where="post", color=theme.best, lw=1.8,
              label="best so far", zorder=4)
    for key in ("paper", "none"):
        design = run.design(key)
        if design is not None and design.cost is not None and design.cost <= top + 0.5 * span:
            colour = layout_colour(theme, key)
            axes.axhline(design.cost, color=colour, lw=1.1, ls=(0, (5, 3)), zorder=2)
            axes.annotate(design.label, (1.0, design.cost), xycoords=("axes fraction", "data"),
                          xytext=(-2, 3), textcoords="offset points", ha="right", color=colour,
                          fontsize=8.5)
    failed = [t.number + 1 for t in run.trials if t.cost is None]
    if failed:
        axes.plot(failed, np.full(len(failed), axes.get_ylim()[1]), "x", color=theme.bad, ms=5,
                  label="failed", clip_on=False, zorder=5)
    axes.set(xlabel="rollout", ylabel="objective by the learned simulator [-]")
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.legend(ncols=8, loc="lower left", bbox_to_anchor=(-0.01, 1.0), borderaxespad=0.2,
                handletextpad=0.3, columnspacing=1.3)
    return figure


def trade_off(run: RunResults, theme: Theme) -> Figure | None:
    """Centroid travel against upstream depth: what a shorter flow costs in depth."""
    cloud = [
        (t.measures["upstream_depth"], t.measures["centroid_travel"])
        for t in run.trials
        if {"upstream_depth", "centroid_travel"} <= t.measures.keys() and t.cost is not None
    ]
    placed = [d for d in run.designs if _point(d.surrogate) or _point(d.verified)]
    if not cloud and not placed:
        return None
    figure = Figure(figsize=(WIDTH, 4.3), layout="constrained")
    axes = figure.subplots()
    if cloud:
        depth, travel = np.array(cloud).T
        axes.scatter(depth, travel, s=14, color=theme.muted, alpha=0.4, linewidths=0)
        front = _front(np.array(cloud))
        axes.plot(*front.T, color=theme.muted, lw=1.0, drawstyle="steps-post", alpha=0.8)
    for design in placed:
        colour = layout_colour(theme, design.key)
        surrogate, verified = _point(design.surrogate), _point(design.verified)
        if surrogate and verified:
            axes.plot(*zip(surrogate, verified, strict=True), color=colour, lw=0.9, alpha=0.7)
        if surrogate:
            axes.plot(*surrogate, "o", mfc=theme.paper, mec=colour, ms=7, mew=1.6, zorder=4)
        if verified:
            axes.plot(*verified, "o", color=colour, ms=8.5, zorder=5)
        if design.key in ("best", "paper", "none"):
            axes.annotate(design.label, verified or surrogate, xytext=(8, 5),
                          textcoords="offset points", color=colour, weight="bold", zorder=6)
    axes.margins(0.09)
    axes.set(xlabel="peak depth upstream of a baffle [m]", ylabel="centroid travel [m]")
    handles = [
        Line2D([], [], marker="o", ls="", color=theme.ink, ms=8, label="reference solver"),
        Line2D([], [], marker="o", ls="", mfc=theme.paper, mec=theme.ink, mew=1.5, ms=7,
               label="learned simulator"),
        Line2D([], [], marker="o", ls="-", lw=1, color=theme.muted, ms=4,
               label="rollouts of the search (learned) and their Pareto front"),
    ]
    axes.legend(handles=handles if cloud else handles[:2], ncols=3, loc="lower left",
                bbox_to_anchor=(-0.01, 1.0), borderaxespad=0.2, handletextpad=0.3)
    return figure


# -- learned against solver ------------------------------------------------------------------------


def agreement(run: RunResults, theme: Theme) -> Figure | None:
    """Each measure by the learned simulator against the solver, with the 1:1 line."""
    designs = list(run.compared())
    if not designs:
        return None
    figure = Figure(figsize=(WIDTH, 3.15), layout="constrained")
    figure.get_layout_engine().set(h_pad=0.08)
    known = {q.name: q for q in wording.quantities(run.scene)}
    for axes, name in zip(figure.subplots(1, len(COMPARED)), COMPARED, strict=True):
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
            axes.plot(solver, learned, "o", ms=7, color=layout_colour(theme, design.key),
                      mec=theme.paper, mew=0.8, zorder=4)
        gap = np.mean([abs(wording.change(p, s) or 0.0) for _, s, p in pairs])
        axes.set(xlim=(low, high), ylim=(low, high), aspect="equal",
                 xlabel=f"solver [{quantity.unit}]")
        axes.set_title(f"{_short(name)}  ±{100 * gap:.1f} %")
        axes.locator_params(nbins=4)
        if name == COMPARED[0]:
            axes.set_ylabel("learned simulator [m]")
    handles = [
        Line2D([], [], marker="o", ls="", color=layout_colour(theme, key), ms=6, label=label)
        for key, label in (("best", "Best found"), ("rank-2", "Other ranked layouts"),
                           ("paper", "Scene's own layout"), ("none", "No baffles"))
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
            plan.contour(x, z, drawn.values.T, levels=[0.01, 0.04, 0.08], colors=colour,
                         linestyles=[style], linewidths=width)
        views.draw_plan(plan, scene, theme, theme.muted)
        plan.set_title("Depth contours at 1, 4 and 8 cm")
        plan.set(xlabel="x [m]", ylabel="z [m]")
        _profiles(profile, solver, learned, theme)
    handles = [
        Line2D([], [], color=colour, ls=style, lw=width, label=label)
        for (_, colour, style, width), label in zip(
            _pair(solver, learned, theme), ("reference solver", "learned simulator"), strict=True
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
    axes.set(xlabel="x [m]", ylabel="depth, mean over the width [m]",
             xlim=(solver.scene.domain.lower[0], solver.scene.domain.upper[0]))
    axes.set_ylim(bottom=0)
    axes.set_title("Deposit along the channel")


def _pair(solver, learned, theme):
    return ((solver, theme.sand[3], "-", 1.8), (learned, theme.origins[1], (0, (4, 1.6)), 1.5))


# -- helpers ---------------------------------------------------------------------------------------


def layout_colour(theme: Theme, key: str) -> str:
    """The colour of a layout, the same in every figure; ranks after the first are lighter."""
    return {"best": theme.best, "paper": theme.own, "none": theme.none}.get(key, theme.sand[2])


def _label(design: Design, flow: Trajectory) -> str:
    return design.label if flow.simulator == SOLVER else f"{design.label} (learned)"


def _short(name: str) -> str:
    return {
        "centroid_travel": "Centroid",
        "runout_p99": "Runout p99",
        "upstream_depth": "Upstream depth",
        "mass_past_section": "Mass past",
    }[name]


def _point(measures: dict[str, float]) -> tuple[float, float] | None:
    if "upstream_depth" not in measures or "centroid_travel" not in measures:
        return None
    return measures["upstream_depth"], measures["centroid_travel"]


def _front(points: np.ndarray) -> np.ndarray:
    """The points that no other beats in both columns (less is better), by the first column."""
    ordered = points[np.lexsort((points[:, 1], points[:, 0]))]
    best_before = np.concatenate([[np.inf], np.minimum.accumulate(ordered[:, 1])[:-1]])
    return ordered[ordered[:, 1] < best_before]


def _cycle(colours: tuple[str, ...], count: int) -> list[str]:
    return [colours[k % len(colours)] for k in range(count)]


FIGURES: dict[str, Callable[[RunResults, Theme], Figure | None]] = {
    "plan": plan_over_time,
    "side": side_over_time,
    "deposit": deposit,
    "agreement": agreement,
    "tradeoff": trade_off,
    "history": history,
}

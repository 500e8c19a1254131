"""The search: objective against rollouts, and what a shorter flow costs in depth."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from design.results import RunResults
from design.theme import WIDTH, Theme, layout_colour


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
        axes.scatter(
            number[chosen],
            np.minimum(cost[chosen], top),
            s=17,
            color=colour,
            alpha=0.85,
            linewidths=0,
            label=origin,
            zorder=3,
        )
    axes.step(
        number,
        np.minimum.accumulate(cost),
        where="post",
        color=theme.best,
        lw=1.8,
        label="best so far",
        zorder=4,
    )
    for key in ("paper", "none"):
        design = run.design(key)
        if design is not None and design.cost is not None and design.cost <= top + 0.5 * span:
            colour = layout_colour(theme, key)
            axes.axhline(design.cost, color=colour, lw=1.1, ls=(0, (5, 3)), zorder=2)
            axes.annotate(
                design.label,
                (1.0, design.cost),
                xycoords=("axes fraction", "data"),
                xytext=(-2, 3),
                textcoords="offset points",
                ha="right",
                color=colour,
                fontsize=8.5,
            )
    failed = [t.number + 1 for t in run.trials if t.cost is None]
    if failed:
        axes.plot(
            failed,
            np.full(len(failed), axes.get_ylim()[1]),
            "x",
            color=theme.bad,
            ms=5,
            label="failed",
            clip_on=False,
            zorder=5,
        )
    axes.set(xlabel="rollout", ylabel=f"objective by the {run.searcher} [-]")
    axes.xaxis.set_major_locator(MaxNLocator(9, integer=True))
    axes.legend(
        ncols=8,
        loc="lower left",
        bbox_to_anchor=(-0.01, 1.0),
        borderaxespad=0.2,
        handletextpad=0.3,
        columnspacing=1.3,
    )
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
        where = verified or surrogate
        if where and design.key in ("best", "paper", "none"):
            axes.annotate(
                design.label,
                where,
                xytext=(8, 5),
                textcoords="offset points",
                color=colour,
                weight="bold",
                zorder=6,
            )
    axes.margins(0.09)
    axes.set(xlabel="peak depth upstream of a baffle [m]", ylabel="centroid travel [m]")
    handles = [
        Line2D([], [], marker="o", ls="", color=theme.ink, ms=8, label="reference solver"),
        Line2D(
            [],
            [],
            marker="o",
            ls="",
            mfc=theme.paper,
            mec=theme.ink,
            mew=1.5,
            ms=7,
            label=run.searcher,
        ),
        Line2D(
            [],
            [],
            marker="o",
            ls="-",
            lw=1,
            color=theme.muted,
            ms=4,
            label="rollouts of the search and their Pareto front",
        ),
    ]
    axes.legend(
        handles=handles if cloud else handles[:2],
        ncols=3,
        loc="lower left",
        bbox_to_anchor=(-0.01, 1.0),
        borderaxespad=0.2,
        handletextpad=0.3,
    )
    return figure


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

"""Figures of cost: seconds per step and edges by number of points, and a training step."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gns_model.evaluation_figures import save_figure
from gns_model.suites.column_figures import LEARNED, OURS, PAPER, tidy
from gns_model.suites.result import Row

Path = str | os.PathLike[str]

#: Column of the table, label and style of every kind of work.
KINDS = {
    "seconds": ("ours, float32", {"color": LEARNED, "marker": "o"}),
    "seconds_bfloat16": ("ours, bfloat16", {"color": LEARNED, "marker": "o", "mfc": "white"}),
    "seconds_plain": ("plain network", {"color": PAPER, "marker": "^"}),
    "seconds_mpm": ("our MPM", {"color": OURS, "marker": "s"}),
}
TOLD = {
    "paper_mpm": ("paper: MPM, 56 cores", {"color": "0.6", "marker": "s"}),
    "paper_cpu": ("paper: GNS, CPU", {"color": "#5a8f3c", "marker": "D"}),
    "paper_gpu": ("paper: GNS, A100", {"color": "#5a8f3c", "marker": "*"}),
}


def speed(rows: Sequence[Row], path: Path) -> None:
    """Seconds per rollout step over points, one panel a network and device; edges below."""
    panels = list(dict.fromkeys((row["network"], row["device"]) for row in rows))
    figure = Figure(figsize=(4.6 * len(panels) + 0.4, 6.8), layout="constrained")
    grid = figure.subplots(2, len(panels), squeeze=False, height_ratios=(1.7, 1), sharex="col")
    for (top, bottom), (network, device) in zip(grid.T, panels, strict=True):
        mine = [r for r in rows if (r["network"], r["device"]) == (network, device)]
        for key, (label, style) in {**KINDS, **TOLD}.items():
            points = [(r["points"], r[key]) for r in mine if r[key] is not None]
            if points:
                line = ":" if key in TOLD else "-"
                top.plot(*zip(*points, strict=True), label=label, linestyle=line, **style)
        top.set_title(f"{network}, {device}")
        top.set_ylabel("seconds per step")
        edges = [(r["points"], r["edges"]) for r in mine]
        bottom.plot(*zip(*edges, strict=True), color=OURS, marker="o", label="ours")
        told = [(r["points"], r["paper_edges"]) for r in mine if r["paper_edges"] is not None]
        if told:
            style = {"color": "#5a8f3c", "marker": "*", "linestyle": ":"}
            bottom.plot(*zip(*told, strict=True), label="paper", **style)
        bottom.set(xlabel="points", ylabel="edges")
        for axes in (top, bottom):
            axes.set(xscale="log", yscale="log")
            axes.margins(x=0.12, y=0.15)
            tidy(axes)
            if axes.lines:
                axes.legend(frameon=False, fontsize=8)
    save_figure(figure, path)


def training(rows: Sequence[Row], path: Path) -> None:
    """Seconds and memory of a training step, a group of bars a network and device."""
    figure = Figure(figsize=(max(7.0, 2.3 * len(rows) + 2), 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    paper_gb = [None if r["paper_memory_gb"] is None else 1024 * r["paper_memory_gb"] for r in rows]
    _bars(left, rows, "seconds", [r["paper_seconds"] for r in rows], "seconds per training step")
    _bars(right, rows, "memory", paper_gb, "peak memory [MB]")
    right.legend(frameon=False, fontsize=8, loc="upper right")
    save_figure(figure, path)


def _bars(
    axes: Axes, rows: Sequence[Row], what: str, paper: Sequence[float | None], label: str
) -> None:
    place = np.arange(len(rows))
    unit = "_mb" if what == "memory" else ""
    kinds = (
        ("", "ours, float32", LEARNED),
        ("_bfloat16", "ours, bfloat16", "#e3a583"),
        ("_plain", "plain network", PAPER),
    )
    groups = [
        (name, colour, [r[f"{what}{kind}{unit}"] for r in rows]) for kind, name, colour in kinds
    ]
    groups.append(("paper, A100", "#5a8f3c", list(paper)))
    for number, (name, colour, values) in enumerate(groups):
        bars = axes.bar(
            place + 0.2 * (number - 1.5),
            [np.nan if v is None else v for v in values],
            0.19, color=colour, label=name,
        )  # fmt: skip
        axes.bar_label(
            bars, ["" if v is None else f"{v:.2g}" if v < 100 else f"{v:.0f}" for v in values],
            fontsize=7,
        )  # fmt: skip
    axes.set_yscale("log")
    axes.margins(y=0.25)
    ticks = [f"{r['network']}\n{r['edges'] / 1e3:.0f}K edges, {r['device']}" for r in rows]
    axes.set_xticks(place, ticks, fontsize=8)
    axes.set_ylabel(label)
    tidy(axes)

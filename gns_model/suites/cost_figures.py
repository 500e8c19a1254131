"""Figures of cost: seconds per step and edges by number of points, and a training step."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

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
#: Column of the paper's table, label and style.
TOLD = (
    (1, "paper: MPM, 56 cores", {"color": "0.6", "marker": "s"}),
    (2, "paper: GNS, CPU", {"color": "#8fb573", "marker": "D"}),
    (3, "paper: GNS, A100", {"color": "#5a8f3c", "marker": "*"}),
)

#: Points -> edges and the seconds of TOLD.
Table = Mapping[int, tuple[float | None, ...]]


def speed(rows: Sequence[Row], told: Mapping[int, Table], path: Path) -> None:
    """Seconds per rollout step over points, one panel a network and device; edges below.

    Args:
        told: the paper's table by dimension, drawn where the network is the paper's.
    """
    panels = list(dict.fromkeys((row["network"], row["device"]) for row in rows))
    figure = Figure(figsize=(4.6 * len(panels) + 0.4, 7.2), layout="constrained")
    grid = figure.subplots(2, len(panels), squeeze=False, height_ratios=(1.9, 1), sharex="col")
    for (top, bottom), (network, device) in zip(grid.T, panels, strict=True):
        mine = [r for r in rows if (r["network"], r["device"]) == (network, device)]
        table = told.get(mine[0]["dim"], {}) if mine[0]["of_paper"] else {}
        for key, (label, style) in KINDS.items():
            _line(top, [(r["points"], r[key]) for r in mine], label, "-", style)
        for column, label, style in TOLD:
            _line(top, [(n, values[column]) for n, values in table.items()], label, ":", style)
        top.set(title=f"{network}, {device}", ylabel="seconds per step")
        edges = {"color": OURS, "marker": "o"}
        _line(bottom, [(r["points"], r["edges"]) for r in mine], "ours", "-", edges)
        edges = {"color": "#5a8f3c", "marker": "*"}
        _line(bottom, [(n, values[0]) for n, values in table.items()], "paper", ":", edges)
        bottom.set(xlabel="points", ylabel="edges")
        for axes in (top, bottom):
            _decades(axes)
            if axes.lines:
                axes.legend(frameon=False, fontsize=8)
    save_figure(figure, path)


def _line(
    axes: Axes, points: Sequence[tuple[int, float | None]], label: str, line: str, style: Row
) -> None:
    known = [(x, y) for x, y in points if y is not None]
    if known:
        axes.plot(*zip(*known, strict=True), label=label, linestyle=line, **style)


def _decades(axes: Axes) -> None:
    """Logarithmic axes over whole decades, so that there are always ticks to read."""
    axes.set(xscale="log", yscale="log")
    for values, limit in ((0, axes.set_xlim), (1, axes.set_ylim)):
        every = np.concatenate([np.asarray(line.get_data()[values], float) for line in axes.lines])
        limit(10 ** np.floor(np.log10(every.min())), 10 ** np.ceil(np.log10(every.max() * 1.01)))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_minor_formatter(NullFormatter())
    tidy(axes)


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
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.margins(y=0.25)
    ticks = [f"{r['network']}\n{r['edges'] / 1e3:.0f}K edges, {r['device']}" for r in rows]
    axes.set_xticks(place, ticks, fontsize=8)
    axes.set_ylabel(label)
    tidy(axes)

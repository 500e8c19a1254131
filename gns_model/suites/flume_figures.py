"""Figure of the flume over time: runout, upstream depth, energies."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from gns_model.evaluation_figures import save_figure
from gns_model.suites.column_figures import LEARNED, PAPER, Path, curve, energy_panel, tidy
from gns_model.suites.pair import Pair
from gns_model.suites.result import Row

DASHED = (0, (3, 2))
GREEN = "#5a8f3c"


def evolution(rows: Sequence[Row], pair: Pair, name: str, path: Path) -> None:
    """Four panels over time [s]: how far, how deep, energies, energy held back by the baffles."""
    figure = Figure(figsize=(10.5, 7.6), layout="constrained")
    (far, deep), (energy, held) = figure.subplots(2, 2, sharex=True)
    labels = {"front": "front", "p99": "p99", "centroid": "centroid"}
    _lines(far, rows, labels, name)
    far.set(ylabel="travel along x [m]", ylim=(0, None))
    depths = {k: k[6:].replace("_", " ") for k in rows[0] if _is_depth(k)}
    _lines(deep, rows, depths, name)
    top = max(box[1, 1] for box in pair.scene.baffle_boxes()) - pair.scene.base
    deep.axhline(top, color="0.5", linewidth=0.8)
    deep.text(0.0, top, " height of the baffles", va="bottom", color="0.4", fontsize=9)
    deep.set(ylabel="depth upstream of a row [m]", ylim=(0, max(1.15 * top, deep.get_ylim()[1])))
    energy_panel(energy, rows, curve(rows, "time"), name, legend=True)
    _lines(held, rows, {"held_back": "upstream minus downstream"}, name)
    held.set(ylabel=r"$(E_p + E_k)/E_0$ held back by the baffles")
    for axes in (energy, held):
        axes.set_xlabel("t [s]")
    save_figure(figure, path)


def _is_depth(key: str) -> bool:
    return key.startswith("depth_row_") and not key.endswith("_mpm")


def _lines(axes: Axes, rows: Sequence[Row], labels: dict[str, str], name: str) -> None:
    time = curve(rows, "time")
    marks = []
    for (key, label), colour in zip(labels.items(), (LEARNED, PAPER, GREEN), strict=False):
        axes.plot(time, curve(rows, f"{key}_mpm"), color=colour, linewidth=1.6)
        axes.plot(time, curve(rows, key), color=colour, linewidth=1.6, linestyle=DASHED)
        marks.append(Line2D([], [], color=colour, label=label))
    marks += [
        Line2D([], [], color="0.3", label="our MPM"),
        Line2D([], [], color="0.3", linestyle=DASHED, label=name),
    ]
    axes.legend(handles=marks, frameon=False, fontsize=9)
    tidy(axes)

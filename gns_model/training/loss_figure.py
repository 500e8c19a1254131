"""`loss.png`: the loss history, in the shape of the paper's, and what the rollouts scored."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from gns_model.files import write_whole
from gns_model.training.logs import read_table

LOG, VALIDATION, PLOT = "log.csv", "validation.csv", "loss.png"

TRAINING, HELD_OUT, SCORE = "#4477aa", "#cc6644", "#1d1b18"
#: Of the measures, in the order of their columns; told apart without colour vision, too.
MEASURES = ("#4477aa", "#ccaa22", "#228833", "#aa3377", "#66ccee", "#cc6644")
#: Share of the run that the smoothed training loss looks back over.
SMOOTHING = 0.02

LABELS = {
    "runout_max": "runout of the front",
    "centroid_travel": "centroid travel",
    "runout_p99": "runout, 99%",
    "upstream_depth": "upstream depth",
    "mass_past_section": "mass past section",
    "energy": "energy over time",
}

#: Columns of the validation log that are no relative errors.
OTHER = ("step", "seconds", "score", "one_step", "drive", "slope", "diverged")


def plot(out: Path) -> None:
    """Draw `loss.png` from the logs in `out`, all over the steps and on log axes: the losses, the
    relative errors of the validation rollouts, and their score."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogFormatter

    class Plain(LogFormatter):
        """Chooses as its parent which ticks get a label, and writes 0.1 for 1e-01."""

        def __call__(self, x: float, pos: int | None = None) -> str:
            return f"{x:g}" if super().__call__(x, pos) else ""

    log, checks = read_table(out / LOG), read_table(out / VALIDATION)
    if not log:
        return
    heights = (2.0, 1.5, 0.8) if checks else (1.0,)
    figure = Figure(figsize=(7.2, 7.4 if checks else 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    rows = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    steps, losses = _columns(log, "step", "loss")
    rows[0].plot(steps, losses, color=TRAINING, lw=0.6, alpha=0.4)
    rows[0].plot(steps, smoothed(losses), color=TRAINING, lw=1.8, label="training, with noise")
    x, share = _columns(log, "step", "unrolled")
    if share.any() and not share[0]:  # the loss jumps here: it is asked for another thing
        for axes in rows:
            axes.axvline(x[share.argmax()], color=SCORE, lw=0.8, ls=":")
        rows[0].plot([], [], color=SCORE, lw=0.8, ls=":", label="unrolled from here")
    rows[0].set_ylabel("loss: mean square of\nnormalised acceleration")
    if checks:
        x, y = _columns(checks, "step", "one_step")
        rows[0].plot(x, y, "o-", color=HELD_OUT, ms=4, lw=1.5, label="held out, without noise")
        names = [n for n in dict.fromkeys(n for row in checks for n in row) if n not in OTHER]
        for name, color in zip(names, MEASURES * len(names), strict=False):
            x, y = _columns(checks, "step", name)
            rows[1].plot(
                x, 100 * y, "o-", color=color, ms=3.5, lw=1.3, label=LABELS.get(name, name)
            )
        rows[1].set_ylabel("error of held-out\nrollouts [%]")
        x, y = _columns(checks, "step", "score")
        rows[2].plot(x, y, "s-", color=SCORE, ms=4, lw=1.5)
        rows[2].set_ylabel("score: mean of\nerror / aim")
    for axes in rows:
        axes.set_yscale("log")
        for choose in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
            choose(Plain(labelOnlyBase=False, minor_thresholds=(1.5, 0.6)))
        axes.tick_params(axis="y", which="minor", labelsize=8)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", which="major", lw=0.4, color="#cfc8bc")
    for axes in rows[:2]:
        axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    rows[-1].set_xlabel("optimiser step")
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=130)
    write_whole(out / PLOT, content.getvalue())


def smoothed(values: np.ndarray) -> np.ndarray:
    """Exponential moving average over `SMOOTHING` of the values, unbiased from the first on."""
    decay = 1 - 1 / max(3.0, SMOOTHING * len(values))
    total, weight, out = 0.0, 0.0, np.empty(len(values))
    for k, value in enumerate(values):
        total, weight = decay * total + value, decay * weight + 1
        out[k] = total / weight
    return out


def _columns(rows: list[dict[str, float]], *names: str) -> tuple[np.ndarray, ...]:
    """Columns of a table, of the rows that have all of them."""
    whole = [row for row in rows if all(name in row for name in names)]
    return tuple(np.array([row[name] for row in whole]) for name in names)

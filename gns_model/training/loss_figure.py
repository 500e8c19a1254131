"""`loss.png`: the loss history, in the shape of the paper's, and what the rollouts scored."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from gns_model.scene import write_whole
from gns_model.training.logs import read_table

LOG, VALIDATION, PLOT = "log.csv", "validation.csv", "loss.png"

TRAINING, HELD_OUT, SCORE = "#4477aa", "#cc6644", "#1d1b18"
#: Of the measures, in the order of their columns; told apart without colour vision, too.
MEASURES = ("#4477aa", "#ccaa22", "#228833", "#aa3377", "#66ccee", "#cc6644")
#: Share of the run that the smoothed training loss looks back over.
SMOOTHING = 0.02

#: Columns of the validation log that are no relative errors.
OTHER = ("step", "seconds", "score", "one_step", "slope", "diverged")


def plot(out: Path) -> None:
    """Draw `loss.png` from the logs in `out`: above the losses over the steps, on a log axis; below
    the relative errors of the validation rollouts and their score."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    log, checks = read_table(out / LOG), read_table(out / VALIDATION)
    if not log:
        return
    figure = Figure(figsize=(7.2, 6.2 if checks else 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    rows = figure.subplots(2 if checks else 1, 1, sharex=True, squeeze=False)[:, 0]
    top = rows[0]
    steps, losses = _columns(log, "step", "loss")
    top.plot(steps, losses, color=TRAINING, lw=0.6, alpha=0.35)
    top.plot(steps, smoothed(losses), color=TRAINING, lw=1.8, label="training, with noise")
    if checks:
        at, held_out = _columns(checks, "step", "one_step")
        top.plot(at, held_out, "o-", color=HELD_OUT, ms=4, lw=1.5, label="held out, without noise")
        bottom = rows[1]
        names = [n for n in dict.fromkeys(n for row in checks for n in row) if n not in OTHER]
        for name, color in zip(names, MEASURES * len(names), strict=False):
            label = name.replace("_", " ").replace("p99", "(99%)").replace("max", "(front)")
            x, y = _columns(checks, "step", name)
            bottom.plot(x, 100 * y, "o-", color=color, ms=3.5, lw=1.3, label=label)
        x, y = _columns(checks, "step", "score")
        score = bottom.twinx()
        score.plot(x, y, "s--", color=SCORE, ms=4, lw=1.5, label="score (right)")
        score.set(ylabel="score: mean of error / aim", yscale="log")
        score.spines["top"].set_visible(False)
        bottom.set(ylabel="error of held-out rollouts [%]", yscale="log")
        handles = [axes.get_legend_handles_labels() for axes in (bottom, score)]
        bottom.legend(
            *(a + b for a, b in zip(*handles, strict=True)),
            loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=4, frameon=False, fontsize=8,
        )  # fmt: skip
        bottom.spines["top"].set_visible(False)
    top.set(ylabel="loss: mean square of\nnormalised acceleration", yscale="log")
    top.legend(frameon=False, fontsize=8)
    top.spines[["top", "right"]].set_visible(False)
    rows[-1].set_xlabel("optimiser step")
    for axes in rows:
        axes.grid(axis="y", which="major", lw=0.4, color="#cfc8bc")
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=130)
    write_whole(out / PLOT, content.getvalue())


def smoothed(values: np.ndarray) -> np.ndarray:
    """Exponential moving average over `SMOOTHING` of the values, unbiased from the first on."""
    decay = 1 - 1 / max(1.0, SMOOTHING * len(values))
    total, weight, out = 0.0, 0.0, np.empty(len(values))
    for k, value in enumerate(values):
        total, weight = decay * total + value, decay * weight + 1
        out[k] = total / weight
    return out


def _columns(rows: list[dict[str, float]], *names: str) -> tuple[np.ndarray, ...]:
    """Columns of a table, of the rows that have all of them."""
    whole = [row for row in rows if all(name in row for name in names)]
    return tuple(np.array([row[name] for row in whole]) for name in names)

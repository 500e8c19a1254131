"""The figures of a run by name, each a function of what the run folder holds and a theme.

Every function returns a matplotlib Figure, or None where the run does not hold what it shows.
`write_figures` writes the light ones as PNG into the folder; the report also embeds dark ones.
"""

from __future__ import annotations

import io
from collections.abc import Callable

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from design.agreement_figures import agreement, deposit
from design.flow_figures import plan_over_time, side_over_time
from design.front_figures import front
from design.results import RunResults
from design.search_figures import history, trade_off
from design.theme import DARK, LIGHT, Theme
from gns_model.files import write_whole

#: Sharp on a page about 1080 CSS pixels wide, also on a dense screen.
DPI = 170

FIGURES: dict[str, Callable[[RunResults, Theme], Figure | None]] = {
    "plan": plan_over_time,
    "side": side_over_time,
    "deposit": deposit,
    "agreement": agreement,
    "front": front,
    "tradeoff": trade_off,
    "history": history,
}


def write_figures(run: RunResults) -> dict[str, tuple[bytes, bytes]]:
    """Write every figure that the run has the data for as figures/{name}.png, light.

    Returns:
        PNG bytes by name, for paper and for a dark screen.
    """
    pictures = {}
    for name in FIGURES:
        light = png(run, name, LIGHT)
        if light is not None:
            write_whole(run.folder / "figures" / f"{name}.png", light)
            pictures[name] = light, png(run, name, DARK) or light
    return pictures


def png(run: RunResults, name: str, theme: Theme) -> bytes | None:
    """One figure as PNG bytes with a palette (a third of the size), or None without data."""
    with mpl.rc_context(theme.rc()):
        figure = FIGURES[name](run, theme)
        if figure is None:
            return None
        figure.set_dpi(DPI)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    small = io.BytesIO()
    picture.quantize(256, dither=Image.Dither.NONE).save(small, "PNG", optimize=True)
    return small.getvalue()

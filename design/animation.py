"""flow.gif: the best layout beside the one it is compared with, in plan and from the side."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.text import Text
from PIL import Image

from design import views, wording
from design.flow_figures import Shown, shown_flows
from design.results import Design, RunResults
from design.theme import DARK, Theme, layout_colour
from gns_model.files import write_whole
from gns_model.trajectory import Trajectory

#: Frames of the loop, and how long each is shown and the last one is held [ms].
FRAMES, FRAME_MS, HOLD_MS = 46, 90, 1800

#: Largest file that is still mailed and embedded without a thought [bytes].
MOST_BYTES = 3_000_000


def write_animation(run: RunResults, *, most_bytes: int = MOST_BYTES) -> Path | None:
    """Write flow.gif into the run folder, whole, at most `most_bytes`; None without a trajectory.

    One dark version serves both themes of the page: a film is dark on either.
    """
    shown = shown_flows(run)
    if shown is None:
        return None
    for dpi in (110, 92, 76, 60):
        content = _gif(_frames(shown, DARK, dpi))
        if len(content) <= most_bytes:
            break
    path = run.folder / "flow.gif"
    write_whole(path, content)
    return path


def slow_motion(flow: Trajectory) -> float:
    """How many times slower than life the animation plays."""
    span = float(flow.time[-1] - flow.time[0])
    return FRAMES * FRAME_MS / 1000 / span if span > 0 else 1.0


def _frames(shown: Shown, theme: Theme, dpi: int) -> list[Image.Image]:
    times = np.linspace(0.0, float(min(flow.time[-1] for _, flow in shown.flows)), FRAMES)
    slower = slow_motion(shown.flows[0][1])
    with mpl.rc_context(theme.rc()):
        figure, panels, clock = _stage(shown, theme)
        figure.set_dpi(dpi)
        canvas = FigureCanvasAgg(figure)
        # Axes and labels are drawn once; a frame is then the maps, what stands on them, the clock.
        for _, _, image in panels:
            for artist in (image, *image.axes.patches, *image.axes.lines):
                artist.set_animated(True)
        clock.set_animated(True)
        canvas.draw()
        still = canvas.copy_from_bbox(figure.bbox)
        pictures = []
        for time in times:
            canvas.restore_region(still)
            for flow, to_map, image in panels:
                image.set_data(views.as_image(to_map(flow, views.frame_at(flow, time))))
                for artist in (image, *image.axes.patches, *image.axes.lines):
                    image.axes.draw_artist(artist)
            clock.set_text(f"t = {time:.2f} s    {slower:.0f}× slower than life")
            figure.draw_artist(clock)
            pictures.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))
    return pictures


def _stage(
    shown: Shown, theme: Theme
) -> tuple[Figure, list[tuple[Trajectory, Callable[..., views.Map], AxesImage]], Text]:
    """The figure with everything that does not move, and what does: (flow, map, image), clock."""
    flows = shown.flows
    scene = flows[0][1].scene
    plan = scene.dim == 3
    length, height = scene.domain.size[0], views.side_top(scene) - scene.base
    ratios = ([scene.domain.size[2]] if plan else []) + [height]
    column = 4.1 if len(flows) > 1 else 6.0
    # Title, note and tick labels need a fixed height; the views scale with the column.
    figure = Figure(
        figsize=(column * len(flows), 0.88 * column * sum(ratios) / length + 1.35),
        layout=ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.05, wspace=0.0, hspace=0.0),
    )
    grid = figure.subplots(
        len(ratios), len(flows), height_ratios=ratios, squeeze=False, sharex=True
    )
    panels = []
    for number, (column_axes, (design, flow)) in enumerate(zip(grid.T, flows, strict=True)):
        colour = layout_colour(theme, design.key)
        rows = [(views.side_map, views.draw_side, "y [m]")]
        if plan:
            rows.insert(0, (views.plan_map, views.draw_plan, "z [m]"))
        for axes, (to_map, draw, label) in zip(column_axes, rows, strict=True):
            image = views.draw_map(axes, to_map(flow, 0), theme, _top(flows, to_map))
            draw(axes, flow.scene, theme, colour)
            panels.append((flow, to_map, image))
            if number == 0:
                axes.set_ylabel(label)
            else:
                axes.tick_params(labelleft=False)
        travel = design.verified or design.surrogate
        text = design.label
        if "centroid_travel" in travel:
            quantity = wording.quantities(scene)[0]
            text += f" · centroid {quantity.text(travel['centroid_travel'])}"
        column_axes[0].set_title(text, color=colour)
        column_axes[-1].set_xlabel("x [m]")
    clock = figure.suptitle(" ", color=theme.ink, x=0.012, ha="left", fontsize=10.5)
    figure.text(0.988, 0.985, shown.by, color=theme.muted, ha="right", va="top", fontsize=9)
    return figure, panels, clock


def _top(flows: list[tuple[Design, Trajectory]], to_map: Callable[..., views.Map]) -> float:
    """One colour scale for all panels of a kind: nearly the largest value at a few instants."""
    seen = [
        to_map(flow, frame).values.ravel()
        for _, flow in flows
        for frame in (np.linspace(0.3, 1, 4) * (len(flow.time) - 1)).astype(int)
    ]
    values = np.concatenate(seen)
    return float(np.quantile(values[values > views.LEAST_SHOWN], 0.985))


def _gif(pictures: list[Image.Image]) -> bytes:
    """One palette for all frames: with a palette each, colours would flicker."""
    chosen = [np.asarray(pictures[int(k * (len(pictures) - 1))]) for k in (0.2, 0.5, 1.0)]
    palette = Image.fromarray(np.concatenate(chosen)).quantize(
        128, kmeans=1, dither=Image.Dither.NONE
    )
    frames = [p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures]
    durations = [FRAME_MS] * (len(frames) - 1) + [HOLD_MS]
    content = io.BytesIO()
    frames[0].save(
        content,
        "GIF",
        save_all=True,
        append_images=frames[1:],
        duration=durations,
        loop=0,
        optimize=False,
    )
    return content.getvalue()

"""Plan and side of a flow as smooth maps, drawn into matplotlib axes.

A map is a mass-conserving density: grains are counted in cells as wide as their spacing, blurred
by about one cell, and given the unit that an engineer reads: metres of depth in plan, share of
the width filled from the side. It looks alike for the fine solver and for the coarse surrogate,
which a scatter of points does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.image import AxesImage
from matplotlib.patches import Polygon, Rectangle
from matplotlib.ticker import MultipleLocator
from scipy.ndimage import gaussian_filter

from design.theme import Theme
from gns_env.deposit import depth_map
from gns_model.measures import moving_positions
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory

#: Depth [m] below which a map shows the ground: less than a layer of single grains.
LEAST_SHOWN = 0.003


@dataclass(frozen=True)
class Map:
    """values: shape (nx, ny), cell averages; extent: (left, right, bottom, top) [m]."""

    values: np.ndarray
    extent: tuple[float, float, float, float]


def spacing(trajectory: Trajectory) -> float:
    """Distance between the points at the start [m]."""
    return trajectory.point_volume ** (1 / trajectory.scene.dim)


def frame_at(trajectory: Trajectory, time: float) -> int:
    """Index of the frame nearest to `time` [s]."""
    return int(np.abs(np.asarray(trajectory.time) - time).argmin())


def plan_map(trajectory: Trajectory, frame: int, *, cell: float | None = None) -> Map:
    """Depth of material over the plan (x, z) [m] in one frame of a 3D trajectory."""
    depth = depth_map(trajectory, frame, cell or spacing(trajectory))
    low, high = trajectory.scene.domain.lower, trajectory.scene.domain.upper
    return Map(_blur(depth), (low[0], high[0], low[2], high[2]))


def side_map(trajectory: Trajectory, frame: int, *, cell: float | None = None) -> Map:
    """Share of the width [-] that is filled, over (x, y) in one frame; in 2D the packing."""
    scene, cell = trajectory.scene, cell or spacing(trajectory)
    low, high = np.array(scene.domain.lower[:2]), np.array(scene.domain.upper[:2])
    shape = np.maximum(np.rint((high - low) / cell).astype(int), 1)
    points = moving_positions(trajectory)[frame][:, :2]
    counts, _ = np.histogramdd(
        points, bins=[int(n) for n in shape], range=list(zip(low, high, strict=True))
    )
    width = scene.domain.size[2] if scene.dim == 3 else 1.0
    filled = counts * trajectory.point_volume / (float(np.prod((high - low) / shape)) * width)
    return Map(_blur(filled), (low[0], high[0], low[1], high[1]))


def surface(
    trajectory: Trajectory, frame: int, *, cell: float = 0.03
) -> tuple[np.ndarray, np.ndarray]:
    """Mean depth across the width [m] over x [m] in one frame: two arrays of shape (nx,)."""
    depth = depth_map(trajectory, frame, cell)
    depth = depth.reshape(len(depth), -1).mean(axis=1)
    low, high = trajectory.scene.domain.lower[0], trajectory.scene.domain.upper[0]
    x = low + (np.arange(len(depth)) + 0.5) * (high - low) / len(depth)
    return x, _blur(depth)


def draw_map(axes: Axes, shown: Map, theme: Theme, top: float) -> AxesImage:
    """Draw a map from nothing to `top`; returns the image, whose data an animation replaces."""
    return axes.imshow(
        as_image(shown),
        extent=shown.extent,
        origin="lower",
        cmap=theme.colormap(),
        vmin=0.0,
        vmax=top,
        interpolation="bicubic",
        aspect="equal",
        zorder=0,
    )


def as_image(shown: Map) -> np.ndarray:
    """The values as imshow wants them, rows along the second axis, (ny, nx)."""
    values = shown.values.T
    return np.where(values < LEAST_SHOWN, 0.0, values)


def draw_plan(axes: Axes, scene: Scene, theme: Theme, colour: str, *, ticks: float = 0.6) -> None:
    """Frame and baffles of a 3D scene in plan, x to the right and z upwards."""
    lower, upper = scene.domain.lower, scene.domain.upper
    for corners in scene.footprints():
        axes.add_patch(Polygon(corners, **_block(theme, colour)))
    axes.axvline(scene.control_section, color=theme.muted, lw=0.8, ls=(0, (1, 2)))
    _frame(axes, (lower[0], upper[0]), (lower[2], upper[2]), ticks)


def draw_side(axes: Axes, scene: Scene, theme: Theme, colour: str, *, ticks: float = 0.6) -> None:
    """Frame and baffles of a scene from the side, x to the right and y upwards."""
    lower, upper = scene.domain.lower, scene.domain.upper
    # In 3D baffles stand at different depths of the view: let the flow shine through.
    alpha = 0.45 if scene.dim == 3 else 1.0
    for low, high in scene.baffle_boxes():
        style = _block(theme, colour, alpha)
        axes.add_patch(Rectangle(tuple(low[:2]), *(high - low)[:2], **style))
    axes.axvline(scene.control_section, color=theme.muted, lw=0.8, ls=(0, (1, 2)))
    _frame(axes, (lower[0], upper[0]), (lower[1], side_top(scene)), ticks)


def side_top(scene: Scene) -> float:
    """Height to which a side view is worth drawing [m]: above it nothing is ever seen."""
    tallest = max([r.upper[1] for r in scene.releases] + [b[1, 1] for b in scene.baffle_boxes()])
    return min(scene.domain.upper[1], scene.base + 1.45 * (tallest - scene.base))


def _block(theme: Theme, colour: str, alpha: float = 1.0) -> dict[str, Any]:
    return {
        "facecolor": colour,
        "edgecolor": theme.paper,
        "linewidth": 0.8,
        "alpha": alpha,
        "zorder": 3,
    }


def _frame(axes: Axes, x: tuple[float, float], y: tuple[float, float], ticks: float) -> None:
    axes.set(xlim=x, ylim=y, aspect="equal")
    axes.grid(False)
    axes.tick_params(length=2.5, pad=2)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MultipleLocator(ticks if axis is axes.xaxis else ticks / 2))
    for side in axes.spines.values():
        side.set_visible(True)


def _blur(values: np.ndarray) -> np.ndarray:
    """Smoothed by about a cell; nothing is lost at the walls."""
    return gaussian_filter(values, 1.1, mode="reflect")

"""Plan and side views of a trajectory, drawn with matplotlib's Agg canvas.

The plan shows the depth of material in every cell of the base, the side view every grain coloured
by its speed. A `View` keeps its figure and only moves the data, so that a film of a flow costs tens
of milliseconds a frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from gns_env.deposit import depth_map
from gns_env.task import BaffleTask, Evaluation
from gns_model.measures import WINDOW_LENGTH, moving_positions
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory

INK, MUTED, HAIRLINE = "#1d1b18", "#6d675d", "#cfc8bc"
BAFFLE, GROUND, WATERMARK = "#2f4858", "#f6f3ee", "#1565a8"
SAND = LinearSegmentedColormap.from_list(
    "sand", [GROUND, "#ecdcb8", "#dcae5c", "#b8722c", "#7c3f17", "#42200d"]
)
SPEED = LinearSegmentedColormap.from_list("speed", ["#7c5a36", "#c98f45", "#e8c07a", "#5fb0c9"])
#: Speed [m/s] at the top of the colour scale: that of the paper's release.
TOP_SPEED = 2.0
#: Depth [m] below which the plan shows the ground: less than a layer of single grains.
LEAST_DEPTH = 0.002
#: Labels of depths keep this far apart along x [m].
LABEL_ROOM = 0.15
#: A rendered frame [inch], at DPI dots an inch: its width, that of a view, and the margins.
WIDTH, VIEW, LEFT, TOP, BOTTOM, BETWEEN, DPI = 6.4, 4.9, 0.62, 0.42, 0.5, 0.22, 100
#: Views of very long or very short domains are kept between these heights [inch].
SHORTEST, TALLEST = 0.6, 6.0


def rest_image(state: Evaluation, task: BaffleTask) -> NDArray[np.uint8]:
    """Where the flow of `state` came to rest, as RGB, shape (H, W, 3), with the peak depth at every
    baffle: written on it in the plan, a line upstream of its face in the side view.

    Raises:
        ValueError: if the evaluation holds no trajectory.
    """
    if state.trajectory is None:
        raise ValueError("only an evaluation that kept its last frames can be drawn")
    film = Film(state.trajectory)
    film.mark_depths(state.depths[np.lexsort(state.centres.T[::-1])] if len(state.centres) else [])
    placed = f"{len(state.centres)} of {task.space.n_baffles} baffles"
    outcome = state.status if state.failed else f"cost {state.cost:.3f}"
    return film.image(-1, f"{task.scene.name} ({task.simulator.name}): {placed}, {outcome}")


class PlanView:
    """The plan of one trajectory in `axes`; `show(frame)` moves it to a frame."""

    def __init__(self, axes: Axes, trajectory: Trajectory) -> None:
        scene = trajectory.scene
        if scene.dim != 3:
            raise ValueError("a 2D scene has no plan")
        self.trajectory = trajectory
        # Cells as wide as the grains' first distance, then blurred by about one: no moiré.
        self.cell = trajectory.point_volume ** (1 / 3)
        lower, upper = scene.domain.lower, scene.domain.upper
        top = max([r.upper[1] - scene.base for r in scene.releases])
        self.image = axes.imshow(
            np.zeros((2, 2)),
            extent=(lower[0], upper[0], lower[2], upper[2]),
            origin="lower",
            cmap=SAND,
            vmin=0.0,
            vmax=0.8 * top,
            interpolation="bicubic",
        )
        for corners in scene.footprints():
            axes.add_patch(_block(corners))
        for r in scene.releases:
            corner, size = (r.lower[0], r.lower[2]), (r.size[0], r.size[2])
            axes.add_patch(Rectangle(corner, *size, fill=False, ec=MUTED, lw=0.8, ls=(0, (3, 2))))
        label = axes.annotate(
            "section",
            (scene.control_section, upper[2]),
            (3, -3),
            textcoords="offset points",
            color=MUTED,
            fontsize=7.5,
            va="top",
        )
        label.set_zorder(4)
        _dress(axes, trajectory, "z [m]", (lower[2], upper[2]))

    def show(self, frame: int) -> None:
        depth = gaussian_filter(depth_map(self.trajectory, frame, self.cell), 0.9, mode="reflect")
        self.image.set_data(np.where(depth < LEAST_DEPTH, 0.0, depth).T)

    def mark_depths(self, depths: Sequence[float] | NDArray[np.float32]) -> None:
        """Write the peak depth [m] at every baffle onto it."""
        boxes = self.trajectory.scene.baffle_boxes()
        for (low, high), depth in zip(boxes, depths, strict=True):
            x, z = (low + high)[[0, 2]] / 2
            self.image.axes.text(
                x,
                z,
                f"{depth:.2f}",
                color="white",
                fontsize=6.5,
                ha="center",
                va="center",
                zorder=5,
            )


class SideView:
    """The side of one trajectory in `axes`; `show(frame)` moves it to a frame."""

    def __init__(self, axes: Axes, trajectory: Trajectory) -> None:
        scene = trajectory.scene
        self.axes = axes
        self.trajectory, self.positions = trajectory, moving_positions(trajectory)
        top = _side_top(scene)
        # Grains at the far side wall are drawn first, the near ones over them.
        order = np.argsort(self.positions[0, :, 2]) if scene.dim == 3 else slice(None)
        self.positions = self.positions[:, order]
        # In 3D baffles stand at different depths of the view: the flow is drawn over pale ones.
        for low, high in scene.baffle_boxes():
            axes.add_patch(_block(_around(low[:2], high[:2]), pale=scene.dim == 3))
        self.points = axes.scatter(
            self.positions[0, :, 0],
            self.positions[0, :, 1],
            c=np.zeros(self.positions.shape[1]),
            cmap=SPEED,
            vmin=0.0,
            vmax=TOP_SPEED,
            linewidths=0,
            zorder=2,
        )
        _dress(axes, trajectory, "y [m]", (scene.base, top))
        # A grain is drawn about as large as it is, on the axes as they are when first shown.
        width = axes.get_window_extent().width / axes.figure.dpi
        grain = 72 * width / scene.domain.size[0] * trajectory.point_volume ** (1 / scene.dim)
        self.points.set_sizes([min(max(0.5 * grain, 1.0), 6.0) ** 2])

    def show(self, frame: int) -> None:
        frame %= len(self.positions)
        before = max(frame - 1, 0)
        interval = float(self.trajectory.time[max(frame, 1)] - self.trajectory.time[before])
        moved = self.positions[max(frame, 1)] - self.positions[before]
        self.points.set_offsets(self.positions[frame, :, :2])
        self.points.set_array(np.linalg.norm(moved, axis=1) / interval)

    def mark_depths(self, depths: Sequence[float] | NDArray[np.float32]) -> None:
        """Draw the peak depth [m] at every baffle, as a line in the window where it is read."""
        scene, axes = self.trajectory.scene, self.axes
        boxes = scene.baffle_boxes()
        labelled: list[float] = []
        # The deepest first: of baffles behind one another in this view it has the label.
        for k in np.argsort(-np.asarray(depths), kind="stable"):
            face, height = boxes[k, 0, 0], scene.base + depths[k]
            axes.plot([face - WINDOW_LENGTH, face], [height] * 2, color=WATERMARK, lw=2, zorder=5)
            if all(abs(face - other) > LABEL_ROOM for other in labelled):
                labelled.append(face)
                axes.annotate(
                    f"{depths[k]:.2f} m",
                    (face, height),
                    (-1, 2.5),
                    textcoords="offset points",
                    color=WATERMARK,
                    fontsize=7.5,
                    weight="bold",
                    ha="right",
                    zorder=5,
                )


class Film:
    """Frames of one trajectory as images, plan above side; the figure is drawn once."""

    def __init__(self, trajectory: Trajectory) -> None:
        scene = trajectory.scene
        self.trajectory = trajectory
        heights = [_side_top(scene) - scene.base]
        if scene.dim == 3:
            heights.insert(0, scene.domain.size[2])
        inches = [min(max(h * VIEW / scene.domain.size[0], SHORTEST), TALLEST) for h in heights]
        height = TOP + sum(inches) + BETWEEN * (len(inches) - 1) + BOTTOM
        self.figure = Figure(figsize=(WIDTH, round(height, 2)), dpi=DPI, facecolor="white")
        self.canvas = FigureCanvasAgg(self.figure)
        self.views: list[PlanView | SideView] = []
        top = height - TOP
        for k, inch in enumerate(inches):
            box = (LEFT / WIDTH, (top - inch) / height, VIEW / WIDTH, inch / height)
            axes = self.figure.add_axes(box)
            bar = self.figure.add_axes((box[0] + box[2] + 0.02, box[1], 0.018, box[3]))
            top -= inch + BETWEEN
            if len(inches) == 2 and k == 0:
                plan = PlanView(axes, trajectory)
                axes.tick_params(labelbottom=False)
                axes.set_xlabel("")
                self.views.append(plan)
                _colour_bar(bar, plan.image, "depth [m]")
            else:
                side = SideView(axes, trajectory)
                self.views.append(side)
                _colour_bar(bar, side.points, "speed [m/s]")
        self.title = self.figure.text(
            LEFT / WIDTH, 1 - 0.6 * TOP / height, "", color=INK, fontsize=10.5, weight="bold"
        )

    def mark_depths(self, depths: Sequence[float] | NDArray[np.float32]) -> None:
        """Show the peak depth [m] upstream of every baffle of the scene, in the scene's order."""
        for view in self.views:
            view.mark_depths(depths)

    def image(self, frame: int, title: str | None = None) -> NDArray[np.uint8]:
        """RGB of one frame, shape (H, W, 3), freshly allocated, under `title` or name and time."""
        for view in self.views:
            view.show(frame)
        name, time = self.trajectory.scene.name, self.trajectory.time[frame]
        self.title.set_text(title or f"{name} ({self.trajectory.simulator}), t = {time:.2f} s")
        self.canvas.draw()
        return np.asarray(self.canvas.buffer_rgba())[:, :, :3].copy()


def _side_top(scene: Scene) -> float:
    """Height to which a side view is worth drawing [m]: hardly anything is ever seen above it."""
    heights = [r.upper[1] for r in scene.releases] + [b[1, 1] for b in scene.baffle_boxes()]
    return float(min(scene.domain.upper[1], scene.base + 1.3 * (max(heights) - scene.base)))


def _around(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners (4, 2) of a rectangle along the axes, in order around it."""
    return np.array([low, (high[0], low[1]), high, (low[0], high[1])])


def _block(corners: NDArray[np.float64], pale: bool = False) -> Polygon:
    colours = (to_rgba(BAFFLE, 0.28), BAFFLE) if pale else (BAFFLE, "white")
    return Polygon(
        corners,
        facecolor=colours[0],
        edgecolor=colours[1],
        lw=0.8,
        zorder=1 if pale else 3,
    )


def _colour_bar(axes: Axes, mappable: ScalarMappable, label: str) -> None:
    bar = axes.figure.colorbar(mappable, cax=axes, extend="max")
    bar.outline.set_visible(False)  # type: ignore[operator]
    bar.locator = MaxNLocator(5 if axes.get_position().height > 0.4 else 2, steps=[1, 2, 5, 10])
    bar.set_label(label, color=MUTED, fontsize=8.5)
    axes.tick_params(color=HAIRLINE, labelcolor=MUTED, labelsize=8, length=2.5)


def _dress(axes: Axes, trajectory: Trajectory, label: str, y: tuple[float, float]) -> None:
    scene = trajectory.scene
    axes.axvline(scene.control_section, color=MUTED, lw=0.9, ls=(0, (1, 2)), zorder=4)
    axes.set(xlim=(scene.domain.lower[0], scene.domain.upper[0]), ylim=y, aspect="equal")
    axes.set_facecolor(GROUND)
    axes.set_xlabel("x [m]", color=MUTED, fontsize=8.5, labelpad=2)
    axes.set_ylabel(label, color=MUTED, fontsize=8.5, labelpad=2)
    axes.yaxis.set_major_locator(
        MaxNLocator(9 if axes.get_position().height > 0.4 else 3, steps=[1, 2, 5, 10])
    )
    axes.tick_params(color=HAIRLINE, labelcolor=MUTED, labelsize=8, length=2.5)
    for spine in axes.spines.values():
        spine.set_color(HAIRLINE)

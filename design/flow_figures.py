"""The flow over time, the best layout above what it is compared with, in plan and from the side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from design import views
from design.results import LEARNED, SOLVER, Design, RunResults
from design.theme import WIDTH, Theme, layout_colour
from gns_model.trajectory import Trajectory

#: Shares of the time until the flow rests at which it is shown, before the end.
INSTANTS = (0.3, 0.6, 0.9)


@dataclass(frozen=True)
class Shown:
    """Flows that may stand side by side: by one simulator, so that only the layout differs.

    Attributes:
        flows: one or two layouts and their trajectories, the best first.
        by: who simulated them, for a reader.
    """

    flows: list[tuple[Design, Trajectory]]
    by: str


def shown_flows(run: RunResults) -> Shown | None:
    """The best layout's flow and one to compare it with: the scene's own, else no baffles.

    By the solver if it has run two of them, else by the search's simulator, else what there is.
    """
    alone = None
    for role, by in ((SOLVER, "reference solver"), (LEARNED, run.searcher)):
        flows = [
            (design, flow)
            for key in ("best", "paper", "none")
            if (design := run.design(key)) and (flow := run.trajectory(key, role))
        ][:2]
        if len(flows) == 2 and flows[0][0].key == "best":
            return Shown(flows, by)
        if flows and alone is None:
            alone = Shown(flows[:1], by)
    return alone


def plan_over_time(run: RunResults, theme: Theme) -> Figure | None:
    """Depth in plan at four instants: the best layout above what it is compared with."""
    return _over_time(run, theme, views.plan_map, views.draw_plan, "z [m]", "depth [m]", 3)


def side_over_time(run: RunResults, theme: Theme) -> Figure | None:
    """The same from the side: share of the width that is filled."""
    plane = run.scene is not None and run.scene.dim == 2
    quantity = "packing, 1 as released" if plane else "share of the width filled"
    return _over_time(run, theme, views.side_map, views.draw_side, "y [m]", quantity, 2)


def _over_time(
    run: RunResults,
    theme: Theme,
    to_map: Callable[..., views.Map],
    draw: Callable[..., None],
    ylabel: str,
    quantity: str,
    least_dim: int,
) -> Figure | None:
    shown = shown_flows(run)
    if shown is None or shown.flows[0][1].scene.dim < least_dim:
        return None
    rows = shown.flows
    scene = rows[0][1].scene
    side = to_map is views.side_map
    height = (views.side_top(scene) - scene.base) if side else scene.domain.size[-1]
    panel = (WIDTH - 1.35) / (len(INSTANTS) + 1)
    row = panel * height / scene.domain.size[0]
    engine = ConstrainedLayoutEngine(w_pad=0.03, h_pad=0.05, wspace=0.01, hspace=0.02)
    figure = Figure(figsize=(WIDTH, len(rows) * (row + 0.27) + 0.4), layout=engine)
    grid = figure.subplots(len(rows), len(INSTANTS) + 1, squeeze=False, sharex=True, sharey=True)
    times = _instants(rows[0][1])
    maps = [[to_map(flow, views.frame_at(flow, t)) for t in times] for _, flow in rows]
    # The block as released is deeper than all that follows: let it saturate.
    everything = np.concatenate([m.values.ravel() for line in maps for m in line[1:]])
    top = float(np.quantile(everything[everything > views.LEAST_SHOWN], 0.99))
    for r, (design, flow) in enumerate(rows):
        colour = layout_colour(theme, design.key)
        for c, t in enumerate(times):
            axes = grid[r, c]
            image = views.draw_map(axes, maps[r][c], theme, top)
            draw(axes, flow.scene, theme, colour)
            title = f"{design.label} · {t:.2f} s" if c == 0 else f"{t:.2f} s"
            axes.set_title(title, color=colour if c == 0 else theme.muted)
            if r == len(rows) - 1:
                axes.set_xlabel("x [m]")
        grid[r, 0].set_ylabel(ylabel)
    bar = figure.colorbar(
        image, ax=grid, aspect=38 if len(rows) > 1 else 20, pad=0.012, shrink=0.9, extend="max"
    )
    bar.set_label(quantity)
    bar.outline.set_visible(False)
    return figure


def _instants(flow: Trajectory) -> list[float]:
    """Four times of the flow [s]; the last is its end, the others lie before it rests."""
    x = views.moving_positions(flow)[:, :, 0].mean(axis=1)
    travelled = (x - x[0]) / max(float(x[-1] - x[0]), 1e-9)
    rest = float(flow.time[min(int(np.searchsorted(travelled, 0.985)), len(x) - 1)])
    return [share * rest for share in INSTANTS] + [float(flow.time[-1])]

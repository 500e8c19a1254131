"""Columns of six aspect ratios: the paper's table "Normalized runout" and the figures around it."""

from __future__ import annotations

from gns_model import paper
from gns_model.simulator import Simulator
from gns_model.suites import column_figures, frames
from gns_model.suites.collapse import collapse_curves, paper_columns
from gns_model.suites.fillings import Starts
from gns_model.suites.pair import CLOSING, PAPERS_RUNOUTS
from gns_model.suites.result import SuiteResult
from gns_model.suites.setup import Setup

#: Aspect ratios whose evolution is drawn: two short columns, the second the paper's, and its tall.
DRAWN = (0.5, 0.8, 2.0)
#: Aspect ratios of which the paper shows the flow at several times.
FRAMED = (0.8, 2.0)


def run(simulator: Simulator, setup: Setup) -> SuiteResult:
    """Roll out the paper's six columns, 1 s each, and write `columns*.csv` and `columns*.png`.

    Raises:
        SimulatorError, SceneError: if the simulator cannot run them.
    """
    scenes = [paper.column_scene(c) for c in paper.COLUMNS]
    starts = Starts.simulate(simulator, scenes, setup)
    rows, curves = [], []
    for k, (column, pair) in enumerate(zip(paper.COLUMNS, starts.pairs, strict=True)):
        rows.append(
            {
                "aspect": column.aspect,
                "height_0": column.height,
                "length_0": column.length,
                **starts.row(k),
                **paper_columns(column),
                **pair.facts(),
            }
        )
        curves.append(collapse_curves(pair, aspect=column.aspect))
    by_aspect = dict(zip([c.aspect for c in paper.COLUMNS], starts.pairs, strict=True))
    out, name = setup.out, simulator.name
    column_figures.runout_by_aspect(rows, name, out / "columns.png")
    chosen = [c for c in curves if c[0]["aspect"] in DRAWN]
    column_figures.evolution(chosen, name, out / "columns-evolution.png")
    column_figures.position_errors(curves, name, out / "columns-position-error.png")
    frames.deposits(by_aspect, name, out / "columns-deposits.png")
    files = ["columns.png", "columns-evolution.png", "columns-position-error.png"]
    files.append("columns-deposits.png")
    for aspect in FRAMED:
        files.append(f"columns-frames-a-{aspect:g}.png")
        frames.collapse(by_aspect[aspect], name, out / files[-1])
    return SuiteResult(
        suite="columns",
        title=f"Normalised runout of columns: {name} beside our MPM and the paper",
        rows=rows,
        warnings=starts.warnings,
        shown=(("aspect", "a = H0/L0", "g"), *starts.shown(*PAPERS_RUNOUTS, *CLOSING)),
        aims=starts.aims(rows, "the aspect ratios"),
        notes=[
            "Runout is that of the farthest point in the last frame. Errors are shares of the "
            "MPM's runout; the paper's own table divides by its GNS's. Centroid: the error of how "
            "far the centroid went."
        ],
        curves={"columns-curves": [row for curve in curves for row in curve]},
        files=files,
    )

"""The up-scaled column, a = 0.8 in 2.2 times the mass and a longer run: does size matter?"""

from __future__ import annotations

from gns_model import paper
from gns_model.simulator import Simulator
from gns_model.suites import column_figures, frames
from gns_model.suites.collapse import collapse_curves, paper_columns
from gns_model.suites.fillings import Starts
from gns_model.suites.pair import CLOSING, PAPERS_RUNOUTS, squared_errors
from gns_model.suites.result import Aim, Row, SuiteResult
from gns_model.suites.setup import Setup

#: The paper's 500 frames of 0.0025 s [s].
DURATION = 1.25
RUNOUT_AIM = 0.02

CASE = (
    ("case", "column", "s"),
    ("points", "points", "d"),
)


def run(simulator: Simulator, setup: Setup) -> SuiteResult:
    """Roll out the up-scaled column and, beside it, the small one of the same aspect ratio.

    Raises:
        SimulatorError, SceneError: if the simulator cannot run them.
    """
    large = paper.UPSCALED
    (small,) = (c for c in paper.COLUMNS if c.aspect == large.aspect)
    cases = {"up-scaled": large, "small": small}
    scenes = [
        paper.column_scene(large).replace(name="column-upscaled", duration=DURATION),
        paper.column_scene(small),
    ]
    starts = Starts.simulate(simulator, scenes, setup)
    pairs = starts.pairs
    rows: list[Row] = []
    curves = []
    for k, ((case, column), pair) in enumerate(zip(cases.items(), pairs, strict=True)):
        rows.append(
            {
                "case": case,
                "aspect": column.aspect,
                "height_0": column.height,
                "length_0": column.length,
                **starts.row(k),
                **paper_columns(column),
                **pair.facts(),
            }
        )
        curves.append(collapse_curves(pair, length_0=column.length))
    out, name = setup.out, simulator.name
    column_figures.upscaled(curves[0], curves[1], squared_errors(pairs[0]), pairs[0], name,
                            out / "upscaled.png")  # fmt: skip
    frames.collapse(pairs[0], name, out / "upscaled-frames.png")
    good = all(pair.good for pair in starts.fillings[0] or pairs[:1])
    error = abs(rows[0][starts.key]) if good else None
    return SuiteResult(
        suite="upscaled",
        title=f"The up-scaled column: {name} beside our MPM and the paper",
        rows=rows,
        warnings=starts.warnings,
        shown=(*CASE, *starts.shown(*PAPERS_RUNOUTS, *CLOSING)),
        aims=[Aim(f"runout error, up-scaled{starts.judged}", error, RUNOUT_AIM)],
        facts={"mass_ratio": large.height * large.length / (small.height * small.length)},
        curves={"upscaled-curves": [row for curve in curves for row in curve]},
        files=["upscaled.png", "upscaled-frames.png"],
    )

"""Runout by friction angle: the paper's multi-friction figure."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

from gns_model import paper
from gns_model.simulator import Simulator
from gns_model.suites import column_figures
from gns_model.suites.fillings import Starts
from gns_model.suites.pair import CLOSING
from gns_model.suites.result import Row, SuiteResult
from gns_model.suites.setup import Setup

#: A short column, the aspect ratio of the training, and a tall one.
ASPECTS = (0.5, 1.0, 2.0)
#: Twice as long as the paper's box [m], whose wall the flows of 15 and 22.5 degrees would reach.
DOMAIN = (2.0, 0.5)

CASE = (
    ("friction_angle", "friction angle [°]", "g"),
    ("aspect", "a = H0/L0", "g"),
)


def blind(simulator: Simulator) -> str | None:
    """Why the simulator cannot answer to the friction angle; None if it can."""
    config = getattr(simulator, "config", None)
    if config is None or "tan_friction_angle" in config.material_features:
        return None
    return "it does not see the friction angle (no material feature tan_friction_angle)"


def run(simulator: Simulator, setup: Setup) -> SuiteResult:
    """Roll out columns of three aspect ratios at five friction angles.

    Raises:
        SimulatorError, SceneError: if the simulator cannot run them.
    """
    columns = [replace(c, domain=DOMAIN) for c in paper.COLUMNS if c.aspect in ASPECTS]
    cases = [(angle, column) for angle in paper.FRICTION_ANGLES for column in columns]
    scenes = [
        paper.column_scene(column, friction_angle=angle).replace(
            name=f"column-a-{column.aspect:g}-phi-{angle:g}"
        )
        for angle, column in cases
    ]
    starts = Starts.simulate(simulator, scenes, setup)
    rows: list[Row] = [
        {
            "friction_angle": angle,
            "aspect": column.aspect,
            **starts.row(k),
            **pair.facts(),
        }
        for k, ((angle, column), pair) in enumerate(zip(cases, starts.pairs, strict=True))
    ]
    column_figures.runout_by_friction(rows, simulator.name, setup.out / "friction.png")
    reason = blind(simulator)
    return SuiteResult(
        suite="friction",
        title=f"Normalised runout by friction angle: {simulator.name} beside our MPM",
        rows=rows,
        warnings=starts.warnings,
        shown=(*CASE, *starts.shown(*CLOSING)),
        aims=starts.aims(rows, "friction angles and aspect ratios"),
        facts={
            f"{key}_falls_with_friction": all(_falls(rows, aspect, key) for aspect in ASPECTS)
            for key in ("runout", "runout_mpm")
        },
        notes=[
            "The paper shows this as a figure without numbers; base friction stays "
            f"{paper.COLUMN_BASE_FRICTION:g} at every angle.",
            *([f"{simulator.name}: {reason}."] if reason else []),
        ],
        files=["friction.png"],
    )


def _falls(rows: list[Row], aspect: float, key: str) -> bool:
    """Whether the runout of one column falls from every friction angle to the next."""
    values = [row[key] for row in rows if row["aspect"] == aspect]
    return all(a > b for a, b in pairwise(values))

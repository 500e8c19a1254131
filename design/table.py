"""trials.csv: every trial of a search as one row."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

import numpy as np

from design.form import FORM
from design.outcome import Trial
from design.space import DesignSpace, Space


def table(trials: Sequence[Trial], space: Space | None = None) -> str:
    """Trials as CSV text with a header; `space` says what varies beside the places."""
    measures = list(dict.fromkeys(name for t in trials for name in t.outcome.measures))
    axes = ("x", "z")
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    varied = space.names if isinstance(space, DesignSpace) else ()
    plan = trials[0].centres.shape[1] - len(varied) if trials else 0
    most = max((len(t.centres) for t in trials), default=0)
    columns = [f"{axes[j]}{k + 1}" for k in range(most) for j in range(plan)]
    limits = list(trials[0].outcome.excess) if trials else []
    spent = ["rollouts", "backwards", "seconds"]
    parts = [
        *(f"cost_{k + 1}" for k in range(max((len(t.outcome.costs) for t in trials), default=0))),
        *(f"flow_{k + 1}" for k in range(max((len(t.outcome.flows) for t in trials), default=0))),
    ]
    broken_by = [f"excess_{name}" for name in limits]
    writer.writerow(
        ["number", "origin", "status", "cost", *parts, *measures, *broken_by]
        + [*varied, *columns, *spent]
    )
    for t in trials:
        o = t.outcome
        writer.writerow(
            [t.number, t.origin, o.status, repr(float(o.cost))]
            + [repr(float(c)) for c in (*o.costs, *o.flows)]
            + [repr(float(o.measures[m])) if m in o.measures else "" for m in measures]
            + [f"{o.excess.get(name, 0.0):.6f}" for name in limits]
            + [f"{value:.6f}" for value in _form_of(space, t.centres).values()]
            + [f"{c:.6f}" for c in t.centres[:, :plan].ravel()]
            + [""] * ((most - len(t.centres)) * plan)
            + [o.rollouts, o.backwards, f"{o.seconds:.3f}"]
        )
    return text.getvalue()


def _form_of(space: Space | None, layout: np.ndarray) -> dict[str, float]:
    """What varies of the form of a layout, by name: sizes [m], yaw [degrees]."""
    if not isinstance(space, DesignSpace):
        return {}
    _, form = space.split(layout)
    known = {"yaw": form.yaw, **dict(zip(FORM, form.size, strict=False))}
    return {name: known[name] for name in space.names}

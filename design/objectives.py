"""Several objectives by name: `--objectives runout,depth`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from gns_env.objective import Objective, ObjectiveError

#: Name on the command line -> weight of `Objective` that it stands for.
NAMES = {
    "runout": "runout_weight",
    "p99": "runout_weight",
    "depth": "depth_weight",
    "mass": "mass_weight",
}


def parse(text: str) -> tuple[str, ...]:
    """Names from a comma-separated list.

    Raises:
        ObjectiveError: for an unknown or repeated name, fewer than two, or runout twice over.
    """
    names = tuple(part.strip() for part in text.split(","))
    for name in names:
        if name not in NAMES:
            raise ObjectiveError(f"no objective {name!r}: give two or more of {', '.join(NAMES)}")
    if len(set(names)) < len(names) or len(names) < 2:
        raise ObjectiveError(
            f"objectives must be two or more different ones of {', '.join(NAMES)}, got {text!r}"
        )
    if {"runout", "p99"} <= set(names):
        raise ObjectiveError("runout and p99 are two measures of one objective: give one of them")
    return names


def split(names: Sequence[str], weighing: Objective) -> tuple[Objective, ...]:
    """One objective for each name, with its weight in `weighing`, or 1 if that is 0.

    Weights do not change a front. They say which point of it is recommended: that of least sum.
    """
    nothing = replace(weighing, runout_weight=1.0, depth_weight=0.0, mass_weight=0.0)
    parts = []
    for name in names:
        weights: dict[str, Any] = {
            "runout_weight": 0.0,
            NAMES[name]: getattr(weighing, NAMES[name]) or 1.0,
        }
        part = replace(nothing, **weights)
        parts.append(replace(part, runout="runout_p99") if name == "p99" else part)
    return tuple(parts)


def joined(parts: Sequence[Objective]) -> Objective:
    """The sum of what `split` returned, as one objective."""
    weights = {
        name: sum(getattr(part, name) for part in parts) for name in dict.fromkeys(NAMES.values())
    }
    runout = next((p.runout for p in parts if p.runout_weight > 0), parts[0].runout)
    return Objective(**weights, runout=runout)

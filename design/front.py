"""A Pareto front in a run folder: entries of summary.json, front.csv, layouts/front-01.toml, ..."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from design.form import described
from design.outcome import Trial
from design.space import Space, form_of
from design.verify import Judged
from gns_env.objective import Objective
from gns_model.files import write_whole
from gns_model.scene import Scene


def front_entries(
    points: Sequence[Trial],
    parts: Sequence[Objective],
    names: Sequence[str],
    verified: Sequence[Judged],
    space: Space,
) -> list[dict[str, Any]]:
    """Plain values of every point of a front, in its order.

    `objectives` and `verified_objectives` are by name and relative to no baffles, without weights:
    1 is as without baffles. What the solver has not run has None.
    """

    judged = {j.centres.tobytes(): j for j in verified}
    entries = []
    for k, point in enumerate(points, 1):
        seen = judged.get(point.centres.tobytes())
        entries.append(
            {
                "point": k,
                "trial": point.number,
                "origin": point.origin,
                **described(point.centres, form_of(space, point.centres)),
                "file": f"layouts/{_name(k)}",
                "cost": point.cost,
                "objectives": relative(point.outcome.costs, parts, names),
                "surrogate": point.outcome.measures,
                "verified_objectives": relative(seen.verified_costs, parts, names)
                if seen
                else None,
                "verified_cost": seen.verified_cost if seen else None,
                "verified": seen.verified if seen else None,
                "verified_status": seen.verified_status if seen else None,
            }
        )
    return entries


def relative(
    costs: Sequence[float], parts: Sequence[Objective], names: Sequence[str]
) -> dict[str, float] | None:
    """Costs by name, without their weights: 1 is as without baffles; None if there are none."""
    if not costs:
        return None
    return {n: c / p.baseline for n, c, p in zip(names, costs, parts, strict=True)}


def write_front(folder: Path, bare: Scene, entries: Sequence[dict[str, Any]]) -> None:
    """Write front.csv and every layout, and delete what an earlier front left."""
    layouts = folder / "layouts"
    layouts.mkdir(parents=True, exist_ok=True)
    for entry in entries:
        placed = bare.with_baffles(entry["layout"], size=entry.get("size"), yaw=entry.get("yaw"))
        placed.to_toml(folder / entry["file"])
    kept = {Path(entry["file"]).name for entry in entries}
    for stale in layouts.glob("front-*.toml"):
        if stale.name not in kept:
            stale.unlink()
    write_whole(folder / "front.csv", table(entries).encode())


def table(entries: Sequence[dict[str, Any]]) -> str:
    """The front as CSV text with a header."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    first = entries[0] if entries else {}
    names, measures = list(first.get("objectives") or ()), list(first.get("surrogate") or ())
    layout: list[list[float]] = max((e["layout"] for e in entries), key=len, default=[])
    form = ["along", "height", "across"] if len(first.get("size", ())) == 3 else ["along", "height"]
    form = [*form, "yaw"] if first.get("size") else []
    axes = [f"{a}{k + 1}" for k, c in enumerate(layout) for a in ("x", "z")[: len(c)]]
    groups = (("", names, "objectives"), ("", measures, "surrogate"))
    solver = (("verified_", names, "verified_objectives"), ("verified_", measures, "verified"))
    columns = [f"{prefix}{n}" for prefix, group, _ in (*groups, *solver) for n in group]
    writer.writerow(
        ["point", "trial", "origin", "file", "cost", "verified_cost", *columns, *form, *axes]
    )
    for entry in entries:
        row = [entry[k] for k in ("point", "trial", "origin", "file", "cost", "verified_cost")]
        for _, group, key in (*groups, *solver):
            row += [(entry[key] or {}).get(n, "") for n in group]
        row += [*entry["size"], entry.get("yaw", 0.0)] if form else []
        row += [v for c in entry["layout"] for v in c]
        row += [""] * (len(axes) - sum(map(len, entry["layout"])))
        writer.writerow(["" if v is None else repr(v) if isinstance(v, float) else v for v in row])
    return text.getvalue()


def _name(point: int) -> str:
    return f"front-{point:02d}.toml"

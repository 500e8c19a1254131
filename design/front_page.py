"""The report's sections on a Pareto front and on scenarios, where a run has them."""

from __future__ import annotations

from html import escape

import numpy as np

from design import page
from design.drawing import thumbnail
from design.results import RunResults

#: What an objective is called in a table.
TITLES = {
    "runout": "centroid travel",
    "p99": "p99 runout",
    "depth": "upstream depth",
    "mass": "mass past",
}


def pareto(run: RunResults, pictures: dict[str, tuple[bytes, bytes]]) -> str:
    """The figure, and every point of the front with its file."""
    entries = run.summary.get("front")
    if not entries:
        return ""
    names = list(entries[0]["objectives"])
    parts = []
    if "front" in pictures:
        parts.append(
            page.picture(
                *pictures["front"],
                "Pareto front",
                "Down and left is better. A line joins what the two simulators say of one layout. "
                "Depth up to the free flow's counts as 1. Layouts far off the front are not drawn.",
            )
        )
    rows = []
    for e in entries:
        placed = (
            run.scene.with_baffles(e["layout"], size=e.get("size"), yaw=e.get("yaw"))
            if run.scene is not None
            else None
        )
        drawn = thumbnail(run.scene, placed, "ranked") if run.scene and placed else ""
        centres = " ".join(
            f'<span class="nowrap">({", ".join(f"{v:.3f}" for v in c)})</span>' for c in e["layout"]
        )
        verified = e["verified_objectives"] or {}
        failed = e["verified_status"] not in (None, "ok")
        rows.append(
            [
                drawn,
                f'<span class="key">{e["point"]}</span><small>{centres}</small>',
                *(f"{e['objectives'][n]:.3f}" for n in names),
                *(
                    f"{verified[n]:.3f}" if n in verified else ("failed" if failed else "–")
                    for n in names
                ),
                f'<a href="{escape(e["file"])}">{escape(e["file"].split("/")[-1])}</a>',
            ]
        )
    head = [
        "",
        "",
        *(f"{escape(TITLES[n])},<br>learned" for n in names),
        *(f"{escape(TITLES[n])},<br>solver" for n in names),
        "file",
    ]
    if run.searcher.startswith("search"):
        head = [h.replace("<br>learned", "<br>search") for h in head]
    parts.append(f'<div class="card">{page.table(head, rows, text=(1,))}</div>')
    count = sum(bool(e["verified_objectives"]) for e in entries)
    return page.section(
        "The Pareto front",
        *parts,
        intro=f"No layout that was tried is better than one of these {len(entries)} in one "
        "objective without being worse in another. All numbers are relative to no baffles: 1 is "
        f"the free flow. {count} of the points ran on the reference solver as well. The layout "
        "recommended above is the one of least weighted sum among those.",
    )


def scenarios(run: RunResults) -> str:
    """Every flow that was drawn, and what the best layout costs in it."""
    flows = run.summary.get("scenarios")
    if not flows:
        return ""
    risk = str(run.summary.get("risk") or "mean")
    shown = [
        (label, run.summary.get(key) or {})
        for label, key in (("best found", "best"), ("scene's own", "paper_layout"))
    ]
    columns = [
        (f"{label},<br>{who}", entry[key])
        for label, entry in shown
        for who, key in (("search", "flows"), ("solver", "verified_flows"))
        if len(entry.get(key) or []) == len(flows)
    ]
    rows = [
        [
            str(k + 1),
            f"{flow['speed']:.2f} m/s",
            f"{flow['volume']:.4g} m³",
            f"{flow['friction_angle']:.1f}°",
            *(f"{values[k]:.4f}" for _, values in columns),
        ]
        for k, flow in enumerate(flows)
    ]
    spread = [
        "range",
        "",
        "",
        "",
        *(f"{np.min(values):.4f} to {np.max(values):.4f}" for _, values in columns),
    ]
    head = ["", "speed", "volume", "friction angle", *(name for name, _ in columns)]
    return page.section(
        "The flows that it has to stand",
        f'<div class="card">{page.table(head, [*rows, spread])}</div>',
        intro=f"The search made small the {escape(risk)} of the objective over {len(flows)} flows, "
        "each relative to no baffles in the same flow. Where this page gives one number for a "
        "layout, costs are that and measures are means over the flows; drawings and figures show "
        "the scene's own flow.",
    )

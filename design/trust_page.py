"""In the report: where the model is out of its depth, and what a refinement changed."""

from __future__ import annotations

import math
from html import escape
from pathlib import Path
from typing import Any

from design import page, wording
from design.results import Design, RunResults

#: The measures whose spread and gap are shown after the objective, and their short names.
SHOWN = {
    "centroid_travel": "centroid travel",
    "upstream_depth": "upstream depth",
    "runout_p99": "runout p99",
    "mass_past_section": "mass past",
}


def depth(run: RunResults) -> str:
    """Spread of the ensemble and marks, layout by layout; "" where nothing is known of either."""
    judged = [d for d in run.designs if d.spread or d.marks]
    ensemble = _dict(run.summary.get("ensemble"))
    if not judged:
        return ""
    marked = [d for d in judged if d.marks]
    limits = {k: float(v) for k, v in _dict(ensemble.get("limits")).items()}
    shown = ["cost", *(n for n in SHOWN if any(n in d.spread for d in judged))]
    parts = [f"<h3>Where the {escape(run.searcher)} is out of its depth</h3>"]
    members = [escape(_named(str(m))) for m in ensemble.get("members", [])]
    if members:
        said = (
            f"{wording.count(len(members), 'model')} ({', '.join(members)}) rolled out each of "
            "these layouts. The spread is the standard deviation over them of a value relative to "
            "no baffles: what they disagree on, none of them knows."
        )
        if not limits:
            said += (
                " What is usual for just these models has not been measured, so the spread marks "
                "nothing here: compare the layouts with each other."
            )
        parts.append(f'<p class="muted">{said}</p>')
        head = ["", *("objective" if n == "cost" else SHOWN[n] for n in shown)]
        head += ["gap of the<br>objective"]
        rows = [[_label(d), *(_spread(d, n, limits) for n in shown), _gap(d)] for d in judged]
        if limits:
            usual = [wording.share(limits[n]) if n in limits else "–" for n in shown]
            rows.append(['<span class="muted">usual at most</span>', *usual, ""])
        parts.append(page.table(head, rows))
    if marked:
        items = "".join(
            f"<li><b>{escape(d.label)}</b>: {escape('; '.join(d.marks))}</li>" for d in marked
        )
        parts.append(
            f'<div class="note"><b>Trust the reference solver only</b><ul>{items}</ul></div>'
        )
    elif limits:
        parts.append('<p class="fine">No layout is marked.</p>')
    return f'<div class="card" style="margin-bottom:16px">{"".join(parts)}</div>'


def refined(run: RunResults) -> str:
    """Each round of refinement: the gap before and after, on old and on new layouts."""
    rounds = run.summary.get("refined")
    cards = [_round(run, told) for told in rounds or [] if isinstance(told, dict)]
    return "".join(cards)


def _round(run: RunResults, told: dict[str, Any]) -> str:
    same, new = _dict(told.get("same")), _dict(told.get("new"))
    titles = {"cost": "Objective"} | {q.name: q.title for q in wording.quantities(run.scene)}
    rows = []
    for name in ("cost", *SHOWN):
        cells = [
            _error(_dict(group.get(when)).get(name))
            for group in (same, new)
            for when in ("before", "after")
        ]
        ranks = [_rank(_dict(new.get(when)).get(name)) for when in ("before", "after")]
        if any(c != "–" for c in cells):
            rows.append([f'<span class="key">{escape(titles[name])}</span>', *cells, *ranks])
    start, model = (
        f'<span class="nowrap">{escape(str(told.get(key)))}</span>' for key in ("from", "model")
    )
    head = [
        "mean |gap| to the solver",
        f"{same.get('layouts', 0)} layouts that it learned:<br>{start}",
        f"<br>{model}",
        f"{new.get('layouts', 0)} new layouts:<br>{start}",
        f"<br>{model}",
        f"rank correlation, new:<br>{start}",
        f"<br>{model}",
    ]
    said = (
        f"{model} is {start} after {told.get('steps', '?')} more steps of training "
        f"({wording.duration(60 * float(told.get('minutes') or 0))}) on the verified layouts. "
        "Layouts that it was trained on say nothing of what it has learnt: judge by the new ones, "
        "which it proposed before the solver saw them."
    )
    before, found = told.get("best_before"), told.get("best_found")
    if isinstance(before, float) and isinstance(found, float):
        word = "better" if found < before else "no better"
        said += (
            f" The best objective, as the solver has it, was {before:.4f} before and is "
            f"{found:.4f} among the layouts found afterwards: {word}."
        )
    return (
        f'<div class="card" style="margin-bottom:16px"><h3>Refined: {model}</h3>'
        f'<p class="muted">{said}</p>{page.table(head, rows)}</div>'
    )


def _named(member: str) -> str:
    """A shipped model, or a checkpoint folder by the name of its run."""
    path = Path(member)
    return path.parent.name if path.name in ("model", "last") and path.parent.name else path.name


def _label(design: Design) -> str:
    by = f"<small>found by {escape(design.model)}</small>" if design.model else ""
    return f'<span class="key">{escape(design.label)}</span>{by}'


def _spread(design: Design, name: str, limits: dict[str, float]) -> str:
    value = design.spread.get(name)
    if value is None or not math.isfinite(value):
        return "–"
    text = wording.share(value)
    return f'<span class="worse">{text}</span>' if value > limits.get(name, math.inf) else text


def _gap(design: Design) -> str:
    return wording.percent(wording.relative(design.cost, design.verified_cost))


def _error(gap: Any) -> str:
    value = _dict(gap).get("mean_relative")
    return wording.share(value) if isinstance(value, float) else "–"


def _rank(gap: Any) -> str:
    value = _dict(gap).get("spearman")
    return f"{value:.2f}".replace("-", "−") if isinstance(value, float) else "–"


def _dict(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}

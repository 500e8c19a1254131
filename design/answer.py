"""The top of the report: where the baffles go, what that gains, and what is not known yet."""

from __future__ import annotations

from html import escape

import numpy as np

from design import page, wording
from design.drawing import layout_drawing
from design.results import Design, RunResults
from gns_model.scene import Scene

#: The measures that stand on the tiles beside the answer.
HEADLINE = ("centroid_travel", "upstream_depth", "runout_p99", "mass_past_section")


def answer(run: RunResults, name: str) -> str:
    """The headline, what is missing, the drawing with its coordinates, and the tiles."""
    best = run.design("best")
    count = len(best.centres) if best is not None and best.centres is not None else 0
    tone, badge = _badge(run, best)
    head = (
        f'<p class="kicker"><span class="badge {tone}">{badge}</span>'
        f"<span>{escape(name)}</span>{_kicker(run)}</p>"
    )
    if best is None or not count:
        return (
            f"{head}<h1>No layout yet</h1><p class=lead>The run folder holds no layout that "
            f"reached the end of its rollout.</p>{_missing(run)}{_notes(run)}"
        )
    title, lead = _headline(run, best, count)
    parts = [head, f"<h1>{title}</h1>", f'<p class="lead">{lead}</p>', _missing(run), _notes(run)]
    if run.scene is not None and best.centres is not None:
        placed = run.scene.with_baffles(best.centres)
        own = run.scene if run.scene.baffles else None
        drawing = layout_drawing(run.scene, placed, own)
        parts.append(
            f'<div class="answer"><div class="card">{drawing}{_legend(run.scene)}</div>'
            f'<div class="stack"><div class="card"><h3>Where the baffles go</h3>'
            f"{_coordinates(run, placed)}</div>{_tiles(run, best)}</div></div>"
        )
    return "".join(parts)


def _badge(run: RunResults, best: Design | None) -> tuple[str, str]:
    if best is None:
        return "warn", "No result"
    if best.verified:
        if _judgement(best, run.design("paper")) in ("worse", "same"):
            return "warn", "Verified · not better than the scene's own layout"
        return "ok", "Verified by the reference solver"
    return "warn", "Failed on the reference solver" if best.status else "Not verified yet"


def _kicker(run: RunResults) -> str:
    parts = []
    if run.trials:
        parts.append(f"{len(run.trials)} rollouts")
    total = _total_seconds(run)
    if total:
        parts.append(wording.duration(total))
    return "".join(f"<span>· {escape(p)}</span>" for p in parts)


def _headline(run: RunResults, best: Design, count: int) -> tuple[str, str]:
    """The answer as a title and two or three sentences; claims only what was measured."""
    verified = bool(best.verified)
    values = best.verified or best.surrogate
    baffles = wording.count(count, "baffle")
    travel = values.get("centroid_travel")
    if travel is None:
        return f"{baffles}, judged by nobody yet", "No measures of it were written."
    quantity = {q.name: q for q in wording.quantities(run.scene)}
    own, none = run.design("paper"), run.design("none")
    against = {
        d.key: wording.relative(travel, _values(d, verified).get("centroid_travel"))
        for d in (own, none)
        if d is not None
    }
    from_none, from_own = against.get("none"), against.get("paper")
    by = "On the reference solver" if verified else f"By the {run.searcher} alone"
    if verified and own is not None and _judgement(best, own) in ("worse", "same"):
        title = "The search found nothing better than the scene's own layout"
    elif from_none is not None and wording.verdict(from_none, -1) == "better":
        title = f"{baffles} that stop the flow {wording.share(from_none)} shorter"
    elif from_none is not None:
        title = f"{baffles} that do not shorten this flow"
    else:
        title = f"Where to put {baffles.lower()}"
    sentences = [
        f"{by}, the centre of mass moves {quantity['centroid_travel'].text(travel)} with this "
        f"layout{_against(from_none, 'without baffles')}"
        f"{_against(from_own, 'with the scene’s own layout', second=from_none is not None)}."
    ]
    depth = values.get("upstream_depth")
    if depth is not None:
        reference = _values(own, verified) if own else {}
        gain = wording.relative(depth, reference.get("upstream_depth"))
        sentences.append(
            f"The flow gets up to {quantity['upstream_depth'].text(depth)} deep before a baffle"
            f"{_against(gain, 'with the scene’s own layout', name='upstream_depth')}."
        )
    if not verified and not best.status:
        sentences.append(
            "<strong>These numbers are predictions.</strong> The reference solver has not seen "
            "this layout: do not build from it yet."
        )
    if not verified and best.status:
        sentences.append(
            "<strong>The rollout on the reference solver failed</strong> "
            f"({escape(best.status)}): this layout cannot be recommended."
        )
    return escape(title), " ".join(sentences)


def _against(
    share: float | None, what: str, *, second: bool = False, name: str = "centroid_travel"
) -> str:
    if share is None:
        return ""
    joint = " and " if second else ": "
    if wording.negligible(share, name):
        return f"{joint}as much as {what}"
    return f"{joint}{wording.share(share)} {'less' if share < 0 else 'more'} than {what}"


def _judgement(design: Design, other: Design | None) -> str:
    """Of two verified layouts: "better", "worse", "same"; "" where one is not verified."""
    if other is None or not design.verified or not other.verified:
        return ""
    mine, theirs = design.verified_cost, other.verified_cost
    if mine is None or theirs is None:
        mine = design.verified.get("centroid_travel")
        theirs = other.verified.get("centroid_travel")
    return wording.verdict(wording.relative(mine, theirs), -1)


def _coordinates(run: RunResults, placed: Scene) -> str:
    plane = placed.dim == 2
    head = ["", "x [m]"] if plane else ["", "x [m]", "z [m]"]
    rows = [
        [f'<span class="key">{k}</span>', *(f"{c:.3f}" for c in baffle.center)]
        for k, baffle in enumerate(placed.baffles, start=1)
    ]
    size = placed.baffles[0].size
    text = f"{size[0]:g} m along x, {size[1]:g} m high" + (
        "" if plane else f", {size[2]:g} m across"
    )
    volume = float(np.prod([b.size for b in placed.baffles], axis=1).sum())
    unit = "m² (per metre of width)" if plane else "m³"
    gaps = _least_gap(placed)
    clear = f"<br>Least clear distance between two: {gaps:.3f} m." if gaps is not None else ""
    return (
        f"{page.table(head, rows)}<p class='fine'>"
        f"Each {text}. Volume in all {volume:.3g} {unit}.{clear}<br>As files: {_links(run)}.</p>"
    )


def _links(run: RunResults) -> str:
    names = [f"layouts/best.{kind}" for kind in ("toml", "stl", "glb")]
    there = [name for name in names if (run.folder / name).is_file()]
    return ", ".join(f'<a href="{name}">{name}</a>' for name in there) or "none yet"


def _least_gap(scene: Scene) -> float | None:
    """Smallest clear distance between two footprints [m]."""
    plan = scene.baffle_boxes()[:, :, [0, *range(2, scene.dim)]]
    gaps = [
        float(np.linalg.norm(np.maximum(np.maximum(a[0] - b[1], b[0] - a[1]), 0)))
        for k, a in enumerate(plan)
        for b in plan[:k]
    ]
    return min(gaps) if gaps else None


def _legend(scene: Scene) -> str:
    items = [("best", "best found"), ("sand", "release")]
    if scene.baffles:
        items.insert(1, ("own", "scene's own layout"))
    if scene.placement is not None:
        items.append(("area", "where baffles may stand"))
    return (
        '<div class="legend">'
        + "".join(f'<span><i class="dot {c}"></i>{escape(t)}</span>' for c, t in items)
        + "</div>"
    )


def _missing(run: RunResults) -> str:
    """What a reader would look for in vain, and why."""
    lacks = []
    best = run.design("best")
    if not run.summary:
        lacks.append("The search has not written its summary: it is under way or was interrupted.")
    elif not run.complete:
        lacks.append("The run was interrupted or is under way: this is what it has so far.")
    if best is not None and not best.verified and not best.status:
        lacks.append("The best layout has not been run on the reference solver.")
    for key, what in (("none", "no baffles"), ("paper", "the scene's own layout")):
        expected = key == "none" or (run.scene is not None and bool(run.scene.baffles))
        design = run.design(key)
        if expected and (design is None or not design.verified):
            lacks.append(f"The reference solver has not run {what}, so there is no verified "
                         "comparison with it.")
    if not run.trials:
        lacks.append("There is no table of trials.")
    lacks += run.problems
    if not lacks:
        return ""
    items = "".join(f"<li>{escape(text)}</li>" for text in lacks)
    resume = "The same command with <code>--resume</code> goes on from here."
    if run.complete and best is not None and not best.verified:
        resume = "The same command with <code>--resume --verify 4</code> has the solver judge it."
    return f'<div class="note"><b>What is missing</b><ul>{items}</ul><p>{resume}</p></div>'


def _notes(run: RunResults) -> str:
    """What the simulators had to say about the scene, such as that it is beyond their training."""
    notes = run.summary.get("notes")
    if not isinstance(notes, list) or not notes:
        return ""
    items = "".join(f"<li>{escape(str(note))}</li>" for note in notes)
    return f'<div class="note"><b>To keep in mind</b><ul>{items}</ul></div>'


def gains(run: RunResults) -> str:
    """Every measure of the best layout beside no baffles and the scene's own layout."""
    best = run.design("best")
    if best is None or not (best.verified or best.surrogate):
        return ""
    verified = bool(best.verified)

    others = _others(run, verified)
    rows = []
    for q in wording.quantities(run.scene):
        value = _values(best, verified).get(q.name)
        if value is None:
            continue
        references = [_values(d, verified).get(q.name) for d in others]
        rows.append(
            [f'<span class="key">{escape(q.title)}</span><small>{escape(q.explanation)}</small>']
            + [q.text(reference) for reference in references]
            + [f"<b>{q.text(value)}</b>"]
            + [_changed(wording.relative(value, reference), q) for reference in references]
        )
    head = ["", *(escape(d.label) for d in others), '<i class="dot best"></i>Best found',
            *(f"against<br>{escape(d.label.lower())}" for d in others)]
    by = (
        "Every number in this section is by the reference solver, not by the simulator that "
        "the search looked through."
        if verified
        else f"<b>Not verified:</b> every number in this section is by the {run.searcher}."
    )
    cost = _cost_line(best, others, verified)
    return page.section(
        "What it gains",
        f'<div class="card">{page.table(head, rows)}</div>',
        intro=f"{by} {cost} “Same” means within what a jittered start changes by itself.",
    )


def _tiles(run: RunResults, best: Design) -> str:
    """The four measures that decide, large, with their change."""
    verified = bool(best.verified)
    tiles = []
    for q in wording.quantities(run.scene):
        value = _values(best, verified).get(q.name)
        if q.name not in HEADLINE or value is None:
            continue
        lines = "".join(
            f"<span>{_changed(wording.relative(value, _values(d, verified).get(q.name)), q)}"
            f" <em>vs {'none' if d.key == 'none' else 'own'}</em></span>"
            for d in _others(run, verified)
        )
        tiles.append(
            f'<div class="tile"><span class="muted">{escape(q.title)}</span>'
            f"<b>{q.text(value, unit=False)} <i>{escape(q.unit)}</i></b>{lines}</div>"
        )
    return f'<div class="tiles">{"".join(tiles)}</div>' if tiles else ""


def _values(design: Design, verified: bool) -> dict[str, float]:
    return design.verified if verified else design.surrogate


def _others(run: RunResults, verified: bool) -> list[Design]:
    """What the best is compared with, by the same simulator."""
    designs = (run.design("none"), run.design("paper"))
    return [d for d in designs if d is not None and _values(d, verified)]


def _changed(share: float | None, quantity: wording.Quantity) -> str:
    kind = wording.verdict(share, quantity.sense, quantity.name)
    word = f" <small>{kind}</small>" if kind else ""
    return f'<span class="change {kind or "same"}">{wording.percent(share)}{word}</span>'


def _cost_line(best: Design, others: list[Design], verified: bool) -> str:
    def cost(design: Design) -> float | None:
        return design.verified_cost if verified else design.cost

    known = [(d.label.lower(), cost(d)) for d in (best, *others) if cost(d) is not None]
    if len(known) < 2:
        return ""
    text = ", ".join(f"{escape(label)} {value:.4f}" for label, value in known)
    return f"Objective: {text}; less is better."


def _total_seconds(run: RunResults) -> float | None:
    seconds = run.summary.get("seconds")
    if isinstance(seconds, (int, float)):
        return float(seconds)
    if not isinstance(seconds, dict):
        return None
    if isinstance(seconds.get("total"), (int, float)):
        return float(seconds["total"])
    parts = [float(v) for v in seconds.values() if isinstance(v, (int, float))]
    return sum(parts) if parts else None

"""The top of the report: where the baffles go, what that gains, and what is not known yet."""

from __future__ import annotations

from html import escape

from design import page, wording
from design.constraints_page import not_kept, stated
from design.drawing import coordinates, layout_drawing, legend
from design.results import Design, RunResults

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
        placed = best.placed(run.scene)
        own = run.scene if run.scene.baffles else None
        drawing = layout_drawing(run.scene, placed, own)
        parts.append(
            f'<div class="answer"><div class="card">{drawing}{legend(run.scene)}</div>'
            f'<div class="stack"><div class="card"><h3>Where the baffles go</h3>'
            f"{coordinates(run, placed)}</div>{_tiles(run, best)}</div></div>"
        )
    return "".join(parts)


def _badge(run: RunResults, best: Design | None) -> tuple[str, str]:
    if best is None:
        return "warn", "No result"
    if best.verified:
        if not_kept(run):
            return "warn", "Verified · breaks a limit"
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
        stop = f"stop{'s' if count == 1 else ''}" if verified else "should stop"
        title = f"{baffles} that {stop} the flow {wording.share(from_none)} shorter"
    elif from_none is not None:
        title = f"{baffles} that {'does' if count == 1 else 'do'} not shorten this flow"
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
    broken = not_kept(run)
    if broken:
        names = " and ".join(f"{escape(c['title'])} ({stated(c)})" for c in broken)
        sentences.append(f"<strong>It does not keep every limit:</strong> {names}.")
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
    for key, what in (("none", "the flow without baffles"), ("paper", "the scene's own layout")):
        expected = key == "none" or (run.scene is not None and bool(run.scene.baffles))
        design = run.design(key)
        if expected and (design is None or not design.verified):
            lacks.append(
                f"The reference solver has not run {what}, so there is no verified "
                "comparison with it."
            )
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
    head = [
        "",
        *(escape(d.label) for d in others),
        '<i class="dot best"></i>Best found',
        *(f"against<br>{escape(d.label.lower())}" for d in others),
    ]
    by = (
        "Every number in this section is by the reference solver, not by the simulator that "
        "the search looked through."
        if verified
        else f"<b>Not verified:</b> every number in this section is by the {run.searcher}."
    )
    cost = _cost_line(run, best, others, verified)
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


def _cost_line(run: RunResults, best: Design, others: list[Design], verified: bool) -> str:
    def cost(design: Design) -> float | None:
        return design.verified_cost if verified else design.cost

    known = [(d.label.lower(), cost(d)) for d in (best, *others) if cost(d) is not None]
    if len(known) < 2:
        return ""
    text = ", ".join(f"{escape(label)} {value:.4f}" for label, value in known)
    settings = run.summary.get("settings")
    objective = settings.get("objective") if isinstance(settings, dict) else None
    meaning = objective.get("text") if isinstance(objective, dict) else None
    meant = f" ({escape(str(meaning))})" if meaning else ""
    return f"Objective{meant}: {text}; less is better."


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

"""report.html: what a search found, as one page that can be mailed.

It is read from top to bottom by somebody who wants to build: where the baffles go, what that gains
as measured by the reference solver, how it looks, how far the learned simulator is to be trusted,
what else there was to choose from, and how to get the same page again. Every number is read from
the run folder; what is missing there is said in words.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from design import animation, figures, page, wording
from design.drawing import layout_drawing, thumbnail
from design.results import LEARNED, SOLVER, Design, RunResults
from design.theme import DARK, LIGHT
from design.verify import spearman
from gns_model.scene import Scene, write_whole

#: The measures that stand on the tiles under the answer.
HEADLINE = ("centroid_travel", "upstream_depth", "runout_p99", "mass_past_section")

#: A GIF up to this size is embedded, a larger one linked [bytes].
MOST_EMBEDDED = 4_000_000


def write_report(folder: str | Path, *, gif: bool = True) -> Path:
    """Write figures/*.png, flow.gif and report.html of a run folder, each whole; return the page.

    A partial run gives a partial page. `gif=False` leaves the animation out: it takes seconds.
    """
    run = RunResults(folder)
    pictures = {
        name: (content, figures.png(run, name, DARK) or content)
        for name in figures.FIGURES
        if (content := figures.png(run, name, LIGHT)) is not None
    }
    for name, (light, _) in pictures.items():
        write_whole(run.folder / "figures" / f"{name}.png", light)
    if gif:
        animation.write_animation(run)
    path = run.folder / "report.html"
    write_whole(path, render(run, pictures).encode())
    return path


def render(run: RunResults, pictures: dict[str, tuple[bytes, bytes]]) -> str:
    """The page as text, from what is in the folder and figures as (light, dark) PNG bytes."""
    name = run.scene.name if run.scene else run.folder.name
    sections = [
        _answer(run, name),
        _gains(run),
        _flow(run, pictures),
        _trust(run, pictures),
        _choice(run, pictures),
        _search(run, pictures),
        _reproduce(run),
        _files(run),
    ]
    footer = (
        "<footer>Baffle layout by gns-design. Axes: x downstream, y up, z across; SI units. "
        "Coordinates are the centres of the footprints.</footer>"
    )
    return page.document(f"Baffle layout · {name}", "".join(sections) + footer)


# -- the answer ------------------------------------------------------------------------------------


def _answer(run: RunResults, name: str) -> str:
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
            f"reached the end of its rollout.</p>{_missing(run)}"
        )
    title, lead = _headline(run, best, count)
    parts = [head, f"<h1>{title}</h1>", f'<p class="lead">{lead}</p>', _missing(run)]
    if run.scene is not None and best.centres is not None:
        placed = run.scene.with_baffles(best.centres)
        own = run.scene if run.scene.baffles else None
        drawing = layout_drawing(run.scene, placed, own)
        parts.append(
            f'<div class="answer"><div class="card">{drawing}{_legend(run.scene)}</div>'
            f'<div class="stack"><div class="card"><h3>Where the baffles go</h3>'
            f"{_coordinates(placed)}</div>{_tiles(run, best)}</div></div>"
        )
    return "".join(parts)


def _badge(run: RunResults, best: Design | None) -> tuple[str, str]:
    if best is None:
        return "warn", "No result"
    if best.verified:
        if _judgement(best, run.design("paper")) == "worse":
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
        d.key: wording.change(travel, (d.verified if verified else d.surrogate).get("centroid_travel"))
        for d in (own, none)
        if d is not None
    }
    from_none, from_own = against.get("none"), against.get("paper")
    by = "On the reference solver" if verified else "By the learned simulator alone"
    if verified and own is not None and _judgement(best, own) in ("worse", "same"):
        title = "The search found nothing better than the scene's own layout"
    elif from_none is not None and wording.verdict(from_none, -1) == "better":
        title = f"{baffles} that stop the flow {_share(from_none)} shorter"
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
        reference = ((own.verified if verified else own.surrogate) if own else {}) or {}
        gain = wording.change(depth, reference.get("upstream_depth"))
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
    return f"{joint}{_share(share)} {'less' if share < 0 else 'more'} than {what}"


def _share(share: float) -> str:
    return f"{abs(100 * share):.1f}{wording.NBSP}%"


def _judgement(design: Design, other: Design | None) -> str:
    """Of two verified layouts: "better", "worse", "same"; "" where one is not verified."""
    if other is None or not design.verified or not other.verified:
        return ""
    if design.verified_cost is not None and other.verified_cost is not None:
        return wording.verdict(wording.change(design.verified_cost, other.verified_cost), -1)
    name = "centroid_travel"
    return wording.verdict(wording.change(design.verified.get(name), other.verified.get(name)), -1)


def _coordinates(placed: Scene) -> str:
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
        f"Each {text}. Volume in all {volume:.4g} {unit}.{clear}<br>As files: layouts/best.toml, "
        "best.stl, best.glb.</p>"
    )


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
    elif run.summary.get("status") in ("interrupted", "partial"):
        lacks.append("The search was interrupted: this page shows what it had by then.")
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
    resume = " Run the same command with <code>--resume</code> to go on." if run.summary else ""
    return f'<div class="note"><b>What is missing</b><ul>{items}</ul>{resume}</div>'


# -- numbers ---------------------------------------------------------------------------------------


def _gains(run: RunResults) -> str:
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
            + [_changed(wording.change(value, reference), q) for reference in references]
        )
    head = ["", *(escape(d.label) for d in others), '<i class="dot best"></i>Best found',
            *(f"against<br>{escape(d.label.lower())}" for d in others)]
    by = (
        "Every number in this section is by the reference solver (MPM), not by the model that "
        "the search used."
        if verified
        else "<b>Not verified:</b> every number in this section is by the learned simulator."
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
            f"<span>{_changed(wording.change(value, _values(d, verified).get(q.name)), q)}"
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
    return f"Objective (less is better): {text}."


# -- flow, trust, choice, search -------------------------------------------------------------------


def _flow(run: RunResults, pictures: dict[str, tuple[bytes, bytes]]) -> str:
    parts = []
    flows = figures.shown_flows(run)
    gif = run.folder / "flow.gif"
    if gif.is_file() and flows:
        slower = animation.slow_motion(flows[0][1])
        caption = (
            f"Seen from above and from the side, {slower:.0f} times slower than life. Above: depth; "
            "below: share of the width that is filled. Dotted: control section."
        )
        if gif.stat().st_size <= MOST_EMBEDDED:
            parts.append(page.film(gif.read_bytes(), "Animation of the flow", caption))
        else:
            parts.append('<p><a href="flow.gif">flow.gif</a>: the animation, too large to embed.</p>')
    by = "reference solver" if flows and flows[0][1].simulator == SOLVER else "learned simulator"
    for name, alt, caption in (
        ("plan", "Flow in plan over time", f"Depth in plan, by the {by}; one colour scale."),
        ("side", "Flow from the side over time", "The same from the side, through the whole width."),
    ):
        if name in pictures:
            parts.append(page.picture(*pictures[name], alt, caption))
    return page.section("How it flows", *parts) if parts else ""


def _trust(run: RunResults, pictures: dict[str, tuple[bytes, bytes]]) -> str:
    compared = list(run.compared())
    title = "How far to trust the learned simulator"
    if not compared:
        return page.section(
            title,
            intro="The reference solver has not run any layout of this search yet, so nothing can "
            "be said about the error of the learned simulator here. Its card tells how it did on "
            "layouts held out from its training.",
        )
    rows, worst = [], None
    best = run.design("best")
    for q in wording.quantities(run.scene):
        pairs = [
            (d, d.surrogate[q.name], d.verified[q.name])
            for d in compared
            if q.name in d.surrogate and q.name in d.verified
        ]
        gaps = [abs(g) for _, s, v in pairs if (g := wording.change(s, v)) is not None]
        if not gaps:
            continue
        learned, solver = np.array([p[1:] for p in pairs]).T
        rank = spearman(learned, solver)
        mine = [(s, v) for d, s, v in pairs if d is best]
        of_best = mine[0] if mine else (None, None)
        rows.append(
            [
                f'<span class="key">{escape(q.title)}</span>', q.text(of_best[0]),
                q.text(of_best[1]), wording.percent(wording.change(*of_best)),
                _share(float(np.mean(gaps))), _share(max(gaps)),
                "–" if rank is None else f"{rank:.2f}".replace("-", "−"),
            ]
        )
        if q.name == "centroid_travel":
            worst = (float(np.mean(gaps)), rank)
    head = ["", "best found,<br>learned", "best found,<br>solver", "gap", "mean |gap|",
            "largest |gap|", "rank<br>correlation"]
    count = len(compared)
    names = ", ".join(d.label.lower() for d in compared)
    intro = (
        f"The search looked through the learned simulator. {wording.count(count, 'layout')} ran on "
        f"the reference solver as well: {escape(names)}."
    )
    if worst is not None:
        intro += f" It was off by {_share(worst[0])} in centroid travel"
        intro += (
            f" and put the layouts in order with a rank correlation of {worst[1]:.2f} (1 is the "
            "solver's order)."
            if worst[1] is not None
            else "; too few layouts to judge the order it puts them in."
        )
    if count < 8:
        intro += " With so few layouts a correlation is an indication and no more."
    parts = [f'<div class="card" style="margin-bottom:16px">{page.table(head, rows)}</div>']
    captions = {
        "agreement": ("Learned against solver", "Each dot is a layout. On the line both agree; the "
                      "band is ±5 %. In the titles: mean gap."),
        "deposit": ("Final deposit by both simulators", "Where the best layout leaves the material, "
                    "by both simulators."),
    }
    for name, (alt, caption) in captions.items():
        if name in pictures:
            parts.append(page.picture(*pictures[name], alt, caption))
    return page.section(title, *parts, intro=intro)


def _choice(run: RunResults, pictures: dict[str, tuple[bytes, bytes]]) -> str:
    parts = []
    if "tradeoff" in pictures:
        parts.append(page.picture(
            *pictures["tradeoff"], "Centroid travel against upstream depth",
            "Down is a shorter flow, left is a shallower one. Lines join what the two simulators "
            "say of one layout.",
        ))
    layouts = [d for d in run.designs if d.centres is not None]
    if run.scene is not None and layouts:
        known = {q.name: q for q in wording.quantities(run.scene)}
        rows = []
        for design in layouts:
            kind = {"best": "best", "paper": "ownfill"}.get(design.key, "ranked")
            placed = run.scene.with_baffles(design.centres)
            values = design.verified or design.surrogate
            mark = "" if design.verified else " *"
            centres = " ".join(
                f'<span class="nowrap">({", ".join(f"{v:.3f}" for v in c)})</span>'
                for c in design.centres
            )
            label = f'<span class="key">{escape(design.label)}</span><small>{centres}</small>'
            rows.append(
                [thumbnail(run.scene, placed, kind), label, escape(design.origin or "–"),
                 _cost(design.cost), "failed" if design.status not in ("", "ok") else
                 _cost(design.verified_cost)]
                + [known[n].text(values.get(n)) + mark for n in HEADLINE]
            )
        head = ["", "", "from", "objective,<br>learned", "objective,<br>solver",
                *(escape(_column(n)) for n in HEADLINE)]
        note = (
            '<p class="fine">* by the learned simulator: '
            "not verified.</p>"
            if any(not d.verified for d in layouts)
            else ""
        )
        parts.append(f'<div class="card">{page.table(head, rows, text=(1, 2))}{note}</div>')
    if not parts:
        return ""
    return page.section(
        "What else there was to choose from", *parts,
        intro="A shorter flow is mostly paid for with more depth before the baffles. The objective "
        "weighs one against the other; if your site weighs them differently, pick another.",
    )


def _column(name: str) -> str:
    return {"centroid_travel": "centroid travel", "upstream_depth": "upstream depth",
            "runout_p99": "runout p99", "mass_past_section": "mass past"}[name]


def _cost(value: float | None) -> str:
    return "–" if value is None else f"{value:.4f}"


def _search(run: RunResults, pictures: dict[str, tuple[bytes, bytes]]) -> str:
    if "history" not in pictures:
        return ""
    done = [t for t in run.trials if t.cost is not None]
    failed = len(run.trials) - len(done)
    first = min(done, key=lambda t: t.cost)
    intro = (
        f"{len(run.trials)} layouts were tried on the learned simulator; the lowest objective, "
        f"{first.cost:.4f}, came from {escape(first.origin)} at number {first.number + 1}."
    )
    if failed:
        intro += f" {failed} rollout{'s' if failed > 1 else ''} failed and counted with a penalty."
    return page.section(
        "How the search went",
        page.picture(*pictures["history"], "Objective against rollouts",
                     "The objective is relative to no baffles, as the learned simulator sees it. "
                     "Values far above the rest are drawn at the top edge."),
        intro=intro,
    )


# -- provenance ------------------------------------------------------------------------------------


def _reproduce(run: RunResults) -> str:
    command = run.summary.get("command")
    if isinstance(command, list):
        command = shlex.join(str(part) for part in command)
    seconds = [
        (k, wording.duration(v) if isinstance(v, (int, float)) else str(v))
        for k, v in _flat(run.summary.get("seconds"))
    ]
    tables = "".join(
        page.key_values(title, values)
        for title, values in (
            ("Settings", [(k, str(v)) for k, v in _flat(run.summary.get("settings"))]),
            ("Time spent", seconds),
            ("Versions", [(k, str(v)) for k, v in _flat(run.summary.get("versions"))]),
        )
    )
    if not command and not tables:
        return ""
    shown = f"<pre>{escape(str(command))}</pre>" if command else ""
    return page.section("How to get this again", shown, f'<div class="columns">{tables}</div>')


def _flat(values: Any, prefix: str = "") -> Iterable[tuple[str, Any]]:
    """Nested settings as dotted names, in their order."""
    if not isinstance(values, dict):
        return
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


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


#: Files of a run folder that are worth a word, by pattern.
FILES = (
    ("layouts/*.toml", "scene with this layout, for gns-design evaluate and the solver"),
    ("**/*.stl", "the baffles as closed solids; metres, z up"),
    ("**/*.glb", "baffles, base and release for a 3D viewer; y up"),
    ("trials.csv", "every rollout of the search"),
    ("summary.json", "the numbers of this page"),
    ("study.db", "the search itself, an Optuna study: optuna-dashboard opens it"),
    ("trajectories/*.h5", "grains over time, HDF5"),
    ("flow.gif", "the animation"),
    ("figures/*.png", "the figures of this page"),
)


def _files(run: RunResults) -> str:
    rows = []
    for pattern, what in FILES:
        for path in sorted(run.folder.glob(pattern)):
            name = path.relative_to(run.folder).as_posix()
            size = path.stat().st_size
            text = f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{max(size / 1e3, 0.1):.1f} kB"
            rows.append([f'<a href="{escape(name)}">{escape(name)}</a>', escape(what), text])
    if not rows:
        return ""
    return page.section(
        "Files in this folder", f'<div class="card">{page.table(("", "", ""), rows, text=(1,))}</div>'
    )


__all__ = ["LEARNED", "render", "write_report"]

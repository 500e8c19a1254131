"""The middle of the report: how it flows, how far to trust the surrogate, what else there was."""

from __future__ import annotations

from html import escape

import numpy as np

from design import animation, page, trust_page, viewer, wording
from design.answer import HEADLINE
from design.drawing import thumbnail
from design.flow_figures import shown_flows
from design.results import RunResults
from gns_model.evaluation import rank_correlation

#: Figures by name as PNG bytes, for paper and for a dark screen.
Pictures = dict[str, tuple[bytes, bytes]]

#: A GIF up to this size is embedded, a larger one linked [bytes].
MOST_EMBEDDED = 4_000_000


def flow(run: RunResults, pictures: Pictures) -> str:
    """The view to be turned, the animation and the two figures over time."""
    shown = shown_flows(run)
    if shown is None:
        return ""
    parts = [viewer.view(shown), viewer.script()]
    gif = run.folder / "flow.gif"
    if gif.is_file():
        slower = animation.slow_motion(shown.flows[0][1])
        colours = (
            "Above: depth in plan; below, from the side: share of the width that is filled."
            if shown.flows[0][1].scene.dim == 3
            else "Colour: packing."
        )
        caption = (
            f"By the {shown.by}, {slower:.0f} times slower than life. {colours} Dotted: control "
            "section."
        )
        if gif.stat().st_size <= MOST_EMBEDDED:
            parts.append(page.film(gif.read_bytes(), "Animation of the flow", caption))
        else:
            parts.append('<p><a href="flow.gif">flow.gif</a>: the animation, too large here.</p>')
    for name, alt, caption in (
        ("plan", "Flow in plan over time", f"Depth in plan by the {shown.by}; one scale."),
        ("side", "Flow from the side over time", f"From the side, by the {shown.by}."),
    ):
        if name in pictures:
            parts.append(page.picture(*pictures[name], alt, caption))
    return page.section("How it flows", *parts)


def trust(run: RunResults, pictures: Pictures) -> str:
    """The gap between the search's simulator and the solver, measure by measure."""
    compared = list(run.compared())
    title = f"How far to trust the {run.searcher}"
    if not compared:
        return page.section(
            title,
            intro="The reference solver has not run any layout of this search yet, so nothing can "
            f"be said about the error of the {run.searcher} here.",
        )
    rows, worst = [], None
    best = run.design("best")
    for q in wording.quantities(run.scene):
        pairs = [
            (d, d.surrogate[q.name], d.verified[q.name])
            for d in compared
            if q.name in d.surrogate and q.name in d.verified
        ]
        gaps = [abs(g) for _, s, v in pairs if (g := wording.relative(s, v)) is not None]
        if not gaps:
            continue
        learned, solver = np.array([p[1:] for p in pairs]).T
        rank = rank_correlation(learned, solver)
        mine = [(s, v) for d, s, v in pairs if d is best]
        of_best = mine[0] if mine else (None, None)
        rows.append(
            [
                f'<span class="key">{escape(q.title)}</span>',
                q.text(of_best[0]),
                q.text(of_best[1]),
                wording.percent(wording.relative(*of_best)),
                wording.share(float(np.mean(gaps))),
                wording.share(max(gaps)),
                "–" if rank is None else f"{rank:.2f}".replace("-", "−"),
            ]
        )
        if q.name == "centroid_travel":
            worst = (float(np.mean(gaps)), rank)
    head = [
        "",
        "best found,<br>learned",
        "best found,<br>solver",
        "gap",
        "mean |gap|",
        "largest |gap|",
        "rank<br>correlation",
    ]
    count = len(compared)
    names = ", ".join(d.label.lower() for d in compared)
    intro = (
        f"The search looked through the {run.searcher}. {wording.count(count, 'layout')} ran on "
        f"the reference solver as well: {escape(names)}."
    )
    if worst is not None:
        intro += f" It was off by {wording.share(worst[0])} in centroid travel"
        intro += (
            f" and put the layouts in order with a rank correlation of {worst[1]:.2f} (1 is the "
            "solver's order)."
            if worst[1] is not None
            else "; too few layouts to judge the order it puts them in."
        )
    if count < 8:
        intro += " With so few layouts a correlation is an indication and no more."
    parts = [f'<div class="card" style="margin-bottom:16px">{page.table(head, rows)}</div>']
    parts += [trust_page.depth(run), trust_page.refined(run)]
    captions = {
        "agreement": (
            "Learned against solver",
            "Each dot is a layout; on the line both agree. Band: ±5 %. In the titles: mean gap.",
        ),
        "deposit": (
            "Final deposit by both simulators",
            "Where the best layout leaves the material, by both simulators.",
        ),
    }
    for name, (alt, caption) in captions.items():
        if name in pictures:
            parts.append(page.picture(*pictures[name], alt, caption))
    return page.section(title, *parts, intro=intro)


def choice(run: RunResults, pictures: Pictures) -> str:
    """The trade-off and the ranked layouts."""
    parts = []
    if "tradeoff" in pictures:
        parts.append(
            page.picture(
                *pictures["tradeoff"],
                "Centroid travel against upstream depth",
                "Down is a shorter flow, left a shallower one. A line joins what the two "
                "simulators say of one layout.",
            )
        )
    layouts = [(d, d.centres) for d in run.designs if d.centres is not None]
    formed = any(d.size for d, _ in layouts)
    if run.scene is not None and layouts:
        known = {q.name: q for q in wording.quantities(run.scene)}
        rows = []
        for design, layout in layouts:
            kind = {"best": "best", "paper": "ownfill"}.get(design.key, "ranked")
            placed = design.placed(run.scene)
            values = design.verified or design.surrogate
            mark = "" if design.verified else " *"
            centres = " ".join(
                f'<span class="nowrap">({", ".join(f"{v:.3f}" for v in c)})</span>' for c in layout
            )
            if formed and placed.baffles:
                size = " × ".join(f"{v:.3f}" for v in placed.baffles[0].size)
                centres += f'<br><span class="nowrap">each {size} m</span>'
            label = f'<span class="key">{escape(design.label)}</span><small>{centres}</small>'
            rows.append(
                [
                    thumbnail(run.scene, placed, kind),
                    label,
                    escape(design.origin or "–"),
                    _cost(design.cost),
                    "failed" if design.status not in ("", "ok") else _cost(design.verified_cost),
                ]
                + [known[n].text(values.get(n)) + mark for n in HEADLINE]
            )
        head = [
            "",
            "",
            "from",
            "objective,<br>learned",
            "objective,<br>solver",
            *(escape(_column(n)) for n in HEADLINE),
        ]
        note = (
            f'<p class="fine">* by the {run.searcher}: not verified.</p>'
            if any(not d.verified for d, _ in layouts)
            else ""
        )
        parts.append(f'<div class="card">{page.table(head, rows, text=(1, 2))}{note}</div>')
    if not parts:
        return ""
    return page.section(
        "What else there was to choose from",
        *parts,
        intro="A shorter flow is mostly paid for with more depth before the baffles. The objective "
        "weighs one against the other; if your site weighs them differently, pick another.",
    )


def _column(name: str) -> str:
    return {
        "centroid_travel": "centroid travel",
        "upstream_depth": "upstream depth",
        "runout_p99": "runout p99",
        "mass_past_section": "mass past",
    }[name]


def _cost(value: float | None) -> str:
    return "–" if value is None else f"{value:.4f}"


def search(run: RunResults, pictures: Pictures) -> str:
    """How the objective fell."""
    if "history" not in pictures:
        return ""
    done = [(t.cost, t.number, t.origin) for t in run.trials if t.cost is not None]
    failed = len(run.trials) - len(done)
    cost, number, origin = min(done)
    intro = (
        f"{len(run.trials)} layouts were tried on the {run.searcher}; the lowest objective, "
        f"{cost:.4f}, came from {escape(origin)} at number {number + 1}."
    )
    if failed:
        intro += f" {failed} rollout{'s' if failed > 1 else ''} failed and counted with a penalty."
    return page.section(
        "How the search went",
        page.picture(
            *pictures["history"],
            "Objective against rollouts",
            "The objective is relative to no baffles, as the search saw it. "
            "Values far above the rest are drawn at the top edge.",
        ),
        intro=intro,
    )

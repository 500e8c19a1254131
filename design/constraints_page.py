"""The report's table of constraints: what was asked, what the best layout has, and what is left."""

from __future__ import annotations

from html import escape
from typing import Any

from design import page, wording
from design.results import RunResults

#: Who says so -> what a reader is told.
SOURCES = {"geometry": "the layout", "solver": "reference solver", "search": "not verified yet"}


def kept(run: RunResults) -> str:
    """The table, if the run has constraints."""
    entries = _entries(run)
    if not entries:
        return ""
    rows = []
    for c in entries:
        word, kind = ("holds", "better") if c["holds"] else ("broken", "worse")
        rows.append(
            [
                f'<span class="key">{escape(str(c["title"]))}</span>',
                f"{escape(str(c['relation']))} {_text(c, 'limit')}",
                _text(c, "value"),
                f'<span class="change {kind}">{_text(c, "margin")} <small>{word}</small></span>',
                escape(SOURCES.get(str(c["by"]), str(c["by"]))),
            ]
        )
    broken = len(not_kept(run))
    verb = "is" if broken == 1 else "are"
    said = (
        f"<b>{wording.count(broken, 'constraint')} {verb} broken.</b>"
        if broken
        else ("The layout keeps them all.")
    )
    return page.section(
        "What it has to keep",
        f'<div class="card">'
        f"{page.table(['', 'asked', 'has', 'to spare', 'says'], rows, text=(4,))}</div>",
        intro=f"{said} Geometry holds for every layout that was tried; what the flow does is known "
        "only once it has run.",
    )


def not_kept(run: RunResults) -> list[dict[str, Any]]:
    """The constraints that the best layout breaks."""
    return [c for c in _entries(run) if not c["holds"]]


def stated(constraint: dict[str, Any]) -> str:
    """ "0.05 m, at least 0.10 m"."""
    relation = escape(str(constraint["relation"]))
    return f"{_text(constraint, 'value')}, {relation} {_text(constraint, 'limit')}"


def _entries(run: RunResults) -> list[dict[str, Any]]:
    entries = run.summary.get("constraints")
    if not isinstance(entries, list):
        return []
    wanted = {"title", "relation", "limit", "value", "margin", "unit", "holds", "by"}
    return [c for c in entries if isinstance(c, dict) and wanted <= set(c)]


def _text(constraint: dict[str, Any], key: str) -> str:
    value, unit = float(constraint[key]), str(constraint["unit"])
    if unit == "-":
        value, unit = 100 * value, "%"
    digits = 2 if unit == "%" else 3 if unit == "m" else 4
    text = f"{value:.{digits}f}".replace("-", "\u2212")
    return f"{text}{wording.NBSP}{escape(unit)}"

"""What `gns-design optimize` prints at its end: measures, layout, constraints, front, verdict."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from design.trust import trust_lines
from gns_model.console import show
from gns_model.measures import UNITS


def print_summary(summary: dict[str, Any], folder: Path) -> None:
    """Print what summary.json of the run folder `folder` says."""
    out = Console(soft_wrap=True)

    def tell(lines: Iterator[str]) -> None:
        for line in lines:
            out.print(line, markup=False, highlight=False)

    show(_measures_table(summary))
    tell(_layout_lines(summary))
    if summary.get("front"):
        show(_front_table(summary["front"]))
    tell(_closing_lines(summary, folder))


def _measures_table(summary: dict[str, Any]) -> Table:
    verified = bool((summary["best"] or {}).get("verified"))
    who = summary["settings"]["verify_with" if verified else "simulator"]["name"]
    table = Table(title=f"Measures by {who}")
    for column in ("", "best found", "scene's own", "no baffles"):
        table.add_column(column, justify="left" if not column else "right")
    role, key = ("verified", "verified_cost") if verified else ("surrogate", "cost")
    layouts = [summary[k] or {} for k in ("best", "paper_layout", "no_baffles")]
    columns = [layout.get(role) or {} for layout in layouts]
    for name, unit in UNITS.items():
        values = [f"{c[name]:.4g}" if name in c else "-" for c in columns]
        table.add_row(f"{name} [{unit}]".replace("[", r"\["), *values)
    costs = [layout.get(key) for layout in layouts]
    table.add_row("cost", *(f"{c:.4f}" if c is not None else "-" for c in costs))
    return table


def _layout_lines(summary: dict[str, Any]) -> Iterator[str]:
    """Where the best baffles stand, their form if it was searched, and whether limits hold."""
    if best := summary["best"]:
        places = "  ".join("(" + ", ".join(f"{v:.3f}" for v in c) + ")" for c in best["layout"])
        yield f"Layout, centres [m]: {places}"
        if size := best.get("size"):
            sides = "along, height" if len(size) == 2 else "along, height, across"
            turned = f", turned by {best['yaw']:.1f} degrees" if "yaw" in best else ""
            yield f"Every baffle ({sides}): {' x '.join(f'{v:.3f}' for v in size)} m{turned}"
    for c in summary.get("constraints", ()):
        verb = "holds" if c["holds"] else "DOES NOT HOLD"
        yield (
            f"{c['name']}: {c['value']:.4g} {c['unit']}, {c['relation']} {c['limit']:.4g}: {verb} "
            f"(by {c['by']})"
        )


def _front_table(entries: list[dict[str, Any]]) -> Table:
    names = list(entries[0]["objectives"])
    table = Table(title="Pareto front, relative to no baffles")
    for column in ("point", *names, *(f"{n}, verified" for n in names), "file"):
        table.add_column(column, justify="left" if column == "file" else "right")
    for e in entries:
        verified = e["verified_objectives"] or {}
        table.add_row(
            str(e["point"]),
            *(f"{e['objectives'][n]:.4f}" for n in names),
            *(f"{verified[n]:.4f}" if n in verified else "-" for n in names),
            e["file"],
        )
    return table


def _closing_lines(summary: dict[str, Any], folder: Path) -> Iterator[str]:
    """How the costs are to be read, the verdict, what to mistrust, and what was spent."""
    if summary.get("scenarios"):
        yield (
            f"Costs are the {summary['risk']} over {len(summary['scenarios'])} scenarios, measures "
            "their means."
        )
    yield summary["verdict_text"]
    yield from trust_lines(summary)
    for note in summary["notes"]:
        yield f"Note: {note}"
    yield (
        f"{summary['rollouts']} rollouts, {summary['backwards']} backward passes, "
        f"{summary['reference_rollouts']} reference rollouts, "
        f"{summary['seconds']['total']:.0f} s. Open {folder / 'report.html'}"
    )

"""What summary.json says of trust, in lines for a terminal."""

from __future__ import annotations

from typing import Any


def trust_lines(summary: dict[str, Any]) -> list[str]:
    """Layouts that are out of the model's depth, and what each refinement changed."""
    lines = []
    for rank, entry in enumerate(summary["ranked"], start=1):
        for mark in entry.get("marks", []):
            lines.append(f"Rank {rank} is out of the model's depth: {mark}.")
    for told in summary.get("refined", []):
        for part, what in (("same", "it was trained on"), ("new", "it found afterwards")):
            group = told[part]
            before, after = (error(group[k], "centroid_travel") for k in ("before", "after"))
            if before is None or after is None:
                continue
            lines.append(
                f"{told['model']}: on the {group['layouts']} layouts that {what}, the gap in "
                f"centroid travel is {100 * after:.1f} %, by {told['from']} {100 * before:.1f} %."
            )
    return lines


def error(gaps: dict[str, dict[str, float]], name: str) -> float | None:
    """Mean gap of a measure (`verify.gap`), or None."""
    return gaps.get(name, {}).get("mean_relative")

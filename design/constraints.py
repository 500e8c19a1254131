"""Whether a layout keeps each constraint, and by how much: for summary.json and the report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from design.outcome import Outcome
from design.rules import Rules
from design.verify import Judged
from gns_model.parts import TOLERANCE
from gns_model.polygon import clearance
from gns_model.scene import Scene

#: Limit on the flow -> what a reader calls it.
WORDS = {
    "max_overtopping": "mass over the baffles' tops",
    "freeboard": "tops above the deepest flow",
}


def constraints(scene: Scene, rules: Rules, judged: Judged) -> list[dict[str, Any]]:
    """Every constraint on the layout of `scene`, its value there and whether it holds.

    Geometry is read off the baffles, limits on the flow off what the reference solver says of
    `judged`, or the search's simulator where it has not run: `by` says which of the three. Of a
    robust search the worst scenario counts.
    """
    placement = scene.placement
    if placement is None or not scene.baffles:
        return []
    boxes = scene.baffle_boxes()[:, :, [0, *range(2, scene.dim)]]
    found: list[dict[str, Any]] = []

    def add(name: str, title: str, limit: float, value: float, unit: str, least: bool) -> None:
        value = round(value, 9) + 0.0  # no -0 and no round-off
        margin = value - limit if least else limit - value
        found.append(
            {
                "name": name,
                "title": title,
                "relation": "at least" if least else "at most",
                "limit": limit,
                "value": value,
                "unit": unit,
                "margin": margin,
                "holds": bool(margin >= -10 * TOLERANCE),
                "by": "geometry",
            }
        )

    if len(boxes) > 1:
        gaps = [
            float(np.maximum(a[0] - b[1], b[0] - a[1]).max()) for a, b in combinations(boxes, 2)
        ]
        add("gap", "Clear gap between baffles, along x or z", placement.gap, min(gaps), "m", True)
    inside = np.concatenate([boxes[:, 0] - placement.lower, placement.upper - boxes[:, 1]])
    add("placement", "Distance inside the placement area", 0.0, float(inside.min()), "m", True)
    if placement.wall_gap:
        plan = [0, *range(2, scene.dim)]
        lower, upper = (np.array(v)[plan] for v in (scene.domain.lower, scene.domain.upper))
        walls = float(np.concatenate([boxes[:, 0] - lower, upper - boxes[:, 1]]).min())
        add("wall_gap", "Distance to the walls", placement.wall_gap, walls, "m", True)
    distances = _to_zones(scene)
    if distances:
        add("keep_out", "Distance to the keep-outs", 0.0, min(distances), "m", True)
    if placement.max_height is not None:
        height = max(b.size[1] for b in scene.baffles)
        add("max_height", "Height", placement.max_height, height, "m", False)
    if placement.max_volume is not None:
        volume = sum(math.prod(b.size) for b in scene.baffles)
        unit = "m³" if scene.dim == 3 else "m²"
        add("max_volume", "Concrete in all", placement.max_volume, volume, unit, False)
    _add_flow(add, found, rules, judged, min(b.size[1] for b in scene.baffles))
    return found


def _add_flow(
    add: Any, found: list[dict[str, Any]], rules: Rules, judged: Judged, height: float
) -> None:
    verified = judged.verified is not None and judged.verified_excess is not None
    excess = (judged.verified_excess or {}) if verified else judged.excess
    if "max_overtopping" in excess:
        limit = rules.max_overtopping or 0.0
        value = limit + excess["max_overtopping"]
        add("max_overtopping", "Mass over the baffles' tops", limit, value, "-", False)
        found[-1]["by"] = "solver" if verified else "search"
    if "freeboard" in excess:
        limit = rules.freeboard or 0.0
        value = limit - excess["freeboard"] * height
        add("freeboard", "Tops above the peak upstream depth", limit, value, "m", True)
        found[-1]["by"] = "solver" if verified else "search"


def _to_zones(scene: Scene) -> list[float]:
    """Distance of every baffle from every keep-out [m]."""
    placement = scene.placement
    assert placement is not None
    if scene.dim == 2:
        half = [b.size[0] / 2 for b in scene.baffles]
        return [
            max(low - (b.center[0] + h), b.center[0] - h - high)
            for low, high in placement.keep_out
            for b, h in zip(scene.baffles, half, strict=True)
        ]
    zones = [((x0, z0), (x1, z0), (x1, z1), (x0, z1)) for x0, z0, x1, z1 in placement.keep_out]
    zones += [tuple(zone) for zone in placement.keep_out_polygons]  # type: ignore[misc]
    return [clearance(b.corners, zone) for zone in zones for b in scene.baffles]


def to_blame(rules: Rules, outcomes: Sequence[Outcome]) -> str:
    """A sentence on the limit of the flow that is to blame where no trial keeps them all; or "".

    That is the limit which the fewest keep.
    """
    names = rules.limited
    if not names or not outcomes or any(o.feasible for o in outcomes):
        return ""
    kept = {name: sum(o.excess[name] <= 0 for o in outcomes) for name in names}
    worst = min(kept, key=lambda name: kept[name])
    counts = ", ".join(f"{kept[n]} keep {n} ({WORDS[n]})" for n in names)
    nearest = min(o.excess[worst] for o in outcomes)
    missed = {
        "max_overtopping": f"the least is {100 * ((rules.max_overtopping or 0) + nearest):.2g}%",
        "freeboard": f"the nearest lacks {100 * nearest:.2g}% of the height",
    }[worst]
    alone = len(names) > 1 and kept[worst] > 0
    blame = "the limits are to blame together" if alone else f"{worst} is to blame: {missed}"
    return f"none of {len(outcomes)} layouts keeps every limit on the flow ({counts}); {blame}"

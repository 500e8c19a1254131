"""A layout on the page: an SVG drawing, plan in 3D and elevation in 2D, and its coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from design import page
from design.results import RunResults
from gns_model import footprint
from gns_model.scene import Scene

#: Pixels of the drawing's longer side, and room for the ticks around it.
LONG, LEFT, BOTTOM, TOP, RIGHT = 520.0, 46.0, 40.0, 22.0, 14.0


#: Two coordinates in metres.
Plane = Sequence[float] | np.ndarray


class Paper:
    """Metres to pixels for one scene, the second axis (z in plan, y in elevation) upwards."""

    def __init__(self, scene: Scene, long: float) -> None:
        self.scene = scene
        lower, upper = np.array(scene.domain.lower), np.array(scene.domain.upper)
        second = 2 if scene.dim == 3 else 1
        self.axes = (0, second)
        self.low, self.high = lower[[0, second]], upper[[0, second]]
        self.scale = long / float((self.high - self.low).max())
        self.width, self.height = (self.high - self.low) * self.scale

    def rectangle(self, low: Plane, high: Plane, attributes: str) -> str:
        """An SVG rectangle between two corners given in metres, already in the two axes shown."""
        x, y = (low[0] - self.low[0]) * self.scale, (self.high[1] - high[1]) * self.scale
        width, height = (high[0] - low[0]) * self.scale, (high[1] - low[1]) * self.scale
        return (
            f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" '
            f"{attributes}/>"
        )

    def baffles(self, scene: Scene, attributes: str) -> list[str]:
        """The baffles of a scene as SVG shapes: polygons in plan, rectangles in elevation."""
        if scene.dim == 2:
            return [self.rectangle(low, high, attributes) for low, high in self.boxes(scene)]
        shapes = []
        for corners in scene.footprints():
            points = " ".join("{:.1f},{:.1f}".format(*self.at(corner)) for corner in corners)
            shapes.append(f'<polygon points="{points}" stroke-linejoin="round" {attributes}/>')
        return shapes

    def at(self, point: Plane) -> tuple[float, float]:
        """Pixels of a point in metres."""
        return (point[0] - self.low[0]) * self.scale, (self.high[1] - point[1]) * self.scale

    def boxes(self, scene: Scene) -> np.ndarray:
        """The boxes that hold the baffles, in the two axes shown [m], shape (B, 2, 2)."""
        return scene.baffle_boxes()[:, :, list(self.axes)]


def layout_drawing(scene: Scene, best: Scene, own: Scene | None) -> str:
    """The layout `best`, numbered, in its surroundings; `own` in outline for comparison."""
    paper = Paper(scene, LONG)
    parts = [
        '<defs><pattern id="hatch" width="7" height="7" patternUnits="userSpaceOnUse" '
        'patternTransform="rotate(45)"><path d="M0 0V7" class="hatch"/></pattern></defs>',
        paper.rectangle(paper.low, paper.high, 'class="ground"'),
    ]
    second = paper.axes[1]
    for release in scene.releases:
        low, high = [[c[0], c[second]] for c in (release.lower, release.upper)]
        parts.append(paper.rectangle(low, high, 'class="release"'))
    parts += _arrow(paper)
    parts += _placement(paper)
    parts += _section(paper)
    parts += paper.baffles(own, 'class="own"') if own is not None else []
    parts += paper.baffles(best, 'class="best"')
    for number, (low, high) in enumerate(paper.boxes(best), start=1):
        x, y = paper.at((low + high) / 2)
        parts.append(f'<text x="{x:.1f}" y="{y:.1f}" dy="0.36em" class="number">{number}</text>')
    parts += _ticks(paper)
    title = f"{'Plan' if scene.dim == 3 else 'Elevation'} of the layout in {scene.name}"
    return (
        f'<svg class="plan" viewBox="{-LEFT} {-TOP} {paper.width + LEFT + RIGHT:.0f} '
        f'{paper.height + TOP + BOTTOM:.0f}" role="img" aria-label="{escape(title)}">'
        f"{''.join(parts)}</svg>"
    )


def thumbnail(scene: Scene, layout: Scene, kind: str) -> str:
    """The layout alone, a few millimetres tall, for a table row; `kind` is the CSS class."""
    paper = Paper(scene, 92.0)
    parts = [paper.rectangle(paper.low, paper.high, 'class="ground"')]
    second = paper.axes[1]
    for release in scene.releases:
        low, high = [[c[0], c[second]] for c in (release.lower, release.upper)]
        parts.append(paper.rectangle(low, high, 'class="release"'))
    parts += paper.baffles(layout, f'class="{kind}"')
    return (
        f'<svg class="thumb" viewBox="-1 -1 {paper.width + 2:.0f} {paper.height + 2:.0f}" '
        f'aria-hidden="true">{"".join(parts)}</svg>'
    )


def coordinates(run: RunResults, placed: Scene) -> str:
    """The centres of the baffles of `placed` as a table, with their size and files."""
    plane = placed.dim == 2
    head = ["", "x [m]"] if plane else ["", "x [m]", "z [m]"]
    rows = [
        [f'<span class="key">{k}</span>', *(f"{c:.3f}" for c in baffle.center)]
        for k, baffle in enumerate(placed.baffles, start=1)
    ]
    size, yaw = placed.baffles[0].size, placed.baffles[0].yaw
    text = f"{size[0]:.4g} m along x, {size[1]:.4g} m high" + (
        "" if plane else f", {size[2]:.4g} m across"
    )
    if len({baffle.yaw for baffle in placed.baffles}) > 1:
        head.append("yaw [°]")
        rows = [[*row, f"{b.yaw:.1f}"] for row, b in zip(rows, placed.baffles, strict=True)]
        text += "; a yaw turns from x towards z"
    elif yaw:
        text += f", turned by {yaw:.1f}° from x towards z"
    volume = float(np.prod([b.size for b in placed.baffles], axis=1).sum())
    unit = "m² (per metre of width)" if plane else "m³"
    gaps = _least_gap(placed)
    clear = f"<br>Least clear distance between two: {gaps:.3f} m." if gaps is not None else ""
    return (
        f"{page.table(head, rows)}<p class='fine'>"
        f"Each {text}. Concrete of {len(placed.baffles)} in all: {volume:.3g} {unit}.{clear}"
        f"<br>As files: {_links(run)}.</p>"
    )


def _links(run: RunResults) -> str:
    names = [f"layouts/best.{kind}" for kind in ("toml", "stl", "glb")]
    there = [name for name in names if (run.folder / name).is_file()]
    return ", ".join(f'<a href="{name}">{name}</a>' for name in there) or "none yet"


def _least_gap(scene: Scene) -> float | None:
    """Smallest clear distance between two footprints [m]."""
    if scene.dim == 2:
        spans = np.sort(scene.baffle_boxes()[:, :, 0], axis=0)
        return float((spans[1:, 0] - spans[:-1, 1]).min()) if len(spans) > 1 else None
    plan = scene.footprints()
    first, second = np.triu_indices(len(plan), 1)
    gaps = np.maximum(footprint.separation(plan[first], plan[second]), 0.0)
    return float(gaps.min()) if len(gaps) else None


def legend(scene: Scene) -> str:
    """What the colours of `layout_drawing` mean."""
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


def _arrow(paper: Paper) -> list[str]:
    """Which way the mass moves, from the middle of the first release."""
    release = paper.scene.releases[0]
    second = paper.axes[1]
    x, y = paper.at([(release.lower[a] + release.upper[a]) / 2 for a in (0, second)])
    along, across = release.velocity[0], -release.velocity[second]
    speed = float(np.hypot(along, across))
    if speed == 0:
        return []
    dx, dy = 26 * along / speed, 26 * across / speed
    turn = np.degrees(np.arctan2(dy, dx))
    return [
        f'<g transform="translate({x:.1f} {y:.1f}) rotate({turn:.1f})" class="arrow">'
        '<path d="M-26 0H22M13 -7L23 0L13 7"/></g>',
        f'<text x="{x:.1f}" y="{y + 24:.1f}" class="small on-sand">{speed:g} m/s</text>',
    ]


def _placement(paper: Paper) -> list[str]:
    placement = paper.scene.placement
    if placement is None:
        return []
    if paper.scene.dim == 2:
        x0, x1 = paper.at((placement.lower[0], 0))[0], paper.at((placement.upper[0], 0))[0]
        y = paper.height + 5
        return [f'<path d="M{x0:.1f} {y:.1f}H{x1:.1f}" class="placement"/>']
    parts = [
        paper.rectangle(rectangle[:2], rectangle[2:], 'class="keep-out" fill="url(#hatch)"')
        for rectangle in placement.keep_out
    ]
    for zone in placement.keep_out_polygons:
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in map(paper.at, zone))
        parts.append(f'<polygon points="{points}" class="keep-out" fill="url(#hatch)"/>')
    return [paper.rectangle(placement.lower, placement.upper, 'class="placement"'), *parts]


def _section(paper: Paper) -> list[str]:
    x, _ = paper.at((paper.scene.control_section, 0))
    return [
        f'<path d="M{x:.1f} 0V{paper.height:.1f}" class="section"/>',
        f'<text x="{x:.1f}" y="-8" class="small middle">control section x = '
        f"{paper.scene.control_section:g} m</text>",
    ]


def _ticks(paper: Paper) -> list[str]:
    """Round coordinates along both axes, at most seven each."""
    parts = []
    for axis, name in enumerate(("x", "z" if paper.scene.dim == 3 else "y")):
        low, high = float(paper.low[axis]), float(paper.high[axis])
        choices = [b * 10**e for e in range(-2, 4) for b in (1, 2, 2.5, 5)]
        step = next((s for s in choices if (high - low) / s <= 7), high - low)
        for k in range(int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9)) + 1):
            value = k * step
            x, y = paper.at((value, value))
            if axis == 0:
                parts.append(
                    f'<path d="M{x:.1f} {paper.height:.1f}v5" class="tick"/>'
                    f'<text x="{x:.1f}" y="{paper.height + 18:.1f}" class="small middle">'
                    f"{value:g}</text>"
                )
            else:
                parts.append(
                    f'<path d="M0 {y:.1f}h-5" class="tick"/>'
                    f'<text x="-9" y="{y:.1f}" dy="0.35em" class="small end">{value:g}</text>'
                )
        if axis == 0:
            parts.append(
                f'<text x="{paper.width / 2:.1f}" y="{paper.height + 34:.1f}" '
                f'class="small middle">{name} [m], downstream</text>'
            )
        else:
            middle = paper.height / 2
            parts.append(
                f'<text transform="translate(-36 {middle:.1f}) rotate(-90)" '
                f'class="small middle">{name} [m]</text>'
            )
    return parts

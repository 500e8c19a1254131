"""The interactive view of the flow on the report page: grains and baffles over time, to be turned.

The page stays one file without network: some thousand grains of each flow go into it as 16-bit
integers, and `viewer.js`, a few kilobytes of plain script, draws them on a canvas. The numbers
under the view are hard measures of the whole flow at the instant that the slider shows, computed
here from every grain and not from those that are drawn.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from design import views
from design.flow_figures import Shown
from gns_model import measures
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory

#: Most grains and instants that are put into the page: 1.2 MB of text for one flow.
GRAINS, FRAMES = 3_200, 46

#: Colours of the baffles by layout, names of CSS variables.
_COLOURS = {"best": "--best", "paper": "--own", "none": "--none"}

#: What stands under each view, by measure: title and decimals.
NUMBERS = {
    "centroid_travel": ("centroid travel", "m", 3),
    "runout_p99": ("runout, 99 %", "m", 3),
    "upstream_depth": ("depth before a baffle", "m", 3),
    "mass_past_section": ("past the section", "%", 1),
}


def view(shown: Shown) -> str:
    """The figure of one or two flows with one slider for both, as HTML with its script."""
    scene = shown.flows[0][1].scene
    times = _times([flow for _, flow in shown.flows])
    flows = [_flow(flow, times, design.key) for design, flow in shown.flows]
    data = {
        "scene": _surroundings(scene),
        "times": [round(float(t), 4) for t in times],
        "fastest": round(_fastest([flow for _, flow in shown.flows]), 3),
        "flows": flows,
    }
    # "<" never stands in the text of a script, so that no value can end it.
    text = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
    panels = "".join(
        _panel(design.label, values) for (design, _), values in zip(shown.flows, flows, strict=True)
    )
    last = len(times) - 1
    return (
        '<figure class="card flow">'
        f'<div class="panels">{panels}</div>'
        '<div class="time"><button type="button">Play</button>'
        f'<input type="range" min="0" max="{last}" value="{last}" step="1" aria-label="Time">'
        "<output></output></div>"
        f"<figcaption>By the {escape(shown.by)}; drag to turn, shift and wheel to zoom. Redder "
        f"grains are faster, up to {data['fastest']:.1f} m/s; dotted: control section. Drawn are "
        f"at most {GRAINS} grains of each flow; the numbers are of all of them, at the time "
        "shown.</figcaption>"
        "<noscript><p>The view needs JavaScript; the figures below do not.</p></noscript>"
        f'<script type="application/json">{text}</script></figure>'
    )


def script() -> str:
    """The script that makes every view of a page live; once, after the last of them."""
    return f"<script>{Path(__file__).with_name('viewer.js').read_text(encoding='utf-8')}</script>"


def _panel(label: str, values: dict[str, Any]) -> str:
    numbers = "".join(
        f'<span>{title} <b data-measure="{name}">{values["numbers"][name][-1]}</b> {unit}</span>'
        for name, (title, unit, _) in NUMBERS.items()
    )
    return (
        f'<div><h3>{escape(label)}</h3><canvas aria-label="Flow with {escape(label.lower())}">'
        f'</canvas><p class="numbers">{numbers}</p></div>'
    )


def _times(flows: Sequence[Trajectory]) -> np.ndarray:
    """The instants that are shown [s], frames of the first flow, both ends among them."""
    own = np.asarray(flows[0].time, dtype=float)
    own = own[own <= min(float(f.time[-1]) for f in flows) + 1e-9]
    return own[np.unique(np.linspace(0, len(own) - 1, min(FRAMES, len(own))).round().astype(int))]


def _surroundings(scene: Scene) -> dict[str, Any]:
    """The box in which positions are quantised, and what is drawn of it; 2D gets a z of 0."""
    lower, upper = (_in_3d(np.array(c)).tolist() for c in (scene.domain.lower, scene.domain.upper))
    if scene.dim == 2:
        lower[2], upper[2] = -0.5, 0.5
    return {
        "lower": lower,
        "upper": upper,
        "top": round(views.side_top(scene), 4),
        "section": scene.control_section,
        "flat": scene.dim == 2,
    }


def _flow(flow: Trajectory, times: np.ndarray, key: str) -> dict[str, Any]:
    """What the script needs of one flow."""
    frames = [views.frame_at(flow, t) for t in times]
    whole = measures.moving_positions(flow)
    stride = -(-whole.shape[1] // GRAINS)
    # A fixed random choice: every n-th grain of a lattice would leave whole rows out.
    chosen = np.sort(
        np.random.default_rng(0).permutation(whole.shape[1])[: GRAINS if stride > 1 else None]
    )
    around = _surroundings(flow.scene)
    lower, upper = np.array(around["lower"]), np.array(around["upper"])
    share = (_in_3d(whole[frames][:, chosen]) - lower) / (upper - lower)
    packed = np.rint(np.clip(share, 0, 1) * 65535).astype("<u2")
    volume = flow.point_volume * whole.shape[1] / len(chosen)
    return {
        "grains": len(chosen),
        "positions": base64.b64encode(packed.tobytes()).decode("ascii"),
        "size": round(volume ** (1 / flow.scene.dim), 5),
        "baffles": _boxes(flow.scene),
        "colour": _COLOURS.get(key, "--best"),
        "numbers": _numbers(flow, frames),
    }


def _boxes(scene: Scene) -> list[list[list[float]]]:
    """Lower and upper corner of each baffle as it would stand unturned [m], cosine and sine of its
    yaw; in 2D baffles reach a little to both sides of z = 0."""
    packed = []
    for box, turn in zip(*scene.oriented_boxes(), strict=True):
        corners = _in_3d(box)
        if scene.dim == 2:
            corners[:, 2] = -1e-3, 1e-3
        packed.append([*corners.tolist(), turn.tolist()])
    return packed


def _numbers(flow: Trajectory, frames: list[int]) -> dict[str, list[str]]:
    """The measures of `NUMBERS` at each frame, as text: each as if the flow ended there."""
    x = measures.moving_positions(flow)[:, :, 0]
    depth = measures.upstream_depth_over_time(flow)
    values = {
        "centroid_travel": measures.centroid_over_time(flow)[:, 0] - x[0].mean(dtype=float),
        "runout_p99": measures.runout_over_time(flow, quantile=measures.FRONT_QUANTILE),
        "upstream_depth": depth.max(axis=1, initial=0.0),
        "mass_past_section": 100 * (x > flow.scene.control_section).mean(axis=1),
    }
    return {
        name: [f"{values[name][k]:.{digits}f}".replace("-", "−") for k in frames]
        for name, (_, _, digits) in NUMBERS.items()
    }


def _fastest(flows: Sequence[Trajectory]) -> float:
    """The speed [m/s] that 99% of the grains' displacements stay below: the end of the colours."""
    speeds = []
    for flow in flows:
        positions = measures.moving_positions(flow)[::3].astype(float)
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=2)
        speeds.append(steps / np.diff(np.asarray(flow.time)[::3])[:, None])
    fastest = float(np.quantile(np.concatenate([s.ravel() for s in speeds]), 0.99))
    return max(fastest, 1e-3)


def _in_3d(points: np.ndarray) -> np.ndarray:
    """Points (..., D) with z = 0 where they have none, shape (..., 3)."""
    if points.shape[-1] == 3:
        return points
    return np.concatenate([points, np.zeros((*points.shape[:-1], 1))], axis=-1)

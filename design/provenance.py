"""The end of the report: how to get the same run again, and what lies in its folder."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from html import escape
from typing import Any

from design import page, wording
from design.results import RunResults

#: Files of a run folder that are worth a word, by pattern.
FILES = (
    ("layouts/*.toml", "scene with this layout, for gns-design evaluate and the solver"),
    ("**/*.stl", "the baffles as closed solids; metres, z up"),
    ("**/*.glb", "baffles, base and release for a 3D viewer; y up"),
    ("front.csv", "the Pareto front: objectives, measures and places of every point"),
    ("refined-*/model.safetensors", "the refined model; its folder is a --simulator"),
    ("trials.csv", "every rollout of the search"),
    ("summary.json", "the numbers of this page"),
    ("study.db", "the search itself, an Optuna study: optuna-dashboard opens it"),
    ("trajectories/*.h5", "grains over time, HDF5"),
    ("flow.gif", "the animation"),
    ("figures/*.png", "the figures of this page"),
)


def reproduce(run: RunResults) -> str:
    """The command, the settings, the time spent and the versions."""
    command = _command(run)
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
    shown = f"<pre>{escape(command)}</pre>" if command else ""
    return page.section("How to get this again", shown, f'<div class="columns">{tables}</div>')


def _command(run: RunResults) -> str:
    """The command line that searches again as this run did, in another folder."""
    settings = dict(_flat(run.summary.get("settings")))
    if not settings or not (run.folder / "scene.toml").is_file():
        return ""
    options = {
        "method": "method",
        "baffles": "baffles",
        "budget": "budget",
        "verify": "verify",
        "seed": "seed",
        "batch": "batch",
        "simulator.name": "simulator",
        "simulator.spacing": "spacing",
        "simulator.device": "device",
        "verify_with.name": "verify-with",
        "verify_with.spacing": "verify-spacing",
        "objectives": "objectives",
        "pattern": "pattern",
        "baffle_cost": "baffle-cost",
        "concrete_cost": "concrete-cost",
        "scenarios.count": "scenarios",
        "scenarios.speed": "speed",
        "scenarios.volume": "volume",
        "scenarios.friction": "friction",
        "scenarios.risk": "risk",
        "scenarios.level": "cvar-level",
        "objective.runout_weight": "runout-weight",
        "objective.depth_weight": "depth-weight",
        "objective.mass_weight": "mass-weight",
        "ensemble": "ensemble",
        "refine": "refine-rounds",
        "refine_minutes": "refine-minutes",
        "refine_data": "refine-data",
    }
    words = ["gns-design", "optimize", str(run.folder / "scene.toml")]
    for key, option in options.items():
        if settings.get(key) is not None:
            words += [f"--{option}", str(settings[key])]
    if settings.get("refine"):
        words.append("--refine")
    return shlex.join([*words, "--out", f"{run.folder}-again"])


def _flat(values: Any, prefix: str = "") -> Iterable[tuple[str, Any]]:
    """Nested settings as dotted names, in their order."""
    if not isinstance(values, dict):
        return
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def files(run: RunResults) -> str:
    """What lies in the folder, as links relative to the page."""
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
        "Files in this folder",
        f'<div class="card">{page.table(("", "", ""), rows, text=(1,))}</div>',
    )

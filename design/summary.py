"""summary.json, trials.csv and layouts/ of a run folder, each file whole, at any stage of a run."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from design.outcome import Trial
from design.space import Space, built
from design.table import table
from design.trials import TrialLog
from design.verify import Judged, gap, verdict
from gns_env.objective import Objective
from gns_model.files import write_whole
from gns_model.scene import Scene

#: How far a run has come: "partial" between stages, "interrupted" by Ctrl-C or an error.
COMPLETE, PARTIAL, INTERRUPTED = "complete", "partial", "interrupted"


def results(
    ranked: Sequence[Judged],
    paper: Judged | None,
    none: Judged | None,
    trials: Sequence[Trial],
    objective: Objective,
) -> dict[str, Any]:
    """The part of summary.json that is found and not chosen.

    `rollouts` and `backwards` are those of the search's trials. `paper_layout` (the layout in the
    scene file) and `no_baffles` hold their verified measures directly, and beside them, as `best`
    and `ranked` do, `layout`, `surrogate`, `verified`, `cost` and `verified_cost`.
    """
    best = ranked[0] if ranked else None
    word, sentence = verdict(best, paper, objective.baseline)
    return {
        "verdict": word,
        "verdict_text": sentence,
        "best": best.as_dict() if best else None,
        "paper_layout": _flat(paper),
        "no_baffles": _flat(none),
        "ranked": [judged.as_dict() for judged in ranked],
        "gap": gap([judged for judged in (*ranked, paper, none) if judged is not None]),
        "rollouts": sum(trial.outcome.rollouts for trial in trials),
        "backwards": sum(trial.outcome.backwards for trial in trials),
        "failed": sum(not trial.ok for trial in trials),
    }


def write_summary(folder: Path, summary: dict[str, Any]) -> None:
    """Write summary.json."""
    write_whole(folder / "summary.json", json.dumps(summary, indent=2, allow_nan=False).encode())


def write_trials(folder: Path, log: TrialLog) -> None:
    """Write trials.csv."""
    write_whole(folder / "trials.csv", table(log.trials(), log.space).encode())


def write_layouts(folder: Path, bare: Scene, space: Space, ranked: Sequence[Judged]) -> None:
    """Write layouts/best.toml, rank-2.toml, ... and delete what an earlier ranking left."""
    layouts = folder / "layouts"
    layouts.mkdir(parents=True, exist_ok=True)
    names = ["best.toml", *(f"rank-{k}.toml" for k in range(2, len(ranked) + 1))]
    for name, judged in zip(names, ranked, strict=False):
        built(bare, space, judged.centres).to_toml(layouts / name)
    for stale in layouts.glob("rank-*.toml"):
        if stale.name not in names:
            stale.unlink()


def versions() -> dict[str, str]:
    """Of what decides a result."""
    found = {"python": platform.python_version(), "machine": platform.machine()}
    for name in ("gns-baffles", "torch", "numpy", "numba", "optuna", "cvxpy"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def _flat(judged: Judged | None) -> dict[str, Any] | None:
    return None if judged is None else {**(judged.verified or {}), **judged.as_dict()}

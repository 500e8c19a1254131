"""Read back what a search left in its run folder, whole or interrupted, for figures and report.

Nothing here is needed to run a search, and nothing here fails because a part is missing: the
report says in words what is not there. A part that is there but broken is named in `problems`.
"""

from __future__ import annotations

import csv
import itertools
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from design.form import FORM
from gns_model import measures
from gns_model.errors import GnsError
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory

#: What a reader calls the layouts that every run compares with.
LABELS = {"best": "Best found", "paper": "Scene's own layout", "none": "No baffles"}

#: Under which key of summary.json they are.
SUMMARY_KEYS = {"best": "best", "paper": "paper_layout", "none": "no_baffles"}

#: File-name endings of the two simulators' trajectories.
SOLVER, LEARNED = "mpm", "learned"


@dataclass
class Design:
    """One layout of the run and what is known of it.

    Attributes:
        key: "best", "rank-2", ..., "paper", "none"; also the stem of its files.
        label: for a reader.
        centres: [m], shape (n, D-1), or None where the run does not say.
        surrogate: measures by the learned simulator; empty where not known.
        verified: measures by the reference solver; empty where not (yet) verified.
        cost: objective by the learned simulator, or None.
        verified_cost: objective by the reference solver, or None.
        origin: which part of the search proposed it.
        status: how the solver's rollout ended, "" where it has not run.
        size, yaw: of its baffles [m], [degrees], where the search chose them.
        spread: of the ensemble, by measure; empty where there is none.
        marks: why the learned simulator may be out of its depth here.
        model: the refined model that found it, "" for the one that was given.
    """

    key: str
    label: str
    centres: np.ndarray | None = None
    surrogate: dict[str, float] = field(default_factory=dict)
    verified: dict[str, float] = field(default_factory=dict)
    cost: float | None = None
    verified_cost: float | None = None
    origin: str = ""
    status: str = ""
    size: tuple[float, ...] | None = None
    yaw: float | None = None
    spread: dict[str, float] = field(default_factory=dict)
    marks: list[str] = field(default_factory=list)
    model: str = ""

    def placed(self, scene: Scene) -> Scene:
        """`scene`, that of the run, with these baffles.

        Raises:
            SceneError: if they do not fit into it.
        """
        if self.key == "paper":
            return scene
        centres = np.zeros((0, scene.dim - 1)) if self.centres is None else self.centres
        return scene.with_baffles(centres, size=self.size, yaw=self.yaw)


@dataclass
class Trial:
    """One rollout of the search; `cost` is None if it failed, `centres` [m] (n, D-1) or None;
    `form` is what the search chose of sizes [m] and yaw [degrees], by name."""

    number: int
    origin: str
    cost: float | None
    measures: dict[str, float]
    centres: np.ndarray | None = None
    form: dict[str, float] = field(default_factory=dict)


class RunResults:
    """A run folder, read lazily. `problems` names every part that is there but unreadable."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.problems: list[str] = []
        self._trajectories: dict[str, Trajectory | None] = {}

    @cached_property
    def summary(self) -> dict[str, Any]:
        """summary.json, or an empty dict."""
        path = self.folder / "summary.json"
        if not path.is_file():
            return {}
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            self.problems.append(f"summary.json cannot be read: {error}")
            return {}
        return values if isinstance(values, dict) else {}

    @cached_property
    def scene(self) -> Scene | None:
        """The scene that was optimised, with its own layout; None if no file of the run has it."""
        path = self.folder / "scene.toml"
        if path.is_file():
            try:
                return Scene.from_toml(path)
            except GnsError as error:
                self.problems.append(str(error))
        for key in ("paper", "none", "best"):
            trajectory = self.trajectory(key, SOLVER) or self.trajectory(key, LEARNED)
            if trajectory is not None:
                return trajectory.scene if key == "paper" else trajectory.scene.with_baffles([])
        return None

    @cached_property
    def trials(self) -> list[Trial]:
        """Every rollout of the search in the order in which they ran."""
        path = self.folder / "trials.csv"
        if not path.is_file():
            return []
        trials = []
        try:
            with path.open(encoding="utf-8", newline="") as file:
                for index, row in enumerate(csv.DictReader(file)):
                    number = _number(row.get("number", row.get("trial")))
                    cost = _number(row.get("cost", row.get("value")))
                    status = str(row.get("status", row.get("state", "")) or "").lower()
                    if status not in ("", "ok", "complete"):
                        cost = None
                    trials.append(
                        Trial(
                            int(number) if number is not None else index,
                            str(row.get("origin") or "search"),
                            cost,
                            _numbers({k: row.get(k) for k in measures.UNITS}),
                            _placed(row),
                            {n: v for n in FORM if (v := _number(row.get(n))) is not None},
                        )
                    )
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            self.problems.append(f"trials.csv cannot be read: {error}")
        return trials

    @cached_property
    def designs(self) -> list[Design]:
        """Best first, then the other ranked layouts, the scene's own and no baffles."""
        found = [self._design("best", self.summary.get("best"))]
        tried = [t for t in self.trials if t.cost is not None]
        if not _any(found[0]) and tried:
            # Interrupted before a summary: the table of trials still knows which was best.
            lowest = min(tried, key=lambda t: t.cost if t.cost is not None else math.inf)
            found[0].centres, found[0].cost = lowest.centres, lowest.cost
            found[0].size, found[0].yaw = _form(lowest.form, self.scene)
            found[0].surrogate, found[0].origin = lowest.measures, lowest.origin
        rank = 1
        for entry in self.summary.get("ranked") or []:
            design = self._design(f"rank-{rank}", entry)
            if _same(design.centres, found[0].centres):
                rank += 1
                _fill(found[0], design)
                continue
            rank = max(rank, 2)
            design.key, design.label = f"rank-{rank}", f"Rank {rank}"
            found.append(design)
            rank += 1
        for key in ("paper", "none"):
            design = self._design(key, self.summary.get(SUMMARY_KEYS[key]))
            if design.centres is None and key == "none":
                design.centres = _centres([])
            if design.centres is None and key == "paper" and self.scene and self.scene.baffles:
                design.centres = _centres([b.center for b in self.scene.baffles])
            found.append(design)
        return [d for d in found if d.surrogate or d.verified or (d.key == "best" and _any(d))]

    @cached_property
    def searcher(self) -> str:
        """What to call the simulator that the search looked through."""
        settings = self.summary.get("settings")
        simulator = settings.get("simulator") if isinstance(settings, dict) else None
        name = simulator.get("name") if isinstance(simulator, dict) else simulator
        return "search's own solver" if name == SOLVER else "learned simulator"

    @property
    def complete(self) -> bool:
        """Whether the run says that it reached its end."""
        return self.summary.get("status") == "complete"

    def design(self, key: str) -> Design | None:
        """The layout under `key`, or None if the run holds nothing about it."""
        return next((d for d in self.designs if d.key == key), None)

    def trajectory(self, key: str, simulator: str) -> Trajectory | None:
        """trajectories/{key}-{simulator}.h5, or None if it is missing or broken."""
        name = f"{key}-{simulator}.h5"
        if name not in self._trajectories:
            path = self.folder / "trajectories" / name
            try:
                self._trajectories[name] = Trajectory.load(path) if path.is_file() else None
            except GnsError as error:
                self.problems.append(str(error))
                self._trajectories[name] = None
        return self._trajectories[name]

    def compared(self) -> Iterator[Design]:
        """The layouts that both simulators have judged."""
        return (d for d in self.designs if d.surrogate and d.verified)

    def _design(self, key: str, entry: Any) -> Design:
        entry = entry if isinstance(entry, dict) else {}
        design = Design(key, LABELS.get(key, key))
        # Measures may stand in the entry itself or under the simulator that they are by.
        nested = isinstance(entry.get("verified"), dict) or isinstance(entry.get("surrogate"), dict)
        design.surrogate = _numbers(entry.get("surrogate")) if nested else {}
        design.verified = _numbers(entry.get("verified") if nested else entry)
        layout = entry.get("layout")
        if isinstance(layout, list):
            design.centres = _centres(layout)
        if isinstance(entry.get("size"), list):
            design.size = tuple(map(float, entry["size"]))
            design.yaw = _number(entry.get("yaw")) or 0.0
        design.cost = _number(entry.get("cost"))
        design.verified_cost = _number(entry.get("verified_cost"))
        design.origin = str(entry.get("origin") or "")
        design.status = str(entry.get("verified_status") or "")
        spread, marks = entry.get("spread"), entry.get("marks")
        if isinstance(spread, dict):
            known = {str(k): _number(v) for k, v in spread.items()}
            design.spread = {k: v for k, v in known.items() if v is not None}
        if isinstance(marks, list):
            design.marks = [str(mark) for mark in marks]
        design.model = str(entry.get("model") or "")
        for attribute, simulator in (("verified", SOLVER), ("surrogate", LEARNED)):
            if not getattr(design, attribute) and not key.startswith("rank-1"):
                trajectory = self.trajectory(key, simulator)
                if trajectory is not None:
                    setattr(design, attribute, _numbers(measures.summary(trajectory)))
                    if design.centres is None:
                        design.centres = _centres([b.center for b in trajectory.scene.baffles])
                        for first in trajectory.scene.baffles[:1]:
                            design.size, design.yaw = first.size, first.yaw
        return design


def _form(
    chosen: dict[str, float], scene: Scene | None
) -> tuple[tuple[float, ...] | None, float | None]:
    """Size and yaw of which some were chosen, the others as in the scene."""
    if not chosen or scene is None:
        return None, None
    size = tuple(chosen.get(name, own) for name, own in zip(FORM, scene.baffle_size, strict=False))
    return size, chosen.get("yaw", scene.baffle_yaw)


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def _numbers(values: Any) -> dict[str, float]:
    if not isinstance(values, dict):
        return {}
    known = {name: _number(values.get(name)) for name in measures.UNITS}
    return {name: number for name, number in known.items() if number is not None}


def _placed(row: dict[str, Any]) -> np.ndarray | None:
    """The layout of a trial, from its columns x1, z1, x2, ... (x1, x2, ... in 2D)."""
    layout = []
    for k in itertools.count(1):
        centre = [_number(row[f"{axis}{k}"]) for axis in "xz" if f"{axis}{k}" in row]
        if not centre or None in centre:
            break
        layout.append(centre)
    return _centres(layout) if layout else None


def _centres(layout: Sequence[Any]) -> np.ndarray:
    """A layout as (n, D-1), also where n is 0 and D unknown."""
    return np.array(layout, dtype=float).reshape(len(layout), -1 if len(layout) else 2)


def _same(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    if a is None or b is None or a.shape != b.shape:
        return False
    return bool(np.allclose(a[np.lexsort(a.T)], b[np.lexsort(b.T)], atol=1e-6))


def _fill(design: Design, other: Design) -> None:
    """What the ranking knows of the best and its own entry does not."""
    for name in ("surrogate", "verified", "cost", "verified_cost", "origin", "spread", "marks"):
        if not getattr(design, name):
            setattr(design, name, getattr(other, name))


def _any(design: Design) -> bool:
    return design.centres is not None or design.cost is not None

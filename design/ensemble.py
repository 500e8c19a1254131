"""An ensemble: several learned models roll out the same layout, and where they disagree, beware.

The members are named by `--ensemble`, or by the card of the model that searches (`ensemble`: names
of shipped models, or folders relative to the checkpoint's own). Only layouts that may be verified
are rolled out by all of them, for a rollout costs seconds. What counts as a large spread is not a
matter of taste: the card holds it (`ensemble_limits`), as `benchmarks/ensemble.py` measured it on
layouts that the models have not seen.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from design.evaluators import SimulatorSpec
from design.outcome import Outcome
from design.rules import broken
from design.store import Pending, Rolled, Watch
from design.verify import Judged
from design.wording import count, quantities
from gns_model.errors import SimulatorError
from gns_model.scene import Scene

#: `--ensemble none`: no members, whatever the card says.
NONE = "none"

#: Layouts that the ensemble rolls out for each one that the reference solver then verifies.
POOL = 2


@dataclass(frozen=True)
class Ensemble:
    """Learned models that judge a layout together.

    Attributes:
        members: the first is the model that searches, or that a refined one came from.
        limits: of the spread of the cost and of measures, above which a layout is marked; empty
            where they are not known for just these members.
    """

    members: tuple[SimulatorSpec, ...] = ()
    limits: dict[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, simulator: SimulatorSpec, names: Sequence[str] | None) -> Ensemble:
        """The ensemble around `simulator`.

        Args:
            names: of further members; None: those that the card of `simulator` names.

        Raises:
            SimulatorError, FileFormatError: if a member cannot be loaded, or is no learned model.
        """
        model = simulator.load()
        card = getattr(model, "card", {})
        own = _own_members(simulator, card)
        wanted = own if names is None else [n for n in names if n != NONE]
        if not wanted:
            return cls()
        specs = [replace(simulator, name=name, options=()) for name in wanted]
        for spec in specs:
            if not is_learned(spec):
                raise SimulatorError(
                    f"--ensemble {spec.name}: an ensemble is of learned models, the reference "
                    "solver judges in the end anyhow"
                )
        if not is_learned(simulator):
            raise SimulatorError(
                f"--ensemble: the simulator {simulator.name!r} is not a learned model, so there is "
                "nothing that an ensemble could check"
            )
        limits = card.get("ensemble_limits", {}) if list(wanted) == own else {}
        return cls((simulator, *specs), {k: float(v) for k, v in limits.items()})

    def __bool__(self) -> bool:
        return len(self.members) > 1

    def check(self, scenes: Sequence[Scene]) -> None:
        """Refuse what a member cannot run. What it was not trained for is said of the searcher.

        Raises:
            SimulatorError, SceneError: as `Simulator.check`.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for spec in self.members[1:]:
                for scene in scenes:
                    spec.load().check(scene)

    def describe(self) -> dict[str, Any]:
        """Plain values for summary.json."""
        return {"members": [spec.name for spec in self.members], "limits": self.limits}

    def marks(self, spread: dict[str, float]) -> list[str]:
        """Why a layout of this spread is out of the models' depth, in words; empty: it is not."""
        if not all(map(math.isfinite, spread.values())):
            return ["a rollout of the ensemble failed"]
        titles = {q.name: q.title.lower() for q in quantities(None)} | {"cost": "objective"}
        return [
            f"the ensemble disagrees on the {titles[name]} by {100 * spread[name]:.1f} %, where "
            f"{100 * limit:.1f} % is usual at most"
            for name, limit in self.limits.items()
            if spread.get(name, 0.0) > limit
        ]


def is_learned(spec: SimulatorSpec) -> bool:
    """Whether `spec` is a learned model, with weights and a card."""
    return hasattr(spec.load(), "model")


def _own_members(simulator: SimulatorSpec, card: dict[str, Any]) -> list[str]:
    """Members that the card of `simulator` names, as `load_simulator` finds them."""
    from pathlib import Path

    from gns_model.learned.checkpoint import shipped_models

    shipped = shipped_models()
    home = shipped.get(simulator.name, Path(simulator.name))
    names = []
    for name in card.get("ensemble", []):
        beside = (home / name).resolve()
        names.append(str(name) if name in shipped else str(beside))
    return names


def relative_spread(outcomes: Sequence[Outcome], none: Sequence[Outcome]) -> dict[str, float]:
    """How far the members of an ensemble differ over one layout, by measure.

    Every member's value is taken relative to what that member says of no baffles: a bias common to
    all layouts says nothing about this one, and cancels in a search. The spread is the standard
    deviation over the members; inf where one of them failed.

    Args:
        outcomes, none: of the layout and of no baffles, by each member.
    """
    failed = any(o.status != "ok" for o in (*outcomes, *none))
    result = {"cost": _deviation([o.cost for o in outcomes]) if not failed else math.inf}
    for name in none[0].measures:
        if failed:
            result[name] = math.inf
            continue
        references = [o.measures[name] for o in none]
        if min(map(abs, references)) < 1e-9:
            continue  # overtopping without baffles
        result[name] = _deviation(
            [o.measures[name] / r for o, r in zip(outcomes, references, strict=True)]
        )
    return result


def _deviation(values: Sequence[float]) -> float:
    """Sample standard deviation over the mean."""
    mean = float(np.mean(values))
    return float(np.std(values, ddof=1)) / max(abs(mean), 1e-9)


class Panel:
    """An ensemble at work in one run.

    Args:
        ensemble: who judges.
        searcher: whose judgement of every layout is known already.
        roll: starts the rollouts of a layout (None: no baffles), one in each flow.
        weigh: makes one outcome of those and of their rollouts without baffles.
    """

    def __init__(
        self,
        ensemble: Ensemble,
        searcher: SimulatorSpec,
        roll: Callable[[SimulatorSpec, Judged | None], list[Pending]],
        weigh: Callable[[list[Rolled], list[Rolled]], Outcome],
        watch: Watch,
    ) -> None:
        self.ensemble = ensemble
        self._searcher, self._roll, self._weigh, self._watch = searcher, roll, weigh, watch
        self._bare = {spec: roll(spec, None) for spec in ensemble.members}
        watch.add("ensemble: no baffles", [p for ps in self._bare.values() for p in ps])

    def choose(self, layouts: Sequence[Judged], number: int) -> list[Judged]:
        """The `number` of `layouts` that all members together think best, all of them judged.

        The best by the searcher's own cost stays among them: it is what the search was for.
        """
        if not layouts:
            return []
        self.judge(layouts)
        first, *others = layouts
        others.sort(
            key=lambda j: (
                broken(j.excess),
                j.ensemble_cost if j.ensemble_cost is not None else math.inf,
            )
        )
        return [first, *others[: number - 1]]

    def judge(self, layouts: Sequence[Judged]) -> None:
        """Fill in the spread, the marks and the mean cost of `layouts`."""
        others = [s for s in self.ensemble.members if s != self._searcher]
        started = {(k, s): self._roll(s, x) for k, x in enumerate(layouts) for s in others}
        waiting = [p for ps in (*started.values(), *self._bare.values()) for p in ps]
        self._watch.add(f"ensemble: {count(len(layouts), 'layout').lower()}", [*waiting])
        self._watch.wait(waiting)
        bare = {s: [p.result() for p in ps] for s, ps in self._bare.items()}
        none = {s: self._weigh(rolled, rolled) for s, rolled in bare.items()}
        for k, layout in enumerate(layouts):
            outcomes = {
                s: self._weigh([p.result() for p in started[k, s]], bare[s]) for s in others
            }
            if self._searcher in none:
                known = Outcome(layout.cost or 0.0, layout.surrogate)
                outcomes[self._searcher] = known
            seen = list(outcomes)
            layout.spread = relative_spread([outcomes[s] for s in seen], [none[s] for s in seen])
            layout.ensemble_cost = float(np.mean([o.cost for o in outcomes.values()]))
            layout.marks = self.ensemble.marks(layout.spread)


def beyond_limits(simulator: SimulatorSpec, scene: Scene) -> list[str]:
    """What of a scene with its baffles lies outside what a learned model was trained on."""
    outside = getattr(simulator.load(), "outside", None)
    lines = [] if outside is None else outside(scene)
    return [f"the model was not trained for {line}" for line in lines]

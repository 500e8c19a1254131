"""What can be chosen about a run, checked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from design.evaluators import SimulatorSpec
from design.methods import METHODS
from design.objectives import joined, split
from design.risk import Risk
from design.rules import Rules
from design.scenarios import Scenarios
from gns_env.layout import LayoutSpace
from gns_env.objective import Objective
from gns_model.errors import GnsError
from gns_model.scene import Scene

#: Layouts of a search that is given no budget; a gradient counts twice.
DEFAULT_BUDGET = 48


class SettingError(GnsError, ValueError):
    """A setting out of its range: the message names it and what is allowed."""


def check_pattern(pattern: str) -> None:
    """Raise SettingError if there is no such pattern."""
    if pattern not in ("free", "rows"):
        raise SettingError(f"pattern must be free or rows, got {pattern!r}")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What can be chosen about a run.

    Attributes:
        method: a key of `methods.METHODS`; None: hybrid where the simulator has a gradient.
        baffles: how many; None: as many as the scene has, or 3.
        budget: passes through a rollout that the search may spend; None: 48 for each scenario.
        verify: how many of the best layouts the reference solver judges; 0: none at all.
        seed: of everything random.
        simulator, verifier: who searches and who judges.
        objective: what to make small; with `objectives`, the sum of those, which says what point of
            the front is recommended.
        objectives: names of `objectives.NAMES` for a Pareto front; none: one objective.
        scenarios: the flows that a layout has to stand; None: the scene's own.
        storage: Optuna storage address, of a study that several workers may share; None: SQLite in
            the run folder.
        study: name of the study there.
        grace: seconds without a sign of life after which another worker's trials are tried again.
        resume: go on with what the run folder and the storage hold.
        workers: processes of one thread; None: one a core, as many as are of use.
        batch: layouts proposed at a time.
        ensemble: further learned models that judge what may be verified; None: those that the card
            of the simulator names.
        refine: rounds in which verified layouts are fed back into training.
        refine_minutes: of training in each round.
        refine_data: folder of trajectories that the model must not forget, if any.
        pattern: "free", or "rows" as an engineer draws them.
        baffle_cost, concrete_cost: of each baffle and m³ of concrete, in units of the objective.
        placement: values that replace those of the scene's placement, by name, such as max_height;
            under `vary` those of its table `vary`.

    Raises:
        SettingError: for a value out of its range.
    """

    method: str | None = None
    baffles: int | None = None
    budget: int | None = None
    verify: int = 4
    seed: int = 0
    simulator: SimulatorSpec = field(default_factory=lambda: SimulatorSpec("baffle-lite"))
    verifier: SimulatorSpec = field(default_factory=lambda: SimulatorSpec("mpm"))
    objective: Objective = field(default_factory=Objective)
    objectives: tuple[str, ...] = ()
    scenarios: Scenarios | None = None
    storage: str | None = None
    study: str = "gns-design"
    grace: int = 60
    resume: bool = False
    workers: int | None = None
    batch: int = 8
    ensemble: tuple[str, ...] | None = None
    refine: int = 0
    refine_minutes: float = 5.0
    refine_data: Path | None = None
    pattern: str = "free"
    baffle_cost: float = 0.0
    concrete_cost: float = 0.0
    placement: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        least = {"budget": 1, "verify": 0, "batch": 1, "seed": 0, "workers": 1, "baffles": 1}
        least["refine"] = 0
        least["grace"] = 2
        for name, bound in least.items():
            value = getattr(self, name)
            if value is not None and value < bound:
                raise SettingError(f"{name} must be {bound} or more, got {value}")
        if self.budget is not None and self.budget < self.flows:
            raise SettingError(
                f"budget must be {self.flows} or more, a rollout for each scenario, got "
                f"{self.budget}"
            )
        if self.refine and not self.verify:
            raise SettingError("refine needs verified layouts: verify must be 1 or more, got 0")
        if self.refine and self.objectives:
            raise SettingError("refine goes with one objective, not with a Pareto front")
        if not (math.isfinite(self.refine_minutes) and self.refine_minutes > 0):
            raise SettingError(f"refine_minutes must be positive, got {self.refine_minutes:g}")
        if self.objectives:
            object.__setattr__(self, "objective", joined(self.parts))
        check_pattern(self.pattern)
        Rules(baffle_cost=self.baffle_cost, concrete_cost=self.concrete_cost)
        if self.objectives and (self.baffle_cost or self.concrete_cost):
            raise SettingError(
                "a price of baffles joins one objective: give no --baffle-cost and no "
                "--concrete-cost with --objectives"
            )
        if self.method is not None and self.method not in METHODS:
            raise SettingError(f"no method {self.method!r}: give {', '.join(METHODS)}")

    @property
    def parts(self) -> tuple[Objective, ...]:
        """Every objective apart."""
        return split(self.objectives, self.objective) if self.objectives else (self.objective,)

    @property
    def flows(self) -> int:
        """Rollouts that one layout takes."""
        return self.scenarios.count if self.scenarios else 1

    @property
    def passes(self) -> int:
        """The budget in rollouts."""
        return DEFAULT_BUDGET * self.flows if self.budget is None else self.budget

    def applied(self, scene: Scene) -> Scene:
        """`scene` with the values of `placement` in place of its own.

        Raises:
            SceneError: if one of them cannot be.
        """
        if not self.placement:
            return scene
        # A scene without a placement gets the usual one, to put the values into.
        own = scene.placement or LayoutSpace(scene, 1).placement
        values = own.model_dump()
        vary = {**(values["vary"] or {}), **self.placement.get("vary", {})}
        values |= {**self.placement, "vary": vary or None}
        return scene.replace(placement=values)

    @property
    def risk(self) -> Risk:
        """Of the costs in several flows."""
        return self.scenarios.risk if self.scenarios else Risk()

"""No baffles and the scene's own layout: what costs are relative to, and what is to be beaten."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from design.form import Form
from design.outcome import Outcome, Trial
from design.space import DesignSpace, numbers, split
from design.store import Pending, Rolled, RolloutStore
from design.verify import as_judged
from gns_model.errors import SceneError, SimulatorError

if TYPE_CHECKING:
    from design.evaluators import SimulatorSpec
    from design.run import Run


@dataclass(frozen=True)
class References:
    """Rollouts by one simulator, one in each flow.

    Attributes:
        none: of no baffles.
        own: of the scene's own layout; empty where it has none that stands in every flow.
    """

    none: Sequence[Pending] = ()
    own: Sequence[Pending] = ()

    @classmethod
    def start(cls, run: Run, store: RolloutStore, spec: SimulatorSpec) -> References:
        """Have `spec` simulate both."""
        problem = run.problem
        # Of several flows nobody looks at one; only the search reads those without baffles.
        alone = not problem.drawn
        searches = spec == run.settings.simulator
        none = store.roll(spec, problem.flows, trajectory=alone or searches)
        if not problem.scene.baffles:
            return cls(none)
        try:
            own = [problem.own(flow) for flow in problem.flows]
        except SceneError as error:
            run.note(f"the scene's own layout does not stand in every scenario: {error}")
            return cls(none)
        return cls(none, store.roll(spec, own, trajectory=alone))

    @property
    def pending(self) -> list[Pending]:
        """All of them."""
        return [*self.none, *self.own]

    def bare(self, rollout: str, so: str) -> list[Rolled]:
        """The rollouts of no baffles; waits for them.

        Args:
            rollout, so: whose they are and what follows if one fails, for the message.

        Raises:
            SimulatorError: if one failed.
        """
        found = [p.result() for p in self.none]
        for rolled in found:
            if rolled.status != "ok":
                raise SimulatorError(
                    f"the {rollout} without baffles ended as {rolled.status!r}{so}"
                )
        return found


def take_in(run: Run, searched: References) -> list[Rolled]:
    """What the search's simulator says of both becomes `run.none`, `run.paper` and a trial.

    Returns:
        the rollouts of no baffles.

    Raises:
        SimulatorError: if one of them failed.
    """
    problem = run.problem
    none = searched.bare(
        f"rollout of {run.settings.simulator.name}", ", so no cost can be relative to it"
    )
    empty = np.zeros((0, problem.scene.dim - 1))
    run.none = as_judged(Trial(-1, "none", empty, problem.weigh(none, none)))
    if searched.own:
        own = [p.result() for p in searched.own]
        centres = np.array([baffle.center for baffle in problem.scene.baffles], dtype=float)
        outcome = replace(problem.weigh(own, none), seconds=sum(r.seconds for r in own))
        run.paper = as_judged(Trial(-1, "scene", centres, outcome))
        _log(run, centres, outcome)
    return none


def _log(run: Run, centres: np.ndarray, outcome: Outcome) -> None:
    """The scene's own layout is a trial too, where the search could have proposed it."""
    space = run.problem.space
    forms = {Form(b.size, b.yaw) for b in run.problem.scene.baffles}
    if len(forms) > 1:
        return
    layout, form = centres, forms.pop()
    if isinstance(space, DesignSpace):
        layout = space.join(centres, form)
    alike = split(space, layout)[1]
    if not np.allclose((*form.size, form.yaw), (*alike.size, alike.yaw)):
        return
    if len(centres) not in numbers(space) or space.check(layout):
        return
    if not any(trial.origin == "scene" for trial in run.log.trials()):
        run.log.add("scene", layout, outcome)

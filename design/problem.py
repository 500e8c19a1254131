"""What a run has to solve: the flows, the buildable layouts, and how one is weighed.

Nothing here is simulated; what the simulators could not run is refused.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from design.evaluators import failure_cost
from design.outcome import Outcome
from design.risk import Flow, weigh
from design.rows import RowSpace
from design.rules import Rules
from design.scenarios import scenes, widest
from design.settings import Settings
from design.space import DesignSpace, Space, built, design_space
from design.store import Rolled
from design.verify import Judged
from gns_env.scenario import Scenario
from gns_model.particles import fill
from gns_model.scene import Scene


@dataclass(frozen=True)
class Problem:
    """A scene with the settings of a run.

    Attributes:
        scene: as given, with what the settings put into its placement.
        drawn: the scenarios that a layout has to stand; empty: the scene's own flow.
        space: the buildable layouts.
        bare: the scene without baffles.
        flows: the same in each scenario.
        rules: prices and limits.
        notes: what is worth knowing of it, in words.
    """

    scene: Scene
    settings: Settings
    drawn: tuple[Scenario, ...]
    space: Space
    bare: Scene
    flows: tuple[Scene, ...]
    rules: Rules
    notes: tuple[str, ...]

    @classmethod
    def of(cls, scene: Scene, settings: Settings) -> Problem:
        """The problem of a scene.

        Raises:
            SceneError, LayoutError, SimulatorError, GnsError: if it cannot be searched as asked.
        """
        scene = settings.applied(scene)
        drawn: list[Scenario] = []
        notes: list[str] = []
        flows = [scene.with_baffles([])]
        if settings.scenarios:
            drawn, notes = settings.scenarios.draw(scene, settings.simulator.load())
            flows = scenes(flows[0], drawn)
        # What is clear of the largest release is clear of all. A scene without a placement keeps
        # its baffles here, for they say how large one is.
        largest = widest(flows)
        if scene.placement is None:
            largest = largest.replace(baffles=scene.baffles)
        else:
            own = {"size": scene.baffle_size, "yaw": scene.baffle_yaw or None}
            largest = largest.replace(placement=scene.placement.model_copy(update=own))
        asked = settings.baffles or len(scene.baffles) or 3
        rows = settings.pattern == "rows"
        space: Space = RowSpace(largest, asked) if rows else design_space(largest, asked)
        bare = scene.replace(baffles=(), placement=space.placement)
        flows = [flow.replace(placement=space.placement) for flow in flows]
        notes += space.notes if isinstance(space, DesignSpace) else []
        notes += _warnings([scene, *flows] if drawn else [scene], settings)
        return cls(
            scene=scene,
            settings=settings,
            drawn=tuple(drawn),
            space=space,
            bare=bare,
            flows=tuple(flows),
            rules=Rules.of(bare, settings.baffle_cost, settings.concrete_cost),
            notes=tuple(notes),
        )

    @property
    def baffles(self) -> int:
        """How many; where the number varies, the one to begin with."""
        return self.space.n_baffles

    @property
    def objective_text(self) -> str:
        """What is made small, in words."""
        text = str(self.settings.objective)
        return f"{text}; plus {self.rules}" if self.rules.charges else text

    def identity(self) -> dict[str, Any]:
        """Plain values that tell a study of this problem from that of another."""
        s = self.settings
        task: dict[str, Any] = {
            "scene": self.bare.to_dict(),
            "number of baffles": self.baffles,
            "objective": asdict(s.objective),
            "simulator": s.simulator.describe(),
        }
        if s.objectives:
            task["set of objectives"] = list(s.objectives)
        if s.pattern != "free":
            task["pattern"] = s.pattern
        if self.rules.charges:
            task["price"] = [s.baffle_cost, s.concrete_cost]
        if s.scenarios:
            task["set of scenarios"] = [asdict(flow) for flow in self.drawn]
            task["risk"] = asdict(s.risk)
        return task

    def built(self, flow: Scene, layout: Judged) -> Scene:
        """`flow` with the baffles of a layout that the search proposed."""
        return built(flow, self.space, layout.centres)

    def own(self, flow: Scene) -> Scene:
        """`flow` with the scene's own layout.

        Raises:
            SceneError: if a release of the flow reaches a baffle.
        """
        return flow.replace(baffles=self.scene.baffles)

    def laid_out(self, layout: Judged | None) -> list[Scene]:
        """Every flow with the baffles of a layout; None: without."""
        if layout is None or layout.origin == "none":
            return list(self.flows)
        if layout.origin == "scene":
            return [self.own(flow) for flow in self.flows]
        return [self.built(flow, layout) for flow in self.flows]

    def weigh(self, rolled: Sequence[Rolled], none: Sequence[Rolled]) -> Outcome:
        """One layout in all flows, relative to no baffles in each."""
        s = self.settings
        flows = [
            Flow.of(r.status, r.measures, n.measures, s.parts, self.rules, r.sizes)
            for r, n in zip(rolled, none, strict=True)
        ]
        return weigh(flows, s.risk, failure_cost(s.parts))


def _warnings(flows: Sequence[Scene], settings: Settings) -> list[str]:
    """Refuse what the simulators cannot run; return what they warn of, each limit once."""
    notes = []
    for spec in (settings.simulator, *([settings.verifier] if settings.verify else [])):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            simulator = spec.load()
            for scene in flows:
                simulator.check(scene)
                spacing = getattr(simulator, "spacing", None)
                if spacing is not None:
                    fill(scene, spacing)  # a release thinner than that: say so before the search
        notes += [str(warning.message) for warning in caught]
    return notes

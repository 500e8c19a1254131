"""Inverse problems: which friction angle, or which release velocity, made this deposit?

The unknown is found by L-BFGS-B on the squared distance between the deposit that a simulator
predicts and the target. Each evaluation costs one rollout and, through a learned simulator, one
backward pass, whatever the number of unknowns; by forward differences it costs 1 + P rollouts.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch

from design.target import Target
from design.unknowns import Parameter, Unknown, unknown
from gns_model.errors import SimulatorError
from gns_model.measures import moving_positions
from gns_model.scene import Scene
from gns_model.simulator import Simulator
from gns_model.trajectory import OK

Method = Literal["gradient", "differences"]

#: Unit of the unknown for L-BFGS-B: [degrees], [m/s]; its first step is `FIRST_STEP` of them.
UNIT = {"friction": 4.0, "velocity": 0.3}
FIRST_STEP = (0.25, 2.0)
#: Step of a forward difference: [degrees], [m/s].
DIFFERENCE = {"friction": 0.5, "velocity": 0.05}
#: The search ends at this share of the first squared distance, and where two evaluations in a row
#: gain less than that of the least.
NEAR, LEAST_GAIN = 1e-4, 0.01


@dataclass
class Found:
    """What a calibration found, and what it cost.

    Attributes:
        value: best value, shape (P,); `distance` [m] is the target's from its deposit.
        start, start_distance: the scene's own.
        method: the one that led there: "differences" too where a gradient did not lead down.
        rollouts, backwards: that were really run.
        history: value and distance of every evaluation, in order.
        status: "converged", "budget" or "interrupted".
        at_bound: the value lies at the end of the range that was looked through.
    """

    value: np.ndarray
    distance: float
    start: np.ndarray
    start_distance: float
    method: Method
    rollouts: int
    backwards: int
    seconds: float
    status: str
    at_bound: bool
    history: list[tuple[list[float], float]] = field(default_factory=list)

    @property
    def evaluations(self) -> int:
        """Values of the unknown at which a slope was taken."""
        return len(self.history)

    @property
    def rollouts_by_differences(self) -> int:
        """Rollouts of as many evaluations by forward differences."""
        return self.evaluations * (1 + len(self.value))


def default_method(simulator: Simulator, parameter: Parameter, method: Method | None) -> Method:
    """The method asked for, or gradient where the simulator has one.

    Raises:
        SimulatorError: if the simulator knows nothing of the unknown, or has no gradient.
    """
    learned = hasattr(simulator, "rollout_tensor")
    if method == "gradient" and not learned:
        raise SimulatorError(
            f"{simulator.name} has no gradient: give --method differences, or a learned simulator"
        )
    features = simulator.config.material_features if learned else ()  # type: ignore[attr-defined]
    if learned and parameter == "friction" and "tan_friction_angle" not in features:
        raise SimulatorError(
            f"{simulator.name} does not see the friction angle, so it cannot find it: give "
            f"{models_that_see_friction()}"
        )
    if learned and parameter == "velocity" and simulator.config.solver_steps:  # type: ignore[attr-defined]
        # The solver's first steps stand between the release and the network.
        if method == "gradient":
            raise SimulatorError(
                f"{simulator.name} leaves its first steps to the reference solver, so it has no "
                "gradient by the velocity of the release: give --method differences"
            )
        return "differences"
    return method or ("gradient" if learned else "differences")


def fitting_models(parameter: Parameter, dim: int | None = None) -> list[str]:
    """The shipped models, of dimension `dim` if one is given, that answer to a parameter."""
    from gns_model.errors import GnsError
    from gns_model.learned.checkpoint import read_card, shipped_models

    names = []
    for name, path in sorted(shipped_models().items()):
        try:
            config = read_card(path).get("config") or {}
        except GnsError:
            continue
        sees = parameter == "velocity" or "tan_friction_angle" in config.get(
            "material_features", ()
        )
        if sees and dim in (None, config.get("dim")):
            names.append(name)
    return names


def models_that_see_friction() -> str:
    """The simulators that answer to the friction angle, for a reader."""
    names = fitting_models("friction")
    own = 'a model trained with material_features = ["tan_friction_angle"]'
    return " or ".join(["mpm", *names, own])


def calibrate(
    scene: Scene,
    simulator: Simulator,
    target: Target,
    parameter: Parameter,
    *,
    method: Method | None = None,
    budget: int = 12,
    progress: Callable[[int, float, np.ndarray], None] | None = None,
) -> Found:
    """The value of a parameter of `scene` whose deposit is nearest to `target`.

    Args:
        scene: where the search starts.
        simulator: a learned one for gradients, any for differences.
        method: default: gradient where there is one.
        budget: most evaluations.
        progress: called with the evaluations done, the least distance [m] and its value.

    Raises:
        SimulatorError: as `default_method`; or if the rollout of the scene itself fails.
    """
    from scipy.optimize import minimize

    wanted = unknown(parameter, scene, target)
    method = default_method(simulator, parameter, method)
    simulator.check(scene)
    measure = _Measure(scene, simulator, target, wanted, method, budget, progress)
    bounds, unit = wanted.bounds(scene, simulator), UNIT[parameter]
    start = np.clip(wanted.start(scene), *np.array(bounds).T)
    began = time.perf_counter()

    def descend() -> str:
        try:
            minimize(
                lambda x: measure(x * unit, unit),
                start / unit,
                jac=True,
                method="L-BFGS-B",
                bounds=np.array(bounds) / unit,
                options={"ftol": 0.0, "gtol": 0.0, "maxfun": budget},
            )
        except _SpentError:
            return "budget"
        except _NearError:
            pass
        except KeyboardInterrupt:
            if not measure.history:
                raise
            return "interrupted"
        return "converged"

    status = descend()
    distances = [d for _, d in measure.history]
    if measure.method == "gradient" and len(distances) > 1 and min(distances) == distances[0] > 0:
        # Adjoints of a chaotic flow can point anywhere; a difference of two rollouts cannot.
        measure.turn_to_differences()
        if status == "converged":
            status = descend()
    value, distance = min(measure.history, key=lambda entry: entry[1])
    at_bound = bool(np.isclose(np.array(bounds).T, value, atol=1e-6).any())
    return Found(
        np.array(value), distance, start, distances[0], measure.method, measure.rollouts,
        measure.backwards, time.perf_counter() - began, status, at_bound, measure.history,
    )  # fmt: skip


class _SpentError(Exception):
    """The budget is used up."""


class _NearError(Exception):
    """Two evaluations in a row gained nothing that counts."""


class _Measure:
    """Squared distance and its slope, counted; called by the optimiser."""

    def __init__(
        self,
        scene: Scene,
        simulator: Simulator,
        target: Target,
        wanted: Unknown,
        method: Method,
        budget: int,
        progress: Callable[[int, float, np.ndarray], None] | None,
    ) -> None:
        self.scene, self.simulator, self.target = scene, simulator, target
        self.wanted, self.method, self.budget = wanted, method, budget
        self.progress = progress
        self.rollouts = self.backwards = 0
        self.history: list[tuple[list[float], float]] = []
        self._scale: float | None = None
        self._begun = 0

    def __call__(self, value: np.ndarray, unit: float) -> tuple[float, np.ndarray]:
        """d² at `value` (P,), scaled, and its slope per `unit`."""
        if len(self.history) >= self.budget:
            raise _SpentError
        self._stop_if_near()
        if self.method == "gradient":
            squared, slope = self._by_gradient(value)
        else:
            squared, slope = self._by_differences(value)
        # A rollout that fails is no reason to stop looking.
        if not (math.isfinite(squared) and np.isfinite(slope).all()):
            squared, slope = self._wall(value)
        self.history.append((value.tolist(), math.sqrt(max(squared, 0.0))))
        if self.progress is not None:
            best, distance = min(self.history, key=lambda entry: entry[1])
            self.progress(len(self.history), distance, np.array(best))
        slope = slope * unit
        if self._scale is None:
            # L-BFGS-B first goes by minus the slope: as far as a parabola with its minimum at zero,
            # which a perfect match would be, has it.
            steep = max(float(np.linalg.norm(slope)), 1e-30)
            self._scale = float(np.clip(2 * squared / steep, *FIRST_STEP)) / steep
        return squared * self._scale, slope * self._scale

    def turn_to_differences(self) -> None:
        """Begin anew without the gradient, which did not lead down."""
        self.method, self._scale, self._begun = "differences", None, len(self.history)

    def _stop_if_near(self) -> None:
        squares = [d * d for _, d in self.history]
        if squares and min(squares) <= NEAR * squares[0]:
            raise _NearError
        squares = squares[self._begun :]
        if len(squares) >= 5 and min(squares) > (1 - LEAST_GAIN) * min(squares[:-2]):
            raise _NearError

    def _by_gradient(self, value: np.ndarray) -> tuple[float, np.ndarray]:
        simulator: Any = self.simulator
        leaf = torch.tensor(value, dtype=torch.float64, requires_grad=True)
        options = self.wanted.rollout_options(self.scene, leaf)
        scene = self.wanted.put(self.scene, value)
        # The exact gradient. The derivative by the release velocity is a difference of the adjoints
        # of neighbouring frames, which limited adjoints destroy: on a quarter of the flume over 0.5
        # s the slope was 0.0772 without it, -0.0001 with its 1.5, and 0.0584 by differences.
        (track,) = simulator.rollout_tensor([scene], **options)
        squared = self.target.residuals(track).square().sum()
        squared.backward()
        self.rollouts += 1
        self.backwards += 1
        assert leaf.grad is not None
        return float(squared.detach()), leaf.grad.numpy().copy()

    def _by_differences(self, value: np.ndarray) -> tuple[float, np.ndarray]:
        step = DIFFERENCE[self.wanted.name]
        values = [value, *(value + step * e for e in np.eye(len(value)))]
        flows = self.simulator.rollout([self.wanted.put(self.scene, v) for v in values])
        self.rollouts += len(flows)
        found = []
        for flow in flows:
            track = torch.from_numpy(moving_positions(flow).astype(np.float64))
            found.append(self.target.residuals(track).numpy())
            if flow.status != OK:
                found[-1] = np.full_like(found[-1], math.nan)
        here, *there = found
        # Of the residuals and not of their square, whose forward difference is off by half a step.
        slope = np.array([2 * here @ (r - here) for r in there]) / step
        return float(here @ here), slope

    def _wall(self, value: np.ndarray) -> tuple[float, np.ndarray]:
        """Where a rollout fails: far worse than the best, rising away from it."""
        if not self.history:
            raise SimulatorError(
                f"the rollout of {self.simulator.name} with the scene's own values fails, so "
                "there is nowhere to start from"
            )
        best, distance = min(self.history, key=lambda entry: entry[1])
        away = value - np.array(best)
        squared = 10 * max(d * d for _, d in self.history) + distance**2
        return squared, 2 * squared * away / max(float(away @ away), 1e-12)

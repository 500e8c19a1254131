"""Gradient search: autograd through the whole rollout, chains of projected steps, several starts.

A gradient costs one forward rollout and one backward pass (with a checkpoint a step, about three
forwards of time), so steps are few and chosen (`chains`): every step is projected onto the
buildable layouts by cvxpy. Smooth measures steer; the hard measures of the same rollout decide what
is best.
"""

from __future__ import annotations

import inspect
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from design.baselines import engineering_layouts, random_layouts
from design.campaign import Campaign
from design.chains import LEAST_STEP, STEP, Adam, Chain, Lbfgs
from design.distinct import apart
from design.form import FORM
from design.outcome import Outcome
from design.risk import Flow, Risk, weigh
from design.rules import FREE, PENALTY, Rules
from design.space import DesignSpace, Space, built, split
from gns_env.task import BaffleTask
from gns_model import measures as hard
from gns_model.errors import SimulatorError
from gns_model.learned.adjoint import ADJOINT_LIMIT, ADJOINT_SMOOTHING
from gns_model.particles import MOVING
from gns_model.scene import Scene
from gns_model.trajectory import DIVERGED, OK, Trajectory

if TYPE_CHECKING:
    from torch import Tensor

#: Most chains of a pure gradient search, and the fewest gradients that each should get: long chains
#: from few starts beat single steps from many.
STARTS, LEAST_GRADIENTS = 4, 3


def search(campaign: Campaign) -> None:
    """Projected Adam from the best starts; see `_search`."""
    _search(campaign, Adam)


def lbfgs(campaign: Campaign) -> None:
    """Projected L-BFGS from the best starts; see `_search`."""
    _search(campaign, Lbfgs)


def _search(campaign: Campaign, kind: type[Chain]) -> None:
    """Run the starts, then chains of steps from the best of them until the budget is spent.

    Starts are the engineering layouts and as many random ones as chains. When all chains have ended
    early, new ones start from random layouts.

    Raises:
        SimulatorError: if the simulator has no gradient.
    """
    require_gradient(campaign)
    log, space = campaign.log, campaign.space
    count = min(STARTS, max(campaign.passes // 2 // (2 * LEAST_GRADIENTS), 1))
    if not any(t.origin != "scene" for t in log.trials()):
        starts = [*engineering_layouts(space), *random_layouts(space, count, campaign.rng(1))]
        # At least half of the budget is for steps.
        starts = starts[: max(campaign.left() // 2, 1)]
        campaign.run(starts)
    first = True
    while campaign.left() >= 2:
        if first:
            ranked = sorted((t for t in log.trials() if t.ok), key=lambda t: t.order)
            origins = apart([t.centres for t in ranked], STEP, count)
        else:
            origins = [c for _, c in random_layouts(space, count, campaign.rng(2))]
        first = False
        descend(campaign, origins, campaign.left(), kind)


def require_gradient(campaign: Campaign) -> None:
    """Refuse a simulator without gradient before anything is spent."""
    if not campaign.evaluator.differentiable:
        raise SimulatorError(
            "this simulator has no gradient, so --method gradient or hybrid cannot use it: choose "
            "a learned simulator such as baffle-lite, or --method bayes"
        )


def descend(
    campaign: Campaign, starts: Sequence[np.ndarray], budget: int, kind: type[Chain] = Adam
) -> None:
    """Step all chains together from `starts` [m], shape (n, D-1), within `budget` passes."""
    chains = [kind(campaign.space, start) for start in starts]
    while chains and (budget := min(budget, campaign.left())) >= 2:
        chains = chains[: budget // 2]
        budget -= 2 * len(chains)
        outcomes = campaign.differentiate("gradient", [chain.centres for chain in chains])
        # What another worker runs just now is the other's chain.
        chains = [chain for k, chain in enumerate(chains) if k in outcomes]
        for chain, k in zip(chains, sorted(outcomes), strict=True):
            chain.learn(outcomes[k])
        chains = [chain for chain in chains if chain.step >= LEAST_STEP]


def cost_and_gradient(
    task: BaffleTask,
    layout: ArrayLike,
    *,
    limit: float | None = ADJOINT_LIMIT,
    smoothing: float = ADJOINT_SMOOTHING,
    starts: int = 1,
) -> tuple[float, np.ndarray]:
    """The smooth cost of a layout and its derivative, by one rollout and one backward pass a start.

    Args:
        task: with a simulator that has a gradient; of several objectives the sum counts.
        layout: centres [m], shape (n, D-1), in any order.
        limit, smoothing: of the grains' adjoints (`gns_model.learned.adjoint`), which keep the
            gradient of a long flow right; None and 0: the exact derivative.
        starts: average over that many starts of the flow that differ in single grains
            (`LearnedSimulator.perturbed_start`), the usual one first.

    Returns:
        the cost of the smooth measures, relative to no baffles, and d cost / d layout [1/m], shape
        (n, D-1). The hard cost that a search reports is `task.evaluate([layout])[0].cost`.

    Raises:
        SimulatorError: if the simulator has no gradient or the rollout diverges.
        LayoutError, SceneError: if the layout is none.
    """
    import torch

    if not hasattr(task.simulator, "rollout_tensor"):
        raise SimulatorError(f"the simulator {task.simulator.name!r} has no gradient")
    centres = torch.tensor(task.space.as_centres(layout).copy(), requires_grad=True)
    _, costs = smooth_costs(
        task, [centres] * starts, limit=limit, smoothing=smoothing, draws=range(starts)
    )
    costs.mean().backward()
    cost = float(costs.detach().mean())
    gradient = None if centres.grad is None else centres.grad.numpy()
    if gradient is None or not (np.isfinite(cost) and np.isfinite(gradient).all()):
        raise SimulatorError("the rollout of this layout diverged, so it has no gradient")
    return cost, gradient


def smooth_costs(
    task: BaffleTask,
    centres: Sequence[Tensor],
    *,
    forms: Sequence[tuple[Tensor, Tensor]] | None = None,
    rules: Rules = FREE,
    limit: float | None = ADJOINT_LIMIT,
    smoothing: float = ADJOINT_SMOOTHING,
    draws: Sequence[int] | None = None,
) -> tuple[list[Tensor], Tensor]:
    """Positions (T, N, D) and the smooth cost of each layout (n, D-1), shape (layouts,).

    Args:
        task: with a simulator that has a gradient.
        centres: of each layout [m], shape (n, D-1); may require grad.
        forms: of each layout: size of its baffles [m], shape (D,), and yaw [degrees], shape (); may
            require grad. Default: the task's.
        rules: prices, and limits on the flow, whose excess costs `rules.PENALTY`.
        limit, smoothing: as `cost_and_gradient`.
        draws: the start of each layout (`LearnedSimulator.perturbed_start`); default: the usual.
    """
    import torch

    from gns_model.smooth_measures import smooth_measures, smooth_overtopping

    if forms is None:
        own = (torch.tensor(task.space.size), torch.tensor(float(task.space.yaw)))
        forms = [own] * len(centres)
    scenes = [
        task.scene.with_baffles(c.detach().numpy(), size=size.tolist(), yaw=float(yaw.detach()))
        for c, (size, yaw) in zip(centres, forms, strict=True)
    ]
    simulator: Any = task.simulator
    more: dict[str, Any] = {}
    if draws is not None and any(draws):
        more["noise"] = [
            simulator.perturbed_start(scene, draw)
            for scene, draw in zip(scenes, draws, strict=True)
        ]
    more |= {"limit": limit, "smoothing": smoothing}
    if any(size.requires_grad or yaw.requires_grad for size, yaw in forms):
        counts = [len(c) for c in centres]
        more["sizes"] = [s.expand(n, -1) for n, (s, _) in zip(counts, forms, strict=True)]
        more["yaws"] = [y.expand(n) for n, (_, y) in zip(counts, forms, strict=True)]
    rollouts = simulator.rollout_tensor(scenes, centres, **more)
    costs = []
    for positions, scene, c, (size, yaw) in zip(rollouts, scenes, centres, forms, strict=True):
        here, size_here = c.to(positions), size.to(positions)
        turn = yaw if yaw.requires_grad or yaw else 0.0
        measures = smooth_measures(positions, scene, here, size_here, yaws=turn)
        if rules.max_overtopping is not None:
            measures["overtopping"] = smooth_overtopping(positions, scene, here, size_here, turn)
        terms = [objective.smooth(measures, task.reference) for objective in task.objectives]
        terms += [PENALTY * torch.relu(e) for e in rules.excess(measures, size_here[1]).values()]
        cost = torch.stack([term.to(torch.float64).cpu() for term in terms]).sum()
        costs.append(cost + rules.price(len(c), len(c) * size.prod()))
    return rollouts, torch.stack(costs)


def follows_forms(simulator: object) -> bool:
    """Whether rollouts of `simulator` can be differentiated in size and yaw of the baffles.

    Where they cannot, chains of steps keep the form that they start with.
    """
    rollout = getattr(simulator, "rollout_tensor", None)
    return rollout is not None and "sizes" in inspect.signature(rollout).parameters


def differentiate(task: BaffleTask, layouts: Sequence[np.ndarray]) -> list[Outcome]:
    """One rollout and one backward pass of each layout [m], shape (n, D-1), as one batch.

    The gradient is that of the smooth objective; cost and measures are hard, of the same rollout.
    """
    return differentiate_flows([task], layouts, Risk())


def differentiate_flows(
    tasks: Sequence[BaffleTask],
    layouts: Sequence[np.ndarray],
    risk: Risk,
    rules: Rules = FREE,
    space: Space | None = None,
) -> list[Outcome]:
    """One rollout and one backward pass of each layout in each task, one task a scenario.

    Costs and gradients are the risk of those of the tasks: the hard costs say which flows count.
    `space` says what the columns of a layout are; default: places alone.
    """
    started = time.perf_counter()
    space = space or tasks[0].space
    found = [_differentiate(task, layouts, rules, space) for task in tasks]
    seconds = (time.perf_counter() - started) / len(layouts)
    failure = sum(objective.failure_cost for objective in tasks[0].objectives)
    outcomes = []
    for passes in zip(*found, strict=True):
        outcome = weigh([flow for flow, _ in passes], risk, failure)
        gradient = None
        if outcome.status == OK:
            shares = risk.weights([sum(flow.costs) for flow, _ in passes])
            gradient = sum(w * g for w, (_, g) in zip(shares, passes, strict=True))
        outcomes.append(replace(outcome, backwards=len(tasks), seconds=seconds, gradient=gradient))
    return outcomes


def _differentiate(
    task: BaffleTask, layouts: Sequence[np.ndarray], rules: Rules, space: Space
) -> list[tuple[Flow, np.ndarray | None]]:
    follows = follows_forms(task.simulator)
    leaves = [_Leaves(space, layout, follows) for layout in layouts]
    rollouts, costs = smooth_costs(
        task, [leaf.centres for leaf in leaves], forms=[leaf.form for leaf in leaves], rules=rules
    )
    costs.sum().backward()
    return [
        _flow(task, p, built(task.scene, space, layout), leaf.gradient(), rules)
        for p, layout, leaf in zip(rollouts, layouts, leaves, strict=True)
    ]


class _Leaves:
    """A layout as the tensors that its rollout is differentiated in.

    Attributes:
        centres: [m], shape (n, D-1). form: size [m], shape (D,), and yaw [degrees], shape ().
    """

    def __init__(self, space: Space, layout: np.ndarray, follows: bool) -> None:
        import torch

        centres, form = split(space, layout)
        self.centres = torch.tensor(np.array(centres, dtype=np.float64), requires_grad=True)
        size, yaw = torch.tensor(form.size, dtype=torch.float64), torch.tensor(form.yaw)
        self._names = space.names if isinstance(space, DesignSpace) else ()
        self._degree = space.forms.degree if isinstance(space, DesignSpace) else 0.0
        size.requires_grad_(follows and any(name != "yaw" for name in self._names))
        self.form = size, yaw.double().requires_grad_(follows and "yaw" in self._names)

    def gradient(self) -> np.ndarray | None:
        """By every column of the layout [1/m], shape (n, columns), after a backward pass.

        The form is one for all rows: each row holds the whole derivative by it.
        """
        plan = self.centres.grad
        if plan is None:
            return None
        size, yaw = self.form
        columns = []
        for name in self._names:
            if name == "yaw":
                columns.append(0.0 if yaw.grad is None else float(yaw.grad) / self._degree)
            else:
                columns.append(0.0 if size.grad is None else float(size.grad[FORM.index(name)]))
        return np.column_stack([plan.numpy(), np.tile(columns, (len(plan), 1))])


def _flow(
    task: BaffleTask, positions: Tensor, scene: Scene, gradient: np.ndarray | None, rules: Rules
) -> tuple[Flow, np.ndarray | None]:
    """What the rollout (T, N, D) gave by hard measures, and the gradient if there is one."""
    config = task.simulator.config  # type: ignore[attr-defined]
    frames = positions.detach().cpu().numpy()
    if gradient is None or not np.isfinite(gradient).all() or not _plausible(frames, scene):
        return Flow.of(DIVERGED, {}, {}, task.objectives, rules), None
    trajectory = Trajectory(
        positions=frames,
        time=np.arange(len(frames)) * config.dt,
        particle_type=np.full(frames.shape[1], MOVING, np.int8),
        scene=scene,
        point_volume=config.spacing**scene.dim,
        simulator=task.simulator.name,
    )
    measures = hard.summary(trajectory)
    sizes = [baffle.size for baffle in scene.baffles]
    return Flow.of(OK, measures, task.reference, task.objectives, rules, sizes), gradient


def _plausible(frames: np.ndarray, scene: Scene) -> bool:
    """Whether all positions (T, N, D) are finite and within the domain, 1 cm of slack [m]."""
    lower, upper = np.asarray(scene.domain.lower) - 0.01, np.asarray(scene.domain.upper) + 0.01
    return bool(np.isfinite(frames).all() and (frames >= lower).all() and (frames <= upper).all())

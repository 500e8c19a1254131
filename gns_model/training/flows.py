"""Training through whole flows: what a person reads off a rollout, differentiated in the weights.

The error of a step hardly sees what decides where a flow ends: an error of a hundredth of g that
all points share and all steps repeat. Here the model rolls a flow out by itself, for as long as it
lasts, and is asked for the place of the mass in every frame, not of every grain: coordinates are
compared in order of size, axis by axis (the squared Wasserstein distance of two heaps in one
dimension), so that grains which trade places cost nothing; the front and the centroid by
themselves; how crowded the grains are, which coordinates do not tell; and, where there are
baffles, the depth upstream of each. A bias that all flows share lies in few directions of the
weights: 37 steps of two flows took the p99 of `baffle-lite` on held-out layouts from 8.4 to 1.3%
off.

The backward pass limits and shares the adjoints of the grains, as design gradients need it, too
(`learned.adjoint`); every step is computed again in it, so that memory holds one step's inside.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from gns_model.data.windows import Window, WindowIndex
from gns_model.learned.model import LearnedModel
from gns_model.learned.rollout import unrolled
from gns_model.training import batches
from gns_model.training.batches import Draw
from gns_model.training.flow_errors import crowding_error, depth_error, mass_error
from gns_model.training.heap import release_heap
from gns_model.training.recipe import Recipe
from gns_model.training.statistics import Statistics

#: Relative error below which a flow counts as right: there the loss turns from a straight line into
#: a square, or flows that are right already would pull as hard as those that are not.
RIGHT = 0.02
#: Share of the flows that are seen from their beginning; the others begin anywhere.
FROM_START = 0.8


# A step of 0.004 along the mean of the unit gradients of ten flows of `column-2d` changes the mean
# error of six others, 0.393, by (limit, smoothing; steps of a flow):
#
#     6, 0.5; 75   -0.028        2, 0.1; 75   -0.035        6, 0.1; 40 from anywhere   -0.019
#     6, 0.1; 75   -0.033        6, 0.1; 30   -0.005        6, 0.1; 15 from anywhere   -0.003
#
#: Of the adjoints, see `learned.adjoint`: weights see all grains, so less has to be shared than for
#: the move of a baffle, and fewer grains may shout.
LIMIT, SMOOTHING = 2.0, 0.1
#: Of `agreement`. A step of 0.012 along the direction of 16 flows changes the mean error of ten
#: others, 0.400, by -0.050 and -0.018 (two drawings) at 0.1, -0.057 and -0.032 at 0.5, -0.069 and
#: -0.051 at 2; a step of 0.004 along the mean gradient by -0.029 and -0.027. A third drawing, of 40
#: flows, gained nothing by it (+0.009 at 2) and next to nothing along the mean (-0.007). All this
#: with ones in place of the errors; those have been trained with, not compared.
RIDGE = 2.0


@dataclass(frozen=True)
class Flow:
    """One flow to roll out: where it begins, for how many steps, and its edges over all of them."""

    draw: Draw
    steps: int

    @property
    def edges(self) -> float:
        """Over all steps, about."""
        return self.steps * self.draw.edges


def draw_flows(
    index: WindowIndex,
    rng: np.random.Generator,
    recipe: Recipe,
    statistics: Statistics,
    *,
    ranks: int,
) -> list[list[Flow]]:
    """The flows of one step for every rank.

    Each rank gets about `recipe.flow_edges` edges, summed over all steps, and at least one flow;
    one that would have more by itself is not rolled to its end.
    Every rank calls this with the same generator and takes its own part.
    """
    chosen: list[Flow] = []
    total = 0.0
    while True:
        source = int(rng.integers(len(index.sources)))
        entry, stride = index.sources[source], index.stride(source)
        last = (index.starts(source, 1) - 1) // stride  # counted in steps of the model
        begin = 0 if rng.random() < FROM_START else int(rng.integers(last // 2 + 1))
        steps = min(recipe.flow_steps, last + 1 - begin)
        mixture, flip = int(rng.integers(2**31)), bool(rng.integers(2)) and recipe.mirror
        half = recipe.halves and entry.plane is not None and rng.random() < 0.5
        points = len(entry.residue) // index.residues(source)
        edges = statistics.edges(points, (begin + steps / 2) / (last + 1)) / (2 if half else 1)
        steps = max(1, min(steps, int(recipe.flow_edges / edges)))
        flow = Flow(Draw(source, stride * begin, mixture, flip, edges, half), steps)
        if len(chosen) >= ranks and total + flow.edges / 2 > ranks * recipe.flow_edges:
            break
        chosen.append(flow)
        total += flow.edges
    return batches.deal(chosen, ranks)


def flow_gradient(
    model: LearnedModel,
    windows: Sequence[Window],
    parameters: Sequence[nn.Parameter],
    *,
    clip_norm: float,
    context: AbstractContextManager[object],
    device: torch.device,
) -> Tensor:
    """Mean error of flows, a scalar; what they agree on is left in `parameters` as the gradient.

    Its direction is that of `agreement`, its length the mean of those of the flows, of which none
    counts as more than `clip_norm`: a flow that hangs on few grains has a gradient many times the
    usual one.

    Args:
        windows: where each flow begins, with as many frames of the future as it is to be rolled.
        context: autocast, or nothing.
    """
    errors, gradients = [], []
    for window in windows:
        with context:
            error = flow_error(model, window, device)
        parts = torch.autograd.grad(error, parameters, allow_unused=True)
        flat = [
            (torch.zeros_like(p) if part is None else part).flatten()
            for p, part in zip(parameters, parts, strict=True)
        ]
        errors.append(error.detach())
        gradients.append(torch.cat(flat))
        del error, parts, flat
        release_heap()  # a rank grew to 9 GB in a dozen flows of the flume, of which it used 1
    error, gradient = torch.stack(errors), torch.stack(gradients)
    length = gradient.norm(dim=1).clamp(max=clip_norm).mean()
    found = length * agreement(gradient, error)
    sizes = [p.numel() for p in parameters]
    for parameter, part in zip(parameters, found.split(sizes), strict=True):
        parameter.grad = part.view_as(parameter)
    return error.mean()


def agreement(gradients: Tensor, errors: Tensor) -> Tensor:
    """The direction against which flows get better, each by about its own error; length 1.

    The mean of the gradients will not do: of sixteen flows of `column-2d` seven tenths of all unit
    gradients lie in one direction, "farther or less far", about which flows that go too far and
    flows that stop too early disagree; the mean favours most at the cost of the rest. With unit
    gradients u_i and C_ij = u_i · u_j,

        d = sum_i a_i u_i,  (C + RIDGE I) a = errors / (their mean),

    a regularised Gauss-Newton step for the errors as residuals. Without the ridge all get better,
    and flows that are not among them less. With it the one that fares worst of the sixteen loses a
    third of what it loses along the mean.

    Args:
        gradients: shape (n, P); one that is not finite makes the direction so.
        errors: shape (n,).
    """
    norm = gradients.norm(dim=1, keepdim=True)
    if not norm.isfinite().all():
        return gradients.sum(0)
    unit = gradients / norm.clamp_min(1e-12)
    wanted = errors / errors.mean().clamp_min(1e-12)
    ridge = RIDGE * torch.eye(len(unit), dtype=unit.dtype, device=unit.device)
    direction = torch.linalg.solve(unit @ unit.T + ridge, wanted.to(unit.dtype)) @ unit
    return direction / direction.norm().clamp_min(1e-12)


def flow_error(model: LearnedModel, window: Window, device: torch.device) -> Tensor:
    """Relative error of one flow that the model rolls out from the truth, a scalar.

    sqrt(e² + RIGHT²) - RIGHT, where e² is the mean over the frames of `mass_error` and, where there
    are baffles, of `depth_error`, plus `crowding_error`.

    Args:
        window: the truth, with a future (N, K, D) [m] to be rolled out.
    """
    rng = np.random.default_rng(0)  # not used: there is no noise
    batch = batches.collate([window], noise_std=0.0, rng=rng, device=device)
    moving = batch.world.moving
    true = (batch.history[:, -1:] + batch.moves.cumsum(1))[moving]
    found = roll(model, batch, steps=batch.moves.shape[1])[moving]
    spacing = model.config.spacing
    square = mass_error(found, true, batch.history[moving, -1], spacing)
    if window.scene.baffles and model.config.dim == 3:
        square = square + depth_error(found, true, window.scene, spacing)
    square = square.mean() + crowding_error(found, true, model.config.radius)
    return (square + RIGHT**2).sqrt() - RIGHT


def roll(model: LearnedModel, batch: batches.Batch, steps: int) -> Tensor:
    """Positions after each of `steps` steps of the model [m], shape (N, steps, D)."""
    counts = torch.bincount(batch.world.batch).tolist()
    rolled = unrolled(model, batch.history, batch.world, counts, steps, LIMIT, SMOOTHING)
    return rolled.transpose(0, 1)

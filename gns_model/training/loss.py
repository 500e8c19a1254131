"""The training loss: error of the acceleration after contact, over one step or several.

A step of the model includes the projection out of baffles and walls, so the loss looks at where
points end, never at what the network said before: what contact corrects costs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from gns_model.learned.model import LearnedModel
from gns_model.training.batches import Batch
from gns_model.training.recipe import Recipe

#: Share of a scene's moving points that are its front: those farthest along x.
FRONT = 0.05
#: Share of them that is its tip.
TIP = 0.02
#: Side of the cells of the local error [spacings]: a dozen grains in 2D.
CELL = 4.0


@dataclass(frozen=True)
class Emphasis:
    """What the error of a step weighs more, and what less; by default all alike, squared.

    Attributes:
        linear_beyond: where the square turns into a straight line, in standard deviations
            (pseudo-Huber, 2 d² (sqrt(1 + e²/d²) - 1)); None: nowhere. Impacts are rare and
            large: a thousandth of the points holds a quarter of the squares.
        momentum_weight: of the mean over scenes of the square (or pseudo-Huber) of a scene's mean
            error. An error that all points share moves the centroid, or lets a heap sink into
            itself, and hardly shows in the mean of squares.
        local_weight: of the mean square (or pseudo-Huber) of the mean error in cells of `CELL`
            spacings. What single grains do is noise for the most part; a cell's mean is what the
            flow does there, and its error is one that the step repeats.
        front_weight: likewise of the mean error of a scene's front (`FRONT`), a twentieth of the
            points that decides the runout, and a twentieth of the mean of squares.
        tip_weight: likewise of its tip (`TIP`). The mean over a front may be right with its tip
            held back and what follows pushed, each by a third of a m/s²: so a network smooths, and
            the front of a large column ends blunt, a tenth short.
        strain_weight: likewise of what of the error strains: of its linear part over a scene, by
            which a flow spreads or sinks too much, and of its expansion over a cell. Neighbours
            that close in on each other by 0.3 m/s² too much do not show in errors of 1.3 m/s², and
            are twice as dense after a quarter of a second.
        scenes_alike: every scene of the batch counts as much as any other, not as many times as it
            has points: a narrow column is a tenth of a wide one, and its runout as important.
        relative_to: an acceleration q [standard deviations]. Errors are divided by
            sqrt(s² + q²), s the root mean square of the scene's accelerations in the history and
            in the step that the model gives, and of the way back where one is asked for. A scene in
            violent motion has large errors for a few steps, and a slow one small errors for so many
            that they decide where it stops. What is asked must not be a part of s: it varies by
            chance about what a state foretells, and divided by itself, the weak draws would count
            for more than the strong ones, so that every flow would be taught to start too slowly.
    """

    linear_beyond: float | None = None
    momentum_weight: float = 0.0
    local_weight: float = 0.0
    front_weight: float = 0.0
    tip_weight: float = 0.0
    strain_weight: float = 0.0
    scenes_alike: bool = False
    relative_to: float | None = None

    @classmethod
    def of(cls, recipe: Recipe, *, replayed: bool = False) -> Emphasis:
        """What a recipe asks for under the same names; of replayed states, if it says so."""
        values = {f.name: getattr(recipe, f.name) for f in fields(cls)}
        if replayed and recipe.replay_relative_to is not None:
            values["relative_to"] = recipe.replay_relative_to
        return cls(**values)


#: The paper's: the plain mean of squares.
PLAIN = Emphasis()


def step_error(
    model: LearnedModel,
    history: Tensor,
    after: Tensor,
    move: Tensor,
    emphasis: Emphasis = PLAIN,
    *,
    batch: Tensor | None = None,
    moving: Tensor | None = None,
    back: Tensor | None = None,
    shared: Tensor | None = None,
) -> Tensor:
    """Mean square of the normalised acceleration error, a scalar.

    ((p' - p) - move)² / dt⁴ / acc_std², averaged over points and axes. With p the noisy position
    and `move` the true displacement, this is the squared error of normalised acceleration against
    the target corrected for noise (Sanchez-Gonzalez et al. 2020; Choi & Kumar).

    Args:
        history: shape (N, H+1, D); p is its last frame.
        after: p', predicted [m], shape (N, D).
        move: true displacement [m], shape (N, D).
        emphasis: what weighs more.
        batch: scene of every point, shape (N,); default: all in one.
        moving: mask of the points that count, shape (N,); default: all.
        back: the part of `move` that leads back to the truth [m], shape (N, D); default: none.
        shared: noise in `history` that is no part of s, shape (N, H+1, D); default: none. It would
            weigh most where it cancels what moves the scene, and teach the model to overdo that.
    """
    place, error = history[:, -1], (after - history[:, -1]) - move
    clean = history if shared is None else history - shared
    velocities = torch.cat([clean, after[:, None]], dim=1).detach().diff(dim=1)
    strength = velocities.diff(dim=1).square().mean(dim=1)
    if back is not None:
        strength = strength + back.square()
    if moving is not None:
        place, error, strength = place[moving], error[moving], strength[moving]
        batch = None if batch is None else batch[moving]
    if batch is None:
        batch = torch.zeros(len(error), dtype=torch.long, device=error.device)
    unit = model.config.dt**2 * model.acceleration_std
    error, linear_beyond = error / unit, emphasis.linear_beyond
    if emphasis.relative_to is not None:
        strong = _scene_mean(strength / unit.square(), batch).mean(1, keepdim=True)
        error = error / (strong + emphasis.relative_to**2).sqrt()[batch]

    def over_points(squares: Tensor) -> Tensor:
        return _scene_mean(squares, batch).mean() if emphasis.scenes_alike else squares.mean()

    loss = over_points(_penalty(error, linear_beyond))
    if emphasis.local_weight or emphasis.strain_weight:
        cell = _cells(place.detach(), batch, CELL * model.config.spacing)
    if emphasis.local_weight:
        mean = _scene_mean(error, cell)[cell]
        loss = loss + emphasis.local_weight * over_points(_penalty(mean, linear_beyond))
    if emphasis.strain_weight:
        spacing = model.config.spacing
        linear = _linear_part(error, place.detach(), batch, spacing)
        loss = loss + emphasis.strain_weight * _penalty(linear, linear_beyond).sum(2).mean()
        expansion = _expansion(error, place.detach(), cell, spacing)[cell, None]
        loss = loss + emphasis.strain_weight * over_points(_penalty(expansion, linear_beyond))
    if emphasis.momentum_weight:
        mean = _scene_mean(error, batch)
        loss = loss + emphasis.momentum_weight * _penalty(mean, linear_beyond).mean()
    for weight, share in ((emphasis.front_weight, FRONT), (emphasis.tip_weight, TIP)):
        if weight:
            ahead = _front(place[:, 0].detach(), batch, share)
            mean = _scene_mean(error[ahead], batch[ahead])
            loss = loss + weight * _penalty(mean, linear_beyond).mean()
    return loss


def _penalty(error: Tensor, linear_beyond: float | None) -> Tensor:
    """The square of `error`, or its pseudo-Huber."""
    square = error.square()
    if linear_beyond is None:
        return square
    d = linear_beyond**2
    return 2 * d * ((1 + square / d).sqrt() - 1)


def _scene_mean(values: Tensor, batch: Tensor) -> Tensor:
    """Mean of `values` (N, D) over the points of every scene (or cell), shape (S, D)."""
    counts = torch.bincount(batch).to(values.dtype)[:, None]
    return values.new_zeros((len(counts), values.shape[1])).index_add(0, batch, values) / counts


def _cells(place: Tensor, batch: Tensor, size: float) -> Tensor:
    """The cell of `size` [m] and scene that every point lies in, numbered from 0, shape (N,)."""
    corner = torch.cat([batch[:, None], (place / size).floor().long()], dim=1)
    cells: Tensor = corner.unique(dim=0, return_inverse=True)[1]
    return cells


def _linear_part(error: Tensor, place: Tensor, batch: Tensor, spacing: float) -> Tensor:
    """Of every scene (or cell), how much of each component of `error` grows with each coordinate:
    covariance over the standard deviation of the coordinate, shape (S, D, D).

    For coordinates without correlation the sum of squares over the last axis is the mean square of
    the linear part of that component.
    """
    off = place - _scene_mean(place, batch)[batch]
    moment = (error[:, :, None] * off[:, None, :]).flatten(1)
    covariance = _scene_mean(moment, batch).unflatten(1, (error.shape[1], off.shape[1]))
    # A point by itself has no extent; a tenth of a spacing keeps it from dividing by zero.
    extent = (_scene_mean(off.square(), batch) + (0.1 * spacing) ** 2).sqrt()
    return covariance / extent[:, None, :]


def _expansion(error: Tensor, place: Tensor, cell: Tensor, spacing: float) -> Tensor:
    """Of every cell, how much `error` makes it expand: its part along the way from the middle,
    root mean square over points and axes, shape (C,)."""
    off = place - _scene_mean(place, cell)[cell]
    outward = _scene_mean((error * off).sum(1, keepdim=True), cell)
    extent = _scene_mean(off.square().sum(1, keepdim=True), cell) + (0.1 * spacing) ** 2
    expansion: Tensor = (outward / (error.shape[1] * extent).sqrt()).squeeze(1)
    return expansion


def _front(place: Tensor, batch: Tensor, share: float) -> Tensor:
    """Indices of the foremost `share` of every scene by `place` along x [m], shape (N,); at least a
    point of each."""
    counts = torch.bincount(batch).tolist()
    order = batch.argsort(stable=True)
    parts = zip(order.split(counts), place[order].split(counts), strict=True)
    return torch.cat(
        [own[x.topk(min(len(x), 1 + int(share * len(x)))).indices] for own, x in parts]
    )


def unrolled_loss(
    model: LearnedModel,
    batch: Batch,
    emphasis: Emphasis = PLAIN,
    *,
    steps: int = 1,
    backprop: bool = False,
    return_steps: float | None = None,
) -> Tensor:
    """Loss after the model has taken `steps` steps on its own, a scalar.

    Args:
        emphasis: what weighs more in the error of a step.
        steps: 1 is plain one-step training; at most the K of the batch.
        backprop: mean of all steps' errors with gradients through all of them. Otherwise
            push-forward (Brandstetter et al. 2022): the first steps only prepare an input with
            the model's own error, and the last one is the loss.
        return_steps: with push-forward, also ask for 1/return_steps of the way back: the true
            displacement less that part of how far a point has drifted from the truth. A heap that
            sinks into itself by a hair each step is one-step perfect and a puddle after fifty; so
            the model learns to push back.
    """

    shared = batch.shared

    def error(after: Tensor, move: Tensor, back: Tensor | None = None) -> Tensor:
        return step_error(
            model,
            history,
            after,
            move,
            emphasis,
            batch=batch.world.batch,
            moving=batch.moving,
            back=back,
            shared=shared,
        )

    history = batch.history
    if not backprop:
        with torch.no_grad():
            for _ in range(steps - 1):
                after = model.step(history, batch.world)
                history, shared = _onwards(history, after), _aged(shared)
        move, back = batch.moves[:, steps - 1], batch.back
        if return_steps is not None and steps > 1:
            truth = batch.history[:, -1] + batch.moves[:, : steps - 1].sum(1)
            back = (truth - history[:, -1]) / return_steps
            move = move + back
        return error(model.step(history, batch.world), move, back)
    total = batch.moves.new_zeros(())
    for k in range(steps):
        after = model.step(history, batch.world)
        total = total + error(after, batch.moves[:, k])
        history, shared = _onwards(history, after), _aged(shared)
    return total / steps


def _onwards(history: Tensor, after: Tensor) -> Tensor:
    """`history` (N, H+1, D) a step later, with `after` (N, D) as its last frame."""
    return torch.cat([history[:, 1:], after[:, None]], dim=1)


def _aged(shared: Tensor | None) -> Tensor | None:
    """The noise of `history` a step later: the frame that the model made has none."""
    return None if shared is None else _onwards(shared, torch.zeros_like(shared[:, 0]))

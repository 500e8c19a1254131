"""The training loss: error of the acceleration after contact, over one step or several.

A step of the model includes the projection out of baffles and walls, so the loss looks at where
points end, never at what the network said before: what contact corrects costs nothing.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gns_model.learned.model import LearnedModel
from gns_model.training.batches import Batch


def step_error(
    model: LearnedModel,
    history: Tensor,
    after: Tensor,
    move: Tensor,
    *,
    batch: Tensor | None = None,
    moving: Tensor | None = None,
    linear_beyond: float | None = None,
    momentum_weight: float = 0.0,
) -> Tensor:
    """Mean square of the normalised acceleration error, a scalar.

    ((p' - p) - move)² / dt⁴ / acc_std², averaged over points and axes. With p the noisy position
    and `move` the true displacement, this is the squared error of normalised acceleration against
    the target corrected for noise (Sanchez-Gonzalez et al. 2020; Choi & Kumar).

    Args:
        history: shape (N, H+1, D); p is its last frame.
        after: p', predicted [m], shape (N, D).
        move: true displacement [m], shape (N, D).
        linear_beyond: where the square turns into a straight line, in standard deviations
            (pseudo-Huber, 2 d² (sqrt(1 + e²/d²) - 1)); default: nowhere. Impacts are rare and
            large: a thousandth of the points holds a quarter of the squares.
        batch: scene of every point, shape (N,); default: all in one.
        moving: mask of the points that count, shape (N,); default: all.
        momentum_weight: of the mean over scenes of the square of a scene's mean error. An error
            that all points share moves the centroid and hardly shows in the mean of squares.
    """
    error = (after - history[:, -1]) - move
    if moving is not None:
        error = error[moving]
        batch = None if batch is None else batch[moving]
    error = error / (model.config.dt**2 * model.acceleration_std)
    square = error.square()
    if linear_beyond is not None:
        d = linear_beyond**2
        square = 2 * d * ((1 + square / d).sqrt() - 1)
    if momentum_weight == 0:
        return square.mean()
    if batch is None:
        batch = torch.zeros(len(error), dtype=torch.long, device=error.device)
    counts = torch.bincount(batch).to(error.dtype)[:, None]
    mean = error.new_zeros((len(counts), error.shape[1])).index_add(0, batch, error) / counts
    return square.mean() + momentum_weight * mean.square().mean()


def unrolled_loss(
    model: LearnedModel,
    batch: Batch,
    *,
    steps: int = 1,
    backprop: bool = False,
    linear_beyond: float | None = None,
    momentum_weight: float = 0.0,
) -> Tensor:
    """Loss after the model has taken `steps` steps on its own, a scalar.

    Args:
        steps: 1 is plain one-step training; at most the K of the batch.
        backprop: mean of all steps' errors with gradients through all of them. Otherwise
            push-forward (Brandstetter et al. 2022): the first steps only prepare an input with
            the model's own error, and the last one is the loss.
        linear_beyond, momentum_weight: see `step_error`.
    """

    def error(after: Tensor, k: int) -> Tensor:
        return step_error(
            model,
            history,
            after,
            batch.moves[:, k],
            batch=batch.world.batch,
            moving=batch.moving,
            linear_beyond=linear_beyond,
            momentum_weight=momentum_weight,
        )

    history = batch.history
    if not backprop:
        with torch.no_grad():
            for _ in range(steps - 1):
                after = model.step(history, batch.world)
                history = torch.cat([history[:, 1:], after[:, None]], dim=1)
        after = model.step(history, batch.world)
        return error(after, steps - 1)
    total = batch.moves.new_zeros(())
    for k in range(steps):
        after = model.step(history, batch.world)
        total = total + error(after, k)
        history = torch.cat([history[:, 1:], after[:, None]], dim=1)
    return total / steps

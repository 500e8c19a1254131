"""Chains of gradient steps: projected Adam, and projected L-BFGS.

A chain holds the layout to differentiate next; told its outcome, it moves on. A gradient is dear,
so there is no line search: a step is as long as the chain trusts it to be, and a chain that stops
improving goes back to its best layout with half of that.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from design.outcome import Outcome
from design.space import Space
from gns_model.trajectory import OK

#: First step of a chain [m], a third of the paper's baffle: the most that a coordinate moves.
#: A fifth of it leaves a search of twenty passes on its way.
STEP = 0.05
#: Steps shorter than this end a chain [m]: less than anybody builds to.
LEAST_STEP = 0.003
#: A chain ends where the next move, within the constraints, is below this share of its step.
HELD = 0.02


class Chain(ABC):
    """One start of a descent. `centres` [m], shape (n, D-1), is the layout to differentiate next.

    Where the form varies, its columns follow (see `space`), and a step changes it too: `project`
    takes the mean of what the rows ask for.
    A kind of chain says which way to go, by `_direction`, and what it makes of a gradient, by
    `_observe`. `patience` is how many layouts in a row may fail to improve before it goes back.
    """

    patience = 2

    def __init__(self, space: Space, centres: np.ndarray, step: float = STEP) -> None:
        self._space = space
        self.centres = np.array(centres, dtype=float)
        self.step = step
        self.best_cost = np.inf
        self._best = self.centres
        self._best_gradient: np.ndarray | None = None
        self._misses = 0
        self._forget()

    def learn(self, outcome: Outcome) -> None:
        """Take in the outcome at `centres` and move on."""
        gradient = outcome.gradient
        usable = outcome.status == OK and gradient is not None and np.isfinite(gradient).all()
        if usable:
            assert gradient is not None
            self._observe(gradient)
        if usable and outcome.merit < self.best_cost:
            self.best_cost, self._best, self._best_gradient = outcome.merit, self.centres, gradient
            self._misses = 0
        else:
            self._misses += 1
            if not usable or self._misses >= self.patience:
                # Back to the best layout with a shorter step and no memory of the way.
                self.step /= 2
                self._misses = 0
                if self._best_gradient is None:  # the start itself failed
                    self.step = 0.0
                    return
                self.centres, gradient = self._best, self._best_gradient
                self._go_back()
        assert gradient is not None
        self._move(self._direction(gradient))

    def _move(self, step: np.ndarray) -> None:
        """Go against `step` [m], shape (n, D-1), as far as the constraints allow."""
        moved = self._space.project(self.centres - step) - self.centres
        most, asked = np.abs(moved).max(), np.abs(step).max()
        if most < HELD * self.step:
            self.step = 0.0  # a local optimum
            return
        if most < asked / 2:
            # What is held had set the scale: go on along what the constraints leave free.
            moved = self._space.project(self.centres + moved * (asked / most)) - self.centres
        self.centres = self.centres + moved

    def _observe(self, gradient: np.ndarray) -> None:  # noqa: B027  (not every kind remembers it)
        """Take note of the gradient [1/m], shape (n, D-1), at `centres`."""

    @abstractmethod
    def _direction(self, gradient: np.ndarray) -> np.ndarray:
        """What to subtract from `centres` [m], shape (n, D-1), at most `step` in a coordinate."""

    def _go_back(self) -> None:
        """Take note that the chain is back at its best layout."""
        self._forget()

    @abstractmethod
    def _forget(self) -> None:
        """Forget the way so far."""


class Adam(Chain):
    """Projected Adam, its direction scaled to `step`, with one scale for all coordinates."""

    #: Decay of the running means; short memories, since a chain has few steps.
    beta_mean, beta_square = 0.7, 0.9
    _mean: np.ndarray
    _square: float
    _count: int

    def _direction(self, gradient: np.ndarray) -> np.ndarray:
        self._count += 1
        self._mean = self.beta_mean * self._mean + (1 - self.beta_mean) * gradient
        # One scale for all coordinates: a baffle that does not matter should not move.
        square = float(np.square(gradient).max())
        self._square = self.beta_square * self._square + (1 - self.beta_square) * square
        mean = self._mean / (1 - self.beta_mean**self._count)
        scale = np.sqrt(self._square / (1 - self.beta_square**self._count))
        return np.clip(self.step * mean / max(scale, 1e-12), -self.step, self.step)

    def _forget(self) -> None:
        self._mean = np.zeros_like(self.centres)
        self._square, self._count = 0.0, 0


class Lbfgs(Chain):
    """Projected L-BFGS (Nocedal 1980; two-loop recursion: Nocedal & Wright 2006, algorithm 7.4).

    Pairs of step s and change of gradient y are kept where s.y > 0, also those of steps that did
    not improve. A quasi-Newton step longer than `step` in a coordinate is shortened to it.
    """

    patience = 1
    #: Pairs that are remembered.
    memory = 5
    #: Least cosine of s and y: below, their curvature is roughness and not shape.
    least_cosine = 0.05
    _pairs: list[tuple[np.ndarray, np.ndarray]]
    _last: tuple[np.ndarray, np.ndarray] | None

    def _observe(self, gradient: np.ndarray) -> None:
        if self._last is not None:
            s = (self.centres - self._last[0]).ravel()
            y = (gradient - self._last[1]).ravel()
            if s @ y > self.least_cosine * np.linalg.norm(s) * np.linalg.norm(y):
                self._pairs = [*self._pairs, (s, y)][-self.memory :]
        self._last = self.centres, gradient

    def _direction(self, gradient: np.ndarray) -> np.ndarray:
        q = gradient.ravel().astype(float)
        shares = []
        for s, y in reversed(self._pairs):
            share = (s @ q) / (s @ y)
            q = q - share * y
            shares.append(share)
        if self._pairs:
            s, y = self._pairs[-1]
            q = q * (s @ y) / (y @ y)
        else:
            q = q * (self.step / max(np.abs(q).max(), 1e-12))
        for (s, y), share in zip(self._pairs, reversed(shares), strict=True):
            q = q + s * (share - (y @ q) / (s @ y))
        longest = np.abs(q).max()
        return (q * min(1.0, self.step / max(longest, 1e-12))).reshape(gradient.shape)

    def _go_back(self) -> None:
        # The curvature that was met holds for the best layout too.
        assert self._best_gradient is not None
        self._last = self._best, self._best_gradient

    def _forget(self) -> None:
        self._pairs, self._last = [], None

"""The nearest layout of a given arrangement: a convex quadratic programme, solved by cvxpy.

Keeping baffles apart is not convex: of two baffles either one may be upstream, or to the left. An
*arrangement* settles it: for each baffle a free rectangle, for each pair one axis and an order
along it. Within one arrangement the nearest layout is a QP. `Projector` tries arrangements that
suggest themselves, and then improves by exchanging the sides that cost most.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gns_env.room import ROUNDING

Array = NDArray[np.float64]

#: Rounds of pushing overlapping baffles apart when the request itself suggests no arrangement.
PUSHES = 200
#: Most pairs whose side is tried the other way in one improvement sweep.
EXCHANGES = 6


@dataclass
class Arrangement:
    """One convex piece of the buildable layouts: centres c (n, d) with lower <= c <= upper, and
    order[p] * (c[first[p]] - c[second[p]])[axis[p]] >= separation[axis[p]] for every pair p."""

    lower: Array
    upper: Array
    axis: NDArray[np.intp]
    order: Array


class Projector:
    """Nearest centres to a request among arrangements of `n` baffles in `free` rectangles.

    Args:
        free: maximal free rectangles for a centre [m], shape (M, 2, d).
        separation: least difference of two centres, along one axis at least [m], shape (d,).
        slots: a packing of at least n centres [m], shape (m, d): the arrangement of last resort.
        n: number of baffles.
    """

    def __init__(self, free: Array, separation: Array, slots: Array, n: int) -> None:
        self.free, self.separation, self.slots, self.n = free, separation, slots, n
        self.first, self.second = np.triu_indices(n, 1)
        self._programme: _Programme | None = None

    def nearest(self, request: Array) -> Array:
        """Buildable centres near `request` [m], shape (n, d): a local minimum of the summed squared
        distance. It is the same, permuted, for a permuted request."""
        sorting = np.lexsort(request.T[::-1])  # stable: equal requests stay in their order
        target = request[sorting]
        best: tuple[float, Array, Arrangement] | None = None
        for start in (self._untied, self._pushed_apart, self._into_slots):
            best = self._solve(target, self._arrangement(start(target), target))
            if best is not None:
                break
        if best is None:  # the slots always have an arrangement: their own
            raise AssertionError("a packing that is not one")  # pragma: no cover
        best = self._improve(target, best)
        result = np.empty_like(best[1])
        result[sorting] = best[1]
        return result

    # Starting points: what an arrangement is read from.

    def _untied(self, target: Array) -> Array:
        # Coincident requests have no direction between them; a tiny spiral gives them one.
        k = np.arange(self.n)
        angle = k * np.pi * (3 - np.sqrt(5))
        spiral = np.stack([np.cos(angle), np.sin(angle)], 1)[:, : target.shape[1]]
        if target.shape[1] == 1:
            spiral = np.ones((self.n, 1)) * k[:, None] / self.n
        return target + 1e-6 * self.separation * np.sqrt(k + 1)[:, None] * spiral

    def _pushed_apart(self, target: Array) -> Array:
        p = self._into_free(self._untied(target))
        i, j = self.first, self.second
        rows = np.arange(len(i))
        for _ in range(PUSHES):
            difference = p[i] - p[j]
            overlap = self.separation - np.abs(difference)
            axis = overlap.argmin(1)
            push = np.maximum(overlap[rows, axis], 0)
            if not (push > 0).any():
                break
            sign = np.where(difference[rows, axis] >= 0, 1.0, -1.0)
            np.add.at(p, (i, axis), 0.3 * sign * push)
            np.add.at(p, (j, axis), -0.3 * sign * push)
            p = self._into_free(p)
        return p

    def _into_slots(self, target: Array) -> Array:
        from scipy.optimize import linear_sum_assignment

        cost = ((target[:, None] - self.slots[None]) ** 2).sum(-1)
        return self.slots[linear_sum_assignment(cost)[1]]

    def _into_free(self, p: Array) -> Array:
        candidates = np.clip(p[:, None], self.free[None, :, 0], self.free[None, :, 1])
        cell = ((candidates - p[:, None]) ** 2).sum(-1).argmin(1)
        return candidates[np.arange(len(p)), cell]

    def _arrangement(self, p: Array, target: Array) -> Arrangement:
        """The arrangement that `p` lies in, or violates least; among several, the target's."""
        candidates = np.clip(p[:, None], self.free[None, :, 0], self.free[None, :, 1])
        away = ((candidates - p[:, None]) ** 2).sum(-1)
        wanted = np.clip(target[:, None], self.free[None, :, 0], self.free[None, :, 1])
        wish = ((wanted - target[:, None]) ** 2).sum(-1)
        away = np.where(away <= away.min(1, keepdims=True) + ROUNDING**2, wish, np.inf)
        lower, upper = self.free[away.argmin(1)].swapaxes(0, 1)
        difference = p[self.first] - p[self.second]
        slack = np.abs(difference) - self.separation
        sign = np.where(difference >= 0, 1.0, -1.0)
        wish = sign * (target[self.first] - target[self.second]) - self.separation
        clear = slack >= -ROUNDING
        axis = np.where(clear.any(1), np.where(clear, wish, -np.inf).argmax(1), slack.argmax(1))
        return Arrangement(lower, upper, axis, sign[np.arange(len(axis)), axis])

    # Within an arrangement.

    def _solve(
        self, target: Array, arrangement: Arrangement
    ) -> tuple[float, Array, Arrangement] | None:
        """Distance², centres and arrangement; None if the arrangement holds no layout."""
        if self._settle(arrangement.lower, arrangement) is None:
            return None
        if self._programme is None:
            self._programme = _Programme(self.n, target.shape[1])
        centres = self._programme.solve(target, arrangement, self.separation)
        if centres is None:  # a sliver too thin for the solver: stay with what is known to fit
            centres = arrangement.lower
        settled = self._settle(centres, arrangement)
        assert settled is not None
        return float(((settled - target) ** 2).sum()), settled, arrangement

    def _settle(self, centres: Array, a: Arrangement) -> Array | None:
        """Move centres by rounding errors until every constraint holds exactly; None if none can.

        Along one axis the constraints are bounds and differences: going up, each centre is pushed
        by those below it; coming down, by those above. From the lower bounds the way up is the
        least layout of all, so it tells whether there is one.
        """
        settled = np.clip(centres, a.lower, a.upper)
        for axis in range(settled.shape[1]):
            pairs = np.flatnonzero(a.axis == axis)
            up = a.order[pairs] > 0
            high = np.where(up, self.first[pairs], self.second[pairs])
            low = np.where(up, self.second[pairs], self.first[pairs])
            order = _topological(self.n, low, high)
            if order is None:
                return None
            below = [low[high == k] for k in range(self.n)]
            above = [high[low == k] for k in range(self.n)]
            least, c = a.lower[:, axis].copy(), settled[:, axis]
            gap, highest = self.separation[axis], a.upper[:, axis]
            for k in order:
                if below[k].size:
                    least[k] = max(least[k], least[below[k]].max() + gap)
                    c[k] = max(c[k], c[below[k]].max() + gap)
            if (least > highest + 5 * ROUNDING).any():
                return None
            np.minimum(c, highest, out=c)
            for k in reversed(order):
                if above[k].size:
                    c[k] = min(c[k], c[above[k]].min() - gap)
        return settled

    def _improve(
        self, target: Array, best: tuple[float, Array, Arrangement]
    ) -> tuple[float, Array, Arrangement]:
        """Read the arrangement again at the solution, and try the costly sides the other way."""
        for _ in range(4 * self.n):
            cost = best[0]
            again = self._solve(target, self._arrangement(best[1], target))
            if again is not None and again[0] < best[0] - 1e-12:
                best = again
                continue
            for changed in self._exchanges(target, best):
                trial = self._solve(target, changed)
                if trial is not None and trial[0] < best[0] - 1e-12:
                    best = trial
                    break
            if best[0] >= cost - 1e-12:
                break
        return best

    def _exchanges(
        self, target: Array, best: tuple[float, Array, Arrangement]
    ) -> list[Arrangement]:
        _, centres, a = best
        rows = np.arange(len(a.axis))
        difference = (centres[self.first] - centres[self.second])[rows, a.axis]
        binding = np.abs(difference * a.order - self.separation[a.axis]) < 1e-6
        moved = ((centres - target) ** 2).sum(1)
        costly = np.where(binding, moved[self.first] + moved[self.second], 0)
        trials = []
        for p in np.argsort(-costly, kind="stable")[:EXCHANGES]:
            if costly[p] <= 1e-12:
                break
            wish = target[self.first[p]] - target[self.second[p]]
            for axis in range(len(self.separation)):
                for order in (1.0, -1.0):
                    # The opposite order along a far axis is never near; skip the hopeless ones.
                    hopeless = order * wish[axis] < -1.5 * self.separation[axis]
                    if (axis, order) != (a.axis[p], a.order[p]) and not hopeless:
                        axes, orders = a.axis.copy(), a.order.copy()
                        axes[p], orders[p] = axis, order
                        trials.append(Arrangement(a.lower, a.upper, axes, orders))
        if len(self.free) > 1:
            for k in np.argsort(-moved, kind="stable")[:EXCHANGES]:
                for lower, upper in self.free:
                    if (lower != a.lower[k]).any() or (upper != a.upper[k]).any():
                        lowers, uppers = a.lower.copy(), a.upper.copy()
                        lowers[k], uppers[k] = lower, upper
                        trials.append(Arrangement(lowers, uppers, a.axis, a.order))
        return trials


def _topological(n: int, low: NDArray[np.intp], high: NDArray[np.intp]) -> list[int] | None:
    """Order of 0..n-1 with every low before its high; None if they go round in a circle."""
    waiting = np.bincount(high, minlength=n)
    ready = [int(k) for k in np.flatnonzero(waiting == 0)]
    order: list[int] = []
    while ready:
        k = ready.pop()
        order.append(k)
        for above in high[low == k]:
            waiting[above] -= 1
            if waiting[above] == 0:
                ready.append(int(above))
    return order if len(order) == n else None


class _Programme:
    """The QP of one arrangement, compiled once: the arrangement and the target are parameters
    (disciplined parametrised programming), so later solves skip the compilation."""

    def __init__(self, n: int, d: int) -> None:
        import cvxpy as cp

        first, second = np.triu_indices(n, 1)
        self.rows = np.arange(len(first))
        self.centres = cp.Variable((n, d))
        self.target = cp.Parameter((n, d))
        self.lower, self.upper = cp.Parameter((n, d)), cp.Parameter((n, d))
        constraints = [self.centres >= self.lower, self.centres <= self.upper]
        if n > 1:
            difference = np.zeros((len(first), n))
            difference[self.rows, first], difference[self.rows, second] = 1.0, -1.0
            self.side = cp.Parameter((len(first), d))
            self.gap = cp.Parameter(len(first))
            along = cp.sum(cp.multiply(self.side, difference @ self.centres), axis=1)
            constraints.append(along >= self.gap)
        objective = cp.sum_squares(self.centres) - 2 * cp.sum(
            cp.multiply(self.target, self.centres)
        )
        self.problem = cp.Problem(cp.Minimize(objective), constraints)
        assert self.problem.is_dpp()

    def solve(self, target: Array, a: Arrangement, separation: Array) -> Array | None:
        import cvxpy as cp

        # Coordinates about the middle keep the numbers near one for the solver.
        origin = (a.lower.min(0) + a.upper.max(0)) / 2
        self.target.value = target - origin
        # A hair of room, so that a layout that just fits has an interior; `_settle` removes it.
        self.lower.value, self.upper.value = a.lower - origin - 1e-8, a.upper - origin + 1e-8
        if len(self.rows):
            side = np.zeros((len(self.rows), target.shape[1]))
            side[self.rows, a.axis] = a.order
            self.side.value, self.gap.value = side, separation[a.axis]
        try:
            # No warm start: the answer must not depend on what was asked before.
            self.problem.solve(solver=cp.CLARABEL, warm_start=False)
        except cp.error.SolverError:
            return None
        if self.centres.value is None or not np.isfinite(self.centres.value).all():
            return None
        return self.centres.value + origin

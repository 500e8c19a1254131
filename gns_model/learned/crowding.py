"""Known incompressibility: grains that a step left too close to each other move apart again.

Dense granular material hardly gives way to pressure, and a network knows that only from states in
which it does not: a heap whose grains close in by 0.3 m/s² too much is twice as dense after a
quarter of a second, which no training state ever was. `baffle-3d` of old ended three times as
dense. Here a share of what exceeds a limit is undone after every step, with the centroid of the
mass left where it is: the density constraint of position-based fluids (Macklin & Müller 2013), for
densities above the limit only, so that material may part freely. Learned simulators of fluids are
held together likewise by Toshev et al. 2024 (Neural SPH).
"""

from __future__ import annotations

import functools
import itertools
import math

import torch
from torch import Tensor

from gns_model.learned.graph import radius_graph
from gns_model.learned.world import World

#: Points farther away than this do not count as crowding [spacings].
REACH = 2.25
#: Share of its own excess that each point undoes in a step, and all its neighbours theirs beside. A
#: cube of 9³ points, squeezed to density 1.9, has 1.29 after five steps with a limit of 1.1, and
#: never less than 1.03 anywhere; with 0.3 the middle ends at 0.84 and with 0.6 at 0.39.
SHARE = 0.1
#: Keeps the step finite where neighbours balance or coincide [1/spacing²].
SOFT = 0.05


def density(positions: Tensor, world: World, spacing: float) -> Tensor:
    """How dense points lie around each, relative to a lattice of `spacing`, shape (N,).

        n_i = sum_j W(|x_i - x_j| / h) / (the same of a lattice),  W(q) = (1 - q²)³,

    with h = REACH spacings, over all j, i itself included, and over their images behind the walls
    near i, or a grain on the base would count as lonely. Images are those of one wall each, which
    leaves out corners.

    Args:
        positions: [m], shape (N, D).
        world: its walls and its scenes; all its points count, moving or not.
        spacing: [m].
    """
    return _Pairs(positions, world, spacing).density(positions)


def spread(positions: Tensor, world: World, spacing: float, limit: float) -> Tensor:
    """Move points apart where they are denser than `limit`, shape (N, D) [m].

    With C_i = max(0, n_i - limit) and g_ij = ∂n_i/∂x_i of the pair,

        λ_i = C_i / (|Σ_j g_ij|² + Σ_j |g_ij|² + SOFT / spacing²),
        Δx_i = -SHARE Σ_j (λ_i + λ_j) g_ij,

    which is a Newton step for n = limit and moves the centroid of no scene whose points all move.
    Positions that are crowded nowhere come back as they are. Differentiable in the positions.

    Args:
        positions: [m], shape (N, D).
        world: its walls and its scenes; points that do not move stay.
        spacing: [m].
        limit: densest that is left alone, relative to a lattice of `spacing`.
    """
    pairs = _Pairs(positions, world, spacing)
    excess = (pairs.density(positions) - limit).clamp_min(0)
    slopes = pairs.slopes()
    stiff = pairs.summed(slopes).square().sum(1) + pairs.summed(slopes.square().sum(1))
    share = SHARE * excess / (stiff + SOFT / spacing**2)
    both = share[pairs.receivers] + share[pairs.senders]
    moved = positions - pairs.summed(both[:, None] * slopes)
    return torch.where(world.moving[:, None], moved, positions)


class _Pairs:
    """All pairs of points within reach of each other."""

    def __init__(self, positions: Tensor, world: World, spacing: float) -> None:
        self.world, self.reach = world, REACH * spacing
        self.rest = _lattice_density(positions.shape[1])
        self.senders, self.receivers = radius_graph(positions.detach(), self.reach, world.batch)
        self.apart = (positions[self.receivers] - positions[self.senders]) / self.reach
        self.square = self.apart.square().sum(1)
        self._zeros = positions.new_zeros

    def density(self, positions: Tensor) -> Tensor:
        """See the function of the same name."""
        total = 1 + self.summed((1 - self.square).clamp_min(0) ** 3)
        for walls, sign in ((self.world.point_lower, 1), (self.world.point_upper, -1)):
            for off in ((positions - walls) * (sign / self.reach)).unbind(1):
                # The image of j is r² + 4 d_i d_j away, squared, where d is how far off the wall.
                near = off.detach() < 1
                chosen = (near[self.receivers] & near[self.senders]).nonzero().squeeze(1)
                to, origin = self.receivers[chosen], self.senders[chosen]
                image = (1 - self.square[chosen] - 4 * off[to] * off[origin]).clamp_min(0) ** 3
                total = total.index_add(0, to, image)
                total = total + (1 - 4 * off.square()).clamp_min(0) ** 3  # its own
        return total / self.rest

    def slopes(self) -> Tensor:
        """g_ij [1/m], shape (E, D)."""
        steep = -6 / (self.reach * self.rest) * (1 - self.square).clamp_min(0).square()
        return steep[:, None] * self.apart

    def summed(self, values: Tensor) -> Tensor:
        """The sum of values of pairs, shape (E, ...), over the senders of each point, (N, ...)."""
        total = self._zeros((len(self.world.batch), *values.shape[1:]))
        return total.index_add(0, self.receivers, values)


@functools.cache
def _lattice_density(dim: int) -> float:
    """sum_j W of a point within a lattice."""
    along = range(-math.floor(REACH), math.floor(REACH) + 1)
    squares = (sum(k * k for k in cell) / REACH**2 for cell in itertools.product(along, repeat=dim))
    return sum(max(0.0, 1 - q) ** 3 for q in squares)

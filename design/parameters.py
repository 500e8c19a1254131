"""Layout <-> search parameters, one to one although baffles are interchangeable.

n equal baffles can be numbered in n! ways, so a search over plain coordinates would see every
layout n! times. Here they are numbered by their place across the flow (rows are common, so z tells
baffles apart better than x), and the ordered places 0 <= w_1 <= ... <= w_n <= 1 become

    r_k = (w_k / w_(k+1))^k,  w_(n+1) = 1,

which maps the ordered simplex onto the unit cube and uniform places onto uniform r (the classical
construction of uniform order statistics; Devroye 1986, Non-Uniform Random Variate Generation,
ch. V.3). Every point of the cube is one layout, and every layout is one point.

Where the number of baffles varies there are as many places as the most baffles need, and those that
a layout has no baffle for are idle: nothing depends on them. `number` is a whole number, and every
variable of the form goes from 0 to 1 over its range.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from optuna.distributions import BaseDistribution, FloatDistribution

from design.rows import NUMBER, RowSpace, number_of
from design.space import DesignSpace, Space
from gns_env.layout import LayoutSpace

#: What an idle place is given.
IDLE = 0.5


def ordered(centres: np.ndarray, dim: int | None = None) -> np.ndarray:
    """The same layout numbered across the flow (last coordinate, then the first).

    Args:
        centres: shape (n, D-1), or with columns for the form.
        dim: coordinates of a centre, D-1; default: all columns.
    """
    rows = np.asarray(centres, dtype=float)
    last = (rows.shape[1] if dim is None else dim) - 1
    return rows[np.lexsort((rows[:, 0], rows[:, last]))]


def plan_dim(space: Space) -> int:
    """Coordinates of a centre, D-1."""
    return space.scene.dim - 1


def to_parameters(space: Space, layout: np.ndarray) -> dict[str, float]:
    """Parameters of a layout [m], (n, D-1) or with columns for the form, in any numbering."""
    if isinstance(space, RowSpace):
        return space.to_parameters(layout)
    if not isinstance(space, DesignSpace):
        return dict(zip(names(space), unit_places(space, layout).ravel().tolist(), strict=True))
    centres, form = space.split(layout)
    found = dict.fromkeys(names(space), IDLE)
    if NUMBER in found:
        found[NUMBER] = len(centres)
    found |= dict(zip(space.names, space.unit(layout).tolist(), strict=True))
    unit = unit_places(space.at(len(centres), form), centres)
    found |= dict(zip(place_names(*unit.shape), unit.ravel().tolist(), strict=True))
    return found


def to_centres(space: Space, parameters: Mapping[str, float]) -> np.ndarray:
    """The layout [m] of parameters, its places not projected yet."""
    if isinstance(space, RowSpace):
        return space.to_layout(parameters)
    if not isinstance(space, DesignSpace):
        unit = np.array([parameters[name] for name in names(space)])
        return places(space, unit.reshape(space.n_baffles, -1))
    n = int(parameters.get(NUMBER, space.n_baffles))
    room, form = space.at_unit(n, [parameters[name] for name in space.names])
    n = room.n_baffles
    unit = np.array([parameters[name] for name in place_names(n, plan_dim(space))])
    return space.join(places(room, unit.reshape(n, -1)), form)


def names(space: Space) -> list[str]:
    """Parameter names: x1, across1, x2, ...; in 2D, where x alone is free, x1, x2, ..."""
    return list(distributions(space))


def distributions(space: Space) -> dict[str, BaseDistribution]:
    """What a sampler may choose: names and ranges."""
    if isinstance(space, RowSpace):
        return space.distributions()
    unit = FloatDistribution(0.0, 1.0)
    if not isinstance(space, DesignSpace):
        return dict.fromkeys(place_names(space.n_baffles, plan_dim(space)), unit)
    return {
        **number_of(space),
        **dict.fromkeys(space.names, unit),
        **dict.fromkeys(place_names(max(space.numbers), plan_dim(space)), unit),
    }


def place_names(count: int, dim: int) -> list[str]:
    """Names of the coordinates of so many places, in a plan of `dim` axes."""
    axes = ["x", "across"][:dim]
    return [f"{axis}{k + 1}" for k in range(count) for axis in axes]


def unit_places(space: LayoutSpace, centres: np.ndarray) -> np.ndarray:
    """Centres [m], shape (n, D-1), as numbers in the unit cube, shape (n, D-1)."""
    centres = ordered(centres)
    unit = np.clip(np.asarray(space.encode(centres), dtype=float), 0.0, 1.0).reshape(centres.shape)
    place = np.append(unit[:, -1], 1.0)
    rank = np.arange(1, len(centres) + 1)
    above = np.maximum(place[1:], 1e-12)
    unit[:, -1] = np.clip(place[:-1] / above, 0.0, 1.0) ** rank
    return unit


def places(space: LayoutSpace, unit: np.ndarray) -> np.ndarray:
    """Centres [m], shape (n, D-1), of numbers in the unit cube, shape (n, D-1); not projected."""
    unit, place = np.array(unit, dtype=float), 1.0
    for k in range(len(unit), 0, -1):
        place *= unit[k - 1, -1] ** (1.0 / k)
        unit[k - 1, -1] = place
    return np.asarray(space.decode(unit.ravel()), dtype=float).reshape(unit.shape)

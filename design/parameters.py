"""Layout <-> search parameters, one to one although baffles are interchangeable.

n equal baffles can be numbered in n! ways, so a search over plain coordinates would see every
layout n! times. Here they are numbered by their place across the flow (rows are common, so z tells
baffles apart better than x), and the ordered places 0 <= w_1 <= ... <= w_n <= 1 become

    r_k = (w_k / w_(k+1))^k,  w_(n+1) = 1,

which maps the ordered simplex onto the unit cube and uniform places onto uniform r (the classical
construction of uniform order statistics; Devroye 1986, Non-Uniform Random Variate Generation,
ch. V.3). Every point of the cube is one layout, and every layout is one point.
"""

from __future__ import annotations

import numpy as np

from gns_env.layout import LayoutSpace


def ordered(centres: np.ndarray) -> np.ndarray:
    """The same layout, shape (n, D-1), numbered across the flow (last column, then the first)."""
    centres = np.asarray(centres, dtype=float)
    return centres[np.lexsort((centres[:, 0], centres[:, -1]))]


def to_parameters(space: LayoutSpace, centres: np.ndarray) -> dict[str, float]:
    """Parameters in [0, 1] of a layout, shape (n, D-1) [m], in any numbering."""
    centres = ordered(centres)
    unit = np.clip(np.asarray(space.encode(centres), dtype=float), 0.0, 1.0).reshape(centres.shape)
    place = np.append(unit[:, -1], 1.0)
    rank = np.arange(1, len(centres) + 1)
    above = np.maximum(place[1:], 1e-12)
    unit[:, -1] = np.clip(place[:-1] / above, 0.0, 1.0) ** rank
    return dict(zip(names(space), unit.ravel().tolist(), strict=True))


def to_centres(space: LayoutSpace, parameters: dict[str, float]) -> np.ndarray:
    """The layout [m], shape (n, D-1), of parameters in [0, 1]; not projected yet."""
    flat = np.array([parameters[name] for name in names(space)])
    unit = flat.reshape(space.n_baffles, -1)
    place = 1.0
    for k in range(len(unit), 0, -1):
        place *= unit[k - 1, -1] ** (1.0 / k)
        unit[k - 1, -1] = place
    return np.asarray(space.decode(unit.ravel()), dtype=float).reshape(unit.shape)


def names(space: LayoutSpace) -> list[str]:
    """Parameter names: x1, across1, x2, ...; in 2D, where x alone is free, x1, x2, ..."""
    axes = ["x", "across"] if space.dim // space.n_baffles == 2 else ["x"]
    return [f"{axis}{k + 1}" for k in range(space.n_baffles) for axis in axes]

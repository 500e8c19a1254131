"""What may be placed where: the buildable layouts of a scene, and the nearest one to a wish.

Baffles of one size and yaw stand on the base. The footprint of turned ones is taken to be the
rectangle along the axes that holds it: what is called buildable is so, and of the rest some could
be built, too. A layout is buildable when

- every whole footprint lies inside the placement rectangle, and so inside the domain, and at least
  `wall_gap` away from the walls of the domain;
- any two footprints are at least `gap` clear of each other **along x or along z** (the distance of
  rectangles in the maximum norm: a passage of width `gap` opens between them along one axis);
- no footprint overlaps a keep-out rectangle or polygon, or a release that reaches down to the
  baffle's height;
- the baffles are no higher than `max_height` and no more than `max_volume` together.

A scene without a placement gets everything downstream of the front, 5 cm off, with a gap of 5 cm.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gns_env.projection import Projector
from gns_env.room import free_rectangles, nearest_free, pack
from gns_model.errors import LayoutError
from gns_model.footprint import bounding_size, corners
from gns_model.parts import TOLERANCE
from gns_model.polygon import clearance, strips
from gns_model.scene import Box, Placement, Scene

Array = NDArray[np.float64]

#: Where a scene without a placement starts to place baffles: this far past the front [m].
DEFAULT_CLEARANCE = 0.05
#: Clear gap of such a scene [m].
DEFAULT_GAP = 0.05
#: How far across the strips that stand for a keep-out polygon reach beyond it [m].
STRIP = 0.05


class LayoutSpace:
    """The buildable layouts of `n_baffles` baffles in `scene`.

    Attributes:
        scene, n_baffles: as given.
        placement: the scene's, or the default one, with size and yaw of a baffle filled in.
        size: of one baffle [m], shape (D,): along x, height, along z.
        yaw: of every baffle [degrees].
        lower, upper: bounds of a centre [m], shape (D-1,): the placement less half a baffle.
        gap: least clear distance [m].
        dim: length of an encoded layout, n_baffles * (D-1).

    Raises:
        LayoutError: if that many baffles do not fit, with how many do.
        SceneError: if the scene says nothing about the size of a baffle.
    """

    def __init__(self, scene: Scene, n_baffles: int) -> None:
        if int(n_baffles) != n_baffles or n_baffles < 1:
            raise LayoutError(f"the number of baffles must be 1 or more, got {n_baffles}")
        self.scene, self.n_baffles = scene, int(n_baffles)
        self.size = np.array(scene.baffle_size, dtype=float)
        placement = scene.placement or _default_placement(scene)
        self.yaw = scene.baffle_yaw
        own = {"size": scene.baffle_size, "yaw": self.yaw or None}
        self.placement = placement.model_copy(update=own)
        self.gap = placement.gap
        self._footprint = self.size[[0, *range(2, scene.dim)]]
        if self.yaw:
            self._footprint = bounding_size(self._footprint, self.yaw)
        self._area = _area(scene, placement)
        self.lower, self.upper = (
            self._area[0] + self._footprint / 2,
            self._area[1] - self._footprint / 2,
        )
        self.separation = self._footprint + self.gap
        self.dim = self.n_baffles * (scene.dim - 1)

        headroom = scene.domain.size[1]
        if self.size[1] > headroom + TOLERANCE:
            raise LayoutError(f"baffles {self.size[1]:g} m high exceed the domain's {headroom:g} m")
        _check_limits(placement, self.size, self.n_baffles)
        if (self.upper < self.lower - TOLERANCE).any():
            raise LayoutError(
                f"one baffle of {_metres(self._footprint)} is larger than the placement area of "
                f"{_metres(self._area[1] - self._area[0])}"
            )
        # An area exactly as wide as the baffle leaves one line for the centre.
        tight = self.upper < self.lower
        middle = (self.lower + self.upper) / 2
        self.lower = np.where(tight, middle, self.lower)
        self.upper = np.where(tight, middle, self.upper)

        half = self._footprint / 2
        self._obstacles = _obstacles(scene, placement, self.size[1])
        self._blocked = np.array(
            [[lo - half, up + half] for _, lo, up in self._obstacles], dtype=float
        ).reshape(-1, 2, scene.dim - 1)
        self._polygons = [
            (f"keep_out_polygons[{k}]", np.array(outline, dtype=float))
            for k, outline in enumerate(placement.keep_out_polygons)
        ]
        # The machinery below knows rectangles: it gets strips that cover the polygons.
        covers = [strips(outline, STRIP) for _, outline in self._polygons]
        self._taken = np.concatenate(
            [self._blocked, *(c + np.stack([-half, half]) for c in covers if len(c))]
        )
        self._free = free_rectangles(np.array([self.lower, self.upper]), self._taken)
        self._slots, most = pack(self._free, self.separation, self.n_baffles)
        if len(self._slots) < self.n_baffles:
            names = ", ".join([o[0] for o in self._obstacles] + [p[0] for p in self._polygons])
            besides = f" beside {names}" if names else ""
            raise LayoutError(
                f"{self.n_baffles} baffles of {_metres(self._footprint)} with {self.gap:g} m clear "
                f"between them do not fit into {_metres(self._area[1] - self._area[0])}{besides}: "
                + (
                    f"at most {most} do"
                    if most == len(self._slots)
                    else f"found room for {len(self._slots)}"
                )
            )
        self._projectors: dict[int, Projector] = {}

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_projectors": {}}  # compiled programmes are made anew

    def encode(self, centres: ArrayLike) -> Array:
        """Centres (n, D-1) [m] as numbers in the unit box, shape (dim,): x, z of each in turn."""
        width = self.upper - self.lower
        unit = (self.as_centres(centres) - self.lower) / np.where(width > 0, width, 1.0)
        return np.where(width > 0, unit, 0.5).reshape(-1)

    def decode(self, unit: ArrayLike) -> Array:
        """Centres [m], shape (n, D-1), of numbers in the unit box, shape (dim,) or (n, D-1)."""
        values = np.asarray(unit, dtype=float)
        if values.size % len(self.lower):
            raise LayoutError(f"{values.size} numbers do not make centres of {len(self.lower)}")
        values = values.reshape(-1, len(self.lower))
        # This form, unlike lower + unit * width, gives both ends exactly.
        return (1 - values) * self.lower + values * self.upper

    def check(self, centres: ArrayLike) -> list[str]:
        """What is wrong with `centres` [m], shape (k, D-1), one sentence each; empty if nothing.

        Any number k of baffles is accepted, so that a layout can be checked while it grows.

        Raises:
            LayoutError: if centres has another shape or is not finite.
        """
        c = self.as_centres(centres)
        faults = []
        for k in np.flatnonzero(
            ((c < self.lower - TOLERANCE) | (c > self.upper + TOLERANCE)).any(1)
        ):
            faults.append(
                f"baffle {k} at {_metres(c[k], ', ')} leaves the placement area: its centre may be "
                f"at {_metres(self.lower, ', ')} to {_metres(self.upper, ', ')}"
            )
        clear = np.abs(c[:, None] - c[None]) - self._footprint
        for i, j in zip(*np.triu_indices(len(c), 1), strict=True):
            if clear[i, j].max() < self.gap - TOLERANCE:
                faults.append(
                    f"baffles {i} and {j} are {max(clear[i, j].max(), 0):.4g} m clear of each "
                    f"other, {self.gap:g} m needed along one axis"
                )
        for (name, _, _), (lower, upper) in zip(self._obstacles, self._blocked, strict=True):
            inside = ((c > lower + TOLERANCE) & (c < upper - TOLERANCE)).all(1)
            faults += [f"baffle {k} overlaps {name}" for k in np.flatnonzero(inside)]
        for name, outline in self._polygons:
            faults += [
                f"baffle {k} overlaps {name}"
                for k, centre in enumerate(c)
                if clearance(self._outline(centre), outline) < -TOLERANCE
            ]
        return faults

    def project(self, centres: ArrayLike) -> Array:
        """Buildable centres nearest to `centres` [m], shape (k, D-1), k <= n_baffles.

        Nearest in the sum of squared distances, up to the choice of who stands on which side of
        whom, which is searched locally (see `gns_env.projection`). A buildable layout comes back
        unchanged; a permuted one comes back permuted; the answer is always buildable. Wishes more
        than a whole area's width outside are drawn in to that first.

        Raises:
            LayoutError: if centres is not finite, has another shape or more than n_baffles rows.
        """
        c = self.as_centres(centres)
        if not 1 <= len(c) <= self.n_baffles:
            raise LayoutError(f"expected 1 to {self.n_baffles} baffles to project, got {len(c)}")
        if not self.check(c):
            return c.copy()
        if len(c) == 1:
            return nearest_free(self._free, c[0])[None]
        width = self._area[1] - self._area[0]
        asked, c = c, np.clip(c, self._area[0] - width, self._area[1] + width)
        if len(c) not in self._projectors:
            self._projectors[len(c)] = Projector(self._free, self.separation, self._slots, len(c))
        # Wishes that were drawn in to one place keep the order that they had outside.
        sorting = np.lexsort(asked.T[::-1])
        found = np.empty_like(c)
        found[sorting] = self._projectors[len(c)].nearest(c[sorting])
        return found

    def place(self, centre: ArrayLike, earlier: ArrayLike) -> Array:
        """The place nearest to `centre` (D-1,) for one more baffle, beside `earlier` (k, D-1) ones.

        Earlier baffles stay where they are. If the nearest place would leave no room for the rest
        of the n_baffles, the nearest place of a packing that does is taken.

        Raises:
            LayoutError: if a number is not finite, or there is no room beside the earlier baffles.
        """
        wish, stand = self.as_centres(np.atleast_2d(centre))[0], self.as_centres(earlier)
        remaining = self.n_baffles - len(stand)
        if remaining < 1:
            raise LayoutError(f"all {self.n_baffles} baffles are placed already")
        free = self._beside(stand)
        if len(free):
            place = nearest_free(free, wish)
            rest = self._beside(np.vstack([stand, place]))
            if (
                remaining == 1
                or len(pack(rest, self.separation, remaining - 1)[0]) >= remaining - 1
            ):
                return place
        slots, _ = pack(free, self.separation, remaining)
        if len(slots) < remaining:
            raise LayoutError(
                f"beside the {len(stand)} baffles that stand there is room for {len(slots)} more, "
                f"not for {remaining}"
            )
        return slots[np.argmin(((slots - wish) ** 2).sum(1))]

    def random(self, rng: np.random.Generator) -> Array:
        """A random buildable layout [m], shape (n, D-1): uniform, projected if that clashes."""
        for _ in range(20):
            centres = rng.uniform(self.lower, self.upper, (self.n_baffles, len(self.lower)))
            if not self.check(centres):
                return centres
        return self.project(centres)

    def _beside(self, stand: Array) -> Array:
        """Free rectangles for one more centre, shape (M, 2, D-1)."""
        taken = np.stack([stand - self.separation, stand + self.separation], axis=1)
        return free_rectangles(
            np.array([self.lower, self.upper]), np.concatenate([self._taken, taken])
        )

    def _outline(self, centre: Array) -> Array:
        """Corners of the footprint about `centre` [m], shape (4, 2)."""
        return corners(centre, self.size[[0, 2]], self.yaw)

    def as_centres(self, centres: ArrayLike) -> Array:
        """`centres` as a float array (k, D-1) [m], k >= 0.

        Raises:
            LayoutError: if it has another shape or is not finite.
        """
        try:
            c = np.asarray(centres, dtype=float)
        except (TypeError, ValueError):
            raise LayoutError(f"centres must be numbers, got {centres!r}") from None
        if c.size == 0:
            return np.zeros((0, len(self.lower)))
        if c.ndim != 2 or c.shape[1] != len(self.lower):
            raise LayoutError(f"centres must have shape (n, {len(self.lower)}), got {c.shape}")
        if not np.isfinite(c).all():
            raise LayoutError(f"centres must be finite, got {c.tolist()}")
        return c


def _default_placement(scene: Scene) -> Placement:
    start, end = scene.front + DEFAULT_CLEARANCE, scene.domain.upper[0]
    if start >= end:
        raise LayoutError(
            f"no room downstream of the front at x = {scene.front:g} m for baffles: the domain "
            f"ends at {end:g} m"
        )
    return Placement(
        lower=(start, *scene.domain.lower[2:]),
        upper=(end, *scene.domain.upper[2:]),
        gap=DEFAULT_GAP,
    )


def _area(scene: Scene, placement: Placement) -> Array:
    """Corners of the rectangle that holds all footprints [m], shape (2, D-1).

    Raises:
        LayoutError: if the distance to the walls leaves none of the placement.
    """
    plan = [0, *range(2, scene.dim)]
    lower = np.array(scene.domain.lower)[plan] + placement.wall_gap
    upper = np.array(scene.domain.upper)[plan] - placement.wall_gap
    area = np.array(
        [np.maximum(placement.lower, lower), np.minimum(placement.upper, upper)], dtype=float
    )
    if placement.wall_gap and (area[0] > area[1] - TOLERANCE).any():
        raise LayoutError(
            f"wall_gap {placement.wall_gap:g} m leaves nothing of the placement area of "
            f"{_metres(np.array(placement.upper) - placement.lower)}"
        )
    return area if placement.wall_gap else np.array([placement.lower, placement.upper], dtype=float)


def _check_limits(placement: Placement, size: Array, n_baffles: int) -> None:
    if placement.max_height is not None and size[1] > placement.max_height + TOLERANCE:
        raise LayoutError(
            f"baffles {size[1]:g} m high exceed max_height {placement.max_height:g} m"
        )
    volume = n_baffles * float(np.prod(size))
    if placement.max_volume is not None and volume > placement.max_volume * (1 + 1e-9):
        unit = "m³" if len(size) == 3 else "m² (per metre of width)"
        raise LayoutError(
            f"{n_baffles} baffles of {_metres(size)} take {volume:.4g} {unit}, more than "
            f"max_volume {placement.max_volume:g}"
        )


def _obstacles(scene: Scene, placement: Placement, height: float) -> list[tuple[str, Array, Array]]:
    """Name, lower and upper corner in plan of everything that a footprint must not overlap."""
    n = scene.dim - 1
    obstacles = [
        (f"keep_out[{k}]", np.array(r[:n]), np.array(r[n:]))
        for k, r in enumerate(placement.keep_out)
    ]
    for k, release in enumerate(scene.releases):
        if release.lower[1] < scene.base + height - TOLERANCE:
            plan = [np.array([corner[0], *corner[2:]]) for corner in (release.lower, release.upper)]
            obstacles.append((f"release[{k}]", plan[0], plan[1]))
    inside = Box(lower=placement.lower, upper=placement.upper)
    return [o for o in obstacles if inside.overlaps(Box(lower=tuple(o[1]), upper=tuple(o[2])))]


def _metres(values: Sequence[float] | Array, joint: str = " x ") -> str:
    return joint.join(f"{v:g}" for v in values) + " m"

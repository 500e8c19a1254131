"""Random columns in 2D: squares and rectangles that collapse, at rest, thrown or in motion.

Each function draws one scene of the family that is named like it; `scenes` lists the families.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from gns_model.paper import COLUMN_BASE_FRICTION, FRICTION_ANGLES, column_material
from gns_model.scene import Scene

#: Boxes along each side of a square of the family "spreading"; a box is whole spacings wide.
PARTS = 6

#: Spacing of points that a square of these families is made for [m].
SPACING = 0.0125

#: Width of a box with room for what runs far [m].
WIDE = 2.0


def column_scene(rng: np.random.Generator, index: int) -> Scene:
    """A scene of the family "columns"."""
    return _square(rng, rng.uniform(0.2, 0.3), 30.0)


def friction_scene(rng: np.random.Generator, index: int) -> Scene:
    """A scene of the family "friction"."""
    return _square(rng, rng.uniform(0.2, 0.4), FRICTION_ANGLES[index % len(FRICTION_ANGLES)])


def rectangle_scene(rng: np.random.Generator, index: int) -> Scene:
    """A scene of the family "rectangles"."""
    height, aspect = rng.uniform(0.2, 0.4), np.exp(rng.uniform(np.log(0.6), np.log(3.5)))
    length = max(0.08, height / aspect)
    return _column_box((0.0, 0.0), (length, height), (0.0, 0.0), 30.0)


def rectangle_friction_scene(rng: np.random.Generator, index: int) -> Scene:
    """A scene of the family "rectangles-friction". Sides are whole multiples of two spacings of the
    models, so that every filling of it is as large as the scene says."""
    aspect = np.exp(rng.uniform(np.log(0.4), np.log(2.5)))
    area, grid = rng.uniform(0.03, 0.10), 2 * SPACING
    sides = (math.sqrt(area / aspect), math.sqrt(area * aspect))
    length, height = (round(grid * round(side / grid), 3) for side in sides)
    at_rest_after = 5 * math.sqrt(height / 9.81)  # the paper's rest near 4 sqrt(H/g), and a bit
    return _column_box(
        (0.0, 0.0),
        (length, height),
        (0.0, 0.0),
        FRICTION_ANGLES[index % len(FRICTION_ANGLES)],
        WIDE,  # the runout of a low one of 15 degrees fits in
        duration=round(max(1.0, at_rest_after), 2),
    )


def square_scene(rng: np.random.Generator, index: int) -> Scene:
    """A scene of the family "squares". The narrow ones collapse in a part of the time."""
    size = float(np.exp(rng.uniform(np.log(0.08), np.log(0.45))))
    width = 1.5  # room for the runout of the largest
    place = 0.0 if rng.random() < 0.5 else rng.uniform(0.0, width - size)
    return _column_box(
        (place, 0.0), (size, size), (0.0, 0.0), 30.0, width, duration=_time_to_rest(size)
    )


def spreading_scene(rng: np.random.Generator, index: int) -> Scene:
    """A scene of the family "spreading"."""
    return _spreading(rng, 30.0, at_rest=0.0)


def spreading_friction_scene(rng: np.random.Generator, index: int) -> Scene:
    """A scene of the family "spreading-friction"."""
    return _spreading(rng, FRICTION_ANGLES[index % len(FRICTION_ANGLES)], at_rest=1 / 3)


def pressed_scene(rng: np.random.Generator, index: int) -> Scene:
    """A scene of the family "pressed"."""
    return _pressed(rng, 30.0)


def pressed_friction_scene(rng: np.random.Generator, index: int) -> Scene:
    """A scene of the family "pressed-friction"."""
    return _pressed(rng, FRICTION_ANGLES[index % len(FRICTION_ANGLES)])


def _pressed(rng: np.random.Generator, friction_angle: float) -> Scene:
    """A square column that rises as it is pushed together.

    The foot is several times as high as the square, so that it is stretched nearly evenly; speeds
    are what lifts its top by up to one and a half sizes.
    """
    size = SPACING * PARTS * int(rng.integers(1, 6))
    at_wall, place = _stand(rng, size)
    speed = -rng.uniform(0.8, 1.7) * np.sqrt(9.81 * size) * (1.0 if at_wall else 0.5)
    foot = size * rng.uniform(2.0, 6.0)
    duration = 0.3 + _time_to_rest(size)
    return _in_motion(size, place, at_wall, speed, foot, friction_angle, duration)


def _spreading(rng: np.random.Generator, friction_angle: float, *, at_rest: float) -> Scene:
    """A square column whose foot spreads, but for a share `at_rest`. High columns fall and spread
    faster than squares at rest ever do, and a model that has seen only those leaves them standing.
    """
    size = SPACING * PARTS * int(rng.integers(1, 7))
    at_wall, place = _stand(rng, size)
    speed = rng.uniform(-0.6, 1.8) * np.sqrt(9.81 * size)
    foot = size * np.exp(rng.uniform(np.log(0.4), np.log(3.0)))
    if rng.random() < at_rest:
        speed = 0.0
    return _in_motion(size, place, at_wall, speed, foot, friction_angle, _time_to_rest(size))


def _stand(rng: np.random.Generator, size: float) -> tuple[bool, float]:
    """Whether a square stands against the wall, as half of them do, and where its left face is."""
    at_wall = bool(rng.random() < 0.5)
    return at_wall, 0.0 if at_wall else rng.uniform(0.0, WIDE - size)


def _in_motion(
    size: float,
    place: float,
    at_wall: bool,
    speed: float,
    foot: float,
    friction_angle: float,
    duration: float,
) -> Scene:
    """A square column with the velocities of the foot of a falling one, free of divergence.

    With l the distance from the plane that does not move (the wall, or the middle) to the face, and
    h the height of the foot,

        u = U (x - x0)/l exp(-y/h),   v = -U h/l (1 - exp(-y/h)).

    The release consists of `PARTS` x `PARTS` boxes, each with the velocity of its middle.

    Args:
        size: of the square [m].
        place: of its left face [m].
        speed: U, of the foot of the face; negative: inwards [m/s].
        foot: h [m].
    """
    still, length = (place, size) if at_wall else (place + size / 2, size / 2)
    corners = size / PARTS * np.arange(PARTS + 1)
    releases = []
    for x, right in itertools.pairwise(place + corners):
        for y, top in itertools.pairwise(corners):
            fade = np.exp(-(y + top) / 2 / foot)
            along = speed * ((x + right) / 2 - still) / length * fade
            down = -speed * foot / length * (1 - fade)
            releases.append({"lower": (x, y), "upper": (right, top), "velocity": (along, down)})
    scene = _column_box(
        (place, 0.0), (size, size), (0.0, 0.0), friction_angle, WIDE, duration=duration
    )
    return Scene.from_dict({**scene.model_dump(exclude={"releases"}), "release": releases})


def _time_to_rest(size: float) -> float:
    """What a square column of `size` [m] needs to come to rest, and a bit more [s]: later frames
    would be still ones."""
    return round(0.2 + 1.5 * math.sqrt(size), 2)


def _square(rng: np.random.Generator, size: float, friction_angle: float) -> Scene:
    """Half of them are thrown; the other half are columns: at rest on the base, half of those
    against a wall. A column that is let go and a heap that has settled look alike to whoever sees
    velocities only, so it takes many of them to tell the two apart by their shape."""
    room = 1.0 - size
    place = [rng.uniform(0, room), rng.uniform(0, room)]
    velocity = [rng.uniform(-1.5, 1.5), rng.uniform(-1.5, 1.5)]
    if rng.random() < 0.5:
        place[1], velocity = 0.0, [0.0, 0.0]
        if rng.random() < 0.5:
            place[0] = 0.0
    return _column_box(tuple(place), (size, size), tuple(velocity), friction_angle)


def _column_box(
    lower: tuple[float, ...],
    size: tuple[float, ...],
    velocity: tuple[float, ...],
    friction_angle: float,
    width: float = 1.0,
    duration: float = 1.0,
) -> Scene:
    upper = tuple(a + b for a, b in zip(lower, size, strict=True))
    return Scene.from_dict(
        {
            "name": "column",
            "duration": duration,
            "domain": {"lower": (0.0, 0.0), "upper": (width, 1.0)},
            "friction": {"base": COLUMN_BASE_FRICTION, "walls": 0.0},
            "material": column_material(friction_angle),
            "release": [{"lower": lower, "upper": upper, "velocity": velocity}],
        }
    )

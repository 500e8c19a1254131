"""Random scenes: what a learned simulator is trained and judged on.

The paper's three datasets (table "Training data"), with what its columns and its flume are made of:

    columns     2D: a square of 0.2 to 0.3 m at a random place and velocity in a box of 1 m
    friction    2D: the same with squares of 0.2 to 0.4 m, at 15, 22.5, 30, 37.5 and 45 degrees in
                turn
    barriers    3D: a cube of 0.2 to 0.4 m at a random place and velocity in a box of 0.8 m, with
                one or two barriers of 0.1 x 0.3 x 0.1 m
    rectangles  2D: a rectangle at rest against a wall, of random aspect: the paper's validation

and for what the paper's aspect ratios ask of a model that has seen aspect 1 only:

    squares     2D: a square column of 0.08 to 0.45 m at rest, half of them against a wall: as
                narrow and as high as the columns of other aspects
    spreading   2D: a square column of 0.075 to 0.45 m that already spreads as it is let go, or is
                being pushed together: what a high column is on its way through aspect 1
    spreading-friction
                2D: the same at 15, 22.5, 30, 37.5 and 45 degrees in turn, a third of them at rest
    pressed     2D: a square column of 0.075 to 0.375 m that is pushed together so fast that it
                rises into one of aspect 1.5 to 4 before it falls
    pressed-friction
                2D: the same at the five angles in turn

and three that are made for layouts of baffles in the flume:

    random   domain, release (size, place, height of fall, velocity) and one to four baffles of
             random size and place: the paper's barrier dataset, widened
    flume    the paper's flume with a release varied by some 15% and one to six random baffles
    layouts  the paper's flume exactly, with three of its own baffles placed at random: unseen
             layouts to choose and to judge a model by
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np

from gns_model.errors import SceneError
from gns_model.paper import COLUMN_BASE_FRICTION, FRICTION_ANGLES, column_material
from gns_model.scene import Box, Scene

#: How often a random baffle is drawn again before a scene does with fewer.
TRIES = 50

#: Boxes along each side of a square of the family "spreading"; a box is whole spacings wide.
PARTS = 6

#: Width of the box in which squares in motion stand [m].
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
    size = 0.0125 * PARTS * int(rng.integers(1, 6))
    at_wall, place = _stand(rng, size)
    speed = -rng.uniform(0.8, 1.7) * np.sqrt(9.81 * size) * (1.0 if at_wall else 0.5)
    foot = size * rng.uniform(2.0, 6.0)
    duration = 0.3 + _time_to_rest(size)
    return _in_motion(size, place, at_wall, speed, foot, friction_angle, duration)


def _spreading(rng: np.random.Generator, friction_angle: float, *, at_rest: float) -> Scene:
    """A square column whose foot spreads, but for a share `at_rest`. High columns fall and spread
    faster than squares at rest ever do, and a model that has seen only those leaves them standing.
    """
    size = 0.0125 * PARTS * int(rng.integers(1, 7))
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


def barrier_scene(rng: np.random.Generator, index: int) -> Scene:
    """A scene of the family "barriers"."""
    size = rng.uniform(0.2, 0.4)
    low, room = 0.1, 0.8 - size
    corner = [low + rng.uniform(0, room), low, low + rng.uniform(0, room)]
    if rng.random() < 0.4:
        corner[1] += rng.uniform(0, min(0.2, room))
    speed, heading = rng.uniform(0.5, 2.4), rng.uniform(0, 2 * np.pi)
    return _with_random_baffles(
        {
            "name": "barriers",
            "domain": {"lower": (low,) * 3, "upper": (low + 0.8,) * 3},
            "release": [
                {
                    "lower": tuple(corner),
                    "upper": tuple(c + size for c in corner),
                    "velocity": (speed * np.cos(heading), 0.0, speed * np.sin(heading)),
                }
            ],
            "duration": 0.87,
        },
        rng,
        count=int(rng.integers(1, 3)),
        size=lambda: (0.1, 0.3, 0.1),
        gap=0.05,
        earliest=low,
        clear_of_release=True,
    )


def random_scene(rng: np.random.Generator, index: int) -> Scene:
    """A scene of the family "random"."""
    length, width = rng.uniform(0.8, 1.8), rng.uniform(0.5, 1.8)
    lower = np.array([0.1, 0.1, 0.1])
    upper = lower + [length, 0.8, width]
    size = np.array(
        [rng.uniform(0.2, 0.4), rng.uniform(0.12, 0.35), width * rng.uniform(0.45, 1.0)]
    )
    fall = rng.uniform(0, 0.1) if rng.random() < 0.2 else 0.0
    start = lower + [
        rng.uniform(0, 0.1) if rng.random() < 0.5 else 0.0,
        fall,
        rng.uniform(0, width - size[2]),
    ]
    velocity = [rng.uniform(0.5, 2.6), 0.0, rng.normal(0, 0.2)]
    return _with_random_baffles(
        {
            "name": "random",
            "domain": {"lower": tuple(lower), "upper": tuple(upper)},
            "release": [
                {
                    "lower": tuple(start),
                    "upper": tuple(np.minimum(start + size, upper)),
                    "velocity": tuple(velocity),
                }
            ],
            "duration": 0.8,
        },
        rng,
        count=int(rng.integers(1, 5)),
        size=lambda: (rng.uniform(0.08, 0.2), rng.uniform(0.15, 0.4), rng.uniform(0.08, 0.4)),
        gap=0.06,
    )


def flume_scene(rng: np.random.Generator, index: int) -> Scene:
    """A scene of the family "flume"."""
    length, height, width = 0.35, 0.25, 1.4
    length *= rng.uniform(0.85, 1.15)
    height *= rng.uniform(0.85, 1.15)
    width *= rng.uniform(0.85, 1.15)
    common = rng.random() < 0.6  # most layouts are of equal baffles near the paper's size
    one = (rng.uniform(0.1, 0.2), rng.uniform(0.22, 0.36), rng.uniform(0.1, 0.25))
    return _with_random_baffles(
        _flume(length, height, width, rng.uniform(1.6, 2.4)),
        rng,
        count=int(rng.integers(1, 7)),
        size=lambda: (
            one
            if common
            else (rng.uniform(0.08, 0.2), rng.uniform(0.15, 0.4), rng.uniform(0.08, 0.4))
        ),
        gap=0.06,
        latest=1.5,
    )


def layout_scene(rng: np.random.Generator, index: int) -> Scene:
    """A scene of the family "layouts"."""
    return _with_random_baffles(
        _flume(0.35, 0.25, 1.4, 2.0),
        rng,
        count=3,
        size=lambda: (0.15, 0.30, 0.15),
        gap=0.10,
        earliest=0.6,
        latest=1.5,
    )


#: By name. The place in the list is a part of the seed: new families go to the end.
FAMILIES: dict[str, Callable[[np.random.Generator, int], Scene]] = {
    "random": random_scene,
    "flume": flume_scene,
    "layouts": layout_scene,
    "columns": column_scene,
    "friction": friction_scene,
    "barriers": barrier_scene,
    "rectangles": rectangle_scene,
    "squares": square_scene,
    "spreading": spreading_scene,
    "spreading-friction": spreading_friction_scene,
    "pressed": pressed_scene,
    "pressed-friction": pressed_friction_scene,
}


def draw(family: str, seed: int, index: int) -> Scene:
    """Scene number `index` of a family: the same for the same seed on every machine.

    Raises:
        SceneError: if there is no such family.
    """
    if family not in FAMILIES:
        raise SceneError(f"no family of scenes named {family!r}: {', '.join(FAMILIES)}")
    key = [seed, index, list(FAMILIES).index(family)]
    scene = FAMILIES[family](np.random.default_rng(key), index)
    return scene.replace(name=f"{family}-{seed}-{index}")


def _flume(length: float, height: float, width: float, speed: float) -> dict:
    middle = 1.0
    return {
        "name": "flume",
        "domain": {"lower": (0.1, 0.1, 0.1), "upper": (1.9, 0.9, 1.9)},
        "release": [
            {
                "lower": (0.1, 0.1, middle - width / 2),
                "upper": (0.1 + length, 0.1 + height, middle + width / 2),
                "velocity": (speed, 0.0, 0.0),
            }
        ],
        "duration": 0.9,
        "section": 1.1,
    }


def _with_random_baffles(
    values: dict,
    rng: np.random.Generator,
    *,
    count: int,
    size: Callable[[], tuple[float, float, float]],
    gap: float,
    earliest: float | None = None,
    latest: float | None = None,
    clear_of_release: bool = False,
) -> Scene:
    """`values` with up to `count` baffles, `gap` [m] apart, downstream of the release.

    Args:
        size: draws the size of a baffle [m].
        earliest, latest: bounds of their faces along x [m]; default: the flow front, the far wall.
        clear_of_release: instead of lying downstream they may stand anywhere beside the release.
    """
    scene = Scene.from_dict(values)
    lower, upper = scene.domain.lower, scene.domain.upper
    first = earliest if earliest is not None else scene.front + 0.04
    last = min(latest if latest is not None else upper[0], upper[0])
    placed: list[dict] = []
    footprints: list[Box] = []
    if clear_of_release:
        for r in scene.releases:
            footprints.append(Box(lower=(r.lower[0], r.lower[2]), upper=(r.upper[0], r.upper[2])))
    for _ in range(TRIES * count):
        if len(placed) == count:
            break
        extent = size()
        if last - first <= extent[0]:
            continue
        x = rng.uniform(first + extent[0] / 2, last - extent[0] / 2)
        z = rng.uniform(lower[2] + extent[2] / 2, upper[2] - extent[2] / 2)
        box = Box(
            lower=(x - extent[0] / 2 - gap, z - extent[2] / 2 - gap),
            upper=(x + extent[0] / 2 + gap, z + extent[2] / 2 + gap),
        )
        inner = Box(
            lower=(x - extent[0] / 2, z - extent[2] / 2),
            upper=(x + extent[0] / 2, z + extent[2] / 2),
        )
        if any(box.overlaps(other) for other in footprints):
            continue
        footprints.append(inner)
        placed.append({"center": (x, z), "size": extent})
    return Scene.from_dict({**values, "baffle": placed})

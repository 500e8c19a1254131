"""Random scenes: what a learned simulator is trained and judged on.

The paper's three datasets (table "Training data"), with what its columns and its flume are made of:

    columns     2D: a square of 0.2 to 0.3 m at a random place and velocity in a box of 1 m
    friction    2D: the same with squares of 0.2 to 0.4 m, at 15, 22.5, 30, 37.5 and 45 degrees in
                turn
    barriers    3D: a cube of 0.2 to 0.4 m at a random place and velocity in a box of 0.8 m, with
                one or two barriers of 0.1 x 0.3 x 0.1 m
    slides      3D: a block of 0.1 to 0.3 m height that slides along the base of a box of 1.4 m, or
                fills a channel of 0.15 to 0.45 m, with up to two barriers in its way
    rectangles  2D: a rectangle at rest against a wall, of random aspect: the paper's validation
    rectangles-friction
                2D: a rectangle of 0.03 to 0.10 m2 and aspect 0.4 to 2.5 at rest against a wall, at
                the five angles in turn

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

and five that are made for layouts of baffles in the flume:

    random   domain, release (size, place, height of fall, velocity) and one to four baffles of
             random size and place: the paper's barrier dataset, widened
    flume    the paper's flume with a release varied by some 15% and one to six random baffles
    bare     the same releases without baffles: what every layout is compared with
    rows     the same releases and one or two rows of two to six equal baffles with gaps of 0.03 to
             0.17 m: what searches end at, and random layouts hardly ever are
    layouts  the paper's flume exactly, with three of its own baffles placed at random: unseen
             layouts to choose and to judge a model by
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gns_model.data.column_scenes import (
    column_scene,
    friction_scene,
    pressed_friction_scene,
    pressed_scene,
    rectangle_friction_scene,
    rectangle_scene,
    spreading_friction_scene,
    spreading_scene,
    square_scene,
)
from gns_model.data.flume_scenes import (
    bare_scene,
    barrier_scene,
    flume_scene,
    layout_scene,
    random_scene,
    row_scene,
    slide_scene,
)
from gns_model.errors import SceneError
from gns_model.scene import Scene

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
    "bare": bare_scene,
    "rows": row_scene,
    "rectangles-friction": rectangle_friction_scene,
    "slides": slide_scene,
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

"""Random scenes: what a learned simulator is trained and judged on.

Three families, all with the material and friction of the paper's flume:

    random   domain, release (size, place, height of fall, velocity) and one to four baffles of
             random size and place: the paper's barrier dataset, widened
    flume    the paper's flume with a release varied by some 15% and one to six random baffles
    layouts  the paper's flume exactly, with three of its own baffles placed at random: unseen
             layouts to choose and to judge a model by
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gns_model.errors import SceneError
from gns_model.scene import Box, Scene

#: How often a random baffle is drawn again before a scene does with fewer.
TRIES = 50


def random_scene(rng: np.random.Generator) -> Scene:
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


def flume_scene(rng: np.random.Generator) -> Scene:
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


def layout_scene(rng: np.random.Generator) -> Scene:
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


FAMILIES: dict[str, Callable[[np.random.Generator], Scene]] = {
    "random": random_scene,
    "flume": flume_scene,
    "layouts": layout_scene,
}


def draw(family: str, seed: int, index: int) -> Scene:
    """Scene number `index` of a family: the same for the same seed on every machine.

    Raises:
        SceneError: if there is no such family.
    """
    if family not in FAMILIES:
        raise SceneError(f"no family of scenes named {family!r}: {', '.join(FAMILIES)}")
    key = [seed, index, list(FAMILIES).index(family)]
    scene = FAMILIES[family](np.random.default_rng(key))
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
) -> Scene:
    scene = Scene.from_dict(values)
    lower, upper = scene.domain.lower, scene.domain.upper
    first = earliest if earliest is not None else scene.front + 0.04
    last = min(latest if latest is not None else upper[0], upper[0])
    placed: list[dict] = []
    footprints: list[Box] = []
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

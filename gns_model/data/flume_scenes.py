"""Random flows in 3D that meet baffles: the paper's barriers, its flume, and wider domains.

Each function draws one scene of the family that is named like it; `scenes` lists the families.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gns_model.scene import Box, Scene

#: How often a random baffle is drawn again before a scene does with fewer.
TRIES = 50


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


def slide_scene(rng: np.random.Generator, index: int) -> Scene:
    """A scene of the family "slides". Most come to rest before the far wall."""
    low = 0.1
    size = [rng.uniform(0.14, 0.36), rng.uniform(0.1, 0.3), rng.uniform(0.2, 0.6)]
    channel = rng.random() < 0.5
    if channel:  # as in the middle of a wide release, nothing gives way sideways
        size[2] = rng.uniform(0.15, 0.45)
    length, width = (1.8, size[2]) if channel else (1.4, 0.8)
    start = (
        low + (rng.uniform(0, 0.1) if rng.random() < 0.5 else 0.0),
        low,
        low + rng.uniform(0, width - size[2]),
    )
    widest = 0.6 * width if channel else 0.2
    return _with_random_baffles(
        {
            "name": "slides",
            "domain": {"lower": (low,) * 3, "upper": (low + length, 0.9, low + width)},
            "release": [
                {
                    "lower": start,
                    "upper": tuple(a + b for a, b in zip(start, size, strict=True)),
                    "velocity": (rng.uniform(0.8, 2.6), 0.0, rng.normal(0, 0.1)),
                }
            ],
            "duration": 0.87,
        },
        rng,
        count=int(rng.integers(0, 3)),
        size=lambda: (rng.uniform(0.1, 0.2), 0.3, rng.uniform(widest / 2, widest)),
        gap=0.05,
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


def bare_scene(rng: np.random.Generator, index: int) -> Scene:
    """A scene of the family "bare"."""
    return Scene.from_dict(_flume(*_varied(rng), rng.uniform(1.6, 2.4)))


def flume_scene(rng: np.random.Generator, index: int) -> Scene:
    """A scene of the family "flume"."""
    size = _varied(rng)
    common = rng.random() < 0.6  # most layouts are of equal baffles near the paper's size
    one = (rng.uniform(0.1, 0.2), rng.uniform(0.22, 0.36), rng.uniform(0.1, 0.25))
    return _with_random_baffles(
        _flume(*size, rng.uniform(1.6, 2.4)),
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


def row_scene(rng: np.random.Generator, index: int) -> Scene:
    """A scene of the family "rows". Within a row the gaps are alike, but for a finger's width."""
    values = _flume(*_varied(rng), rng.uniform(1.6, 2.4))
    low, high = (values["domain"][k][2] for k in ("lower", "upper"))
    size = (rng.uniform(0.1, 0.2), rng.uniform(0.22, 0.36), rng.uniform(0.1, 0.25))
    placed: list[dict] = []
    x = rng.uniform(0.62, 0.95)
    for _ in range(int(rng.integers(1, 3))):
        pitch = size[2] + rng.uniform(0.05, 0.15)
        fit = int((high - low + pitch - size[2]) / pitch)
        count = int(rng.integers(2, min(fit, 6) + 1))
        room = high - low - (count - 1) * pitch - size[2]
        first = low + size[2] / 2 + rng.uniform(0, room)
        for k in range(count):
            z = np.clip(
                first + k * pitch + rng.uniform(-0.01, 0.01), low + size[2] / 2, high - size[2] / 2
            )
            placed.append({"center": (x + rng.uniform(-0.02, 0.02), z), "size": size})
        x += size[0] + rng.uniform(0.15, 0.4)
    return Scene.from_dict({**values, "baffle": placed})


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


def _varied(rng: np.random.Generator) -> tuple[float, float, float]:
    """Length, height and width of a release within 15% of the paper's [m]."""
    length, height, width = (x * rng.uniform(0.85, 1.15) for x in (0.35, 0.25, 1.4))
    return length, height, width


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

"""Scenarios: the same site with another flow, so that a policy learns to answer to a range of them.

| key              | unit    | what                                                              |
|------------------|---------|-------------------------------------------------------------------|
| `volume`         | m³ (m²) | of all releases; their shape stays, and so do their upstream face, |
|                  |         | their bottom and their middle across                              |
| `speed`          | m/s     | of the fastest release; a scene at rest gets it downstream        |
| `friction_angle` | degrees | of the material                                                   |
| `place`          | m       | shift of the releases in plan, (x, z), in 2D (x,)                 |

A key that is not drawn and not given is the scene's own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gns_env.errors import InvalidScenario
from gns_model.scene import Scene

#: Widest range of a scenario: volume as a ratio to the scene's, friction angle as a difference
#: [degrees], speed as a difference in units of the scene's (or of 1 m/s if that is slower).
VOLUME_RATIO, ANGLE_DIFFERENCE, SPEED_DIFFERENCE = 4.0, 20.0, 1.0
#: What `scenarios="random"` draws: shares of the scene's volume and speed, degrees about its
#: friction angle, and shifts as a share of the domain as far as there is room.
RANDOM_VOLUME, RANDOM_SPEED, RANDOM_ANGLE, RANDOM_SHIFT = (0.6, 1.4), (0.6, 1.25), 5.0, 0.1

Range = tuple[float, float]


@dataclass(frozen=True)
class Scenario:
    """What distinguishes one flow on a site from another; see the module."""

    volume: float
    speed: float
    friction_angle: float
    place: tuple[float, ...]


KEYS = tuple(field.name for field in fields(Scenario))


class ScenarioSpace:
    """The scenarios of `scene`.

    Args:
        scene: the site with its own flow.
        ranges: None, every episode is the scene's own flow; "random", the ranges above; or ranges
            (low, high) by key, for `place` one for every axis: the other keys stay.
        limits: what a learned model was trained for (`gns_model.learned.config.Limits`): "random"
            keeps to it. None: no limit.

    Raises:
        InvalidScenario: for an unknown key, or a range that is none or wider than allowed.
    """

    def __init__(
        self, scene: Scene, ranges: str | Mapping[str, Any] | None = None, limits: Any = None
    ) -> None:
        self.scene = scene
        axes = [0, *range(2, scene.dim)]
        self._names = [f"place[{'xyz'[axis]}]" for axis in axes]
        volume = sum(math.prod(r.size) for r in scene.releases)
        speed = max(math.hypot(*r.velocity) for r in scene.releases)
        angle = scene.material.friction_angle
        self.own = Scenario(volume, speed, angle, (0.0,) * len(axes))
        size = np.array(scene.domain.size)[axes]
        self._speed_scale = SPEED_DIFFERENCE * max(speed, 1.0)
        self._half = size / 2
        #: The widest ranges allowed, by name; `place` has one for every axis.
        self.bounds: dict[str, Range] = {
            "volume": (volume / VOLUME_RATIO, volume * VOLUME_RATIO),
            "speed": (max(speed - self._speed_scale, 0.0), speed + self._speed_scale),
            "friction_angle": (max(angle - ANGLE_DIFFERENCE, 1.0), min(angle + 20.0, 89.0)),
            **{n: (-float(h), float(h)) for n, h in zip(self._names, self._half, strict=True)},
        }
        self.usual = self._usual(limits, axes)
        self.ranges: dict[str, Range] = {}
        if isinstance(ranges, str):
            if ranges != "random":
                raise InvalidScenario(
                    f"scenarios must be None, 'random' or ranges by key, got {ranges!r}"
                )
            self.ranges = dict(self.usual)
        elif ranges is not None:
            self.ranges = self._parse(ranges, "scenarios", ranges_only=True)

    def draw(self, rng: np.random.Generator, options: Mapping[str, Any] | None) -> Scenario:
        """A scenario: what `options` of `reset` say, else drawn from the ranges, else the scene's.

        Args:
            rng: decides what is drawn, uniformly.
            options: a number, or a range (low, high) to draw from, by key; "randomise": True draws
                the other keys from the ranges of "random" in this episode, False none of them.

        Raises:
            InvalidScenario: for an unknown key, or a value that is none or out of bounds.
        """
        ranges = self.ranges_with(options)
        values = {
            # low + share * width would round; a number given must come out as given
            name: low if low == high else float(rng.uniform(low, high))
            for name, (low, high) in ranges.items()
        }
        place = tuple(values.pop(n, 0.0) for n in self._names)
        return replace(self.own, place=place, **values)

    def ranges_with(self, options: Mapping[str, Any] | None) -> dict[str, Range]:
        """The ranges of an episode: those of the space, overridden by `options`; see `draw`."""
        ranges = dict(self.ranges)
        if options:
            if not isinstance(options, Mapping):
                raise InvalidScenario(f"options must be a dict, got {options!r}")
            options = dict(options)
            randomise = options.pop("randomise", None)
            if randomise not in (None, True, False):
                raise InvalidScenario(f"randomise must be True or False, got {randomise!r}")
            if randomise is not None:
                ranges = {**self.usual, **ranges} if randomise else {}
            ranges |= self._parse(options, "options", ranges_only=False)
        # In one order, so that the same seed draws the same whatever order the keys came in.
        return {name: ranges[name] for name in self.bounds if name in ranges}

    def apply(self, scenario: Scenario) -> Scene:
        """The scene with the flow of `scenario`.

        Raises:
            SceneError: if a release then leaves the domain or overlaps another.
        """
        if scenario == self.own:
            return self.scene
        scene, own = self.scene, self.own
        scale = (scenario.volume / own.volume) ** (1 / scene.dim)
        releases = []
        for release in scene.releases:
            lower, size = np.array(release.lower), np.array(release.size) * scale
            if scene.dim == 3:
                lower[2] += (release.size[2] - size[2]) / 2
            lower[[0, *range(2, scene.dim)]] += scenario.place
            velocity = np.array(release.velocity)
            if own.speed > 0:
                velocity = velocity * (scenario.speed / own.speed)
            else:
                velocity[0] = scenario.speed
            releases.append(
                {
                    "lower": tuple(lower.round(9).tolist()),
                    "upper": tuple((lower + size).round(9).tolist()),
                    "velocity": tuple(velocity.tolist()),
                }
            )
        material = scene.material.model_copy(update={"friction_angle": scenario.friction_angle})
        return scene.replace(releases=tuple(releases), material=material)

    def observe(self, scenario: Scenario) -> NDArray[np.float32]:
        """The scenario in [-1, 1], 0 for the scene's own, shape (3 + D-1,): see the env's table."""
        own = self.own
        numbers = [
            math.log(scenario.volume / own.volume) / math.log(VOLUME_RATIO),
            (scenario.speed - own.speed) / self._speed_scale,
            (scenario.friction_angle - own.friction_angle) / ANGLE_DIFFERENCE,
            *(np.array(scenario.place) / self._half),
        ]
        return np.clip(np.array(numbers), -1, 1).astype(np.float32)

    def _usual(self, limits: Any, axes: list[int]) -> dict[str, Range]:
        own, scene = self.own, self.scene
        lower = np.array(scene.domain.lower)[axes]
        upper = np.array(scene.domain.upper)[axes]
        low = np.min([np.array(r.lower)[axes] for r in scene.releases], axis=0)
        high = np.max([np.array(r.upper)[axes] for r in scene.releases], axis=0)
        shift = RANDOM_SHIFT * (upper - lower)
        ranges = {
            "volume": (RANDOM_VOLUME[0] * own.volume, RANDOM_VOLUME[1] * own.volume),
            "speed": (RANDOM_SPEED[0] * own.speed, RANDOM_SPEED[1] * own.speed),
            "friction_angle": (
                max(own.friction_angle - RANDOM_ANGLE, 1.0),
                own.friction_angle + RANDOM_ANGLE,
            ),
        }
        if limits is not None and limits.max_speed is not None:
            ranges["speed"] = _within(ranges["speed"], (0.0, limits.max_speed), own.speed)
        if limits is not None and limits.friction_angle is not None:
            angle = ranges["friction_angle"]
            ranges["friction_angle"] = _within(angle, limits.friction_angle, own.friction_angle)
        if limits is not None and limits.release_height is not None:
            height = max(r.upper[1] - scene.base for r in scene.releases)
            most = own.volume * (limits.release_height / height) ** scene.dim
            ranges["volume"] = _within(ranges["volume"], (0.0, most), own.volume)
        for k, name in enumerate(self._names):
            ranges[name] = (
                -float(min(shift[k], low[k] - lower[k])),
                float(min(shift[k], upper[k] - high[k])),
            )
        return ranges

    def _parse(
        self, values: Mapping[str, Any], source: str, *, ranges_only: bool
    ) -> dict[str, Range]:
        if not isinstance(values, Mapping):
            raise InvalidScenario(f"{source} must be a dict, got {values!r}")
        parsed: dict[str, Range] = {}
        for key, value in values.items():
            if key not in KEYS:
                known = ", ".join(KEYS if ranges_only else [*KEYS, "randomise"])
                raise InvalidScenario(f"{source}: unknown key {key!r}; known are {known}")
            if key != "place":
                parsed[key] = self._range(key, value, ranges_only)
                continue
            try:
                parts = list(value)
            except TypeError:
                parts = []
            if len(parts) != len(self._names):
                raise InvalidScenario(
                    f"place needs {len(self._names)} values, {', '.join(self._names)}, "
                    f"got {value!r}"
                )
            for name, part in zip(self._names, parts, strict=True):
                parsed[name] = self._range(name, part, ranges_only)
        return parsed

    def _range(self, name: str, value: Any, ranges_only: bool) -> Range:
        try:
            numbers = np.asarray(value, dtype=float)
        except (TypeError, ValueError):
            numbers = np.array(np.nan)
        single = numbers.shape == () and not ranges_only
        if not (single or numbers.shape == (2,)) or not np.isfinite(numbers).all():
            wanted = "a range (low, high)" if ranges_only else "a number or a range (low, high)"
            raise InvalidScenario(f"{name} needs {wanted}, got {value!r}")
        low, high = (float(v) for v in np.broadcast_to(numbers, 2))
        least, most = self.bounds[name]
        slack = 1e-9 * max(abs(least), abs(most))
        if not least - slack <= low <= high <= most + slack:
            raise InvalidScenario(
                f"{name} = {value!r}: it must be ordered and lie in {least:.4g} to {most:.4g}"
            )
        return low, high


def _within(wanted: Range, limit: Range, own: float) -> Range:
    """`wanted` cut to `limit`; the scene's own value alone if they do not meet."""
    low, high = max(wanted[0], limit[0]), min(wanted[1], limit[1])
    return (low, high) if low <= high else (own, own)

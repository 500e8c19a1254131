"""Measures: what a person reads off a trajectory, in SI units, on NumPy arrays.

These are the hard definitions. Every number in a report comes from here; `smooth_measures` holds
the differentiable twins that steer a gradient. Only moving points count, and should a trajectory
hold a frame that is not finite, the last finite frame before it stands in for the rest.

| measure | definition |
|---|---|
| runout_max | largest front over the frames minus the first; the front is the farthest point |
| runout_p99 | 99th percentile of x in the last frame minus that in the first |
| centroid_travel | mean x in the last frame minus that in the first |
| mass_past_section | share of points with x > scene.control_section in the last frame |
| upstream_depth | largest depth just upstream of a baffle, over baffles and frames |
| overtopping | share of points that were above the plan footprint of a baffle in some frame |
| energy_dissipated | E_0 - E_p - E_k of the last frame, E_0 = E_p + E_k of the first |

The paper's runout is `runout_max`; single grains decide it, so it is reported and never optimised.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from gns_model.errors import SceneError, SimulatorError
from gns_model.footprint import bounding_size, upstream_side
from gns_model.particles import STATIONARY
from gns_model.scene import Scene
from gns_model.trajectory import Trajectory

#: Length along x of the window in which depth is read, upstream of a baffle's face [m].
WINDOW_LENGTH = 0.05
#: The depth is this quantile of the heights in the window, so that a stray grain is not a flow.
DEPTH_QUANTILE = 0.98
#: A window counts when it holds at least this mean depth of material [m].
LEAST_DEPTH = 0.02
#: Width of the windows of a scene that names no size of baffle: the paper's [m].
DEFAULT_WIDTH = 0.15
#: Quantile of x for the runout that is worth comparing.
FRONT_QUANTILE = 0.99
#: A grain on a top face may sit this much below it by round-off and contact [m].
CONTACT_SLACK = 1e-3

#: Names of the entries of `summary`, in order, with their units.
UNITS = {
    "runout_max": "m",
    "runout_p99": "m",
    "centroid_travel": "m",
    "mass_past_section": "-",
    "upstream_depth": "m",
    "overtopping": "-",
    "energy_dissipated": "J",
}


def summary(trajectory: Trajectory) -> dict[str, float]:
    """The measures of the table above, all finite; energy in J, in 2D J per metre of width.

    Raises:
        SimulatorError: if the trajectory has no moving point or no finite first frame.
    """
    x = moving_positions(trajectory)[:, :, 0]
    return {
        "runout_max": float(x.max() - x[0].max()),
        "runout_p99": _quantile(x[-1], FRONT_QUANTILE) - _quantile(x[0], FRONT_QUANTILE),
        "centroid_travel": centroid_travel(trajectory),
        "mass_past_section": float((x[-1] > trajectory.scene.control_section).mean()),
        "upstream_depth": float(upstream_depth_over_time(trajectory).max(initial=0.0)),
        "overtopping": overtopping(trajectory),
        "energy_dissipated": energy_dissipated(trajectory),
    }


# -- how far ---------------------------------------------------------------------------------------


def front_over_time(trajectory: Trajectory, *, quantile: float = 1.0) -> np.ndarray:
    """x of the flow front [m], shape (T,): the farthest point, or a `quantile` of all x."""
    x = moving_positions(trajectory)[:, :, 0]
    front = x.max(axis=1) if quantile >= 1 else np.quantile(x, quantile, axis=1)
    return front.astype(float)


def runout_over_time(trajectory: Trajectory, *, quantile: float = 1.0) -> np.ndarray:
    """Travel of the front since the first frame [m], shape (T,); see `front_over_time`."""
    front = front_over_time(trajectory, quantile=quantile)
    return front - front[0]


def thinned_front_over_time(trajectory: Trajectory, points: int) -> np.ndarray:
    """Expected x of the farthest of `points` material points, drawn at random [m], shape (T,).

    A front is a maximum, and that of fewer points is less far: of every eighth of the points of the
    flume it is 8% short. Two simulations with points of different size are compared by the same
    number of them. With f = points / N the k-th farthest is the farthest drawn with probability
    f (1 - f)^(k - 1), each point drawn or not by itself.
    """
    x = moving_positions(trajectory)[:, :, 0]
    share = min(1.0, points / x.shape[1])
    kept = min(x.shape[1], 1 + int(np.ceil(16 / share)))  # what follows weighs below e^-16
    ordered = -np.partition(-x, kept - 1, axis=1)[:, :kept]
    ordered = -np.sort(-ordered, axis=1).astype(float)
    weight = share * (1 - share) ** np.arange(kept)
    return ordered @ (weight / weight.sum())


def centroid_over_time(trajectory: Trajectory) -> np.ndarray:
    """Centre of mass [m], shape (T, D)."""
    return moving_positions(trajectory).mean(axis=1, dtype=float)


def centroid_travel(trajectory: Trajectory) -> float:
    """How far the centroid has gone along x at the last frame [m]."""
    x = centroid_over_time(trajectory)[:, 0]
    return float(x[-1] - x[0])


def height_over_time(trajectory: Trajectory) -> np.ndarray:
    """H_t of the paper [m], shape (T,): from the base to the highest point."""
    height = moving_positions(trajectory)[:, :, 1].max(axis=1)
    return height.astype(float) - trajectory.scene.base


def normalised_runout(trajectory: Trajectory) -> float:
    """(L_f - L_0) / L_0 of a column against the left wall [-], as in the paper's table.

    L_0 is the nominal length of the release and L_f that of the last frame to the farthest point,
    both from the left wall.
    """
    wall = trajectory.scene.domain.lower[0]
    length = trajectory.scene.front - wall
    return float((front_over_time(trajectory)[-1] - wall - length) / length)


def arrival_time(trajectory: Trajectory, x: float, *, quantile: float = 1.0) -> float | None:
    """When the front first reaches `x` [s], linear between frames; None if it never does."""
    front = front_over_time(trajectory, quantile=quantile)
    there = np.flatnonzero(front >= x)
    if there.size == 0:
        return None
    k = int(there[0])
    if k == 0:
        return float(trajectory.time[0])
    share = (x - front[k - 1]) / (front[k] - front[k - 1])
    return float(trajectory.time[k - 1] + share * (trajectory.time[k] - trajectory.time[k - 1]))


def rest_time(
    trajectory: Trajectory,
    *,
    by: Literal["runout_p99", "runout_max", "kinetic_energy"] = "runout_p99",
    fraction: float = 0.01,
) -> float | None:
    """First time from which the flow counts as at rest [s]; None if it still moves at the end.

    Args:
        by: "runout_p99" or "runout_max": from then on that front stays within `fraction` of its
            total travel of where it ends. "kinetic_energy": from then on the kinetic energy stays
            below `fraction` of the largest that it had.
        fraction: [-]. The definitions differ by some 0.1 s on the paper's flume, whose "rest"
            (0.63 s) was read from pictures of the flow.
    """
    if by == "kinetic_energy":
        energy = kinetic_energy(trajectory)
        moves = energy > fraction * energy.max()
    else:
        runout = runout_over_time(
            trajectory, quantile=FRONT_QUANTILE if by == "runout_p99" else 1.0
        )
        moves = np.abs(runout - runout[-1]) > fraction * np.abs(runout).max()
        # The last frame always agrees with itself, which says nothing about rest.
        moves[-1] = len(moves) > 1 and moves[-2]
    if moves[-1]:
        return None
    last = np.flatnonzero(moves)
    return float(trajectory.time[last[-1] + 1 if last.size else 0])


# -- how deep --------------------------------------------------------------------------------------


def upstream_depth_over_time(
    trajectory: Trajectory,
    *,
    window: float = WINDOW_LENGTH,
    quantile: float = DEPTH_QUANTILE,
    least: float = LEAST_DEPTH,
) -> np.ndarray:
    """Flow depth just upstream of every baffle [m], shape (T, B).

    The depth is the `quantile` of the heights of the points' tops, y - base + spacing / 2, in the
    window face - window <= x <= face, |z - z_c| <= width / 2, and 0 where the window holds less
    material than a layer of `least` [m]. Of a turned baffle `width` is its extent across the flow
    and `face` is, at every z, the x of its upstream side there.

    Without baffles it is the depth of the free flow, shape (T, W): the same in W windows of the
    same plan size that tile the placement area, or the plan downstream of the front if none.
    """
    scene = trajectory.scene
    positions = moving_positions(trajectory)
    frames, plan = len(positions), [0, *range(2, scene.dim)]
    boxes = scene.baffle_boxes()
    if len(boxes) == 0:
        return _tiled_depth(trajectory, positions, window, quantile, least)
    depth = np.zeros((frames, len(boxes)))
    columns = [np.ascontiguousarray(positions[:, :, axis]) for axis in range(scene.dim)]
    for b, (baffle, box) in enumerate(zip(scene.baffles, boxes, strict=True)):
        lower, upper = box[0, plan], box[1, plan]
        lower[0], upper[0] = box[0, 0] - window, box[0, 0]
        size, yaw = baffle.unturned
        inside = np.ones(columns[0].shape, bool)
        for axis, lo, up in zip(plan, lower, upper, strict=True):
            if axis == 0 and yaw:
                face = upstream_side(columns[2], baffle.center, (size[0], size[2]), yaw)
                inside &= columns[0] >= face - window
                inside &= columns[0] <= face
                continue
            inside &= columns[axis] >= lo
            inside &= columns[axis] <= up
        frame = np.nonzero(inside)[0]
        count = least * np.prod(upper - lower) / trajectory.point_volume
        depth[:, b] = _grouped_quantile(
            frame, _heights(trajectory, columns[1][inside]), frames, quantile, count
        )
    return depth


def depth_tiles(scene: Scene, window: float = WINDOW_LENGTH) -> tuple[np.ndarray, np.ndarray, list]:
    """The windows in which the depth of a free flow is read.

    Returns:
        lower corner of their grid in plan [m], shape (D-1,); size of one window [m], shape (D-1,);
        number of windows along each plan axis.
    """
    plan = [0, *range(2, scene.dim)]
    lower = np.array(scene.domain.lower)[plan]
    upper = np.array(scene.domain.upper)[plan]
    lower[0] = min(scene.front, upper[0] - window)
    if scene.placement is not None:
        lower, upper = np.array(scene.placement.lower), np.array(scene.placement.upper)
    try:
        width = scene.baffle_size[2:]
        if scene.dim == 3 and scene.baffle_yaw:
            plan_size = (scene.baffle_size[0], scene.baffle_size[2])
            width = (float(bounding_size(plan_size, scene.baffle_yaw)[1]),)
    except SceneError:
        width = (DEFAULT_WIDTH,) * (scene.dim - 2)
    size = np.array([window, *width])
    counts = np.maximum(1, np.floor((upper - lower) / size + 1e-9)).astype(int)
    # What the whole windows leave over is shared between both ends.
    return lower + (upper - lower - counts * size) / 2, size, counts.tolist()


def _tiled_depth(
    trajectory: Trajectory, positions: np.ndarray, window: float, quantile: float, least: float
) -> np.ndarray:
    scene = trajectory.scene
    lower, size, counts = depth_tiles(scene, window)
    windows = int(np.prod(counts))
    depth = np.zeros((len(positions), windows))
    least_count = least * np.prod(size) / trajectory.point_volume
    for t, frame in enumerate(positions):
        plan = frame[:, [0, *range(2, scene.dim)]]
        cell = np.floor((plan - lower) / size)
        inside = ((cell >= 0) & (cell < counts)).all(axis=1)
        index = np.ravel_multi_index(tuple(cell[inside].astype(int).T), counts)
        depth[t] = _grouped_quantile(
            index, _heights(trajectory, frame[inside, 1]), windows, quantile, least_count
        )
    return depth


def half_spacing(point_volume: float, dim: int) -> float:
    """How far the material of a point reaches above its centre [m].

    Without it a depth would shrink with the spacing of the points, by 4% from the solver's to a
    learned model's.
    """
    return 0.5 * point_volume ** (1 / dim)


def _heights(trajectory: Trajectory, y: np.ndarray) -> np.ndarray:
    """Height [m] of the top of every point; one that blew through a wall counts as being at it."""
    scene = trajectory.scene
    half = half_spacing(trajectory.point_volume, scene.dim)
    return np.clip(y - scene.base + half, 0.0, scene.domain.size[1])


def overtopping(trajectory: Trajectory) -> float:
    """Share of points that in some frame were above the plan footprint of a baffle [-].

    The only way to be there is over the top. 0 without baffles.
    """
    positions = moving_positions(trajectory)
    over = np.zeros(positions.shape[1], bool)
    plan = [0, *range(2, trajectory.scene.dim)]
    columns = [np.ascontiguousarray(positions[:, :, axis]) for axis in range(positions.shape[2])]
    for (lower, upper), turn in zip(*trajectory.scene.oriented_boxes(), strict=True):
        own = _in_frame(columns, lower, upper, turn)
        above = columns[1] >= upper[1] - CONTACT_SLACK
        for axis in plan:
            above &= own[axis] > lower[axis] + CONTACT_SLACK
            above &= own[axis] < upper[axis] - CONTACT_SLACK
        over |= above.any(axis=0)
    return float(over.mean())


def points_inside_baffles(trajectory: Trajectory, *, slack: float = 1e-5) -> int:
    """Points that in some frame were deeper than `slack` [m] inside a baffle: 0 is right."""
    positions = moving_positions(trajectory)
    inside = np.zeros(positions.shape[1], bool)
    columns = [positions[:, :, axis] for axis in range(positions.shape[2])]
    for (lower, upper), turn in zip(*trajectory.scene.oriented_boxes(), strict=True):
        deep = np.ones(positions.shape[:2], bool)
        for axis, values in enumerate(_in_frame(columns, lower, upper, turn)):
            deep &= values > lower[axis] + slack
            deep &= values < upper[axis] - slack
        inside |= deep.any(axis=0)
    return int(inside.sum())


def _in_frame(
    columns: list[np.ndarray], lower: np.ndarray, upper: np.ndarray, turn: np.ndarray
) -> list[np.ndarray]:
    """Coordinates x, y and z in the frame of a box turned about the vertical through its middle."""
    cosine, sine = turn
    if sine == 0:
        return columns
    middle = (lower + upper) / 2
    x, z = columns[0] - middle[0], columns[2] - middle[2]
    return [middle[0] + cosine * x + sine * z, columns[1], middle[2] + cosine * z - sine * x]


# -- energy ----------------------------------------------------------------------------------------


def potential_energy(trajectory: Trajectory) -> np.ndarray:
    """E_p = -sum m g . (p - lower corner of the domain) [J], shape (T,); sum m g h when level."""
    scene = trajectory.scene
    arm = centroid_over_time(trajectory) - np.array(scene.domain.lower)
    return -_mass(trajectory) * arm @ np.array(scene.gravity)


def kinetic_energy(trajectory: Trajectory) -> np.ndarray:
    """E_k = 1/2 sum m v^2 [J], shape (T,).

    v of the first frame is that of the releases, of the last a backward difference and of all
    others a central one, so a point that hits something between frames counts with its mean.
    """
    energies = [_kinetic(trajectory, t) for t in range(len(trajectory.time))]
    return np.array(energies)


def energy_dissipated(trajectory: Trajectory) -> float:
    """E_d = E_0 - E_p(T) - E_k(T) [J] with E_0 = E_p(0) + E_k(0)."""
    potential = potential_energy(trajectory)
    lost = _kinetic(trajectory, 0) - _kinetic(trajectory, len(trajectory.time) - 1)
    return float(potential[0] - potential[-1] + lost)


def _kinetic(trajectory: Trajectory, t: int) -> float:
    positions, time = moving_positions(trajectory), trajectory.time
    if t == 0:
        velocity = release_velocity(trajectory.scene, positions[0])
    else:
        after = min(t + 1, len(time) - 1)
        velocity = (positions[after] - positions[t - 1]) / float(time[after] - time[t - 1])
    square = np.square(velocity, dtype=float).sum()
    return float(0.5 * trajectory.point_mass * square)


def release_velocity(scene: Scene, positions: np.ndarray) -> np.ndarray:
    """Velocity [m/s] that points at `positions` [m], (N, D), start with, shape (N, D).

    A point belongs to the release nearest to it.
    """
    distances = [
        np.linalg.norm(positions - np.clip(positions, r.lower, r.upper), axis=1)
        for r in scene.releases
    ]
    owner = np.argmin(distances, axis=0)
    return np.array([r.velocity for r in scene.releases])[owner]


def _mass(trajectory: Trajectory) -> float:
    return trajectory.point_mass * moving_positions(trajectory).shape[1]


# -- against another -------------------------------------------------------------------------------


def position_error(trajectory: Trajectory, reference: Trajectory) -> np.ndarray:
    """Mean over points of |p - p_reference|^2 at every frame of `trajectory` [m^2], shape (T,).

    The reference is interpolated linearly to the times of `trajectory`.

    Raises:
        SimulatorError: if the two do not follow the same number of points, or the reference ends
            first.
    """
    a, b = moving_positions(trajectory), moving_positions(reference)
    if a.shape[1:] != b.shape[1:]:
        raise SimulatorError(
            f"cannot compare points: {a.shape[1]} of {trajectory.simulator!r} against "
            f"{b.shape[1]} of {reference.simulator!r}"
        )
    time, known = np.asarray(trajectory.time, float), np.asarray(reference.time, float)
    if time[0] < known[0] - 1e-6 or time[-1] > known[-1] + 1e-6:
        raise SimulatorError(
            f"the reference covers {known[0]:g} to {known[-1]:g} s, not {time[0]:g} to {time[-1]:g}"
        )
    place = np.interp(time, known, np.arange(len(known)))
    error = np.empty(len(time))
    for t, where in enumerate(place):
        k = min(int(where), len(known) - 1)
        share = where - k
        there = b[k] if share == 0 else (1 - share) * b[k] + share * b[k + 1]
        error[t] = np.square(a[t] - there, dtype=float).sum(axis=1).mean()
    return error


def moving_positions(trajectory: Trajectory) -> np.ndarray:
    """Positions of the moving points [m], shape (T, M, D), finite.

    Raises:
        SimulatorError: if no point moves, or the first frame is not finite.
    """
    positions, moving = trajectory.positions, trajectory.particle_type != STATIONARY
    if not moving.any() or len(positions) == 0:
        raise SimulatorError(f"a trajectory of {trajectory.simulator!r} holds no moving point")
    if not moving.all():
        positions = positions[:, moving]
    # A sum is several times cheaper than isfinite over everything, and NaN and inf survive it.
    if not math.isfinite(positions.sum(dtype=float)):
        finite = np.isfinite(positions).all(axis=(1, 2))
        if not finite[0]:
            raise SimulatorError(
                f"the first frame of a trajectory of {trajectory.simulator!r} is not finite"
            )
        if not finite.all():
            good = int(np.argmin(finite))
            positions = positions.copy()
            positions[good:] = positions[good - 1]
    return positions


def _quantile(values: np.ndarray, q: float) -> float:
    return float(np.quantile(values.astype(float), q))


def _grouped_quantile(
    group: np.ndarray, values: np.ndarray, groups: int, q: float, least: float
) -> np.ndarray:
    """The q-quantile of `values` in every group, linear as NumPy's; 0 in groups of under `least`.

    One sort of a joint key does all groups at once: a call of np.quantile for each would cost more
    than everything else here.
    """
    if len(values) == 0:
        return np.zeros(groups)
    low = float(values.min())
    width = float(values.max()) - low + 1.0
    ordered = np.sort(group * width + (values - low))
    count = np.bincount(group, minlength=groups)
    start = np.cumsum(count) - count
    place = q * np.maximum(count - 1, 0)
    below = np.floor(place).astype(int)
    above = np.minimum(below + 1, np.maximum(count - 1, 0))
    last = len(ordered) - 1
    first, second = (ordered[np.minimum(start + k, last)] for k in (below, above))
    quantile = first + (place - below) * (second - first) - np.arange(groups) * width + low
    # A little slack, so that a window exactly at the limit does not hang on round-off.
    return np.where(count >= max(least * (1 - 1e-9), 1), quantile, 0.0)

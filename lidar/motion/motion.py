"""Speed profiles along paths, and the trajectories that follow from them."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.support.columns import Columns
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.geometry.attitude import quat_from_euler
from lidar.geometry.poses import Trajectory
from lidar.motion.path import Path
from lidar.motion.vehicle import Vehicle

RATE_HZ = 100.0
"""Poses of a trajectory per second."""
DWELL_S = 1.0
"""Seconds at rest at every stop between legs, for steering and gear changes, and at the end of a route."""
_AT_REST = 0.01  # m/s, below which a vehicle has come to rest
_SLOWEST = 0.3  # m/s, minimum of the speed limit that bends impose
_SPARE = 0.98  # share of the acceleration limits used, a margin for sampling
_BRIEF_S = 0.3  # seconds of the second moving average, which smooths the jerk
_FIT = 40
_ROWS = 65


@dataclass(frozen=True, slots=True)
class Motion(Columns):
    """A speed profile: progress along a path at an even rate.

    time_ns : (n,) int64
    s       : (n,) true metres along the path
    speed, acceleration : (n,) m/s, m/s^2, along the path
    row     : (n,) int64, the last row of the path passed
    """

    time_ns: NDArray[np.int64]
    s: Float
    speed: Float
    acceleration: Float
    row: NDArray[np.int64]


def drive_path(
    path: Path,
    vehicle: Vehicle,
    *,
    duration: float | None = None,
    at_speed: bool = False,
) -> Trajectory:
    """The trajectory of a vehicle along a path, from rest to rest, in the scene frame; 100 poses per second.

    duration : maximum seconds; on a longer path the vehicle stops in time
    at_speed : the vehicle is at speed at the start, and after ``duration``; it still stops at the path's end

    The speed stays within speed limits and the vehicle's lateral acceleration, acceleration, deceleration and
    jerk. The body's x axis is along the path at the rear axle, apart from roll and pitch under acceleration.
    Raises InputError for a duration that is not positive.
    """
    motion = motion_along(path, vehicle, duration=duration, at_speed=at_speed)
    return poses_along(path, vehicle, motion=motion)


def motion_along(
    path: Path, vehicle: Vehicle, *, duration: float | None = None, at_speed: bool = False
) -> Motion:
    """The fastest speed profile along a path within all limits; arguments as for `drive_path`."""
    if duration is not None and not duration > 0:
        raise InputError("the duration of a drive must be positive")
    limit, dt = speed_limits(path, vehicle), 1.0 / RATE_HZ
    s, v, leg = _all_legs(path, limit, vehicle=vehicle, dt=dt, at_speed=at_speed)
    if duration is not None and len(s) * dt > duration:
        if at_speed:
            count = max(round(duration / dt), 1) + 1
            s, v, leg = s[:count], v[:count], leg[:count]
        else:
            s, v, leg = _within(path, limit, vehicle=vehicle, dt=dt, duration=duration)
    acceleration = np.gradient(v, dt) if len(s) > 1 else np.zeros(len(s))
    first = np.searchsorted(path.leg, leg, side="left")
    last = np.searchsorted(path.leg, leg, side="right") - 1
    row = np.clip(np.searchsorted(path.s, s, side="right") - 1, first, last)
    return Motion(even_times(len(s)), s, v, acceleration, row)


def even_times(count: int) -> NDArray[np.int64]:
    """Times (count,) in nanoseconds, `RATE_HZ` of them per second."""
    return np.round(np.arange(count) * (1e9 / RATE_HZ)).astype(np.int64)


def ended_at_rest(motion: Motion) -> Motion:
    """A speed profile that ends `DWELL_S` after the vehicle has come to rest for the last time."""
    step = int(motion.time_ns[1] - motion.time_ns[0])
    moving = np.flatnonzero(motion.speed > _AT_REST)
    count = (int(moving[-1]) if len(moving) else 0) + 1 + round(DWELL_S * 1e9 / step)
    more = max(count - len(motion.s), 0)
    return Motion(
        np.arange(count) * step,
        np.append(motion.s[:count], np.full(more, motion.s[-1])),
        np.append(motion.speed[:count], np.zeros(more)),
        np.append(motion.acceleration[:count], np.zeros(more)),
        np.append(motion.row[:count], np.full(more, motion.row[-1])),
    )


def speed_limits(path: Path, vehicle: Vehicle) -> Float:
    """Speed (n,) in m/s that speed limits, bends, crests and steering rate allow along a path."""
    bend = np.abs(path.curvature)
    wheel, crest = (np.abs(_along(path, column)) for column in (path.curvature, _soften(path, vehicle)))
    with np.errstate(divide="ignore", over="ignore"):  # a straight allows any speed
        by_bend = np.sqrt(_SPARE * vehicle.lateral_acceleration / bend)
        by_wheel = np.cbrt(_SPARE * vehicle.lateral_jerk / wheel)
        by_crest = np.sqrt(_SPARE * vehicle.lateral_acceleration / crest)
    beside = np.minimum(np.append(path.limit[1:], np.inf), np.append(np.inf, path.limit[:-1]))
    posted = np.minimum(vehicle.pace * np.minimum(path.limit, beside), vehicle.max_speed)
    allowed = np.minimum(posted, np.minimum(by_bend, np.minimum(by_wheel, by_crest)))
    return np.asarray(np.maximum(allowed, _SLOWEST))


def _soften(path: Path, vehicle: Vehicle) -> Float:
    """Slopes (n,) smoothed over the wheelbase: shorter bumps do not raise the body."""
    from scipy.ndimage import gaussian_filter1d  # noqa: PLC0415  (slow to import)

    out = np.empty(len(path))
    over = vehicle.turning_radius if vehicle.kind == "air" else max(vehicle.wheelbase, 1.0)
    for first, last in legs_of(path):
        gap = (path.s[last - 1] - path.s[first]) / max(last - first - 1, 1)
        out[first:last] = gaussian_filter1d(path.slope[first:last], over / max(gap, 1e-6), mode="nearest")
    return out


def _along(path: Path, values: Float) -> Float:
    """Derivative of a column along the path, leg by leg."""
    out = np.zeros(len(path))
    for first, last in legs_of(path):
        if last - first > 1:
            out[first:last] = np.gradient(values[first:last], path.s[first:last])
    return out


def legs_of(path: Path) -> list[tuple[int, int]]:
    """First and last row (exclusive) of each leg."""
    cuts = [0, *(np.flatnonzero(np.diff(path.leg)) + 1).tolist(), len(path)]
    return list(itertools.pairwise(cuts))


def _all_legs(
    path: Path, limit: Float, *, vehicle: Vehicle, dt: float, at_speed: bool = False
) -> tuple[Float, Float, NDArray[np.int32]]:
    """Distance, speed and leg at every ``dt`` of the whole path, with a rest between legs.

    at_speed : it is at speed at the start
    """
    s: list[Float] = []
    v: list[Float] = []
    leg: list[NDArray[np.int32]] = []
    rest = round(DWELL_S / dt)
    for first, last in legs_of(path):
        at_rest = (not vehicle.cruise and not (at_speed and not first), not vehicle.cruise)
        ds, dv = _time_law(
            path.s[first:last] - path.s[first], limit[first:last], vehicle=vehicle, dt=dt, rest=at_rest
        )
        if s:
            ds, dv = np.concatenate([np.zeros(rest), ds[1:]]), np.concatenate([np.zeros(rest), dv[1:]])
        s.append(path.s[first] + ds)
        v.append(dv)
        leg.append(np.full(len(ds), path.leg[first], np.int32))
    return np.concatenate(s), np.concatenate(v), np.concatenate(leg)


def _within(
    path: Path, limit: Float, *, vehicle: Vehicle, dt: float, duration: float
) -> tuple[Float, Float, NDArray[np.int32]]:
    """As `_all_legs`, along as much of the path as fits ``duration``, and then at rest."""

    def until(row: int) -> tuple[Float, Float, NDArray[np.int32]]:
        return _all_legs(path.take(slice(0, row + 1)), limit[: row + 1], vehicle=vehicle, dt=dt)

    # upper bound: the undisturbed drive gets here in that time, one that stops ends a little before
    s, _, _ = _all_legs(path, limit, vehicle=vehicle, dt=dt)
    low, high = 1, int(np.searchsorted(path.s, s[round(duration / dt)]))
    best, back = until(1), 64
    while low < high:
        row = max(high - back, (low + high + 1) // 2)
        law = until(row)
        if len(law[0]) * dt <= duration:
            low, best = row, law
        else:
            high, back = row - 1, 2 * back
    rest = max(round(duration / dt) + 1 - len(best[0]), 0)
    s, v, leg = best
    return (
        np.append(s, np.full(rest, s[-1])),
        np.append(v, np.zeros(rest)),
        np.append(leg, np.full(rest, leg[-1])),
    )


def _time_law(
    s: Float, limit: Float, *, vehicle: Vehicle, dt: float, rest: tuple[bool, bool]
) -> tuple[Float, Float]:
    """Distance and speed at every ``dt`` of a leg; ``rest``: whether it starts and ends at rest.

    The fastest profile under the limits and the accelerations (a forward and a backward pass) is averaged
    over a window in time. An average of speeds keeps the bounds of their accelerations, and its acceleration
    changes by no more than acceleration plus deceleration per window: the jerk. Where the average is faster
    than the limit of the place reached by then, the limit is lowered and the profile made again.
    """
    up, down, jerk = (_SPARE * v for v in (vehicle.acceleration, vehicle.deceleration, vehicle.jerk))
    length = float(s[-1])
    if length < 1e-6:
        return np.zeros(2), np.zeros(2)
    half = max(math.ceil((up + down) / jerk / dt / 2), 1)
    window, brief = 2 * half + 1, 2 * max(round(_BRIEF_S / dt / 2), 1) + 1
    if len(s) < _ROWS:  # speeds between rows are not checked
        at = np.linspace(0.0, length, _ROWS)
        s, limit = at, np.interp(at, s, limit)
    lowered = limit
    for _ in range(_FIT):
        far, speed = _smooth_profile(s, lowered, bounds=(up, down), windows=(window, brief), dt=dt, rest=rest)
        excess = speed / np.interp(far, s, limit)
        if excess.max() <= 1.0:
            return far, speed
        lowered = _lower_limits(lowered, s, far=far, excess=excess, reach=speed * (half * dt))
    # stretch time by the remaining excess, so that all limits hold
    old = np.arange(len(far))
    moment = np.linspace(0.0, old[-1], math.ceil(old[-1] * excess.max()) + 1)
    return np.interp(moment, old, far), np.interp(moment, old, speed) * (len(old) - 1) / (len(moment) - 1)


def _smooth_profile(
    s: Float,
    limit: Float,
    *,
    bounds: tuple[float, float],
    windows: tuple[int, int],
    dt: float,
    rest: tuple[bool, bool],
) -> tuple[Float, Float]:
    """Distance and speed at every ``dt``: the fastest profile, averaged over two windows in time."""
    v = _fastest(s, limit, up=bounds[0], down=bounds[1], rest=rest)
    t = np.concatenate([[0.0], np.cumsum(np.diff(s) / np.maximum((v[1:] + v[:-1]) / 2, 1e-3))])
    raw = np.interp(dt * np.arange(math.ceil(t[-1] / dt) + 1), t, v)
    reach = sum(windows) // 2 - 1
    if rest[1]:
        raw[-1] = 0.0
    # the averages of a drive from rest to rest reach beyond both of its ends
    before, behind = (
        np.zeros(2 * reach) if still else np.full(reach, edge)
        for still, edge in zip(rest, raw[[0, -1]], strict=True)
    )
    pad = np.concatenate([before, raw, behind])
    speed = np.maximum(_average(_average(pad, windows[0]), windows[1]), 0.0)
    for still, end in zip(rest, (0, -1), strict=True):
        if still:
            speed[end] = 0.0
    far = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) * (dt / 2))])
    short = float(s[-1]) - far[-1]
    if short > 0 and rest == (False, True):  # a drive at speed may start a little further on
        return far + short, speed
    stretch = float(s[-1]) / far[-1]
    return far * stretch, speed * stretch


def _average(values: Float, window: int) -> Float:
    """Running means (n - window + 1,) of values (n,)."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    mean: Float = (total[window:] - total[:-window]) / window
    return mean


def _lower_limits(lowered: Float, s: Float, *, far: Float, excess: Float, reach: Float) -> Float:
    """Limits lowered where a profile exceeded them, within ``reach`` metres of each place."""
    over = np.flatnonzero(excess > 1.0)
    out = lowered.copy()
    lo = np.searchsorted(s, far[over] - 0.5 * reach[over] - 0.5)
    hi = np.searchsorted(s, far[over] + 0.5 * reach[over] + 0.5, side="right")
    # one pass per run of consecutive samples
    cuts = np.flatnonzero(np.diff(over) > 1) + 1
    for group in np.split(np.arange(len(over)), cuts):
        a, b = int(lo[group].min()), int(hi[group].max())
        factor = 1.0 / min(float(excess[over[group]].max()) + 0.002, 1.5)
        out[a:b] = np.minimum(out[a:b], np.maximum(lowered[a:b] * factor, 0.05))
    return out


def _fastest(s: Float, limit: Float, *, up: float, down: float, rest: tuple[bool, bool]) -> Float:
    """The highest speeds (n,) at distances s under a limit and accelerations up and down."""
    square = limit**2
    for still, end in zip(rest, (0, -1), strict=True):
        if still:
            square[end] = 0.0
    ahead = np.minimum.accumulate(square - 2 * up * s) + 2 * up * s
    back = np.minimum.accumulate((ahead + 2 * down * s)[::-1])[::-1] - 2 * down * s
    return np.sqrt(np.maximum(back, 0.0))


def poses_along(path: Path, vehicle: Vehicle, *, motion: Motion) -> Trajectory:
    """The trajectory of a speed profile along a path; cubic between rows, so velocity is continuous."""
    from scipy.interpolate import CubicHermiteSpline  # noqa: PLC0415  (slow to import)

    n = len(motion.s)
    position, heading = np.empty((n, 3)), np.empty(n)
    columns = {name: np.empty(n) for name in ("slope", "pitch", "bank", "scale", "curvature")}
    gear = path.gear[motion.row].astype(float)
    leg = path.leg[motion.row]
    for first, last in legs_of(path):
        here = leg == path.leg[first]
        if not here.any():
            continue
        s, p = motion.s[here], path.take(slice(first, last))
        run = np.cos(p.slope) * p.scale * p.gear
        tangent = np.column_stack(
            [run * np.cos(p.heading), run * np.sin(p.heading), np.sin(p.slope) * p.gear]
        )
        position[here] = CubicHermiteSpline(p.s, p.position, tangent)(s)
        heading[here] = CubicHermiteSpline(p.s, p.heading, p.curvature * np.cos(p.slope))(s)
        for name, column in columns.items():
            column[here] = np.interp(s, p.s, getattr(p, name))
    v = motion.speed * gear
    flat = np.cos(columns["slope"])
    velocity = np.column_stack(
        [v * flat * np.cos(heading), v * flat * np.sin(heading), v * np.sin(columns["slope"])]
    )
    across = motion.speed**2 * columns["curvature"] * gear
    roll = columns["bank"] + vehicle.roll_gradient * across
    pitch = -vehicle.pitch_gradient * motion.acceleration * gear
    if vehicle.kind != "air" or vehicle.cruise:  # multicopters climb level
        pitch = pitch - columns["pitch"]
    if any(vehicle.bob):
        shift = _gait(motion, vehicle, heading=heading)
        seconds = motion.time_ns * 1e-9
        velocity = velocity + np.gradient(shift, seconds, axis=0)
        position = position + shift * np.column_stack([columns["scale"], columns["scale"], np.ones(n)])
    return Trajectory(
        motion.time_ns, position, quat_from_euler(roll, pitch, gamma=heading), velocity, columns["scale"]
    )


def _gait(motion: Motion, vehicle: Vehicle, *, heading: Float) -> Float:
    """True metres (n, 3) along the scene's axes by which a walker's body is off its path, step by step.

    The body rises once a step and sways to one side and the other in two, in proportion to its speed.
    """
    sway, rise, steps = vehicle.bob
    phase = 2 * np.pi * steps / vehicle.max_speed * motion.s
    share = motion.speed / vehicle.max_speed
    left, up = sway * share * np.sin(phase / 2), rise * share * (1 - np.cos(phase)) / 2
    return np.column_stack([-np.sin(heading) * left, np.cos(heading) * left, up])

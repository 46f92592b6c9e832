"""Smoothest speed profile that never overtakes a given one, such as that of a traffic simulation.

Signals, queues and other traffic give an upper bound of the distance driven at each time. The profile
maximises the sum of distances below it, within the limits of speed, acceleration and jerk: a linear programme
over even time steps, whose unknowns are the accelerations at the steps, linear in between. Speed limits
depend on the position; they are looked up at the last solution, and the programme is solved again. Windows
of time are solved one after another.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from geoscene.typing import Float, Ints
from lidar.errors import InputError
from lidar.motion.motion import DWELL_S, RATE_HZ, Motion, even_times, legs_of, speed_limits
from lidar.motion.path import Path
from lidar.motion.vehicle import Vehicle

STEP_S = 0.2
"""Seconds between the knots of a motion."""
_SPARE = 0.98  # share of the acceleration limits used, a margin for sampling
_COMFORT = 0.8  # share of the deceleration used before lower speed limits
_AGAIN = 8  # maximum number of solutions of a window
_WINDOW, _KEPT, _BEYOND = 200, 50, 35
"""Steps of a window, those that are kept, and those behind them in which limits hold too: time to brake."""
_GAP = 0.25  # metres between the places at which limits are looked up
_FAST_COST = 1e3  # metres that a m/s above the limit costs in a step
_AT_REST = 1e-3  # m/s
_SLACK = 0.005  # share of a speed limit by which a solution may exceed it
_TAIL_S = 10.0  # seconds that a leg may take longer than on an empty road
_SETTLING_S = 10.0  # seconds over which a profile that starts at speed falls behind by one step
_NEAR = 0.05  # metres from its end at which a leg is complete
_AROUND = 1.0  # metres before and after a position whose speed limits count


@dataclass(frozen=True, slots=True)
class _Knots:
    """A profile at steps ``dt`` seconds apart: metres, m/s and m/s^2; acceleration is linear in between."""

    s: Float
    v: Float
    a: Float
    dt: float


def motion_within(
    path: Path,
    vehicle: Vehicle,
    *,
    time_s: Float,
    max_distance: Float,
    at_speed: bool = False,
) -> Motion:
    """The speed profile along a path, from rest to rest, that never exceeds given distances.

    time_s    : (k,) rising seconds from 0
    max_distance : (k,) metres along the path at these times, not decreasing
    at_speed : the vehicle is at speed at the start and at the last time

    It ends at the last time or at the end of the path. Raises InputError for decreasing distances.
    """
    if len(time_s) < 2 or (np.diff(max_distance) < -1e-9).any():
        raise InputError("the maximum distances of a speed profile must not decrease")
    limit = speed_limits(path, vehicle)
    parts: list[tuple[Float, Float, Ints]] = []
    begin, dt, total = 0.0, 1.0 / RATE_HZ, float(time_s[-1])
    for first, last in legs_of(path):
        if parts and total - begin < 2 * STEP_S:
            break
        origin, end = float(path.s[first]), float(path.s[last - 1])
        allowed = np.clip(max_distance, origin, end) - origin
        there = np.flatnonzero(allowed >= end - origin - 1e-6)
        s = path.s[first:last] - origin
        needed = _TAIL_S + 1.5 * float((np.diff(s) / limit[first : last - 1]).sum())
        until = max(float(time_s[there[0]]) - begin, 0.0) + needed if len(there) else math.inf
        t = STEP_S * np.arange(max(math.floor(min(total - begin, until) / STEP_S), 2) + 1)
        rolls = at_speed and not parts
        # each step is bounded by the distance allowed one step before, so all times in between are too
        late = STEP_S * np.minimum(t / _SETTLING_S, 1.0) if rolls else STEP_S
        bounds = np.interp(begin + t - late, time_s, allowed)
        still = (not rolls, not at_speed or until < total - begin)
        knots = _best(s, limit[first:last], vehicle=vehicle, allowed=bounds, rest=still)
        s, v = _sample(knots, end - origin, dt=dt)
        driven = s[-1] > end - origin - 2 * _NEAR
        if driven and last < len(path):
            rest = round(DWELL_S / dt)
            s, v = np.append(s, np.full(rest, s[-1])), np.append(v, np.zeros(rest))
        s = origin + s
        row = np.clip(np.searchsorted(path.s, s, side="right") - 1, first, last - 1)
        parts.append((s, v, row))
        begin += len(s) * dt
        if not driven:
            break
    s, v, row = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Motion(even_times(len(s)), s, v, np.gradient(v, dt), row)


def desired_speed(path: Path, vehicle: Vehicle) -> Float:
    """Desired speed (n,) in m/s along a path: comfortable braking, rest at the end of each leg."""
    limit = speed_limits(path, vehicle)
    out = np.empty(len(limit))
    for first, last in legs_of(path):
        limit[last - 1] = 0.0
        out[first:last] = _limit_braking(path.s[first:last], limit[first:last], vehicle=vehicle)
    return out


def _limit_braking(s: Float, limit: Float, *, vehicle: Vehicle) -> Float:
    """Speed limits (n,) at distances (n,), lowered for comfortable braking before lower ones."""
    by = 2 * _COMFORT * vehicle.deceleration
    lowest = np.minimum.accumulate((limit**2 + by * s)[::-1])[::-1]
    speed: Float = np.sqrt(np.maximum(lowest - by * s, 0.0))
    return speed


@dataclass(frozen=True, slots=True)
class _Limits:
    """Speed limits in m/s every `_GAP` metres of a leg: as they are, and with comfortable braking before."""

    place: Float
    strict: Float
    cautious: Float

    def at(self, s: Float) -> Float:
        """Cautious limits (n,) at distances (n,)."""
        return np.interp(s, self.place, self.cautious)

    def excess(self, s: Float, *, v: Float) -> float:
        """Largest ratio of speeds (n,) to the limits at distances (n,)."""
        return float((v / np.interp(s, self.place, self.strict)).max())


def _limits(s: Float, limit: Float, *, vehicle: Vehicle) -> _Limits:
    from scipy.ndimage import minimum_filter1d  # noqa: PLC0415

    place = _GAP * np.arange(math.ceil((s[-1] + _GAP) / _GAP))
    strict = np.interp(place, s, limit)
    least = minimum_filter1d(strict, 2 * round(_AROUND / _GAP) + 1)
    return _Limits(place, strict, _limit_braking(place, least, vehicle=vehicle))


def _best(s: Float, limit: Float, *, vehicle: Vehicle, allowed: Float, rest: tuple[bool, bool]) -> _Knots:
    """The best profile along a leg that never exceeds ``allowed`` (k,) metres.

    rest : whether the vehicle is at rest at the start, and at the end

    It is solved in windows of time, each from a state within the one before: the limits at a place can be
    looked up only where the time of arrival there is known.
    """
    limits, n = _limits(s, limit, vehicle=vehicle), len(allowed)
    knots, excess, first = np.zeros((3, n)), 1.0, 0
    start: tuple[float, ...] = (0.0, 0.0, 0.0) if rest[0] else (0.0,)
    while first < n - 1:
        ends = first + _WINDOW >= n - 1
        part, over = _in_window(
            limits,
            allowed[first : first + _WINDOW + 1],
            vehicle=vehicle,
            start=start,
            ends=ends,
            rests=ends and rest[1],
        )
        kept = part if ends else part[:, : _KEPT + 1]
        knots[:, first : first + kept.shape[1]] = kept
        excess, first = max(excess, over), first + kept.shape[1] - 1
        start = tuple(knots[:, first].tolist())
        if rest[1] and start[0] > s[-1] - _NEAR and start[1] < _AT_REST:
            knots[0, first:] = start[0]
            break
    # stretch time by the remaining excess, so that all limits hold
    return _Knots(knots[0], knots[1] / excess, knots[2] / excess**2, STEP_S * excess)


def _in_window(
    limits: _Limits, allowed: Float, *, vehicle: Vehicle, start: tuple[float, ...], ends: bool, rests: bool
) -> tuple[Float, float]:
    """Distances, speeds and accelerations (3, k) of the best profile in a window, and its excess of speed.

    start : distance, or distance, speed and acceleration at the first knot
    ends  : the window is the last, so that all of it counts
    rests : the vehicle is at rest at its end
    """
    counts = len(allowed) if ends else _KEPT + _BEYOND
    speed = start[1] if len(start) > 1 else float(limits.at(np.array(start[:1]))[0])
    near = _reachable(allowed, limits, vehicle=vehicle, start=(start[0], speed))
    if len(start) == 1:  # any state that follows ``near``
        allowed = near
    cap = limits.at(near)
    for _ in range(_AGAIN):
        s, v, a = _solve(vehicle, allowed, cap=cap, start=start, rests=rests)
        excess = limits.excess(s[:counts], v=v[:counts])
        if excess <= 1.0 + _SLACK:
            break
        cap = limits.at(s)
    return np.stack([s, v, a]), excess


def _reachable(allowed: Float, limits: _Limits, *, vehicle: Vehicle, start: tuple[float, float]) -> Float:
    """Distances (k,) behind those allowed that are reached under speed limits and the vehicle's acceleration.

    start : metres and m/s at the first of them

    They are near the solution, so that the limits found there are about those of the solution.
    """
    out = np.empty_like(allowed)
    s, v = start
    near = int(s / _GAP)
    table = limits.cautious[near : int(max(s, float(allowed.max())) / _GAP) + 1].tolist()
    most = len(table) - 1
    out[0] = s
    for k, bound in enumerate(allowed[1:].tolist(), 1):
        v = min(v + _SPARE * vehicle.acceleration * STEP_S, table[min(int(s / _GAP) - near, most)])
        ahead = max(min(s + v * STEP_S, bound), s)
        s, v = ahead, (ahead - s) / STEP_S
        out[k] = s
    return out


def _solve(
    vehicle: Vehicle, allowed: Float, *, cap: Float, start: tuple[float, ...], rests: bool
) -> list[Float]:
    """The linear programme: greatest sum of distances under those allowed and caps (k,) on speed.

    Speeds above the caps cost much more than they gain: caps may be out of reach of the state at the start.
    """
    from scipy.optimize import linprog  # noqa: PLC0415
    from scipy.sparse import csr_array, diags_array, hstack, vstack  # noqa: PLC0415

    n, dt = len(allowed), STEP_S
    m = n - 1
    here = diags_array([np.ones(m)], offsets=[0], shape=(m, n))
    change = diags_array([-np.ones(m), np.ones(m)], offsets=[0, 1], shape=(m, n))
    each = diags_array([np.ones(n)], offsets=[0], shape=(n, n))
    following = here + change
    none, nothing = csr_array((m, n)), csr_array((n, n))
    # acceleration is linear in a step: speed and distance follow from it
    speeds = hstack([none, change, -dt / 2 * (here + following), none])
    places = hstack([change, -dt * here, -(dt**2) * (here / 3 + following / 6), none])
    jerks = hstack([none, none, change, none])
    # and speed, a parabola in a step, is not below the third of its control values: never backwards
    forwards = hstack([none, here, dt / 2 * here, none])
    caps = hstack([nothing, each, nothing, -each])
    up, down, jerk = (_SPARE * v for v in (vehicle.acceleration, vehicle.deceleration, vehicle.jerk))
    low = np.concatenate([np.zeros(2 * n), np.full(n, -down), np.zeros(n)])
    high = np.concatenate([np.maximum(allowed, 0.0), np.full(n, np.inf), np.full(n, up), np.full(n, np.inf)])
    first = np.arange(len(start)) * n
    low[first] = high[first] = start
    if rests:
        low[[2 * n - 1, 3 * n - 1]] = high[[2 * n - 1, 3 * n - 1]] = 0.0
    programme: dict[str, Any] = {
        "c": np.concatenate([-np.ones(n), np.zeros(2 * n), np.full(n, _FAST_COST)]),
        "A_ub": vstack([jerks, -jerks, -forwards, caps]),
        "b_ub": np.concatenate([np.full(2 * m, jerk * dt), np.zeros(m), cap]),
        "A_eq": vstack([speeds, places]),
        "b_eq": np.zeros(2 * m),
        "bounds": np.column_stack([low, high]),
    }
    for presolve in (True, False):  # it is faster, and fails in rare cases near rest
        found = linprog(**programme, method="highs-ds", options={"presolve": presolve})
        if found.status == 0:
            break
    else:
        raise InputError(f"no speed profile satisfies the maximum distances: {found.message}")
    s, v, a, _ = np.split(found.x, 4)
    return [s, np.maximum(v, 0.0), a]


def _sample(knots: _Knots, end: float, *, dt: float) -> tuple[Float, Float]:
    """Distance and speed at every ``dt`` until the knots end, or the vehicle rests at the end of its leg."""
    last = len(knots.s) - 1
    resting = np.flatnonzero((knots.s > end - _NEAR) & (knots.v < _AT_REST))
    if len(resting):
        last = int(resting[0])
    t = dt * np.arange(math.ceil((last * knots.dt + 1e-9) / dt))
    i = np.minimum((t / knots.dt).astype(int), len(knots.s) - 2)
    u = t - i * knots.dt
    jerk = (knots.a[i + 1] - knots.a[i]) / knots.dt
    v = np.maximum(knots.v[i] + knots.a[i] * u + jerk * u**2 / 2, 0.0)
    far = knots.s[i] + knots.v[i] * u + knots.a[i] * u**2 / 2 + jerk * u**3 / 6
    return np.maximum.accumulate(np.clip(far, 0.0, end)), v

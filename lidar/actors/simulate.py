"""Movers that go along their ways, keep their distance and never touch: the loop over time.

Every mover holds the squares of ground that it covers from its tail to where it could stop. A mover takes new
squares only if nobody holds them, and never goes faster than lets it stop within its own: so no two bodies
touch, whatever the ways look like. How fast it goes within that is the Intelligent Driver Model (Treiber,
Hennecke and Helbing, "Congested traffic states in empirical observations and microscopic simulations", 2000).
A junction is entered only by who may hold his whole way through it (crossing ways exclude each other, movers
on the same way follow each other), so nobody waits in the middle of it for who waits for him.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lidar.actors.lanes import STEP

Float = NDArray[np.float64]
Ints = NDArray[np.int64]

EGO = -2
"""Holder of the squares under the ego vehicle."""
HARD = 8.0
"""m/s^2: the braking that a mover could still do, which decides how far ahead it holds the ground."""
_LOOK = 90.0  # metres ahead that are looked at
_YIELD_S = 4.0  # seconds to arrival within which somebody with priority is waited for
_LINE = 1.2  # metres before a stop line at which a mover stands


class Movers(NamedTuple):
    """Movers and their ways, one row a mover; flat tables start at ``*_start`` (n + 1).

    station_start : into ``speed_limit`` (desired speed at each station, m/s), ``x``, ``y``, ``heading``
    square_start  : into ``square``, ``first``, ``last``, ``leave`` of `lidar.actors.sweep.Sweep`
    block_start   : into the blocks, stretches of the way through junctions:
    block_from, block_to : stations of the body's middle, first and last, at which it is in the junction
    block_stop    : station at which to wait
    block_zone, block_group : junction, and group of its signals, -1 for none
    block_way     : number of the way through the junction; movers of one number follow each other
    block_rank    : the lower goes first
    headway, pull, brake, gap : time gap s, acceleration, comfortable braking m/s^2, standing gap m
    length, width : metres
    appear        : step at which the mover appears
    begin         : station at which it appears
    """

    station_start: Ints
    speed_limit: Float
    x: Float
    y: Float
    heading: Float
    square_start: Ints
    square: NDArray[np.int32]
    first: NDArray[np.int32]
    last: NDArray[np.int32]
    leave: NDArray[np.int32]
    block_start: Ints
    block_from: Ints
    block_to: Ints
    block_stop: Ints
    block_zone: Ints
    block_group: Ints
    block_way: Ints
    block_rank: Float
    headway: Float
    pull: Float
    brake: Float
    gap: Float
    length: Float
    width: Float
    appear: Ints
    begin: Ints


class Ego(NamedTuple):
    """What the others know of the ego vehicle, a row a step, and the squares it will cover.

    x, y, heading, speed : (t,) of its box's middle
    half    : (2,) metres, half its box, grown by what others keep from it
    event_start, event_square : squares that it covers at each step (t + 1) and (e,)
    """

    x: Float
    y: Float
    heading: Float
    speed: Float
    half: Float
    event_start: Ints
    event_square: NDArray[np.int32]


class Signals(NamedTuple):
    """Fixed-time signals, a row a junction: seconds of the cycle, its offset, and windows kept for the ego.

    cycle, shift : (z,) seconds
    window       : (w, 4) junction, group, from and to in seconds: only that group has green
    """

    cycle: Float
    shift: Float
    window: Float


@njit(cache=True, nogil=True)
def is_green(zone: int, group: int, t: float, cycle: Any, shift: Any, window: Any) -> bool:
    """Whether a group of a junction's signals shows green: half the cycle each, less 5 s to clear."""
    for w in range(len(window)):
        if window[w, 0] == zone and window[w, 2] <= t <= window[w, 3]:
            return bool(window[w, 1] == group)
    phase = (t + shift[zone]) % cycle[zone]
    half = 0.5 * cycle[zone]
    return bool(group * half <= phase < (group + 1) * half - 5.0)


@njit(cache=True, nogil=True)
def _meets(
    ax: float,
    ay: float,
    ah: float,
    al: float,
    aw: float,
    bx: float,
    by: float,
    bh: float,
    bl: float,
    bw: float,
) -> bool:
    """Whether two rectangles (middle, heading, half sizes) share a point: separating axes."""
    dx, dy = bx - ax, by - ay
    for h in (ah, ah + math.pi / 2, bh, bh + math.pi / 2):
        c, s = math.cos(h), math.sin(h)
        far = abs(dx * c + dy * s)
        ra = al * abs(math.cos(ah - h)) + aw * abs(math.sin(ah - h))
        rb = bl * abs(math.cos(bh - h)) + bw * abs(math.sin(bh - h))
        if far > ra + rb:
            return False
    return True


@njit(cache=True, nogil=True)
def run(
    m: Any,
    ego: Any,
    signals: Any,
    out_of_play: Any,
    blocked: Any,
    squares: int,
    dt: float,
    steps: int,
    horizon: int,
    far: float,
) -> Any:
    """Rows (mover, step, metres along the way, speed) by step, and who met the ego.

    out_of_play : (n,) movers to leave out
    blocked     : squares that nobody may take
    horizon     : steps that the ego's squares are known ahead
    far         : metres from the ego beyond which movers end
    """
    n = len(m.appear)
    nobody = -1
    owner = np.full(squares, nobody, np.int32)
    times = np.zeros(squares, np.int16)
    hold = np.full(squares, nobody, np.int32)
    holds = np.zeros(squares, np.int16)
    arrive = np.full(squares, np.inf, np.float32)
    until = np.full(squares, -np.inf, np.float32)
    for p in blocked:
        owner[p] = EGO - 1
    active = np.zeros(n, np.bool_)
    gone = out_of_play.copy()
    met = np.zeros(n, np.bool_)
    s, v = np.zeros(n), np.zeros(n)
    taken, left = np.zeros(n, np.int64), np.zeros(n, np.int64)  # rows of squares taken and given back
    station = np.full(n, -1, np.int64)  # last station that is held
    block = m.block_start[:-1].copy()
    granted = np.zeros(n, np.bool_)
    waiting = np.zeros(n, np.int64)
    room = 4096
    log = np.empty((room, 4))
    rows = 0

    for step in range(steps):
        t = step * dt
        ahead = step + horizon
        for e in range(ahead if step else 0, ahead + 1):
            if e < len(ego.x):
                for q in range(ego.event_start[e], ego.event_start[e + 1]):
                    p = ego.event_square[q]
                    te = e * dt
                    if until[p] < t:
                        arrive[p] = te
                    until[p] = te
        if step == 0:
            for e in range(min(horizon, len(ego.x))):
                for q in range(ego.event_start[e], ego.event_start[e + 1]):
                    p = ego.event_square[q]
                    arrive[p] = min(arrive[p], e * dt)
                    until[p] = max(until[p], e * dt)
        for i in range(n):
            if gone[i]:
                continue
            base = m.station_start[i]
            stations = m.station_start[i + 1] - base
            q0, q1 = m.square_start[i], m.square_start[i + 1]
            if not active[i]:
                if step < m.appear[i]:
                    continue
                if step > m.appear[i] + 100:
                    gone[i] = True
                    continue
                k = m.begin[i]
                # it comes at a speed that lets it stop before whatever is ahead
                free = k
                lo = q0
                while lo < q1 and m.last[lo] < k:
                    lo += 1
                fits = True
                wish = m.speed_limit[base + k]
                want = min(k + int(wish * wish / (2 * m.brake[i]) / STEP) + 4, stations - 1)
                if block[i] < m.block_start[i + 1]:
                    want = min(want, max(m.block_stop[block[i]], k))
                stop = want
                for q in range(q0, q1):
                    if m.first[q] > want:
                        break
                    if m.last[q] < k:
                        continue
                    p = m.square[q]
                    if owner[p] != nobody or (until[p] >= t and m.first[q] <= k + 30):
                        stop = min(stop, m.first[q] - 1)
                        if m.first[q] <= k + 3:
                            fits = False
                            break
                if not fits or stop < k + 2:
                    continue
                free = stop
                s[i] = k * STEP
                v[i] = min(wish, math.sqrt(2 * m.brake[i] * max((free - k - 2) * STEP, 0.0)) * 0.9)
                active[i] = True
                q = q0
                while q < q1 and m.first[q] <= free:
                    if m.last[q] >= k:
                        p = m.square[q]
                        owner[p] = i
                        times[p] += 1
                    q += 1
                taken[i] = q
                station[i] = free
                left[i] = q0
                while left[i] < q1 and m.last[m.leave[left[i]] + q0] < k:
                    left[i] += 1
            k = int(s[i] / STEP)
            # who goes where: the next junction
            limit = stations - 1
            b = block[i]
            while b < m.block_start[i + 1] and k > m.block_to[b]:
                b += 1
                granted[i] = False
            block[i] = b
            line = False
            if b < m.block_start[i + 1] and not granted[i]:
                near = m.block_stop[b] - k <= (v[i] * v[i] / (1.3 * m.brake[i]) + 2.0 * v[i]) / STEP + 12
                if (
                    near
                    and k <= m.block_from[b]
                    and _may_enter(
                        i,
                        b,
                        k,
                        t,
                        m,
                        signals,
                        ego,
                        v,
                        block,
                        granted,
                        active,
                        s,
                        owner,
                        hold,
                        arrive,
                        until,
                        station,
                        taken,
                    )
                ):
                    granted[i] = True
                    for q in range(q0, q1):
                        if m.first[q] > m.block_to[b]:
                            break
                        if m.first[q] >= m.block_from[b]:
                            hold[m.square[q]] = m.block_way[b]
                            holds[m.square[q]] += 1
                if not granted[i]:
                    limit = min(limit, max(m.block_stop[b], station[i]))
                    line = near
            # what is ahead
            look = min(limit, k + int(_LOOK / STEP))
            lead_speed, stop_at, free = 0.0, look + 1, True
            q = left[i]
            pointer = taken[i]
            own_end = pointer
            # squares held already may since be wanted by the ego
            close = math.hypot(m.x[base + k] - ego.x[step], m.y[base + k] - ego.y[step])
            if close > far:
                gone[i] = True
            for q in range(q0 if close < _LOOK else own_end, own_end):
                if m.last[q] < k or m.first[q] <= k:
                    continue
                p = m.square[q]
                if until[p] >= t and arrive[p] - t < (m.last[q] - k) * STEP / max(v[i], 2.0) + 1.0:
                    if m.first[q] < stop_at:
                        stop_at = m.first[q]
                        free = False
                        lead_speed = max(
                            ego.speed[step] * math.cos(ego.heading[step] - m.heading[base + k]), 0.0
                        )
            q = own_end
            while q < q1 and m.first[q] <= look and m.first[q] < stop_at:
                p = m.square[q]
                o = owner[p]
                if o != nobody and o != i:
                    stop_at = m.first[q]
                    free = False
                    lead_speed = 0.0
                    if o >= 0:
                        ko = m.station_start[o] + int(s[o] / STEP)
                        lead_speed = max(
                            v[o] * math.cos(m.heading[ko] - m.heading[base + min(stop_at, stations - 1)]), 0.0
                        )
                    break
                if until[p] >= t and arrive[p] - t < (m.last[q] - k) * STEP / max(v[i], 2.0) + 1.0:
                    stop_at = m.first[q]
                    free = False
                    lead_speed = max(ego.speed[step] * math.cos(ego.heading[step] - m.heading[base + k]), 0.0)
                    break
                q += 1
            wish = max(m.speed_limit[base + k], 0.5)
            here = v[i]
            ratio = here / wish
            pull = m.pull[i] * (1.0 - ratio**4)
            if not free or (line and stop_at > limit):
                gap = max(stop_at * STEP - s[i] - STEP, 0.05)
                quiet = m.gap[i] if not free else 0.3
                desired = quiet + max(
                    here * m.headway[i]
                    + here * (here - lead_speed) / (2 * math.sqrt(m.pull[i] * m.brake[i])),
                    0.0,
                )
                pull -= m.pull[i] * (desired / gap) ** 2
            pull = min(max(pull, -HARD), m.pull[i])
            new = max(here + pull * dt, 0.0)
            # hold the ground as far as it takes to stop; go as fast as the ground that is held allows
            need = min(int((s[i] + (here + new) / 2 * dt + new * new / (2 * HARD)) / STEP) + 2, limit)
            q = taken[i]
            reached = station[i]
            while q < q1 and m.first[q] <= need:
                p = m.square[q]
                o = owner[p]
                if (o != nobody and o != i) or (
                    until[p] >= t and arrive[p] - t < (m.last[q] - k) * STEP / max(v[i], 2.0) + 0.5
                ):
                    need = m.first[q] - 1
                    break
                q += 1
            need = max(need, reached)
            q = taken[i]
            while q < q1 and m.first[q] <= need:
                p = m.square[q]
                owner[p] = i
                times[p] += 1
                q += 1
            taken[i] = q
            station[i] = need
            end = (need - 1) * STEP if need < stations - 1 else (stations - 1) * STEP
            room_left = end - s[i] - here * dt / 2
            root = (dt / 2) ** 2 * HARD * HARD + 2 * HARD * room_left
            most = -HARD * dt / 2 + math.sqrt(root) if root > 0 else 0.0
            if new > most:
                new = max(most, 0.0)
            s[i] += (here + new) / 2 * dt if room_left > -here * dt / 2 else 0.0
            v[i] = new
            if s[i] > (stations - 2) * STEP:
                gone[i] = True  # at the end of its way
            k = int(s[i] / STEP)
            while left[i] < q1 and (m.last[m.leave[left[i]] + q0] < k or gone[i]):
                row = m.leave[left[i]] + q0
                p = m.square[row]
                if row < taken[i] and m.last[row] >= m.begin[i]:
                    times[p] -= 1
                    if times[p] == 0:
                        owner[p] = nobody
                left[i] += 1
            _give_back(i, k, m, block, hold, holds, granted, gone[i])
            if rows == room:
                room *= 2
                more = np.empty((room, 4))
                more[:rows] = log[:rows]
                log = more
            log[rows, 0], log[rows, 1], log[rows, 2], log[rows, 3] = i, step, s[i], v[i]
            rows += 1
            if gone[i]:
                active[i] = False
                continue
            row = base + k
            if _meets(
                ego.x[step],
                ego.y[step],
                ego.heading[step],
                ego.half[0],
                ego.half[1],
                m.x[row],
                m.y[row],
                m.heading[row],
                m.length[i] / 2,
                m.width[i] / 2,
            ):
                met[i] = True
    return log[:rows], met, waiting


@njit(cache=True, nogil=True)
def _give_back(i: int, k: int, m: Any, block: Any, hold: Any, holds: Any, granted: Any, gone: bool) -> None:
    """End a mover's hold of a junction that it has left."""
    b = block[i]
    if b >= m.block_start[i + 1] or not granted[i] or (k <= m.block_to[b] and not gone):
        return
    for q in range(m.square_start[i], m.square_start[i + 1]):
        if m.first[q] > m.block_to[b]:
            break
        if m.first[q] >= m.block_from[b]:
            p = m.square[q]
            holds[p] -= 1
            if holds[p] == 0:
                hold[p] = -1
    granted[i] = False
    block[i] = b + 1


@njit(cache=True, nogil=True)
def _may_enter(
    i: int,
    b: int,
    k: int,
    t: float,
    m: Any,
    signals: Any,
    ego: Any,
    v: Any,
    block: Any,
    granted: Any,
    active: Any,
    s: Any,
    owner: Any,
    hold: Any,
    arrive: Any,
    until: Any,
    station: Any,
    taken: Any,
) -> bool:
    """Whether a mover may enter its next junction."""
    zone, group = m.block_zone[b], m.block_group[b]
    base = m.station_start[i]
    end = m.block_to[b] + 2
    pace = max(v[i], 3.0)
    eta = max(m.block_stop[b] - k, 0) * STEP / pace
    if group >= 0 and not is_green(zone, group, t + eta, signals.cycle, signals.shift, signals.window):
        return False
    for q in range(taken[i], m.square_start[i + 1]):
        if m.first[q] > end:
            break
        p = m.square[q]
        o = owner[p]
        if o >= 0 and o != i:
            ko = m.station_start[o] + int(s[o] / STEP)
            along = math.cos(
                m.heading[ko] - m.heading[base + min(m.first[q], m.station_start[i + 1] - base - 1)]
            )
            same = block[o] < m.block_start[o + 1] and m.block_way[block[o]] == m.block_way[b]
            if along < 0.5 or v[o] < 1.5 or not (same or m.first[q] > m.block_from[b]):
                return False
            break
        if o != -1 and o != i:
            return False
    for q in range(m.square_start[i], m.square_start[i + 1]):
        if m.first[q] > end:
            break
        if m.first[q] < m.block_from[b]:
            continue
        p = m.square[q]
        if hold[p] != -1 and hold[p] != m.block_way[b] and m.first[q] <= m.block_to[b]:
            return False
        if until[p] >= t and arrive[p] - t < (m.last[q] - k) * STEP / pace + 2.0:
            return False
    for j in range(len(v)):
        if j == i or not active[j] or block[j] >= m.block_start[j + 1]:
            continue
        c = block[j]
        if m.block_zone[c] != zone or granted[j] or m.block_way[c] == m.block_way[b]:
            continue
        if m.block_group[c] >= 0 and m.block_group[c] != group:
            continue
        if m.block_rank[c] < m.block_rank[b] and v[j] > 1.0:
            kj = int(s[j] / STEP)
            theirs = (m.block_from[c] - kj) * STEP / max(v[j], 3.0)
            if theirs < eta + _YIELD_S:
                return False
    return True

"""Movers that go along their ways, keep their distance and never touch: the loop over time.

Every mover holds the squares of ground that it covers from its tail to where it could stop. A mover takes new
squares only if nobody holds them, and never goes faster than lets it stop within its own: so no two bodies
touch, whatever their ways look like. How fast it goes within that is the Intelligent Driver Model (Treiber,
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

from geoscene.typing import Float, Ints
from lidar.traffic.junctions import is_green
from lidar.traffic.lanes import STEP

Flags = NDArray[np.bool_]

HARD = 8.0
"""m/s^2: the braking that a mover could still do, which decides how far ahead it holds the ground."""
_LOOK = (15.0, 5.0)  # metres, and metres for each m/s, ahead that are looked at
_BESIDE = 90.0  # metres from the ego within which what is held already is looked at again
_COARSE = 3  # one square in so many is looked at: what stands there covers more
_YIELD_S = 4.0  # seconds to arrival within which somebody with priority is waited for
_PATIENCE = 20  # steps for which a mover waits for room to appear
_HALT = 10  # steps at rest before a stop sign
_AT_LINE = 3.0  # metres from where to stop within which one has stopped there
_NOBODY = -1


class Movers(NamedTuple):
    """Movers and their ways, one row a mover (n); flat tables begin at ``*_start`` (n + 1).

    station_start : into the stations of ways, `STEP` metres apart:
    wish          : speed that its driver wants, m/s
    x, y, heading : of the body's middle

    square_start  : into the squares of `lidar.traffic.sweep.Sweep`, numbered from 0:
    square, first, last, leave

    block_start   : into the blocks, stretches of ways through junctions:
    block_from, block_to : first and last station of the body's middle at which it is in the junction
    block_stop    : station at which to wait
    block_zone, block_group : junction, and group of its signals, -1 for none
    block_way     : number of the way through the junction; movers of one number follow each other
    block_rank    : the lower goes first
    block_halt    : whether there is a stop sign: one comes to rest before it

    headway, pull, brake, gap : time gap s, acceleration, comfortable braking m/s^2, standing gap m
    length, width : metres
    appear, begin : step and station at which the mover appears
    leaves        : whether its way leads out of the map; otherwise it stops at its end
    whole         : whether it takes all of a block at once: people on crossings
    """

    station_start: Ints
    wish: Float
    x: Float
    y: Float
    heading: Float
    square_start: Ints
    square: NDArray[np.integer]
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
    block_halt: Flags
    headway: Float
    pull: Float
    brake: Float
    gap: Float
    length: Float
    width: Float
    appear: Ints
    begin: Ints
    leaves: Flags
    whole: Flags


class Ego(NamedTuple):
    """What the others know of the ego vehicle, a row a step (t), and the squares it covers then.

    x, y, heading, speed : of its box's middle
    half    : (2,) metres, half its box
    event_start, event_square : (t + 1) and (e,), the squares under it and what others keep from it
    """

    x: Float
    y: Float
    heading: Float
    speed: Float
    half: Float
    event_start: Ints
    event_square: NDArray[np.integer]


class _Ground(NamedTuple):
    """Squares of ground.

    owner, times  : who holds each and how often, `_NOBODY` for nobody
    hold, holds   : the way through a junction that it is kept for, and by how many
    arrive, until : when the ego needs it next, and until when, in seconds
    """

    owner: NDArray[np.int32]
    times: NDArray[np.int16]
    hold: NDArray[np.int32]
    holds: NDArray[np.int16]
    arrive: NDArray[np.float32]
    until: NDArray[np.float32]


class _State(NamedTuple):
    """Where movers are.

    active, gone  : whether they have appeared, and ended
    s, v          : metres along their ways, m/s
    ahead         : the first row of their squares that they do not stand on yet
    taken, left   : rows taken, and rows (in the order of leaving) given back
    station       : the last station that they hold
    block, granted : the next block, and whether they may enter it
    rested        : steps for which they have stood at the stop sign of the next block
    """

    active: Flags
    gone: Flags
    s: Float
    v: Float
    ahead: Ints
    taken: Ints
    left: Ints
    station: Ints
    block: Ints
    granted: Flags
    rested: Ints


@njit(cache=True, nogil=True)
def run(
    m: Any,
    ego: Any,
    signals: Any,
    out: Any,
    squares: int,
    dt: float,
    steps: int,
    horizon: int,
    far: float,
    driver: int,
) -> Any:
    """Rows (mover, step, metres along the way, speed) by step, and which movers (n,) met the ego.

    ego     : its motion, if that is given; else its place is filled in as it moves
    driver  : the mover that is the ego, -1 for none: then the ego's motion is given
    out     : (n,) bool, movers to leave out
    squares : number of squares
    horizon : steps that the ego's way is known ahead
    far     : metres from the ego beyond which movers end
    """
    n = len(m.appear)
    g = _Ground(
        np.full(squares, _NOBODY, np.int32),
        np.zeros(squares, np.int16),
        np.full(squares, _NOBODY, np.int32),
        np.zeros(squares, np.int16),
        np.full(squares, np.inf, np.float32),
        np.full(squares, -np.inf, np.float32),
    )
    st = _State(
        np.zeros(n, np.bool_),
        out.copy(),
        np.zeros(n),
        np.zeros(n),
        m.square_start[:-1].copy(),
        m.square_start[:-1].copy(),
        m.square_start[:-1].copy(),
        np.full(n, -1, np.int64),
        m.block_start[:-1].copy(),
        np.zeros(n, np.bool_),
        np.zeros(n, np.int64),
    )
    met = np.zeros(n, np.bool_)
    log = np.empty((4096, 4))
    rows = 0
    for step in range(steps):
        for ahead in range(step + horizon if step else 0, step + horizon + 1):
            _expect_ego(g, ego, ahead, step * dt, dt)
        if driver >= 0:
            row = m.station_start[driver] + int(st.s[driver] / STEP)
            ego.x[step], ego.y[step] = m.x[row], m.y[row]
        for i in range(n):
            if st.gone[i] or not (st.active[i] or _appears(i, step, step * dt, m, g, st)):
                continue
            _move(i, step, dt, m, g, st, ego, signals)
            row = m.station_start[i] + int(st.s[i] / STEP)
            if rows == len(log):
                more = np.empty((2 * rows, 4))
                more[:rows] = log
                log = more
            log[rows, 0], log[rows, 1], log[rows, 2], log[rows, 3] = i, step, st.s[i], st.v[i]
            rows += 1
            if math.hypot(m.x[row] - ego.x[step], m.y[row] - ego.y[step]) > far:
                st.gone[i] = True
            if _meet(i, row, step, m, ego):
                met[i] = True
            _leave(i, m, g, st)
    return log[:rows], met


@njit(cache=True, nogil=True)
def _expect_ego(g: Any, ego: Any, ahead: int, t: float, dt: float) -> None:
    """Note the squares that the ego will cover at a step ahead."""
    if ahead >= len(ego.x):
        return
    for q in range(ego.event_start[ahead], ego.event_start[ahead + 1]):
        p = ego.event_square[q]
        if g.until[p] < t:
            g.arrive[p] = ahead * dt
        g.until[p] = ahead * dt


@njit(cache=True, nogil=True)
def _wanted(g: Any, p: int, t: float, seconds: float) -> bool:
    """Whether the ego will need a square less than some seconds from now."""
    return bool(g.until[p] >= t and g.arrive[p] - t < seconds)


@njit(cache=True, nogil=True)
def _appears(i: int, step: int, t: float, m: Any, g: Any, st: Any) -> bool:
    """Whether a mover appears now: where there is room for it, as fast as the room allows."""
    if step < m.appear[i]:
        return False
    # what is there from the start is there at once; later comers may wait at the rim
    if step > m.appear[i] + (_PATIENCE if m.appear[i] else 0):
        st.gone[i] = True
        return False
    base, k = m.station_start[i], m.begin[i]
    stations = m.station_start[i + 1] - base
    q0, q1 = m.square_start[i], m.square_start[i + 1]
    wish = m.wish[base + k]
    free = min(k + int(wish * wish / (2 * m.brake[i]) / STEP) + 4, stations - 1)
    if st.block[i] < m.block_start[i + 1]:
        free = min(free, max(m.block_stop[st.block[i]], k))
    for q in range(q0, q1):
        if m.first[q] > free:
            break
        if m.last[q] >= k and (g.owner[m.square[q]] != _NOBODY or _wanted(g, m.square[q], t, 6.0)):
            free = m.first[q] - 1
    if free < k + 2:
        return False
    st.active[i] = True
    st.s[i] = k * STEP
    st.v[i] = min(wish, 0.9 * math.sqrt(2 * m.brake[i] * (free - k - 2) * STEP))
    _take(i, free, m, g, st)
    while st.left[i] < q1 and m.last[m.leave[st.left[i]] + q0] < k:
        st.left[i] += 1
    return True


@njit(cache=True, nogil=True)
def _take(i: int, station: int, m: Any, g: Any, st: Any) -> None:
    """Hold the ground up to a station."""
    q = st.taken[i]
    while q < m.square_start[i + 1] and m.first[q] <= station:
        if m.last[q] >= m.begin[i]:
            g.owner[m.square[q]] = i
            g.times[m.square[q]] += 1
        q += 1
    st.taken[i] = q
    st.station[i] = station


@njit(cache=True, nogil=True)
def _leave(i: int, m: Any, g: Any, st: Any) -> None:
    """Give back the ground behind a mover, and the junction that it has left."""
    q0, q1 = m.square_start[i], m.square_start[i + 1]
    k = int(st.s[i] / STEP)
    while st.left[i] < q1 and (st.gone[i] or m.last[m.leave[st.left[i]] + q0] < k):
        row = m.leave[st.left[i]] + q0
        if row < st.taken[i] and m.last[row] >= m.begin[i]:
            p = m.square[row]
            g.times[p] -= 1
            if g.times[p] == 0:
                g.owner[p] = _NOBODY
        st.left[i] += 1
    b = st.block[i]
    if b == m.block_start[i + 1] or not (st.gone[i] or k > m.block_to[b]):
        return
    _release(i, m, g, st)
    st.rested[i] = 0
    st.block[i] = b + 1


@njit(cache=True, nogil=True)
def _release(i: int, m: Any, g: Any, st: Any) -> None:
    """Give back the way through a mover's next junction, if it has it."""
    b = st.block[i]
    if st.granted[i]:
        for q in range(m.square_start[i], m.square_start[i + 1]):
            if m.block_from[b] <= m.first[q] <= m.block_to[b]:
                p = m.square[q]
                g.holds[p] -= 1
                if g.holds[p] == 0:
                    g.hold[p] = _NOBODY
    st.granted[i] = False


@njit(cache=True, nogil=True)
def _too_late(i: int, k: int, t: float, m: Any, st: Any, signals: Any) -> bool:
    """Whether a signal will have changed before a mover that may enter its next junction gets there.

    Not if it could no longer stop before it in comfort.
    """
    b, v = st.block[i], st.v[i]
    metres = (m.block_stop[b] - k) * STEP
    if m.whole[i] or m.block_group[b] < 0 or st.station[i] >= m.block_stop[b]:
        return False
    eta = metres / max(v, 3.0)
    return bool(
        v * v / (2 * m.brake[i]) + STEP < metres
        and not is_green(m.block_zone[b], m.block_group[b], t + eta, signals)
    )


@njit(cache=True, nogil=True)
def _move(i: int, step: int, dt: float, m: Any, g: Any, st: Any, ego: Any, signals: Any) -> None:
    """Move a mover on by one step."""
    base = m.station_start[i]
    end = m.station_start[i + 1] - base - 1
    t, s, v = step * dt, st.s[i], st.v[i]
    k = int(s / STEP)
    while st.ahead[i] < m.square_start[i + 1] and m.first[st.ahead[i]] <= k:
        st.ahead[i] += 1
    limit = end
    line = not m.leaves[i]
    halts = False
    b = st.block[i]
    if b < m.block_start[i + 1] and st.granted[i] and _too_late(i, k, t, m, st, signals):
        _release(i, m, g, st)
    if b < m.block_start[i + 1] and not st.granted[i]:
        near = m.block_stop[b] - k <= (v * v / (1.3 * m.brake[i]) + 2.0 * v) / STEP + 12
        halts = m.block_halt[b] and st.rested[i] < _HALT
        if near and not halts and k <= m.block_from[b] and _may_enter(i, k, t, m, g, st, signals):
            st.granted[i] = True
            for q in range(st.ahead[i], m.square_start[i + 1]):
                if m.block_from[b] <= m.first[q] <= m.block_to[b]:
                    g.hold[m.square[q]] = m.block_way[b]
                    g.holds[m.square[q]] += 1
            if m.whole[i]:
                _take(i, max(st.station[i], min(m.block_to[b] + 1, end)), m, g, st)
        else:
            limit = min(end, max(m.block_stop[b], st.station[i]))
            line = near
    stop_at, lead = _obstacle(i, k, t, step, limit, m, g, st, ego)
    free = stop_at > min(limit, k + _sight(v))
    wish = max(m.wish[base + k], 0.3)
    pull = 1.0 - (v / wish) ** 4
    if not free or (line and stop_at > limit):
        gap = max((stop_at - 1) * STEP - s, 0.05)
        quiet = 0.3 if free else m.gap[i]
        close = v * (v - lead) / (2 * math.sqrt(m.pull[i] * m.brake[i]))
        pull -= ((quiet + max(v * m.headway[i] + close, 0.0)) / gap) ** 2
    new = max(v + min(max(m.pull[i] * pull, -HARD), m.pull[i]) * dt, 0.0)
    # hold the ground as far as it takes to stop; go as fast as the ground that is held allows
    need = min(int((s + (v + new) / 2 * dt + new * new / (2 * HARD)) / STEP) + 2, limit)
    q = st.taken[i]
    while q < m.square_start[i + 1] and m.first[q] <= need:
        p = m.square[q]
        other = g.owner[p] not in (_NOBODY, i)
        if other or _wanted(g, p, t, (m.last[q] - k) * STEP / max(v, 2.0) + 0.5):
            need = m.first[q] - 1
            break
        q += 1
    _take(i, max(need, st.station[i]), m, g, st)
    room = min(st.station[i] - 1, end - 1) * STEP - s - v * dt / 2
    root = (dt / 2 * HARD) ** 2 + 2 * HARD * room
    new = min(new, max(math.sqrt(root) - dt / 2 * HARD, 0.0) if root > 0 else 0.0)
    if halts and new < 0.4 and (m.block_stop[b] - k) * STEP < _AT_LINE:
        st.rested[i] += 1
        new = 0.0
    st.s[i] = min(s + (v + new) / 2 * dt, max(end - 1, k) * STEP)
    st.v[i] = new
    if m.leaves[i] and st.s[i] > (end - 3) * STEP:
        st.gone[i] = True


@njit(cache=True, nogil=True)
def _sight(v: float) -> int:
    """Stations ahead that are looked at."""
    return int((_LOOK[0] + _LOOK[1] * v) / STEP)


@njit(cache=True, nogil=True)
def _obstacle(
    i: int, k: int, t: float, step: int, limit: int, m: Any, g: Any, st: Any, ego: Any
) -> tuple[int, float]:
    """First station ahead that cannot be had now, and how fast what is there goes the mover's way.

    One station beyond what is looked at if all can be had.
    """
    base = m.station_start[i]
    look = min(limit, k + _sight(st.v[i]))
    pace = max(st.v[i], 2.0)
    beside = math.hypot(m.x[base + k] - ego.x[step], m.y[base + k] - ego.y[step]) > _BESIDE
    # what is held already may since be wanted by the ego
    for q in range(st.taken[i] if beside else st.ahead[i], m.square_start[i + 1], _COARSE):
        if m.first[q] > look:
            break
        p = m.square[q]
        o = g.owner[p]
        if o not in (_NOBODY, i):
            there = m.heading[base + m.first[q]]
            theirs = m.heading[m.station_start[o] + int(st.s[o] / STEP)]
            return m.first[q], max(st.v[o] * math.cos(theirs - there), 0.0)
        if _wanted(g, p, t, (m.last[q] - k) * STEP / pace + 1.0):
            return m.first[q], max(ego.speed[step] * math.cos(ego.heading[step] - m.heading[base + k]), 0.0)
    return look + 1, 0.0


@njit(cache=True, nogil=True)
def _may_enter(i: int, k: int, t: float, m: Any, g: Any, st: Any, signals: Any) -> bool:
    """Whether a mover may enter its next junction."""
    b = st.block[i]
    zone, group, way = m.block_zone[b], m.block_group[b], m.block_way[b]
    base = m.station_start[i]
    pace = max(st.v[i], 1.2 if m.whole[i] else 3.0)
    eta = max(m.block_stop[b] - k, 0) * STEP / pace
    if group >= 0 and not (is_green(zone, group, t, signals) and is_green(zone, group, t + eta, signals)):
        return False
    behind = False  # somebody on the same way through is ahead
    for q in range(st.ahead[i], m.square_start[i + 1]):
        if m.first[q] > m.block_to[b] + 2:
            break
        p = m.square[q]
        o = g.owner[p]
        if q >= st.taken[i] and o not in (_NOBODY, i) and not behind:
            theirs = m.heading[m.station_start[o] + int(st.s[o] / STEP)]
            same = st.block[o] < m.block_start[o + 1] and m.block_way[st.block[o]] == way
            moves = st.v[o] > 0.5 * pace and math.cos(theirs - m.heading[base + m.first[q]]) > 0.5
            if not moves or not (same or m.first[q] > m.block_from[b]):
                return False
            behind = True
        if m.first[q] >= m.block_from[b]:
            if g.hold[p] not in (_NOBODY, way) and m.first[q] <= m.block_to[b]:
                return False
            if _wanted(g, p, t, (m.last[q] - k) * STEP / pace + 2.0):
                return False
    return not (m.whole[i] and behind) and not _yields(i, eta, m, st)


@njit(cache=True, nogil=True)
def _yields(i: int, eta: float, m: Any, st: Any) -> bool:
    """Whether somebody with priority is about to arrive at a mover's next junction."""
    b = st.block[i]
    for j in range(len(st.v)):
        c = st.block[j]
        if j == i or not st.active[j] or st.gone[j] or st.granted[j] or c == m.block_start[j + 1]:
            continue
        rival = m.block_zone[c] == m.block_zone[b] and m.block_way[c] != m.block_way[b]
        if not rival or (m.block_group[c] >= 0 and m.block_group[c] != m.block_group[b]):
            continue
        arrives = (m.block_from[c] - int(st.s[j] / STEP)) * STEP / max(st.v[j], 3.0)
        if m.block_rank[c] < m.block_rank[b] and st.v[j] > 1.0 and arrives < eta + _YIELD_S:
            return True
    return False


@njit(cache=True, nogil=True)
def _meet(i: int, row: int, step: int, m: Any, ego: Any) -> bool:
    """Whether a mover's box and the ego's share a point: separating axes."""
    dx, dy = ego.x[step] - m.x[row], ego.y[step] - m.y[row]
    if math.hypot(dx, dy) > m.length[i] + 2 * ego.half[0]:
        return False
    a, b = m.heading[row], ego.heading[step]
    for h in (a, a + math.pi / 2, b, b + math.pi / 2):
        mine = m.length[i] / 2 * abs(math.cos(a - h)) + m.width[i] / 2 * abs(math.sin(a - h))
        its = ego.half[0] * abs(math.cos(b - h)) + ego.half[1] * abs(math.sin(b - h))
        if abs(dx * math.cos(h) + dy * math.sin(h)) > mine + its:
            return False
    return True

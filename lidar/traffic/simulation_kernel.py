"""The time loop of the traffic simulation: road users follow their paths and never touch.

Every road user reserves the cells of ground from its rear end to where it could stop. It reserves a cell only
if no one else has, and never drives faster than it can stop within its own cells: so no two bodies touch,
whatever the shape of their paths. Within these bounds its speed follows the Intelligent Driver Model
(Treiber, Hennecke and Helbing, "Congested traffic states in empirical observations and microscopic
simulations", 2000).

A road user enters a junction only once it has reserved its whole route through it. Crossing routes exclude
each other, users of the same route follow each other: so no one waits inside a junction, and there is no
deadlock.
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
"""m/s^2, emergency deceleration: decides how far ahead a road user reserves the ground."""
_LOOK_AHEAD = (15.0, 5.0)  # metres, and metres per m/s, within which obstacles are searched
_NEAR_EGO = 90.0  # metres from the ego within which reserved cells are checked again
_EVERY = 3  # every third cell is checked: bodies cover more than that
_YIELD_S = 4.0  # seconds to arrival within which a road user with priority is waited for
_PATIENCE = 20  # steps that a road user waits for room to appear
_STOP_STEPS = 10  # steps at rest at a stop sign
_AT_LINE = 3.0  # metres from the stop line within which a road user has stopped there
_NOBODY = -1


class Movers(NamedTuple):
    """Columns of moving road users and their paths (n); flat tables start at ``*_start`` (n + 1).

    station_start : rows of the following, one per station of a path, `STEP` metres apart
    desired_speed : m/s
    x, y, heading : of the body's centre

    cell_start : rows of the following, see `lidar.traffic.sweep.Sweep`; cells are numbered from 0
    cell, first, last, leave

    block_start           : rows of the following, one per passage through a junction
    block_from, block_to  : first and last station at which the body is in the junction
    block_stop            : station of the centre when waiting at the stop line
    block_zone            : junction
    block_group           : group of its signals, -1 for none
    block_route           : number of the route through the junction; users of one route follow each other
    block_rank            : priority, lower goes first
    block_stop_sign       : whether there is a stop sign

    headway, acceleration, deceleration, gap : of the driver model, see `lidar.traffic.trips.Driver`
    length, width : metres
    appear, begin : step and station at which the road user appears
    leaves        : whether it disappears at the end of its path; otherwise it stops there
    whole_block   : whether it reserves a whole passage at once: pedestrians on crossings
    """

    station_start: Ints
    desired_speed: Float
    x: Float
    y: Float
    heading: Float
    cell_start: Ints
    cell: NDArray[np.integer]
    first: NDArray[np.int32]
    last: NDArray[np.int32]
    leave: NDArray[np.int32]
    block_start: Ints
    block_from: Ints
    block_to: Ints
    block_stop: Ints
    block_zone: Ints
    block_group: Ints
    block_route: Ints
    block_rank: Float
    block_stop_sign: Flags
    headway: Float
    acceleration: Float
    deceleration: Float
    gap: Float
    length: Float
    width: Float
    appear: Ints
    begin: Ints
    leaves: Flags
    whole_block: Flags


class EgoMotion(NamedTuple):
    """Motion of the ego vehicle, one row per step (t), and the cells that it covers.

    x, y, heading, speed    : of its bounding box's centre
    half                    : (2,) metres, half length and half width of its bounding box
    event_start, event_cell : (t + 1) and (e,), cells under the box and its safety margin at each step
    """

    x: Float
    y: Float
    heading: Float
    speed: Float
    half: Float
    event_start: Ints
    event_cell: NDArray[np.integer]


class _Reservations(NamedTuple):
    """Reservations of cells (c).

    owner, times  : road user that has reserved the cell, `_NOBODY` for none, and how often
    hold, holds   : junction route that the cell is reserved for, and by how many road users
    arrive, until : seconds from and until which the ego covers it next
    """

    owner: NDArray[np.int32]
    times: NDArray[np.int16]
    hold: NDArray[np.int32]
    holds: NDArray[np.int16]
    arrive: NDArray[np.float32]
    until: NDArray[np.float32]


class _State(NamedTuple):
    """State of the road users (n).

    active, departed       : has appeared; has disappeared
    s, v               : metres along the path, m/s
    ahead              : row of the first cell that the body has not reached
    reserved, released : rows reserved, and rows (in the order of leaving) released
    station            : last station reserved
    block, granted     : next passage through a junction, and whether it may be entered
    rested             : steps at rest at the stop sign of the next passage
    """

    active: Flags
    departed: Flags
    s: Float
    v: Float
    ahead: Ints
    reserved: Ints
    released: Ints
    station: Ints
    block: Ints
    granted: Flags
    rested: Ints


@njit(cache=True, nogil=True)
def run(
    m: Any,
    ego: Any,
    signals: Any,
    excluded: Any,
    cells: int,
    dt: float,
    steps: int,
    horizon: int,
    radius: float,
    ego_row: int,
) -> Any:
    """Rows (k, 4) of road user, step, metres along the path and speed; whether each (n,) hits the ego.

    ego      : its motion; filled in step by step if the ego is simulated
    ego_row  : row of a simulated ego, -1 if the ego's motion is fixed
    excluded : (n,) bool, road users to leave out
    cells    : number of cells
    horizon  : steps that the ego's motion is known ahead
    radius   : metres from the ego beyond which road users disappear
    """
    n = len(m.appear)
    g = _Reservations(
        np.full(cells, _NOBODY, np.int32),
        np.zeros(cells, np.int16),
        np.full(cells, _NOBODY, np.int32),
        np.zeros(cells, np.int16),
        np.full(cells, np.inf, np.float32),
        np.full(cells, -np.inf, np.float32),
    )
    st = _State(
        np.zeros(n, np.bool_),
        excluded.copy(),
        np.zeros(n),
        np.zeros(n),
        m.cell_start[:-1].copy(),
        m.cell_start[:-1].copy(),
        m.cell_start[:-1].copy(),
        np.full(n, -1, np.int64),
        m.block_start[:-1].copy(),
        np.zeros(n, np.bool_),
        np.zeros(n, np.int64),
    )
    hit_ego = np.zeros(n, np.bool_)
    log = np.empty((4096, 4))
    rows = 0
    for step in range(steps):
        for ahead in range(step + horizon if step else 0, step + horizon + 1):
            _reserve_for_ego(g, ego, ahead, step * dt, dt)
        if ego_row >= 0:
            row = m.station_start[ego_row] + int(st.s[ego_row] / STEP)
            ego.x[step], ego.y[step] = m.x[row], m.y[row]
        for i in range(n):
            if st.departed[i] or not (st.active[i] or _try_to_appear(i, step, step * dt, m, g, st)):
                continue
            _move(i, step, dt, m, g, st, ego, signals)
            row = m.station_start[i] + int(st.s[i] / STEP)
            if rows == len(log):
                more = np.empty((2 * rows, 4))
                more[:rows] = log
                log = more
            log[rows, 0], log[rows, 1], log[rows, 2], log[rows, 3] = i, step, st.s[i], st.v[i]
            rows += 1
            if math.hypot(m.x[row] - ego.x[step], m.y[row] - ego.y[step]) > radius:
                st.departed[i] = True
            if _boxes_overlap(i, row, step, m, ego):
                hit_ego[i] = True
            _release_behind(i, m, g, st)
    return log[:rows], hit_ego


@njit(cache=True, nogil=True)
def _reserve_for_ego(g: Any, ego: Any, ahead: int, t: float, dt: float) -> None:
    """Reserve the cells that the ego covers at step ``ahead``."""
    if ahead >= len(ego.x):
        return
    for q in range(ego.event_start[ahead], ego.event_start[ahead + 1]):
        p = ego.event_cell[q]
        if g.until[p] < t:
            g.arrive[p] = ahead * dt
        g.until[p] = ahead * dt


@njit(cache=True, nogil=True)
def _needed_by_ego(g: Any, p: int, t: float, seconds: float) -> bool:
    """Whether the ego covers a cell within some seconds from ``t``."""
    return bool(g.until[p] >= t and g.arrive[p] - t < seconds)


@njit(cache=True, nogil=True)
def _try_to_appear(i: int, step: int, t: float, m: Any, g: Any, st: Any) -> bool:
    """Whether a road user appears in this step: if there is room, at a speed that fits the room."""
    if step < m.appear[i]:
        return False
    # those of the first step appear at once or never, later ones may wait at the rim
    if step > m.appear[i] + (_PATIENCE if m.appear[i] else 0):
        st.departed[i] = True
        return False
    base, k = m.station_start[i], m.begin[i]
    stations = m.station_start[i + 1] - base
    q0, q1 = m.cell_start[i], m.cell_start[i + 1]
    desired = m.desired_speed[base + k]
    free = min(k + int(desired * desired / (2 * m.deceleration[i]) / STEP) + 4, stations - 1)
    if st.block[i] < m.block_start[i + 1]:
        free = min(free, max(m.block_stop[st.block[i]], k))
    for q in range(q0, q1):
        if m.first[q] > free:
            break
        if m.last[q] >= k and (g.owner[m.cell[q]] != _NOBODY or _needed_by_ego(g, m.cell[q], t, 6.0)):
            free = m.first[q] - 1
    if free < k + 2:
        return False
    st.active[i] = True
    st.s[i] = k * STEP
    st.v[i] = min(desired, 0.9 * math.sqrt(2 * m.deceleration[i] * (free - k - 2) * STEP))
    _reserve(i, free, m, g, st)
    while st.released[i] < q1 and m.last[m.leave[st.released[i]] + q0] < k:
        st.released[i] += 1
    return True


@njit(cache=True, nogil=True)
def _reserve(i: int, station: int, m: Any, g: Any, st: Any) -> None:
    """Reserve the cells up to a station."""
    q = st.reserved[i]
    while q < m.cell_start[i + 1] and m.first[q] <= station:
        if m.last[q] >= m.begin[i]:
            g.owner[m.cell[q]] = i
            g.times[m.cell[q]] += 1
        q += 1
    st.reserved[i] = q
    st.station[i] = station


@njit(cache=True, nogil=True)
def _release_behind(i: int, m: Any, g: Any, st: Any) -> None:
    """Release the cells behind a road user and the junction that it has left."""
    q0, q1 = m.cell_start[i], m.cell_start[i + 1]
    k = int(st.s[i] / STEP)
    while st.released[i] < q1 and (st.departed[i] or m.last[m.leave[st.released[i]] + q0] < k):
        row = m.leave[st.released[i]] + q0
        if row < st.reserved[i] and m.last[row] >= m.begin[i]:
            p = m.cell[row]
            g.times[p] -= 1
            if g.times[p] == 0:
                g.owner[p] = _NOBODY
        st.released[i] += 1
    b = st.block[i]
    if b == m.block_start[i + 1] or not (st.departed[i] or k > m.block_to[b]):
        return
    _release_junction(i, m, g, st)
    st.rested[i] = 0
    st.block[i] = b + 1


@njit(cache=True, nogil=True)
def _release_junction(i: int, m: Any, g: Any, st: Any) -> None:
    """Release the route through a road user's next junction."""
    b = st.block[i]
    if st.granted[i]:
        for q in range(m.cell_start[i], m.cell_start[i + 1]):
            if m.block_from[b] <= m.first[q] <= m.block_to[b]:
                p = m.cell[q]
                g.holds[p] -= 1
                if g.holds[p] == 0:
                    g.hold[p] = _NOBODY
    st.granted[i] = False


@njit(cache=True, nogil=True)
def _signal_will_change(i: int, k: int, t: float, m: Any, st: Any, signals: Any) -> bool:
    """Whether the signal of the next junction turns red before a road user arrives that can still stop."""
    b, v = st.block[i], st.v[i]
    metres = (m.block_stop[b] - k) * STEP
    if m.whole_block[i] or m.block_group[b] < 0 or st.station[i] >= m.block_stop[b]:
        return False
    eta = metres / max(v, 3.0)
    return bool(
        v * v / (2 * m.deceleration[i]) + STEP < metres
        and not is_green(m.block_zone[b], m.block_group[b], t + eta, signals)
    )


@njit(cache=True, nogil=True)
def _move(i: int, step: int, dt: float, m: Any, g: Any, st: Any, ego: Any, signals: Any) -> None:
    """Advance a road user by one step."""
    base = m.station_start[i]
    end = m.station_start[i + 1] - base - 1
    t, s, v = step * dt, st.s[i], st.v[i]
    k = int(s / STEP)
    while st.ahead[i] < m.cell_start[i + 1] and m.first[st.ahead[i]] <= k:
        st.ahead[i] += 1
    limit = end
    line = not m.leaves[i]
    must_stop = False
    b = st.block[i]
    if b < m.block_start[i + 1] and st.granted[i] and _signal_will_change(i, k, t, m, st, signals):
        _release_junction(i, m, g, st)
    if b < m.block_start[i + 1] and not st.granted[i]:
        near = m.block_stop[b] - k <= (v * v / (1.3 * m.deceleration[i]) + 2.0 * v) / STEP + 12
        must_stop = m.block_stop_sign[b] and st.rested[i] < _STOP_STEPS
        if near and not must_stop and k <= m.block_from[b] and _may_enter(i, k, t, m, g, st, signals):
            st.granted[i] = True
            for q in range(st.ahead[i], m.cell_start[i + 1]):
                if m.block_from[b] <= m.first[q] <= m.block_to[b]:
                    g.hold[m.cell[q]] = m.block_route[b]
                    g.holds[m.cell[q]] += 1
            if m.whole_block[i]:
                _reserve(i, max(st.station[i], min(m.block_to[b] + 1, end)), m, g, st)
        else:
            limit = min(end, max(m.block_stop[b], st.station[i]))
            line = near
    stop_at, lead = _obstacle(i, k, t, step, limit, m, g, st, ego)
    free = stop_at > min(limit, k + _stations_ahead(v))
    desired = max(m.desired_speed[base + k], 0.3)
    accel = 1.0 - (v / desired) ** 4
    if not free or (line and stop_at > limit):
        gap = max((stop_at - 1) * STEP - s, 0.05)
        quiet = 0.3 if free else m.gap[i]
        close = v * (v - lead) / (2 * math.sqrt(m.acceleration[i] * m.deceleration[i]))
        accel -= ((quiet + max(v * m.headway[i] + close, 0.0)) / gap) ** 2
    new = max(v + min(max(m.acceleration[i] * accel, -HARD), m.acceleration[i]) * dt, 0.0)
    # reserve the stopping distance; drive no faster than the reserved cells allow
    need = min(int((s + (v + new) / 2 * dt + new * new / (2 * HARD)) / STEP) + 2, limit)
    q = st.reserved[i]
    while q < m.cell_start[i + 1] and m.first[q] <= need:
        p = m.cell[q]
        other = g.owner[p] not in (_NOBODY, i)
        if other or _needed_by_ego(g, p, t, (m.last[q] - k) * STEP / max(v, 2.0) + 0.5):
            need = m.first[q] - 1
            break
        q += 1
    _reserve(i, max(need, st.station[i]), m, g, st)
    room = min(st.station[i] - 1, end - 1) * STEP - s - v * dt / 2
    root = (dt / 2 * HARD) ** 2 + 2 * HARD * room
    new = min(new, max(math.sqrt(root) - dt / 2 * HARD, 0.0) if root > 0 else 0.0)
    if must_stop and new < 0.4 and (m.block_stop[b] - k) * STEP < _AT_LINE:
        st.rested[i] += 1
        new = 0.0
    st.s[i] = min(s + (v + new) / 2 * dt, max(end - 1, k) * STEP)
    st.v[i] = new
    if m.leaves[i] and st.s[i] > (end - 3) * STEP:
        st.departed[i] = True


@njit(cache=True, nogil=True)
def _stations_ahead(v: float) -> int:
    """Stations ahead that are searched for obstacles."""
    return int((_LOOK_AHEAD[0] + _LOOK_AHEAD[1] * v) / STEP)


@njit(cache=True, nogil=True)
def _obstacle(
    i: int, k: int, t: float, step: int, limit: int, m: Any, g: Any, st: Any, ego: Any
) -> tuple[int, float]:
    """First station ahead that is blocked, and the speed of the obstacle along the path.

    The station after the last one searched if none is blocked.
    """
    base = m.station_start[i]
    look = min(limit, k + _stations_ahead(st.v[i]))
    pace = max(st.v[i], 2.0)
    far_from_ego = math.hypot(m.x[base + k] - ego.x[step], m.y[base + k] - ego.y[step]) > _NEAR_EGO
    # the ego may since have come to need cells that are reserved
    for q in range(st.reserved[i] if far_from_ego else st.ahead[i], m.cell_start[i + 1], _EVERY):
        if m.first[q] > look:
            break
        p = m.cell[q]
        o = g.owner[p]
        if o not in (_NOBODY, i):
            here = m.heading[base + m.first[q]]
            theirs = m.heading[m.station_start[o] + int(st.s[o] / STEP)]
            return m.first[q], max(st.v[o] * math.cos(theirs - here), 0.0)
        if _needed_by_ego(g, p, t, (m.last[q] - k) * STEP / pace + 1.0):
            return m.first[q], max(ego.speed[step] * math.cos(ego.heading[step] - m.heading[base + k]), 0.0)
    return look + 1, 0.0


@njit(cache=True, nogil=True)
def _may_enter(i: int, k: int, t: float, m: Any, g: Any, st: Any, signals: Any) -> bool:
    """Whether a road user may enter its next junction."""
    b = st.block[i]
    zone, group, route = m.block_zone[b], m.block_group[b], m.block_route[b]
    base = m.station_start[i]
    pace = max(st.v[i], 1.2 if m.whole_block[i] else 3.0)
    eta = max(m.block_stop[b] - k, 0) * STEP / pace
    if group >= 0 and not (is_green(zone, group, t, signals) and is_green(zone, group, t + eta, signals)):
        return False
    behind = False  # a road user on the same route is ahead
    for q in range(st.ahead[i], m.cell_start[i + 1]):
        if m.first[q] > m.block_to[b] + 2:
            break
        p = m.cell[q]
        o = g.owner[p]
        if q >= st.reserved[i] and o not in (_NOBODY, i) and not behind:
            theirs = m.heading[m.station_start[o] + int(st.s[o] / STEP)]
            same = st.block[o] < m.block_start[o + 1] and m.block_route[st.block[o]] == route
            moves = st.v[o] > 0.5 * pace and math.cos(theirs - m.heading[base + m.first[q]]) > 0.5
            if not moves or not (same or m.first[q] > m.block_from[b]):
                return False
            behind = True
        if m.first[q] >= m.block_from[b]:
            if g.hold[p] not in (_NOBODY, route) and m.first[q] <= m.block_to[b]:
                return False
            if _needed_by_ego(g, p, t, (m.last[q] - k) * STEP / pace + 2.0):
                return False
    return not (m.whole_block[i] and behind) and not _yields(i, eta, m, st)


@njit(cache=True, nogil=True)
def _yields(i: int, eta: float, m: Any, st: Any) -> bool:
    """Whether a road user with priority is about to arrive at the next junction."""
    b = st.block[i]
    for j in range(len(st.v)):
        c = st.block[j]
        if j == i or not st.active[j] or st.departed[j] or st.granted[j] or c == m.block_start[j + 1]:
            continue
        rival = m.block_zone[c] == m.block_zone[b] and m.block_route[c] != m.block_route[b]
        if not rival or (m.block_group[c] >= 0 and m.block_group[c] != m.block_group[b]):
            continue
        arrives = (m.block_from[c] - int(st.s[j] / STEP)) * STEP / max(st.v[j], 3.0)
        if m.block_rank[c] < m.block_rank[b] and st.v[j] > 1.0 and arrives < eta + _YIELD_S:
            return True
    return False


@njit(cache=True, nogil=True)
def _boxes_overlap(i: int, row: int, step: int, m: Any, ego: Any) -> bool:
    """Whether the bounding boxes of a road user and the ego intersect (separating axes)."""
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

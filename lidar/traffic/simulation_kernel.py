"""The time loop of the traffic simulation: road users follow their paths and never touch.

Every road user reserves the cells of ground from its rear end to where it could stop. It reserves a cell only
if no one else has, and never drives faster than it can stop within its own cells: so no two bodies touch,
whatever the shape of their paths. Within these bounds its speed follows the Intelligent Driver Model
(Treiber, Hennecke and Helbing, "Congested traffic states in empirical observations and microscopic
simulations", 2000).

A road user enters a junction only once it has reserved its whole route through it. Crossing routes exclude
each other, users of the same route follow each other: so no one waits inside a junction for those who cross
it. Paths also meet elsewhere, on sidewalks and behind junctions: of road users that wait for each other in a
circle, and so for good, the smallest one disappears.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.support.compiled import njit
from geoscene.typing import Float, Ints
from lidar.traffic.junctions import Signals, is_green
from lidar.traffic.lanes import STEP

STEP_S = 0.1
"""Seconds of a simulation step."""
LOOK_AHEAD = (15.0, 5.0)
"""Metres, and metres per m/s, within which obstacles are searched."""
_NEAR_EGO = 90.0  # metres from the ego within which reserved cells are checked again
_EVERY = 3  # every third cell is checked: bodies cover more than that
_YIELD_S = 4.0  # seconds to arrival within which a road user with priority is waited for
_PATIENCE = 20  # steps that a road user waits for room to appear
_AT_REST = 0.01  # m/s
_STOP_STEPS = 10  # steps at rest at a stop sign
_DEADLOCK_STEPS = 50  # steps at rest after which road users that wait for each other are a deadlock
_ARRIVED_STEPS = 30  # steps at rest at the end of a path after which a road user disappears
_LOOK_EVERY = 10  # steps from one search for deadlocks to the next
_AT_LINE = 3.0  # metres from the stop line within which a road user has stopped there
NOBODY = -1
"""Owner of a cell that is not reserved, and route of a cell that no road user holds."""


# Tables of records: a function with one argument per column takes a minute to compile.

USER = np.dtype(
    [
        *((name, np.int64) for name in ("station_start", "cell_start", "block_start", "appear", "begin")),
        *((name, np.float64) for name in ("headway", "acceleration", "deceleration", "hard", "gap")),
        *((name, np.float64) for name in ("length", "width")),
        *((name, np.bool_) for name in ("leaves", "whole_block")),
    ],
    align=True,
)
"""A moving road user.

station_start, cell_start, block_start : its first row in the other tables; ends where the next one's begin
headway, acceleration, deceleration, hard, gap : of the driver model, see `lidar.traffic.trips.Driver`
length, width : metres
appear, begin : step and station at which it appears
leaves        : whether it drives on at the end of its path; otherwise it stops there before it disappears
whole_block   : whether it reserves a whole passage at once: pedestrians on crossings
"""

STATION = np.dtype([(name, np.float64) for name in ("desired_speed", "x", "y", "heading")])
"""A station of a path, `STEP` metres after the last: m/s, and pose of the body's centre."""

CELL = np.dtype([(name, np.int32) for name in ("number", "first", "last", "leave")])
"""A cell that a path covers, see `lidar.traffic.sweep.SweptCells`; cells are numbered from 0."""

BLOCK = np.dtype(
    [
        *((name, np.int64) for name in ("first", "last", "stop", "zone", "group", "route")),
        ("rank", np.float64),
        ("stop_sign", np.bool_),
    ],
    align=True,
)
"""A passage through a junction.

first, last : stations between which the body is in the junction
stop        : station of the centre when waiting at the stop line
zone, group : junction, and group of its signals, -1 for none
route       : number of the route through the junction; users of one route follow each other
rank        : priority, lower goes first
stop_sign   : whether there is a stop sign
"""

MOTION = np.dtype([(name, np.float64) for name in ("x", "y", "heading", "speed")])
"""Motion of the ego's bounding box at a step: pose of its centre and m/s."""

RESERVATION = np.dtype(
    [
        *((name, np.int32) for name in ("owner", "times", "hold", "holds")),
        *((name, np.float32) for name in ("arrive", "until")),
    ]
)
"""Reservations of a cell.

owner, times  : road user that has reserved it, `NOBODY` for none, and how often
hold, holds   : junction route that it is reserved for, and by how many road users
arrive, until : seconds from and until which the ego covers it next
"""

STATE = np.dtype(
    [
        *((name, np.float64) for name in ("s", "v")),
        *((name, np.int64) for name in ("ahead", "reserved", "released", "station", "block", "rested")),
        *((name, np.int64) for name in ("still", "waits_for")),
        *((name, np.bool_) for name in ("active", "departed", "granted")),
    ],
    align=True,
)
"""State of a road user.

active, departed   : has appeared; has disappeared
s, v               : metres along the path, m/s
ahead              : row of the first cell that the body has not reached
reserved, released : rows reserved, and rows (in the order of leaving) released
station            : last station reserved
block, granted     : next passage through a junction, and whether it may be entered
rested             : steps at rest at the stop sign of the next passage
still, waits_for   : steps at rest, and the road user that is in its way, `NOBODY` for none
"""


def records(dtype: np.dtype[np.void], **columns: ArrayLike) -> NDArray[np.void]:
    """A table of records from its columns."""
    table = np.empty(np.size(next(iter(columns.values()))), dtype)
    for name, values in columns.items():
        table[name] = values
    return table


class Movers(NamedTuple):
    """Moving road users and their paths: tables of `USER` (n + 1, the last one ends them), `STATION`, ..."""

    user: NDArray[np.void]
    station: NDArray[np.void]
    cell: NDArray[np.void]
    block: NDArray[np.void]


class EgoMotion(NamedTuple):
    """Motion of the ego vehicle, one row per step (t), and the cells that it covers.

    motion                  : (t,) `MOTION`
    half                    : (2,) metres, half length and half width of its bounding box
    first                   : the step of the first row of ``event_start``
    event_start, event_cell : (k + 1) and (e,), cells under the box and its safety margin at each step
    """

    motion: NDArray[np.void]
    half: Float
    first: int
    event_start: Ints
    event_cell: NDArray[np.integer]


def make_unreserved(cells: int) -> NDArray[np.void]:
    """Reservations of cells that nobody has reserved."""
    out = np.zeros(cells, RESERVATION)
    out["owner"] = out["hold"] = NOBODY
    out["arrive"], out["until"] = np.inf, -np.inf
    return out


def simulate_steps(
    movers: Movers,
    ego: EgoMotion,
    *,
    signals: Signals,
    reservations: NDArray[np.void],
    state: NDArray[np.void],
    steps: tuple[int, int],
    dt: float,
    horizon: int,
    radius: float,
    ego_row: int = -1,
) -> tuple[Float, NDArray[np.bool_]]:
    """Rows (k, 4) of road user, step, metres along the path and speed; whether each (n,) hits the ego.

    ego      : its motion; filled in step by step if the ego is simulated
    reservations, state : of the cells and road users, `RESERVATION` and `STATE`; changed in place
    steps    : first step, and the one at which to end
    dt       : seconds of a step
    horizon  : steps that the ego's motion is known ahead
    radius   : metres from the ego beyond which road users disappear
    ego_row  : row of a simulated ego, -1 if the ego's motion is fixed
    """
    hit_ego = np.zeros(len(state), bool)
    log = _run(movers, reservations, state, ego, signals, steps, dt, horizon, radius, ego_row, hit_ego)
    return log, hit_ego


@njit(cache=True, nogil=True)
def _run(
    m: Any,
    g: Any,
    st: Any,
    ego: Any,
    signals: Any,
    steps: Any,
    dt: float,
    horizon: int,
    radius: float,
    ego_row: int,
    hit_ego: Any,
) -> Any:
    """The time loop of `simulate_steps`: returns its rows and fills ``hit_ego``."""
    log = np.empty((4096, 4))
    rows = 0
    for step in range(steps[0], steps[1]):
        for ahead in range(step + horizon if step else 0, step + horizon + 1):
            _reserve_for_ego(g, ego, ahead, step * dt, dt)
        if ego_row >= 0:
            row = m.user[ego_row].station_start + int(st[ego_row].s / STEP)
            ego.motion[step].x, ego.motion[step].y = m.station[row].x, m.station[row].y
        for i in range(len(st)):
            if st[i].departed or not (st[i].active or _try_to_appear(i, step, step * dt, m, g, st)):
                continue
            _move(i, step, dt, m, g, st, ego, signals)
            row = m.user[i].station_start + int(st[i].s / STEP)
            if rows == len(log):
                more = np.empty((2 * rows, 4))
                for r in range(rows):
                    for c in range(4):
                        more[r, c] = log[r, c]
                log = more
            log[rows, 0], log[rows, 1], log[rows, 2], log[rows, 3] = i, step, st[i].s, st[i].v
            rows += 1
            if (
                math.hypot(m.station[row].x - ego.motion[step].x, m.station[row].y - ego.motion[step].y)
                > radius
            ):
                st[i].departed = True
            if _boxes_overlap(i, row, step, m, ego):
                hit_ego[i] = True
            _release_behind(i, m, g, st)
        if step % _LOOK_EVERY == 0:
            _end_deadlocks(m, g, st, ego_row)
    return log[:rows]


@njit(cache=True, nogil=True)
def _end_deadlocks(m: Any, g: Any, st: Any, ego_row: int) -> None:
    """Remove one of the road users of each circle of those that wait for each other, the smallest one."""
    seen = np.full(len(st), NOBODY)
    for i in range(len(st)):
        j = i
        while j != NOBODY and seen[j] == NOBODY and st[j].still >= _DEADLOCK_STEPS:
            seen[j] = i
            j = st[j].waits_for
        if j == NOBODY or seen[j] != i:
            continue
        smallest, k = NOBODY, st[j].waits_for
        while True:
            if k != ego_row and (smallest == NOBODY or m.user[k].length < m.user[smallest].length):
                smallest = k
            if k == j:
                break
            k = st[k].waits_for
        st[smallest].departed = True
        _release_behind(smallest, m, g, st)


@njit(cache=True, nogil=True)
def _reserve_for_ego(g: Any, ego: Any, ahead: int, t: float, dt: float) -> None:
    """Reserve the cells that the ego covers at step ``ahead``."""
    if ahead >= len(ego.motion):
        return
    for q in range(ego.event_start[ahead - ego.first], ego.event_start[ahead - ego.first + 1]):
        p = ego.event_cell[q]
        if g[p].until < t:
            g[p].arrive = ahead * dt
        g[p].until = ahead * dt


@njit(cache=True, nogil=True)
def _needed_by_ego(g: Any, p: int, t: float, seconds: float) -> bool:
    """Whether the ego covers a cell within some seconds from ``t``."""
    return bool(g[p].until >= t and g[p].arrive - t < seconds)


@njit(cache=True, nogil=True)
def _try_to_appear(i: int, step: int, t: float, m: Any, g: Any, st: Any) -> bool:
    """Whether a road user appears in this step: if there is room, at a speed that fits the room."""
    if step < m.user[i].appear:
        return False
    # those of the first step appear at once or never, later ones may wait at the rim
    if step > m.user[i].appear + (_PATIENCE if m.user[i].appear else 0):
        st[i].departed = True
        return False
    base, k = m.user[i].station_start, m.user[i].begin
    stations = m.user[i + 1].station_start - base
    q0, q1 = m.user[i].cell_start, m.user[i + 1].cell_start
    desired = m.station[base + k].desired_speed
    free = min(k + int(desired * desired / (2 * m.user[i].deceleration) / STEP) + 4, stations - 1)
    if st[i].block < m.user[i + 1].block_start:
        free = min(free, max(m.block[st[i].block].stop, k))
    for q in range(q0, q1):
        if m.cell[q].first > free:
            break
        if m.cell[q].last >= k and (
            g[m.cell[q].number].owner != NOBODY or _needed_by_ego(g, m.cell[q].number, t, 6.0)
        ):
            free = m.cell[q].first - 1
    if free < k + 2:
        return False
    st[i].active = True
    st[i].s = k * STEP
    st[i].v = min(desired, 0.9 * math.sqrt(2 * m.user[i].deceleration * (free - k - 2) * STEP))
    _reserve(i, free, m, g, st)
    while st[i].released < q1 and m.cell[m.cell[st[i].released].leave + q0].last < k:
        st[i].released += 1
    return True


@njit(cache=True, nogil=True)
def _reserve(i: int, station: int, m: Any, g: Any, st: Any) -> None:
    """Reserve the cells up to a station."""
    q = st[i].reserved
    while q < m.user[i + 1].cell_start and m.cell[q].first <= station:
        if m.cell[q].last >= m.user[i].begin:
            g[m.cell[q].number].owner = i
            g[m.cell[q].number].times += 1
        q += 1
    st[i].reserved = q
    st[i].station = station


@njit(cache=True, nogil=True)
def _release_behind(i: int, m: Any, g: Any, st: Any) -> None:
    """Release the cells behind a road user and the junction that it has left."""
    q0, q1 = m.user[i].cell_start, m.user[i + 1].cell_start
    k = int(st[i].s / STEP)
    while st[i].released < q1 and (st[i].departed or m.cell[m.cell[st[i].released].leave + q0].last < k):
        row = m.cell[st[i].released].leave + q0
        if row < st[i].reserved and m.cell[row].last >= m.user[i].begin:
            p = m.cell[row].number
            g[p].times -= 1
            if g[p].times == 0:
                g[p].owner = NOBODY
        st[i].released += 1
    b = st[i].block
    if b == m.user[i + 1].block_start or not (st[i].departed or k > m.block[b].last):
        return
    _release_junction(i, m, g, st)
    st[i].rested = 0
    st[i].block = b + 1


@njit(cache=True, nogil=True)
def _cells_of_junction(i: int, m: Any, st: Any) -> Any:
    """First and last (exclusive) row of the cells that a road user comes to in its next junction."""
    b, q = st[i].block, m.user[i].cell_start
    end = m.user[i + 1].cell_start
    above = end
    while q < above:  # cells are in the order of ``first``
        middle = (q + above) // 2
        if m.cell[middle].first < m.block[b].first:
            q = middle + 1
        else:
            above = middle
    while above < end and m.cell[above].first <= m.block[b].last:
        above += 1
    return q, above


@njit(cache=True, nogil=True)
def _hold_junction(i: int, m: Any, g: Any, st: Any) -> None:
    """Reserve the route through a road user's next junction."""
    first, end = _cells_of_junction(i, m, st)
    for q in range(first, end):
        g[m.cell[q].number].hold = m.block[st[i].block].route
        g[m.cell[q].number].holds += 1
    st[i].granted = True


@njit(cache=True, nogil=True)
def _release_junction(i: int, m: Any, g: Any, st: Any) -> None:
    """Release the route through a road user's next junction."""
    if st[i].granted:
        first, end = _cells_of_junction(i, m, st)
        for q in range(first, end):
            p = m.cell[q].number
            g[p].holds -= 1
            if g[p].holds == 0:
                g[p].hold = NOBODY
    st[i].granted = False


@njit(cache=True, nogil=True)
def _signal_will_change(i: int, k: int, t: float, m: Any, st: Any, signals: Any) -> bool:
    """Whether the signal of the next junction turns red before a road user arrives that can still stop."""
    b, v = st[i].block, st[i].v
    metres = (m.block[b].stop - k) * STEP
    if m.user[i].whole_block or m.block[b].group < 0 or st[i].station >= m.block[b].stop:
        return False
    eta = metres / max(v, 3.0)
    return bool(
        v * v / (2 * m.user[i].deceleration) + STEP < metres
        and not is_green(m.block[b].zone, m.block[b].group, t + eta, signals)
    )


@njit(cache=True, nogil=True)
def _is_queueing(i: int, m: Any, g: Any, st: Any) -> bool:
    """Whether someone who may not enter the next junction has come between it and a road user."""
    b = st[i].block
    for q in range(st[i].reserved, m.user[i + 1].cell_start):
        if m.cell[q].first >= m.block[b].first:
            break
        o = g[m.cell[q].number].owner
        if o not in (NOBODY, i):
            return not st[o].granted
    return False


@njit(cache=True, nogil=True)
def _move(i: int, step: int, dt: float, m: Any, g: Any, st: Any, ego: Any, signals: Any) -> None:
    """Advance a road user by one step."""
    base = m.user[i].station_start
    end = m.user[i + 1].station_start - base - 1
    t, s, v = step * dt, st[i].s, st[i].v
    k = int(s / STEP)
    while st[i].ahead < m.user[i + 1].cell_start and m.cell[st[i].ahead].first <= k:
        st[i].ahead += 1
    st[i].waits_for = NOBODY
    limit = end
    line = not m.user[i].leaves
    must_stop = False
    b = st[i].block
    if st[i].granted and (_signal_will_change(i, k, t, m, st, signals) or _is_queueing(i, m, g, st)):
        _release_junction(i, m, g, st)
    if b < m.user[i + 1].block_start and not st[i].granted:
        near = m.block[b].stop - k <= (v * v / (1.3 * m.user[i].deceleration) + 2.0 * v) / STEP + 12
        must_stop = m.block[b].stop_sign and st[i].rested < _STOP_STEPS
        if near and not must_stop and _may_enter(i, k, t, m, g, st, signals):
            _hold_junction(i, m, g, st)
            if m.user[i].whole_block:
                _reserve(i, max(st[i].station, min(m.block[b].last + 1, end)), m, g, st)
        else:
            limit = min(end, max(m.block[b].stop, st[i].station))
            line = near
    stop_at, lead = _obstacle(i, k, t, step, limit, m, g, st, ego)
    free = stop_at > min(limit, k + _stations_ahead(v))
    desired = max(m.station[base + k].desired_speed, 0.3)
    accel = 1.0 - (v / desired) ** 4
    if not free or (line and stop_at > limit):
        gap = max((stop_at - 1) * STEP - s, 0.05)
        quiet = 0.3 if free else m.user[i].gap
        close = v * (v - lead) / (2 * math.sqrt(m.user[i].acceleration * m.user[i].deceleration))
        accel -= ((quiet + max(v * m.user[i].headway + close, 0.0)) / gap) ** 2
    hard = m.user[i].hard
    new = max(v + min(max(m.user[i].acceleration * accel, -hard), m.user[i].acceleration) * dt, 0.0)
    # reserve the stopping distance; drive no faster than the reserved cells allow
    need = min(int((s + (v + new) / 2 * dt + new * new / (2 * hard)) / STEP) + 2, limit)
    if st[i].granted and _next_signal_is_red(i, k, t, need, m, st, signals):
        need = m.block[b + 1].stop
    route = m.block[b].route if st[i].granted else NOBODY
    q = st[i].reserved
    while q < m.user[i + 1].cell_start and m.cell[q].first <= need:
        p = m.cell[q].number
        other = g[p].owner not in (NOBODY, i) or (m.user[i].whole_block and g[p].hold not in (NOBODY, route))
        if other:
            st[i].waits_for = g[p].owner if g[p].owner not in (NOBODY, i) else _holder(g[p].hold, m, st)
        if other or _needed_by_ego(g, p, t, (m.cell[q].last - k) * STEP / max(v, 2.0) + 0.5):
            need = m.cell[q].first - 1
            break
        q += 1
    _reserve(i, max(need, st[i].station), m, g, st)
    room = min(st[i].station - 1, end - 1) * STEP - s - v * dt / 2
    root = (dt / 2 * hard) ** 2 + 2 * hard * room
    new = min(new, max(math.sqrt(root) - dt / 2 * hard, 0.0) if root > 0 else 0.0)
    if must_stop and new < 0.4 and (m.block[b].stop - k) * STEP < _AT_LINE:
        st[i].rested += 1
        new = 0.0
    st[i].still = st[i].still + 1 if new < _AT_REST else 0
    st[i].s = min(s + (v + new) / 2 * dt, max(end - 1, k) * STEP)
    st[i].v = new
    if st[i].s > (end - 3) * STEP and (m.user[i].leaves or st[i].still >= _ARRIVED_STEPS):
        st[i].departed = True


@njit(cache=True, nogil=True)
def _next_signal_is_red(i: int, k: int, t: float, need: int, m: Any, st: Any, signals: Any) -> bool:
    """Whether a station is beyond the stop line of the junction after the next one, whose signal is red."""
    b = st[i].block + 1
    if m.user[i].whole_block or b >= m.user[i + 1].block_start or need <= m.block[b].stop:
        return False
    zone, group = m.block[b].zone, m.block[b].group
    eta = max(m.block[b].stop - k, 0) * STEP / max(st[i].v, 3.0)
    green = group < 0 or (is_green(zone, group, t, signals) and is_green(zone, group, t + eta, signals))
    return not green


@njit(cache=True, nogil=True)
def _stations_ahead(v: float) -> int:
    """Stations ahead that are searched for obstacles."""
    return int((LOOK_AHEAD[0] + LOOK_AHEAD[1] * v) / STEP)


@njit(cache=True, nogil=True)
def _obstacle(
    i: int, k: int, t: float, step: int, limit: int, m: Any, g: Any, st: Any, ego: Any
) -> tuple[int, float]:
    """First station ahead that is blocked, and the speed of the obstacle along the path.

    The station after the last one searched if none is blocked.
    """
    base = m.user[i].station_start
    look = min(limit, k + _stations_ahead(st[i].v))
    pace = max(st[i].v, 2.0)
    far_from_ego = (
        math.hypot(m.station[base + k].x - ego.motion[step].x, m.station[base + k].y - ego.motion[step].y)
        > _NEAR_EGO
    )
    # the ego may since have come to need cells that are reserved
    for q in range(st[i].reserved if far_from_ego else st[i].ahead, m.user[i + 1].cell_start, _EVERY):
        if m.cell[q].first > look:
            break
        p = m.cell[q].number
        o = g[p].owner
        if o not in (NOBODY, i):
            here = m.station[base + m.cell[q].first].heading
            theirs = m.station[m.user[o].station_start + int(st[o].s / STEP)].heading
            st[i].waits_for = o
            return m.cell[q].first, max(st[o].v * math.cos(theirs - here), 0.0)
        if _needed_by_ego(g, p, t, (m.cell[q].last - k) * STEP / pace + 1.0):
            return m.cell[q].first, max(
                ego.motion[step].speed * math.cos(ego.motion[step].heading - m.station[base + k].heading), 0.0
            )
    return look + 1, 0.0


@njit(cache=True, nogil=True)
def _may_enter(i: int, k: int, t: float, m: Any, g: Any, st: Any, signals: Any) -> bool:
    """Whether a road user may enter its next junction."""
    b = st[i].block
    zone, group, route = m.block[b].zone, m.block[b].group, m.block[b].route
    base = m.user[i].station_start
    pace = max(st[i].v, 1.2 if m.user[i].whole_block else 3.0)
    eta = max(m.block[b].stop - k, 0) * STEP / pace
    if group >= 0 and not (is_green(zone, group, t, signals) and is_green(zone, group, t + eta, signals)):
        return False
    leader = NOBODY  # the last road user found ahead, on the same route
    for q in range(st[i].ahead, m.user[i + 1].cell_start):
        if m.cell[q].first > m.block[b].last + 2:
            break
        p = m.cell[q].number
        o = g[p].owner
        if q >= st[i].reserved and o not in (NOBODY, i, leader):
            theirs = m.station[m.user[o].station_start + int(st[o].s / STEP)].heading
            same = st[o].block < m.user[o + 1].block_start and m.block[st[o].block].route == route
            moves = (
                st[o].v > 0.5 * pace and math.cos(theirs - m.station[base + m.cell[q].first].heading) > 0.5
            )
            if not moves or not (same or m.cell[q].first > m.block[b].first):
                st[i].waits_for = o
                return False
            leader = o
        if m.cell[q].first >= m.block[b].first:
            if g[p].hold not in (NOBODY, route) and m.cell[q].first <= m.block[b].last:
                st[i].waits_for = _holder(g[p].hold, m, st)
                return False
            if _needed_by_ego(g, p, t, (m.cell[q].last - k) * STEP / pace + 2.0):
                return False
    if m.user[i].whole_block and leader != NOBODY:
        st[i].waits_for = leader
        return False
    return not _yields(i, eta, m, st)


@njit(cache=True, nogil=True)
def _holder(route: int, m: Any, st: Any) -> int:
    """A road user that has reserved a route through a junction, `NOBODY` for none."""
    for j in range(len(st)):
        if st[j].granted and m.block[st[j].block].route == route:
            return j
    return NOBODY


@njit(cache=True, nogil=True)
def _yields(i: int, eta: float, m: Any, st: Any) -> bool:
    """Whether a road user with priority is about to arrive at the next junction."""
    b = st[i].block
    for j in range(len(st)):
        c = st[j].block
        if j == i or not st[j].active or st[j].departed or st[j].granted or c == m.user[j + 1].block_start:
            continue
        rival = m.block[c].zone == m.block[b].zone and m.block[c].route != m.block[b].route
        if not rival or (m.block[c].group >= 0 and m.block[c].group != m.block[b].group):
            continue
        arrives = (m.block[c].first - int(st[j].s / STEP)) * STEP / max(st[j].v, 3.0)
        if m.block[c].rank < m.block[b].rank and st[j].v > 1.0 and arrives < eta + _YIELD_S:
            return True
    return False


@njit(cache=True, nogil=True)
def _boxes_overlap(i: int, row: int, step: int, m: Any, ego: Any) -> bool:
    """Whether the bounding boxes of a road user and the ego intersect (separating axes)."""
    dx, dy = ego.motion[step].x - m.station[row].x, ego.motion[step].y - m.station[row].y
    if math.hypot(dx, dy) > m.user[i].length + 2 * ego.half[0]:
        return False
    a, b = m.station[row].heading, ego.motion[step].heading
    for h in (a, a + math.pi / 2, b, b + math.pi / 2):
        mine = m.user[i].length / 2 * abs(math.cos(a - h)) + m.user[i].width / 2 * abs(math.sin(a - h))
        its = ego.half[0] * abs(math.cos(b - h)) + ego.half[1] * abs(math.sin(b - h))
        if abs(dx * math.cos(h) + dy * math.sin(h)) > mine + its:
            return False
    return True

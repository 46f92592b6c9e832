"""Simulation of trips around a fixed or a simulated ego vehicle.

Time passes in windows: the tables of the time loop hold the road users that are present in one window.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geoscene.roadgraph.graph import RoadGraph
from geoscene.support.columns import Columns
from geoscene.typing import Float, Ints
from lidar.geometry.poses import Trajectory
from lidar.motion.vehicle import Vehicle
from lidar.traffic.ego import EgoBox, EgoTrip, ego_motion, green_windows
from lidar.traffic.junctions import JunctionPlan, Signals
from lidar.traffic.lanes import STEP
from lidar.traffic.passages import passages
from lidar.traffic.simulation_kernel import (
    BLOCK,
    CELL,
    LOOK_AHEAD,
    MOTION,
    NOBODY,
    STATE,
    STATION,
    STEP_S,
    USER,
    EgoMotion,
    Movers,
    make_unreserved,
    records,
    simulate_steps,
)
from lidar.traffic.surroundings import LEFT
from lidar.traffic.sweep import SweptCells, sweep
from lidar.traffic.trips import Trip

_ROUNDS = 30
_HORIZON = 60  # steps that the ego's path is known ahead: 6 s
_STEPS = 200
"""Steps of a window: 20 s."""
_FASTER = 1.2  # maximum factor by which a road user exceeds its desired speed


@dataclass(frozen=True, slots=True)
class SimulatedTrips(Columns):
    """Motion of the trips that appeared, sorted by trip and time.

    trip, step : (k,) int32
    travelled, speed : (k,) metres of the body's centre along the path, m/s
    """

    trip: NDArray[np.int32]
    step: NDArray[np.int32]
    travelled: Float
    speed: Float

    @classmethod
    def of_rows(cls, rows: Float) -> SimulatedTrips:
        """The motion in rows (k, 4) of trip, step, metres along the path and speed."""
        trip, step = rows[:, :2].T.astype(np.int32)
        return cls(trip, step, rows[:, 2].copy(), rows[:, 3].copy())


def simulate_trips(
    trips: Sequence[Trip],
    graph: RoadGraph,
    *,
    plan: JunctionPlan,
    ego: Trajectory,
    vehicle: Vehicle,
    radius: float,
    obeys_signals: bool = False,
) -> SimulatedTrips:
    """The motion of trips around a fixed ego trajectory, from its start to its end.

    vehicle       : the ego
    obeys_signals : whether the ego's motion obeys the signals; otherwise they turn green for it

    Trips that the ego would hit are left out.
    """
    moved = [SimulatedTrips.of_rows(np.empty((0, 4)))]
    if not trips:
        return moved[0]
    known = ego_motion(ego, vehicle, graph=graph)
    signals = plan.signals if obeys_signals else plan.signals._replace(window=green_windows(plan, known))
    simulation = TrafficSimulation(trips, graph, plan=plan, ego=known, signals=signals, radius=radius)
    excluded = np.zeros(len(trips), bool)
    for _ in range(_ROUNDS):
        del moved[1:]
        hit_ego = np.zeros(len(trips), bool)
        for rows, hit in simulation.windows(excluded):
            moved.append(SimulatedTrips.of_rows(rows))
            hit_ego[hit] = True
        if not hit_ego.any():
            break
        excluded |= hit_ego
    in_time = SimulatedTrips.concatenate(moved)
    return in_time.take(np.argsort(in_time.trip, kind="stable"))


def simulate_ego(
    ego: EgoTrip,
    trips: Sequence[Trip],
    *,
    graph: RoadGraph,
    plan: JunctionPlan,
    seconds: float,
    radius: float,
) -> Float:
    """Metres (t,) along its path that the ego has driven at each step of `STEP_S`, simulated with the trips.

    It follows, gives way and obeys signals and signs like the other road users, and they react to it.
    """
    steps = int(np.ceil(seconds / STEP_S)) + 1
    motion = EgoBox(np.zeros(steps, MOTION), np.full(2, -np.inf))
    simulation = TrafficSimulation(
        [ego, *trips], graph, plan=plan, ego=motion, signals=plan.signals, radius=radius, ego_row=0
    )
    travelled = np.zeros(steps)
    for rows, _ in simulation.windows(np.zeros(len(trips) + 1, bool)):
        mine = rows[:, 0] == 0
        travelled[rows[mine, 1].astype(int)] = rows[mine, 2]
    return np.maximum.accumulate(travelled)


def has_traffic_control(ego: EgoTrip, graph: RoadGraph, *, plan: JunctionPlan) -> bool:
    """Whether signals or stop signs are on the ego vehicle's path."""
    blocks = passages(ego, graph, plan=plan, routes={})
    return bool((blocks[:, 4] >= 0).any() or (blocks[:, 7] > 0).any())


@dataclass(frozen=True, slots=True)
class _Tables:
    """Rows of one road user in the tables of the simulation.

    station : `STATION`, of its whole path
    level   : (n,) 1 at stations on bridges and in tunnels, 0 at others
    scale   : scene metres per true metre
    block   : columns of `BLOCK`, of its whole path
    sweep   : the cells that it can come to or leave in a window
    """

    station: NDArray[np.void]
    level: Ints
    scale: float
    block: Float
    sweep: SweptCells


class TrafficSimulation:
    """A simulation of trips around the ego vehicle.

    trips   : in the order in which they move within a step; a simulated ego is one of them
    ego     : the ego's motion, filled in step by step if it is simulated
    signals : of the junctions
    radius  : true metres from the ego beyond which road users disappear
    ego_row : number of the ego's trip, -1 if its motion is fixed
    """

    def __init__(
        self,
        trips: Sequence[Trip | EgoTrip],
        graph: RoadGraph,
        *,
        plan: JunctionPlan,
        ego: EgoBox,
        signals: Signals,
        radius: float,
        ego_row: int = -1,
    ) -> None:
        self._trips, self._graph, self._plan = trips, graph, plan
        self._ego, self._signals, self._radius, self._ego_row = ego, signals, radius, ego_row
        self._covered = graph.bridge | graph.tunnel
        self._alone = len(trips) == 1 and ego_row >= 0  # no one else reserves cells
        self._routes: dict[tuple[int, ...], int] = {}
        self._appear = np.array([int(trip.appear_s / STEP_S) for trip in trips], np.int64)

    def windows(self, excluded: NDArray[np.bool_]) -> Iterator[tuple[Float, Ints]]:
        """Rows (k, 4) of trip, step, metres along the path and speed, and trips that hit the ego, in time.

        excluded : (n,) trips to leave out
        """
        coming = np.argsort(self._appear, kind="stable")
        coming = coming[~excluded[coming]]
        begins = np.searchsorted(self._appear[coming], np.arange(0, len(self._ego.motion), _STEPS))
        begins = np.append(begins, np.searchsorted(self._appear[coming], len(self._ego.motion)))
        here, state = np.empty(0, np.int64), np.zeros(0, STATE)
        tables: dict[int, _Tables] = {}
        carried = np.empty(0, np.int64), make_unreserved(0)
        for window, first in enumerate(range(0, len(self._ego.motion), _STEPS)):
            last = min(first + _STEPS, len(self._ego.motion))
            rows = np.sort(np.append(here, coming[begins[window] : begins[window + 1]]))
            known = self._ego.known(first, last + _HORIZON)
            old, state = state, np.zeros(len(rows), STATE)
            state["station"] = -1
            state[np.searchsorted(rows, here)] = old
            tables = {
                row: self._around(row, tables.get(row) or self._tables(row), state=state[k : k + 1])
                for k, row in enumerate(rows.tolist())
            }
            movers, known, used = self._numbered(rows, list(tables.values()), known=known)
            reservations = _renumber(carried, rows, used=used)
            start = movers.user[:-1]
            _shift(state, start, sign=1)
            log, hit = simulate_steps(
                movers,
                known,
                signals=self._signals,
                reservations=reservations,
                state=state,
                steps=(first, last),
                dt=STEP_S,
                horizon=_HORIZON,
                radius=self._radius + LEFT,
                ego_row=self._ego_row,
            )
            _shift(state, start, sign=-1)
            log[:, 0] = rows[log[:, 0].astype(np.int64)]
            yield log, rows[hit]
            carried = _reserve(reservations, rows, used=used, after_s=last * STEP_S)
            stay = ~state["departed"] | (rows == self._ego_row)
            here, state = rows[stay], state[stay]

    def _tables(self, row: int) -> _Tables:
        trip = self._trips[row]
        path, desired_speed = trip.course.path, trip.course.desired_speed
        xy, heading = trip.body()
        station = records(STATION, desired_speed=desired_speed, x=xy[:, 0], y=xy[:, 1], heading=heading)
        block = passages(trip, self._graph, plan=self._plan, routes=self._routes)
        level = np.where(path.edge >= 0, self._covered[path.edge], False).astype(np.int64)
        return _Tables(station, level, path.scale, block, SweptCells.empty())

    def _around(self, row: int, tables: _Tables, *, state: NDArray[np.void]) -> _Tables:
        """The tables of a trip with its cells in the next window; adapts its ``state`` (1,) to them."""
        if self._alone:
            return tables
        trip, own = self._trips[row], state[0]
        at = int(own["s"] / STEP) if own["active"] else trip.begin
        speed = _FASTER * float(tables.station["desired_speed"].max())
        slowing = min(trip.driver.deceleration, trip.driver.hard)
        ahead = (max(LOOK_AHEAD[0] + LOOK_AHEAD[1] * speed, speed**2 / slowing + 2 * speed) + 20.0) / STEP
        to = max(at + speed * _STEPS * STEP_S / STEP, float(own["station"])) + ahead
        first, last, stop = tables.block[:, :3].T
        to = max(to, float(last[(stop <= to) & (last >= at)].max(initial=0)) + ahead)
        passing = float(first[own["block"]]) if own["granted"] else at
        begin = max(int(min(at, passing) - 2 * (trip.length + trip.width) / STEP) - 4, 0)
        part = slice(begin, int(min(to, len(tables.station))))
        xy = np.column_stack([tables.station[c][part] for c in "xy"])
        heading = tables.station["heading"][part].copy()  # the type that is compiled
        swept = sweep(
            xy,
            heading,
            length=trip.length,
            width=trip.width,
            level=tables.level[part],
            scale=tables.scale,
        )
        first_station = np.int32(begin)
        swept = replace(swept, first=swept.first + first_station, last=swept.last + first_station)
        state["ahead"] = np.searchsorted(swept.first, at, side="right")
        state["reserved"] = np.searchsorted(swept.first, own["station"], side="right")
        state["released"] = np.searchsorted(swept.last[swept.leave], at)
        return replace(tables, sweep=swept)

    def _numbered(
        self, rows: Ints, tables: Sequence[_Tables], *, known: EgoMotion
    ) -> tuple[Movers, EgoMotion, Ints]:
        """The tables of road users and the ego's motion with cells numbered from 0, and these cells."""
        trips = [self._trips[row] for row in rows.tolist()]
        columns = SweptCells.concatenate([SweptCells.empty(), *(part.sweep for part in tables)])
        used, number = np.unique(np.concatenate([columns.cell, known.event_cell]), return_inverse=True)
        mine, its = np.split(number.astype(np.int32), [len(columns)])
        counted = {"station_start": "station", "cell_start": "sweep", "block_start": "block"}
        starts = {
            name: np.cumsum([0, *(len(getattr(part, column)) for part in tables)])
            for name, column in counted.items()
        }
        drivers = ("headway", "acceleration", "deceleration", "hard", "gap")
        user = {name: [getattr(t.driver, name) for t in trips] for name in drivers}
        user |= {name: [getattr(t, name) for t in trips] for name in ("length", "width", "begin", "leaves")}
        user["appear"] = self._appear[rows].tolist()
        user["whole_block"] = [t.on_foot for t in trips]
        end = {name: [*values, 0] for name, values in user.items()}
        block = np.concatenate([np.empty((0, 8)), *(part.block for part in tables)])
        station = [part.station for part in tables] or [np.empty(0, STATION)]
        movers = Movers(
            records(USER, **starts, **end),
            station[0] if len(station) == 1 else np.concatenate(station),
            records(CELL, number=mine, first=columns.first, last=columns.last, leave=columns.leave),
            records(BLOCK, **dict(zip(BLOCK.names or (), block.T, strict=True))),
        )
        return movers, known._replace(event_cell=its), used


def _shift(state: NDArray[np.void], start: NDArray[np.void], *, sign: int) -> None:
    """Count rows in states from the start of all tables (sign 1), or of each road user's (-1)."""
    for name in ("ahead", "reserved", "released"):
        state[name] += sign * start["cell_start"]
    state["block"] += sign * start["block_start"]


def _reserve(
    reservations: NDArray[np.void], rows: Ints, *, used: Ints, after_s: float
) -> tuple[Ints, NDArray[np.void]]:
    """Cells that are reserved after a time, and their reservations, with the numbers of trips as owners."""
    taken = (reservations["owner"] != NOBODY) | (reservations["holds"] > 0)
    kept = np.flatnonzero(taken | (reservations["until"] > after_s - 1.0))
    out = reservations[kept]
    owned = out["owner"] != NOBODY
    out["owner"][owned] = rows[out["owner"][owned]]
    return used[kept], out


def _renumber(carried: tuple[Ints, NDArray[np.void]], rows: Ints, *, used: Ints) -> NDArray[np.void]:
    """Reservations of the cells of a window: those carried over from the last one, and none of others."""
    cells, kept = carried
    out = make_unreserved(len(used))
    place = np.searchsorted(used, cells)
    found = used[np.minimum(place, len(used) - 1)] == cells if len(used) else np.zeros(len(cells), bool)
    owned = kept["owner"] != NOBODY
    kept["owner"][owned] = np.searchsorted(rows, kept["owner"][owned])
    out[place[found]] = kept[found]
    return out

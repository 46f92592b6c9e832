"""The traffic simulation in windows of time: tables hold the road users that are there in one window."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.roadgraph.graph import RoadGraph
from geoscene.typing import Float, Ints
from lidar.geometry.poses import release
from lidar.motion.blockwise import rowwise
from lidar.traffic.ego_trip import EgoTrip
from lidar.traffic.junctions import JunctionPlan, Signals
from lidar.traffic.lanes import STEP
from lidar.traffic.passages import passages
from lidar.traffic.simulation_kernel import (
    BLOCK,
    CELL,
    LOOK_AHEAD,
    NOBODY,
    STATE,
    STATION,
    STEP_S,
    USER,
    EgoMotion,
    Movers,
    make_unreserved,
    simulate_steps,
)
from lidar.traffic.surroundings import LEFT
from lidar.traffic.sweep import CELL_SIZE, SweptCells, cells_under, sweep
from lidar.traffic.trips import Trip

_HORIZON = 60  # steps that the ego's path is known ahead: 6 s
_STEPS = 200
"""Steps of a window: 20 s."""
_FASTER = 1.2  # maximum factor by which a road user exceeds its desired speed
_MEMORY = 1 << 22  # bytes up to which a log is in memory


@dataclass(frozen=True, slots=True)
class EgoBox:
    """The ego's bounding box, one row per step (t).

    motion : (t,) `MOTION`
    half   : (2,) metres, half length and half width
    grown  : (t, 2) the same with the margin that others keep; None if they do not know the ego's motion
    level  : (t,) 1 on bridges and in tunnels, 0 elsewhere
    """

    motion: NDArray[np.void]
    half: Float
    grown: Float | None = None
    level: Ints | None = None

    def known(self, first: int, last: int) -> EgoMotion:
        """The motion, with the cells that the box covers from step ``first`` to ``last`` (exclusive)."""
        cells: list[Ints] = [np.empty(0, np.int64)] * (last - first)
        if self.grown is not None and self.level is not None:
            size = self.grown.max(axis=0)
            under = np.empty(int(4 * np.prod(size / CELL_SIZE + 2)), np.int64)
            for k in range(first, min(last, len(self.motion))):
                x, y, heading, _ = self.motion[k].item()
                n = cells_under(x, y, heading, self.grown[k], self.level[k], under)
                cells[k - first] = under[:n].copy()
        start = np.cumsum([0, *(len(part) for part in cells)])
        return EgoMotion(self.motion, self.half, first, start, np.concatenate(cells))


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


class Log:
    """Rows (k, 4) of a simulation, in memory and beyond that in a temporary file."""

    def __init__(self) -> None:
        self._file = tempfile.SpooledTemporaryFile(_MEMORY)  # noqa: SIM115 - closed with the log

    def close(self) -> None:
        """Delete the file."""
        self._file.close()

    def clear(self) -> None:
        """Remove all rows."""
        self._file.seek(0)
        self._file.truncate()

    def add(self, rows: Float) -> None:
        """Add rows."""
        self._file.write(rows.tobytes())

    def __iter__(self) -> Iterator[Float]:
        """All rows, block by block."""
        self._file.seek(0)
        while block := self._file.read(1 << 22):
            yield np.frombuffer(block, float).reshape(-1, 4)


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
        self._alone = len(trips) == 1 and ego_row >= 0  # nobody takes its ground
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
            release(movers.station, self._ego.motion)
            _shift(state, start, sign=-1)
            log[:, 0] = rows[log[:, 0].astype(np.int64)]
            yield log, rows[hit]
            carried = _reserve(reservations, rows, used=used, after_s=last * STEP_S)
            stay = ~state["departed"] | (rows == self._ego_row)
            here, state = rows[stay], state[stay]

    def _tables(self, row: int) -> _Tables:
        """The tables of a trip."""
        trip = self._trips[row]
        course = trip.draw()
        path = course.path
        xy, heading = trip.body(path)
        station = rowwise(
            lambda speed, xy, heading: records(
                STATION, desired_speed=speed, x=xy[:, 0], y=xy[:, 1], heading=heading
            ),
            course.desired_speed,
            xy,
            heading,
        )
        block = passages(trip, course, graph=self._graph, plan=self._plan, routes=self._routes)
        level = rowwise(
            lambda edge: np.where(edge >= 0, self._covered[edge], False).astype(np.int64), path.edge
        )
        return _Tables(station, level, path.scale, block, SweptCells.empty())

    def _around(self, row: int, tables: _Tables, *, state: NDArray[np.void]) -> _Tables:
        """The tables of a trip with its cells in the next window; its ``state`` (1,) is made to fit them."""
        if self._alone:
            return tables
        trip, own = self._trips[row], state[0]
        at = int(own["s"] / STEP) if own["active"] else trip.begin
        speed = _FASTER * float(tables.station["desired_speed"].max())
        brake = min(trip.driver.deceleration, trip.driver.hard)
        ahead = (max(LOOK_AHEAD[0] + LOOK_AHEAD[1] * speed, speed**2 / brake + 2 * speed) + 20.0) / STEP
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
        """The tables of road users with cells numbered from 0, and the numbered cells."""
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


def records(dtype: np.dtype[np.void], **columns: ArrayLike) -> NDArray[np.void]:
    """A table of records from its columns."""
    table = np.empty(np.size(next(iter(columns.values()))), dtype)
    for name, values in columns.items():
        table[name] = values
    return table


def _shift(state: NDArray[np.void], start: NDArray[np.void], *, sign: int) -> None:
    """Make rows in states count from the starts of all tables (1), or of each road user's (-1)."""
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

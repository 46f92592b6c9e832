"""Placement of symbols on lanes: arrows before junctions, bicycles, BUS, speed limits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.geometry import polylines
from geoscene.roadgraph.carriageways import Carriageways
from geoscene.roadgraph.junctions import carriageway
from geoscene.roadgraph.lane_uses import CycleLane, LaneUses
from geoscene.roadgraph.markings import PRIORITY, PaintedStretches
from geoscene.roadgraph.surface_rows import SurfaceRows
from geoscene.roadgraph.symbols import ARROW, arrow, bicycle, word
from geoscene.typing import Float

# Metres: from the tip of the last arrow to the end of the paint, from arrow to arrow, and the number of
# arrows (RMS: they are repeated); from a junction to the first symbol of another kind, and from one of a kind
# to the next (MUTCD 9C: shared lanes every 250 feet). Assumed where no source is named.
_BEFORE, _BETWEEN, _ARROWS = 3.0, 25.0, 3
_AFTER = {"bus": 12.0, "speed": 12.0, "lane": 6.0, "advisory": 6.0, "shared": 6.0}
_EVERY = {"bus": 60.0, "speed": np.inf, "lane": 50.0, "advisory": 50.0, "shared": 76.0}
_CLEAR = 1.0
"""Metres between a symbol and what lies on the road before or behind it."""
_LEAST = 1.8
"""Metres of a lane that a cycle lane must leave for symbols to lie there."""


@dataclass(frozen=True, slots=True)
class _Travel:
    """A direction of travel along a stretch.

    line  : (n, 2) in the direction of travel
    length : metres
    taken : stations from and to which other things lie on the road; symbols are added as they are placed
    """

    line: Float
    length: float
    taken: list[tuple[float, float]] = field(default_factory=list)

    def placed(self, start: float, size: float, *, back: bool) -> float | None:
        """The first free station for a symbol at or after ``start``, or before it with ``back``."""
        for _ in range(len(self.taken) + 1):
            if not _CLEAR <= start <= self.length - size:
                return None
            blocks = [(a, b) for a, b in self.taken if a < start + size + _CLEAR and b > start - _CLEAR]
            if not blocks:
                return start
            start = min(a for a, _ in blocks) - size - _CLEAR if back else max(b for _, b in blocks) + _CLEAR
        return None

    def laid(self, symbol: Any, start: float, *, left: float) -> Any:
        """A symbol with its foot at a station, moved to the left of the line."""
        size = float(symbol.bounds[2])
        middle = start + size / 2
        a, place, b = polylines.points_at(self.line, [middle - size / 2, middle, middle + size / 2])
        ahead = polylines.unit(b - a)
        side = np.array([-ahead[1], ahead[0]])
        return shapely.transform(
            symbol, lambda uv: place + (uv[:, :1] - size / 2) * ahead + (uv[:, 1:] + left) * side
        )


def symbol_rows(
    roads: Carriageways,
    stretches: PaintedStretches,
    *,
    edge: NDArray[np.int32],
    taken: NDArray[np.object_],
    left_hand: bool,
) -> SurfaceRows:
    """Symbols on lanes, as the tags of their ways say (`geoscene.roadgraph.lane_uses`).

    taken : shapely polygons of what else is on roads: crossings, stop lines
    """
    used = np.array([bool(roads.uses[row]) for row in stretches.row.tolist()], np.bool_)
    own = stretches.take(np.flatnonzero(used))
    bands = carriageway(own.line, roads.width[own.row] / 2)
    which, other = shapely.STRtree(taken).query(bands, predicate="intersects")
    blocks: dict[int, list[tuple[float, float]]] = {}
    for k, shape in zip(which.tolist(), taken[other], strict=True):
        at = shapely.line_locate_point(own.line[k], shapely.points(shapely.get_coordinates(shape)))
        blocks.setdefault(k, []).append((float(at.min()), float(at.max())))

    zones = _zones(roads)
    shapes, rows, sources = [], [], []
    for k, row in enumerate(own.row.tolist()):
        for side in (0, 1):
            if roads.street[row].direction == (-1 if side == 0 else 1):
                continue
            xy = shapely.get_coordinates(own.line[k])
            length = polylines.length(xy)
            at = blocks.get(k, [])
            travel = _Travel(xy, length, list(at))
            if side:
                travel = _Travel(xy[::-1], length, [(length - b, length - a) for a, b in at])
            enters = zones[int(roads.ends[row, side])] != {roads.uses[row].speed}
            for source, shape in _symbols(
                travel, roads, stretch=own.take([k]), side=side, enters=enters, left_hand=left_hand
            ):
                shapes.append(shape)
                rows.append(row)
                sources.append(f"{source}/default")
    of = np.array(rows, np.int64)
    return SurfaceRows.of(
        np.array(shapes, object),
        klass=Class.LANE_MARKING,
        material="lane_paint",
        priority=PRIORITY,
        osm_id=roads.osm_id[of],
        source=np.array(sources, np.str_),
        place=roads.place[of],
        level=roads.layer[of],
        edge=edge[of],
    )


def _zones(roads: Carriageways) -> list[set[str]]:
    """Limits of the zones of the carriageways at each node (n,); "" is of those outside of zones."""
    found: list[set[str]] = [set() for _ in range(len(roads.node_id))]
    for ends, uses in zip(roads.ends.tolist(), roads.uses, strict=True):
        for node in ends:
            found[node].add(uses.speed if uses.zone else "")
    return found


def _symbols(
    travel: _Travel,
    roads: Carriageways,
    *,
    stretch: PaintedStretches,
    side: int,
    enters: bool,
    left_hand: bool,
) -> Iterator[tuple[str, Any]]:
    """Symbols of one direction of one stretch, each with its tag.

    side   : 0 along the line, 1 against it
    enters : traffic comes from outside the zone
    """
    row = int(stretch.row[0])
    street, uses, layout = roads.street[row], roads.uses[row], stretch.layout
    lanes = int(layout.own[0] if side == 0 or street.direction else layout.other[0])
    left = _middles(stretch, uses, lanes=lanes, side=side, left_hand=left_hand)

    turns = uses.turns[side]
    for k in range(_ARROWS if any(turns) else 0):
        start = travel.placed(travel.length - _BEFORE - ARROW - k * _BETWEEN, ARROW, back=True)
        if start is None:
            break
        travel.taken.append((start, start + ARROW))
        for lane, turn in enumerate(turns):
            if turn:
                yield "turn", travel.laid(arrow(turn, left_hand=left_hand), start, left=left[lane])
    buses = {lane for lane in uses.bus[side] if lane < lanes}
    if buses:
        for start in _repeat(travel, word("BUS"), kind="bus"):
            for lane in sorted(buses):
                yield "busway", travel.laid(word("BUS"), start, left=left[lane])
    if uses.speed and (enters or not uses.zone):
        for start in _repeat(travel, word(uses.speed), kind="speed"):
            for lane in sorted(set(range(lanes)) - buses):
                yield "maxspeed", travel.laid(word(uses.speed), start, left=left[lane])
    for which, cycle in enumerate(uses.cycle):
        on_left = which == side  # as seen in the direction of travel
        usual = street.direction != 0 or on_left == left_hand
        if cycle is None or usual == cycle.against:
            continue
        aside = _cycle_offset(cycle, stretch, one_way=street.direction != 0)
        mark = bicycle(chevrons=cycle.kind == "shared")
        for start in _repeat(travel, mark, kind=cycle.kind):
            yield "cycleway", travel.laid(mark, start, left=aside if on_left else -aside)


def _middles(
    stretch: PaintedStretches, uses: LaneUses, *, lanes: int, side: int, left_hand: bool
) -> list[float]:
    """Metres to the left of the line of the middle of each lane, from the left one to the right one.

    Of lanes that a cycle lane lies on, the middle of what it leaves.
    """
    layout = stretch.layout
    width, half = float(layout.width[0]), float(layout.span[0]) / 2
    from_kerb = np.arange(lanes) if left_hand else np.arange(lanes)[::-1]
    kept = 1.0 if left_hand else -1.0
    edges = kept * (half - (from_kerb[:, None] + [0.0, 1.0]) * width)
    # Cycle lanes on the left and right, as seen in the direction of travel.
    beside = uses.cycle[::-1] if side else uses.cycle
    free = [
        np.inf
        if cycle is None or cycle.kind == "shared"
        else float(layout.carriageway[0]) / 2 - cycle.inset - cycle.width
        for cycle in beside
    ]
    clipped = np.clip(edges, -free[1], free[0])
    wide = np.abs(clipped[:, 0] - clipped[:, 1]) > _LEAST
    middle: list[float] = np.where(wide, clipped.mean(axis=1), edges.mean(axis=1)).tolist()
    return middle


def _repeat(travel: _Travel, symbol: Any, *, kind: str) -> Iterator[float]:
    """Stations of a symbol that is repeated along a stretch; of a limit that is not, the first."""
    size = float(symbol.bounds[2])
    start: float | None = _AFTER[kind]
    while start is not None and (start := travel.placed(start, size, back=False)) is not None:
        travel.taken.append((start, start + size))
        yield start
        start = start + _EVERY[kind] if np.isfinite(_EVERY[kind]) else None


def _cycle_offset(cycle: CycleLane, stretch: PaintedStretches, *, one_way: bool) -> float:
    """Metres from the centre line to the middle of a cycle lane, or of the outermost lane if it is shared."""
    layout = stretch.layout
    if cycle.kind != "shared":
        return float(layout.carriageway[0]) / 2 - cycle.inset - cycle.width / 2
    if int(layout.count[0]) == 1:
        return 0.0 if one_way else float(layout.carriageway[0]) / 4
    return float(layout.span[0] - layout.width[0]) / 2

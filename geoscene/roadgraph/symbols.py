"""Symbols on lanes: arrows before junctions, bicycles, words, speed limits.

Frame of a symbol: u along the lane in the direction of travel from 0, v to the left, metres. Symbols are
drawn out along the lane, so that drivers see them upright. Sizes are close to those of RMS (Germany: arrows
of 5 m in towns) and the MUTCD (bicycles of 1.8 m); proportions are assumed.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import affinity

from geoscene.classes import Class
from geoscene.geometry import polylines
from geoscene.roadgraph.carriageways import Carriageways
from geoscene.roadgraph.junctions import carriageway
from geoscene.roadgraph.lane_uses import CycleLane, LaneUses
from geoscene.roadgraph.markings import PRIORITY, PaintedStretches
from geoscene.roadgraph.surface_rows import SurfaceRows
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

ARROW = 5.0
"""Length of arrows."""

_STEM = 0.15
_HEAD, _HALF = 1.6, 0.3
# Of a turn: its heads' half width along the lane, where it begins beside the stem and ends.
_SIDE, _FROM, _TIP = 0.8, 0.30, 0.95
_STROKE = 0.13
_LETTER, _TALL, _SPACE = 0.5, 1.8, 0.3
_WHEEL, _APART, _STRETCH, _TYRE = 0.24, 0.33, 1.7, 0.09

_Line = Sequence[tuple[float, float]]

# Strokes of letters and digits in a square of side 1, x to the right and y up.
_RIGHT_BOWL: _Line = ((0.7, 0.52), (1, 0.42), (1, 0.1), (0.7, 0), (0.3, 0), (0, 0.1))
_ROUND: _Line = ((0.3, 0), (0.7, 0), (1, 0.1), (1, 0.9), (0.7, 1), (0.3, 1), (0, 0.9), (0, 0.1), (0.3, 0))
_SIX: _Line = (
    (1, 0.9), (0.7, 1), (0.3, 1), (0, 0.9), (0, 0.1), (0.3, 0), (0.7, 0), (1, 0.1), (1, 0.45), (0.7, 0.55),
    (0, 0.55),
)  # fmt: skip
_STROKES: dict[str, tuple[_Line, ...]] = {
    "0": (_ROUND,),
    "1": (((0.2, 0.8), (0.6, 1), (0.6, 0)),),
    "2": (((0, 0.88), (0.3, 1), (0.7, 1), (1, 0.88), (1, 0.6), (0.02, 0.03), (1, 0.03)),),
    "3": (((0, 0.9), (0.3, 1), (0.7, 1), (1, 0.9), (1, 0.62), *_RIGHT_BOWL), ((0.3, 0.52), (0.72, 0.52))),
    "4": (((0.75, 0), (0.75, 1), (0, 0.3), (1, 0.3)),),
    "5": (((0.95, 0.97), (0.05, 0.97), (0.05, 0.55), (0.7, 0.55), *_RIGHT_BOWL[1:]),),
    "6": (_SIX,),
    "7": (((0, 0.97), (0.95, 0.97), (0.35, 0)),),
    "8": (_ROUND, ((0, 0.52), (1, 0.52))),
    "9": (tuple((1 - x, 1 - y) for x, y in _SIX),),
    "B": (
        ((0, 0.03), (0, 0.97), (0.7, 0.97), (1, 0.87), (1, 0.62), (0.7, 0.52), (1, 0.42), (1, 0.13),
         (0.7, 0.03), (-0.1, 0.03)),
        ((0, 0.52), (0.72, 0.52)),
    ),
    "S": (((1, 0.9), (0.7, 1), (0.3, 1), (0, 0.9), (0, 0.62), (0.3, 0.52), *_RIGHT_BOWL),),
    "U": (((0, 1), (0, 0.1), (0.3, 0), (0.7, 0), (1, 0.1), (1, 1)),),
}  # fmt: skip


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
            lanes = int((own.layout.own if side == 0 else own.layout.other)[k])
            if roads.street[row].direction == (-1 if side == 0 else 1) and not lanes:
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
    lanes = int(layout.own[0] if side == 0 else layout.other[0])
    against = street.direction == (-1 if side == 0 else 1)  # only buses and bicycles ride there
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
    bicycles = {lane for lane in uses.bicycles[side] if lane < lanes}
    if bicycles:
        for start in _repeat(travel, bicycle(), kind="lane"):
            for lane in sorted(bicycles):
                yield "cycleway", travel.laid(bicycle(), start, left=left[lane])
    if uses.speed and (enters or not uses.zone) and not against:
        for start in _repeat(travel, word(uses.speed), kind="speed"):
            for lane in sorted(set(range(lanes)) - buses - bicycles):
                yield "maxspeed", travel.laid(word(uses.speed), start, left=left[lane])
    for which, cycle in enumerate(() if against else uses.cycle):
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
    borders = layout.borders[0, : int(layout.count[0]) + 1]
    if side:
        borders = -borders[::-1]
    from_kerb = np.arange(lanes) if left_hand else np.arange(lanes)[::-1]
    kept = 1.0 if left_hand else -1.0
    edges = kept * borders[from_kerb[:, None] + [0, 1]]
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


@functools.cache
def arrow(turns: tuple[str, ...], *, left_hand: bool = False) -> Any:
    """The arrow of a lane, a polygon of `ARROW` length: values of ``turn:lanes``, as in (left, through).

    left_hand : traffic keeps left, and turns back on the right
    """
    merging = [turn for turn in turns if turn.startswith("merge")]
    if merging:
        lean = np.degrees(np.arctan2(0.8, ARROW)) * (1 if merging[0] == "merge_to_left" else -1)
        return affinity.rotate(_straight(ARROW), lean, origin=(ARROW / 2, 0))
    parts = [_straight(ARROW)] if "through" in turns or not turns else []
    # Beside the head of a straight arrow, branches leave the stem lower; those of one side below each other.
    top = 2.5 if parts else ARROW - _SIDE
    reach = 0.0
    for side in (1.0, -1.0):
        own = [turn for turn in turns if _side(turn, left_hand=left_hand) == side]
        own.sort(key=lambda turn: turn == "reverse")
        for turn, level in zip(
            own, np.linspace(top, max(top - 1.5 * len(own) + 1.5, 2.05), len(own)), strict=True
        ):
            branch, joint = _branch(turn, float(level))
            parts.append(affinity.scale(branch, 1.0, side, origin=(0, 0)))
            reach = max(reach, joint)
    return shapely.union_all([*parts, shapely.box(0, -_STEM / 2, reach, _STEM / 2)])


def _side(turn: str, *, left_hand: bool) -> float:
    """1 for turns to the left, -1 to the right, 0 for none."""
    if turn == "reverse":
        return -1.0 if left_hand else 1.0
    return 1.0 if "left" in turn else -1.0 if "right" in turn else 0.0


def _straight(length: float) -> Any:
    neck = length - _HEAD
    half = _STEM / 2
    return shapely.Polygon(
        [(0, -half), (neck, -half), (neck, -_HALF), (length, 0), (neck, _HALF), (neck, half), (0, half)]
    )


def _branch(turn: str, at: float) -> tuple[Any, float]:
    """The part of an arrow that leaves the stem to the left, with its head about u = at; where it leaves."""
    if turn == "reverse":
        back = shapely.LineString([(at - 1.2, 0), (at, 0.1), (at + 0.3, 0.35), (at, 0.6), (at - 0.6, 0.68)])
        head = shapely.Polygon([(at - 0.5, 0.68 - _HALF), (at - 0.5, 0.68 + _HALF), (at - 2.0, 0.68)])
        return shapely.union_all([_stroke(back, _STEM), head]), at - 1.2
    if turn.startswith("slight"):
        bend = shapely.LineString([(at - 1.6, 0), (at - 0.6, 0.12), (at, 0.35)])
        head = shapely.Polygon([(at + 1.0 - 0.15, 0.70), (at - 0.35, 0.57), (at + 0.1, 0.12)])
        return shapely.union_all([_stroke(bend, _STEM), head]), at - 1.6
    back = 0.5 if turn.startswith("sharp") else 0.0
    bend = shapely.LineString([(at - 1.2, 0), (at - 0.45, 0.05), (at, _FROM + 0.02)])
    head = shapely.Polygon([(at - _SIDE, _FROM), (at + _SIDE, _FROM), (at - back, _TIP)])
    return shapely.union_all([_stroke(bend, _STEM), head]), at - 1.2


def _stroke(line: Any, width: float) -> Any:
    return line.buffer(width / 2, cap_style="flat", join_style="mitre", mitre_limit=2.0)


@functools.cache
def word(text: str) -> Any:
    """Letters or digits side by side, about v = 0; of `_STROKES`."""
    parts = []
    for k, letter in enumerate(text):
        left = (len(text) * _LETTER + (len(text) - 1) * _SPACE) / 2 - k * (_LETTER + _SPACE)
        for line in _STROKES[letter]:
            places = [(y * _TALL, left - x * _LETTER) for x, y in line]
            closed = places[0] == places[-1]
            pen = shapely.LinearRing(places) if closed else shapely.LineString(places)
            parts.append(_stroke(pen, _STROKE))
    joined = shapely.union_all(parts)
    return affinity.translate(joined, -joined.bounds[0], 0)


@functools.cache
def bicycle(*, chevrons: bool = False) -> Any:
    """A bicycle 1.2 m wide; with two chevrons ahead, the mark of a lane that is shared with cars."""
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    parts = []
    for aside in (_APART, -_APART):
        outer, inner = (
            np.column_stack([_STRETCH * (_WHEEL + r * np.cos(turn)), aside + r * np.sin(turn)])
            for r in (_WHEEL, _WHEEL - _TYRE)
        )
        parts.append(shapely.Polygon(outer, [inner]))
    hub, top = _STRETCH * _WHEEL, 1.15
    frame = (
        [(hub, _APART), (top, 0.12), (top, -0.22), (hub, 0.02), (top, 0.12)],
        [(hub, _APART), (hub, 0.02)],
        [(hub, -_APART), (1.5, -0.19), (1.5, -0.36)],
        [(hub, 0.02), (1.32, 0.16)],
        [(1.32, 0.04), (1.32, 0.28)],
    )
    parts.extend(_stroke(shapely.LineString(line), 0.08) for line in frame)
    starts = (2.0, 2.7) if chevrons else ()
    lines = [shapely.LineString([(u, 0.5), (u + 0.45, 0), (u, -0.5)]) for u in starts]
    parts.extend(_stroke(line, 0.12) for line in lines)
    return shapely.simplify(shapely.union_all(parts), 0.004)

"""Grading: terrain filled up to ramps, cut down to underpasses and levelled across carriageways."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry import polylines
from geoscene.geometry.frames import Frame
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.longitudinal_profile import Obstacles
from geoscene.roadgraph.paths import way_lines
from geoscene.roadgraph.tags import place_and_layer
from geoscene.sources.data import OsmData, Tags
from geoscene.support.columns import Columns, squares_between
from geoscene.support.compiled import njit
from geoscene.typing import Bools, Float, Height, Ints

_SHARP = 0.002
"""Where carriageways overlap, a road counts for most near its middle: the less this is, the more so."""

_PAST, _MOUTH = 1e-4, 0.1
"""Weight of a road from so many metres beyond the end at which a bridge or a tunnel begins: streets that
cross there keep their height."""

PARALLEL = 0.85
"""Cosine of the greatest angle at which one road runs beside another rather than across it."""

_BEYOND = 0.3
"""Metres beyond the edge of a road to which the ground follows bridges and tunnels that begin at its side."""

_CUT = 0.5
"""Rise over run of the slopes of cuts and fills in surveyed ground: 1 to 2, usual in soil."""

_LEVEL = 1e-6
"""Metres: lower roads on level ground count as level."""

# Metres of clearance below bridges (railways: EN 15273 with overhead line; small waterways: a rowing boat).
_CLEAR = {
    "railway": {"rail": 5.7, "light_rail": 5.0, "tram": 4.7, "subway": 4.5, "narrow_gauge": 4.5},
    "waterway": {"river": 3.0, "canal": 3.0, "stream": 1.0, "ditch": 0.5, "drain": 0.5},
}


def find_obstacles(osm: OsmData, frame: Frame) -> Obstacles:
    """Railways and waterways on the ground that bridges must clear."""
    ways, lines = way_lines([way for way in osm.ways if required_clearance(way.tags) is not None], frame)
    return Obstacles(lines, np.array([required_clearance(way.tags) for way in ways], float))


def required_clearance(tags: Tags) -> float | None:
    """Metres of free height that a railway or waterway on the ground requires; None for other ways."""
    if place_and_layer(tags)[0] != 0:
        return None
    for key, heights in _CLEAR.items():
        if tags.get(key) in heights:
            return heights[tags[key]]
    return None


def graded_ground(
    graph: RoadGraph,
    ground: Height,
    *,
    level: bool = False,
    surveyed: bool = False,
    shoulder: float = 2.5,
    batter: float = 8.0,
) -> Height:
    """The terrain with roads graded into it: a function of x, y (n,) that returns z (n,).

    Within a carriageway and its shoulder the ground is level across, at the road's profile; over the next
    ``batter`` metres it blends into the terrain. Where roads meet, the nearer one has the greater weight.
    Bridges and tunnels do not change the terrain; the grading ends square where they begin.

    graph    : with heights, from `profile`
    ground   : height of the terrain
    level    : the terrain is 0 everywhere, so that only roads near ramps count
    surveyed : the terrain shows the roads as they were built: it is kept beyond the shoulder, but where it is
               over a cut or under a fill with slopes of 1 to 2. Graded again, such ground stays as it is
    """
    once = np.flatnonzero(graph.once & ~graph.bridge & ~graph.tunnel)
    if not len(once):
        return ground
    begun = structure_starts(graph)
    lines = [*graph.geometry[once], *begun.line]
    start = np.concatenate([line[:-1] for line in lines])
    end = np.concatenate([line[1:] for line in lines])
    width = graph.width[np.append(once, begun.edge)]
    half = np.repeat(width / 2 + shoulder, [len(line) - 1 for line in lines])
    structure = graph.bridge | graph.tunnel
    mouth = np.zeros(len(graph.node_id), np.bool_)
    mouth[graph.tail[structure]] = mouth[graph.head[structure]] = True
    sizes = np.array([len(line) - 1 for line in lines])
    last = np.cumsum(sizes) - 1
    square_ends = np.zeros((len(start), 2), np.bool_)
    roads = np.arange(len(once))
    square_ends[(last - sizes + 1)[roads], 0] = mouth[graph.tail[once]]
    square_ends[last[roads], 1] = mouth[graph.head[once]]
    square_ends[last[len(once) :], 1] = True
    pieces = shapely.linestrings(np.stack([start[:, :2], end[:, :2]], axis=1))
    reach = float(half.max()) + batter
    rows = _beside_ramps(pieces, start, end=end, reach=2 * reach) if level else np.arange(len(pieces))
    rows = rows[shapely.STRtree(pieces[rows]).query(shapely.box(*shapely.total_bounds(pieces)))]
    table = _Pieces.of(start[rows], end[rows], half=half[rows], square_ends=square_ends[rows], batter=batter)
    return partial(_graded_height, ground=ground, roads=table, surveyed=surveyed)


@dataclass(frozen=True, slots=True)
class Starts(Columns):
    """First metres of bridges and tunnels that begin at the side of a road, within its carriageway.

    line : (n,) object, (k, 3) float64 scene metres, from the node on
    edge, node : (n,) int64
    """

    line: NDArray[np.object_]
    edge: Ints
    node: Ints


def structure_starts(graph: RoadGraph) -> Starts:
    """The first metres of bridges and tunnels that lie on the ground of the road where they begin."""
    single = graph.once
    structure = graph.bridge | graph.tunnel
    ends = np.unique(np.concatenate([graph.tail[structure], graph.head[structure]]))
    arms: dict[int, list[tuple[Float, float]]] = {}
    for node, step in ((graph.tail, 1), (graph.head, -1)):
        for edge in np.flatnonzero(single & ~structure & np.isin(node, ends)).tolist():
            ahead = _first_direction(graph.geometry[edge][::step])
            arms.setdefault(int(node[edge]), []).append((ahead, float(graph.width[edge]) / 2))
    lines, edges, nodes = [], [], []
    for edge in np.flatnonzero(single & structure).tolist():
        for node, step in ((graph.tail, 1), (graph.head, -1)):
            line = graph.geometry[edge][::step]
            ahead, metres = _first_direction(line), 0.0
            for other, half in arms.get(int(node[edge]), []):
                if abs(float(ahead @ other)) < PARALLEL:
                    metres = max(metres, half / float(np.sqrt(1.0 - (ahead @ other) ** 2)) + _BEYOND)
            metres = min(metres, polylines.length(line) / 2)
            if metres > 0.0:
                lines.append(polylines.cut(line, 0.0, end=metres))
                edges.append(edge)
                nodes.append(int(node[edge]))
    column = np.fromiter(lines, object, len(lines))
    return Starts(column, np.array(edges, np.int64), np.array(nodes, np.int64))


def _first_direction(line: Float) -> Float:
    """Unit vector (2,) along the first metres of a line."""
    return polylines.unit(polylines.points_at(line[:, :2], [2.0])[0] - line[0, :2])


def _beside_ramps(pieces: NDArray[np.object_], start: Float, *, end: Float, reach: float) -> Ints:
    """Rows of the road pieces above or below the ground, and of those within ``reach`` metres."""
    ramps = pieces[np.maximum(np.abs(start[:, 2]), np.abs(end[:, 2])) > _LEVEL]
    return np.unique(shapely.STRtree(pieces).query(ramps, predicate="dwithin", distance=reach)[1])


@dataclass(frozen=True, slots=True)
class _Pieces:
    """Road pieces that the ground is graded to, indexed by squares of a grid.

    start, end  : (n, 3) metres
    half        : (n,) half of the width with shoulders
    square_ends : (n, 2) whether the grading ends square at the start and the end
    batter      : metres beyond the shoulder in which the ground blends into the terrain
    side        : metres of the squares
    corner      : (2,) numbers of the grid's first column and row
    shape       : (2,) numbers of columns and rows
    square      : (k,) sorted numbers of the squares with pieces in reach, column by column
    first       : (k + 1,) where the pieces of each of them begin in ``piece``
    piece       : (m,) rows of pieces, ascending in each square
    """

    start: Float
    end: Float
    half: Float
    square_ends: Bools
    batter: float
    side: float
    corner: Ints
    shape: Ints
    square: Ints
    first: Ints
    piece: Ints

    @classmethod
    def of(cls, start: Float, end: Float, *, half: Float, square_ends: Bools, batter: float) -> _Pieces:
        """The table of pieces; see the columns."""
        reach = float(half.max(initial=0.0)) + batter
        side = 2 * reach
        ends = np.stack([start[:, :2], end[:, :2]])
        low = np.floor((ends.min(axis=0) - reach) / side).astype(np.int64)
        high = np.floor((ends.max(axis=0) + reach) / side).astype(np.int64)
        corner = low.min(axis=0, initial=0)
        shape = (high + 1).max(axis=0, initial=0) - corner
        found, piece = squares_between(low - corner, high - corner)
        number = found[:, 0] * shape[1] + found[:, 1]
        order = np.argsort(number, kind="stable")
        square, first = np.unique(number[order], return_index=True)
        first = np.append(first, len(order))
        return cls(start, end, half, square_ends, batter, side, corner, shape, square, first, piece[order])


def _graded_height(x: Float, y: Float, *, ground: Height, roads: _Pieces, surveyed: bool) -> Float:
    """The height of `graded_ground`; a function of a module, so that worker processes can take it."""
    z = np.asarray(ground(x, y), float)
    places = (roads.square, roads.first, roads.piece, roads.corner, roads.shape, roads.side)
    pieces = (roads.start, roads.end, roads.half, roads.square_ends, roads.batter)
    road_z, most, near = _weigh(
        np.ascontiguousarray(x, float), np.ascontiguousarray(y, float), places, pieces
    )
    road_z = np.where(near, road_z, z)
    if surveyed:
        # steeper towards the end of the reach, so that high fills and deep cuts end there without a step
        with np.errstate(divide="ignore"):
            free_of = _CUT * roads.batter * (1.0 - most) / most
        return np.where(near, np.clip(z, road_z - free_of, road_z + free_of), z)
    blend = most * most * (3.0 - 2.0 * most)
    graded: Float = z + blend * (road_z - z)
    return graded


@njit(cache=True, nogil=True, error_model="numpy")
def _weigh(
    x: Float,
    y: Float,
    places: tuple[Ints, Ints, Ints, Ints, Ints, float],
    pieces: tuple[Float, Float, Float, Bools, float],
) -> tuple[Float, Float, Bools]:
    """The height of the roads at points (n,), the greatest share that one has there, and whether any has.

    places, pieces : columns of `_Pieces`: those of the grid, and of the pieces
    """
    square, first, piece, corner, shape, side = places
    start, end, half, square_ends, batter = pieces
    z, most, near = np.zeros(len(x)), np.zeros(len(x)), np.zeros(len(x), np.bool_)
    for p in range(len(x)):
        column, row = int(np.floor(x[p] / side)) - corner[0], int(np.floor(y[p] / side)) - corner[1]
        if not (0 <= column < shape[0] and 0 <= row < shape[1]):
            continue
        number = column * shape[1] + row
        at = np.searchsorted(square, number)
        if at == len(square) or square[at] != number:
            continue
        total = heights = 0.0
        for r in piece[first[at] : first[at + 1]]:
            along_x, along_y = end[r, 0] - start[r, 0], end[r, 1] - start[r, 1]
            metres2 = max(along_x * along_x + along_y * along_y, 1e-12)
            free = ((x[p] - start[r, 0]) * along_x + (y[p] - start[r, 1]) * along_y) / metres2
            t = min(max(free, 0.0), 1.0)
            away = math.hypot(x[p] - (start[r, 0] + t * along_x), y[p] - (start[r, 1] + t * along_y))
            beyond = max(away - half[r], 0.0)
            if beyond >= batter:
                continue
            ahead = abs(free - t) * math.sqrt(metres2)
            blunt = ahead > 0 and square_ends[r, 0 if free < t else 1]
            if blunt:
                aside = math.sqrt(max(away * away - ahead * ahead, 0.0)) - half[r]
                beyond = math.hypot(max(aside, 0.0), ahead)
            share = min(max(1.0 - beyond / batter, 0.0), 1.0)
            nearness = away / half[r]
            fall = _SHARP + nearness * nearness
            weight = share * share / (fall * fall)
            if blunt and ahead > _MOUTH:
                weight *= _PAST
            total += weight
            heights += weight * (start[r, 2] + t * (end[r, 2] - start[r, 2]))
            most[p] = max(most[p], share)
        near[p] = total > 0
        z[p] = heights / total if total > 0 else 0.0
    return z, most, near

"""Streets between and in buildings: carriageways yield to walls that the map has, and end at them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry import polylines
from geoscene.geometry.frames import Frame
from geoscene.roadgraph.clipping import Stretches
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.tags import Street, is_passage
from geoscene.roadgraph.values import Remarks
from geoscene.sources.data import Way
from geoscene.support.problems import Problem
from geoscene.typing import Float, Ints

IN_CARRIAGEWAY = "building-in-carriageway"
"""Reason of a problem: a building stands in a carriageway, however narrow that was made."""
CLOSED = "closed-by-building"
"""Reason of a problem: a street ends in a building, and so at its wall."""
HEADROOM = 2.5
"""Metres above the ground from which on a building does not stand in a carriageway."""
NARROWEST_CAR_LANE = 2.5
"""Metres between walls that a car passes, with a third of a metre on each side."""
_STEP = 0.25
"""Metres: widths between walls are whole multiples of it, so that few places change them."""
_LEAST = 0.05
"""Metres by which a building stands in a carriageway at least: maps are no better than that."""

_BEFORE = 0.1
"""Metres before a wall at which a street ends."""


@dataclass(frozen=True, slots=True)
class Walls:
    """Footprints of buildings that stand on the ground.

    footprint : (n,) shapely polygons, scene metres
    osm_id    : (n,) str
    """

    footprint: NDArray[np.object_]
    osm_id: NDArray[np.str_]

    @classmethod
    def of(cls, footprint: NDArray[np.object_], osm_id: NDArray[np.str_], *, min_height: Float) -> Walls:
        """Those of buildings without room for a car below; ``min_height`` (n,) metres above the ground."""
        low = np.flatnonzero(min_height < HEADROOM)
        return cls(footprint[low], osm_id[low])


def yield_to_walls(
    ways: Sequence[Way], streets: Sequence[Street], *, remarks: Sequence[Remarks], walls: Walls, frame: Frame
) -> tuple[list[Way], list[Street], list[Remarks]]:
    """The ways, cut where their widths change, with streets that are as wide as the walls beside them allow.

    Only widths that the map has not narrow, segment by segment, down to `NARROWEST_CAR_LANE` for each mapped
    lane, or for the whole street. Remarks name the buildings that still stand in a carriageway.
    """
    free = [_may_meet_walls(way, street) for way, street in zip(ways, streets, strict=True)]
    rows = np.flatnonzero(np.array(free, np.bool_))
    lines = [np.stack(frame.from_geographic(*ways[k].lonlat.T), axis=1) for k in rows.tolist()]
    if not lines or not len(walls.footprint):
        return list(ways), list(streets), list(remarks)
    way = np.repeat(rows, [len(line) - 1 for line in lines])
    segments = shapely.linestrings(np.concatenate([np.stack([xy[:-1], xy[1:]], axis=1) for xy in lines]))
    half = np.array([street.width for street in streets])[way] / 2
    wall, segment = _pairs(walls, segments, half=half - _LEAST)
    distance = shapely.distance(walls.footprint[wall], segments[segment])
    room = np.full(len(segments), np.inf)
    np.minimum.at(room, segment, 2 * distance)
    width = 2 * half
    yields = np.isfinite(room) & np.array([_is_assumed(streets[k]) for k in way.tolist()], np.bool_)
    least = np.array([_least_width(streets[k]) for k in way.tolist()])
    between = np.maximum(np.floor(room[yields] / _STEP) * _STEP, least[yields])
    width[yields] = np.minimum(width[yields], between)
    _remark_remaining(
        walls,
        remarks,
        pairs=(wall, way[segment]),
        depth=width[segment] / 2 - distance,
    )
    first = np.append(np.searchsorted(way, rows), len(way))
    made: tuple[list[Way], list[Street], list[Remarks]] = ([], [], [])
    at = {int(row): k for k, row in enumerate(rows.tolist())}
    for k, (one, street, remark) in enumerate(zip(ways, streets, remarks, strict=True)):
        own = width[first[at[k]] : first[at[k] + 1]] if k in at else np.empty(0)
        for number, (piece, metres) in enumerate(_pieces(one, own)):
            made[0].append(piece)
            made[1].append(street if metres is None or metres == street.width else _narrowed(street, metres))
            made[2].append(remark if number == 0 else [])
    return made


def find_closed(graph: RoadGraph, walls: Walls) -> tuple[Stretches, list[Problem]]:
    """Stretches of streets on the ground in buildings, as `leave_out` takes them, and rows that name these.

    Streets that lead through a building have a passage there; these end in it, as in garages and car parks.
    """
    streets = np.flatnonzero(graph.once & ~graph.bridge & ~graph.tunnel)
    lines = [graph.geometry[street] for street in streets.tolist()]
    if not lines or not len(walls.footprint):
        return {}, []
    street = np.repeat(streets, [len(line) - 1 for line in lines])
    first = np.concatenate([polylines.stations(line)[:-1] for line in lines])
    ends = np.concatenate([np.stack([line[:-1, :2], line[1:, :2]], axis=1) for line in lines])
    segments = shapely.linestrings(ends)
    segment, wall = shapely.STRtree(walls.footprint).query(segments, predicate="intersects")
    within = shapely.buffer(walls.footprint, -_LEAST, join_style="mitre")
    enters = shapely.intersects(segments[segment], within[wall])
    entered = set(zip(street[segment[enters]].tolist(), wall[enters].tolist(), strict=True))
    inside, piece = shapely.get_parts(
        shapely.intersection(segments[segment], walls.footprint[wall]), return_index=True
    )
    found: Stretches = {}
    metres: dict[tuple[str, str], float] = {}
    for part, k in zip(inside, piece.tolist(), strict=True):
        edge, building = int(street[segment[k]]), int(wall[k])
        if (edge, building) in entered:
            along = np.hypot(*(shapely.get_coordinates(part) - ends[segment[k], 0]).T) + first[segment[k]]
            start, end = float(along.min()) - _BEFORE, float(along.max()) + _BEFORE
            last = polylines.length(graph.geometry[edge])
            found.setdefault(edge, []).append((max(start, 0.0), min(end, last)))
            names = str(graph.osm_id[edge]), str(walls.osm_id[building])
            metres[names] = metres.get(names, 0.0) + float(np.ptp(along))
    problems = [
        Problem(name, "road", "dropped", CLOSED, f"{length:.1f} m in {building}, which has no passage")
        for (name, building), length in sorted(metres.items())
    ]
    return found, problems


def _may_meet_walls(way: Way, street: Street) -> bool:
    """Whether a way runs on the ground, outside buildings, and has all its nodes."""
    on_ground = not street.bridge and not street.tunnel and not is_passage(way.tags)
    return on_ground and len(way.nodes) > 1 and bool(np.isfinite(way.lonlat).all())


def _is_assumed(street: Street) -> bool:
    """Whether the metres of a street's width are not from the map."""
    return street.width_source in ("default", "lanes") and not any(street.aside)


def _least_width(street: Street) -> float:
    lanes = sum(street.lanes) if street.lanes_source == "lanes" else 1.0
    return min(NARROWEST_CAR_LANE * max(lanes, 1.0), street.width)


def _pairs(walls: Walls, segments: NDArray[np.object_], *, half: Float) -> tuple[Ints, Ints]:
    """Pairs of buildings and segments that are nearer than half the carriageway."""
    segment, wall = shapely.STRtree(walls.footprint).query(segments, predicate="dwithin", distance=half)
    order = np.lexsort([wall, segment])
    return wall[order], segment[order]


def _remark_remaining(
    walls: Walls, remarks: Sequence[Remarks], *, pairs: tuple[Ints, Ints], depth: Float
) -> None:
    """Remark on the buildings that stand in carriageways: the deepest place of each with each way."""
    deepest: dict[tuple[int, int], float] = {}
    for wall, way, metres in zip(*(pair.tolist() for pair in pairs), depth.tolist(), strict=True):
        if metres > _LEAST:
            deepest[way, wall] = max(metres, deepest.get((way, wall), 0.0))
    for (way, wall), metres in sorted(deepest.items()):
        text = f"{walls.osm_id[wall]} stands up to {metres:.1f} m within the carriageway"
        remarks[way].append((IN_CARRIAGEWAY, text))


def _pieces(way: Way, width: Float) -> list[tuple[Way, float | None]]:
    """The way in pieces of one width each; None without widths."""
    if not len(width):
        return [(way, None)]
    cuts = [0, *(np.flatnonzero(np.diff(width)) + 1).tolist(), len(width)]
    return [
        (replace(way, nodes=way.nodes[a : b + 1], lonlat=way.lonlat[a : b + 1]), float(width[a]))
        for a, b in pairwise(cuts)
    ]


def _narrowed(street: Street, width: float) -> Street:
    """The street with less width; both directions share a lane where two cars do not pass."""
    lanes = street.lanes
    if street.direction == 0 and street.lanes_source == "default" and width < 2 * NARROWEST_CAR_LANE:
        lanes = (0.5, 0.5)
    return replace(street, width=width, width_source="buildings", lanes=lanes)

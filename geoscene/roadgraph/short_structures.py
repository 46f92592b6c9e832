"""Bridges and tunnels that end within the street that they cross, lengthened to pass it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import shapely

from geoscene.geometry import polylines
from geoscene.geometry.frames import Frame
from geoscene.roadgraph.paths import way_lines
from geoscene.roadgraph.tags import drivable, place_and_layer, read_street
from geoscene.sources.data import OsmData, Way
from geoscene.support.problems import Problem
from geoscene.typing import Float

_MARGIN = 1.0
"""Metres from the edge of a street to the end of a bridge or a tunnel that crosses it, at least."""

_REST = 1.0
"""Metres of the way that follows, at least."""


@dataclass(frozen=True, slots=True)
class _Short:
    """A structure that is too short: its way, which end, the way that follows, metres missing, the street."""

    way: int
    end: int
    following: int
    metres: float
    street: int


def lengthen_structures(osm: OsmData, frame: Frame) -> tuple[OsmData, list[Problem]]:
    """The map with bridges and tunnels that end clear of the streets they cross, and those lengthened.

    Mappers end bridges where the street below ends, or nearer. There the ground would rise from one to the
    other within the street. The missing metres are taken from the way that follows, if there is one.
    """
    ways = [way for way in osm.ways if drivable(way.tags, private=True) and len(way.nodes) > 1]
    ways, lines = way_lines([way for way in ways if np.isfinite(way.lonlat).all()], frame)
    made = {way.osm_id: way for way in ways}
    problems = []
    fresh = min((int(way.nodes.min(initial=0)) for way in osm.ways), default=0) - 1
    for short in _find_short(ways, lines):
        own, rest = made[ways[short.way].osm_id], made[ways[short.following].osm_id]
        longer = _moved(
            own, rest, node=int(ways[short.way].nodes[-short.end]), short=short, fresh=fresh, frame=frame
        )
        if longer is None:
            continue
        fresh -= 1
        made[own.osm_id], made[rest.osm_id] = longer
        what = "bridge" if place_and_layer(own.tags)[0] == 1 else "tunnel"
        detail = f"ended within {ways[short.street].osm_id}, which it crosses; {short.metres:.1f} m longer"
        problems.append(Problem(own.osm_id, "road", "repaired", f"short-{what}", detail))
    if not problems:
        return osm, []
    return replace(osm, ways=[made.get(way.osm_id, way) for way in osm.ways]), problems


def _find_short(ways: list[Way], lines: np.ndarray) -> Iterator[_Short]:
    """Structures that end within a street, in order; of several streets at an end the one that needs most."""
    raised = np.array([place_and_layer(way.tags)[0] != 0 for way in ways], np.bool_)
    at: dict[int, set[int]] = defaultdict(set)
    for k, way in enumerate(ways):
        for node in way.nodes.tolist():
            at[node].add(k)
    structures, ground = np.flatnonzero(raised), np.flatnonzero(~raised)
    tree = shapely.STRtree(lines[ground])
    for k in structures.tolist():
        crossed = np.sort(ground[tree.query(lines[k], predicate="crosses")]).tolist()
        crossed = [s for s in crossed if not set(ways[s].nodes.tolist()) & set(ways[k].nodes.tolist())]
        for end in (0, 1):
            others = at[int(ways[k].nodes[-end])] - {k}
            if len(others) != 1 or not crossed:
                continue
            following = others.pop()
            ends = ways[following].nodes[[0, -1]].tolist()
            if raised[following] or int(ways[k].nodes[-end]) not in ends or following in crossed:
                continue
            needs = [(_missing(lines[k], lines[s], end=end, width=_width(ways[s])), s) for s in crossed]
            metres, street = max(needs, key=lambda need: need[0])
            if metres > 0.0:
                yield _Short(k, end, following, metres, street)


def _width(way: Way) -> float:
    return float(read_street(way.tags)[0].width)


def _missing(line: shapely.LineString, street: shapely.LineString, *, end: int, width: float) -> float:
    """Metres by which a line must be longer at its start or end to pass a street of some width."""
    points = shapely.get_coordinates(line.intersection(street))
    at = shapely.line_locate_point(line, shapely.points(points))
    way, other = (
        polylines.directions(
            np.array([one], object), shapely.line_locate_point([one], shapely.points(points[:1])), reach=1.0
        )
        for one in (line, street)
    )
    sine = max(abs(float(polylines.cross(way, other)[0])), 0.5)
    left = line.length - at.max() if end else at.min()
    return float(width / 2 / sine + _MARGIN - left)


def _moved(
    own: Way, rest: Way, *, node: int, short: _Short, fresh: int, frame: Frame
) -> tuple[Way, Way] | None:
    """Both ways after the structure took the first metres of the one that follows; None without them."""
    turned = int(rest.nodes[0]) != node
    nodes, lonlat = (rest.nodes[::-1], rest.lonlat[::-1]) if turned else (rest.nodes, rest.lonlat)
    xy = np.column_stack(frame.from_geographic(*lonlat.T))
    along = polylines.stations(xy)
    if along[-1] < short.metres + _REST:
        return None
    taken = int(np.searchsorted(along, short.metres))
    x, y = polylines.points_at(xy, [short.metres], along=along)[0]
    place: Float = np.column_stack(frame.to_geographic(np.array([x]), np.array([y])))
    more_nodes, more = np.append(nodes[1:taken], fresh), np.concatenate([lonlat[1:taken], place])
    if short.end:
        longer = replace(
            own, nodes=np.append(own.nodes, more_nodes), lonlat=np.concatenate([own.lonlat, more])
        )
    else:
        longer = replace(
            own,
            nodes=np.append(more_nodes[::-1], own.nodes),
            lonlat=np.concatenate([more[::-1], own.lonlat]),
        )
    nodes, lonlat = np.append(fresh, nodes[taken:]), np.concatenate([place, lonlat[taken:]])
    shorter = replace(rest, nodes=nodes[::-1] if turned else nodes, lonlat=lonlat[::-1] if turned else lonlat)
    return longer, shorter

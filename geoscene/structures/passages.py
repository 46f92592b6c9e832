"""Passages: openings of buildings for the ways that run through them on the ground."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings import Buildings
from geoscene.buildings.roof_guesses import without_guess
from geoscene.buildings.table import GRID
from geoscene.geometry.frames import Frame
from geoscene.geometry.polylines import unit
from geoscene.ground.kinds import storey_tag
from geoscene.roadgraph.grading import required_clearance
from geoscene.roadgraph.paths import path_width, way_lines
from geoscene.roadgraph.tags import drivable, is_tunnel, place_and_layer, read_layer, read_street
from geoscene.sources.data import OsmData, Tags, Way, is_building
from geoscene.structures.sheets import areal
from geoscene.support.columns import Columns
from geoscene.support.problems import Problem
from geoscene.tags import parse_length
from geoscene.typing import Bools, Float, Height, Ints

_COVERED = frozenset({"building_passage", "covered", "avalanche_protector"})
"""Values of ``tunnel`` of ways on the ground."""

_ARCADES = frozenset({"arcade", "colonnade"})
"""Values of ``covered`` of ways that are open to one side."""

_TRACKS = frozenset({"rail", "light_rail", "tram", "narrow_gauge", "preserved"})
"""Railways whose tunnels in buildings are on the ground; subways are below it."""

_ROAD, _FOOT = 4.5, 2.5
"""Metres of free height over roads and paths where none is mapped: most signs for low clearances are below
the first (StVO: vehicles up to 4 m), doors and underpasses have the second."""

_TRACK = 4.4
"""Metres: width of a passage of one track."""

_FREE = (1.5, 30.0)
"""Metres, least and greatest free height that is taken from tags."""

_BESIDE = 0.05
"""Metres on both sides of a way in its opening, so that the borders of both do not coincide."""

_ENTERED = 0.05
"""Metres of a way in a building from which it runs through it."""

_NEAR = 1.0
"""Metres from the end of a way to a wall behind which it leaves the building."""

_THIN, _ARCADE = 0.3, 1.2
"""Metres; thinner walls beside a passage, and beside an arcade, are left out."""

_LINTEL = 0.3
"""Metres between an opening whose height is not mapped and the eaves."""

_LOW = 2.0
"""Metres: undersides of parts from here on leave passages free; least height of a passage under low eaves."""

_INTO = 0.05
"""Metres by which an opening is cut beyond walls and into what hangs over it, so that no film is left."""

_TINY = 0.01
"""Square metres; smaller openings are left out."""

_STEP = 2.0
"""Metres between places at which the ground in a passage is looked up."""


@dataclass(frozen=True, slots=True)
class Passages(Columns):
    """Openings of buildings, one row for each way and building.

    polygon  : (n,) object, shapely MultiPolygon, scene metres: what the way takes of the building in plan
    cut      : (n,) object, likewise and some centimetres beyond walls, without what parts whose underside is
               lower leave free
    building : (n,) int64, row of the table of buildings
    width    : (n,) float64 metres
    top      : (n,) float64 metres above the way up to which it is cut, and whether these are not mapped
    guessed  : (n,) bool
    height   : (n,) float64 metres of free height, less than that under low eaves and hanging parts
    height_source : (n,) str: ``height``, ``maxheight:physical``, ``maxheight``, ``default``, or ``building``
               where that is less
    osm_id   : (n,) str, the way
    """

    polygon: NDArray[np.object_]
    cut: NDArray[np.object_]
    building: Ints
    width: Float
    top: Float
    guessed: Bools
    height: Float
    height_source: NDArray[np.str_]
    osm_id: NDArray[np.str_]


def mark_passages(osm: OsmData) -> tuple[OsmData, list[Problem]]:
    """The map with tunnels in buildings as passages, which are on the ground, and these tunnels.

    A tunnel of a road, path or track is one if at least half of its length lies in buildings or their parts
    and no layer or storey below the ground is tagged.
    """
    rows = [k for k, way in enumerate(osm.ways) if _may_be_passage(way.tags)]
    houses = np.array([area.geometry for area in osm.areas if is_building(area.tags)], object)
    if not rows or not len(houses):
        return osm, []
    tree, ways, problems = shapely.STRtree(houses), list(osm.ways), []
    for k in rows:
        way = ways[k]
        line = shapely.LineString(way.lonlat)
        over = shapely.union_all(houses[tree.query(line, predicate="intersects")])
        if line.intersection(over).length < 0.5 * line.length or line.length == 0:
            continue
        ways[k] = replace(way, tags=way.tags | {"tunnel": "building_passage"})
        detail = f"tunnel={way.tags['tunnel']} in a building and without a layer, taken for a passage"
        problems.append(Problem(way.osm_id, "structure", "repaired", "tunnel-in-building", detail))
    return replace(osm, ways=ways), problems


def _may_be_passage(tags: Tags) -> bool:
    """Whether a way is a tunnel of which the map does not say that it is below the ground."""
    if not is_tunnel(tags) or not ("highway" in tags or tags.get("railway") in _TRACKS):
        return False
    layer, source = read_layer(tags, [])
    return source not in ("layer", "level") or layer == 0


def find_passages(osm: OsmData, buildings: Buildings, *, frame: Frame) -> tuple[Passages, list[Problem]]:
    """The passages of a map, in the order of its ways, and those that are not mapped as such.

    A way on the ground has one in each building that its line runs through if it is tagged
    ``tunnel=building_passage`` or ``covered``; a public street also without these tags in a building that
    stands on the ground, unless it ends there, and a parking aisle if both of its ends are outside. It is as
    wide as the way, extended through the wall at which the way ends, and as high as ``height``,
    ``maxheight:physical`` or ``maxheight`` of the way, else 4.5 m over roads, 2.5 m over paths, and the free
    height of the kind of track. Thin walls that would be left beside it are left out; an arcade is open to
    the side.
    """
    drawn = np.flatnonzero(buildings.drawn)
    ways, lines = way_lines([w for w in osm.ways if _is_passage(w.tags) or _is_street(w.tags)], frame)
    loose = _loose_ends(ways, lines, others=osm.ways)
    tree = shapely.STRtree(buildings.footprint[drawn])
    way, found = tree.query(lines, predicate="intersects")
    owner = buildings.outline[drawn[found]]
    rows, problems = [], []
    for k, building in np.unique(np.column_stack([way, owner]), axis=0).tolist():
        mine = drawn[buildings.outline[drawn] == building]
        body = shapely.union_all(buildings.footprint[mine])
        inside = body if _is_arcade(ways[k].tags) else body.buffer(-_INTO, join_style="mitre")
        if shapely.length(shapely.intersection(lines[k], inside)) < _ENTERED:
            continue
        mapped = _is_passage(ways[k].tags)
        if not mapped and shapely.intersects(loose[k], inside):
            continue
        width = _width(ways[k].tags)
        polygon, beyond = _opening(lines[k], body, half=width / 2 + _BESIDE, tags=ways[k].tags)
        if polygon.area < _TINY:
            continue
        top, source = _free_height(ways[k].tags)
        low, plan = buildings.min_height[mine], buildings.footprint[mine]
        grounded = shapely.union_all(plan[low < _LOW])
        hanging = shapely.union_all(plan[(low >= _LOW) & (low < top)])
        free = hanging.difference(grounded).buffer(-_INTO, join_style="mitre")
        into = grounded.intersection(polygon).area > _TINY
        if not (mapped or into):
            continue
        if not mapped:
            detail = f"runs through {buildings.osm_id[building]}, which has no passage; opened"
            problems.append(Problem(ways[k].osm_id, "road", "repaired", "street-in-building", detail))
        cut = areal(beyond.difference(free), least=_TINY) if into else shapely.MultiPolygon()
        guessed = source == "default"
        underside = np.where(low < _LOW, _eaves(buildings, mine) if guessed else np.inf, low)
        own = np.where(low < _LOW, plan, shapely.difference(plan, grounded))
        over = (shapely.area(shapely.intersection(own, polygon)) > _TINY) & (underside >= _LOW)
        height = underside[over].min(initial=top)
        source = source if height == top else "building"
        rows.append((polygon, cut, building, width, top, guessed, height, source, ways[k].osm_id))
    columns: list[Any] = list(zip(*rows, strict=True)) if rows else [()] * 9
    passages = Passages(
        np.fromiter(columns[0], object),
        np.fromiter(columns[1], object),
        np.array(columns[2], np.int64),
        np.array(columns[3], float),
        np.array(columns[4], float),
        np.array(columns[5], np.bool_),
        np.array(columns[6], float),
        np.array(columns[7], np.str_),
        np.array(columns[8], np.str_),
    )
    return passages, problems


def _loose_ends(ways: list[Way], lines: NDArray[np.object_], *, others: list[Way]) -> NDArray[np.object_]:
    """Ends of ways (n,) at which none of the others leads on, and all of parking aisles, as MultiPoints."""
    used = Counter(node for way in others if _leads_on(way.tags) for node in way.nodes.tolist())
    ends = shapely.get_point(lines[:, None], [0, -1])
    loose = np.array(
        [[used[node] < 2 or not _leads_on(way.tags) for node in way.nodes[[0, -1]].tolist()] for way in ways],
        np.bool_,
    )
    found: NDArray[np.object_] = shapely.multipoints(np.where(loose.reshape(-1, 2), ends, None))
    return found


def _eaves(buildings: Buildings, row: Ints) -> Float:
    """Metres from the bases of buildings (k,) to the highest passages under their eaves, or into low ones."""
    level = without_guess(buildings, np.ones(len(buildings), np.bool_))
    most = np.asarray(level.height[row] - _LINTEL, float)
    return np.where(most < _LOW, most, np.maximum(most - level.roof_height[row], _LOW))


def _is_passage(tags: Tags) -> bool:
    """Whether a road, path or track runs on the ground through buildings or under their roofs.

    ``level`` does not take a road with ``tunnel=building_passage`` off the ground.
    """
    inside = tags.get("tunnel") in _COVERED or tags.get("covered", "no") != "no"
    road = tags.get("tunnel") in _COVERED and drivable(tags, private=True)
    on_ground = place_and_layer(tags)[0] == 0 and (road or not storey_tag(tags))
    return inside and on_ground and _width(tags) > 0 and tags.get("indoor", "no") == "no"


def _is_street(tags: Tags) -> bool:
    """Whether a way is a public street on the ground that leads through the buildings on it."""
    on_ground = place_and_layer(tags)[0] == 0 and not storey_tag(tags)
    return drivable(tags) and on_ground and tags.get("indoor", "no") == "no"


def _leads_on(tags: Tags) -> bool:
    """Whether a way is a street, but not in a parking lot or garage."""
    return drivable(tags, private=True) and tags.get("service") != "parking_aisle"


def _is_arcade(tags: Tags) -> bool:
    return tags.get("covered") in _ARCADES


def _width(tags: Tags) -> float:
    """Metres of a way, 0 for one that has no passages."""
    if drivable(tags, private=True):
        return read_street(tags)[0].width
    if tags.get("railway") in _TRACKS:
        return _TRACK
    return path_width(tags)[0]


def _free_height(tags: Tags) -> tuple[float, str]:
    """Metres of free height of a passage, and the tag that they are from."""
    for key in ("height", "maxheight:physical", "maxheight"):
        metres = parse_length(tags.get(key))
        if metres is not None and _FREE[0] <= metres <= _FREE[1]:
            return metres, key
    if drivable(tags, private=True):
        return _ROAD, "default"
    return required_clearance(tags) or _FOOT, "default"


def _opening(line: Any, body: Any, *, half: float, tags: Tags) -> tuple[Any, Any]:
    """What a passage along a line takes of a building's outline ``body``, and likewise beyond its walls."""
    xy = shapely.get_coordinates(line)
    walls = body.boundary
    for end, before in ((0, 1), (-1, -2)):
        place = shapely.Point(xy[end])
        out = xy[end] + (half + _NEAR) * unit(xy[end] - xy[before])
        if place.distance(walls) <= _NEAR and not shapely.intersects_xy(body, *out):
            xy = np.vstack([out, xy] if end == 0 else [xy, out])
    band = shapely.LineString(xy).buffer(half, quad_segs=4, join_style="mitre", mitre_limit=2.0)
    parts = shapely.get_parts(areal(band.intersection(body), least=_TINY))
    polygon = shapely.union_all(parts[shapely.intersects(parts, line)])
    thin = _ARCADE if _is_arcade(tags) else _THIN
    rest = body.difference(polygon)
    thick = rest.buffer(-thin / 2, join_style="mitre").buffer(thin / 2 + GRID, join_style="mitre")
    slips = shapely.get_parts(areal(rest.difference(thick), least=_TINY))
    slips = slips[shapely.length(shapely.intersection(slips, polygon.buffer(GRID).boundary)) > half]
    taken = shapely.union_all([polygon, *shapely.buffer(slips, GRID, join_style="mitre")])
    wide = shapely.union_all([band, *shapely.buffer(slips, _INTO, join_style="mitre")])
    beyond = wide.intersection(taken.buffer(2 * _INTO, join_style="mitre"))
    return areal(taken, least=_TINY), areal(shapely.union_all([taken, beyond]), least=_TINY)


@dataclass(frozen=True, slots=True)
class PassageCuts(Columns):
    """Passages in bodies of buildings, one row for each passage and drawn row of the table.

    row      : (k,) int64, row of the table of buildings
    corridor : (k,) object, shapely, what is cut out
    clear    : (k,) float64, metres from the building's base up to which it is
    """

    row: Ints
    corridor: NDArray[np.object_]
    clear: Float


def passage_cuts(
    passages: Passages, buildings: Buildings, *, base: Float, height: Height | None
) -> tuple[PassageCuts, list[Problem]]:
    """What passages cut out of the bodies of buildings, and passages lower than usual.

    Under eaves that would leave less than 0.3 m over it, a passage whose height is not mapped is lower.

    base   : (count,) z in metres of each building's base, NaN for buildings that are not looked at
    height : z of the ground at x, y; None for level ground at 0
    """
    some = np.flatnonzero(~np.isnan(base[passages.building]) & ~shapely.is_empty(passages.cut))
    xy, of = shapely.get_coordinates(shapely.segmentize(passages.cut[some], _STEP), return_index=True)
    z = np.zeros(len(xy)) if height is None else np.asarray(height(*xy.T), float)
    ground = np.full(len(some), -np.inf)
    np.maximum.at(ground, of, z)
    ground -= base[passages.building[some]]
    drawn = np.flatnonzero(buildings.drawn)
    pair, row = shapely.STRtree(buildings.footprint[drawn]).query(passages.cut[some], predicate="intersects")
    row = drawn[row]
    own = buildings.outline[row] == passages.building[some[pair]]
    pair, row = pair[own], row[own]
    clear = ground[pair] + passages.top[some[pair]]
    eaves = _eaves(buildings, row)
    lower = passages.guessed[some[pair]] & (eaves < clear) & (eaves >= ground[pair] + _LOW)
    problems = []
    for n in np.flatnonzero(lower).tolist():
        k = some[pair[n]]
        detail = f"{eaves[n] - ground[pair[n]]:.2f} m high under the eaves of {buildings.osm_id[row[n]]}"
        name = str(passages.osm_id[k])
        problems.append(
            Problem(name, "building", "repaired", "low-passage", f"{detail}, {passages.top[k]:g} m is usual")
        )
    clear = np.where(lower, eaves, clear)
    hit = buildings.min_height[row] < clear
    return PassageCuts(row[hit], passages.cut[some[pair[hit]]], clear[hit]), problems

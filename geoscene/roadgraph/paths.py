"""Surfaces of footways, cycleways, squares, rails and pedestrian crossings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from geoscene.geometry.polylines import directions
from geoscene.ground.kinds import ground_class
from geoscene.roadgraph.carriageways import Carriageways, surface_material
from geoscene.roadgraph.junctions import carriageway
from geoscene.roadgraph.surface_rows import SurfaceRows
from geoscene.roadgraph.tags import place_and_layer
from geoscene.sources.data import Area, OsmData, TaggedNode, Tags, Way
from geoscene.support.columns import Columns, nth
from geoscene.tags import parse_length, parse_number
from geoscene.typing import Float, Ints

# Default width (metres) and material. Assumed: minimum widths of design guides.
_PATHS = {
    "footway": (2.0, "paving"),
    "sidewalk": (2.0, "paving"),
    "pedestrian": (5.0, "paving"),
    "cycleway": (2.5, "asphalt"),
    "path": (1.5, "dirt"),
    "bridleway": (2.0, "dirt"),
    "steps": (2.0, "concrete"),
}
_PRIORITIES = {"sidewalk": "footway", "cycleway": "cycleway"}  # of other kinds: path
_SQUARES = frozenset({"pedestrian", "footway", "cycleway", "path", "platform"})
_YARDS = frozenset({"service", "unclassified", "residential", "living_street", "rest_area", "services"})
# Railways whose rails lie on the ground; ballast and track beds are land cover.
_RAILWAYS = frozenset({"rail", "light_rail", "tram", "subway", "narrow_gauge", "funicular", "preserved"})
# Metres: default gauge, and the width of a rail's head (EN 13674-1, 60E1: 72 mm).
_GAUGE, _RAIL_HEAD = 1.435, 0.072

PRIORITY = {"square": 105.0, "yard": 106.0, "path": 110.0, "footway": 114.0, "cycleway": 116.0, "rail": 175.0}
"""Priorities of surfaces, higher on top: land cover is below 100, carriageways are between 130 and 150."""

_AREA, _PAINT = 160.0, 165.0
# Metres: default width of a crossing, of a zebra's stripes and the gaps between, and of the
# two lines of a signalled crossing (Vienna Convention: 2.5 and more; MUTCD 3B.18: lines 6 to 24 inches,
# stripes 12 to 24, gaps not over 2.5 times that).
_WIDTH = 3.0
_STRIPE, _STRIPE_GAP = 0.5, 0.5
_BORDER = 0.3

_STRIPES = frozenset({"zebra", "marked", "uncontrolled", "yes", "island", "pelican", "toucan", "puffin"})


def way_lines(ways: Sequence[Way], frame: Frame) -> tuple[list[Way], NDArray[np.object_]]:
    """Ways of which two or more points are known, and their shapely LineStrings in scene metres."""
    sizes = np.array([len(way.lonlat) for way in ways], np.int64)
    if not sizes.sum():
        return [], np.empty(0, object)
    lonlat = np.concatenate([way.lonlat for way in ways])
    index = np.repeat(np.arange(len(ways)), sizes)
    known = np.isfinite(lonlat).all(axis=1)
    fresh = known & np.concatenate([[True], (lonlat[1:] != lonlat[:-1]).any(axis=1) | (np.diff(index) > 0)])
    enough = fresh & (np.bincount(index[fresh], minlength=len(ways)) > 1)[index]
    x, y = frame.from_geographic(*lonlat[enough].T)
    rows = np.unique(index[enough])
    lines = shapely.linestrings(np.stack([x, y], axis=1), indices=np.searchsorted(rows, index[enough]))
    return [ways[k] for k in rows.tolist()], lines


def path_surfaces(osm: OsmData, frame: Frame) -> SurfaceRows:
    """Footways, cycleways, paths and steps mapped as lines, except crossings."""
    ways, lines = way_lines([way for way in osm.ways if _is_path(way.tags)], frame)
    kind = ["sidewalk" if w.tags.get("footway") == "sidewalk" else w.tags["highway"] for w in ways]
    width, source, material = [], [], []
    for way, name in zip(ways, kind, strict=True):
        metres, width_source = path_width(way.tags)
        made_of, material_source = surface_material(way.tags, _PATHS[name][1])
        width.append(metres)
        source.append(f"{width_source}/{material_source}")
        material.append(made_of)
    bands = shapely.buffer(lines, np.array(width, float) / 2, quad_segs=4)
    return SurfaceRows.of(
        bands,
        klass=[ground_class(Class.SIDEWALK, name) for name in material],
        material=material,
        priority=[PRIORITY[_PRIORITIES.get(name, "path")] for name in kind],
        osm_id=[way.osm_id for way in ways],
        source=source,
        **_place_and_level([way.tags for way in ways]),
    )


def path_width(tags: Tags) -> tuple[float, str]:
    """Width of a path in metres, 0 for other ways, and its source (``width``, ``est_width``, ``default``)."""
    if not _is_path(tags):
        return 0.0, "default"
    for key in ("width", "est_width"):
        metres = parse_length(tags.get(key))
        if metres is not None and 0.3 <= metres <= 30:
            return metres, key
    name = "sidewalk" if tags.get("footway") == "sidewalk" else tags["highway"]
    return _PATHS[name][0], "default"


def _is_path(tags: Tags) -> bool:
    crossing = "crossing" in (tags.get("footway"), tags.get("cycleway"), tags.get("path"))
    return (
        tags.get("highway") in _PATHS
        and not crossing
        and tags.get("area") != "yes"
        and tags.get("indoor", "no") == "no"
        and tags.get("conveying", "no") == "no"
    )


def _place_and_level(tags: Sequence[Tags]) -> dict[str, Any]:
    """Columns ``place`` and ``level`` of tagged features."""
    found = [place_and_layer(t) for t in tags]
    return {"place": [place for place, _ in found], "level": [layer for _, layer in found]}


def square_surfaces(osm: OsmData, frame: Frame) -> SurfaceRows:
    """Squares, footpaths, platforms and yards mapped as areas."""
    areas = [a for a in osm.areas if _square_class(a) is not None and a.tags.get("indoor", "no") == "no"]
    shapes = shapely.transform(
        np.fromiter((area.geometry for area in areas), object),
        lambda lonlat: np.stack(frame.from_geographic(*lonlat.T), axis=1),
    )
    yard = [_square_class(area) == Class.ROAD for area in areas]
    made_of = [
        surface_material(area.tags, "asphalt" if y else "paving") for area, y in zip(areas, yard, strict=True)
    ]
    return SurfaceRows.of(
        shapes,
        klass=[
            Class.ROAD if y else ground_class(Class.SIDEWALK, name)
            for y, (name, _) in zip(yard, made_of, strict=True)
        ],
        material=[name for name, _ in made_of],
        priority=[PRIORITY["yard" if y else "square"] for y in yard],
        osm_id=[area.osm_id for area in areas],
        source=[f"area/{source}" for _, source in made_of],
        **_place_and_level([area.tags for area in areas]),
    )


def _square_class(area: Area) -> Class | None:
    highway = area.tags.get("highway", "")
    if highway in _SQUARES:
        return Class.SIDEWALK
    return Class.ROAD if highway in _YARDS else None


def rail_surfaces(osm: OsmData, frame: Frame) -> SurfaceRows:
    """The two rails of each track, as thin bands of steel."""
    ways, lines = way_lines([way for way in osm.ways if way.tags.get("railway") in _RAILWAYS], frame)
    given = [parse_number(way.tags.get("gauge")) for way in ways]
    mapped = np.array([g is not None and 300 <= g <= 2200 for g in given], np.bool_)
    gauge = np.array([(g or 0.0) / 1000 for g in given], float)
    aside = np.where(mapped, gauge, _GAUGE) / 2 + _RAIL_HEAD / 2
    rails = shapely.offset_curve(np.tile(lines, 2), np.concatenate([aside, -aside]), join_style="mitre")
    where = _place_and_level([way.tags for way in ways] * 2)
    return SurfaceRows.of(
        shapely.buffer(rails, _RAIL_HEAD / 2, cap_style="flat", join_style="mitre"),
        klass=Class.RAIL,
        material="rail_steel",
        priority=PRIORITY["rail"],
        osm_id=[way.osm_id for way in ways] * 2,
        source=np.tile(np.where(mapped, "gauge/default", "default/default"), 2),
        **where,
    )


@dataclass(frozen=True, slots=True)
class _Crossings(Columns):
    """Crossings as lines from kerb to kerb.

    line  : (c,) shapely LineString
    width : (c,) float64 metres along the road
    paint : (c,) str, ``stripes``, ``lines`` or "" (asphalt alone)
    source : (c,) str
    osm_id : (c,) str
    """

    line: NDArray[np.object_]
    width: Float
    paint: NDArray[np.str_]
    source: NDArray[np.str_]
    osm_id: NDArray[np.str_]


def crossing_rows(osm: OsmData, roads: Carriageways, *, frame: Frame) -> SurfaceRows:
    """Surfaces of crossings: the strip of road that pedestrians use, and its zebra stripes or border lines.

    They are read from crossing ways and, where no such way passes, from crossing nodes. A crossing tagged
    ``unmarked`` has neither paint nor a strip of its own.
    """
    ground = roads.take(roads.place == 0)
    ways = [way for way in osm.ways if _is_crossing(way.tags)]
    found = _Crossings.concatenate(
        [
            _from_ways([w for w in ways if _paint(w.tags)[0] != "none"], ground, frame=frame),
            _from_nodes(osm, ways, roads=ground, frame=frame),
        ]
    )
    line, width, paint, source, osm_id = found.line, found.width, found.paint, found.source, found.osm_id
    out = [
        SurfaceRows.of(
            carriageway(line, width / 2),
            klass=Class.CROSSING,
            material="asphalt",
            priority=_AREA,
            osm_id=osm_id,
            source=np.char.add(source, "/default"),
        )
    ]
    striped, lined = np.flatnonzero(paint == "stripes"), np.flatnonzero(paint == "lines")
    stripes, of = _stripes(line[striped], width[striped])
    aside = width[lined] / 2 - _BORDER / 2
    borders = shapely.offset_curve(np.tile(line[lined], 2), np.concatenate([aside, -aside]))
    for shapes, row in (
        (stripes, striped[of]),
        (shapely.buffer(borders, _BORDER / 2, cap_style="flat"), np.tile(lined, 2)),
    ):
        out.append(
            SurfaceRows.of(
                shapes,
                klass=Class.CROSSING,
                material="lane_paint",
                priority=_PAINT,
                osm_id=osm_id[row],
                source=np.char.add(source[row], "/default"),
            )
        )
    return SurfaceRows.concatenate(out)


def _is_crossing(tags: Tags) -> bool:
    return tags.get("highway") in ("footway", "cycleway", "path") and "crossing" in (
        tags.get("footway"),
        tags.get("cycleway"),
        tags.get("path"),
    )


def _paint(tags: Tags) -> tuple[str, str]:
    """``stripes``, ``lines`` or ``none``, and its source: the tag ``crossing`` or ``default``."""
    markings, kind = tags.get("crossing:markings", ""), tags.get("crossing", "")
    if markings in ("no", "none") or (not markings and kind in ("unmarked", "no", "informal")):
        return "none", "crossing"
    if markings and markings != "yes":
        return ("lines" if "lines" in markings or markings in ("dashes", "dots") else "stripes"), "crossing"
    if tags.get("crossing_ref") == "zebra" or kind in _STRIPES - {"yes", "island"}:
        return "stripes", "crossing"
    if kind == "traffic_signals":
        return "lines", "crossing"
    return "stripes", "default"


def _from_ways(ways: list[Way], roads: Carriageways, *, frame: Frame) -> _Crossings:
    """Crossing ways, cut to the carriageways that they cross."""
    ways, lines = way_lines(ways, frame)
    bands = carriageway(roads.line, roads.width / 2)
    way, band = shapely.STRtree(bands).query(lines, predicate="intersects")
    pieces = shapely.intersection(lines[way], bands[band])
    cut = [shapely.line_merge(shapely.union_all(pieces[way == k])) for k in range(len(ways))]
    parts, index = shapely.get_parts(np.array(cut, object), return_index=True)
    long = (shapely.get_type_id(parts) == shapely.GeometryType.LINESTRING) & (shapely.length(parts) > 2.0)
    of = [ways[k] for k in index[long].tolist()]
    return _crossings(parts[long], of)


def _from_nodes(osm: OsmData, ways: list[Way], *, roads: Carriageways, frame: Frame) -> _Crossings:
    """Crossing nodes without a crossing way, as lines straight across their road."""
    passed = set(np.concatenate([way.nodes for way in ways]).tolist()) if ways else set()
    points = [
        p
        for p in osm.points
        if p.tags.get("highway") == "crossing"
        and _paint(p.tags)[0] != "none"
        and int(p.osm_id.removeprefix("node/")) not in passed
    ]
    x, y = frame.from_geographic([p.lon for p in points], [p.lat for p in points])
    at = shapely.points(np.stack([x, y], axis=1)) if points else np.empty(0, object)
    which, road = shapely.STRtree(roads.line).query_nearest(at, max_distance=0.5, all_matches=False)
    line = roads.line[road]
    along = shapely.line_locate_point(line, at[which])
    ahead = directions(line, along, reach=1.0)
    across = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) * (roads.width[road] / 2)[:, None]
    centre = shapely.get_coordinates(shapely.line_interpolate_point(line, along))
    ends = np.stack([centre - across, centre + across], axis=1)
    shapes = shapely.linestrings(ends) if len(ends) else np.empty(0, object)
    return _crossings(shapes, [points[k] for k in which.tolist()])


def _crossings(lines: NDArray[np.object_], of: Sequence[Way | TaggedNode]) -> _Crossings:
    given = [parse_length(feature.tags.get("width")) for feature in of]
    paint = [_paint(feature.tags) for feature in of]
    return _Crossings(
        lines,
        np.array([g if g is not None and 1.5 <= g <= 15 else _WIDTH for g in given], float),
        np.array([kind for kind, _ in paint], "<U8"),
        np.array([source for _, source in paint], "<U8"),
        np.array([feature.osm_id for feature in of], np.str_),
    )


def _stripes(lines: NDArray[np.object_], width: Float) -> tuple[NDArray[np.object_], Ints]:
    """Zebra stripes along the road, side by side along crossing lines, and the line of each."""
    length = shapely.length(lines)
    pitch = _STRIPE + _STRIPE_GAP
    count = np.floor((length - 0.2 + _STRIPE_GAP) / pitch).astype(np.int64)
    of = np.repeat(np.arange(len(lines)), count)
    if not len(of):
        return np.empty(0, object), of
    number = nth(count)
    start = (length - count * pitch + _STRIPE_GAP)[of] / 2 + number * pitch
    ends = shapely.line_interpolate_point(lines[of][:, None], start[:, None] + np.array([0.0, _STRIPE]))
    bits = shapely.linestrings(shapely.get_coordinates(ends).reshape(-1, 2, 2))
    return shapely.buffer(bits, width[of] / 2, cap_style="flat"), of

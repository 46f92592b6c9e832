"""Surfaces of footways, cycleways, squares and rails."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from geoscene.roadgraph.carriageways import PAVED, place_of, surface_material
from geoscene.roadgraph.surface_rows import SurfaceRows
from geoscene.roadgraph.tags import is_bridge, is_tunnel, read_layer
from geoscene.sources.data import Area, OsmData, Tags, Way
from geoscene.tags import parse_length, parse_number

# Default width (metres) and material. Assumed: minimum widths of design guides.
_PATHS = {
    "footway": (2.0, "paving"),
    "sidewalk": (2.0, "paving"),
    "pedestrian": (5.0, "paving"),
    "cycleway": (2.5, "asphalt"),
    "path": (1.5, "soil"),
    "bridleway": (2.0, "soil"),
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
        given = parse_length(way.tags.get("width"))
        usable = given is not None and 0.3 <= given <= 30
        made_of, material_source = surface_material(way.tags, _PATHS[name][1])
        width.append(given if usable else _PATHS[name][0])
        source.append(f"{'width' if usable else 'default'}/{material_source}")
        material.append(made_of)
    bands = shapely.buffer(lines, np.array(width, float) / 2, quad_segs=4)
    return SurfaceRows.of(
        bands,
        klass=[Class.SIDEWALK if m in PAVED | {"wood", "metal"} else Class.TERRAIN for m in material],
        material=material,
        priority=[PRIORITY[_PRIORITIES.get(name, "path")] for name in kind],
        osm_id=[way.osm_id for way in ways],
        source=source,
        **_place_and_level([way.tags for way in ways]),
    )


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
    layers = [read_layer(t, []) for t in tags]
    return {
        "place": [
            place_of(layer, source, bridge=is_bridge(t), tunnel=is_tunnel(t))
            for t, (layer, source) in zip(tags, layers, strict=True)
        ],
        "level": [layer for layer, _ in layers],
    }


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
        klass=[Class.ROAD if y else Class.SIDEWALK for y in yard],
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

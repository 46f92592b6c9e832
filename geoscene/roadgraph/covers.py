"""Manhole covers, gully grates and patches of asphalt in carriageways."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.geometry import polylines
from geoscene.geometry.frames import Frame
from geoscene.ground.layers import COVERS, GULLIES, PATCHES
from geoscene.roadgraph.carriageways import PAVED, Carriageways
from geoscene.roadgraph.junctions import carriageway
from geoscene.roadgraph.surface_rows import SurfaceRows
from geoscene.sources.data import OsmData, Tags
from geoscene.support.columns import nth
from geoscene.support.splitmix import number_of, uniform_at
from geoscene.typing import Float, Ints

_RADIUS = 0.31
"""Metres: covers of 600 mm openings (EN 124)."""

_GULLY = (0.5, 0.3)
"""Metres along and across the kerb (DIN 19583: 500 x 300)."""

_EVERY = {"cover": 30.0, "gully": 30.0, "patch": 60.0}
"""Metres of street to one of each. Assumed: sewers have manholes every 50 to 70 m, other networks more."""

_STREETS = frozenset({"primary", "secondary", "tertiary", "unclassified", "residential", "living_street"})
_BUILT_UP = 61 / 3.6
_EDGE = 0.6
"""Metres between the middle of a cover and the edge of the carriageway, at least."""

_OCTAGON = np.arange(8) * np.pi / 4 + np.pi / 8


def cover_rows(osm: OsmData, roads: Carriageways, *, frame: Frame, guess: bool) -> SurfaceRows:
    """Manhole covers and gullies, flush with carriageways.

    Mapped are points tagged ``manhole`` or ``man_made=manhole``. Guessed are covers, gullies at kerbs and
    patches along streets of built-up areas: drawn by the ids of the street and of its first node, and by
    the place along it, whatever else there is.
    """
    parts = [_find_mapped(osm, roads, frame=frame)]
    if guess:
        parts += [_guess_rows(roads, kind) for kind in _EVERY]
    return SurfaceRows.concatenate(parts)


def _find_mapped(osm: OsmData, roads: Carriageways, *, frame: Frame) -> SurfaceRows:
    points = [point for point in osm.points if _is_manhole(point.tags)]
    x, y = frame.from_geographic([p.lon for p in points], [p.lat for p in points])
    xy = np.column_stack([x, y]) if points else np.empty((0, 2))
    street = roads.take(roads.place == 0)
    place = shapely.points(xy)
    ahead, on = np.tile([1.0, 0.0], (len(xy), 1)), np.zeros(len(xy), np.bool_)
    if len(street) and len(xy):
        point, road = shapely.STRtree(street.line).query_nearest(place, max_distance=30.0, all_matches=False)
        line = street.line[road]
        along = shapely.line_locate_point(line, place[point])
        ahead[point] = polylines.directions(line, along, reach=1.0)
        on[point] = shapely.distance(line, place[point]) < street.width[road] / 2
    drain = np.array([p.tags.get("manhole") == "drain" for p in points], np.bool_)
    shapes = np.where(drain, _rectangles(xy, ahead, size=np.tile(_GULLY, (len(xy), 1))), _discs(xy))
    return SurfaceRows.of(
        shapes,
        klass=np.where(on, Class.ROAD, Class.SIDEWALK),
        material="cast_iron",
        priority=np.where(drain, GULLIES, COVERS),
        osm_id=np.array([p.osm_id for p in points], np.str_),
        source="manhole/default",
    )


def _is_manhole(tags: Tags) -> bool:
    mapped = tags.get("man_made") == "manhole" or tags.get("manhole", "no") != "no"
    return mapped and tags.get("indoor", "no") == "no" and tags.get("layer", "0") == "0"


def _guess_rows(roads: Carriageways, kind: str) -> SurfaceRows:
    """Rows of a kind along all streets of built-up areas."""
    every, length = _EVERY[kind], shapely.length(roads.line)
    street = np.array([s.highway in _STREETS and max(s.speed) <= _BUILT_UP for s in roads.street], np.bool_)
    street &= (roads.place == 0) & np.isin(roads.material, list(PAVED)) & (roads.width >= 2 * _EDGE + 2.0)
    count = np.where(street, (length / every).astype(np.int64), 0)
    road = np.repeat(np.arange(len(roads)), count)
    place = nth(count)
    way = np.array([number_of(name) for name in roads.osm_id], np.int64)
    column = (way * 1_000_003 + roads.node_id[roads.ends[:, 0]])[road] if len(roads) else road
    salt = list(_EVERY).index(kind)
    draw = uniform_at(column, 8 * place + salt, count=4)
    along, half = (place + 0.1 + 0.8 * draw[0]) * every, roads.width[road] / 2
    side = np.where(draw[1] < 0.5, 0, 1)
    kept = np.ones(len(road), np.bool_)
    if kind == "gully":
        aside = half - _GULLY[1] / 2
        kept = roads.walk[road, side] > 0  # there is a kerb
    elif kind == "cover":
        aside = draw[2] * (half - _EDGE)
    else:
        wide = np.minimum(0.6 + 1.2 * draw[2], half - 0.4)
        aside = half - 0.2 - wide / 2
    road, along, side, draw = road[kept], along[kept], side[kept], draw[:, kept]
    at, ahead = _beside(roads, road, along=along, aside=np.where(side == 0, 1.0, -1.0) * aside[kept])
    if kind == "cover":
        shapes = _discs(at)
    elif kind == "gully":
        shapes = _rectangles(at, ahead, size=np.tile(_GULLY, (len(at), 1)))
    else:
        shapes = _rectangles(at, ahead, size=np.column_stack([1.0 + 4.0 * draw[3], wide[kept]]))
    within = carriageway(roads.line[road], roads.width[road] / 2)
    return SurfaceRows.of(
        shapely.intersection(shapes, within),
        klass=Class.ROAD,
        material="asphalt_fresh" if kind == "patch" else "cast_iron",
        priority={"cover": COVERS, "gully": GULLIES, "patch": PATCHES}[kind],
        osm_id=roads.osm_id[road],
        source="guess/default",
    )


def _beside(roads: Carriageways, road: Ints, *, along: Float, aside: Float) -> tuple[Float, Float]:
    """Places (n, 2) beside centre lines, to the left for positive ``aside``, and directions (n, 2)."""
    line = roads.line[road]
    ahead = polylines.directions(line, along, reach=1.0)
    middle = shapely.get_coordinates(shapely.line_interpolate_point(line, along))
    return middle + aside[:, None] * np.stack([-ahead[:, 1], ahead[:, 0]], axis=1), ahead


def _discs(xy: Float) -> NDArray[np.object_]:
    """Octagons (n,) about points (n, 2)."""
    if not len(xy):
        return np.empty(0, object)
    ring = _RADIUS * np.column_stack([np.cos(_OCTAGON), np.sin(_OCTAGON)])
    return np.asarray(shapely.polygons(xy[:, None] + ring), object)


def _rectangles(xy: Float, ahead: Float, *, size: Float) -> NDArray[np.object_]:
    """Rectangles (n,) about points (n, 2), of sizes (n, 2) along and across directions (n, 2)."""
    if not len(xy):
        return np.empty(0, object)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    u, v = ahead * size[:, :1] / 2, left * size[:, 1:] / 2
    return np.asarray(
        shapely.polygons(np.stack([xy + u + v, xy - u + v, xy - u - v, xy + u - v], axis=1)), object
    )

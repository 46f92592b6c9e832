"""Beds of ballast under mapped tracks."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class, materials
from geoscene.geometry.frames import Frame
from geoscene.ground.ballast import FADE, SLOPE, Beds
from geoscene.ground.layers import Layers
from geoscene.roadgraph.carriageways import place_of, surface_material
from geoscene.roadgraph.paths import way_lines
from geoscene.roadgraph.tags import is_bridge, is_tunnel, read_layer
from geoscene.sources.data import OsmData, Tags

_TRACKS = frozenset({"rail", "light_rail", "subway", "narrow_gauge", "preserved"})
_TOP = 1.8
"""Metres from the middle of a track to the edge of the top: half a sleeper of 2.6 m and a shoulder."""

_GAP = 0.7
"""Metres: beds are one where less than twice this is between their tops, as between tracks 4 to 5 m apart."""

_PRIORITY_TOP, _PRIORITY_SLOPE = 80.999, 78.9
"""Above the land cover of tracks; below it, above all other land cover but platforms."""

_LEAST = 2.0
"""Square metres of a top, at least."""


def read_beds(osm: OsmData, frame: Frame, *, cover: Layers, others: Layers) -> tuple[Beds, Layers]:
    """Beds under tracks on the ground, and their rows for the ground: tops and slopes.

    Tracks of trams, and those with a ``surface`` other than ballast or gravel, lie in the street and have
    none. Beds keep off roads, paths, platforms, water and buildings, and come down where these cross tracks
    and to bridges and tunnels. Rows have the features of the tracks' land cover.

    cover  : land cover
    others : surfaces of roads and paths, and building pads
    """
    ways, lines = way_lines([way for way in osm.ways if way.tags.get("railway") in _TRACKS], frame)
    on_ground = np.array([_place(way.tags) == 0 for way in ways], np.bool_)
    ends = shapely.get_parts(shapely.boundary(lines[~on_ground]))
    bedded = on_ground & np.array([_embed(way.tags) for way in ways], np.bool_)
    lines, ids = lines[bedded], [way.osm_id for way, b in zip(ways, bedded, strict=True) if b]
    obstacle = _obstacles(cover, others, lines=lines)
    wide = shapely.union_all(shapely.buffer(lines, _TOP + _GAP, cap_style="flat", join_style="mitre"))
    keep_off = shapely.union_all(shapely.buffer(obstacle, SLOPE, join_style="mitre"))
    area = shapely.difference(shapely.buffer(wide, -_GAP, join_style="mitre"), keep_off)
    tops = shapely.get_parts(area)
    tops = tops[shapely.area(tops) > _LEAST]
    line, other = shapely.STRtree(obstacle).query(lines, predicate="intersects")
    crossed = shapely.intersection(lines[line], obstacle[other])
    ends = np.concatenate([crossed[~shapely.is_empty(crossed)], ends])
    return Beds.of(tops, ends), _rows(lines, ids, tops=tops, ends=ends, keep_off=keep_off, cover=cover)


def _place(tags: Tags) -> int:
    layer, source = read_layer(tags, [])
    return place_of(layer, source, bridge=is_bridge(tags), tunnel=is_tunnel(tags))


def _embed(tags: Tags) -> bool:
    return surface_material(tags, "ballast")[0] in {"ballast", "gravel"}


def _obstacles(cover: Layers, others: Layers, *, lines: NDArray[np.object_]) -> NDArray[np.object_]:
    """Surfaces (n,) near tracks that beds keep off."""
    solid = cover.take(np.flatnonzero(np.isin(cover.klass, (Class.SIDEWALK, Class.WATER))))
    shapes = np.concatenate([solid.polygon, others.polygon[others.klass != Class.RAIL]])
    near = shapely.buffer(lines, _TOP + _GAP + SLOPE, cap_style="flat")
    found = np.unique(shapely.STRtree(shapes).query(near, predicate="intersects")[1])
    return np.asarray(shapes[found], object)


def _rows(
    lines: NDArray[np.object_],
    ids: list[str],
    *,
    tops: NDArray[np.object_],
    ends: NDArray[np.object_],
    keep_off: Any,
    cover: Layers,
) -> Layers:
    """Tops and slopes of beds, each track's own, cut where they come down."""
    if not len(tops):
        return Layers.empty()
    top = shapely.MultiPolygon(tops.tolist())
    slopes = shapely.difference(shapely.buffer(top, SLOPE, join_style="mitre"), keep_off)
    fading = shapely.union_all(shapely.buffer(ends, FADE, quad_segs=4))
    tracks = cover.take(np.flatnonzero(cover.klass == Class.RAIL))
    feature = dict(zip(tracks.osm_id.tolist(), tracks.feature.tolist(), strict=True))
    parts = []
    for area, priority, beside in (
        (top, _PRIORITY_TOP, _TOP + _GAP),
        (slopes, _PRIORITY_SLOPE, _TOP + _GAP + SLOPE),
    ):
        own = shapely.intersection(shapely.buffer(lines, beside, cap_style="square"), area)
        for shapes, level in (
            (shapely.difference(own, fading), priority),
            (shapely.intersection(own, fading), priority + 1e-4),
        ):
            parts.append(
                Layers.of(
                    shapely.buffer(shapes, 0.0),
                    klass=Class.RAIL,
                    material=materials()["ballast"].code,
                    priority=level,
                    osm_id=np.array(ids, np.str_),
                    feature=[feature.get(name, -1) for name in ids],
                )
            )
    rows = Layers.concatenate(parts)
    return rows.take(np.flatnonzero(shapely.area(rows.polygon) > 0.0))

"""Land cover: mapped areas, waterways, railways, the sea, and paved yards in dense towns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class, materials
from geoscene.geometry.frames import Frame
from geoscene.ground.kinds import (
    FIELD,
    OPEN,
    SEA,
    GroundKind,
    area_kind,
    ground_class,
    line_kind,
    read_surface,
)
from geoscene.ground.land import TEMPERATE, Land
from geoscene.ground.layers import Layers
from geoscene.sources.data import Area, OsmData, Way
from geoscene.support.columns import nth
from geoscene.support.problems import Problem
from geoscene.support.splitmix import number_of, uniform_at
from geoscene.tags import parse_length
from geoscene.typing import Float, Ints

_WIDEST = 3000.0
"""Metres; larger widths are taken for typing errors."""

_ASIDE = 0.01
"""Metres to each side of a coastline at which land and sea are sampled."""

_CELL = 20.0  # metres
_AROUND = 2  # cells on each side that a cell's density is taken over: 100 m in all
_DENSE = 0.2  # built-up share from which yards are paved; assumed
_CLOSED = 0.4  # built-up share from which all of it is paved; assumed
_APRON = 8.0  # metres around buildings that are paved where the share is less; assumed
_ROUND = 4  # segments of a quarter circle at corners
_PRIORITY = -1.0  # below everything that is mapped


def landcover(
    osm: OsmData, frame: Frame, *, extent: Sequence[float], land: Land = TEMPERATE
) -> tuple[Layers, list[Problem]]:
    """Land cover within the extent as `Layers`, and repaired or dropped features as problems.

    Areas by `kinds.AREAS`, lines of water, rail and stone widened by their ``width`` or their kind's, and
    the sea behind coastlines. Roads and buildings are no land cover. A ``surface`` tag decides the
    material. Priorities lie in [0, 100): the kind's tier, plus less than 1 that is greater for smaller
    polygons, so that a lawn in a park shows.

    extent : (xmin, ymin, xmax, ymax) scene metres; polygons are cut there
    land   : usual land of the region, for areas whose surface the map does not give (source ``assumed``)
    """
    areas, problems = _areas(osm, frame, extent=extent, land=land)
    lines, more = _lines(osm.ways, frame)
    coast = [way for way in osm.ways if way.tags.get("natural") == "coastline"]
    seas, still_more = sea(
        [_to_scene(frame, way.lonlat) for way in coast], extent, osm_id=[way.osm_id for way in coast]
    )
    water = Layers.of(
        seas,
        klass=SEA.klass,
        material=materials()[SEA.material].code,
        priority=float(SEA.tier),
        source="coastline",
        body=SEA.body,
    )
    cut = _cut(Layers.concatenate([areas, lines, water]), extent)
    return cut, problems + more + still_more


def _to_scene(frame: Frame, lonlat: Float) -> Float:
    return np.column_stack(frame.from_geographic(lonlat[:, 0], lonlat[:, 1]))


def _layers(
    found: Sequence[tuple[Area | Way, GroundKind]],
    polygons: NDArray[np.object_],
    *,
    source: Sequence[str] = (),
) -> Layers:
    """Rows of features and their kinds; within a tier the smaller polygon lies above the larger.

    source : of each row; by default that of its material
    """
    looks = [read_surface(feature.tags, kind) for feature, kind in found]
    tier = np.array([kind.tier for _, kind in found], int)
    return Layers.of(
        polygons,
        klass=[klass for klass, _, _ in looks],
        material=[0 if name in (OPEN, FIELD) else materials()[name].code for _, name, _ in looks],
        priority=tier + 0.99 / (1.0 + shapely.area(polygons) / 100.0),
        osm_id=[feature.osm_id for feature, _ in found],
        source=source or [given for _, _, given in looks],
        body=[kind.body for _, kind in found],
    )


def _assume(layers: Layers, found: Sequence[tuple[Area, GroundKind]], *, land: Land) -> Layers:
    """The rows; those of `OPEN` and `FIELD` have the usual materials of the region."""
    unknown = np.flatnonzero(layers.material == 0)
    number = np.array([number_of(found[k][0].osm_id) for k in unknown.tolist()], np.int64)
    farmed = np.array([found[k][1].material == FIELD for k in unknown.tolist()], np.bool_)
    name = np.where(farmed, land.field_at(uniform_at(number, np.zeros_like(number), count=1)[0]), land.open)
    klass, material, source = layers.klass.copy(), layers.material.copy(), layers.source.astype(object)
    klass[unknown] = [ground_class(Class.TERRAIN, one) for one in name.tolist()]
    material[unknown] = [materials()[one].code for one in name.tolist()]
    source[unknown] = "assumed"
    return replace(layers, klass=klass, material=material, source=source.astype(np.str_))


def _areas(
    osm: OsmData, frame: Frame, *, extent: Sequence[float], land: Land
) -> tuple[Layers, list[Problem]]:
    """Land cover mapped as areas that intersect the extent."""
    found = [(area, kind) for area in osm.areas if (kind := area_kind(area.tags)) is not None]
    polygons = np.fromiter((area.geometry for area, _ in found), object)
    polygons = shapely.transform(polygons, lambda lonlat: _to_scene(frame, lonlat))
    near = shapely.intersects(shapely.box(*extent), shapely.envelope(polygons))
    found = [pair for pair, keep in zip(found, near, strict=True) if keep]
    polygons = polygons[near]
    problems = []
    for k in np.flatnonzero(~shapely.is_valid(polygons)):
        reason = shapely.is_valid_reason(polygons[k])
        polygons[k] = shapely.make_valid(polygons[k], method="structure", keep_collapsed=False)
        problems.append(Problem(found[k][0].osm_id, "area", "repaired", "invalid-after-projection", reason))
    return _assume(_layers(found, polygons), found, land=land), problems


def _lines(ways: Sequence[Way], frame: Frame) -> tuple[Layers, list[Problem]]:
    """Land cover drawn as lines, widened."""
    found = [(way, kind) for way in ways if (kind := line_kind(way.tags)) is not None and len(way.lonlat) > 1]
    width, source, problems = [], [], []
    for way, kind in found:
        metres, problem = _width(way, kind)
        width.append(metres)
        source.append("default-width" if metres == kind.width else "width")
        problems += problem
    if not found:
        return Layers.empty(), problems
    xy = _to_scene(frame, np.concatenate([way.lonlat for way, _ in found]))
    line = np.repeat(np.arange(len(found)), [len(way.lonlat) for way, _ in found])
    strips = shapely.buffer(shapely.linestrings(xy, indices=line), np.array(width) / 2, quad_segs=2)
    return _layers(found, strips, source=source), problems


def _width(way: Way, kind: GroundKind) -> tuple[float, list[Problem]]:
    """A line's width in metres, and a problem where its tag cannot be used."""
    text = way.tags.get("width") or way.tags.get("est_width")
    if text is None:
        return kind.width, []
    metres = parse_length(text)
    if metres is not None and 0.0 < metres <= _WIDEST:
        return metres, []
    detail = f"width={text!r} is no width; took {kind.width} m"
    return kind.width, [Problem(way.osm_id, "area", "repaired", "unreadable-width", detail)]


def _cut(layers: Layers, extent: Sequence[float]) -> Layers:
    """Rows that have area within the extent, polygons cut a metre outside it."""
    box = shapely.box(extent[0] - 1.0, extent[1] - 1.0, extent[2] + 1.0, extent[3] + 1.0)
    polygon = layers.polygon.copy()
    across = ~shapely.covers(box, polygon)
    polygon[across] = shapely.intersection(polygon[across], box)
    keep = shapely.area(polygon) > 0
    return replace(layers, polygon=polygon).take(keep)


def sea(
    coastlines: Sequence[Float], extent: Sequence[float], *, osm_id: Sequence[str] = ()
) -> tuple[NDArray[np.object_], list[Problem]]:
    """Polygons (n,) of the sea within the extent, and repairs.

    coastlines : (k, 2) scene metres each, in the direction of the map: land left, sea right
    extent     : (xmin, ymin, xmax, ymax)
    osm_id     : of each coastline, for the problems

    Without a coastline inside the extent there is no sea. A coastline that ends inside the extent (where an
    extract was cut) is extended to the nearest point of the border. A face whose shores contradict each
    other, which broken coastlines cause, becomes what most metres of its shore indicate.
    """
    box = shapely.box(*extent)
    names = list(osm_id) or [""] * len(coastlines)
    inside = [k for k, c in enumerate(coastlines) if len(c) > 1 and shapely.LineString(c).intersects(box)]
    if not inside:
        return np.empty(0, object), []
    problems: list[Problem] = []
    lines: list[Any] = [shapely.LineString(coastlines[k]) for k in inside]
    for k, point in _loose_ends([coastlines[k] for k in inside], box):
        border = shapely.shortest_line(shapely.Point(point), box.exterior)
        lines.append(_extend(border))
        detail = f"led {border.length:.1f} m on to the edge of the scene"
        problems.append(Problem(names[inside[k]], "coastline", "repaired", "open-end", detail))
    faces = shapely.get_parts(shapely.polygonize([shapely.union_all([*lines, box.exterior])]))
    faces = faces[shapely.contains_properly(box.buffer(_ASIDE), faces)]
    wet, dry = _shores(faces, [coastlines[k] for k in inside])
    for face, w, d in zip(faces, wet, dry, strict=True):
        if min(w, d) > 0.01 * max(w, d):
            at = face.representative_point()
            detail = f"sea by {w:.0f} m of shore, land by {d:.0f} m, at ({at.x:z.0f}, {at.y:z.0f})"
            problems.append(Problem("", "coastline", "repaired", "conflict", detail))
    return faces[wet > dry], problems


def _loose_ends(coastlines: Sequence[Float], box: Any) -> list[tuple[int, Float]]:
    """(coastline, point) of ends inside the box where no other coastline continues."""
    ends = np.array([[c[0], c[-1]] for c in coastlines]).reshape(-1, 2)
    _, place, count = np.unique(np.round(ends, 3), axis=0, return_inverse=True, return_counts=True)
    loose = (count[place.reshape(-1)] == 1) & shapely.contains_xy(box, ends[:, 0], ends[:, 1])
    return [(int(e) // 2, ends[e]) for e in np.flatnonzero(loose)]


def _extend(line: Any) -> Any:
    """A line (two points) extended slightly beyond its end, so that it crosses the touched line."""
    (x0, y0), (x1, y1) = line.coords
    length = max(line.length, _ASIDE)
    return shapely.LineString(
        [(x0, y0), (x1 + (x1 - x0) * _ASIDE / length, y1 + (y1 - y0) * _ASIDE / length)]
    )


def _shores(faces: NDArray[np.object_], coastlines: Sequence[Float]) -> tuple[Float, Float]:
    """Metres of shore of each face (n,) that indicate sea, and that indicate land."""
    start = np.concatenate([c[:-1] for c in coastlines])
    step = np.concatenate([np.diff(c, axis=0) for c in coastlines])
    length = np.hypot(*step.T)
    start, step, length = start[length > 0], step[length > 0], length[length > 0]
    right = np.stack([step[:, 1], -step[:, 0]], axis=1) / length[:, None] * _ASIDE
    tree = shapely.STRtree(faces)
    shores: list[Float] = []
    # Long segments may cross the border of the extent: they are sampled at several points.
    pieces = np.maximum(np.ceil(length / 5.0).astype(int), 1)
    segment = np.repeat(np.arange(len(length)), pieces)
    middle = start[segment] + step[segment] * ((nth(pieces) + 0.5) / pieces[segment])[:, None]
    weight = length[segment] / pieces[segment]
    for side in (1.0, -1.0):
        point, face = tree.query(shapely.points(middle + side * right[segment]), predicate="within")
        shores.append(np.bincount(face, weight[point], minlength=len(faces)).astype(np.float64))
    return shores[0], shores[1]


def _cells(chosen: NDArray[np.bool_], *, low: Ints, wider: float) -> Any:
    """The chosen cells of a grid from cell ``low`` on, and the land around, with rounded corners."""
    x, y = ((np.argwhere(chosen) + low) * _CELL).T
    cells = shapely.coverage_union_all(shapely.box(x, y, x + _CELL, y + _CELL))
    wide = shapely.buffer(cells, 2 * wider, quad_segs=_ROUND)
    return shapely.buffer(wide, -wider, quad_segs=_ROUND)


def paved_fabric(footprints: NDArray[Any]) -> Layers:
    """Paved ground between dense buildings, as the lowest layer: an assumption, marked as such.

    Where buildings cover more than a fifth of the 100 m around, unmapped ground is paved (yards, pavements).
    It remains the base, as in suburbs and in the country, between blocks that stand apart: more than 8 m from
    buildings where these cover less than two fifths. Source ``assumed-built-up``.

    footprints : shapely polygons, scene metres
    """
    shapes = footprints[~shapely.is_empty(footprints)] if len(footprints) else footprints
    if not len(shapes):
        return Layers.empty()
    boxes = shapely.bounds(shapes)
    low = np.floor(boxes[:, :2].min(axis=0) / _CELL).astype(int) - _AROUND
    high = np.ceil(boxes[:, 2:].max(axis=0) / _CELL).astype(int) + _AROUND
    built = np.zeros(high - low)
    points = shapely.get_coordinates(shapely.centroid(shapes))
    i, j = (np.floor(points / _CELL).astype(int) - low).T
    np.add.at(built, (i, j), shapely.area(shapes))
    width = 2 * _AROUND + 1
    padded = np.pad(built, _AROUND)
    around = np.lib.stride_tricks.sliding_window_view(padded, (width, width)).sum(axis=(2, 3))
    dense, closed = (
        _cells(around > share * (width * _CELL) ** 2, low=low, wider=15.0) for share in (_DENSE, _CLOSED)
    )
    beside = shapes[shapely.STRtree(shapes).query(dense, predicate="intersects")]
    # Lawns of less than 8 m across are closed.
    aprons = shapely.union_all(shapely.buffer(beside, _APRON + 4.0, quad_segs=_ROUND // 2))
    aprons = shapely.buffer(aprons, -4.0, quad_segs=_ROUND // 2)
    paved = shapely.get_parts(shapely.intersection(dense, shapely.union(closed, aprons)))
    paved = paved[shapely.area(paved) > 0]
    return Layers.of(
        paved,
        klass=Class.PAVED,
        material=materials()["paving"].code,
        priority=_PRIORITY,
        source="assumed-built-up",
    )

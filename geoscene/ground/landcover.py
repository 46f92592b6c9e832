"""Mapped land cover: areas, waterways, railways, the sea."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import materials
from geoscene.geometry.frames import Frame
from geoscene.ground.coast import sea
from geoscene.ground.kinds import SEA, SURFACES, GroundKind, area_kind, line_kind
from geoscene.ground.layers import Layers
from geoscene.sources.data import Area, OsmData, Tags, Way
from geoscene.support.problems import Problem
from geoscene.tags import parse_length
from geoscene.typing import Float

_WIDEST = 3000.0
"""Metres; larger widths are taken for typing errors."""


def landcover(osm: OsmData, frame: Frame, *, extent: Sequence[float]) -> tuple[Layers, list[Problem]]:
    """Land cover within the extent as `Layers`, and repaired or dropped features as problems.

    Areas by `kinds.AREAS`, lines of water, rail and stone widened by their ``width`` or their kind's, and
    the sea behind coastlines. Roads and buildings are no land cover. A ``surface`` tag decides the
    material. Priorities lie in [0, 100): the kind's tier, plus less than 1 that is greater for smaller
    polygons, so that a lawn in a park shows.

    extent : (xmin, ymin, xmax, ymax) scene metres; polygons are cut there
    """
    areas, problems = _areas(osm, frame, extent=extent)
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


def _material(tags: Tags, kind: GroundKind) -> tuple[str, str]:
    """(material, source): the surface tag's, else the kind's."""
    named = SURFACES.get(tags.get("surface", "").split(";")[0].strip())
    if named is None or kind.body:
        return kind.material, "tags"
    return named, "surface"


def _layers(
    found: Sequence[tuple[Area | Way, GroundKind]],
    polygons: NDArray[np.object_],
    *,
    source: Sequence[str] = (),
) -> Layers:
    """Rows of features and their kinds; within a tier the smaller polygon lies above the larger.

    source : of each row; by default that of its material
    """
    looks = [_material(feature.tags, kind) for feature, kind in found]
    tier = np.array([kind.tier for _, kind in found], int)
    return Layers.of(
        polygons,
        klass=[kind.klass for _, kind in found],
        material=[materials()[name].code for name, _ in looks],
        priority=tier + 0.99 / (1.0 + shapely.area(polygons) / 100.0),
        osm_id=[feature.osm_id for feature, _ in found],
        source=source or [name for _, name in looks],
        body=[kind.body for _, kind in found],
    )


def _areas(osm: OsmData, frame: Frame, *, extent: Sequence[float]) -> tuple[Layers, list[Problem]]:
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
    return _layers(found, polygons), problems


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

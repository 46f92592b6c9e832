"""Footprints: valid polygons on the 0.1 mm grid, in scene metres, from polygons of the map."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.errors import GEOSException

from geoscene.buildings.table import GRID
from geoscene.geometry.frames import Frame
from geoscene.typing import Bools, Float, Ints

Polygons = NDArray[Any]

NOTCHES = (1e-2, 3e-2, 1e-1)
"""Half the diagonal of the notch that separates two rings touching in a point, metres. The next size is tried
where the rings diverge so little that the grid closes the notch again (thin wedges)."""


def to_grid(xy: Float) -> Float:
    """Coordinates rounded to the 0.1 mm grid."""
    # like GEOS: division by 1e4 gives the float nearest to the decimal, multiplication by 1e-4 does not
    return np.rint(xy * 1e4) / 1e4


def groups(number: NDArray[np.integer]) -> list[Ints]:
    """Ascending positions of each distinct number, in order of the numbers."""
    order = np.argsort(number, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(number[order])) + 1) if len(order) else []


def project(geometry: Polygons, frame: Frame) -> Polygons:
    """Polygons (n,) in degrees as polygons in scene metres, not yet on the grid."""
    out: Polygons = shapely.transform(
        geometry, lambda lonlat: np.column_stack(frame.from_geographic(lonlat[:, 0], lonlat[:, 1]))
    )
    return out


def clean(polygons: Polygons) -> tuple[Polygons, Bools]:
    """Valid polygons on the grid (n,), and which of them had to be repaired.

    A repaired polygon may be a MultiPolygon, or empty. Rings of the result do not touch: a notch of 10 mm (up
    to 100 mm in thin wedges) separates rings that touched in a point, where a wall edge would have four
    faces.
    """
    out = np.array(polygons, dtype=object)
    finite = np.isfinite(shapely.bounds(out)).all(axis=1) & ~shapely.is_empty(out)
    out[~finite] = shapely.Polygon()
    snapped = _without_repeated_points(shapely.transform(out, to_grid))
    bad = ~shapely.is_valid(snapped)
    if bad.any():
        valid = shapely.make_valid(out[bad], method="structure", keep_collapsed=False)
        snapped[bad] = _polygonal(shapely.set_precision(valid, GRID))
    pinched = ~shapely.is_simple(shapely.boundary(snapped))  # rings touch
    for row in np.flatnonzero(pinched):
        snapped[row] = _separate_rings(snapped[row])
    return shapely.orient_polygons(snapped), bad | pinched


def _without_repeated_points(polygons: Polygons) -> Polygons:
    """Polygons (n,) without repeated points; one with a ring that has shrunk to a point stays, invalid."""
    try:
        return np.asarray(shapely.remove_repeated_points(polygons, 0.0), object)
    except GEOSException:
        if len(polygons) == 1:
            return polygons
        return np.concatenate([_without_repeated_points(polygons[k : k + 1]) for k in range(len(polygons))])


def _polygonal(geometry: Polygons) -> Polygons:
    """The polygonal parts of geometries (n,); lines and points are dropped."""
    parts, row = shapely.get_parts(geometry, return_index=True)
    parts, index = shapely.get_parts(parts, return_index=True)
    keep = (shapely.get_type_id(parts) == shapely.GeometryType.POLYGON) & ~shapely.is_empty(parts)
    parts, row = parts[keep], row[index[keep]]
    out = np.full(len(geometry), shapely.Polygon(), dtype=object)
    for members in groups(row):
        k, mine = row[members[0]], parts[members]
        out[k] = mine[0] if len(mine) == 1 else shapely.multipolygons(mine)
    return out


def _separate_rings(polygon: Any) -> Any:
    """The polygon with a notch cut wherever a corner of a ring lies on another ring."""
    points, cut = _touching(polygon), polygon
    for reach in NOTCHES:
        notches = shapely.union_all(shapely.buffer(points, reach, quad_segs=1))
        cut = _polygonal(np.array([shapely.difference(polygon, notches, grid_size=GRID)], dtype=object))[0]
        if not len(_touching(cut)):
            break
    return cut


def _touching(polygon: Any) -> Polygons:
    """The corners of a polygon's rings that lie on other rings, as points."""
    rings = shapely.get_rings(shapely.get_parts(polygon))
    corners, ring = shapely.get_coordinates(rings, return_index=True)
    points = shapely.points(corners)
    distance = shapely.distance(points[:, None], rings)
    distance[np.arange(len(ring)), ring] = np.inf
    found: Polygons = points[distance.min(axis=1, initial=np.inf) < GRID / 2]
    return found


def subtract(polygon: Any, others: Any, *, sliver: float = 0.02) -> Any:
    """The polygon minus others, on the grid, without slivers narrower than twice ``sliver`` metres."""
    # pieces thinner than the grid come back as lines, which no further operation takes together with polygons
    rest = _polygonal(np.array([shapely.difference(polygon, others, grid_size=GRID)], dtype=object))[0]
    opened = shapely.buffer(
        shapely.buffer(rest, -sliver, join_style="mitre"), sliver * 1.5, join_style="mitre"
    )
    rest = shapely.intersection(rest, opened, grid_size=GRID)
    return clean(_polygonal(np.array([rest], dtype=object)))[0][0]

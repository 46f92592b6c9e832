"""Footprints: map polygons as clean polygons on the grid, in scene metres."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings.table import GRID
from geoscene.frames import Frame

Polygons = NDArray[Any]

NOTCH = 2e-3
"""Half the diagonal of the notch that parts two rings which touch in a point, metres."""


def to_grid(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coordinates moved to the nearest point of the 0.1 mm grid, by at most 0.07 mm."""
    # dividing by 1e4, as GEOS does, gives the float nearest to the decimal; multiplying by 1e-4 does not
    rounded: NDArray[np.float64] = np.rint(xy * 1e4) / 1e4
    return rounded


def gathered(shapes: Sequence[Any]) -> Polygons:
    """A column of shapes."""
    out = np.empty(len(shapes), dtype=object)
    out[:] = shapes
    return out


def project(geometry: Polygons, frame: Frame) -> Polygons:
    """Polygons (n,) in degrees as polygons in scene metres, not yet on the grid."""
    out: Polygons = shapely.transform(
        geometry, lambda lonlat: np.column_stack(frame.from_geographic(lonlat[:, 0], lonlat[:, 1]))
    )
    return out


def clean(polygons: Polygons) -> tuple[Polygons, NDArray[np.bool_]]:
    """Valid polygons on the grid (n,), and which of them had to be repaired.

    What remains of a polygon may be a MultiPolygon, or empty. Rings of the result do not touch: where they
    met in a point, a notch of 2 mm parts them, because a wall edge there would carry four faces.
    """
    out = np.array(polygons, dtype=object)
    finite = np.isfinite(shapely.bounds(out)).all(axis=1) & ~shapely.is_empty(out)
    out[~finite] = shapely.Polygon()
    snapped = shapely.remove_repeated_points(shapely.transform(out, to_grid), 0.0)
    bad = ~shapely.is_valid(snapped)
    if bad.any():
        valid = shapely.make_valid(out[bad], method="structure", keep_collapsed=False)
        snapped[bad] = _polygonal(shapely.set_precision(valid, GRID))
    pinched = _pinched(snapped)
    for row in np.flatnonzero(pinched):
        snapped[row] = _part_rings(snapped[row])
    return shapely.orient_polygons(snapped), bad | pinched


def _polygonal(geometry: Polygons) -> Polygons:
    """The polygons of geometries (n,); lines and points fall away."""
    parts, row = shapely.get_parts(geometry, return_index=True)
    parts, row = _flatten(parts, row)
    out = np.full(len(geometry), shapely.Polygon(), dtype=object)
    for k in np.unique(row):
        mine = parts[row == k]
        out[k] = mine[0] if len(mine) == 1 else shapely.multipolygons(mine)
    return out


def _flatten(parts: Polygons, row: NDArray[np.integer]) -> tuple[Polygons, NDArray[np.integer]]:
    """Polygons with their rows out of parts that may hold MultiPolygons."""
    inner, index = shapely.get_parts(parts, return_index=True)
    row = row[index]
    area = shapely.get_type_id(inner) == shapely.GeometryType.POLYGON
    keep = area & ~shapely.is_empty(inner)
    return inner[keep], row[keep]


def _pinched(polygons: Polygons) -> NDArray[np.bool_]:
    """(n,) bool: some vertex occurs twice in the rings of the polygon."""
    rings, ring_row = shapely.get_rings(shapely.get_parts(polygons), return_index=True)
    piece_row = shapely.get_parts(polygons, return_index=True)[1]
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    row = piece_row[ring_row[ring]]
    last = np.r_[ring[1:] != ring[:-1], True] if len(ring) else np.empty(0, np.bool_)
    table = np.column_stack((row[~last], np.rint(xy[~last] * 1e4)))
    order = np.lexsort(table.T[::-1])
    twice = (np.diff(table[order], axis=0) == 0).all(axis=1)
    pinched = np.zeros(len(polygons), np.bool_)
    pinched[table[order[1:][twice], 0].astype(int)] = True
    return pinched


def _part_rings(polygon: Any) -> Any:
    """The polygon less a small notch at every vertex that occurs twice."""
    for _ in range(3):
        xy = np.concatenate(
            [shapely.get_coordinates(r)[:-1] for r in shapely.get_rings(shapely.get_parts(polygon))]
        )
        distinct, count = np.unique(np.rint(xy * 1e4), axis=0, return_counts=True)
        if not (count > 1).any():
            break
        notches = shapely.buffer(shapely.points(distinct[count > 1] / 1e4), NOTCH, quad_segs=1)
        cut = shapely.difference(polygon, shapely.union_all(notches), grid_size=GRID)
        polygon = _polygonal(np.array([cut], dtype=object))[0]
    return polygon


def subtract(polygon: Any, others: Any, *, sliver: float = 0.02) -> Any:
    """The polygon less others, on the grid, without slivers narrower than twice ``sliver`` metres."""
    rest = shapely.difference(polygon, others, grid_size=GRID)
    opened = shapely.buffer(
        shapely.buffer(rest, -sliver, join_style="mitre"), sliver * 1.5, join_style="mitre"
    )
    rest = shapely.intersection(rest, opened, grid_size=GRID)
    return clean(_polygonal(np.array([rest], dtype=object)))[0][0]

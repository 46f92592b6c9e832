"""Road surfaces as columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from geoscene.classes import materials
from geoscene.support.columns import Columns
from geoscene.typing import Bools, Float

GRID = 1e-4
"""Metres: coordinates of surfaces are whole multiples of it."""


@dataclass(frozen=True, slots=True)
class SurfaceRows(Columns):
    """Polygons in plan; where two overlap the higher priority wins.

    polygon  : (n,) object, valid shapely Polygon, scene metres, coordinates on a grid of 0.1 mm
    klass    : (n,) uint8, `geoscene.classes.Class`
    material : (n,) uint8, code of `geoscene.classes.materials`
    priority : (n,) float64
    osm_id   : (n,) str, the way, node or relation
    source   : (n,) str, sources of shape and material, as ``shape/material``: shape is ``width``,
               ``est_width``, ``lanes`` or ``default`` (where the width comes from), ``diameter``,
               ``sidewalk``, ``turn``, ``cycleway``, ``busway``, ``maxspeed`` (tags),
               ``area``, ``crossing`` (tag), ``control`` (a signal or sign); material is ``surface`` or
               ``default``
    place    : (n,) int8, 0 on the ground, 1 on a bridge, 2 in a tunnel
    level    : (n,) int8, OSM layer
    edge     : (n,) int32, the edge of the road graph on it, -1 for none
    number   : (n,) int32, of the shape that the polygon is a part of, -1 for none
    """

    polygon: NDArray[np.object_]
    klass: NDArray[np.uint8]
    material: NDArray[np.uint8]
    priority: Float
    osm_id: NDArray[np.str_]
    source: NDArray[np.str_]
    place: NDArray[np.int8]
    level: NDArray[np.int8]
    edge: NDArray[np.int32]
    number: NDArray[np.int32]

    @classmethod
    def of(
        cls,
        polygon: NDArray[np.object_],
        *,
        klass: ArrayLike,
        material: Sequence[str] | NDArray[np.str_] | str,
        priority: ArrayLike,
        osm_id: ArrayLike = "",
        source: ArrayLike = "default/default",
        place: ArrayLike = 0,
        level: ArrayLike = 0,
        edge: ArrayLike = -1,
        number: ArrayLike = -1,
    ) -> SurfaceRows:
        """Rows of shapes; materials by name, every other column broadcast.

        Shapes are snapped to the grid, made valid and split into polygons; empty ones are left out.
        """
        n = (len(polygon),)
        table = materials()
        names = np.broadcast_to(np.asarray(material, np.str_), n).tolist()
        shapes = _on_grid(polygon)
        parts, row = shapely.get_parts(shapes, return_index=True)
        keep = (shapely.get_type_id(parts) == shapely.GeometryType.POLYGON) & (shapely.area(parts) > GRID)
        row = row[keep]
        return cls(
            parts[keep],
            np.broadcast_to(np.asarray(klass, np.uint8), n)[row],
            np.array([table[name].code for name in names], np.uint8)[row],
            np.broadcast_to(np.asarray(priority, np.float64), n)[row],
            np.broadcast_to(np.asarray(osm_id, np.str_), n)[row],
            np.broadcast_to(np.asarray(source, np.str_), n)[row],
            np.broadcast_to(np.asarray(place, np.int8), n)[row],
            np.broadcast_to(np.asarray(level, np.int8), n)[row],
            np.broadcast_to(np.asarray(edge, np.int32), n)[row],
            np.broadcast_to(np.asarray(number, np.int32), n)[row],
        )


def in_reach(shapes: NDArray[np.object_], area: Any | None, *, metres: ArrayLike) -> Bools:
    """Whether shapes (n,) are within ``metres``, one or (n,), of an area; all are if it is None."""
    if area is None:
        return np.ones(len(shapes), np.bool_)
    return np.asarray(shapely.dwithin(area, shapes, metres), np.bool_)


def _on_grid(shapes: NDArray[np.object_]) -> NDArray[np.object_]:
    """Shapes with coordinates on the grid, valid; those that rounding leaves valid have only been rounded."""
    rounded: NDArray[np.object_] = shapely.set_precision(shapes, GRID, mode="pointwise")
    rounded = shapely.remove_repeated_points(rounded)
    broken = ~shapely.is_valid(rounded)
    rounded[broken] = shapely.set_precision(shapes[broken], GRID)
    return rounded

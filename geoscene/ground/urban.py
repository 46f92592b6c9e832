"""Ground without mapped land cover: paved in dense towns, soil elsewhere."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class, materials
from geoscene.ground import Layers

_CELL = 20.0  # metres
_AROUND = 2  # cells on each side that a cell's density is taken over: 100 m in all
_DENSE = 0.2  # built-up share from which yards are paved; assumed
_ROUND = 4  # segments of a quarter circle at corners
_PRIORITY = -1.0  # below everything that is mapped


def paved_fabric(footprints: NDArray[Any]) -> Layers:
    """Paved ground between dense buildings, as the lowest layer: an assumption, marked as such.

    Where buildings cover more than a fifth of the 100 m around, unmapped ground is paved (yards, pavements);
    in suburbs and in the country it remains the base. Source ``assumed-built-up``.

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
    dense = around > _DENSE * (width * _CELL) ** 2
    x, y = ((np.argwhere(dense) + low) * _CELL).T
    cells = shapely.coverage_union_all(shapely.box(x, y, x + _CELL, y + _CELL))
    wide = shapely.buffer(cells, 30.0, quad_segs=_ROUND)
    smooth = shapely.get_parts(shapely.buffer(wide, -15.0, quad_segs=_ROUND))
    return Layers.of(
        smooth,
        klass=Class.TERRAIN,
        material=materials()["paving"].code,
        priority=_PRIORITY,
        source="assumed-built-up",
    )

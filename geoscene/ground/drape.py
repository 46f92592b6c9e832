"""Heights of the ground's triangles: on the terrain, and at water levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import materials
from geoscene.geometry import polylines
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import Mesh
from geoscene.ground.kerbs import AROUND, Beside, has_kerbs, kerb_heights, rows_beside
from geoscene.ground.layers import Layers
from geoscene.ground.partition import (
    GroundPlan,
    Partition,
    follows_terrain,
    partition_tile,
    rows_near,
    tile_lattice,
    values_at,
)
from geoscene.ground.triangulate import PlaneTriangles, triangulate, triangulate_lattice
from geoscene.sources.data import Way
from geoscene.support.graphs import components
from geoscene.typing import Bools, Float, Height

_STATION = 20.0
"""Spacing in metres of terrain samples along shores and rivers."""

_FINE = 2.0
"""Spacing in metres of the stations of a river's level."""

_CUT = 3.0
"""Metres that a river may lie below the terrain; more is a fault of the elevation model or the map."""


@dataclass(frozen=True, slots=True)
class WaterLevels:
    """Levels of the water.

    level   : (n,) float64 metres, of each row of the layers; NaN where the row is no water, or a river
    river   : (n,) bool, the row is a river: its level at a point is that of the nearest station
    station : (k, 2) float64, places on rivers' centre lines, scene metres
    height  : (k,) float64 metres, of the water there
    nearest : KD-tree of the stations, None without stations
    reversed : ids of waterways that were mapped against the fall of the terrain
    """

    level: Float
    river: Bools
    station: Float
    height: Float
    nearest: Any
    reversed: tuple[str, ...]


def water_levels(layers: Layers, ways: Sequence[Way], *, frame: Frame, height: Height) -> WaterLevels:
    """The level of every water row of the layers.

    The sea has one level: the median of the terrain over it. Connected standing water has one level: that of
    the sea if they touch, else the lowest terrain on its shore. A river falls along its centre line and is
    level across: every 20 m its level is the lowest terrain upstream, at most 3 m below the terrain. A
    waterway that is mapped against a fall of more than 3 m is reversed and listed. A river area without a
    centre line is standing water.

    ways : those with ``waterway`` give the centre lines
    """
    level = np.full(len(layers), np.nan)
    lines = [way for way in ways if "waterway" in way.tags and len(way.lonlat) > 1]
    stations, heights, turned = _profiles(lines, frame, height=height)
    river = layers.body == "river"
    if river.any():
        tree = shapely.STRtree(shapely.points(stations))
        has_line = np.unique(tree.query(layers.polygon[river], predicate="contains")[0])
        river[np.flatnonzero(river)[~np.isin(np.arange(river.sum()), has_line)]] = False
    still = np.flatnonzero((layers.body != "") & ~river)
    if len(still):
        level[still] = _still_levels(layers.polygon[still], layers.body[still] == "sea", height=height)
    nearest = None
    if len(stations):
        from scipy.spatial import cKDTree  # noqa: PLC0415 - slow to import

        nearest = cKDTree(stations)
    return WaterLevels(level, river, stations, heights, nearest, turned)


def drape(
    plan: GroundPlan,
    cells: Partition,
    *,
    triangles: PlaneTriangles,
    height: Height | None = None,
    levels: WaterLevels | None = None,
) -> Mesh:
    """The ground mesh in scene coordinates: faces upward, each with its cell's class, material and feature.

    A vertex on water, its shore included, has the water's level (where several waters meet, the lowest),
    any other that of the terrain; 0 everywhere without ``height``. The height of a vertex on a tile's border
    depends on all layers there, not on the tile's own cells, so that neighbouring tiles agree.
    """
    x, y = triangles.points.T
    z = np.zeros(len(x)) if height is None else np.array(height(x, y), float)
    low, high = triangles.points.min(axis=0) - AROUND, triangles.points.max(axis=0) + AROUND
    near = rows_near(plan, low[0], ymin=low[1], xmax=high[0], ymax=high[1])
    kerbs = plan.kerbs if has_kerbs(plan, near) else None
    wet = levels is not None and bool((plan.layers.body[near] != "").any())
    beside = rows_beside(plan, cells, triangles=triangles) if kerbs is not None or wet else None
    if kerbs is not None and beside is not None:
        z += kerb_heights(plan, kerbs, triangles=triangles, beside=beside)
    if plan.raised is not None:
        z += plan.raised.height(triangles.points)
    if levels is not None and wet and beside is not None:
        z = _flood(plan, triangles.points, z=z, levels=levels, beside=beside)
    color = np.zeros((256, 3), np.uint8)
    for material in materials().values():
        color[material.code] = material.color
    return Mesh.of(
        np.column_stack([triangles.points, z]),
        triangles.faces,
        feature=cells.feature[triangles.cell],
        klass=cells.klass[triangles.cell],
        material=cells.material[triangles.cell],
        color=color[cells.material[triangles.cell]],
    )


def ground_tile(
    plan: GroundPlan, i: int, *, j: int, height: Height | None = None, levels: WaterLevels | None = None
) -> Mesh:
    """The ground of tile (i, j) in scene coordinates: partition, triangles and heights in one call."""
    cells = partition_tile(plan, i, j=j)
    still = np.isin(values_at(plan.layers.body, cells.row, base=""), ("sea", "standing")).all()
    if follows_terrain(plan, i, j=j) and not still:
        triangles = triangulate_lattice(cells, tile_lattice(plan, i, j=j))
    else:
        triangles = triangulate(cells)
    return drape(plan, cells, triangles=triangles, height=height, levels=levels)


def _inside(polygons: NDArray[np.object_]) -> tuple[Float, Float]:
    """Up to about a thousand points inside polygons, on a regular grid; at least one each."""
    sure = shapely.get_coordinates(shapely.point_on_surface(polygons))
    xmin, ymin, xmax, ymax = shapely.total_bounds(polygons)
    step = max(np.sqrt((xmax - xmin) * (ymax - ymin) / 1000.0), 1.0)
    x, y = np.meshgrid(np.arange(xmin, xmax, step) + step / 2, np.arange(ymin, ymax, step) + step / 2)
    spread = np.column_stack([x.ravel(), y.ravel()])
    point, _ = shapely.STRtree(polygons).query(shapely.points(spread), predicate="within")
    every = np.concatenate([sure, spread[np.unique(point)]])
    return every[:, 0], every[:, 1]


def _still_levels(polygons: NDArray[np.object_], sea: Bools, *, height: Height) -> Float:
    """Levels (n,) of standing waters; waters that touch have the same level."""
    n = len(polygons)
    one, other = shapely.STRtree(polygons).query(polygons, predicate="intersects")
    # All sea has one level, even where land divides it.
    first = np.flatnonzero(sea)[:1]
    one = np.concatenate([one, np.repeat(first, sea.sum())])
    other = np.concatenate([other, np.flatnonzero(sea)[: len(one) - len(other)]])
    water = components(one, other, count=n)
    shores = shapely.segmentize(shapely.boundary(polygons), _STATION)
    xy, owner = shapely.get_coordinates(shores, return_index=True)
    level = np.full(n, np.inf)
    np.minimum.at(level, water[owner], height(xy[:, 0], xy[:, 1]))
    if sea.any():
        level[water[first]] = np.median(height(*_inside(polygons[sea])))
    levels: Float = level[water]
    return levels


def _profiles(ways: Sequence[Way], frame: Frame, *, height: Height) -> tuple[Float, Float, tuple[str, ...]]:
    """Stations (k, 2) on rivers, the level (k,) there, and which rivers were reversed."""
    stations, heights, turned = [np.empty((0, 2))], [np.empty(0)], []
    for way in ways:
        line = shapely.LineString(np.column_stack(frame.from_geographic(*way.lonlat.T)))
        xy = shapely.get_coordinates(shapely.segmentize(line, _STATION))
        ground = np.asarray(height(xy[:, 0], xy[:, 1]), float)
        third = max(len(ground) // 3, 1)
        if ground[-third:].mean() > ground[:third].mean() + _CUT:
            xy, ground = xy[::-1], ground[::-1]
            turned.append(way.osm_id)
        level = np.maximum(np.minimum.accumulate(ground), ground - _CUT)
        # Between stations the water falls evenly.
        along = polylines.stations(xy)
        fine = np.linspace(0.0, along[-1], max(int(along[-1] / _FINE), 1) + 1)
        stations.append(polylines.points_at(xy, fine, along=along))
        heights.append(np.interp(fine, along, level))
    return np.concatenate(stations), np.concatenate(heights), tuple(turned)


def _flood(plan: GroundPlan, points: Float, *, z: Float, levels: WaterLevels, beside: Beside) -> Float:
    """Heights (n,) of points (n, 2), at the level of the water on the shore and in water."""
    vertex, row, _ = beside
    on_water = values_at(plan.layers.body, row, base="") != ""
    vertex, row = vertex[on_water], row[on_water]
    stand = levels.level[row]
    flows = levels.river[row]
    if flows.any():
        stand[flows] = levels.height[levels.nearest.query(points[vertex[flows]])[1]]
    level = np.full(len(z), np.inf)
    np.minimum.at(level, vertex, stand)
    return np.where(np.isinf(level), z, level)

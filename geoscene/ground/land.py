"""Assumed land where the map has none: what open ground looks like here, and fields around settlements.

Open ground has the usual material of the region, and so have built-up areas whose surface is not mapped.
Beyond buildings, within sight of roads, it is divided into parcels: fields, meadows and fallow land, by what
is mapped nearest to them, else by the region's shares. Fields leave verges beside roads. All is assumed,
and is a function of the map alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class, material_names, materials
from geoscene.ground.kinds import ground_class
from geoscene.ground.layers import Layers
from geoscene.support.columns import squares_between
from geoscene.support.splitmix import uniform_at
from geoscene.typing import Float, Ints

_NATURAL = (Class.TERRAIN, Class.GRASS, Class.SAND, Class.FOREST_FLOOR)

PARCELS = "assumed-land"
"""Source of parcels."""

_PRIORITY = -2.0  # below the assumed yards of towns, and all that is mapped
_SIDE = 110.0  # metres, mean side of a parcel
_JITTER = 0.38  # of a side, by which the middle of a parcel is moved
_SEEN = 160.0  # metres from roads and buildings within which there are parcels
_TOWN = 800.0  # metres of roads within that distance from which on a parcel belongs to a town
_GARDENS = 45.0  # metres around buildings that are gardens and yards
_VERGE = 3.0  # metres beside a carriageway that no field reaches
_BESIDE = 90.0  # metres from mapped land within which a parcel is as that land
_YARD = 12.0  # metres around a building that no field reaches
_ALIKE = 0.6  # share of parcels beside mapped land that are as that land
_ROUND = 2  # segments of a quarter circle at corners
_SMALLEST = 60.0  # square metres of a parcel's piece


@dataclass(frozen=True, slots=True)
class Land:
    """Usual land of a region.

    open   : material of open ground, gardens and verges, of `geoscene.classes.materials`
    fields : weights of the materials of parcels
    """

    open: str
    fields: Mapping[str, float]

    def field_at(self, draw: Float) -> NDArray[np.object_]:
        """Material (n,) of fields for random numbers (n,)."""
        names, ends = np.array(list(self.fields), object), np.cumsum(list(self.fields.values()))
        chosen: NDArray[np.object_] = names[np.searchsorted(ends[:-1] / ends[-1], draw, side="right")]
        return chosen


TEMPERATE = Land("grass", {"grass": 4.0, "soil": 3.0, "dry_grass": 3.0})
"""Land of a moist and mild climate."""


def parcels(
    land: Land,
    *,
    roads: NDArray[np.object_],
    width: Float,
    buildings: NDArray[np.object_],
    cover: Layers,
) -> Layers:
    """Parcels of assumed land, one row for each material that differs from open ground.

    roads     : (k,) centre lines, scene metres
    width     : (k,) metres
    buildings : footprints, scene metres
    cover     : mapped land
    """
    kept = buildings[~shapely.is_empty(buildings)]
    seen = np.concatenate([roads, kept])
    if not len(seen):
        return Layers.empty()
    cell, middle = _cells(seen)
    polygon = _polygons(middle)
    near = shapely.STRtree(seen).query(shapely.points(middle), predicate="dwithin", distance=_SEEN)[0]
    chosen = np.zeros(len(cell), np.bool_)
    chosen[near] = True
    homes = shapely.STRtree(kept).query(shapely.points(middle), predicate="dwithin", distance=_GARDENS)[0]
    chosen[homes] = False
    chosen[chosen] = ~_in_towns(middle[chosen], roads=roads)
    # Parcels on the rim, whose polygons are open to the outside, are further away than any that is seen.
    name = _materials(land, cell, middle=middle, cover=cover)
    rows = np.flatnonzero(chosen & (name != land.open))
    free = _without_verges(polygon[rows], roads=roads, width=width, buildings=kept)
    parts: list[Layers] = []
    for material in sorted(set(name[rows].tolist())):
        whole = shapely.get_parts(shapely.union_all(free[name[rows] == material]))
        whole = whole[(shapely.get_dimensions(whole) == 2) & (shapely.area(whole) > _SMALLEST)]
        parts.append(
            Layers.of(
                whole,
                klass=ground_class(Class.TERRAIN, material),
                material=materials()[material].code,
                priority=_PRIORITY,
                source=PARCELS,
            )
        )
    return Layers.concatenate([Layers.empty(), *parts])


def _cells(seen: NDArray[np.object_]) -> tuple[Ints, Float]:
    """Squares (n, 2) of a grid around what is seen, with a margin, and middles (n, 2) of their parcels."""
    box = shapely.bounds(seen)
    low = np.floor((box[:, :2] - _SEEN) / _SIDE).astype(np.int64) - 2
    high = np.floor((box[:, 2:] + _SEEN) / _SIDE).astype(np.int64) + 2
    squares, _ = squares_between(low, high)
    cell = np.unique(squares, axis=0)
    draw = uniform_at(cell[:, 0], cell[:, 1], count=2, seed=11)
    return cell, (cell + 0.5 + 2 * _JITTER * (draw.T - 0.5)) * _SIDE


def _in_towns(middle: Float, *, roads: NDArray[np.object_]) -> NDArray[np.bool_]:
    """Mask (n,) of places (n, 2) among so many roads as only towns have."""
    around = shapely.buffer(shapely.points(middle), _SEEN, quad_segs=_ROUND)
    place, road = shapely.STRtree(roads).query(around, predicate="intersects")
    length = shapely.length(shapely.intersection(around[place], roads[road]))
    town: NDArray[np.bool_] = np.bincount(place, length, minlength=len(middle)) > _TOWN
    return town


def _polygons(middle: Float) -> NDArray[np.object_]:
    """Voronoi polygons (n,) of points (n, 2)."""
    made = shapely.get_parts(shapely.voronoi_polygons(shapely.multipoints(middle)))
    point, of = shapely.STRtree(made).query(shapely.points(middle), predicate="within")
    polygon = np.full(len(middle), shapely.Polygon(), object)
    polygon[point] = made[of]
    return polygon


def _materials(land: Land, cell: Ints, *, middle: Float, cover: Layers) -> NDArray[np.object_]:
    """Material (n,) of each parcel: that of mapped land near it, else by the shares of the region."""
    draw = uniform_at(cell[:, 0], cell[:, 1], count=2, seed=12)
    own = land.field_at(draw[0])
    useful = np.flatnonzero(np.isin(cover.klass, _NATURAL) & (cover.priority >= 0))
    if not len(useful):
        return own
    parcel, found = shapely.STRtree(cover.polygon[useful]).query_nearest(
        shapely.points(middle), max_distance=_BESIDE, all_matches=False
    )
    row = useful[found]
    like = material_names(cover.material[row])
    like[cover.klass[row] == Class.FOREST_FLOOR] = land.open
    takes = np.isin(like, [land.open, *land.fields]) & (draw[1][parcel] < _ALIKE)
    own[parcel[takes]] = like[takes]
    return own


def _without_verges(
    polygon: NDArray[np.object_], *, roads: NDArray[np.object_], width: Float, buildings: NDArray[np.object_]
) -> NDArray[np.object_]:
    """Parcels (n,) less carriageways with their verges, and yards around buildings."""
    bands = np.concatenate(
        [
            shapely.buffer(roads, width / 2 + _VERGE, quad_segs=_ROUND, cap_style="flat"),
            shapely.buffer(buildings, _YARD, quad_segs=_ROUND),
        ]
    )
    parcel, band = shapely.STRtree(bands).query(polygon, predicate="intersects")
    free = polygon.copy()
    ends = np.flatnonzero(np.diff(parcel, append=-1)) + 1
    for first, stop in pairwise([0, *ends.tolist()]):
        k = parcel[first]
        free[k] = shapely.difference(free[k], shapely.union_all(bands[band[first:stop]]))
    return free

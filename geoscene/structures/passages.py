"""Passages through buildings for roads in tunnels or on bridges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings import Buildings
from geoscene.buildings.table import GRID
from geoscene.report import Problem
from geoscene.structures.heights import surface_heights
from geoscene.structures.table import StructureOptions, Structures
from geoscene.typing import Bools, Float, Ints

_SCANT = 1.0
"""Square metres; a smaller overlap of building and road is left as it is."""

_OVER = 0.1
"""Metres from a tunnel's roof, or a bridge's free height, to the underside of what stands over it."""

_STEP = 0.05
"""Metres: undersides are whole multiples of this over the base, so that pieces of road that are all but
equally high do not leave a stair of micrometres, which the grid of solids would crush."""


def buildings_over(
    buildings: Buildings,
    base: Float,
    *,
    foot: Float,
    table: Structures,
    options: StructureOptions | None = None,
) -> tuple[Buildings, list[Problem]]:
    """The buildings, those on a tunnel or a road bridge with a passage, and the rows of those.

    The part over the road gets its underside above the tunnel's roof or the bridge's free height; the rest
    reaches down as before. Divided buildings have flat roofs. A bridge counts where its centre line lies
    within the building, not where its edge touches it; footbridges do not count, they lead into buildings.

    base : (count,) z in metres of each building's base
    foot : (count,) z in metres of the lower end of its walls
    """
    options = options or StructureOptions()
    rows = np.flatnonzero(buildings.drawn)
    roads = np.flatnonzero(table.tunnel | (table.edge >= 0))
    pair = shapely.STRtree(buildings.footprint[rows]).query(table.polygon[roads], predicate="intersects")
    road, row = roads[pair[0]], rows[pair[1]]
    common = shapely.intersection(buildings.footprint[row], table.polygon[road])
    tunnel = table.tunnel[road]
    free = np.where(tunnel, table.rise[road] + options.roof, options.headroom) + _OVER
    low, high = np.empty((2, len(row)))
    for k, piece in enumerate(road.tolist()):
        z = surface_heights(table, piece, xy=shapely.get_coordinates(common[k]).reshape(-1, 2))
        low[k] = z.min(initial=np.inf) - table.body[piece]
        high[k] = z.max(initial=-np.inf) + free[k]
    stands = base[buildings.outline[row]]
    middle = np.array([shapely.LineString(line[:, :2]) for line in table.line[road]], object)
    within = shapely.length(shapely.intersection(buildings.footprint[row], middle)) > _SCANT
    hit = (shapely.area(common) > _SCANT) & (tunnel | within)
    grounded = buildings.min_height[row] <= 0
    under = np.where(grounded, foot[buildings.outline[row]], stands + buildings.min_height[row])
    hit &= (high > under) & (low < stands + buildings.height[row])
    if not hit.any():
        return buildings, []
    corridor = table.polygon[road[hit]]
    clear = np.ceil((high - stands)[hit] / _STEP - 1e-3) * _STEP
    return _divided(buildings, row[hit], corridor=corridor, clear=clear, tunnel=tunnel[hit])


def _divided(
    buildings: Buildings, row: Ints, *, corridor: NDArray[np.object_], clear: Float, tunnel: Bools
) -> tuple[Buildings, list[Problem]]:
    """Rows (k,) divided along corridors (k,); the parts within start ``clear`` (k,) metres over the base."""
    footprint, underside = buildings.footprint.copy(), buildings.min_height.copy()
    why = buildings.min_height_source.copy()
    source: list[int] = []
    shape: list[shapely.Geometry] = []
    new_low: list[float] = []
    over_what = np.where(tunnel, "tunnel", "bridge")
    cause: list[str] = []
    for k in np.unique(row).tolist():
        rest, first = footprint[k], len(source)
        # Highest first: where roads cross, the building stands over the upper one.
        for there in sorted(np.flatnonzero(row == k).tolist(), key=lambda c: -clear[c]):
            over = _polygons(shapely.intersection(rest, corridor[there]))
            rest = _polygons(shapely.difference(rest, corridor[there]))
            if not over.is_empty and clear[there] < buildings.height[k] - _OVER:
                source.append(k)
                shape.append(over)
                new_low.append(clear[there])
                cause.append(str(over_what[there]))
        if buildings.is_part[k]:
            if rest.is_empty:  # entirely over tunnels
                over = int(np.flatnonzero(row == k)[np.argmax(clear[row == k])])
                rest, underside[k], why[k] = footprint[k], clear[over], over_what[over]
                del source[first:], shape[first:], new_low[first:], cause[first:]
            footprint[k] = rest
        elif not rest.is_empty:
            source.append(k)
            shape.append(rest)
            new_low.append(buildings.min_height[k])
            cause.append(str(buildings.min_height_source[k]))
    problems = [
        Problem(str(buildings.osm_id[k]), "building", "repaired", f"over-{what}", f"stands over a {what}")
        for what in ("tunnel", "bridge")
        for k in np.unique(buildings.outline[row[over_what == what]]).tolist()
    ]
    extra = np.array(source, np.int64)
    added = replace(
        buildings.take(extra),
        footprint=np.fromiter(shape, object),
        is_part=np.ones(len(extra), np.bool_),
        min_height=np.array(new_low, float),
        min_height_source=np.array(cause, object),
        roof_shape=np.full(len(extra), "flat", object),
        roof_height=np.zeros(len(extra)),
        roof_source=np.full(len(extra), "none", object),
    )
    kept = replace(buildings, footprint=footprint, min_height=underside, min_height_source=why)
    return Buildings.concatenate([kept, added]), problems


def _polygons(shape: shapely.Geometry) -> shapely.Geometry:
    """The polygons of a shape, on the grid of buildings, without tiny ones."""
    parts = shapely.get_parts(shapely.set_precision(shape, GRID))
    areal = (shapely.get_type_id(parts) == shapely.GeometryType.POLYGON) & (shapely.area(parts) > 0.05)
    parts = shapely.orient_polygons(shapely.set_precision(parts[areal], 0.0))
    return parts[0] if len(parts) == 1 else shapely.MultiPolygon(parts.tolist())

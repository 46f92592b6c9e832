"""Passages through buildings for roads in tunnels or on bridges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings import Buildings
from geoscene.buildings.table import GRID
from geoscene.structures.heights import surface_heights
from geoscene.structures.table import StructureOptions, Structures
from geoscene.support.problems import Problem
from geoscene.typing import Bools, Float, Ints

_SCANT = 1.0
"""Square metres; a smaller overlap of building and road is left as it is."""

_OVER = 0.1
"""Metres from a tunnel's roof, or a bridge's free height, to the underside of what stands over it."""

_GAP = 0.01
"""Metres; narrower gaps between corridors are closed."""

_LEAST = 0.05
"""Square metres; a building of which passages leave less has none."""

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

    Passages reach from below a building up to the tunnel's roof or the bridge's free height, but leave parts
    that end below the road. A bridge counts where its centre line lies within the building, not where its
    edge touches it; footbridges do not count, they lead into buildings.

    base : (count,) z in metres of each building's base, NaN for buildings that are not looked at
    foot : (count,) z in metres of the lower end of its walls
    """
    options = options or StructureOptions()
    rows = np.flatnonzero(buildings.drawn & ~np.isnan(base[buildings.outline]))
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
    top = stands + buildings.height[row]
    hit &= (high > under) & (low < top)
    if not hit.any():
        return buildings, []
    corridor = table.polygon[road]
    for k in np.flatnonzero((high > under) & (low >= top)).tolist():  # below the road
        same = (road == road[k]) & (buildings.outline[row] == buildings.outline[row[k]])
        corridor[same] = shapely.difference(corridor[same], buildings.footprint[row[k]])
    corridor = corridor[hit]
    clear = np.ceil((high - stands)[hit] / _STEP - 1e-3) * _STEP
    return _with_passages(buildings, row[hit], corridor=corridor, clear=clear, tunnel=tunnel[hit])


def _with_passages(
    buildings: Buildings, row: Ints, *, corridor: NDArray[np.object_], clear: Float, tunnel: Bools
) -> tuple[Buildings, list[Problem]]:
    """Buildings with passages in rows (k,): corridors (k,) up to ``clear`` (k,) metres over the base."""
    passages = buildings.passages.copy()
    # what would be too thin over a road is left out
    height = buildings.height[row]
    clear = np.where(clear < height - _OVER, clear, np.maximum(clear, height + _OVER))
    of = buildings.outline[row]
    for k in np.unique(of).tolist():
        there = np.flatnonzero(of == k)
        levels = np.unique(clear[there])[::-1]
        cuts = [(_close_gaps(corridor[there][clear[there] >= level]), float(level)) for level in levels]
        mine = np.flatnonzero(buildings.drawn & (buildings.outline == k))
        gone = [
            shapely.union_all([p for p, top in cuts if top >= height]) for height in buildings.height[mine]
        ]
        if shapely.area(shapely.difference(buildings.footprint[mine], gone)).max() > _LEAST:
            passages[k] = tuple(cuts)
    problems = [
        Problem(str(buildings.osm_id[k]), "building", "repaired", f"over-{what}", f"stands over a {what}")
        for what in ("tunnel", "bridge")
        for k in np.unique(of[tunnel == (what == "tunnel")]).tolist()
    ]
    return replace(buildings, passages=passages), problems


def _close_gaps(corridors: NDArray[np.object_]) -> shapely.Geometry:
    """The union of corridors on the grid of buildings, without the gaps that rounding leaves between them."""
    wide = shapely.buffer(
        shapely.union_all(shapely.buffer(corridors, _GAP, join_style="mitre")), -_GAP, join_style="mitre"
    )
    return shapely.set_precision(shapely.simplify(wide, _GAP), GRID)

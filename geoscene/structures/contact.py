"""Contact of bridges and tunnels with the ground and with buildings: lowered or open ground, passages."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings import Buildings
from geoscene.buildings.table import GRID
from geoscene.classes import Class, materials
from geoscene.geometry import polylines
from geoscene.ground.layers import PADS, Layers
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.routing import edge_lines
from geoscene.roadgraph.surface_rows import in_reach
from geoscene.structures.passages import PassageCuts
from geoscene.structures.pieces import NEAR
from geoscene.structures.sheets import areal
from geoscene.structures.table import (
    THINNEST,
    StructureOptions,
    Structures,
    nearest_on_line,
    surface_heights,
)
from geoscene.support.problems import Problem
from geoscene.typing import Bools, Float, Height, Ints

OPENING, LOW = PADS + 100.0, PADS + 50.0
"""Priority of openings, above all others, and of the ground inside decks, which is hidden."""

LIP = 0.05
"""Metres: how far a tunnel's roof stands out of open ground or lies under other."""

_FALL = 0.25
"""Slope at which the ground leaves a deck, from its end on, until it is below."""

_BELOW = 0.1
"""Metres between a deck and the ground below it at least."""

_STEP = 2.0
"""Metres along a tunnel at which the ground above it is looked at."""

VERGE = 0.3
"""Metres of ground beside the carriageway of a road that passes over a tunnel's mouth."""

_EDGE = 0.05
"""Metres from a deck's outside to the outline along which the ground falls away below it."""

_HIGH = 1.0
"""Metres over the ground around it at which a deck is over the ground below it as well."""

_TINY = 0.01
"""Square metres; smaller parts of areas are left out."""

_INTO = 0.1
"""Metres by which the ground reaches into a tunnel's wall beside an opening."""

_SCANT = 1.0
"""Square metres; a smaller overlap of building and road is left as it is."""

_OVER = 0.1
"""Metres from a tunnel's roof, or a bridge's free height, to the underside of what stands over it."""

_GAP = 0.01
"""Metres; narrower gaps between corridors are closed."""

_LEAST = 0.05
"""Square metres; a building of which passages leave less has none."""

_RISE = 0.05
"""Metres: undersides are whole multiples of this over the base, so that pieces of road that are all but
equally high do not leave a stair of micrometres, which the grid of solids would crush."""


def ground_below(table: Structures, height: Height) -> Height:
    """The terrain, lowered where it would rise above the underside of a bridge.

    At a bridge's end it may reach the deck, from where it falls by 1 in 4.
    """
    bridges = np.flatnonzero(~table.tunnel)
    if not len(bridges):
        return height
    return partial(_lowered_height, table=table, height=height, bridges=bridges)


def _lowered_height(x: Float, y: Float, *, table: Structures, height: Height, bridges: Ints) -> Float:
    """The height of `ground_below`; a function of a module, so that worker processes can take it."""
    z = np.asarray(height(x, y), float).copy()
    if not len(z):
        return z
    decks = table.polygon[bridges]
    low, high = np.split(shapely.bounds(decks), 2, axis=1)
    near = (low <= [x.max(), y.max()]).all(axis=1) & (high >= [x.min(), y.min()]).all(axis=1)
    for d in np.flatnonzero(near).tolist():
        rows = np.flatnonzero((x >= low[d, 0]) & (x <= high[d, 0]) & (y >= low[d, 1]) & (y <= high[d, 1]))
        rows = rows[shapely.intersects_xy(decks[d], x[rows], y[rows])] if len(rows) else rows
        if not len(rows):
            continue
        k = int(bridges[d])
        deck = surface_heights(table, k, xy=np.column_stack([x[rows], y[rows]]))
        away = shapely.distance(shapely.points(x[rows], y[rows]), table.approach[k])
        away = np.where(np.isnan(away), np.inf, away)
        below = np.minimum(_FALL * away, table.body[k] + _BELOW)
        z[rows] = np.minimum(z[rows], deck - below)
    return z


def find_low_decks(table: Structures, height: Height | None, *, near: Bools) -> Structures:
    """The table with the areas (``low``) where the ground would rise into a bridge's deck.

    height : height of the ground before `ground_below` lowers it
    near   : (n,) which pieces have such areas
    """
    low = table.low.copy()
    for k in np.flatnonzero(~table.tunnel & near).tolist():
        xy, _, ground = _ground_on(np.array([table.polygon[k]], object), height)
        if (ground < surface_heights(table, k, xy=xy) - table.body[k] - _HIGH).all():
            continue
        strips = _strips(table, k)
        xy, strip, ground = _ground_on(strips, height)
        high = ground > surface_heights(table, k, xy=xy) - table.body[k]
        intersected = strips[np.bincount(strip[high], minlength=len(strips)) > 0]
        within = table.polygon[k].buffer(-_EDGE, join_style="mitre")
        low[k] = areal(shapely.union_all(shapely.buffer(intersected, 1e-3)).intersection(within), least=_TINY)
    return replace(table, low=low)


def _strips(table: Structures, k: int) -> NDArray[np.object_]:
    """A piece's outline cut into strips across its line."""
    line = table.line[k][:, :2]
    reach = float(table.half[k]) + 5.0
    length = shapely.LineString(line).length
    cuts = np.linspace(0.0, length, max(int(np.ceil(length / _STEP)), 1) + 1)
    strips = shapely.buffer(polylines.parts(line, cuts), reach, cap_style="flat", quad_segs=16)
    rest = table.polygon[k].difference(shapely.union_all(strips))  # beyond the line's ends, as at bends
    across = shapely.intersection(strips, table.polygon[k])
    return np.append(across, shapely.get_parts(areal(rest, least=_TINY)))


def _ground_on(strips: NDArray[np.object_], height: Height | None) -> tuple[Float, Ints, Float]:
    """Points (n, 2) around strips, the strip of each, and the ground's height there."""
    xy, strip = shapely.get_coordinates(shapely.segmentize(strips, _STEP), return_index=True)
    return xy, strip, np.zeros(len(xy)) if height is None else np.asarray(height(*xy.T), float)


def find_openings(
    table: Structures, height: Height | None, *, graph: RoadGraph, area: Any | None = None
) -> NDArray[np.object_]:
    """Areas (n,) above each tunnel piece without ground, as shapely polygons; None without any.

    There the ground is not higher than the minimum roof over the tunnel's ceiling. Roads on the ground that
    pass over the roof keep theirs.

    area : shapely geometry: pieces far from it have none
    """
    openings = np.empty(len(table), object)
    on_ground = np.flatnonzero(~graph.bridge & ~graph.tunnel)
    lines = edge_lines(graph)[on_ground]
    tree = shapely.STRtree(lines)
    for k in np.flatnonzero(table.tunnel & in_reach(table.polygon, area, metres=NEAR)).tolist():
        strips = _strips(table, k)
        xy, strip, ground = _ground_on(strips, height)
        covered = ground > surface_heights(table, k, xy=xy) + table.rise[k] + THINNEST + 2 * LIP
        open_ = np.bincount(strip[~covered], minlength=len(strips)) > 0
        if open_.any():
            within = table.inner[k].buffer(table.body[k] - _INTO, join_style="mitre")
            shape = shapely.union_all(shapely.buffer(strips[open_], 1e-3)).intersection(table.polygon[k])
            over = [
                lines[row].intersection(table.polygon[k]).buffer(graph.width[on_ground[row]] / 2 + VERGE)
                for row in tree.query(table.polygon[k], predicate="intersects").tolist()
                if _passes_over(table, k, line=graph.geometry[on_ground[row]])
            ]
            free = shape.intersection(within).difference(shapely.union_all(over))
            opening = areal(free, least=_TINY)
            openings[k] = None if opening.is_empty else opening
    return openings


def _passes_over(table: Structures, k: int, *, line: Float) -> bool:
    """Whether a road (n, 3) is above the roof of tunnel piece ``k`` wherever it is within its outline."""
    flat = polylines.flat(line)
    xy = shapely.get_coordinates(shapely.segmentize(flat.intersection(table.polygon[k]), _STEP))
    if not len(xy):
        return False
    roof = surface_heights(table, k, xy=xy) + table.rise[k] + THINNEST
    return bool((nearest_on_line(line, xy)[0] > roof).all())


def opening_layers(table: Structures, openings: NDArray[np.object_]) -> Layers:
    """Rows for `geoscene.ground`: class TUNNEL for openings, class TERRAIN for bare soil under low decks.

    The latter provide edges along which the ground can fall below the deck.
    """
    rows = np.flatnonzero([shape is not None for shape in openings])
    low = np.flatnonzero(~shapely.is_empty(table.low))
    return Layers.concatenate(
        [
            Layers.of(
                openings[rows],
                klass=Class.TUNNEL,
                material=materials()["concrete"].code,
                priority=OPENING,
                osm_id=table.osm_id[rows],
                feature=table.feature[rows],
            ),
            Layers.of(
                table.low[low],
                klass=Class.TERRAIN,
                material=materials()["soil"].code,
                priority=LOW,
                osm_id=table.osm_id[low],
            ),
        ]
    )


def tunnel_roof(
    xy: Float, ceiling: Float, *, ground: Float, opening: shapely.Geometry | None, options: StructureOptions
) -> Float:
    """Heights (n,) of a tunnel's roof at points (n, 2): below the ground, or above it in openings."""
    thick = ceiling + options.roof
    roof: Float = np.clip(ground - LIP, ceiling + THINNEST, thick)
    if opening is not None:
        shapely.prepare(opening)
        out = shapely.dwithin(opening, shapely.points(xy), 2e-3)
        roof = np.where(out, np.maximum(thick, ground + LIP), roof)
    return roof


def buildings_over(
    buildings: Buildings,
    base: Float,
    *,
    foot: Float,
    table: Structures,
    cuts: PassageCuts | None = None,
    options: StructureOptions | None = None,
) -> tuple[Buildings, list[Problem]]:
    """The buildings with passages, those on a tunnel or a road bridge, too, and the rows of those.

    Those of tunnels and bridges reach from below a building up to the tunnel's roof or the bridge's free
    height, but leave parts that end below the road. A bridge counts where its centre line lies within the
    building, not where its edge touches it; footbridges do not count, they lead into buildings.

    base : (count,) z in metres of each building's base, NaN for buildings that are not looked at
    foot : (count,) z in metres of the lower end of its walls
    cuts : passages of ways on the ground
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
    middle = np.array([polylines.flat(line) for line in table.line[road]], object)
    within = shapely.length(shapely.intersection(buildings.footprint[row], middle)) > _SCANT
    hit = (shapely.area(common) > _SCANT) & (tunnel | within)
    grounded = buildings.min_height[row] <= 0
    under = np.where(grounded, foot[buildings.outline[row]], stands + buildings.min_height[row])
    top = stands + buildings.height[row]
    hit &= (high > under) & (low < top)
    corridor = table.polygon[road]
    for k in np.flatnonzero((high > under) & (low >= top)).tolist():  # below the road
        same = (road == road[k]) & (buildings.outline[row] == buildings.outline[row[k]])
        corridor[same] = shapely.difference(corridor[same], buildings.footprint[row[k]])
    corridor = corridor[hit]
    clear, row, tunnel = (high - stands)[hit], row[hit], tunnel[hit]
    problems = [
        Problem(str(buildings.osm_id[k]), "building", "repaired", f"over-{what}", f"stands over a {what}")
        for what in ("tunnel", "bridge")
        for k in np.unique(buildings.outline[row[tunnel == (what == "tunnel")]]).tolist()
    ]
    if cuts is not None:
        row, clear = np.append(row, cuts.row), np.append(clear, cuts.clear)
        corridor = np.append(corridor, cuts.corridor)
    clear = np.ceil(clear / _RISE - 1e-3) * _RISE
    return _with_passages(buildings, row, corridor=corridor, clear=clear), problems


def _with_passages(
    buildings: Buildings, row: Ints, *, corridor: NDArray[np.object_], clear: Float
) -> Buildings:
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
    return replace(buildings, passages=passages)


def _close_gaps(corridors: NDArray[np.object_]) -> shapely.Geometry:
    """The union of corridors on the grid of buildings, without the gaps that rounding leaves between them."""
    wide = shapely.buffer(
        shapely.union_all(shapely.buffer(corridors, _GAP, join_style="mitre")), -_GAP, join_style="mitre"
    )
    return shapely.set_precision(shapely.simplify(wide, _GAP), GRID)

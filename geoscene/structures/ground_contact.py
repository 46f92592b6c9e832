"""Ground at structures: lowered below bridge decks, and open where tunnels surface."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class, materials
from geoscene.geometry import polylines
from geoscene.ground.layers import PADS, Layers
from geoscene.roadgraph.surface_rows import in_reach
from geoscene.structures.heights import surface_heights
from geoscene.structures.pieces import NEAR
from geoscene.structures.sheets import areal
from geoscene.structures.table import THINNEST, StructureOptions, Structures
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

_EDGE = 0.05
"""Metres from a deck's outside to the outline along which the ground falls away below it."""

_HIGH = 1.0
"""Metres over the ground around it at which a deck is over the ground below it as well."""

_TINY = 0.01
"""Square metres; smaller parts of areas are left out."""

_INTO = 0.1
"""Metres by which the ground reaches into a tunnel's wall beside an opening."""


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
    table: Structures, height: Height | None, *, area: Any | None = None
) -> NDArray[np.object_]:
    """Areas (n,) above each tunnel piece without ground, as shapely polygons; None without any.

    There the ground is not higher than the minimum roof over the tunnel's ceiling.

    area : shapely geometry: pieces far from it have none
    """
    openings = np.empty(len(table), object)
    for k in np.flatnonzero(table.tunnel & in_reach(table.polygon, area, metres=NEAR)).tolist():
        strips = _strips(table, k)
        xy, strip, ground = _ground_on(strips, height)
        covered = ground > surface_heights(table, k, xy=xy) + table.rise[k] + THINNEST + 2 * LIP
        open_ = np.bincount(strip[~covered], minlength=len(strips)) > 0
        if open_.any():
            within = table.inner[k].buffer(table.body[k] - _INTO, join_style="mitre")
            shape = shapely.union_all(shapely.buffer(strips[open_], 1e-3)).intersection(table.polygon[k])
            opening = areal(shape.intersection(within), least=_TINY)
            openings[k] = None if opening.is_empty else opening
    return openings


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

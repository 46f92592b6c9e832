"""Bridges and tunnels read from a map, and their piers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.geometry import polylines
from geoscene.geometry.frames import Frame
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.surface_rows import SurfaceRows, in_reach
from geoscene.roadgraph.surfaces import RoadSurfaces
from geoscene.sources.data import OsmData
from geoscene.structures.contact import find_low_decks
from geoscene.structures.paths import path_members
from geoscene.structures.pieces import NEAR, Members, cut_pieces, road_members
from geoscene.structures.table import StructureOptions, Structures, nearest_on_line
from geoscene.support.problems import Problem
from geoscene.typing import Bools, Float, Height

_KEPT_FREE = (Class.ROAD, Class.LANE_MARKING, Class.CROSSING, Class.SIDEWALK, Class.KERB, Class.RAIL)
"""No pier stands on these."""

_FREE = 0.5
"""Metres between a pier and what it must not stand on."""

_RAIL_FREE = 2.0
"""Metres between a pier and a rail."""

_LOW = 1.0
"""Metres: where a bridge is less above the ground it needs no pier."""

_SHARE, _ALONG = 0.6, 1.0
"""A pier's width as a share of its bridge's, and its length along it in metres. Assumed."""

_END = 0.9
"""Metres from a bridge's end to the middle of the pier under it, where it does not lie on the ground."""

_SHIFTS = (0.0, 2.0, -2.0, 4.0, -4.0, 6.0, -6.0, 8.0, -8.0, 10.0, -10.0)
"""Metres along the bridge by which a pier gives way."""


def read_structures(
    surfaces: RoadSurfaces,
    graph: RoadGraph,
    *,
    osm: OsmData,
    frame: Frame,
    height: Height | None = None,
    options: StructureOptions | None = None,
    area: Any | None = None,
) -> tuple[Structures, list[Problem]]:
    """The bridges and tunnels of a map, and the problems repaired or dropped.

    graph  : with heights, from `geoscene.roadgraph.profile`
    height : height of the graded ground (`geoscene.roadgraph.graded_ground`); level at 0 by default
    area   : shapely geometry, scene metres: pieces far from it have no piers, no low ground and no area
             within their parapets; all have by default
    """
    options = options or StructureOptions()
    raised = surfaces.raised
    paths, problems = path_members(raised, osm, frame=frame, graph=graph, height=height, options=options)
    members = Members.concatenate([road_members(graph, raised), paths])
    table = cut_pieces(members, raised, graph=graph, options=options, area=area)
    near = in_reach(table.polygon, area, metres=NEAR)
    table = place_piers(table, surfaces, height=height, near=near, options=options)
    return find_low_decks(table, height, near=near), problems


def place_piers(
    table: Structures, ground: SurfaceRows, *, height: Height | None, near: Bools, options: StructureOptions
) -> Structures:
    """The table with piers at equal spans, moved or left out where something passes below.

    ground : roads, paths and rails on the ground
    near   : (n,) which pieces have piers
    """
    rows = np.flatnonzero(np.isin(ground.klass, _KEPT_FREE))
    below = shapely.STRtree(ground.polygon[rows])
    rail = ground.klass[rows] == Class.RAIL
    pieces = shapely.STRtree(table.polygon)
    pier, spacing = table.pier.copy(), table.pier_spacing.copy()
    ends, solid = _ends(table), shapely.STRtree(ground.polygon[rows[~rail]])
    for k in np.flatnonzero(~table.tunnel & near).tolist():
        flat = polylines.flat(table.line[k])
        count = max(int(np.ceil(flat.length / options.pier_spacing)), 1)
        spacing[k] = flat.length / count
        at = (np.arange(count) + 0.5) * spacing[k]
        tries = np.add.outer(at, [s for s in _SHIFTS if abs(s) < spacing[k] / 2])
        shapes = _piers(table, k, flat=flat, at=tries.ravel())
        free = _above_ground(table, k, flat=flat, at=tries.ravel(), height=height) & ~shapely.is_empty(shapes)
        hit, found = below.query(shapes, predicate="dwithin", distance=_FREE)
        free[hit] = False
        hit, found = below.query(shapes, predicate="dwithin", distance=_RAIL_FREE)
        free[hit[rail[found]]] = False
        free &= ~_on_pieces(table, k, pieces=pieces, shapes=shapes)
        free = free.reshape(tries.shape)
        first = free.argmax(axis=1) + np.arange(count) * tries.shape[1]
        stands = [
            *shapes[first[free.any(axis=1)]],
            *_abutments(table, k, flat=flat, ends=ends, ways=solid, height=height),
        ]
        pier[k] = shapely.MultiPolygon(shapely.get_parts(shapely.union_all(stands)).tolist())
    spacing[shapely.is_empty(pier)] = 0.0
    return replace(table, pier=pier, pier_spacing=spacing)


def _ends(table: Structures) -> Bools:
    """Whether no other piece continues from the start and the end of each piece's line (n, 2)."""
    places = np.array([line[[0, -1], :2] for line in table.line]).reshape(-1, 2)
    _, number, count = np.unique(np.round(places, 2), axis=0, return_inverse=True, return_counts=True)
    ends: Bools = (count[number.ravel()] == 1).reshape(-1, 2)
    return ends


def _abutments(
    table: Structures,
    k: int,
    *,
    flat: shapely.LineString,
    ends: Bools,
    ways: shapely.STRtree,
    height: Height | None,
) -> list[shapely.Geometry]:
    """Piers at the ends of a piece that hang above the ground, as railway bridges without an embankment do.

    They keep clear of roads and paths, but not of the piece's own track, which ends before them.
    """
    at = np.array([_END, flat.length - _END])[ends[k]]
    shapes = _piers(table, k, flat=flat, at=at)
    free = _above_ground(table, k, flat=flat, at=at, height=height) & ~shapely.is_empty(shapes)
    free[np.unique(ways.query(shapes, predicate="dwithin", distance=_FREE)[0])] = False
    return list(shapes[free])


def _piers(table: Structures, k: int, *, flat: shapely.LineString, at: Float) -> NDArray[np.object_]:
    """Piers' outlines (n,) at metres along a piece."""
    wide = min(_SHARE * 2 * table.half[k], 2 * table.half[k] - 0.6)
    here, there = (
        shapely.get_coordinates(shapely.line_interpolate_point(flat, np.clip(at + s, 0.0, flat.length)))
        for s in (-0.5, 0.5)
    )
    way = polylines.unit(there - here)
    across = np.column_stack([-way[:, 1], way[:, 0]]) * wide / 2
    middle = (here + there) / 2
    lines = shapely.linestrings(np.stack([middle - across, middle + across], axis=1))
    along = min(_ALONG, wide)
    within = table.polygon[k].buffer(-0.3)
    shapes: NDArray[np.object_] = shapely.intersection(
        shapely.buffer(lines, along / 2, cap_style="flat"), within
    )
    return shapes


def _above_ground(
    table: Structures, k: int, *, flat: shapely.LineString, at: Float, height: Height | None
) -> Bools:
    """Whether the bridge is well above the ground at metres along it."""
    xy = shapely.get_coordinates(shapely.line_interpolate_point(flat, at))
    ground = np.zeros(len(xy)) if height is None else np.asarray(height(*xy.T), float)
    high: Bools = nearest_on_line(table.line[k], xy)[0] - table.body[k] > ground + _LOW
    return high


def _on_pieces(table: Structures, k: int, *, pieces: shapely.STRtree, shapes: NDArray[np.object_]) -> Bools:
    """Whether each pier would be on another bridge or over an open tunnel."""
    blocked = np.zeros(len(shapes), np.bool_)
    hit, found = pieces.query(shapes, predicate="dwithin", distance=_FREE)
    for row, other in zip(hit.tolist(), found.tolist(), strict=True):
        if other == k or other in table.near[k]:
            continue
        xy = shapely.get_coordinates(shapes[row].centroid)
        blocked[row] |= (
            nearest_on_line(table.line[other], xy)[0][0] < nearest_on_line(table.line[k], xy)[0][0]
        )
    return blocked

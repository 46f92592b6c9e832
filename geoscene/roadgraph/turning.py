"""Places to turn: turning circles, turning loops with their islands, and mini-roundabouts."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.ground.layers import KERBS, SIDEWALKS
from geoscene.roadgraph.carriageways import KERB, Carriageways
from geoscene.roadgraph.surface_rows import SurfaceRows
from geoscene.roadgraph.tags import TURNING, island_radius, read_diameter
from geoscene.sources.data import OsmData, TaggedNode

_NEAR = 3.0
"""Metres from a node within which the middles of its carriageways are looked for."""
_DOME = 3.0
"""Metres, diameter of the painted middle of a mini-roundabout (1 to 4 m in British practice)."""
_CARRIAGEWAY, _PRIORITY, _PAINT = 130.25, 146.9, 170.0
"""Islands cover carriageways and junctions, paint covers both."""


def turning_rows(osm: OsmData, roads: Carriageways) -> SurfaceRows:
    """The surfaces of places to turn on carriageways, with kerbs, sidewalks, islands and paint.

    They have the material and the sidewalk of the most important road there, and are not narrower than it.
    """
    node_of = {int(osm_id): k for k, osm_id in enumerate(roads.node_id.tolist())}
    places = [
        (point, node_of[number])
        for point in osm.points
        if point.tags.get("highway") in TURNING
        and (number := int(point.osm_id.removeprefix("node/"))) in node_of
    ]
    middles = shapely.points(roads.node_xy[[node for _, node in places]].reshape(-1, 2))
    place, road = shapely.STRtree(roads.line).query(middles, predicate="dwithin", distance=_NEAR)
    rows: list[SurfaceRows] = []
    importance = roads.importance
    for k, (point, _) in enumerate(places):
        near = road[place == k]
        if not len(near):
            continue
        # Of roads beside their nodes, those of other carriageways may be near: the nearest one comes first.
        metres = np.round(shapely.distance(roads.line[near], middles[k]), 2)
        main = int(near[np.lexsort([near, -importance[near], metres])[0]])
        priority = _CARRIAGEWAY + float(importance[main])
        rows += _rows_at(point, middles[k], roads=roads, main=main, priority=priority)
    none = SurfaceRows.of(np.empty(0, object), klass=Class.ROAD, material="asphalt", priority=0.0)
    return SurfaceRows.concatenate([none, *rows])


def _rows_at(
    point: TaggedNode, middle: shapely.Point, *, roads: Carriageways, main: int, priority: float
) -> list[SurfaceRows]:
    """The surfaces of one place to turn."""
    kind = point.tags["highway"]
    tagged = "diameter" in point.tags
    radius = max(read_diameter(point.tags, []), float(roads.width[main])) / 2
    shape_source = "diameter" if tagged else "default"
    common = {"osm_id": point.osm_id, "place": roads.place[main], "level": roads.layer[main]}
    source = f"{shape_source}/{roads.material_source[main]}"

    def disc(metres: float) -> NDArray[np.object_]:
        return np.array([middle.buffer(metres, quad_segs=12)], object)

    found = [
        SurfaceRows.of(
            disc(radius),
            klass=Class.ROAD,
            material=str(roads.material[main]),
            priority=priority,
            source=source,
            **common,
        )
    ]
    walk = float(roads.walk[main].max())
    if walk > 0:
        for klass, high, material, metres in (
            (Class.KERB, KERBS, "concrete", radius + KERB),
            (Class.SIDEWALK, SIDEWALKS, "paving", radius + KERB + walk),
        ):
            found.append(
                SurfaceRows.of(disc(metres), klass=klass, material=material, priority=high, **common)
            )
    if island := island_radius(point.tags, float(roads.width[main])):
        for klass, more, material, metres in (
            (Class.KERB, 0.0, "concrete", island),
            (Class.GRASS, 0.05, "grass", island - KERB),
        ):
            found.append(
                SurfaceRows.of(
                    disc(metres), klass=klass, material=material, priority=_PRIORITY + more, **common
                )
            )
    if kind == "mini_roundabout":
        found.append(
            SurfaceRows.of(
                disc(min(_DOME, radius) / 2),
                klass=Class.LANE_MARKING,
                material="lane_paint",
                priority=_PAINT,
                source=f"{shape_source}/default",
                **common,
            )
        )
    return found

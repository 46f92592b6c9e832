"""Road surfaces in plan: carriageways, kerbs, sidewalks, paths, markings, crossings and rails."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from geoscene.ground.layers import KERBS, SIDEWALKS
from geoscene.roadgraph.carriageways import KERB, PAVED, Carriageways, read_carriageways
from geoscene.roadgraph.covers import cover_rows
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.junctions import JOINT, build_junctions, carriageway
from geoscene.roadgraph.markings import marking_rows, painted_stretches, stop_rows
from geoscene.roadgraph.paths import crossing_rows, path_surfaces, rail_surfaces, square_surfaces
from geoscene.roadgraph.routing import edge_lines
from geoscene.roadgraph.surface_rows import SurfaceRows, in_reach
from geoscene.roadgraph.symbols import symbol_rows
from geoscene.roadgraph.turning import turning_rows
from geoscene.sources.data import OsmData
from geoscene.typing import Float, Ints

_CARRIAGEWAY = 130.0
# Metres by which a bridge is wider than its surfaces on each side, for the parapet. Assumed.
_PARAPET = 0.5


@dataclass(frozen=True, slots=True)
class SurfaceOptions:
    """Defaults for road surfaces where the map has no tags.

    sidewalks : ``urban`` gives paved streets in built-up areas (up to 60 km/h) sidewalks where the map has
                neither a sidewalk tag nor a footway beside them; ``mapped`` gives them none
    left_hand : traffic keeps left
    covers    : manhole covers and the like: none, the ``mapped`` ones, or also what is ``guessed``
    """

    sidewalks: Literal["mapped", "urban"] = "urban"
    left_hand: bool = False
    covers: Literal["none", "mapped", "guessed"] = "none"


@dataclass(frozen=True, slots=True)
class RoadSurfaces(SurfaceRows):
    """`SurfaceRows` of the ground, priorities 100 to 200.

    raised : the surfaces on bridges and in tunnels: their carriageways, kerbs, sidewalks and markings, and
             (class BRIDGE, lowest) the outline of the deck
    first  : number of the first carriageway; that of carriageway k is ``first + k``
    count  : of numbers, which neither depend on how shapes are cut nor on the area
    """

    raised: SurfaceRows
    first: int
    count: int


def road_surfaces(
    osm: OsmData,
    graph: RoadGraph,
    *,
    frame: Frame,
    roads: Carriageways | None = None,
    options: SurfaceOptions | None = None,
    area: Any | None = None,
) -> RoadSurfaces:
    """The surfaces of roads, paths and rails in plan.

    Surfaces overlap: the kerb extends under the carriageway and the sidewalk under the kerb, so that cutting
    by priority leaves neither gaps nor slivers between them.

    roads : the map's carriageways, read with the same options if not given
    area  : shapely geometry, scene metres: carriageways on the ground far from it are left out, with the same
            numbers for the others; none are by default
    """
    options = options or SurfaceOptions()
    roads = roads or read_carriageways(osm, frame, sidewalks=options.sidewalks, left_hand=options.left_hand)
    edge = _edges_below(roads, graph)
    crossings = crossing_rows(osm, roads, frame=frame)
    strips = crossings.polygon[crossings.priority == crossings.priority.min(initial=np.inf)]
    paths = SurfaceRows.concatenate([square_surfaces(osm, frame), path_surfaces(osm, frame)])
    carriageways, count = _carriageway_rows(roads, edge, first=len(paths), area=area)
    stretches = painted_stretches(roads, left_hand=options.left_hand)
    lines = marking_rows(roads, stretches, edge=edge, left_hand=options.left_hand)
    stops = stop_rows(graph, roads, crossings=strips, left_hand=options.left_hand)
    taken = np.concatenate([strips, stops.polygon])
    symbols = symbol_rows(roads, stretches, edge=edge, taken=taken, left_hand=options.left_hand)
    covers = []
    if options.covers != "none":
        covers = [cover_rows(osm, roads, frame=frame, guess=options.covers == "guessed")]
    turning = turning_rows(osm, roads)
    others = SurfaceRows.concatenate(
        [crossings, lines, stops, rail_surfaces(osm, frame), symbols, *covers, turning]
    )
    paths.number[:] = np.arange(len(paths))
    others.number[:] = count + np.arange(len(others))
    rows = SurfaceRows.concatenate([paths, *carriageways, others])
    ground = rows.take(rows.place == 0)
    columns = {f.name: getattr(ground, f.name) for f in fields(ground)}
    return RoadSurfaces(
        **columns, raised=rows.take(rows.place != 0), first=len(paths), count=count + len(others)
    )


def carriageway_boxes(roads: Carriageways) -> Float:
    """Boxes (n, 4) that cover all surfaces of carriageways and junctions, however these are cut."""
    xy, road = shapely.get_coordinates(roads.line, return_index=True)
    beside = _beside(roads)
    on = np.flatnonzero(road[1:] == road[:-1])
    near = beside[road[on], None]
    low, high = np.minimum(xy[on], xy[on + 1]) - near, np.maximum(xy[on], xy[on + 1]) + near
    reach = _junction_reach(roads)[:, None]
    return np.concatenate(
        [np.hstack([low, high]), np.hstack([roads.node_xy - reach, roads.node_xy + reach])[reach[:, 0] > 0]]
    )


def _beside(roads: Carriageways) -> Float:
    """Metres (k,) from the centre line of each carriageway to the outside of its surfaces, at most."""
    out: Float = roads.width / 2 + roads.walk.max(axis=1, initial=0.0) + KERB + _PARAPET + 1.0
    return out


def _junction_reach(roads: Carriageways) -> Float:
    """Upper bound (n,) in metres from each node to the border of its junction; 0 without one."""
    reach = np.zeros(len(roads.node_xy))
    starts, ends = (shapely.get_coordinates(shapely.get_point(roads.line, k)) for k in (0, -1))
    off = np.linalg.norm(np.stack([starts, ends], axis=1) - roads.node_xy[roads.ends], axis=2)
    np.maximum.at(reach, roads.ends.ravel(), (_beside(roads)[:, None] + off).ravel() + JOINT)
    reach[np.bincount(roads.ends.ravel(), minlength=len(reach)) < 2] = 0.0
    return reach


def _edges_below(roads: Carriageways, graph: RoadGraph) -> NDArray[np.int32]:
    """The edge of the graph that runs along each carriageway (k,), the first of a street's two, or -1."""
    edge = np.full(len(roads), -1, np.int32)
    if not len(graph) or not len(roads):
        return edge
    middle = shapely.line_interpolate_point(roads.line, 0.5, normalized=True)
    row, found = shapely.STRtree(edge_lines(graph)).query(middle, predicate="dwithin", distance=1e-3)
    for k, e in zip(row[::-1].tolist(), found[::-1].tolist(), strict=True):
        if roads.osm_id[k] in str(graph.osm_id[e]).split(";") and (edge[k] < 0 or e < edge[k]):
            edge[k] = e
    return edge


def _carriageway_rows(
    roads: Carriageways, edge: NDArray[np.int32], *, first: int, area: Any | None
) -> tuple[list[SurfaceRows], int]:
    """Surfaces of carriageways that are raised or near the area, numbered from ``first``; the next number."""
    if not len(roads):
        return [], first
    importance = roads.importance
    place, level = roads.place, roads.layer
    half = roads.width / 2
    common = {"osm_id": roads.osm_id, "place": place, "level": level, "edge": edge}

    def at(rows: Ints) -> dict[str, NDArray[np.generic]]:
        return {name: column[rows] for name, column in common.items()}

    source = np.array(
        [f"{s.width_source}/{m}" for s, m in zip(roads.street, roads.material_source, strict=True)]
    )
    wanted = (place != 0) | in_reach(roads.line, area, metres=_beside(roads))
    chosen = np.flatnonzero(wanted)
    at_node = in_reach(shapely.points(roads.node_xy), area, metres=_junction_reach(roads))
    joints = build_junctions(roads, importance, wanted=(place != 0)[:, None] | at_node[roads.ends])
    count = first + len(roads)
    out = [
        SurfaceRows.of(
            carriageway(roads.line[chosen], half[chosen]),
            klass=Class.ROAD,
            material=roads.material[chosen],
            priority=_CARRIAGEWAY + importance[chosen],
            source=source[chosen],
            number=first + chosen,
            **at(chosen),
        ),
        SurfaceRows.of(
            joints.polygon,
            klass=Class.ROAD,
            material=roads.material[joints.main],
            priority=_CARRIAGEWAY + importance[joints.main] + 0.5,
            source=source[joints.main],
            number=count + joints.number,
            **at(joints.main),
        ),
    ]
    count += 2 * len(roads)
    tagged = (roads.walk_source == "sidewalk").any(axis=1)
    walk_source = np.where(tagged, "sidewalk/default", "default/default")
    walk_material = np.where(np.isin(roads.material, list(PAVED)), "paving", "gravel")
    for klass, priority, material, shape in (
        (Class.KERB, KERBS, np.full(len(roads), "concrete"), "kerb"),
        (Class.SIDEWALK, SIDEWALKS, walk_material, "walk"),
    ):
        extra = np.where(roads.walk > 0, KERB + (roads.walk if shape == "walk" else 0.0), 0.0)
        bands_of = _widen(roads, half, extra=extra, rows=chosen)
        corners = (joints.corner_main, joints.corner_number, getattr(joints, shape))
        for rows, number, bands in (*((rows, rows, bands) for rows, bands in bands_of), corners):
            out.append(
                SurfaceRows.of(
                    bands,
                    klass=klass,
                    material=material[rows],
                    priority=priority,
                    source=walk_source[rows],
                    number=count + number,
                    **at(rows),
                )
            )
            count += 2 * len(roads)
    bridge = np.flatnonzero(place == 1)
    out.append(
        SurfaceRows.of(
            carriageway(roads.line[bridge], half[bridge] + (roads.walk.max(axis=1) + _PARAPET)[bridge]),
            klass=Class.BRIDGE,
            material="concrete",
            priority=101.0,
            number=count + bridge,
            **at(bridge),
        )
    )
    return out, count + len(roads)


def _widen(
    roads: Carriageways, half: Float, *, extra: Float, rows: Ints
) -> list[tuple[Ints, NDArray[np.object_]]]:
    """Bands ``extra`` (k, 2) wider than some carriageways on the left and right, with their rows."""
    both = rows[(extra[rows, 0] == extra[rows, 1]) & (extra[rows, 0] > 0)]
    out: list[tuple[Ints, NDArray[np.object_]]] = []
    out.append((both, carriageway(roads.line[both], half[both] + extra[both, 0])))
    for side, sign in ((0, 1.0), (1, -1.0)):
        one = rows[(extra[rows, 0] != extra[rows, 1]) & (extra[rows, side] > 0)]
        far = sign * (half[one] + extra[one, side])
        bands = shapely.buffer(roads.line[one], far, single_sided=True, join_style="mitre", mitre_limit=1.1)
        out.append((one, bands))
    return out

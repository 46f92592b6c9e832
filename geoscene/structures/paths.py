"""Bridges and tunnels of footways, cycleways, private roads and railway tracks, with their heights."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from geoscene.geometry.polylines import unit
from geoscene.roadgraph import find_obstacles
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.layers import rank_ways
from geoscene.roadgraph.paths import way_lines
from geoscene.roadgraph.routing import edge_lines
from geoscene.roadgraph.surface_rows import SurfaceRows
from geoscene.roadgraph.tags import drivable, is_tunnel, place_and_layer, read_layer
from geoscene.sources.data import OsmData, Way
from geoscene.structures.pieces import Members
from geoscene.structures.table import StructureOptions, nearest_on_line
from geoscene.support.problems import Problem
from geoscene.typing import Bools, Float, Height, Ints

_STATION = 5.0
"""Maximum metres between stations."""

_BESIDE = 4.0
"""Metres from a road bridge's carriageway within which a path of the same layer is on that bridge."""

_COVER = 0.3
"""Metres of ground over the roof of a pedestrian tunnel."""

_SPARE = 0.6
"""Metres of cover and roof that a path over a tunnel may take away."""

_SLOPE = 0.12
"""Maximum gradient of ramps; one in eight is a steep ramp. Assumed."""

_STEEPEST = 0.35
"""The same where a tunnel leaves a street that it must not lower."""

_TRACK_SLOPE = 0.025
"""The same for railways (EN 15273 and the TSI for infrastructure have 2.5 % on main lines, 3.5 % at most)."""

_BED = 4.4
"""Metres: width of the deck under one track."""

_UNDERGROUND, _SURFACE, _STREET = 1, 2, 3
"""What a way joins at an end: only tunnels, ways on the surface, a public street on the ground."""

_HANGING = 0.5
"""Metres between a bridge's end and the ground from which they are reported."""


@dataclass(frozen=True, slots=True)
class _Net:
    """Network of stations along all ways, shared where ways share nodes.

    xy     : (v, 2) float64
    rows   : per way, its stations in order
    a, b   : (s,) neighbouring stations
    metres : (s,) between them
    slope  : (s,) float64, maximum gradient between them
    node   : (v,) int64, the map's node at each station, 0 where there is none
    """

    xy: Float
    rows: list[Ints]
    a: Ints
    b: Ints
    metres: Float
    slope: Float
    node: Ints


@dataclass(frozen=True, slots=True)
class _Crossed:
    """Obstacles that paths may cross, and the rules for each.

    height : height of the terrain at x, y; None for level ground at 0
    """

    osm: OsmData
    frame: Frame
    graph: RoadGraph
    height: Height | None
    options: StructureOptions


@dataclass(frozen=True, slots=True)
class _Paths:
    """Paths on bridges and in tunnels, one row each.

    tunnel : (n,) bool, else on a bridge
    level  : (n,) int8, OSM layer
    body   : (n,) metres from the surface to the underside of the deck
    free   : (n,) metres of free height over the surface
    """

    tunnel: Bools
    level: NDArray[np.int8]
    body: Float
    free: Float


def path_members(
    raised: SurfaceRows,
    osm: OsmData,
    *,
    frame: Frame,
    graph: RoadGraph,
    height: Height | None,
    options: StructureOptions,
) -> tuple[Members, list[Problem]]:
    """Bridges and tunnels of ways outside the road graph, and the ways that end above the ground.

    Beside a road bridge of the same layer they have its height. Otherwise they run evenly from ground to
    ground, but with the required clearance over (or under) roads, tracks and water, from where they fall
    (rise) with the gradient of a ramp. Tunnels below the ground descend with that gradient from their
    junctions with ways on the surface until the ground covers them, and stay at that depth. Those of private
    roads and tracks that have no room for it, below or above the streets they cross, are as low as those of
    footways.
    """
    own = np.flatnonzero(
        (raised.edge < 0)
        & (raised.klass != Class.LANE_MARKING)
        & ((raised.place == 1) | ((raised.place == 2) & (raised.klass != Class.RAIL)))
    )
    place = dict(zip(raised.osm_id[own].tolist(), raised.place[own].tolist(), strict=True))
    chosen = [
        way
        for way in osm.ways
        if way.osm_id in place
        and len(way.nodes) > 1
        and way.nodes[0] != way.nodes[-1]
        and np.isfinite(way.lonlat).all()
    ]
    ways, lines = way_lines(chosen, frame)
    ids = np.array([way.osm_id for way in ways], np.str_)
    tunnel = np.array([place[name] == 2 for name in ids.tolist()], np.bool_)
    rows = [own[raised.osm_id[own] == name] for name in ids.tolist()]
    level = np.array([raised.level[r[0]] for r in rows], np.int8)
    track = np.array([(raised.klass[r] == Class.RAIL).all() for r in rows], np.bool_)
    net = _network(lines, [way.nodes for way in ways], slope=np.where(track, _TRACK_SLOPE, _SLOPE))
    foot_only = ~track & np.array([(raised.klass[r] != Class.ROAD).all() for r in rows], np.bool_)
    sunk = tunnel & _is_below_ground(osm, ways)
    joined = _find_joined(osm, ways)
    ends = _ends(net, sunk, joined=joined)
    mouth = _find_mouths(net, sunk, joined=joined)
    crossed = _Crossed(osm, frame, graph, height, options)
    paths = _Paths(
        tunnel,
        level,
        np.where(track, options.deck, options.slab),
        np.where(foot_only, options.passage, options.headroom),
    )
    low = foot_only | _find_low(net, paths, rows=sunk & ~foot_only, mouth=mouth, crossed=crossed)
    paths = replace(paths, free=np.where(low, options.passage, options.headroom))
    depth = _depths(net, sunk, mouth=mouth, full=paths.free + options.roof + _COVER)
    held = np.zeros(len(net.xy), np.bool_)
    held[[net.rows[k][-e] for k, e in np.argwhere(sunk[:, None] & (joined == _STREET)).tolist()]] = True
    z = _heights(net, paths, ends=ends, held=held, depth=depth, crossed=crossed)

    count = len(ways)
    line, approach, own_rows = (np.empty(count, object) for _ in range(3))
    landed = np.zeros((count, 2), np.bool_)
    width = np.empty(count)
    problems = []
    for k in range(count):
        station = net.rows[k]
        line[k] = np.column_stack([net.xy[station], z[station]])
        own_rows[k] = rows[k]
        area = shapely.area(shapely.union_all(raised.polygon[rows[k]]))
        width[k] = _BED if track[k] else max(area / max(lines[k].length, 1.0), 0.5)
        landed[k] = ends[station[[0, -1]]]
        approach[k] = shapely.union_all(
            [_area_before_start(line[k][:: 1 - 2 * e, :2], width[k]) for e in (0, 1) if landed[k, e]]
        )
        gap = z[station[[0, -1]]] - _ground(net.xy[station[[0, -1]]], height)
        worst = float(np.abs(gap[landed[k]]).max(initial=0.0))
        if worst > _HANGING:
            detail = f"an end {worst:.1f} m from the ground"
            problems.append(Problem(str(ids[k]), "structure", "repaired", "no-ramp", detail))
    edge = np.full(count, -1, np.int32)
    return Members(line, tunnel, low, width, own_rows, approach, landed, ~landed, level, edge, ids), problems


def _ground(xy: Float, height: Height | None) -> Float:
    return np.zeros(len(xy)) if height is None else np.asarray(height(*xy.T), float)


def _area_before_start(xy: Float, width: float) -> shapely.Geometry:
    """The area of the way's first metres before the start of its line."""
    band = shapely.LineString([xy[0], xy[0] - 3.0 * unit(xy[1] - xy[0])]).buffer(width, cap_style="flat")
    return band.union(shapely.Point(xy[0]).buffer(width / 2))


def _network(lines: NDArray[np.object_], nodes: list[Ints], *, slope: Float) -> _Net:
    """Stations at the ends and along lines with given maximum gradients (n,)."""
    number: dict[int, int] = {}
    places: list[Float] = []
    rows, a, b, metres = [], [], [], []
    count = 0
    for line, ids in zip(lines, nodes, strict=True):
        xy = shapely.get_coordinates(shapely.segmentize(line, _STATION))
        station = np.empty(len(xy), np.int64)
        # Ways share nodes, which are identified by their coordinates in the line.
        drawn = shapely.get_coordinates(line)
        whole = len(drawn) == len(ids)
        ends = (0, -1)
        known = (
            zip(drawn.tolist(), ids.tolist(), strict=True)
            if whole
            else ((drawn[e].tolist(), ids[e]) for e in ends)
        )
        at = {tuple(place): int(node) for place, node in known}
        for k, p in enumerate(xy.tolist()):
            node = at.get(tuple(p))
            if node is not None and node in number:
                station[k] = number[node]
                continue
            station[k] = count
            places.append(xy[k])
            if node is not None:
                number[node] = count
            count += 1
        rows.append(station)
        a.append(station[:-1])
        b.append(station[1:])
        metres.append(np.maximum(np.hypot(*np.diff(xy, axis=0).T), 1e-3))
    if not rows:
        none = np.empty(0, np.int64)
        return _Net(np.empty((0, 2)), [], none, none, np.empty(0), np.empty(0), none)
    steep = np.repeat(slope, [len(part) for part in a])
    node_at = np.zeros(count, np.int64)
    node_at[list(number.values())] = list(number)
    return _Net(
        np.array(places), rows, np.concatenate(a), np.concatenate(b), np.concatenate(metres), steep, node_at
    )


def _is_below_ground(osm: OsmData, ways: list[Way]) -> Bools:
    """Whether tunnels (n,) are below the ground: by layer; by default if less than half is in buildings."""
    houses = np.array([area.geometry for area in osm.areas if "building" in area.tags], object)
    tree = shapely.STRtree(houses)
    out = np.zeros(len(ways), np.bool_)
    for k, way in enumerate(ways):
        layer, source = read_layer(way.tags, [])
        if source in ("layer", "level"):
            out[k] = layer < 0
            continue
        line = shapely.LineString(way.lonlat)
        over = houses[tree.query(line, predicate="intersects")]
        out[k] = line.intersection(shapely.union_all(over)).length < 0.5 * line.length
    return out


def _find_joined(osm: OsmData, ways: list[Way]) -> NDArray[np.int8]:
    """Other ways at the start and end (n, 2) of ways: 0 none, else the greatest of the kinds above."""
    own = {way.osm_id for way in ways}
    kind: dict[int, int] = {}
    for way in osm.ways:
        if way.osm_id in own or not ("highway" in way.tags or "railway" in way.tags):
            continue
        on_ground = place_and_layer(way.tags)[0] == 0
        place = _UNDERGROUND if is_tunnel(way.tags) else _SURFACE
        place = _STREET if on_ground and drivable(way.tags) else place
        for node in way.nodes.tolist():
            kind[node] = max(kind.get(node, 0), place)
    at = [[kind.get(int(node), 0) for node in way.nodes[[0, -1]]] for way in ways]
    return np.array(at, np.int8).reshape(-1, 2)


def _ends(net: _Net, sunk: Bools, *, joined: NDArray[np.int8]) -> Bools:
    """Whether a station (v,) is the end of one way only; not for dead ends underground."""
    ends: Bools = np.bincount(np.concatenate([net.a, net.b]), minlength=len(net.xy)) == 1
    for k in np.flatnonzero(sunk).tolist():
        station = net.rows[k][[0, -1]]
        ends[station[joined[k] == 0]] = False
    return ends


def _find_mouths(net: _Net, sunk: Bools, *, joined: NDArray[np.int8]) -> Bools:
    """Whether tunnels below the ground may begin at a station (v,): at and on ways on the surface."""
    mouth = np.zeros(len(net.xy), np.bool_)
    for k, rows in enumerate(net.rows):
        mouth[rows[[0, -1]][joined[k] >= _SURFACE] if sunk[k] else rows] = True
    return mouth


def _depths(net: _Net, sunk: Bools, *, mouth: Bools, full: Float) -> Float:
    """Minimum depth (v,) of stations under the ground: ``full`` (n,) except on ramps; NaN elsewhere."""
    depth = np.full(len(net.xy), np.nan)
    for k in np.flatnonzero(sunk).tolist():
        depth[net.rows[k]] = np.fmax(depth[net.rows[k]], full[k])
    if np.isnan(depth).all():
        return depth
    ramped: Float = np.minimum(depth, -_cones(net, np.where(mouth, 0.0, -np.inf)))
    return ramped


def _find_low(net: _Net, paths: _Paths, *, rows: Bools, mouth: Bools, crossed: _Crossed) -> Bools:
    """Which of the tunnels ``rows`` (n,) have no room for their free height at the streets that they cross.

    Those below a street nearer to their mouth than a ramp is long, or over a tunnel but below the ground.
    """
    low = np.zeros(len(paths.free), np.bool_)
    if not rows.any():
        return low
    options, ground = crossed.options, _ground(net.xy, crossed.height)
    least, most = _height_limits(net, paths, rows=rows, crossed=crossed)
    ramp = ground + _cones(net, np.where(mouth, 0.0, -np.inf))
    for k in np.flatnonzero(rows).tolist():
        at = net.rows[k]
        highest = np.maximum(ramp[at], ground[at] - (paths.free[k] + options.roof + _COVER - _SPARE))
        low[k] = bool((most[at] < ramp[at]).any() or (least[at] > highest).any())
    return low


def _heights(net: _Net, paths: _Paths, *, ends: Bools, held: Bools, depth: Float, crossed: _Crossed) -> Float:
    """Heights (v,) of stations; ``ends`` (v,) lie on the ground, tunnels at least ``depth`` (v,) under it.

    held : (v,) stations of tunnels that are on the ground whatever they cross
    """
    if not len(net.xy):
        return np.empty(0)
    ground = _ground(net.xy, crossed.height)
    fixed = np.where(ends, ground, np.nan)
    on_road = _on_road_bridges(net, paths, graph=crossed.graph, osm=crossed.osm)
    fixed = np.where(np.isnan(on_road), fixed, on_road)
    z = _even(net, fixed, ground=ground)
    every = np.ones(len(net.rows), np.bool_)
    least, most = _height_limits(net, paths, rows=every, crossed=crossed)
    # Crossings take precedence over cover: below a path a tunnel may have less cover, but stays underground.
    under = np.where(np.isnan(depth), np.inf, ground - np.maximum(depth - _SPARE, 0.0))
    least = np.minimum(least, under)
    for sign, need in ((-1.0, ground - depth), (1.0, least), (-1.0, most)):
        bound = np.where(np.isnan(on_road) & ~np.isnan(need), sign * need, -np.inf)
        z = sign * np.maximum(sign * z, _cones(net, bound))
    steep = replace(net, slope=np.full(len(net.slope), _STEEPEST))
    z = np.maximum(z, _cones(steep, np.where(held, ground, -np.inf)))
    return np.where(np.isnan(on_road), z, on_road)


def _on_road_bridges(net: _Net, paths: _Paths, *, graph: RoadGraph, osm: OsmData) -> Float:
    """Height (v,) of the nearest road bridge or tunnel of the same layer or with a common node, else NaN."""
    z, nearest = np.full(len(net.xy), np.nan), np.full(len(net.xy), np.inf)
    edges = np.flatnonzero(graph.bridge | graph.tunnel)
    if not len(edges):
        return z
    tree = shapely.STRtree(edge_lines(graph)[edges])
    nodes = _nodes_of(osm, graph, edges=edges)
    for rows, below, layer in zip(net.rows, paths.tunnel.tolist(), paths.level.tolist(), strict=True):
        point, found = tree.query(shapely.points(net.xy[rows]), predicate="dwithin", distance=20.0)
        edge = edges[found]
        alike = graph.tunnel[edge] == below
        for e in np.unique(edge[alike]).tolist():
            at = rows[np.unique(point[alike & (edge == e)])]
            high, away, beside = nearest_on_line(graph.geometry[e], net.xy[at])
            near = np.isin(net.node[at], list(nodes[e]))
            if graph.layer[e] == layer:
                near |= beside & (away < graph.width[e] / 2 + _BESIDE)
            near &= away < nearest[at]
            z[at[near]], nearest[at[near]] = high[near], away[near]
    return z


def _nodes_of(osm: OsmData, graph: RoadGraph, *, edges: Ints) -> dict[int, set[int]]:
    """The map's nodes on the ways of some edges."""
    ways = {edge: graph.osm_id[edge].split(";") for edge in edges.tolist()}
    nodes: dict[str, set[int]] = {name: set() for names in ways.values() for name in names}
    for way in osm.ways:
        if way.osm_id in nodes:
            nodes[way.osm_id].update(way.nodes.tolist())
    return {edge: set().union(*(nodes[name] for name in names)) for edge, names in ways.items()}


def _even(net: _Net, fixed: Float, *, ground: Float) -> Float:
    """Heights (v,) interpolated along ways between fixed ones; the ground's where none is fixed."""
    from scipy.sparse import csr_array, diags_array  # noqa: PLC0415  (slow to import)
    from scipy.sparse.linalg import spsolve  # noqa: PLC0415

    count = len(fixed)
    stiff = 1.0 / net.metres
    row, column = np.concatenate([net.a, net.b]), np.concatenate([net.b, net.a])
    links = csr_array((np.tile(stiff, 2), (row, column)), shape=(count, count))
    held = np.where(np.isnan(fixed), 1e-6, 1e6)
    matrix = diags_array(np.asarray(links.sum(axis=1)).ravel() + held) - links
    z: Float = spsolve(matrix.tocsc(), held * np.where(np.isnan(fixed), ground, fixed))
    return z


def _height_limits(net: _Net, paths: _Paths, *, rows: Bools, crossed: _Crossed) -> tuple[Float, Float]:
    """Lower and upper bounds (v,) on the height of stations of paths ``rows`` (n,) at crossings, else NaN."""
    graph, options = crossed.graph, crossed.options
    obstacles = find_obstacles(crossed.osm, crossed.frame)
    roads = edge_lines(graph)
    rank = rank_ways(graph.layer, bridge=graph.bridge, tunnel=graph.tunnel)
    lines = np.concatenate([roads, obstacles.line])
    tree = shapely.STRtree(lines)
    least, most = np.full((2, len(net.xy)), np.nan)
    columns = (paths.tunnel, paths.level, paths.body, paths.free)
    for k in np.flatnonzero(rows).tolist():
        stations = net.rows[k]
        below, layer, thick, free = (column[k].item() for column in columns)
        way = shapely.LineString(net.xy[stations])
        own = int(rank_ways(layer, bridge=not below, tunnel=below))
        for other in tree.query(way, predicate="crosses").tolist():
            is_road = other < len(roads)
            over = own > rank[other] if is_road else not below
            for xy in shapely.get_coordinates(shapely.intersection(way, lines[other])):
                near = np.hypot(*(net.xy[stations] - xy).T)
                if is_road and own == rank[other]:
                    continue  # they meet
                at = stations[near < _STATION]
                on_road = nearest_on_line(graph.geometry[other], xy[None])[0] if is_road else None
                z = float((_ground(xy[None], crossed.height) if on_road is None else on_road)[0])
                if over and is_road:
                    need = z + options.headroom + thick + (options.roof if graph.tunnel[other] else 0.0)
                elif over:
                    need = z + float(obstacles.clear[other - len(roads)]) + thick
                else:
                    carried = options.deck if is_road and graph.bridge[other] else 2 * options.margin
                    need = z - free - carried - (options.roof if below else 0.0)
                if over:
                    least[at] = np.fmax(least[at], need)
                else:
                    most[at] = np.fmin(most[at], need)
    return least, most


def _cones(net: _Net, bound: Float) -> Float:
    """Maximum over all bounds (v,) of bound minus gradient times distance along ways; -inf without any."""
    from scipy.sparse import csr_array  # noqa: PLC0415  (slow to import)
    from scipy.sparse.csgraph import dijkstra  # noqa: PLC0415

    start = np.flatnonzero(np.isfinite(bound))
    if not len(start):
        return np.full(len(bound), -np.inf)
    count, top = len(bound), float(bound[start].max())
    row = np.concatenate([net.a, np.full(len(start), count)])
    column = np.concatenate([net.b, start])
    cost = np.concatenate([net.metres * net.slope, top - bound[start] + 1e-9])
    links = csr_array((cost, (row, column)), shape=(count + 1, count + 1))
    reach: Float = top - dijkstra(links, directed=False, indices=count)[:count]
    return reach

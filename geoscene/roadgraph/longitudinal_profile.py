"""Longitudinal profiles of roads: smooth on the ground, with the clearances of bridges and tunnels."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry import polylines
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.quadratic import Bounds, interior_point
from geoscene.roadgraph.stations import Stations, find_crossings, find_overlaps, place_stations
from geoscene.typing import Bools, Float, Height, Ints


@dataclass(frozen=True, slots=True)
class ProfileOptions:
    """Limits of profiles. Lengths in metres, gradients as a ratio.

    clearance : free height over a road below a bridge or in a tunnel (AASHTO: 4.3 to 4.9 and more)
    deck      : thickness of bridge decks
    cover     : thickness of the ground over a tunnel
    slope     : maximum gradient of ramps, bridges and tunnels (exceeded only where the ground is steeper)
    steepest  : maximum gradient of roads where the ground is steeper (Baldwin Street in Dunedin has 0.35)
    step      : maximum change of gradient from one station to the next, in addition to the ground's own
    smooth    : length over which the ground is smoothed
    spacing   : distance between stations
    edges     : take heights of the ground near both edges of carriageways, not in the middle, which may be
                a crown
    """

    clearance: float = 4.7
    deck: float = 0.8
    cover: float = 1.0
    slope: float = 0.08
    steepest: float = 0.35
    step: float = 0.02
    smooth: float = 12.0
    spacing: float = 10.0
    edges: bool = False


@dataclass(frozen=True, slots=True)
class Obstacles:
    """Lines on the ground that bridges cross: railway tracks and waterways.

    line  : (k,) shapely LineString, scene metres
    clear : (k,) float64 metres of free height that they require
    """

    line: NDArray[np.object_]
    clear: Float


# Weights of the least-squares terms, per metre of road. The ground holds a ramp more firmly with the distance
# from its bridge or tunnel, and other roads so that they do not give way; violated bounds cost more.
_FIXED, _FIRM, _RAMP, _LOOSE = 1e4, 100.0, 1.0, 1e-6
_RAMP_REACH = 150.0
# Over more than this length (metres) a bridge or tunnel behaves as a taut string rather than as a beam.
_TAUT = 30.0
_AROUND = 400.0
"""Metres along roads from what does not lie still, within which heights are solved for at first."""
_STILL, _MOVED = 1e-9, 1e-4
"""What counts as lying still, in the units of cost and bounds, and as having moved, metres."""
_HARD, _STEADY, _HARDEST = 1e8, 4e9, 1e9
"""Of slopes; of changes of slope, of stations at full spacing; of heights, which come first where a
short ramp cannot serve all."""
_STEEPEST, _HELD = 1e12, 1e10
"""Of the steepest gradient; of roads beyond ramps: where a ramp is too short, it is steep, and where it
cannot be steeper, the clearance is less, but these do not move."""
_GIVE, _CUT = 0.1, 40.0
"""Metres that roads beyond ramps may be off the ground, and more for each unit of its slope: on hillsides
they are cut and filled, and elevation models are less exact."""
_WITHIN = 1.0
"""Metres inside the edges of a carriageway at which its height is looked up: a raster's cells blur kerbs."""
_CLOSE = 1.0
"""Metres: stations nearer to each other count as so far apart."""
_BESIDE, _CROSSFALL = 1e6, 0.01
"""Of carriageways that overlap side by side, below slopes; the slope across them where they are one."""
_PORTAL, _WISHED = 15.0, 1e3
"""Metres from a tunnel's mouth within which it should be covered; what that counts, well below the others."""


def profile(
    graph: RoadGraph,
    ground: Height,
    *,
    obstacles: Obstacles | None = None,
    options: ProfileOptions | None = None,
) -> RoadGraph:
    """The graph with heights (and vertices at most ``spacing`` apart where heights vary).

    Constrained least squares over all stations at once. Minimised: the squared distance from the ground, plus
    the squared curvature in height times ``smooth`` to the fourth; bridges and tunnels have the second term
    only, so they continue their ramps. Bounds: a road is above one that it crosses by clearance and deck,
    if one of them is a bridge or a tunnel, and else, without a common node, as high;
    bridges and tunnels that overlap a road beside them have its height or that distance over or under it;
    a bridge is above obstacles and the ground; a tunnel is under the ground, deeper with the distance from
    its mouth, and if gradients allow entirely so after 15 m; gradients; changes of gradient; near bridges and
    tunnels roads beyond their ramps have the height of the ground. Bounds that contradict each other (a ramp
    too short for its gradient) are relaxed: first those between carriageways side by side, then gradients up
    to ``steepest``, then clearances. Solved by an interior-point method.

    ground    : height of the terrain, which roads follow where no bound prevents it
    obstacles : railway tracks and waterways that bridges cross
    """
    options = options or ProfileOptions()
    if not len(graph):
        return graph
    stations = place_stations(graph, spacing=options.spacing)
    if options.edges:
        terrain = _near_edges(graph, stations, ground=ground)
    else:
        terrain = np.asarray(ground(stations.xy[:, 0], stations.xy[:, 1]), float)
    ramp = _along_ramps(graph, stations)
    bounds = _bounds(
        graph, stations, terrain=terrain, ground=ground, obstacles=obstacles, ramp=ramp, options=options
    )
    weight = _weights(graph, stations, ramp=ramp)
    z = _solve(graph, stations, terrain=terrain, bounds=bounds, weight=weight, options=options)
    return _with_heights(graph, stations, z=z)


def take_heights(graph: RoadGraph, whole: RoadGraph, *, options: ProfileOptions | None = None) -> RoadGraph:
    """A graph with the heights that `profile` gave to one of these and more ways."""
    options = options or ProfileOptions()
    stations = place_stations(graph, spacing=options.spacing)
    of_way: dict[str, list[int]] = defaultdict(list)
    for edge in np.flatnonzero(whole.once).tolist():
        for name in whole.osm_id[edge].split(";"):
            of_way[name].append(edge)
    lines = np.fromiter(map(shapely.linestrings, whole.geometry), object, count=len(whole))
    z = np.zeros(len(stations.xy))
    begin = np.flatnonzero(np.diff(stations.edge, prepend=-1))
    for start, stop in zip(begin.tolist(), [*begin[1:].tolist(), len(stations.edge)], strict=True):
        names = graph.osm_id[stations.edge[start]].split(";")
        some = lines[sorted({edge for name in names for edge in of_way[name]})]
        points = shapely.points(stations.place[start:stop])
        nearest = some[np.argmin(shapely.distance(points[:, None], some), axis=1)]
        on_line = shapely.line_interpolate_point(nearest, shapely.line_locate_point(nearest, points))
        z[stations.row[start:stop]] = shapely.get_z(on_line)
    return _with_heights(graph, stations, z=z)


def _near_edges(graph: RoadGraph, stations: Stations, *, ground: Height) -> Float:
    """Height of the ground (v,): the mean of places `_WITHIN` metres inside both edges of carriageways."""
    a, b, _, edge = stations.segments
    x, y = polylines.unit(stations.xy[b] - stations.xy[a]).T
    aside = np.maximum(graph.width[edge] / 2 - _WITHIN, 0.0)[:, None] * np.column_stack([-y, x])
    total, count = np.zeros((2, len(stations.xy)))
    for end in (a, b):
        for side in (-aside, aside):
            place = stations.xy[end] + side
            np.add.at(total, end, np.asarray(ground(place[:, 0], place[:, 1]), float))
            np.add.at(count, end, 1.0)
    return total / count


def _structures(graph: RoadGraph, stations: Stations) -> tuple[Bools, Bools]:
    """Whether segments (s,) are of bridges or tunnels, and whether stations (v,) are on these."""
    a, b, _, edge = stations.segments
    structure = graph.bridge[edge] | graph.tunnel[edge]
    on = np.zeros(len(stations.xy), np.bool_)
    on[a[structure]] = on[b[structure]] = True
    return structure, on


def _along_ramps(graph: RoadGraph, stations: Stations) -> Float:
    """Metres (v,) of stations on ramps from their bridge or tunnel, `_RAMP_REACH` at all others.

    A ramp is a road on the ground from the end of a bridge or a tunnel to its first junction of roads on
    the ground.
    """
    a, b, metres, _ = stations.segments
    structure, ends = _structures(graph, stations)
    count = len(ends)
    arms = np.bincount(np.concatenate([a[~structure], b[~structure]]), minlength=count)
    junction = arms > np.where(ends, 1, 2)
    part = ~structure & ~junction[a] & ~junction[b]
    return _distance(count, (a[part], b[part], metres[part]), start=ends & ~junction, limit=_RAMP_REACH)


def _near_structures(graph: RoadGraph, stations: Stations) -> Bools:
    """Whether stations (v,) are within `_RAMP_REACH` of a bridge or a tunnel along roads on the ground."""
    a, b, metres, _ = stations.segments
    structure, ends = _structures(graph, stations)
    links = a[~structure], b[~structure], metres[~structure]
    near: Bools = _distance(len(ends), links, start=ends, limit=_RAMP_REACH) < _RAMP_REACH
    return near


def _steepness(stations: Stations, *, terrain: Float) -> Float:
    """Greatest slope of the ground along roads at each station (v,)."""
    a, b, metres, _ = stations.segments
    slope = np.abs(terrain[b] - terrain[a]) / np.maximum(metres, _CLOSE)
    found = np.zeros(len(terrain))
    for end in (a, b):
        np.maximum.at(found, end, slope)
    return found


def _weights(graph: RoadGraph, stations: Stations, *, ramp: Float) -> Float:
    """Weight of the distance from the ground at each station: per metre, times the station's length."""
    a, b, metres, edge = stations.segments
    structure = graph.bridge[edge] | graph.tunnel[edge]
    count = len(stations.xy)
    per_metre = _RAMP + (_FIRM - _RAMP) * (ramp / _RAMP_REACH) ** 2
    per_metre[ramp >= _RAMP_REACH] = _FIXED
    share = np.where(structure, 0.0, metres / 2)
    held = np.bincount(a, share, count) + np.bincount(b, share, count)
    return np.maximum(held * per_metre, _LOOSE)


def _distance(count: int, links: tuple[Ints, Ints, Float], *, start: Bools, limit: float) -> Float:
    """Metres along links from the nearest start, at most ``limit``."""
    from scipy.sparse import csr_array  # noqa: PLC0415  (slow to import)
    from scipy.sparse.csgraph import dijkstra  # noqa: PLC0415

    if not start.any():
        return np.full(count, limit)
    a, b, metres = links
    # One more station, linked to all starts, is their common source.
    source = np.flatnonzero(start)
    rows = np.concatenate([a, np.full(len(source), count)])
    columns = np.concatenate([b, source])
    values = np.concatenate([metres, np.full(len(source), 1e-6)])
    least = np.lexsort([values, columns, rows])
    first = np.unique(np.stack([rows[least], columns[least]]), axis=1, return_index=True)[1]
    keep = least[first]
    net = csr_array((values[keep], (rows[keep], columns[keep])), shape=(count + 1, count + 1))
    reach = dijkstra(net, directed=False, indices=count, limit=limit)[:count]
    near: Float = np.minimum(reach, limit)
    return near


def _bounds(
    graph: RoadGraph,
    stations: Stations,
    *,
    terrain: Float,
    ground: Height,
    obstacles: Obstacles | None,
    ramp: Float,
    options: ProfileOptions,
) -> Bounds:
    """All bounds on heights."""
    rows = _Rows(len(stations.xy))
    a, b, metres, edge = stations.segments
    structure = graph.bridge[edge] | graph.tunnel[edge]

    own = np.minimum(np.abs(terrain[b] - terrain[a]), options.steepest * metres)
    most = np.where(structure, options.slope * metres, np.maximum(options.slope * metres, own))
    rows.add([(b, 1.0), (a, -1.0)], -most, weight=_HARD)
    rows.add([(a, 1.0), (b, -1.0)], -most, weight=_HARD)
    around = _near_structures(graph, stations)
    part = structure | around[a] | around[b]
    for begin, end in ((a[part], b[part]), (b[part], a[part])):
        rows.add([(end, 1.0), (begin, -1.0)], -options.steepest * metres[part], weight=_STEEPEST)
    held = np.flatnonzero(around & (ramp >= _RAMP_REACH))
    give = (_GIVE + _CUT * _steepness(stations, terrain=terrain))[held]
    for sign in (1.0, -1.0):
        rows.add([(held, sign)], sign * terrain[held] - give, weight=_HELD)

    p, q, r, before, after = stations.triples
    near = np.minimum(before, after)
    bend = (terrain[r] - terrain[q]) / after - (terrain[q] - terrain[p]) / before
    on_ground = np.ones(len(terrain), np.bool_)
    on_ground[a[structure]] = on_ground[b[structure]] = False
    allowed = (options.step + np.where(on_ground[p] & on_ground[q] & on_ground[r], np.abs(bend), 0.0)) * near
    turn = [(p, near / before), (q, -near / before - near / after), (r, near / after)]
    # Bounds on the change of gradient: between close stations a few centimetres exceed them.
    firm = _STEADY * (options.spacing / np.clip(near, _CLOSE, options.spacing)) ** 2
    rows.add(turn, -allowed, weight=firm)
    rows.add([(station, -factor) for station, factor in turn], -allowed, weight=firm)

    high = options.clearance + options.deck
    upper, on_upper, lower, on_lower, margin = find_crossings(graph, stations)
    length = stations.along[np.searchsorted(stations.edge, upper, side="right") - 1]
    for shift in (-margin, 0.0 * margin, margin):
        k, m, s = stations.at(upper, np.clip(on_upper + shift, 0.0, length))
        place = stations.xy[k] * (1 - s)[:, None] + stations.xy[m] * s[:, None]
        i, j, t = stations.at(lower, _nearest(graph, lower, xy=place, along=on_lower))
        rows.add([(k, 1 - s), (m, s), (i, t - 1), (j, -t)], np.full(len(upper), high), weight=_HARDEST)

    one, on_one, two, on_two, _ = find_crossings(graph, stations, level=True)
    k, m, s = stations.at(one, on_one)
    i, j, t = stations.at(two, on_two)
    for sign in (1.0, -1.0):
        equal = [(k, sign * (1 - s)), (m, sign * s), (i, sign * (t - 1)), (j, -sign * t)]
        rows.add(equal, np.zeros(len(one)), weight=_HARDEST)

    room, parting = _parting(high, options)
    beside = find_overlaps(graph, stations, crossing=(upper, lower), room=room)
    terms: list[tuple[Ints, Float]] = [
        (beside.station, np.ones(len(beside.station))),
        (beside.before, beside.share - 1),
        (beside.after, -beside.share),
    ]
    above = np.where(beside.side > 0, parting(beside.fork), -_CROSSFALL * beside.away)
    below = np.where(beside.side < 0, parting(beside.fork), -_CROSSFALL * beside.away)
    for sign, least, chosen in ((1.0, above, beside.side >= 0), (-1.0, below, beside.side <= 0)):
        factors = [(station[chosen], sign * share[chosen]) for station, share in terms]
        rows.add(factors, least[chosen], weight=_BESIDE)

    bridge, tunnel = (
        _mouth_distance(graph, stations, kind=kind, options=options) for kind in ("bridge", "tunnel")
    )
    deck = np.flatnonzero(np.isfinite(bridge))
    rows.add(
        [(deck, 1.0)],
        terrain[deck] + np.minimum(options.deck, options.slope / 2 * bridge[deck]),
        weight=_HARDEST,
    )
    bore = np.flatnonzero(np.isfinite(tunnel))
    deep = np.minimum(options.clearance + options.cover, options.slope / 2 * tunnel[bore])
    rows.add([(bore, -1.0)], deep - terrain[bore], weight=_HARDEST)
    # Where the ground does not rise over it, the road descends into a cutting before its tunnel.
    bore = bore[tunnel[bore] >= _PORTAL]
    whole = np.full(len(bore), options.clearance + options.cover)
    rows.add([(bore, -1.0)], whole - terrain[bore], weight=_WISHED)

    if obstacles is not None and len(obstacles.line):
        over, along, x, y, clear = _over_obstacles(graph, stations, obstacles=obstacles)
        i, j, t = stations.at(over, along)
        rows.add(
            [(i, 1 - t), (j, t)], np.asarray(ground(x, y), float) + clear + options.deck, weight=_HARDEST
        )
    return rows.bounds()


def _parting(high: float, options: ProfileOptions) -> tuple[float, Callable[[Float], Float]]:
    """Roads that part at a fork: metres until they are ``high`` apart, and their height difference before.

    One rises and one falls, each with the maximum change of gradient up to the maximum gradient.
    """
    bend = 0.5 * options.step / options.spacing
    bent = options.slope / bend
    steep = max(high - bend / 2 * bent**2, 0.0) / options.slope

    def apart(metres: Float) -> Float:
        near = np.minimum(metres, bent)
        return np.minimum(bend / 2 * near**2 + options.slope * (np.minimum(metres, 1e6) - near), high)

    return bent + steep, apart


def _nearest(graph: RoadGraph, edge: Ints, *, xy: Float, along: Float) -> Float:
    """Metres along edges (k,) of the places nearest to points (k, 2), not far from ``along``."""
    lines = np.array([shapely.linestrings(graph.geometry[e][:, :2]) for e in edge.tolist()], object)
    found = shapely.line_locate_point(lines, shapely.points(xy)) if len(edge) else along
    # A loop can come near a second time: only places near the crossing count.
    far = np.hypot(*(xy - shapely.get_coordinates(shapely.line_interpolate_point(lines, along))).T)
    return np.clip(found, along - far, along + far)


class _Rows:
    """Collects rows ``a z >= b``."""

    def __init__(self, stations: int) -> None:
        self._stations = stations
        self._count = 0
        self._entries: list[tuple[Ints, Ints, Float]] = []
        self._right: list[Float] = []
        self._weight: list[Float] = []

    def add(
        self, terms: Sequence[tuple[Ints, Float | float]], right: Float, *, weight: float | Float
    ) -> None:
        """Add rows: the sum of factor times height over the terms is at least ``right``."""
        number = self._count + np.arange(len(right))
        for station, factor in terms:
            self._entries.append((number, station, np.broadcast_to(factor, len(right)).astype(float)))
        self._right.append(right)
        self._weight.append(np.broadcast_to(weight, len(right)).astype(float))
        self._count += len(right)

    def bounds(self) -> Bounds:
        """All rows as a sparse matrix with its right side and weights."""
        from scipy.sparse import csr_array  # noqa: PLC0415  (slow to import)

        row, column, value = (np.concatenate([entry[k] for entry in self._entries]) for k in range(3))
        matrix = csr_array((value, (row, column)), shape=(self._count, self._stations))
        return Bounds(matrix, np.concatenate(self._right), np.concatenate(self._weight))


def _mouth_distance(graph: RoadGraph, stations: Stations, *, kind: str, options: ProfileOptions) -> Float:
    """Metres from each station of a bridge or a tunnel to its nearest end, NaN elsewhere."""
    flag = getattr(graph, kind)
    a, b, metres, edge = stations.segments
    of_kind = flag[edge]
    inside, outside = np.zeros((2, len(stations.xy)), np.bool_)
    inside[a[of_kind]] = inside[b[of_kind]] = True
    outside[a[~of_kind]] = outside[b[~of_kind]] = True
    limit = 4 * (options.clearance + options.deck + options.cover) / options.slope
    links = a[of_kind], b[of_kind], metres[of_kind]
    far = _distance(len(stations.xy), links, start=inside & outside, limit=limit)
    return np.where(inside, far, np.nan)


def _over_obstacles(
    graph: RoadGraph, stations: Stations, *, obstacles: Obstacles
) -> tuple[Ints, Float, Float, Float, Float]:
    """Crossings of bridges over obstacles: (edge, metres along it, x, y, clearance needed)."""
    once = np.unique(stations.edge)
    once = once[graph.bridge[once]]
    lines = np.array([shapely.linestrings(graph.geometry[e][:, :2]) for e in once.tolist()], object)
    one, two = shapely.STRtree(obstacles.line).query(lines, predicate="intersects")
    points, pair = shapely.get_parts(shapely.intersection(lines[one], obstacles.line[two]), return_index=True)
    kept = shapely.get_type_id(points) == shapely.GeometryType.POINT
    points, one, two = points[kept], one[pair[kept]], two[pair[kept]]
    x, y = shapely.get_coordinates(points).T
    return once[one], shapely.line_locate_point(lines[one], points), x, y, obstacles.clear[two]


def _solve(
    graph: RoadGraph,
    stations: Stations,
    *,
    terrain: Float,
    bounds: Bounds,
    weight: Float,
    options: ProfileOptions,
) -> Float:
    """Heights (v,) of minimum cost within the bounds."""
    from scipy.sparse import csr_array, diags_array  # noqa: PLC0415  (slow to import)

    p, q, r, before, after = stations.triples
    before, after = np.maximum(before, 0.5), np.maximum(after, 0.5)
    reach = (before + after) / 2
    row = np.arange(len(p))
    bend = csr_array(
        (
            np.concatenate([1 / before, -1 / before - 1 / after, 1 / after]),
            (np.tile(row, 3), np.concatenate([p, q, r])),
        ),
        shape=(len(p), len(terrain)),
    )
    stiff = bend.T @ diags_array(options.smooth**4 / reach) @ bend
    a, b, metres, edge = stations.segments
    taut = np.where((graph.bridge | graph.tunnel)[edge], options.smooth**4 / _TAUT**2, 0.0)
    row = np.arange(len(a))
    rise = csr_array(
        (np.repeat([-1.0, 1.0], len(a)), (np.tile(row, 2), np.concatenate([a, b]))),
        shape=(len(a), len(terrain)),
    )
    cost = (stiff + rise.T @ diags_array(taut / metres) @ rise + diags_array(weight)).tocsr()
    linear = weight * terrain
    # Stations at which the terrain already satisfies all bounds need no solution.
    restless = np.abs(cost @ terrain - linear) > _STILL
    short = np.flatnonzero(bounds.a @ terrain < bounds.b - _STILL)
    restless[bounds.a[short].indices] = True
    z, radius = terrain, _AROUND
    while restless.any():
        far = _distance(len(terrain), (a, b, metres), start=restless, limit=radius)
        free = far < radius
        z = _solve_some(cost, linear, bounds=bounds, terrain=terrain, free=free)
        rim = free & (far > radius / 2)
        if free.all() or np.abs(z - terrain)[rim].max(initial=0.0) < _MOVED:
            break
        radius *= 2
    return z


def _solve_some(cost: Any, linear: Float, *, bounds: Bounds, terrain: Float, free: Bools) -> Float:
    """Heights (v,) of minimum cost within the bounds; stations that are not free lie on the terrain."""
    held = np.where(free, 0.0, terrain)
    columns = np.flatnonzero(free)
    a = bounds.a[:, columns]
    rows = np.flatnonzero(np.diff(a.indptr))
    some = Bounds(a[rows], (bounds.b - bounds.a @ held)[rows], bounds.weight[rows])
    z = held
    z[columns] = interior_point(
        cost[columns][:, columns].tocsc(),
        (linear - cost @ held)[columns],
        bounds=some,
        start=terrain[columns],
    )
    return z


def _with_heights(graph: RoadGraph, stations: Stations, *, z: Float) -> RoadGraph:
    """The graph with the stations' heights; a level line keeps its original vertices."""
    geometry = np.empty(len(graph), object)
    begin = np.flatnonzero(np.diff(stations.edge, prepend=-1))
    for start, stop in zip(begin.tolist(), [*begin[1:].tolist(), len(stations.edge)], strict=True):
        edge, row = int(stations.edge[start]), stations.row[start:stop]
        place = stations.place[start:stop]
        if np.ptp(z[row]) < 1e-3:
            drawn = stations.drawn[start:stop]
            row, place = row[drawn], place[drawn]
        line = np.column_stack([place, z[row]])
        geometry[edge] = line
        if graph.twin[edge] >= 0:
            geometry[graph.twin[edge]] = line[::-1].copy()
    node_xyz = graph.node_xyz.copy()
    node_xyz[:, 2] = z[: len(node_xyz)]
    return replace(graph, geometry=geometry, node_xyz=node_xyz)

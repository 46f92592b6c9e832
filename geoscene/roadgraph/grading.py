"""Grading: terrain filled up to ramps, cut down to underpasses and levelled across carriageways."""

from __future__ import annotations

from functools import partial

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.frames import Frame
from geoscene.roadgraph.carriageways import place_of
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.longitudinal_profile import Obstacles
from geoscene.roadgraph.paths import way_lines
from geoscene.roadgraph.tags import is_bridge, is_tunnel, read_layer
from geoscene.sources.data import OsmData, Tags
from geoscene.typing import Bools, Float, Height, Ints

_SHARP = 0.05
"""Where carriageways overlap, a road counts for most near its middle: the less this is, the more so."""

_CUT = 0.5
"""Rise over run of the slopes of cuts and fills in surveyed ground: 1 to 2, usual in soil."""

_LEVEL = 1e-6
"""Metres: lower roads on level ground count as level."""

# Metres of clearance below bridges (railways: EN 15273 with overhead line; small waterways: a rowing boat).
_CLEAR = {
    "railway": {"rail": 5.7, "light_rail": 5.0, "tram": 4.7, "subway": 4.5, "narrow_gauge": 4.5},
    "waterway": {"river": 3.0, "canal": 3.0, "stream": 1.0, "ditch": 0.5, "drain": 0.5},
}


def find_obstacles(osm: OsmData, frame: Frame) -> Obstacles:
    """Railways and waterways on the ground that bridges must clear."""
    ways, lines = way_lines([way for way in osm.ways if _required_clearance(way.tags) is not None], frame)
    return Obstacles(lines, np.array([_required_clearance(way.tags) for way in ways], float))


def _required_clearance(tags: Tags) -> float | None:
    layer, source = read_layer(tags, [])
    if place_of(layer, source, bridge=is_bridge(tags), tunnel=is_tunnel(tags)) != 0:
        return None
    for key, heights in _CLEAR.items():
        if tags.get(key) in heights:
            return heights[tags[key]]
    return None


def graded_ground(
    graph: RoadGraph,
    ground: Height,
    *,
    level: bool = False,
    surveyed: bool = False,
    shoulder: float = 2.5,
    batter: float = 8.0,
) -> Height:
    """The terrain with roads graded into it: a function of x, y (n,) that returns z (n,).

    Within a carriageway and its shoulder the ground is level across, at the road's profile; over the next
    ``batter`` metres it blends into the terrain. Where roads meet, the nearer one has the greater weight.
    Bridges and tunnels do not change the terrain; the grading ends square where they begin.

    graph    : with heights, from `profile`
    ground   : height of the terrain
    level    : the terrain is 0 everywhere, so that only roads near ramps count
    surveyed : the terrain shows the roads as they were built: it is kept beyond the shoulder, but where it is
               over a cut or under a fill with slopes of 1 to 2. Graded again, such ground stays as it is
    """
    once = np.flatnonzero(
        ((graph.twin < 0) | (graph.twin > np.arange(len(graph)))) & ~graph.bridge & ~graph.tunnel
    )
    if not len(once):
        return ground
    lines = [graph.geometry[e] for e in once.tolist()]
    start = np.concatenate([line[:-1] for line in lines])
    end = np.concatenate([line[1:] for line in lines])
    half = np.repeat(graph.width[once] / 2 + shoulder, [len(line) - 1 for line in lines])
    structure = graph.bridge | graph.tunnel
    mouth = np.zeros(len(graph.node_id), np.bool_)
    mouth[graph.tail[structure]] = mouth[graph.head[structure]] = True
    sizes = np.array([len(line) - 1 for line in lines])
    last = np.cumsum(sizes) - 1
    square_ends = np.zeros((len(start), 2), np.bool_)
    square_ends[last - sizes + 1, 0] = mouth[graph.tail[once]]
    square_ends[last, 1] = mouth[graph.head[once]]
    pieces = shapely.linestrings(np.stack([start[:, :2], end[:, :2]], axis=1))
    reach = float(half.max()) + batter
    rows = _beside_ramps(pieces, start, end=end, reach=2 * reach) if level else np.arange(len(pieces))
    return partial(
        _graded_height,
        ground=ground,
        tree=shapely.STRtree(pieces[rows]),
        start=start[rows],
        end=end[rows],
        half=half[rows],
        square_ends=square_ends[rows],
        batter=batter,
        surveyed=surveyed,
    )


def _beside_ramps(pieces: NDArray[np.object_], start: Float, *, end: Float, reach: float) -> Ints:
    """Rows of the pieces of road that are not at height 0, and of those within ``reach`` metres of them."""
    ramps = pieces[np.maximum(np.abs(start[:, 2]), np.abs(end[:, 2])) > _LEVEL]
    return np.unique(shapely.STRtree(pieces).query(ramps, predicate="dwithin", distance=reach)[1])


def _graded_height(
    x: Float,
    y: Float,
    *,
    ground: Height,
    tree: shapely.STRtree,
    start: Float,
    end: Float,
    half: Float,
    square_ends: Bools,
    batter: float,
    surveyed: bool,
) -> Float:
    """The height of `graded_ground`; a function of a module, so that worker processes can take it."""
    z = np.asarray(ground(x, y), float).copy()
    xy = np.stack([x, y], axis=1)
    reach = float(half.max(initial=0.0)) + batter
    point, road = tree.query(shapely.points(xy), predicate="dwithin", distance=reach)
    along = end[road, :2] - start[road, :2]
    square = np.maximum((along**2).sum(axis=1), 1e-12)
    free = ((xy[point] - start[road, :2]) * along).sum(axis=1) / square
    t = np.clip(free, 0.0, 1.0)
    foot = start[road] + t[:, None] * (end[road] - start[road])
    away = np.hypot(*(xy[point] - foot[:, :2]).T)
    beyond = np.maximum(away - half[road], 0.0)
    ahead = np.abs(free - t) * np.sqrt(square)
    cut = np.where(free < t, *square_ends[road].T) & (ahead > 0)
    aside = np.sqrt(np.maximum(away**2 - ahead**2, 0.0)) - half[road]
    beyond[cut] = np.hypot(np.maximum(aside, 0.0), ahead)[cut]
    share = np.clip(1.0 - beyond / batter, 0.0, 1.0)
    weight = share**2 / (_SHARP + (away / half[road]) ** 2) ** 2
    total = np.bincount(point, weight, len(z))
    near = total > 0
    road_z = np.divide(np.bincount(point, weight * foot[:, 2], len(z)), total, out=z.copy(), where=near)
    most = np.zeros(len(z))
    np.maximum.at(most, point, share)
    if surveyed:
        # steeper towards the end of the reach, so that high fills and deep cuts end there without a step
        with np.errstate(divide="ignore"):
            free_of = _CUT * batter * (1.0 - most) / most
        return np.where(near, np.clip(z, road_z - free_of, road_z + free_of), z)
    blend = most * most * (3.0 - 2.0 * most)
    graded: Float = z + blend * (road_z - z)
    return graded

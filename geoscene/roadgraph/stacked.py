"""Tunnels of garages and drives that the map draws over one another with no room between them."""

from __future__ import annotations

import numpy as np
import shapely

from geoscene.geometry import polylines
from geoscene.roadgraph.clipping import Stretches
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.routing import edge_lines
from geoscene.support.problems import Problem
from geoscene.typing import Bools, Float

STACKED = "tunnel-in-tunnel"
"""Reason of a problem: a street and another one are at one place, and neither passes over the other."""

_STEP = 0.5
"""Metres between places along tunnels."""

_ABREAST = 1.0
"""Metres between centre lines from which on tunnels lie side by side, with a wall between them."""

_PARTED, _LEVEL = 1.0, 0.05
"""Metres of difference in height from which on tunnels are no fork, and up to which they are one surface."""

_PASSING = 5.4
"""Metres of difference in height from which on one tunnel passes over another (free height, roof, floor)."""

_WALL = 1.0
"""Metres beside a tunnel's carriageway, and beyond its stretches, that walls and their ends take up."""


def find_stacked(graph: RoadGraph) -> tuple[Stretches, list[Problem]]:
    """Stretches of service roads in tunnels that are within another tunnel, and a row for each pair of ways.

    Storeys of garages and ramps between them are mapped as lines upon one another. Where the map gives them
    no room, no height is right.
    """
    tunnels = np.flatnonzero(graph.tunnel & graph.once)
    lines = edge_lines(graph)[tunnels]
    one, two = shapely.STRtree(lines).query(lines, predicate="dwithin", distance=_ABREAST)
    stretches: Stretches = {}
    problems: dict[tuple[str, str], float] = {}
    for row, other in zip(one.tolist(), two.tolist(), strict=True):
        edge, upon = int(tunnels[row]), int(tunnels[other])
        if row == other or graph.highway[edge] != "service":
            continue
        at, within = _within(graph.geometry[edge], graph.geometry[upon], half=float(graph.width[upon]) / 2)
        for run in np.split(np.flatnonzero(within), np.flatnonzero(np.diff(np.flatnonzero(within)) > 1) + 1):
            if len(run):
                start, end = max(at[run[0]] - _WALL, 0.0), min(at[run[-1]] + _WALL, at[-1])
                stretches.setdefault(edge, []).append((float(start), float(end)))
                names = str(graph.osm_id[edge]), str(graph.osm_id[upon])
                problems[names] = problems.get(names, 0.0) + float(end - start)
    return stretches, [
        Problem(
            name, "road", "dropped", STACKED, f"{metres:.1f} m in {other}, not far enough above or below it"
        )
        for (name, other), metres in sorted(problems.items())
    ]


def _within(line: Float, other: Float, *, half: float) -> tuple[Float, Bools]:
    """Metres along a line (k, 3), and whether it is within another tunnel there.

    half : metres of half the width of the other
    """
    along = polylines.stations(line)
    at = np.linspace(0.0, along[-1], max(int(along[-1] / _STEP), 1) + 1)
    places = polylines.points_at(line, at, along=along)
    flat, stations = polylines.flat(other), polylines.stations(other)
    points = shapely.points(places[:, :2])
    away = shapely.distance(flat, points)
    z = np.interp(shapely.line_locate_point(flat, points), stations, other[:, 2])
    apart = np.abs(places[:, 2] - z)
    near = (away < half + _WALL) & (apart > _LEVEL) & (apart < _PASSING)
    seed = near & (away < _ABREAST) & (apart > _PARTED)
    run = np.cumsum(np.diff(near, prepend=False))
    return at, near & np.isin(run, run[seed])

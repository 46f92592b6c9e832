"""Carriageways with a camber, and the stretches over which it fades out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.geometry import polylines
from geoscene.ground.camber import CAMBER, Camber
from geoscene.ground.layers import Layers
from geoscene.roadgraph.carriageways import PAVED, Carriageways
from geoscene.roadgraph.junctions import carriageway, junction_reach
from geoscene.typing import Bools, Float, Ints

_NARROW = 3.5
"""Metres: carriageways narrower than a lane, such as alleys, are level across. Assumed."""

_FADE = 10.0
"""Metres over which a camber begins. Assumed: its edge then falls by 0.9 % on a road 7 m wide."""

_SHORT = 2.0
"""Metres of camber at least."""

_ABOVE = 0.75
"""Priority of a half with camber above its carriageway: over joints (0.5), below the next class of road."""


@dataclass(frozen=True, slots=True)
class Crowns:
    """Stretches of centre lines over which a crown rises, stays or falls.

    line : (n,) shapely LineString, scene metres, in the direction of the carriageway
    road : (n,) int64 row of the carriageways
    crown : (n, 2) float64 metres by which the middle stands above the edges at the start and the end
    """

    line: NDArray[np.object_]
    road: Ints
    crown: Float


def find_crowns(roads: Carriageways) -> Crowns:
    """The crowns of carriageways on the ground that are paved and `_NARROW` metres wide or wider.

    A crown goes on over a node where two carriageways with crowns meet, or where two with crowns meet lesser
    ones. Everywhere else it fades out over `_FADE` metres before the junction's joint, the bridge, the
    tunnel or the dead end.
    """
    length = shapely.length(roads.line)
    cambered = (roads.place == 0) & (roads.width >= _NARROW) & np.isin(roads.material, list(PAVED))
    through = _goes_on(roads, cambered)
    first = np.where(through, 0.0, junction_reach(roads)[0])
    fade = np.where(through, 0.0, _FADE)
    usable = length - first.sum(axis=1)
    share = np.minimum(1.0, np.maximum(usable, 0.0) / np.maximum(fade.sum(axis=1), 1e-9))
    lines, road, crowns = [], [], []
    for k in np.flatnonzero(cambered & (usable > _SHORT)).tolist():
        top = CAMBER * roads.width[k] / 2 * share[k]
        near, far = first[k, 0], length[k] - first[k, 1]
        rise, fall = near + fade[k, 0] * share[k], far - fade[k, 1] * share[k]
        xy = shapely.get_coordinates(roads.line[k])
        along = polylines.stations(xy)
        for start, end, low, high in ((near, rise, 0.0, top), (rise, fall, top, top), (fall, far, top, 0.0)):
            if end - start > 1e-3:
                inside = (along > start) & (along < end)
                stations = np.concatenate([[start], along[inside], [end]])
                lines.append(polylines.points_at(xy, stations, along=along))
                road.append(k)
                crowns.append((low, high))
    return Crowns(
        np.array([shapely.LineString(line) for line in lines], object),
        np.array(road, np.int64),
        np.array(crowns, float).reshape(-1, 2),
    )


def _goes_on(roads: Carriageways, cambered: Bools) -> Bools:
    """Whether the crown of each carriageway continues beyond its start and end (k, 2)."""
    k = len(roads)
    node, road = roads.ends.T.ravel(), np.tile(np.arange(k), 2)
    rank = np.where(roads.place == 0, roads.importance, len(roads.node_xy) + 1)[road]
    order = np.lexsort([-rank, node])
    begin = np.flatnonzero(np.diff(node[order], prepend=-1))
    size = np.diff(begin, append=2 * k)
    through = np.zeros(2 * k, np.bool_)
    begin, size = begin[size > 1], size[size > 1]
    one, two = order[begin], order[begin + 1]
    lesser = (size == 2) | (rank[order[np.minimum(begin + 2, 2 * k - 1)]] < rank[two])
    pair = lesser & cambered[road[one]] & cambered[road[two]]
    through[one[pair]] = through[two[pair]] = True
    return through.reshape(2, k).T


def camber_of(roads: Carriageways, crowns: Crowns) -> Camber:
    """Heights of the ground above the edges of carriageways with crowns."""
    xy, of = shapely.get_coordinates(crowns.line, return_index=True)
    length, on = shapely.length(crowns.line), np.flatnonzero(of[1:] == of[:-1])
    first = np.flatnonzero(np.diff(of, prepend=-1))
    step = np.hypot(*np.diff(xy, axis=0, prepend=xy[:1]).T)
    step[first] = 0.0
    share = polylines.add_up(step, first[of])[:, None] / length[of, None] if len(of) else np.empty((0, 1))
    crown = (crowns.crown[of, :1] * (1.0 - share) + crowns.crown[of, 1:] * share)[:, 0]
    return Camber.of(
        xy[on],
        xy[on + 1],
        half=roads.width[crowns.road[of[on]]] / 2,
        crown=np.stack([crown[on], crown[on + 1]], axis=1),
    )


def crown_rows(roads: Carriageways, crowns: Crowns, *, surfaces: Layers, first: int) -> Layers:
    """Rows for the left half of carriageways with crowns, so that the ground has vertices along the crown.

    They lie above their carriageways and have their features.

    surfaces : those of roads
    first    : feature of the first carriageway; that of row k is ``first + k``
    """
    rows = np.flatnonzero((surfaces.klass == Class.ROAD) & (surfaces.feature >= first))
    rows = rows[surfaces.feature[rows] < first + len(roads)]
    row = np.full(len(roads), -1, np.int64)
    row[surfaces.feature[rows] - first] = rows
    drawn = np.flatnonzero(row[crowns.road] >= 0)
    line, half = crowns.line[drawn], roads.width[crowns.road[drawn]] / 2
    left = shapely.buffer(line, half, single_sided=True, join_style="mitre", mitre_limit=1.1)
    halves = shapely.buffer(shapely.intersection(left, carriageway(line, half)), 0.0)
    found = surfaces.take(row[crowns.road[drawn]])
    return Layers.of(
        halves,
        klass=found.klass,
        material=found.material,
        priority=found.priority + _ABOVE,
        osm_id=found.osm_id,
        source=found.source,
        feature=found.feature,
    ).take(np.flatnonzero(shapely.area(halves) > 0.0))

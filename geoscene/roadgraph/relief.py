"""Relief of roads and tracks on the ground: cambers, beds of ballast, kerbs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class, materials
from geoscene.geometry import polylines
from geoscene.geometry.frames import Frame
from geoscene.ground.kerbs import MappedKerbs
from geoscene.ground.layers import Layers
from geoscene.ground.relief import CAMBER, FADE, SLOPE, Beds, Camber
from geoscene.roadgraph.carriageways import KERB, PAVED, Carriageways, surface_material
from geoscene.roadgraph.junctions import carriageway, junction_reach
from geoscene.roadgraph.paths import way_lines
from geoscene.roadgraph.tags import place_and_layer
from geoscene.sources.data import OsmData
from geoscene.typing import Bools, Float, Ints

_NARROW = 3.5
"""Metres: carriageways narrower than a lane, such as alleys, are level across. Assumed."""

_FADE = 10.0
"""Metres over which a camber begins. Assumed: its edge then falls by 0.9 % on a road 7 m wide."""

_SHORT = 2.0
"""Metres of camber at least."""

_ABOVE = 0.75
"""Priority of a half with camber above its carriageway: over joints (0.5), below the next class of road."""

_TRACKS = frozenset({"rail", "light_rail", "subway", "narrow_gauge", "preserved"})
_BALLAST = ("ballast", "gravel")
_TOP = 1.8
"""Metres from the middle of a track to the edge of the top: half a sleeper of 2.6 m and a shoulder."""

_GAP = 0.7
"""Metres: beds are one where less than twice this is between their tops, as between tracks 4 to 5 m apart."""

_PRIORITY_TOP, _PRIORITY_SLOPE = 80.999, 78.9
"""Above the land cover of tracks; below it, above all other land cover but platforms."""

_LEAST = 2.0
"""Square metres of a top, at least."""

_KINDS = {"raised": "raised", "yes": "raised", "lowered": "lowered", "rolled": "lowered"} | dict.fromkeys(
    ("flush", "no"), "flush"
)


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


def read_beds(osm: OsmData, frame: Frame, *, cover: Layers, others: Layers) -> tuple[Beds, Layers]:
    """Beds under tracks on the ground, and their rows for the ground: tops and slopes.

    Tracks of trams, and those with a ``surface`` other than ballast or gravel, lie in the street and have
    none. Beds keep off roads, paths, platforms, water and buildings, and come down where these cross tracks
    and to bridges and tunnels. Rows have the features of the tracks' land cover.

    cover  : land cover
    others : surfaces of roads and paths, and building pads
    """
    ways, lines = way_lines([way for way in osm.ways if way.tags.get("railway") in _TRACKS], frame)
    on_ground = np.array([place_and_layer(way.tags)[0] == 0 for way in ways], np.bool_)
    ends = shapely.get_parts(shapely.boundary(lines[~on_ground]))
    bedded = on_ground & np.isin([surface_material(way.tags, "ballast")[0] for way in ways], _BALLAST)
    lines, ids = lines[bedded], [way.osm_id for way, b in zip(ways, bedded, strict=True) if b]
    obstacle = _obstacles(cover, others, lines=lines)
    wide = shapely.union_all(shapely.buffer(lines, _TOP + _GAP, cap_style="flat", join_style="mitre"))
    keep_off = shapely.union_all(shapely.buffer(obstacle, SLOPE, join_style="mitre"))
    area = shapely.difference(shapely.buffer(wide, -_GAP, join_style="mitre"), keep_off)
    tops = shapely.get_parts(area)
    tops = tops[shapely.area(tops) > _LEAST]
    line, other = shapely.STRtree(obstacle).query(lines, predicate="intersects")
    crossed = shapely.intersection(lines[line], obstacle[other])
    ends = np.concatenate([crossed[~shapely.is_empty(crossed)], ends])
    return Beds.of(tops, ends), _rows(lines, ids, tops=tops, ends=ends, keep_off=keep_off, cover=cover)


def _obstacles(cover: Layers, others: Layers, *, lines: NDArray[np.object_]) -> NDArray[np.object_]:
    """Surfaces (n,) near tracks that beds keep off."""
    solid = cover.take(np.flatnonzero(np.isin(cover.klass, (Class.SIDEWALK, Class.WATER))))
    shapes = np.concatenate([solid.polygon, others.polygon[others.klass != Class.RAIL]])
    near = shapely.buffer(lines, _TOP + _GAP + SLOPE, cap_style="flat")
    found = np.unique(shapely.STRtree(shapes).query(near, predicate="intersects")[1])
    return np.asarray(shapes[found], object)


def _rows(
    lines: NDArray[np.object_],
    ids: list[str],
    *,
    tops: NDArray[np.object_],
    ends: NDArray[np.object_],
    keep_off: Any,
    cover: Layers,
) -> Layers:
    """Tops and slopes of beds, each track's own, cut where they come down."""
    if not len(tops):
        return Layers.empty()
    top = shapely.MultiPolygon(tops.tolist())
    slopes = shapely.difference(shapely.buffer(top, SLOPE, join_style="mitre"), keep_off)
    fading = shapely.union_all(shapely.buffer(ends, FADE, quad_segs=4))
    tracks = cover.take(np.flatnonzero(cover.klass == Class.RAIL))
    feature = dict(zip(tracks.osm_id.tolist(), tracks.feature.tolist(), strict=True))
    parts = []
    for area, priority, beside in (
        (top, _PRIORITY_TOP, _TOP + _GAP),
        (slopes, _PRIORITY_SLOPE, _TOP + _GAP + SLOPE),
    ):
        own = shapely.intersection(shapely.buffer(lines, beside, cap_style="square"), area)
        for shapes, level in (
            (shapely.difference(own, fading), priority),
            (shapely.intersection(own, fading), priority + 1e-4),
        ):
            parts.append(
                Layers.of(
                    shapely.buffer(shapes, 0.0),
                    klass=Class.RAIL,
                    material=materials()["ballast"].code,
                    priority=level,
                    osm_id=np.array(ids, np.str_),
                    feature=[feature.get(name, -1) for name in ids],
                )
            )
    rows = Layers.concatenate(parts)
    return rows.take(np.flatnonzero(shapely.area(rows.polygon) > 0.0))


def mapped_kerbs(osm: OsmData, frame: Frame) -> MappedKerbs:
    """The nodes with a tag ``kerb`` (raised, lowered, rolled, flush or no)."""
    points = [point for point in osm.points if point.tags.get("kerb") in _KINDS]
    if not points:
        return MappedKerbs.empty()
    x, y = frame.from_geographic([point.lon for point in points], [point.lat for point in points])
    return MappedKerbs(
        shapely.points(np.column_stack([x, y])),
        np.array([_KINDS[point.tags["kerb"]] for point in points], "U8"),
        np.array([point.tags.get("highway") == "crossing" for point in points], np.bool_),
    )


def sidewalk_ends(roads: Carriageways) -> NDArray[np.object_]:
    """Lines (n,) across carriageways on the ground, sidewalks included, where bridges and tunnels begin."""
    place = roads.place
    mouth = np.zeros(len(roads.node_xy), np.bool_)
    mouth[roads.ends[place != 0]] = True
    road, end = np.nonzero(mouth[roads.ends] & (place == 0)[:, None])
    along = np.where(end == 0, 0.0, shapely.length(roads.line[road]))
    ahead = polylines.directions(roads.line[road], along, reach=1.0)
    across = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    half = roads.width[road] / 2 + KERB + roads.walk[road].max(axis=1, initial=0.0)
    node = roads.node_xy[roads.ends[road, end]]
    ends = np.stack([node - half[:, None] * across, node + half[:, None] * across], axis=1)
    return np.asarray(shapely.linestrings(ends), object) if len(ends) else np.empty(0, object)

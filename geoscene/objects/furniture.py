"""Street furniture: lamps, signals, signs, bollards, benches, poles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import ShapeInstances
from geoscene.ground.kinds import is_underground, storey_tag
from geoscene.ground.partition import GroundPlan
from geoscene.objects.shapes import place, shapes
from geoscene.objects.signs import select_direction, sign_face, sign_shape
from geoscene.objects.siting import Sites
from geoscene.objects.street import stands as bicycle_stands
from geoscene.objects.street import street_shape
from geoscene.roadgraph.tags import is_bridge, is_tunnel
from geoscene.sources.data import OsmData, TaggedNode, Tags
from geoscene.support.columns import Columns
from geoscene.support.problems import Problem
from geoscene.tags import parse_direction, parse_length
from geoscene.typing import Bools, Float, Height, Ints

_Stand = tuple[Float, float, str]
"""(place, heading, heading source)."""
_Row = tuple[Float, float, str, str, float, str, str, str, str, Float, int]
"""A stand with (shape, height, height source, place source, face, id, where it is mapped, number)."""

_TALLEST = 60.0
"""Metres; greater heights are taken for masts or typing errors."""

_STOREY = 3.0
"""Metres, ``min_height`` from which an object is on a storey; plates of signs begin lower."""

_FARTHEST = 30.0
"""Metres within which the road that an object faces is searched for."""

_WITHOUT_SURFACE = 4.0
"""Metres from the centre line where no road surface is known: half a street of two lanes, and a clearance."""

POSTS, STANDS = 2, 16
"""Feature numbers of a node: posts beside a road, and stands of a bicycle parking."""

_TRAVELLED = frozenset(
    {"motorway", "trunk", "primary", "secondary", "tertiary", "unclassified", "residential", "living_street",
     "service", "motorway_link", "trunk_link", "primary_link", "secondary_link", "tertiary_link", "busway",
     "road"}
)  # fmt: skip

_KINDS: dict[tuple[str, str], str] = {
    ("highway", "street_lamp"): "street_lamp",
    ("highway", "traffic_signals"): "traffic_signals",
    ("highway", "stop"): "sign_stop",
    ("highway", "give_way"): "sign_give_way",
    ("barrier", "bollard"): "bollard",
    ("amenity", "bench"): "bench",
    ("power", "pole"): "utility_pole",
    ("man_made", "utility_pole"): "utility_pole",
    ("man_made", "flagpole"): "flagpole",
    ("emergency", "fire_hydrant"): "hydrant",
}


@dataclass(frozen=True, slots=True)
class Furniture(Columns):
    """Street furniture, one row per object.

    xy       : (n, 2) float64, scene metres
    shape    : (n,) str, name in `geoscene.objects.shapes.shapes`
    height   : (n,) float64 metres above the ground
    heading  : (n,) float64, radians counter-clockwise from east, the direction it faces
    height_source : (n,) str: ``height`` or ``default`` (the shape's own)
    place_source : (n,) str: ``node`` (where it is mapped), ``moved`` (mapped on a carriageway, moved to the
                nearest clear place) or ``roadside`` (mapped on a road's own node, moved beside that road)
    moved    : (n,) float64 metres from where it is mapped
    heading_source : (n,) str: ``direction`` (tag), ``road`` (towards its traffic or the road) or ``default``
    source   : (n,) str: ``mapped``, ``outdoor_seating`` (tables at a place that the map says to have some) or
                ``guess``
    face     : (n,) str: with relief, what is drawn on a sign as far as it is mapped, `geoscene.objects.signs`
    osm_id   : (n,) str: of its node; of guesses, the street or the place to eat
    feature  : (n,) int32: as read, `POSTS` (with relief `STANDS`) times the row of its node among
                `mapped_furniture`; further posts and stands add 1, 2 ...; then guesses follow
    """

    xy: Float
    shape: NDArray[np.str_]
    height: Float
    heading: Float
    height_source: NDArray[np.str_]
    place_source: NDArray[np.str_]
    moved: Float
    heading_source: NDArray[np.str_]
    source: NDArray[np.str_]
    face: NDArray[np.str_]
    osm_id: NDArray[np.str_]
    feature: NDArray[np.int32]


def read_furniture(
    osm: OsmData, frame: Frame, *, plan: GroundPlan, left_hand: bool = False, relief: str = "off"
) -> tuple[Furniture, list[Problem]]:
    """Mapped street furniture within the ground's extent, and moved or dropped objects.

    No post stands on a carriageway, a crossing, a track or in the mouth of a tunnel:

    - Signals and signs on a road's own node stand beside the road, half a metre off its surface, on the
      side on which their traffic drives, and face that traffic: the one that ``traffic_signals:direction``,
      ``traffic_sign:direction`` or ``direction`` names, else that of a one-way road, else (``stop`` and
      ``give_way``) the one that comes to the nearer junction, else both, each with a post of its own.
    - Other objects that are mapped on a carriageway are taken for imprecise and stand at the nearest clear
      place, bollards too: the road graph does not close roads at bollards, so vehicles pass there.

    Lamps face the nearest road. Left out and listed as problems are signals and signs of bridges and tunnels,
    objects inside buildings, and those without a clear place within `geoscene.objects.siting.FARTHEST`.

    With relief, bicycle parkings are rows of stands, and signs have the plates of their codes and faces.

    left_hand : traffic keeps left
    relief    : of `geoscene.uses.RELIEFS`; with ``plain`` and ``full`` there are more kinds
    """
    chosen, mapped = mapped_furniture(osm, frame, extent=plan.extent, relief=relief)
    roads, sites = _Roads.of(osm, frame), Sites.of(plan)
    addressing = np.array([_addresses(shape) and bool(roads.at(p)) for p, shape in chosen], np.bool_)
    amid = ~addressing & sites.driven(mapped)
    xy, found = mapped.copy(), np.ones(len(mapped), np.bool_)
    xy[amid], found[amid] = sites.nearest_clear(mapped[amid])
    problems = [
        Problem(chosen[k][0].osm_id, "furniture", "dropped", "on-carriageway")
        for k in np.flatnonzero(~found).tolist()
    ]
    problems += [
        Problem(p.osm_id, "furniture", "dropped", "off-ground", where)
        for p in osm.points
        if (where := storey_tag(p.tags, least=_STOREY)) and shape_of(p.tags, relief=relief) is not None
    ]
    rows: list[_Row] = []
    each = POSTS if relief == "off" else STANDS
    for k in np.flatnonzero(found).tolist():
        point, shape = chosen[k]
        height, height_source = _height(point, shape, problems=problems)
        stands = (
            _roadside_stands(point, shape, xy=xy[k], roads=roads, frame=frame)
            if addressing[k]
            else [_stand(point, shape, xy=xy[k], roads=roads, frame=frame, left_hand=left_hand)]
        )
        if not stands:
            problems.append(Problem(point.osm_id, "furniture", "dropped", "on-bridge-or-in-tunnel"))
        face = sign_face(point.tags) if relief != "off" and shape.startswith("sign_") else ""
        source = "roadside" if addressing[k] else "moved" if amid[k] else "node"
        if shape == "bicycle_stand":
            at, heading, heading_source = stands[0]
            row = bicycle_stands(point.tags, place=at, heading=heading, most=STANDS)
            stands = [(place, heading, heading_source) for place in row]
        rows += [
            (*stand, shape, height, height_source, source, face, point.osm_id, mapped[k], each * k + nth)
            for nth, stand in enumerate(stands)
        ]
    table, lost = _beside_roads(_table(rows), sites, left_hand=left_hand)
    problems += [Problem(str(osm_id), "furniture", "dropped", "no-roadside") for osm_id in np.unique(lost)]
    built = sites.classes(table.xy) == Class.BUILDING_PAD
    problems += [
        Problem(str(osm_id), "furniture", "dropped", "in-building")
        for osm_id in np.unique(table.osm_id[built])
    ]
    return table.take(~built), problems


def mapped_furniture(
    osm: OsmData, frame: Frame, *, extent: Sequence[float], relief: str = "off"
) -> tuple[list[tuple[TaggedNode, str]], Float]:
    """The nodes within an extent that are street furniture, with their shapes, and their places (n, 2)."""
    points = osm.points
    if relief != "off":
        points = [
            replace(p, tags=tags) if (tags := select_direction(p.tags)) is not p.tags else p for p in points
        ]
    chosen = [
        (point, shape)
        for point in points
        if (shape := shape_of(point.tags, relief=relief)) is not None and not _off_ground(point.tags)
    ]
    x, y = frame.from_geographic(*np.array([(p.lon, p.lat) for p, _ in chosen]).reshape(-1, 2).T)
    xmin, ymin, xmax, ymax = extent
    inside = np.flatnonzero((x >= xmin) & (x < xmax) & (y >= ymin) & (y < ymax))
    return [chosen[k] for k in inside.tolist()], np.column_stack([x, y])[inside]


def furniture_instances(furniture: Furniture, *, height: Height | None = None) -> ShapeInstances:
    """An instance of a shape for each object, in scene coordinates, standing on the terrain."""
    n = len(furniture)
    z = np.zeros(n) if height is None else np.asarray(height(*furniture.xy.T), float)
    usual = np.array([usual_height(str(shape)) for shape in furniture.shape], float)
    size = np.ones((n, 3))
    size[:, 2] = furniture.height / usual
    return place(
        furniture.shape,
        np.column_stack([furniture.xy, z]),
        size=size,
        heading=furniture.heading,
        feature=furniture.feature,
    )


def shape_of(tags: Tags, *, relief: str = "off") -> str | None:
    """Name of the shape for a node's tags, None if it is not street furniture."""
    if relief != "off" and (shape := street_shape(tags)) is not None:
        return shape
    for (key, value), shape in _KINDS.items():
        if tags.get(key) == value:
            return shape
    sign = tags.get("traffic_sign", "")
    if sign in {"", "no"}:
        return None
    return _sign(sign.lower()) if relief == "off" else sign_shape(sign_face(tags))


def _sign(value: str) -> str:
    """The plate of a ``traffic_sign``: by its human-readable value, else a plain rectangle.

    National codes (``DE:206``) do not tell the plate's form without each country's table.
    """
    if value == "stop":
        return "sign_stop"
    if value == "give_way":
        return "sign_give_way"
    if value in {"maxspeed", "overtaking", "no_entry", "maxweight", "maxheight", "maxwidth"}:
        return "sign_round"
    return "sign_triangle" if value == "hazard" else "sign_rectangle"


def _off_ground(tags: Tags) -> bool:
    """Whether the object is not on the ground in the open."""
    layer = tags.get("layer", "0").lstrip("+")
    return (
        is_underground(tags)
        or layer not in {"0", ""}
        or storey_tag(tags, least=_STOREY) != ""
        or tags.get("location") in {"indoor", "wall", "wall_mounted"}
        or tags.get("fire_hydrant:type") in {"underground", "wall", "pond", "pipe"}
    )


def usual_height(shape: str) -> float:
    """Height of a shape in metres."""
    return float(shapes(with_relief=True)[shape].vertices[:, 2].max())


def _height(point: TaggedNode, shape: str, *, problems: list[Problem]) -> tuple[float, str]:
    """(metres, source) of the height of an object."""
    usual = usual_height(shape)
    if "height" not in point.tags:
        return usual, "default"
    metres = parse_length(point.tags["height"])
    if metres is not None and 0.1 < metres <= _TALLEST:
        return metres, "height"
    detail = f"height={point.tags['height']!r}; took {usual:.1f} m"
    problems.append(Problem(point.osm_id, "furniture", "repaired", "unusable-height", detail))
    return usual, "default"


@dataclass(frozen=True, slots=True)
class _Roads:
    """Centre lines of roads, indexed by node and by position.

    lines : (n,) object, scene metres
    oneway : (n,) int8: 1, -1 or 0
    raised : (n,) bool, on a bridge or in a tunnel
    by_node : (row, vertex index) pairs of each node
    nodes : ids of the nodes of each line
    tree : of the lines
    """

    lines: NDArray[np.object_]
    oneway: NDArray[np.int8]
    raised: Bools
    by_node: dict[int, list[tuple[int, int]]]
    nodes: list[Ints]
    tree: shapely.STRtree

    @classmethod
    def of(cls, osm: OsmData, frame: Frame) -> _Roads:
        ways = [w for w in osm.ways if w.tags.get("highway") in _TRAVELLED and len(w.lonlat) > 1]
        nodes = [way.nodes for way in ways]
        lonlat = np.concatenate([np.empty((0, 2)), *(way.lonlat for way in ways)])
        of = np.repeat(np.arange(len(ways)), [len(way.lonlat) for way in ways])
        xy = np.column_stack(frame.from_geographic(*lonlat.T))
        lines = np.asarray(shapely.linestrings(xy, indices=of), object)
        by_node: dict[int, list[tuple[int, int]]] = {}
        oneway = []
        for row, way in enumerate(ways):
            value = way.tags.get("oneway", "yes" if way.tags.get("junction") == "roundabout" else "no")
            oneway.append({"yes": 1, "1": 1, "true": 1, "-1": -1, "reverse": -1}.get(value, 0))
            for index, node in enumerate(way.nodes.tolist()):
                by_node.setdefault(node, []).append((row, index))
        raised = np.array([is_bridge(way.tags) or is_tunnel(way.tags) for way in ways], np.bool_)
        return cls(lines, np.array(oneway, np.int8), raised, by_node, nodes, shapely.STRtree(lines))

    def at(self, point: TaggedNode) -> list[tuple[int, int]]:
        """(row, vertex index) pairs of a node that lies on roads."""
        return self.by_node.get(int(point.osm_id.removeprefix("node/")), [])

    def nearer_junction(self, row: int, index: int) -> int:
        """1 if a vertex's nearer junction lies ahead along its line, -1 if behind, 0 if it is a junction.

        Where no junction lies between, the end of the line counts.
        """
        nodes, last = self.nodes[row], len(self.nodes[row]) - 1
        crossing = [k for k in range(last + 1) if k in (0, last) or self._arms(int(nodes[k])) > 2]
        if index in crossing:
            return 0 if self._arms(int(nodes[index])) > 2 else 1 if index else -1
        xy = shapely.get_coordinates(self.lines[row])
        metres = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
        ahead = min(metres[k] for k in crossing if k > index) - metres[index]
        behind = metres[index] - max(metres[k] for k in crossing if k < index)
        return 1 if ahead <= behind else -1

    def _arms(self, node: int) -> int:
        """Number of road arms that leave a node."""
        return sum(1 if k in (0, len(self.nodes[row]) - 1) else 2 for row, k in self.by_node[node])

    def course(self, row: int, index: int) -> Float:
        """Unit vector (2,) along a line at one of its vertices, of the segment that leads to it."""
        xy = shapely.get_coordinates(self.lines[row])
        step = np.diff(xy, axis=0)
        step = step[np.hypot(*step.T) > 0]
        if not len(step):
            return np.array([1.0, 0.0])
        one = step[min(max(index - 1, 0), len(step) - 1)]
        unit: Float = one / np.hypot(*one)
        return unit


def _addresses(shape: str) -> bool:
    """Whether a shape addresses the traffic of one direction."""
    return shape == "traffic_signals" or shape.startswith("sign_")


def _facing(point: TaggedNode, xy: Float, *, frame: Frame) -> float | None:
    """Heading from tags in degrees or as a compass point, None without one."""
    stated = parse_direction(point.tags.get("direction") or point.tags.get("light:direction"))
    if stated is None:
        return None
    lon, lat = frame.to_geographic(*xy)
    return float(np.pi / 2 - (np.radians(stated) - float(frame.convergence(lon, lat))))


def _stand(
    point: TaggedNode, shape: str, *, xy: Float, roads: _Roads, frame: Frame, left_hand: bool
) -> _Stand:
    """Position and heading of an object that is not on a node of a road."""
    heading = _facing(point, xy, frame=frame)
    if heading is not None:
        return xy, heading, "direction"
    near = roads.tree.query_nearest(shapely.Point(xy), max_distance=_FARTHEST, all_matches=False)
    if len(near) == 0:
        return xy, 0.0, "default"
    line = roads.lines[near[0]]
    along = line.project(shapely.Point(xy))
    toward = shapely.get_coordinates(line.interpolate(along))[0] - xy
    if np.hypot(*toward) < 1e-6:
        return xy, 0.0, "default"
    if not _addresses(shape):
        return xy, float(np.arctan2(toward[1], toward[0])), "road"
    # It faces the traffic on its side of the road.
    before, after = shapely.get_coordinates(line.interpolate([max(along - 1, 0), along + 1]))
    course = after - before
    right = course[0] * -toward[1] - course[1] * -toward[0] < 0
    against = -course if right != left_hand else course
    if roads.oneway[near[0]]:
        against = -course * float(roads.oneway[near[0]])
    return xy, float(np.arctan2(against[1], against[0])), "road"


def _roadside_stands(
    point: TaggedNode, shape: str, *, xy: Float, roads: _Roads, frame: Frame
) -> list[_Stand]:
    """A post, still at the node, for each direction of traffic that a road's node addresses."""
    on = [(row, index) for row, index in roads.at(point) if not roads.raised[row]]
    if not on:
        return []
    # A node inside a way has one course; one where ways meet takes that of the first that passes through.
    row, index = max(on, key=lambda at: 0 < at[1] < shapely.get_num_points(roads.lines[at[0]]) - 1)
    course = roads.course(row, index)
    keys = ("traffic_signals:direction", "traffic_sign:direction", "direction")
    stated = next((point.tags[key] for key in keys if key in point.tags), "")
    signs = {"forward": (1,), "backward": (-1,), "both": (1, -1)}.get(stated)
    facing = _facing(point, xy, frame=frame)
    if signs is None and facing is not None:
        return [(xy, facing, "direction")]
    source = "road" if signs is None else "direction"
    if signs is None and roads.oneway[row]:
        signs = (int(roads.oneway[row]),)
    elif signs is None:
        nearer = roads.nearer_junction(row, index) if shape in {"sign_stop", "sign_give_way"} else 0
        signs = (nearer,) if nearer else (1, -1)
    against = [-course * sign for sign in signs]
    return [(xy, float(np.arctan2(y, x)), source) for x, y in against]


def _beside_roads(table: Furniture, sites: Sites, *, left_hand: bool) -> tuple[Furniture, NDArray[np.str_]]:
    """The table with its roadside posts moved off the road, and the ids without a clear point.

    A post is placed at the nearest clear point between straight to the driving side of the traffic it faces
    and straight back; in a junction this is the near corner.
    """
    moved = np.flatnonzero(table.place_source == "roadside")
    side = 1.0 if left_hand else -1.0
    aside = table.heading[moved] + np.pi + side * np.pi / 2
    paved = sites.driven(table.xy[moved])
    off = np.where(paved, 0.0, _WITHOUT_SURFACE)[:, None] * np.column_stack([np.cos(aside), np.sin(aside)])
    xy, found = sites.nearest_clear(
        table.xy[moved] + off, angles=aside[:, None] + side * np.radians(np.arange(0, 91, 15))
    )
    xy[~found], found[~found] = sites.nearest_clear(table.xy[moved[~found]])
    places, keep = table.xy.copy(), np.ones(len(table), np.bool_)
    places[moved], keep[moved] = xy, found
    placed = replace(table, xy=places, moved=table.moved + np.hypot(*(places - table.xy).T))
    return placed.take(keep), table.osm_id[~keep]


def _table(rows: list[_Row]) -> Furniture:
    columns: list[list[object]] = [list(column) for column in zip(*rows, strict=True)] if rows else [[]] * 11
    where, heading, heading_source, shape, height, height_source, place_source, face, *ids = columns
    osm_id, mapped, number = ids
    xy = np.array(where, float).reshape(-1, 2)
    return Furniture(
        xy,
        np.array(shape, np.str_),
        np.array(height, float),
        np.array(heading, float),
        np.array(height_source, np.str_),
        np.array(place_source, np.str_),
        np.hypot(*(xy - np.array(mapped, float).reshape(-1, 2)).T),
        np.array(heading_source, np.str_),
        np.full(len(rows), "mapped"),
        np.array(face, np.str_),
        np.array(osm_id, np.str_),
        np.array(number, np.int32),
    )

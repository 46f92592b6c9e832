"""Street furniture: lamps, signals, signs, bollards, benches, poles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.frames import Frame
from geoscene.ground.kinds import is_underground
from geoscene.ground.partition import GroundPlan, winners
from geoscene.mesh import Instances
from geoscene.objects.shapes import place, shapes
from geoscene.report import Problem
from geoscene.sources.data import OsmData, Point, Tags
from geoscene.tags import parse_direction, parse_length
from geoscene.typing import Float

Height = Callable[[Float, Float], Float]
_Stand = tuple[Float, float, str, str]
"""(place, heading, place source, heading source)."""
_Row = tuple[Float, float, str, str, str, float, str, str]
"""A stand with (shape, height, height source, id)."""

_TALLEST = 60.0
"""Metres: a taller pole is a mast or a slip of the pen."""

_ASIDE = 0.5
"""Metres between the edge of the carriageway and what stands beside it: the clearance of traffic signs."""

_FARTHEST = 30.0
"""Metres within which the road that a thing belongs to, or that road's edge, is looked for."""

_WIDEST = 15.0
"""Metres from a centre line beyond which no carriageway of one road reaches."""

_WITHOUT_SURFACE = 4.0
"""Metres from the centre line where no road surface is known: half a street of two lanes, and `_ASIDE`."""

_ON_ROAD = (Class.ROAD, Class.LANE_MARKING, Class.CROSSING, Class.KERB, Class.PARKING, Class.RAIL)
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
class Furniture:
    """Things that stand by the road, one row a thing.

    xy       : (n, 2) float64, scene metres
    shape    : (n,) str, name in `geoscene.objects.shapes.shapes`
    height   : (n,) float64 metres above the ground
    heading  : (n,) float64, radians counter-clockwise from east: where it faces
    height_source : (n,) str: ``height`` or ``default`` (the shape's own)
    place_source : (n,) str: ``node`` (where the map has it) or ``roadside`` (beside the road of its node)
    heading_source : (n,) str: ``direction``, ``road`` (against its traffic, or towards it) or ``default``
    osm_id   : (n,) str
    feature  : (n,) int32, -1 for none
    """

    xy: Float
    shape: NDArray[np.str_]
    height: Float
    heading: Float
    height_source: NDArray[np.str_]
    place_source: NDArray[np.str_]
    heading_source: NDArray[np.str_]
    osm_id: NDArray[np.str_]
    feature: NDArray[np.int32]

    def __len__(self) -> int:
        """Number of things."""
        return len(self.shape)

    def take(self, keep: NDArray[np.bool_] | NDArray[np.integer]) -> Furniture:
        """The chosen rows, in the given order."""
        return Furniture(*(getattr(self, f.name)[keep] for f in fields(self)))


def read_furniture(
    osm: OsmData, frame: Frame, *, plan: GroundPlan, left_hand: bool = False
) -> tuple[Furniture, list[Problem]]:
    """The street furniture on the map within the ground's extent, and what could not be used.

    Signals and signs that the map has on a road's own node are put beside the road, facing the traffic
    that heeds them (``direction`` or ``traffic_signals:direction``, else, on a two-way road, traffic of
    both directions, each with its own): on the side that traffic keeps to, half a metre off the road's
    surface, as the ground has it. Lamps face the nearest road. What is in tunnels, on bridges or inside
    buildings is left out.

    left_hand : traffic keeps left
    """
    chosen = [
        (point, shape)
        for point in osm.points
        if (shape := shape_of(point.tags)) is not None and not _elsewhere(point.tags)
    ]
    x, y = frame.from_geographic(*np.array([(p.lon, p.lat) for p, _ in chosen]).reshape(-1, 2).T)
    xy = np.column_stack([x, y])
    xmin, ymin, xmax, ymax = plan.extent
    inside = (x >= xmin) & (x < xmax) & (y >= ymin) & (y < ymax)
    roads = _Roads.of(osm, frame)
    problems: list[Problem] = []
    rows: list[_Row] = []
    for k in np.flatnonzero(inside):
        point, shape = chosen[k]
        height, height_source = _height(point, shape, problems=problems)
        rows += [
            (*stand, shape, height, height_source, point.osm_id)
            for stand in _stands(point, shape, xy=xy[k], roads=roads, frame=frame, left_hand=left_hand)
        ]
    table = _table(rows)
    table, adrift = _put_beside(table, plan, left_hand=left_hand)
    problems += [Problem(str(osm_id), "furniture", "dropped", "no-roadside") for osm_id in np.unique(adrift)]
    built = np.append(plan.layers.klass == Class.BUILDING_PAD, np.False_)[winners(plan, table.xy)]
    problems += [
        Problem(str(osm_id), "furniture", "dropped", "in-building")
        for osm_id in np.unique(table.osm_id[built])
    ]
    return table.take(~built), problems


def furniture_instances(furniture: Furniture, *, height: Height | None = None) -> Instances:
    """A copy of a shape for each thing, in scene coordinates, standing on the terrain."""
    n = len(furniture)
    z = np.zeros(n) if height is None else np.asarray(height(*furniture.xy.T), float)
    usual = np.array([_usual_height(str(shape)) for shape in furniture.shape], float)
    size = np.ones((n, 3))
    size[:, 2] = furniture.height / usual
    return place(
        furniture.shape,
        np.column_stack([furniture.xy, z]),
        size=size,
        heading=furniture.heading,
        feature=furniture.feature,
    )


def shape_of(tags: Tags) -> str | None:
    """The shape for a node's tags, None if it is no street furniture."""
    for (key, value), shape in _KINDS.items():
        if tags.get(key) == value:
            return shape
    sign = tags.get("traffic_sign", "")
    return _sign(sign.lower()) if sign not in {"", "no"} else None


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


def _elsewhere(tags: Tags) -> bool:
    """Whether it does not stand on the ground in the open."""
    layer = tags.get("layer", "0").lstrip("+")
    return (
        is_underground(tags)
        or layer not in {"0", ""}
        or tags.get("location") in {"indoor", "wall", "wall_mounted"}
    )


def _usual_height(shape: str) -> float:
    """How high a shape reaches, metres."""
    return float(shapes()[shape].vertices[:, 2].max())


def _height(point: Point, shape: str, *, problems: list[Problem]) -> tuple[float, str]:
    """(metres, source) of a thing's height."""
    usual = _usual_height(shape)
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
    """Roads' centre lines, to be found by node and by nearness.

    lines : (n,) object, scene metres
    oneway : (n,) int8: 1, -1 or 0
    by_node : rows and places in them of each node
    tree : of the lines
    """

    lines: NDArray[np.object_]
    oneway: NDArray[np.int8]
    by_node: dict[int, list[tuple[int, int]]]
    tree: shapely.STRtree

    @classmethod
    def of(cls, osm: OsmData, frame: Frame) -> _Roads:
        ways = [w for w in osm.ways if w.tags.get("highway") in _TRAVELLED and len(w.lonlat) > 1]
        lines = np.empty(len(ways), object)
        by_node: dict[int, list[tuple[int, int]]] = {}
        oneway = []
        for row, way in enumerate(ways):
            lines[row] = shapely.LineString(np.column_stack(frame.from_geographic(*way.lonlat.T)))
            value = way.tags.get("oneway", "yes" if way.tags.get("junction") == "roundabout" else "no")
            oneway.append({"yes": 1, "1": 1, "true": 1, "-1": -1, "reverse": -1}.get(value, 0))
            for index, node in enumerate(way.nodes):
                by_node.setdefault(int(node), []).append((row, index))
        return cls(lines, np.array(oneway, np.int8), by_node, shapely.STRtree(lines))

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


def _stands(
    point: Point, shape: str, *, xy: Float, roads: _Roads, frame: Frame, left_hand: bool
) -> list[_Stand]:
    """Where a thing stands and faces, once or twice; ``roadside`` ones are still on the centre line."""
    stated = parse_direction(point.tags.get("direction") or point.tags.get("light:direction"))
    heading = None
    if stated is not None:
        lon, lat = frame.to_geographic(*xy)
        heading = np.pi / 2 - (np.radians(stated) - float(frame.convergence(lon, lat)))
    on = roads.by_node.get(int(point.osm_id.removeprefix("node/")), [])
    if on and (shape == "traffic_signals" or shape.startswith("sign_")):
        return _heeded(point, xy, roads=roads, on=on)
    if heading is not None:
        return [(xy, heading, "node", "direction")]
    near = roads.tree.query_nearest(shapely.Point(xy), max_distance=_FARTHEST, all_matches=False)
    if len(near) == 0:
        return [(xy, 0.0, "node", "default")]
    line = roads.lines[near[0]]
    foot = shapely.get_coordinates(line.interpolate(line.project(shapely.Point(xy))))[0]
    toward = foot - xy
    if np.hypot(*toward) < 1e-6:
        return [(xy, 0.0, "node", "default")]
    if shape.startswith("sign_") or shape == "traffic_signals":
        # Beside the road: it faces the traffic that keeps to its side, against that traffic's course.
        along = line.project(shapely.Point(xy))
        ahead = shapely.get_coordinates(line.interpolate([max(along - 1, 0), along + 1]))
        course = ahead[1] - ahead[0]
        right = course[0] * -toward[1] - course[1] * -toward[0] < 0
        against = -course if right != left_hand else course
        if roads.oneway[near[0]]:
            against = -course * float(roads.oneway[near[0]])
        return [(xy, float(np.arctan2(against[1], against[0])), "node", "road")]
    return [(xy, float(np.arctan2(toward[1], toward[0])), "node", "road")]


def _heeded(point: Point, xy: Float, *, roads: _Roads, on: list[tuple[int, int]]) -> list[_Stand]:
    """A thing on a road's centre line, once for each direction of traffic that heeds it, facing that."""
    # A node inside a way knows its course; one where ways meet takes that of the first that passes through.
    row, index = max(on, key=lambda at: 0 < at[1] < shapely.get_num_points(roads.lines[at[0]]) - 1)
    course = roads.course(row, index)
    stated = point.tags.get("traffic_signals:direction") or point.tags.get("direction", "")
    signs = {"forward": (1,), "backward": (-1,), "both": (1, -1)}.get(stated)
    source = "direction" if signs is not None else "road"
    if signs is None:
        signs = (int(roads.oneway[row]),) if roads.oneway[row] else (1, -1)
    against = [-course * sign for sign in signs]
    return [(xy, float(np.arctan2(y, x)), "roadside", source) for x, y in against]


def _put_beside(table: Furniture, plan: GroundPlan, *, left_hand: bool) -> tuple[Furniture, NDArray[np.str_]]:
    """The table with its roadside things half a metre off the road, and the ids that found no place.

    Straight to the side of the traffic that the thing faces; amid a junction, where that leads along another
    road, back to the near corner.
    """
    moved = np.flatnonzero(table.place_source == "roadside")
    ahead = -np.column_stack([np.cos(table.heading[moved]), np.sin(table.heading[moved])])
    aside = np.column_stack([ahead[:, 1], -ahead[:, 0]]) * (-1.0 if left_hand else 1.0)
    courses = np.stack([aside, (aside - ahead) / np.sqrt(2.0)], axis=1)
    reach = np.arange(0.0, _FARTHEST, 0.25)
    places = table.xy[moved][:, None, None] + reach[:, None] * courses[:, :, None]
    klass = np.append(plan.layers.klass, np.uint8(plan.base[0]))[winners(plan, places.reshape(-1, 2))]
    road = np.isin(klass, _ON_ROAD).reshape(places.shape[:3])
    ends = np.any(~road[:, :, reach <= _WIDEST], axis=2)
    no_surface = ~road[:, 0, 0]
    which = np.where(ends[:, 0], 0, 1)
    nth = np.arange(len(moved))
    off = np.where(no_surface, _WITHOUT_SURFACE, reach[np.argmin(road[nth, which], axis=1)] + _ASIDE)
    xy = table.xy.copy()
    xy[moved] += off[:, None] * courses[nth, which]
    keep = np.ones(len(table), bool)
    keep[moved] = no_surface | ends.any(axis=1)
    return replace(table, xy=xy).take(keep), table.osm_id[~keep]


def _table(rows: list[_Row]) -> Furniture:
    columns: list[list[object]] = [list(column) for column in zip(*rows, strict=True)] if rows else [[]] * 8
    where, heading, place_source, heading_source, shape, height, height_source, osm_id = columns
    return Furniture(
        np.array(where, float).reshape(-1, 2),
        np.array(shape, np.str_),
        np.array(height, float),
        np.array(heading, float),
        np.array(height_source, np.str_),
        np.array(place_source, np.str_),
        np.array(heading_source, np.str_),
        np.array(osm_id, np.str_),
        np.full(len(rows), -1, np.int32),
    )

"""Plans of drives on roads: from a scene and the description of a route to a path.

Route and path are planned together: streets and turns that the vehicle cannot pass are avoided.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import GROUND, Class
from geoscene.geometry.frames import Frame
from geoscene.pipeline.reach import RoadMap
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.routing import edge_lines
from geoscene.roadgraph.walls import HEADROOM
from geoscene.scene import Scene
from geoscene.support.progress import Progress, silent
from geoscene.typing import Float
from lidar.errors import BlockedError, OffStreetError, RouteError
from lidar.geometry.time_scales import check_duration
from lidar.motion.path import Path, Surface, plan_path
from lidar.motion.route import Route, RouteOptions, Side, Spec, plan_route
from lidar.motion.vehicle import Vehicle, load_vehicle
from lidar.motion.waypoints import TOLERANCE
from lidar.world.world import World

_RANDOM_SECONDS = 60.0
ROUTE_MARGIN_S = 15.0
"""Seconds at the speed limits by which the route of a drive that starts and ends at speed exceeds its record.

It covers the braking distance at any speed that streets allow."""
_SEARCH_M = 1.5  # metres above and below the road graph within which the road surface is searched
_NO_ROADS = "has no drivable roads within its bounds; choose a place with roads"
_ON_ROAD = 5.0  # metres from a waypoint to a road that is meant
_DRIVEN = [*map(int, GROUND), int(Class.BRIDGE)]


@dataclass(frozen=True, slots=True)
class RoadDriveOptions:
    """Options of a drive on roads.

    vehicle   : a built-in vehicle, or a TOML file
    seed      : of a random route
    duration  : seconds to record; the whole route, or 60 s of a random one, by default
    side      : side of the road that is driven on
    from_rest : start and end a random drive at rest; by default its route is longer than the record and the
                vehicle is at speed at both ends
    """

    vehicle: str
    seed: int = 0
    duration: float | None = None
    side: Side = "right"
    from_rest: bool = False

    def record(self, spec: Spec) -> tuple[float | None, bool]:
        """Seconds to record, None for the whole route, and whether the vehicle is at speed at both ends."""
        seconds = self.duration if self.duration is not None or spec != "random" else _RANDOM_SECONDS
        return seconds, spec == "random" and not self.from_rest

    def route_options(self, spec: Spec) -> RouteOptions:
        """Options of its route."""
        seconds, at_speed = self.record(spec)
        if seconds is not None and at_speed:
            seconds += ROUTE_MARGIN_S
        return RouteOptions(seed=self.seed, duration=seconds, side=self.side)


@dataclass(frozen=True, slots=True)
class RoadPlan:
    """A planned drive on roads.

    graph     : road graph of the scene
    path      : along the route; its edges are those of ``graph``
    duration  : seconds to record, None for the whole route
    at_speed : whether the vehicle is at speed at the start and at the end of the record
    """

    graph: RoadGraph
    path: Path
    duration: float | None
    at_speed: bool = False


def graph_on_tiles(graph: RoadGraph | None, scene: Scene | RoadMap) -> RoadGraph:
    """The part of a road graph on the scene's tiles; raises RouteError if it is empty."""
    if graph is None:
        raise RouteError(f"{_name(scene)}: {_NO_ROADS}")
    kept = edges_on_tiles(graph, scene)
    return graph if kept.all() else graph.take(kept)


def edges_on_tiles(graph: RoadGraph, scene: Scene | RoadMap) -> NDArray[np.bool_]:
    """Whether (m,) each edge of a road graph lies on the scene's tiles; raises RouteError if none does.

    Of a map, and of a scene for an area, it is whether the edge lies on the tiles of the whole map.
    """
    xmin, ymin, xmax, ymax = scene.bounds
    points = np.concatenate([np.empty((0, 3)), *graph.geometry])[:, :2]
    edge = np.repeat(np.arange(len(graph)), [len(line) for line in graph.geometry])
    low, high = np.array([xmin, ymin]), np.array([xmax, ymax])
    inside = ((points >= low) & (points <= high)).all(axis=1)
    if isinstance(scene, Scene) and scene.area is None:
        inside &= scene.tiles_at(points) >= 0
    kept = np.bincount(edge, ~inside, minlength=len(graph)) == 0
    if not kept.any():
        raise RouteError(f"{_name(scene)}: {_NO_ROADS}")
    on_tiles: NDArray[np.bool_] = kept
    return on_tiles


def _name(scene: Scene | RoadMap) -> str:
    return str(scene.path) if isinstance(scene, Scene) else scene.name


_Buildings = tuple[NDArray[np.object_], Float, NDArray[np.object_], Float]
"""Footprints (k,) in scene metres of buildings and parts, metres (k,) from the ground to their lower ends,
passages (p,) through them, and the free height (p,) of these."""


def _buildings(scene: Scene) -> _Buildings:
    """The buildings of a scene in plan."""
    tables = [scene.features(name) for name in ("buildings", "building_parts") if scene.table_length(name)]
    if not tables:
        return np.empty(0, object), np.empty(0), np.empty(0, object), np.empty(0)
    parted = np.concatenate([table.columns["building"] for table in tables[1:]] or [np.empty(0, np.int64)])
    whole = ~np.isin(tables[0].columns["feature"], parted)
    kept = [whole, *(np.ones(len(table), np.bool_) for table in tables[1:])]
    footprints, low = (
        np.concatenate([column[rows] for column, rows in zip(columns, kept, strict=True)])
        for columns in (
            [table.geometry for table in tables],
            [np.asarray(table.columns["min_height"], float) for table in tables],
        )
    )
    if not scene.table_length("passages"):
        return footprints, low, np.empty(0, object), np.empty(0)
    passages = scene.features("passages")
    return footprints, low, passages.geometry, np.asarray(passages.columns["height"], float)


def _obstacles(buildings: _Buildings, *, height: float) -> NDArray[np.object_]:
    """What buildings take of the ground for vehicles of a height: without what these pass under."""
    footprints, min_height, passages, free = buildings
    blocked = footprints[min_height < HEADROOM]
    passages = passages[free > height]
    of, which = shapely.STRtree(passages).query(blocked, predicate="intersects")
    for k in np.unique(of).tolist():
        blocked[k] = shapely.difference(blocked[k], shapely.union_all(passages[which[of == k]]))
    return blocked


def building_obstacles(scene: Scene, *, height: float) -> NDArray[np.object_]:
    """Footprints (k,) in scene metres of buildings without passages for vehicles of ``height`` metres."""
    return _obstacles(_buildings(scene), height=height)


def road_map(scene: Scene) -> RoadMap:
    """The roads and buildings of a scene."""
    graph = scene.road_graph() if scene.files.road_graph.exists() else None
    return RoadMap(
        str(scene.path), scene.frame, scene.bounds, graph, *_buildings(scene), left_hand=scene.left_hand
    )


def road_surface(scene: Scene) -> Surface:
    """Heights of the ground or bridge surface near given heights; the given heights where none is found."""
    world = World(scene)

    def surface(x: Float, y: Float, z: Float) -> Float:  # noqa: PLR0917 - a Surface
        world.follow((float(x.min()) - 1, float(y.min()) - 1, float(x.max()) + 1, float(y.max()) + 1))
        origins = np.column_stack([x, y, z + _SEARCH_M])
        down = np.broadcast_to([0.0, 0.0, -1.0], origins.shape)
        hits = world.caster.cast(origins, down, far=2 * _SEARCH_M)
        on_road = np.isfinite(hits.range) & np.isin(world.lookup(hits).klass, _DRIVEN)
        return np.where(on_road, z + _SEARCH_M - np.where(on_road, hits.range, 0.0), z)

    return surface


def plan_road_drive(
    scene: Scene,
    spec: Spec,
    *,
    options: RoadDriveOptions,
    progress: Progress = silent,
) -> RoadPlan:
    """The route and the path of a vehicle through a scene.

    Streets too narrow for the vehicle are avoided. Raises RouteError if there is no route.
    """
    whole = scene.road_graph()
    kept = edges_on_tiles(whole, scene)
    graph = whole if kept.all() else whole.take(kept)
    vehicle, buildings = load_vehicle(options.vehicle), _buildings(scene)
    progress("planning", 0, total=0)
    try:
        _, path = plan_route_and_path(
            graph,
            scene.frame,
            spec=spec,
            vehicle=vehicle,
            options=options.route_options(spec),
            obstacles=_obstacles(buildings, height=vehicle.height),
            roofs=shapely.STRtree(buildings[0]),
            ground=road_surface(scene),
        )
    except RouteError as error:
        if isinstance(error, OffStreetError) and (reason := _street_there(scene, whole, places=error.places)):
            raise RouteError(f"{error}; {reason}") from None
        if scene.route is None:
            raise
        raise RouteError(f"{error}; the scene has only what lies along the route it was built for") from None
    number = np.append(np.flatnonzero(kept), -1).astype(np.int32)
    path = replace(path, edge=number[path.edge])
    return RoadPlan(whole, path, *options.record(spec))


def _street_there(scene: Scene, graph: RoadGraph, *, places: Sequence[Sequence[float]]) -> str:
    """Why a street of the map at one of the places (x, y) is none to drive on; "" without such a street.

    graph : of the scene, with what lies on no tile
    """
    points = shapely.points(np.asarray(places, float).reshape(-1, 2))
    if shapely.STRtree(edge_lines(graph)).query(points, predicate="dwithin", distance=TOLERANCE).size:
        return (
            "the street there leaves the scene; choose a place further inside, or build a scene that holds"
            " all of it"
        )
    if scene.table_length("road_surfaces"):
        layer = scene.features("road_surfaces")
        road = layer.geometry[layer.columns["class"] == Class.ROAD.name.lower()]
        if shapely.STRtree(road).query(points, predicate="dwithin", distance=_ON_ROAD).size:
            return (
                "the road there is not connected to drivable streets: it is closed to the public, or not for"
                " cars"
            )
    return ""


def road_course(roads: RoadMap, spec: Spec, *, options: RoadDriveOptions) -> tuple[Float, list[Float]]:
    """Path (n, 2) in scene metres that `plan_road_drive` will plan, and all routes that it may try.

    Raises RouteError as `plan_road_drive` does.
    """
    tried: list[Float] = []
    vehicle = load_vehicle(options.vehicle)
    _, path = plan_route_and_path(
        graph_on_tiles(roads.graph, roads),
        roads.frame,
        spec=spec,
        vehicle=vehicle,
        options=options.route_options(spec),
        obstacles=_obstacles(
            (roads.footprints, roads.min_height, roads.passages, roads.passage_height),
            height=vehicle.height,
        ),
        roofs=shapely.STRtree(roads.footprints),
        tried=lambda route: tried.append(route.line[:, :2]),
    )
    return path.position[:, :2], tried


_ATTEMPTS = 40
"""Maximum number of plans."""


def plan_route_and_path(
    graph: RoadGraph,
    frame: Frame,
    *,
    spec: Spec,
    vehicle: Vehicle,
    options: RouteOptions | None = None,
    obstacles: Sequence[Any] | NDArray[np.object_] | shapely.STRtree | None = None,
    roofs: shapely.STRtree | None = None,
    ground: Surface | None = None,
    tried: Callable[[Route], None] = lambda _: None,
) -> tuple[Route, Path]:
    """A route and a path along it on which the vehicle touches no obstacle.

    Parameters are those of `plan_route` and `lidar.motion.path.plan_path`; ``body_width`` and
    ``turning_radius`` are the vehicle's. Where the body does not pass, the route is planned again without
    that street or turn; ``tried`` is called with each route.

    Raises RouteError as `plan_route` does and for a given route that takes longer than a drive lasts, and
    BlockedError if every route is blocked.
    """
    options = replace(
        options or RouteOptions(), body_width=vehicle.width, turning_radius=vehicle.turning_radius
    )
    if not isinstance(obstacles, shapely.STRtree):
        obstacles = shapely.STRtree([] if obstacles is None else list(obstacles))
    avoid: set[tuple[int, int]] = set()
    blocked: BlockedError
    for _ in range(_ATTEMPTS):
        try:
            route = plan_route(graph, frame, spec=spec, options=options, avoid=avoid, roofs=roofs)
        except RouteError:
            if avoid:
                break
            raise
        if spec != "random" and options.duration is None:
            check_duration(route.least_seconds(vehicle.max_speed), what="the route")
        tried(route)
        try:
            return route, plan_path(route, vehicle, frame=frame, obstacles=obstacles, ground=ground)
        except BlockedError as error:
            blocked = error
            fresh = set(error.turns) - avoid
            # a turn that is avoided already and still blocked means that its street is blocked
            avoid |= fresh or {(b, b) for _, b in error.turns}
    raise blocked

"""Plans of drives on roads: from a scene and the description of a route to a path."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.pipeline.reach import RoadMap
from geoscene.roadgraph.graph import RoadGraph
from geoscene.scene import Scene
from geoscene.support.progress import Progress, silent
from geoscene.typing import Float
from lidar.errors import RouteError
from lidar.motion.path import Path, Surface
from lidar.motion.rerouting import plan_route_and_path
from lidar.motion.route import Route, RouteOptions, Side, Spec
from lidar.motion.vehicle import load_vehicle
from lidar.world.world import World

_RANDOM_SECONDS = 60.0
ROUTE_MARGIN_S = 15.0
"""Seconds at the speed limits by which the route of a drive that starts and ends at speed exceeds its record.

It covers the braking distance at any speed that streets allow."""
_HEADROOM = 2.5  # metres below a building from which on vehicles pass under it
_SEARCH_M = 1.5  # metres above and below the road graph within which the road surface is searched
_NO_ROADS = "has no drivable roads within its bounds; choose a place with roads"
_DRIVEN = [int(c) for c in Class if Class.ROAD <= c <= Class.BUILDING_PAD or c == Class.BRIDGE]


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
    route: Route
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


def ground_footprints(scene: Scene) -> NDArray[np.object_]:
    """Footprints (k,) in scene metres of buildings without a passage below."""
    if not scene.table_length("buildings"):
        return np.empty(0, object)
    layer = scene.features("buildings")
    return _obstacles(layer.geometry, np.asarray(layer.columns["min_height"], float))


def _obstacles(footprints: NDArray[np.object_], min_height: Float) -> NDArray[np.object_]:
    return footprints[min_height < _HEADROOM]


def road_map(scene: Scene) -> RoadMap:
    """The roads and buildings of a scene."""
    xy, height = np.empty(0, object), np.empty(0)
    if scene.table_length("buildings"):
        layer = scene.features("buildings")
        xy, height = layer.geometry, np.asarray(layer.columns["min_height"], float)
    graph = scene.road_graph() if scene.files.road_graph.exists() else None
    return RoadMap(str(scene.path), scene.frame, scene.bounds, graph, xy, height, scene.left_hand)


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
    obstacles = ground_footprints(scene)
    progress("planning", 0, total=0)
    try:
        route, path = plan_route_and_path(
            graph,
            scene.frame,
            spec=spec,
            vehicle=load_vehicle(options.vehicle),
            options=options.route_options(spec),
            obstacles=obstacles,
            ground=road_surface(scene),
        )
    except RouteError as error:
        if scene.route is None:
            raise
        raise RouteError(f"{error}; the scene has only what lies along the route it was built for") from None
    number = np.append(np.flatnonzero(kept), -1).astype(np.int32)
    path = replace(path, edge=number[path.edge])
    return RoadPlan(whole, route, path, *options.record(spec))


def road_course(roads: RoadMap, spec: Spec, *, options: RoadDriveOptions) -> tuple[Float, list[Float]]:
    """Path (n, 2) in scene metres that `plan_road_drive` will plan, and all routes that it may try.

    Raises RouteError as `plan_road_drive` does.
    """
    tried: list[Float] = []
    _, path = plan_route_and_path(
        graph_on_tiles(roads.graph, roads),
        roads.frame,
        spec=spec,
        vehicle=load_vehicle(options.vehicle),
        options=options.route_options(spec),
        obstacles=_obstacles(roads.footprints, roads.min_height),
        tried=lambda route: tried.append(route.line[:, :2]),
    )
    return path.position[:, :2], tried

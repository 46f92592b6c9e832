"""The road users around an ego vehicle for a whole drive: traffic, parked vehicles, pedestrians."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.errors import SceneFormatError
from geoscene.geometry import polylines
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.walls import HEADROOM
from geoscene.scene import Scene
from geoscene.scene.geopackage import Layer
from lidar.geometry.poses import Trajectory
from lidar.motion.road_drive import building_obstacles
from lidar.motion.vehicle import DRY, RoadConditions, Vehicle
from lidar.traffic.junctions import JunctionPlan, junction_plan
from lidar.traffic.lanes import Lanes, lane_shift, lanes_of
from lidar.traffic.options import TrafficOptions
from lidar.traffic.parked import ParkingSpaces, kerb_spaces, lot_spaces, parked_actors
from lidar.traffic.pedestrians import pedestrian_trips, sidewalks_around
from lidar.traffic.simulation import simulate_trips
from lidar.traffic.surroundings import TrafficArea, ego_line, surroundings_of
from lidar.traffic.sweep import rectangles
from lidar.traffic.tracks import moving_actors
from lidar.traffic.trips import Trip, vehicle_trips
from lidar.world.actors import Actors, first_feature, join_actors

_ROAD = ("road", "lane_marking", "crossing", "parking")
_BUILDING_AREA = 1.0  # square metres from which an obstacle is a building
_POST_RADIUS = 0.2  # metres, of posts and trunks


@dataclass(frozen=True, slots=True)
class TrafficSetup:
    """Input of a traffic simulation around one ego trajectory.

    graph     : road graph of the scene
    seed, options : of the road users
    plan      : junctions and their signals
    area      : surroundings of the ego over time
    trips     : moving road users
    obstacles : footprints of buildings, posts and trunks
    surfaces  : the scene's layer of roads and sidewalks
    around    : polygon of everything within the radius of the ego's trajectory
    scale     : scene metres per true metre
    """

    scene: Scene
    graph: RoadGraph
    seed: int
    options: TrafficOptions
    lanes: Lanes
    plan: JunctionPlan
    area: TrafficArea
    trips: list[Trip]
    obstacles: NDArray[np.object_]
    surfaces: Layer | None
    around: shapely.Geometry
    scale: float


def populate(
    scene: Scene,
    graph: RoadGraph,
    *,
    ego: Trajectory,
    vehicle: Vehicle,
    seed: int,
    options: TrafficOptions | None = None,
    road: RoadConditions = DRY,
) -> Actors:
    """The road users around an ego vehicle whose trajectory is fixed; deterministic for a seed and options.

    Road users avoid the ego and signals are green when it arrives; see `drive_in_traffic` for an ego vehicle
    that reacts to traffic. Raises InputError for a scene whose features cannot be read.
    """
    setup = traffic_setup(scene, graph, ego=ego, seed=seed, options=options or TrafficOptions(), road=road)
    return simulated_actors(setup, ego, vehicle=vehicle, obeys_signals=False)


def traffic_setup(
    scene: Scene,
    graph: RoadGraph,
    *,
    ego: Trajectory,
    seed: int,
    options: TrafficOptions,
    road: RoadConditions = DRY,
) -> TrafficSetup:
    """Trips, junctions and obstacles around an ego trajectory; vehicles drive under conditions ``road``."""
    lanes = lanes_of(graph, side=options.side, bounds=scene.bounds, cut_nodes=scene.cut_nodes)
    plan = junction_plan(graph, lanes, seed=seed)
    scale = float(np.mean(np.asarray(scene.frame.scale_at(*ego.position[0, :2]), float)))
    area = surroundings_of(lanes, ego, radius=options.radius, scale=scale)
    around = shapely.buffer(ego_line(ego), (options.radius + 30.0) * scale)
    shapely.prepare(around)
    surfaces = _layer(scene, "road_surfaces")
    ground = _union(surfaces, _ROAD, area=around, grow=0.3)
    obstacles = _obstacles(scene, around)
    if ground is not None:
        ground = _passable(ground, obstacles, lanes=lanes, area=area)

    trips = vehicle_trips(lanes, area, seed=seed, density=options.vehicles, ground=ground, road=road)
    trips += vehicle_trips(
        lanes,
        area,
        seed=seed,
        density=options.cyclists,
        shares={"cyclist": 1.0},
        ground=ground,
        road=road,
    )
    walks = sidewalks_around(
        lanes, area, pavement=_union(surfaces, ("sidewalk",), area=around, grow=0.0), obstacles=obstacles
    )
    trips += pedestrian_trips(lanes, area, walks=walks, seed=seed, density=options.pedestrians)
    return TrafficSetup(
        scene, graph, seed, options, lanes, plan, area, trips, obstacles, surfaces, around, scale
    )


def simulated_actors(
    setup: TrafficSetup, ego: Trajectory, *, vehicle: Vehicle, obeys_signals: bool
) -> Actors:
    """Moving and parked road users of a simulation around an ego trajectory.

    obeys_signals : whether the trajectory stops at red signals; otherwise they are green when the ego arrives
    """
    flow = simulate_trips(
        setup.trips,
        setup.graph,
        plan=setup.plan,
        ego=ego,
        vehicle=vehicle,
        radius=setup.options.radius * setup.scale,
        obeys_signals=obeys_signals,
    )
    moving = moving_actors(setup.trips, flow, scene=setup.scene, scale=setup.scale)
    parked = parked_vehicles(setup, ego, vehicle=vehicle, swept=_swept(setup.trips))
    return join_actors([moving, parked], first_feature=first_feature(setup.scene))


def parked_vehicles(
    setup: TrafficSetup, ego: Trajectory, *, vehicle: Vehicle, swept: Iterable[NDArray[np.object_]]
) -> Actors:
    """Parked vehicles along kerbs and in parking lots, and parked bicycles on sidewalks.

    swept : areas swept by moving road users, polygons in plan, in several arrays
    """
    scene, surfaces, around, lanes = setup.scene, setup.surfaces, setup.around, setup.lanes
    seed, share = setup.seed, setup.options.parked
    lots = _polygons(_layer(scene, "landcover"), ("parking",), area=around)
    structures = _layer(scene, "structures")
    crossings = shapely.buffer(_polygons(surfaces, ("crossing",), area=around), 2.0)
    free = itertools.chain(
        [
            setup.obstacles,
            _strips(lanes, setup.area),
            shapely.buffer(setup.plan.zones.polygon, 3.0),
            crossings,
            np.empty(0, object) if structures is None else shapely.buffer(structures.geometry, 0.5),
            _ego_boxes(ego, vehicle, scale=setup.scale),
        ],
        swept,
    )
    spots = ParkingSpaces.concatenate(
        [
            kerb_spaces(lanes, setup.area.near, seed=seed, share=share),
            lot_spaces(lots, seed=seed, share=share),
        ]
    )
    return parked_actors(spots, scene, free=free, seed=seed, scale=setup.scale)


def _passable(
    road: shapely.Geometry, obstacles: NDArray[np.object_], *, lanes: Lanes, area: TrafficArea
) -> shapely.Geometry:
    """Carriageways without buildings on them; bridges and tunnels are kept."""
    buildings = obstacles[shapely.area(obstacles) > _BUILDING_AREA]
    over = np.flatnonzero(area.near & (lanes.graph.bridge | lanes.graph.tunnel))
    free = shapely.buffer(area.lines[over], lanes.graph.width[over] / 2 * area.scale)
    whole = shapely.union(shapely.difference(road, shapely.union_all(buildings)), shapely.union_all(free))
    shapely.prepare(whole)
    return whole


def _swept(trips: list[Trip]) -> Iterator[NDArray[np.object_]]:
    """Bounding boxes (k,) of each moving road user along its path, with a margin."""
    for trip in trips:
        xy, heading = trip.body()
        every = slice(0, None, 2 if trip.on_foot else 4)
        yield rectangles(
            xy[every], heading[every], length=max(trip.length, 1.0) + 0.5, width=trip.width + 0.3
        )


def _strips(lanes: Lanes, area: TrafficArea) -> NDArray[np.object_]:
    """Strips (k,) along the lanes around the ego, as wide as a car."""
    lines = [
        polylines.parallel(
            lanes.graph.geometry[e], -lanes.side * lane_shift(lanes, e, lane=lane, width=1.82)
        )[:, :2]
        for e in np.flatnonzero(area.near & (lanes.traffic_weight > 0)).tolist()
        for lane in range(int(lanes.count[e]))
    ]
    strips: NDArray[np.object_] = shapely.buffer(
        [shapely.linestrings(xy) for xy in lines], 1.0, cap_style="flat"
    )
    return strips


def _ego_boxes(ego: Trajectory, vehicle: Vehicle, *, scale: float) -> NDArray[np.object_]:
    """Bounding boxes (k,) of the ego vehicle every metre of its trajectory, with a margin."""
    moved = polylines.stations(ego.position)
    every = np.unique(np.searchsorted(moved, np.arange(0.0, moved[-1] + 1.0, 1.0)).clip(0, len(moved) - 1))
    poses = ego.at(ego.time_ns[every])
    forward = poses.rotation[:, :2, 0]
    middle = poses.position[:, :2] + scale * forward * vehicle.middle
    heading = np.arctan2(forward[:, 1], forward[:, 0])
    return rectangles(middle, heading, length=vehicle.length + 1.2, width=vehicle.width + 0.5)


def _layer(scene: Scene, name: str) -> Layer | None:
    try:
        return scene.features(name)
    except SceneFormatError:
        return None  # a scene without such features has no such layer


def _polygons(
    layer: Layer | None, classes: tuple[str, ...], *, area: shapely.Geometry
) -> NDArray[np.object_]:
    """Polygons (k,) of some classes that intersect an area."""
    if layer is None:
        return np.empty(0, object)
    kept = layer.geometry[np.isin(layer.columns["class"].astype(str), classes)]
    parts: NDArray[np.object_] = shapely.get_parts(kept[shapely.intersects(area, kept)])
    return parts


def _union(
    layer: Layer | None, classes: tuple[str, ...], *, area: shapely.Geometry, grow: float
) -> shapely.Geometry | None:
    """Union of the surfaces of some classes, buffered by ``grow`` metres; None without such surfaces."""
    parts = _polygons(layer, classes, area=area)
    if not len(parts):
        return None
    whole = shapely.buffer(shapely.union_all(parts), grow)
    shapely.prepare(whole)
    return whole


def _obstacles(scene: Scene, area: shapely.Geometry) -> NDArray[np.object_]:
    """Footprints (k,) in an area of posts, trunks and buildings without a passage below."""
    parts: list[NDArray[np.object_]] = [np.empty(0, object)]
    parts.append(building_obstacles(scene, height=HEADROOM))
    near = shapely.intersects(area, shapely.box(*scene.tile_boxes.T))
    for i, j in itertools.compress(scene.tile_indices, near):
        tile = scene.tile(i, j)
        posts = tile.instances.transform[:, :2, 3] + tile.origin[:2]
        parts.append(shapely.buffer(shapely.points(posts), _POST_RADIUS))
    whole = np.concatenate(parts)
    kept: NDArray[np.object_] = whole[shapely.intersects(area, whole)]
    return kept

"""A scene's road users for a drive: traffic, parked cars, people."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.errors import SceneFormatError
from geoscene.geopackage import Layer, read_layer
from geoscene.roads import RoadGraph
from geoscene.routing import edge_lines
from geoscene.scene import Scene
from lidar.actors.actors import Actors, joined
from lidar.actors.lanes import lanes_of
from lidar.actors.parked import Spots, kerb_spots, lot_spots, parked_actors
from lidar.actors.sweep import body_poses
from lidar.actors.tracks import moving_actors
from lidar.actors.traffic import junction_plan, rectangles, simulate_trips, vehicle_trips
from lidar.errors import InputError
from lidar.poses import Trajectory
from lidar.vehicle import Vehicle

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TrafficOptions:
    """How busy a place is.

    vehicles : moving vehicles per kilometre of lane
    parked   : share of the places along kerbs and in parking lots that are taken
    reach    : metres from the ego vehicle within which there are road users
    side     : side of the road that traffic keeps to
    """

    vehicles: float = 12.0
    parked: float = 0.6
    reach: float = 200.0
    side: Literal["right", "left"] = "right"

    def __post_init__(self) -> None:
        """Refuse densities that cannot be meant."""
        faults = [
            f"{name} {value}: {low} to {high}"
            for name, value, low, high in (
                ("vehicles", self.vehicles, 0, 60), ("parked", self.parked, 0, 1), ("reach", self.reach, 50, 1000),
            )
            if not low <= value <= high
        ]  # fmt: skip
        if faults:
            raise InputError("traffic out of bounds: " + "; ".join(faults))


def populate(
    scene: Scene,
    graph: RoadGraph,
    ego: Trajectory,
    vehicle: Vehicle,
    *,
    seed: int,
    options: TrafficOptions | None = None,
) -> Actors:
    """The road users around the ego vehicle for its whole drive; the same for the same seed and options.

    ego     : the ego vehicle's trajectory, which is given: the others keep clear of it
    vehicle : its size
    """
    options = options or TrafficOptions()
    lanes = lanes_of(graph, side=options.side)
    plan = junction_plan(graph, lanes, seed=seed)
    x, y = ego.position[0, :2]
    scale = float(np.mean(np.asarray(scene.frame.scale_at(x, y), float)))
    surfaces = _layer(scene, "road_surfaces")
    road = _union(surfaces, ("road", "lane_marking", "crossing", "parking"), 0.3)
    trips = vehicle_trips(
        graph, lanes, ego, seed=seed, density=options.vehicles, reach=options.reach, ground=road, scale=scale
    )
    box = (vehicle.length, vehicle.width, vehicle.length / 2 - vehicle.rear_overhang)
    flow = simulate_trips(trips, graph, plan, ego, box, reach=options.reach)
    groups = [moving_actors(trips, flow, scene, scale=scale)]

    route = _route(ego)
    near = shapely.dwithin(edge_lines(graph), route, options.reach)
    lots = _polygons(_layer(scene, "landcover"), ("parking",))
    lots = lots[shapely.dwithin(lots, route, options.reach)]
    spots = [
        kerb_spots(lanes, near, seed=seed, share=options.parked),
        lot_spots(lots, seed=seed, share=options.parked),
    ]
    whole = Spots(*(np.concatenate([getattr(s, name) for s in spots]) for name in ("xy", "heading", "hint")))
    driven = [_ego_boxes(ego, vehicle, scale)]
    for trip in trips:
        xy, heading = body_poses(trip.way, trip.shape.base * trip.stretch[0])
        part = slice(0, None, 4)
        driven.append(
            rectangles(
                xy[part], heading[part], trip.shape.length + 0.5, trip.shape.width * trip.stretch[1] + 0.3
            )
        )
    free = [
        *driven,
        shapely.buffer(plan.zones.polygon, 3.0),
        shapely.buffer(_polygons(surfaces, ("crossing",)), 2.0),
    ]
    groups.append(
        parked_actors(
            whole, scene, shapely.STRtree(_standing(scene, route.buffer(options.reach + 20))),
            shapely.STRtree(np.concatenate(free)), seed=seed, scale=scale,
        )
    )  # fmt: skip
    beyond = max((stop for _, stop in scene.layers.values()), default=0)
    return joined(groups, first_feature=beyond)


def _route(ego: Trajectory) -> shapely.Geometry:
    """The ego's way in plan."""
    xy = ego.position[:: max(len(ego.position) // 2000, 1), :2]
    return shapely.linestrings(xy).simplify(0.5) if np.ptp(xy, axis=0).max() > 0.5 else shapely.points(xy[0])


def _ego_boxes(ego: Trajectory, vehicle: Vehicle, scale: float) -> NDArray[np.object_]:
    """Boxes of the ego vehicle along its way, grown by what is kept from it."""
    moved = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(ego.position[:, :2], axis=0).T))])
    rows = np.unique(np.searchsorted(moved, np.arange(0.0, moved[-1] + 1.0, 1.0)).clip(0, len(moved) - 1))
    poses = ego.at(ego.time_ns[rows])
    forward = poses.rotation[:, :2, 0]
    middle = poses.position[:, :2] + scale * forward * (vehicle.length / 2 - vehicle.rear_overhang)
    heading = np.arctan2(forward[:, 1], forward[:, 0])
    return rectangles(middle, heading, vehicle.length + 1.2, vehicle.width + 0.5)


def _layer(scene: Scene, name: str) -> Layer | None:
    try:
        return read_layer(scene.path / "features.gpkg", name, scene.frame)
    except SceneFormatError:
        return None  # a scene without such features has no such layer


def _polygons(layer: Layer | None, classes: tuple[str, ...]) -> NDArray[np.object_]:
    if layer is None:
        return np.empty(0, object)
    kept = layer.geometry[np.isin(layer.columns["class"].astype(str), classes)]
    parts: NDArray[np.object_] = shapely.get_parts(kept)
    return parts


def _union(layer: Layer | None, classes: tuple[str, ...], grow: float) -> shapely.Geometry | None:
    parts = _polygons(layer, classes)
    if not len(parts):
        return None
    whole = shapely.buffer(shapely.union_all(parts), grow)
    shapely.prepare(whole)
    return whole


def _standing(scene: Scene, area: shapely.Geometry) -> NDArray[np.object_]:
    """Footprints of buildings and posts, trees and other things that stand in an area."""
    parts: list[NDArray[np.object_]] = []
    buildings = _layer(scene, "buildings")
    if buildings is not None:
        low = np.asarray(buildings.columns["min_height"], float)
        parts.append(buildings.geometry[low < 2.5])
    shapely.prepare(area)
    for i, j in scene.tile_indices:
        corner = np.array([i, j]) * scene.tile_size
        if not shapely.intersects(area, shapely.box(*corner, *(corner + scene.tile_size))):
            continue
        tile = scene.tile(i, j)
        posts = tile.instances.transform[:, :2, 3] + tile.origin[:2]
        parts.append(shapely.buffer(shapely.points(posts), 0.2))
    whole = np.concatenate([*parts, np.empty(0, object)])
    kept: NDArray[np.object_] = whole[shapely.intersects(area, whole)]
    return kept

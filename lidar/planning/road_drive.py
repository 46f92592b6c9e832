"""From a scene and a route's description to the vehicle's trajectory."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.progress import Progress, silent
from geoscene.roadgraph.graph import RoadGraph
from geoscene.scene import Scene
from geoscene.typing import Float
from lidar.errors import RouteError
from lidar.planning.path import Path, Surface
from lidar.planning.rerouting import plan_route_and_path
from lidar.planning.route import Route, Spec
from lidar.rig.vehicle import load_vehicle
from lidar.world.world import World

_RANDOM_SECONDS = 60.0
ROUTE_MARGIN_S = 15.0
"""Seconds at the speed limits by which the route of a drive that is under way is longer than its record.

A car can pull up in them from any speed that streets allow."""
_ABOVE = (
    1.5  # metres over the graph's height from which the surface under the wheels is looked for, and below it
)
_DRIVEN = [int(c) for c in Class if Class.ROAD <= c <= Class.BUILDING_PAD or c == Class.BRIDGE]


@dataclass(frozen=True, slots=True)
class RoadPlan:
    """A planned drive on roads.

    route, path : the path's edges are those of the whole road graph
    duration   : seconds that were asked for, if any were
    under_way  : whether it is at speed when it starts, and drives on when it ends
    """

    route: Route
    path: Path
    duration: float | None
    under_way: bool = False


def graph_on_tiles(graph: RoadGraph, scene: Scene) -> RoadGraph:
    """The part of a road graph that lies on the scene's tiles; raises as `edges_on_tiles` does."""
    kept = edges_on_tiles(graph, scene)
    return graph if kept.all() else graph.take(kept)


def edges_on_tiles(graph: RoadGraph, scene: Scene) -> NDArray[np.bool_]:
    """Which edges (m,) of a road graph lie on the scene's tiles.

    Raises RouteError if none does.
    """
    xmin, ymin, xmax, ymax = scene.bounds
    size = scene.tile_size
    tiles = np.array(scene.tile_indices).reshape(-1, 2)
    points = np.concatenate([np.empty((0, 3)), *graph.geometry])[:, :2]
    edge = np.repeat(np.arange(len(graph)), [len(line) for line in graph.geometry])
    low, high = np.array([xmin, ymin]), np.array([xmax, ymax])
    inside = ((points >= low) & (points <= high)).all(axis=1)
    width = int(tiles[:, 1].max() - tiles[:, 1].min()) + 3
    base = tiles.min(axis=0) - 1
    keys = (tiles - base) @ np.array([width, 1])
    place = np.clip(np.floor(points / size).astype(int) - base, 0, [10**6, width - 1])
    inside &= np.isin(place @ np.array([width, 1]), keys)
    kept = np.bincount(edge, ~inside, minlength=len(graph)) == 0
    if not kept.any():
        raise RouteError(f"{scene.path}: no road lies within the tiles of this scene")
    on_tiles: NDArray[np.bool_] = kept
    return on_tiles


def ground_footprints(scene: Scene) -> NDArray[np.object_]:
    """Footprints, scene metres, of buildings that reach down to the ground."""
    if "buildings" not in scene.layers or len(set(scene.layers["buildings"])) == 1:
        return np.empty(0, object)
    layer = scene.features("buildings")
    low = np.asarray(layer.columns["min_height"], float)
    standing: NDArray[np.object_] = layer.geometry[low < 2.5]
    return standing


def road_surface(scene: Scene) -> Surface:
    """The surface of ground and bridges, as rays see it, near given heights; those where there is none."""
    world: World | None = None

    def surface(x: Float, y: Float, z: Float) -> Float:  # noqa: PLR0917 - a Surface
        nonlocal world
        region = (float(x.min()) - 1, float(y.min()) - 1, float(x.max()) + 1, float(y.max()) + 1)
        if world is None:
            world = World.load(scene, region=region)
        else:
            world.follow(region)
        origins = np.column_stack([x, y, z + _ABOVE])
        hits = world.caster.cast(origins, np.broadcast_to([0.0, 0.0, -1.0], origins.shape), far=2 * _ABOVE)
        on_it = np.isfinite(hits.range) & np.isin(world.lookup(hits).klass, _DRIVEN)
        found: Float = np.where(on_it, z + _ABOVE - np.where(on_it, hits.range, 0.0), z)
        return found

    return surface


def plan_road_drive(
    scene: Scene,
    spec: Spec,
    *,
    vehicle: str,
    seed: int = 0,
    duration: float | None = None,
    side: str = "right",
    from_rest: bool = False,
    progress: Progress = silent,
) -> RoadPlan:
    """The route and the path of a vehicle through a scene.

    from_rest : whether a random drive too goes from rest to rest; else it is under way at both ends, along
                a route that is longer than the record

    Where a street is too narrow for the vehicle between its buildings, it is left out and the route planned
    again. Raises RouteError if no way is left.
    """
    whole = scene.road_graph()
    kept = edges_on_tiles(whole, scene)
    graph = whole if kept.all() else whole.take(kept)
    body = load_vehicle(vehicle)
    obstacles = ground_footprints(scene)
    progress("planning", 0, total=0)
    seconds = duration if duration is not None or spec != "random" else _RANDOM_SECONDS
    under_way = spec == "random" and not from_rest
    route, path = plan_route_and_path(
        graph,
        scene.frame,
        spec=spec,
        vehicle=body,
        seed=seed,
        duration=None if seconds is None else seconds + (ROUTE_MARGIN_S if under_way else 0.0),
        side=cast("Literal['left', 'right']", side),
        obstacles=obstacles,
        ground=road_surface(scene),
    )
    path = replace(path, edge=np.where(path.edge >= 0, np.flatnonzero(kept)[path.edge], -1).astype(np.int32))
    return RoadPlan(route, path, seconds, under_way)

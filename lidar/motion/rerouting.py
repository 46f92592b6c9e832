"""Planning of a route and its path together: streets and turns that the vehicle cannot pass are avoided."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry.frames import Frame
from geoscene.roadgraph.graph import RoadGraph
from lidar.errors import BlockedError, RouteError
from lidar.geometry.time_scales import check_duration
from lidar.motion.path import MARGIN, Path, Surface, plan_path
from lidar.motion.route import Route, RouteOptions, Spec, plan_route
from lidar.motion.vehicle import Vehicle

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
    ground: Surface | None = None,
    margin: float = MARGIN,
    tried: Callable[[Route], None] = lambda _: None,
) -> tuple[Route, Path]:
    """A route and a path along it on which the vehicle touches no obstacle.

    Parameters are those of `plan_route` and `lidar.motion.path.plan_path`; ``body_width`` is the vehicle's.
    Where the body does not pass, the route is planned again without that street or turn; ``tried`` is called
    with each route.

    Raises RouteError as `plan_route` does and for a given route that takes longer than a drive lasts, and
    BlockedError if every route is blocked.
    """
    options = replace(options or RouteOptions(), body_width=vehicle.width)
    if not isinstance(obstacles, shapely.STRtree):
        obstacles = shapely.STRtree([] if obstacles is None else list(obstacles))
    avoid: set[tuple[int, int]] = set()
    blocked: BlockedError
    for _ in range(_ATTEMPTS):
        try:
            route = plan_route(graph, frame, spec=spec, options=options, avoid=avoid)
        except RouteError:
            if avoid:
                break
            raise
        if spec != "random" and options.duration is None:
            check_duration(route.least_seconds(vehicle.max_speed), what="the route")
        tried(route)
        try:
            return route, plan_path(
                route, vehicle, frame=frame, obstacles=obstacles, ground=ground, margin=margin
            )
        except BlockedError as error:
            blocked = error
            fresh = set(error.turns) - avoid
            # a turn that is avoided already and still blocked means that its street is blocked
            avoid |= fresh or {(b, b) for _, b in error.turns}
            if options.as_is:
                break
    raise blocked

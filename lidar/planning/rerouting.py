"""A route and the path along it, found together: where the vehicle does not fit, it goes another way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.frames import Frame
from geoscene.roadgraph.graph import RoadGraph
from lidar.errors import BlockedError, RouteError
from lidar.planning.path import MARGIN, Path, Surface, plan_path
from lidar.planning.route import TOLERANCE, Route, Side, Spec, plan_route
from lidar.rig.vehicle import Vehicle

DETOURS = 40
"""Times that another way is looked for."""


def plan_route_and_path(
    graph: RoadGraph,
    frame: Frame,
    *,
    spec: Spec,
    vehicle: Vehicle,
    seed: int = 0,
    duration: float | None = None,
    length: float | None = None,
    side: Side = "right",
    tolerance: float = TOLERANCE,
    as_is: bool = False,
    obstacles: Sequence[Any] | NDArray[np.object_] | shapely.STRtree | None = None,
    ground: Surface | None = None,
    margin: float = MARGIN,
) -> tuple[Route, Path]:
    """A route and the path along it on which the vehicle touches no obstacle; arguments as for both.

    Where the body does not pass, the streets or turns in question are avoided and the route is planned again:
    a random one goes elsewhere, one through waypoints takes a detour.

    Raises RouteError as `plan_route` does, and BlockedError if no detour is left.
    """
    if not isinstance(obstacles, shapely.STRtree):
        obstacles = shapely.STRtree([] if obstacles is None else list(obstacles))
    avoid: set[tuple[int, int]] = set()
    blocked: BlockedError
    for _ in range(DETOURS):
        try:
            route = plan_route(
                graph,
                frame,
                spec=spec,
                seed=seed,
                duration=duration,
                length=length,
                side=side,
                body_width=vehicle.width,
                tolerance=tolerance,
                as_is=as_is,
                avoid=avoid,
            )
        except RouteError:
            if avoid:
                break
            raise
        try:
            return route, plan_path(
                route, vehicle, frame=frame, obstacles=obstacles, ground=ground, margin=margin
            )
        except BlockedError as error:
            blocked = error
            fresh = set(error.turns) - avoid
            # a turn that is avoided already and still in the way is the street's own fault
            avoid |= fresh or {(b, b) for _, b in error.turns}
            if as_is:
                break
    raise blocked

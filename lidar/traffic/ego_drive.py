"""Trajectories of an ego vehicle that reacts to signals, stop signs and other road users."""

from __future__ import annotations

import numpy as np

from geoscene.roadgraph.graph import RoadGraph
from geoscene.scene import Scene
from geoscene.typing import Float
from lidar.geometry.poses import Trajectory
from lidar.motion.motion import ended_at_rest, motion_along, poses_along
from lidar.motion.path import Path
from lidar.motion.road_drive import RoadPlan
from lidar.motion.speed_profile import motion_within
from lidar.motion.vehicle import DRY, RoadConditions, Vehicle
from lidar.traffic.ego import ego_trip
from lidar.traffic.junctions import JunctionPlan, junction_plan
from lidar.traffic.lanes import lanes_of
from lidar.traffic.options import TrafficOptions
from lidar.traffic.simulation import has_traffic_control, simulate_ego
from lidar.traffic.simulation_kernel import STEP_S
from lidar.traffic.trips import Trip
from lidar.world.actors import Actors

_ROUNDS = 3  # maximum number of simulations of the ego vehicle
_SAME = 25.0  # metres between two trajectories from which the surroundings are the same
_LONGER = (2.0, 90.0)  # maximum time of a drive to its end: factor of that on empty roads, plus seconds
_ON_S = 10.0  # seconds that are simulated beyond the record's end if the vehicle is at speed there


def drive_with_signals(
    path: Path,
    vehicle: Vehicle,
    *,
    graph: RoadGraph,
    seed: int,
    side: str = "right",
    bounds: tuple[float, float, float, float] | None = None,
    duration: float | None = None,
    at_speed: bool = False,
    road: RoadConditions = DRY,
) -> Trajectory:
    """The trajectory of a vehicle that drives a path alone and stops at red signals and stop signs.

    seed     : of the signals, as for `junction_plan`
    side     : of the road that is driven on
    bounds   : of the map in scene metres
    duration, at_speed : as for `drive_path`; a drive without a duration ends `DWELL_S` after its arrival
    road     : conditions on which it brakes in an emergency
    """
    plan = junction_plan(graph, lanes_of(graph, side=side, bounds=bounds), seed=seed)
    controlled = has_traffic_control(ego_trip(path, vehicle), graph, plan=plan)
    alone_ns = 0
    if duration is None or not controlled:
        motion = motion_along(path, vehicle, duration=duration, at_speed=at_speed)
        motion = motion if duration is not None else ended_at_rest(motion)
        if not controlled:
            return poses_along(path, vehicle, motion=motion)
        alone_ns = int(motion.time_ns[-1])
    return _driven(
        path,
        vehicle,
        graph=graph,
        plan=plan,
        trips=[],
        alone_ns=alone_ns,
        duration=duration,
        radius=np.inf,
        at_speed=at_speed,
        road=road,
    )


def drive_in_traffic(
    scene: Scene,
    plan: RoadPlan,
    *,
    vehicle: Vehicle,
    first: Trajectory,
    seed: int,
    options: TrafficOptions,
    road: RoadConditions = DRY,
) -> tuple[Trajectory, Actors]:
    """The trajectory of a vehicle along a planned path in simulated traffic, and the other road users.

    first : its trajectory without other road users, such as `drive_with_signals` gives
    road  : conditions on which the others drive; ``vehicle`` is the ego as it is driven on them

    The ego is simulated together with the others. Its motion is then smoothed to its limits of acceleration
    and jerk, never ahead of the simulated one, and the others are simulated again around it.
    Raises InputError for a scene whose features cannot be read.
    """
    from lidar.traffic.populate import (  # noqa: PLC0415  (not for drives without traffic)
        simulated_actors,
        traffic_setup,
    )

    ego, rounds = first, 0
    while True:
        setup = traffic_setup(scene, plan.graph, ego=ego, seed=seed, options=options, road=road)
        before = ego
        ego = _driven(
            plan.path,
            vehicle,
            graph=plan.graph,
            plan=setup.plan,
            trips=setup.trips,
            alone_ns=first.duration_ns,
            duration=plan.duration,
            radius=options.radius * setup.scale,
            at_speed=plan.at_speed,
            road=road,
        )
        rounds += 1
        if rounds == _ROUNDS or _apart(before, ego) < _SAME * setup.scale:
            return ego, simulated_actors(setup, ego, vehicle=vehicle, obeys_signals=True)
        del setup  # its trips take the most memory of a drive


def _driven(
    path: Path,
    vehicle: Vehicle,
    *,
    graph: RoadGraph,
    plan: JunctionPlan,
    trips: list[Trip],
    alone_ns: int,
    duration: float | None,
    radius: float,
    at_speed: bool,
    road: RoadConditions,
) -> Trajectory:
    """The trajectory of the ego simulated with trips; ``alone_ns`` is its time without them."""
    factor, more = _LONGER
    seconds = duration if duration is not None else factor * alone_ns * 1e-9 + more
    if duration is not None and at_speed:
        seconds += _ON_S
    travelled = simulate_ego(
        ego_trip(path, vehicle, at_speed=at_speed, road=road),
        trips,
        graph=graph,
        plan=plan,
        seconds=seconds,
        radius=radius,
    )
    time_s: Float = STEP_S * np.arange(len(travelled), dtype=float)
    motion = motion_within(
        path, vehicle, time_s=time_s, max_distance=travelled.clip(max=path.length), at_speed=at_speed
    )
    if duration is None:
        return poses_along(path, vehicle, motion=ended_at_rest(motion))
    return poses_along(path, vehicle, motion=motion).until(round(duration * 1e9))


def _apart(one: Trajectory, other: Trajectory) -> float:
    """Largest distance in plan between two trajectories at one time, while both last; scene metres."""
    until = min(one.duration_ns, other.duration_ns)
    time = np.linspace(0, until, max(int(until / 1e9), 1) + 1).astype(np.int64)
    d = one.at(time).position[:, :2] - other.at(time).position[:, :2]
    return float(np.hypot(*d.T).max())

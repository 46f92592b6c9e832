"""Area of a map that a drive needs: its course on the roads, buffered by the sensors' maximum range.

A scene of this part gives the drive the bytes of a scene of the whole map.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from geoscene.pipeline.reach import RoadMap
from geoscene.scene.layout import OVERHANG
from geoscene.typing import Float
from lidar.motion.replay import read_replay
from lidar.motion.road_drive import road_course
from lidar.motion.vehicle import load_vehicle
from lidar.options import DriveOptions
from lidar.sensors.navigation.satellite_visibility import BLOCK_M, REACH
from lidar.sensors.rig.devices import Camera
from lidar.sensors.rig.specs import load_rig
from lidar.simulation.flight_planning import flight_course
from lidar.simulation.frame_loop import CHUNK
from lidar.simulation.plan import flight_options, road_drive_options, sensors_of
from lidar.traffic.surroundings import LEFT

_ASIDE = 15.0
"""Metres, maximum distance of a sensor from the rear axle's path."""

_OBSTACLES = 25.0
"""Metres from routes within which footprints decide whether they can be driven."""

_STEP = 20.0
"""Metres between the points of a course from which the squares of loaded tiles are taken."""

_ROUNDING = 0.2
"""Metres by which a simplified line may differ from the line."""


@dataclass(frozen=True, slots=True)
class DriveCourse:
    """Course of a drive in plan, scene metres.

    path  : (n, 2) the vehicle's path, all that can be recorded
    tried : lines (k, 2) of the routes that were tried in the search of the path
    """

    path: Float
    tried: Sequence[Float] = ()


def drive_course(roads: RoadMap, options: DriveOptions) -> DriveCourse:
    """The course of a drive through the scene of a map; raises RouteError as the drive would."""
    rig = load_rig(options.rig)
    vehicle = load_vehicle(options.vehicle or rig.vehicle)
    route = options.route or "random"
    if isinstance(route, Path) and route.suffix == ".csv" and not options.survey:
        return DriveCourse(read_replay(route, roads.frame).position[:, :2])
    if vehicle.kind == "air":
        sensors = sensors_of(rig, options)
        return DriveCourse(
            flight_course(roads, route, vehicle=vehicle, sensors=sensors, options=flight_options(options))
        )
    options.check_on_roads(vehicle.name)
    return DriveCourse(*road_course(roads, route, options=road_drive_options(options, roads)))


def needed_area(roads: RoadMap, options: DriveOptions) -> Any:
    """The polygon, scene metres, that a drive needs the scene of; raises RouteError as the drive would.

    Sensors measure up to their range. Satellites and the sun are blocked by whatever is loaded: by all tiles
    around the stretch of the drive at hand. Road users are simulated within a radius.
    """
    course = drive_course(roads, options)
    rig, settings = load_rig(options.rig), options.recording_settings
    sensors = sensors_of(rig, options)
    x, y = course.path[len(course.path) // 2]
    scale = max(float(np.asarray(roads.frame.scale_at(x, y))), 1.0)
    margin = min(max((s.max_range for s in sensors), default=0.0), settings.world.reach)
    parts = [_around(course.path, (margin + _ASIDE) * scale)]
    parts += [_around(line, _OBSTACLES * scale) for line in course.tried]
    colored = any(isinstance(s, Camera) and "rgb" in s.spec.images for s in sensors)
    if colored and settings.camera.shadows:
        parts += _squares(course.path, CHUNK, margin=margin + OVERHANG)
    if rig.gnss:
        parts += _squares(course.path, BLOCK_M * scale, margin=REACH + OVERHANG)
    if options.traffic is not None:
        parts.append(_around(course.path, (options.traffic.radius + LEFT + _ASIDE) * scale))
    return shapely.union_all(parts)


def _around(line: Float, metres: float) -> Any:
    """Buffer of a line (n, 2), scene metres."""
    whole = shapely.linestrings(line) if np.ptp(line, axis=0).max() > 0 else shapely.points(line[0])
    return shapely.buffer(shapely.simplify(whole, _ROUNDING), metres + _ROUNDING, quad_segs=16)


def _squares(line: Float, span: float, *, margin: float) -> list[Any]:
    """Boxes of all stretches of a line (n, 2) of at most ``span`` metres along each axis, with a margin."""
    whole = shapely.linestrings(line) if np.ptp(line, axis=0).max() > 0 else shapely.points(line[0])
    points = shapely.get_coordinates(shapely.segmentize(shapely.simplify(whole, _ROUNDING), _STEP))
    more = margin + _ASIDE + _STEP
    return [
        shapely.box(*(points[rows].min(axis=0) - more), *(points[rows].max(axis=0) + more))
        for rows in _stretches(points, span + _STEP)
    ]


def _stretches(points: Float, span: float) -> Iterator[slice]:
    """The longest runs of points within a box of ``span`` metres, none within another."""
    last = 0
    for first in range(len(points)):
        stop = max(last, first + 1)
        low, high = points[first:stop].min(axis=0), points[first:stop].max(axis=0)
        while stop < len(points):
            low, high = np.minimum(low, points[stop]), np.maximum(high, points[stop])
            if (high - low).max() > span:
                break
            stop += 1
        if stop > last:
            yield slice(first, stop)
        if stop == len(points):
            return
        last = stop

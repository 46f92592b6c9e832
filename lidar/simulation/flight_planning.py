"""Plans of flights over a scene: along waypoints, along streets, or in strips over an area."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import shapely

from geoscene.classes import GROUND
from geoscene.errors import reason_of
from geoscene.pipeline.reach import RoadMap
from geoscene.scene import Scene
from geoscene.sources.tracks import read_geometries
from geoscene.typing import Float, Ints
from lidar.errors import RouteError
from lidar.geometry.poses import Trajectory
from lidar.geometry.time_scales import LONGEST_S, check_duration
from lidar.motion.flight import (
    dense_line,
    survey_flight,
    survey_lines,
    times_on_lines,
    waypoint_flight,
)
from lidar.motion.motion import drive_path
from lidar.motion.path import plan_path
from lidar.motion.road_drive import ROUTE_MARGIN_S, graph_on_tiles
from lidar.motion.route import Route, RouteOptions, plan_route
from lidar.motion.vehicle import Vehicle
from lidar.motion.waypoints import read_track
from lidar.options.drive import DriveOptions
from lidar.sensors.rig.camera_model import unproject
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.sensors.rig.scanner import firings
from lidar.world.world import World

ALTITUDES = {"slow": 60.0, "fast": 600.0}
"""Default metres above the ground of aircraft slower and faster than 30 m/s."""

_RANDOM_SECONDS = 60.0  # of a random flight
_STREET_RADIUS = 20.0  # metres, largest turning radius that can follow streets
_HIGH = 1e4
_LAYERS = 16  # surfaces above the ground that a vertical ray passes at most
_BORDER = 1e-3  # metres inside the scene's border, on which rays may miss the ground
_CLEAR = 2.0  # metres, minimum clearance above the scene
_STEEPEST = 0.2  # sine of the smallest depression angle of a beam that counts for the swath
_FURTHEST = 20_000.0  # metres from the scene to a waypoint; sensors do not range further
_GROUND = [int(c) for c in GROUND]


def plan_flight(
    scene: Scene, *, vehicle: Vehicle, sensors: Sequence[Scanner | Camera], options: DriveOptions
) -> tuple[Trajectory, Ints | None]:
    """The flight of an aircraft over a scene, and the times at which its scanners work.

    These are (k, 2) int64 nanoseconds from and to which they work; None for always. A random route is over
    streets. Surveys of craft that cannot hover (`cruise`) are level, above the highest ground below them.

    Raises RouteError for a flight that the aircraft cannot fly or that would collide with the scene.
    """
    survey, above, duration = options.survey, _above(vehicle, options), _seconds(options)
    below = _SceneBelow(scene)
    if survey:
        route, lines, spacing = _strips(
            scene, vehicle, sensors=sensors, options=options, height=above, below=below
        )
    else:
        route = _along(scene, vehicle=vehicle, options=options, above=above, below=below)
        if duration is None:
            check_duration(route.least_seconds(vehicle.max_speed), what="the route")
    at_speed = _is_random(options) and not options.from_rest
    trajectory = drive_path(plan_path(route, vehicle, frame=scene.frame), vehicle, at_speed=at_speed)
    if duration is not None:
        trajectory = trajectory.until(round(duration * 1e9))
    _refuse_collisions(trajectory, below, scene=scene)
    if not survey or options.turns:
        return trajectory, None
    scanning_ns = times_on_lines(trajectory, lines, max_offset=spacing / 2)
    if not len(scanning_ns):
        raise RouteError(
            f"the record of {trajectory.duration_ns / 1e9:.1f} s ends before the first line of the survey;"
            " record longer, or scan on the way there too (`turns`)"
        )
    return trajectory, scanning_ns


def flight_course(
    roads: RoadMap, *, vehicle: Vehicle, sensors: Sequence[Scanner | Camera], options: DriveOptions
) -> Float:
    """Scene metres (n, 2) of the course that `plan_flight` will plan over the scene of a map.

    In plan it does not depend on heights. Raises RouteError as `plan_flight` does, but for collisions.
    """
    above = _above(vehicle, options)
    if options.survey:
        route, _, _ = _strips(roads, vehicle, sensors=sensors, options=options, height=above, below=_LEVEL)
    else:
        route = _along(roads, vehicle=vehicle, options=options, above=above, below=_LEVEL)
    return plan_path(route, vehicle, frame=roads.frame).position[:, :2]


def _is_random(options: DriveOptions) -> bool:
    return options.route in ("", "random") and not options.survey


def _seconds(options: DriveOptions) -> float | None:
    """Seconds of a flight; None for a whole survey or given route."""
    return _RANDOM_SECONDS if options.duration is None and _is_random(options) else options.duration


def _above(vehicle: Vehicle, options: DriveOptions) -> float:
    """Metres of a flight above the ground."""
    if options.altitude is not None:
        return options.altitude
    return ALTITUDES["slow" if vehicle.max_speed < 30.0 else "fast"]


class _Ground(Protocol):
    def ground(self, x: Float, y: Float) -> Float: ...


class _Level:
    def ground(self, x: Float, y: Float) -> Float:  # noqa: ARG002
        """Height (n,) of level ground."""
        return np.zeros(len(x))


_LEVEL = _Level()


class _SceneBelow:
    """Heights of the scene below points, with the tiles around them loaded on demand."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._world = World(scene)

    def _load(self, x: Float, y: Float) -> World:
        xmin, ymin, xmax, ymax = self._scene.bounds
        region = (
            float(np.clip(x.min(), xmin, xmax)),
            float(np.clip(y.min(), ymin, ymax)),
            float(np.clip(x.max(), xmin, xmax)),
            float(np.clip(y.max(), ymin, ymax)),
        )
        self._world.follow(region)
        return self._world

    def top(self, x: Float, y: Float) -> Float:
        """Height (n,) of the highest surface; -inf without one."""
        world = self._load(x, y)
        origin = np.column_stack([x, y, np.full(len(x), _HIGH)])
        hits = world.caster.cast(origin, np.broadcast_to([0.0, 0.0, -1.0], origin.shape))
        return _HIGH - hits.range

    def ground(self, x: Float, y: Float) -> Float:
        """Height (n,) of the ground below buildings and trees along a line.

        Outside the scene it is that of the nearest place on its border. Where there is no ground, it is
        interpolated between the points before and after, and 0 if none has any.
        """
        xmin, ymin, xmax, ymax = self._scene.bounds
        x = np.clip(x, xmin + _BORDER, xmax - _BORDER)
        y = np.clip(y, ymin + _BORDER, ymax - _BORDER)
        world = self._load(x, y)
        origin = np.column_stack([x, y, np.full(len(x), _HIGH)])
        found = np.full(len(x), np.nan)
        left = np.arange(len(x))
        for _ in range(_LAYERS):
            hits = world.caster.cast(origin[left], np.broadcast_to([0.0, 0.0, -1.0], (len(left), 3)))
            hit = np.isfinite(hits.range)
            ground = hit & np.isin(world.lookup(hits).klass, _GROUND)
            origin[left[hit], 2] -= hits.range[hit]
            found[left[ground]] = origin[left[ground], 2]
            left = left[hit & ~ground]
            if not len(left):
                break
            origin[left, 2] -= 1e-3
        known = np.flatnonzero(np.isfinite(found))
        return np.interp(np.arange(len(x)), known, found[known]) if len(known) else np.zeros(len(x))


def _along(
    scene: Scene | RoadMap, *, vehicle: Vehicle, options: DriveOptions, above: float, below: _Ground
) -> Route:
    """The route along waypoints or streets, ``above`` metres over the ground."""
    spec, seconds = options.route, _seconds(options)
    if _is_random(options):
        if vehicle.turning_radius > _STREET_RADIUS:
            raise RouteError(
                f"a craft that turns within {vehicle.turning_radius:.0f} m cannot follow streets; give"
                " `survey` all, `survey` FILE or waypoints"
            )
        length = vehicle.max_speed * ((seconds or _RANDOM_SECONDS) + ROUTE_MARGIN_S)
        graph = graph_on_tiles(scene.graph if isinstance(scene, RoadMap) else scene.road_graph(), scene)
        line = plan_route(
            graph, scene.frame, spec="random", options=RouteOptions(seed=options.seed, length=length)
        ).line
        xyz, given = np.array(line), False
    elif isinstance(spec, str | Path):
        track = read_track(Path(spec), scene.frame)
        xyz, given = track.xyz, bool(track.xyz[:, 2].any())
    else:
        lat, lon = np.array(spec, float).T
        x, y = scene.frame.from_geographic(lon, lat)
        xyz, given = np.column_stack([x, y, np.zeros(len(x))]), False
    xmin, ymin, xmax, ymax = scene.bounds
    away = np.abs(xyz[:, :2] - np.clip(xyz[:, :2], [xmin, ymin], [xmax, ymax])).max(axis=1)
    if not away.max() <= _FURTHEST:
        k = int(np.argmax(~(away <= _FURTHEST)))
        raise RouteError(
            f"`route`: point {k + 1} lies {away[k] / 1000:.0f} km from the scene; give points over the scene"
        )
    if options.altitude is None and given:
        return waypoint_flight(xyz, limit=vehicle.max_speed)
    xy = dense_line(xyz[:, :2])
    level = np.column_stack([xy, np.full(len(xy), above)])
    return waypoint_flight(level, ground=below.ground, limit=vehicle.max_speed)


def _strips(
    scene: Scene | RoadMap,
    vehicle: Vehicle,
    *,
    sensors: Sequence[Scanner | Camera],
    options: DriveOptions,
    height: float,
    below: _Ground,
) -> tuple[Route, Float, float]:
    """The route in strips along an area's longer side, the strips (k, 2, 2), and their spacing."""
    area = survey_area(scene, options.survey)
    scale = float(np.asarray(scene.frame.scale_at(area.centroid.x, area.centroid.y)))
    spacing = swath(sensors, height) * (1.0 - options.overlap) * scale
    corner = shapely.get_coordinates(shapely.minimum_rotated_rectangle(area))
    sides = np.diff(corner[:3], axis=0)
    dx, dy = sides[int(np.argmax(np.hypot(*sides.T)))]
    strips = 1 + float(np.hypot(*sides.T).min()) / spacing
    turn = 2 * math.pi * vehicle.turning_radius * scale
    seconds = (area.area / spacing + strips * turn) / (vehicle.max_speed * scale)
    if not seconds <= LONGEST_S:
        raise RouteError(
            f"the survey has {strips:.0f} strips {spacing / scale:.3g} m apart and takes over"
            f" {LONGEST_S / 3600:.0f} hours; fly several surveys of parts of the area, lower the `overlap`"
            " or fly higher (`altitude`)"
        )
    stop = 0.0 if vehicle.cruise else vehicle.max_speed**2 / (2 * vehicle.acceleration)
    heading_deg = math.degrees(math.atan2(dx, dy))
    route = survey_flight(
        area,
        spacing=spacing,
        height=height,
        radius=vehicle.turning_radius * 1.1 * scale,
        heading_deg=heading_deg,
        run_out=stop,
        ground=below.ground,
        follow=not vehicle.cruise,
        limit=vehicle.max_speed,
    )
    return route, survey_lines(area, spacing=spacing, heading_deg=heading_deg), spacing


def survey_area(scene: Scene | RoadMap, text: str) -> Any:
    """The polygon, scene metres, that ``all``, W,S,E,N or a GeoJSON file names.

    Raises RouteError for a file without a polygon and for an area that does not touch the scene.
    """
    whole = shapely.box(*scene.bounds)
    if text == "all":
        return whole
    try:
        west, south, east, north = (float(v) for v in text.split(","))
        area = shapely.box(west, south, east, north)
    except ValueError:
        area = _polygon(Path(text))
    bounds = np.abs(area.bounds)
    if not (bounds[::2] <= 180).all() or not (bounds[1::2] <= 90).all():
        raise RouteError(f"`survey` {text}: coordinates are not longitudes and latitudes in degrees")
    # degrees: sides stay straight on the map where they are in the file
    area = shapely.segmentize(area, 1e-3)
    area = shapely.transform(area, lambda p: np.column_stack(scene.frame.from_geographic(*p.T)))
    if not shapely.intersects(area, whole):
        raise RouteError(f"`survey` {text}: the area does not touch the scene")
    return area


def _polygon(path: Path) -> Any:
    if not path.is_file():
        raise RouteError(f"`survey` {path}: neither all, W,S,E,N in degrees, nor a GeoJSON file")
    try:
        parts = read_geometries(path, path.read_bytes())
        shapes = [shapely.from_geojson(json.dumps(part)) for part in parts]
    except (ValueError, shapely.errors.GEOSException) as error:
        raise RouteError(f"`survey` {path}: not readable as GeoJSON ({reason_of(error)})") from error
    areas = shapely.union_all([s for s in shapes if s.geom_type in ("Polygon", "MultiPolygon")])
    if areas.is_empty:
        raise RouteError(f"`survey` {path}: no polygon in it")
    return areas if areas.geom_type == "Polygon" else areas.convex_hull


def swath(sensors: Sequence[Scanner | Camera], height: float) -> float:
    """Width in metres of the swath that all scanners (without scanners, all cameras) cover from a height.

    Raises RouteError without sensors, if a sensor does not look down, or if its maximum range is less than
    the height.
    """
    if not sensors:
        raise RouteError("a survey needs a rig with a scanner or a camera, such as drone or aircraft")
    lidars = [s for s in sensors if isinstance(s, Scanner)]
    return min(_swath(s, height) for s in lidars or sensors)


def _swath(sensor: Scanner | Camera, height: float) -> float:
    if isinstance(sensor, Scanner):
        way = firings(sensor.sensor, 0).direction
    else:
        c = sensor.spec
        edge = [[0.0, 0.0], [c.width - 1.0, 0.0], [c.width - 1.0, c.height - 1.0], [0.0, c.height - 1.0]]
        way = unproject(c, edge)
    way = way @ sensor.spec.mount.rotation.T
    down = way[-way[:, 2] > _STEEPEST]
    if height >= sensor.max_range:
        raise RouteError(
            f"`altitude` {height:g}: the maximum range of {sensor.name} is {sensor.max_range:g} m; fly lower"
        )
    if not len(down):
        raise RouteError(f"{sensor.name} does not look down; a survey needs a rig such as drone or aircraft")
    aside = down[:, 1] / -down[:, 2] * height
    furthest = math.sqrt(sensor.max_range**2 - height**2)
    left, right = np.percentile(aside, 98), -np.percentile(aside, 2)
    return 2.0 * float(min(left, right, furthest))


def _refuse_collisions(trajectory: Trajectory, below: _SceneBelow, *, scene: Scene) -> None:
    """Raise RouteError where the clearance above the scene is too small."""
    xyz = trajectory.position[::10]
    top = below.top(xyz[:, 0], xyz[:, 1])
    short = top + _CLEAR - xyz[:, 2]
    worst = int(np.argmax(short))
    if short[worst] > 0:
        lon, lat = scene.frame.to_geographic(*xyz[worst, :2])
        raise RouteError(
            f"the flight would collide with the scene, which reaches up to z = {top[worst]:.0f} m at"
            f" {float(lat):.6f}, {float(lon):.6f}; fly {math.ceil(short[worst])} m higher (`altitude`)"
        )

"""The plan of a drive: everything that is fixed before the first frame is recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from geoscene import __version__
from geoscene.classes import Class, materials
from geoscene.drawing.report import metres
from geoscene.pipeline.limits import Limit, height_limit
from geoscene.pipeline.reach import OFFSET, RoadMap
from geoscene.scene import Scene
from geoscene.support.progress import Progress, silent
from geoscene.typing import Float, Ints
from lidar.dataset.derived import scene_provenance, versions
from lidar.dataset.formats import FORMATS
from lidar.errors import InputError, RouteError
from lidar.geometry.georeference import Georeference, export_crs
from lidar.geometry.poses import Trajectory
from lidar.geometry.time_scales import check_duration, check_start
from lidar.motion.road_drive import RoadDriveOptions, RoadPlan, plan_road_drive
from lidar.motion.vehicle import Vehicle, load_vehicle, vehicle_on
from lidar.options.drive import DriveOptions
from lidar.raycast.device import check_device
from lidar.sensors.rig.devices import Camera, Scanner, cameras, scanners, sensor_kinds
from lidar.sensors.rig.specs import Rig, load_rig
from lidar.signal.attacks.placed_object import with_objects
from lidar.signal.stage import LABELS, POSES, ROAD_USERS
from lidar.simulation.recording import Recording
from lidar.traffic.ego_drive import drive_in_traffic, drive_with_signals
from lidar.traffic.options import TrafficFile
from lidar.world.actors import Actors
from lidar.world.settings import check_relief, origin_limit

if TYPE_CHECKING:
    from lidar.traffic.signal_heads import SignalStates


@dataclass(frozen=True, slots=True)
class SensorFrame:
    """One frame of one sensor."""

    start_ns: int
    order: int
    frame: int
    sensor: Scanner | Camera = field(compare=False)


@dataclass(frozen=True, slots=True)
class DrivePlan:
    """Immutable plan of a drive: everything that `drive` records, fixed before the first frame.

    scene       : the scene
    options     : the options
    rig         : sensors and their mounts
    sensors     : scanners and cameras of the rig, in its order
    start       : UTC time of the drive's start
    trajectory  : of the ego vehicle
    actors      : other road users; None without traffic
    signals     : what signal heads show in images; None without cameras or heads, and where it is not known
    scanning_ns : (k, 2) times from and until which scanners work; None for always
    geo         : from the scene frame to the export CRS
    jobs        : frames of all sensors in order of time
    """

    scene: Scene
    options: DriveOptions
    rig: Rig
    sensors: tuple[Scanner | Camera, ...]
    start: datetime
    trajectory: Trajectory
    actors: Actors | None
    signals: SignalStates | None
    scanning_ns: Ints | None
    geo: Georeference
    jobs: Sequence[SensorFrame]

    @property
    def max_range(self) -> float:
        """Metres beyond which no sensor measures."""
        return max((s.max_range for s in self.sensors), default=0.0)

    @property
    def length(self) -> float:
        """True metres that the ego vehicle covers."""
        steps = np.diff(self.trajectory.position, axis=0)
        steps[:, :2] /= self.trajectory.scale[1:, None]
        return float(np.linalg.norm(steps, axis=1).sum())

    @property
    def frames(self) -> dict[str, int]:
        """Number of frames, by sensor."""
        return {s.name: s.frame_count(self.trajectory.duration_ns) for s in self.sensors}

    @property
    def limits(self) -> list[Limit]:
        """Errors that no range is corrected for: of lengths at the trajectory's height, and of its origin.

        And surfaces that are missing, where sensors see farther than a scene along a route was built.
        """
        position = self.trajectory.position[:: max(len(self.trajectory) // 1000, 1)]
        settings = self.options.recording_settings.world
        sight = min(self.max_range, settings.reach)
        return [
            *height_limit(position[:, 2]),
            *(origin_limit(position) if settings.origin == "scene" else []),
            *reach_limit(self.scene, position, sight=sight),
        ]

    def recording(self, out: Path) -> Recording:
        """Input of the frame loop for a dataset folder."""
        return Recording(
            out,
            self.scene.frame,
            trajectory=self.trajectory,
            start=self.start,
            geo=self.geo,
            settings=self.options.recording_settings,
            actors=self.actors,
            signals=self.signals,
            max_range=self.max_range,
            scanning_ns=self.scanning_ns,
        )

    def manifest(self) -> dict[str, Any]:
        """Contents of ``dataset.json`` but its counts of points and finished frames."""
        scene, options, frames = self.scene, self.options, self.frames
        manifest = {
            "schema": 1,
            "generator": f"geoscene lidar {__version__}",
            "versions": versions(),
            **scene_provenance(scene),
            "frame": scene.frame.to_json(),
            "export_crs": self.geo.crs.to_wkt(),
            "start_time": self.start.isoformat(),
            "duration_ns": self.trajectory.duration_ns,
            "length_m": round(self.length, 3),
            "rig": self.rig.name,
            "formats": list(options.formats),
            "labels": list(options.labels),
            "deskew": options.deskew,
            "fidelity": options.fidelity,
            "seed": options.seed,
            "frames": next(iter(frames.values()), 0),
            "sensor_frames": frames,
            "classes": {klass.name.lower(): int(klass) for klass in Class},
            "materials": {material.name: material.code for material in materials().values()},
        }
        if self.scanning_ns is not None:
            on = np.clip(self.scanning_ns, 0, self.trajectory.duration_ns)
            manifest["scanners_on_ns"] = on.tolist()
        manifest["limits"] = [limit.to_json() for limit in self.limits]
        return manifest | {"recipe": options.recipe(scene)}


def plan_drive(scene: Scene, options: DriveOptions, *, progress: Progress = silent) -> DrivePlan:
    """The plan of a drive through a scene.

    Raises InputError (also as RouteError, RigError) for what cannot be driven.
    """
    settings = options.recording_settings.world
    check_relief(scene, settings)
    check_device(settings.device)
    start = options.start or solar_start(scene)
    check_start(start, 0)
    rig = load_rig(options.rig)
    sensors = sensors_of(rig, options)
    _check_tolerance(sensors, options)
    if any(isinstance(sensor, Camera) for sensor in sensors):
        scene.require("colors")
    road = options.road_conditions()
    vehicle = vehicle_on(load_vehicle(options.vehicle or rig.vehicle), road)
    motion = plan_motion(scene, options, vehicle=vehicle, sensors=sensors, progress=progress)
    check_duration(motion.trajectory.duration_ns / 1e9, what="the route")
    _refuse_elsewhere(scene, motion.trajectory, sensors=sensors)
    trajectory, actors = _with_traffic(scene, options, vehicle=vehicle, motion=motion, progress=progress)
    check_duration(trajectory.duration_ns / 1e9, what="the route in traffic")
    stages = options.recording_settings.stages
    actors = with_objects(actors, stages, scene=scene, trajectory=trajectory)
    check_start(start, trajectory.duration_ns)
    jobs = schedule(sensors, trajectory.duration_ns)
    if sensors and not jobs:
        raise InputError(f"the drive lasts {trajectory.duration_ns / 1e9:.2f} s, less than one frame")
    last = dict.fromkeys(sensor_kinds(rig), trajectory.duration_ns / 1e9)
    last |= {job.sensor.name: job.start_ns / 1e9 for job in jobs}
    stages.check_start(sensor_kinds(rig), last=last)
    return DrivePlan(
        scene,
        options,
        rig,
        sensors,
        start=start,
        trajectory=trajectory,
        actors=actors,
        signals=_signals(scene, options, vehicle=vehicle, motion=motion, sensors=sensors),
        scanning_ns=motion.scanning_ns,
        geo=Georeference(scene.frame, export_crs(scene.frame, options.crs), exact=options.exact),
        jobs=jobs,
    )


_HIDDEN = 0.1
"""Part of the deviation of range noise below which errors are hidden by it: they add 0.5 % to it."""


@dataclass(frozen=True, slots=True)
class Tolerable:
    """The smallest tolerance of a scanner's ranges whose errors show in its files.

    metres : 0 if ranges have neither noise nor steps
    reason : what hides smaller errors, such as "has range noise of 3 cm"
    """

    metres: float
    reason: str = ""


def least_tolerance(scanner: Scanner, options: DriveOptions) -> Tolerable:
    """The smallest tolerance that the noise and the steps of a scanner, and those of the files, leave."""
    settings, sensor = options.recording_settings.scanner, scanner.sensor
    noise = sensor.range_sigma if settings.range_noise != "none" else 0.0
    step = sensor.range_quantum if settings.quantise else 0.0
    # The format that keeps most decides.
    coarse, name = (
        min((FORMATS[name].step, name) for name in options.formats) if options.formats else (0.0, "")
    )
    limits = (
        Tolerable(_HIDDEN * noise, f"{scanner.name} has range noise of {metres(noise)}"),
        Tolerable(step / 2, f"{scanner.name} has steps of {metres(step)}"),
        Tolerable(coarse / 2, f"files of {name} have steps of {metres(coarse)}"),
    )
    return max(limits, key=lambda limit: limit.metres)


def _check_tolerance(sensors: Sequence[Scanner | Camera], options: DriveOptions) -> None:
    """Raise InputError for a tolerance of ranges below what the noise or the steps of ranges leave of it."""
    asked = options.recording_settings.scanner.footprint
    for scanner in (one for one in sensors if isinstance(one, Scanner)):
        least = least_tolerance(scanner, options)
        if 0 < asked < least.metres:
            raise InputError(
                f"`settings` footprint={asked:g}: {least.reason}, in which errors below"
                f" {metres(least.metres)} do not show; give at least that"
            )


def _refuse_elsewhere(scene: Scene, trajectory: Trajectory, *, sensors: Sequence[Scanner | Camera]) -> None:
    """Raise RouteError for a motion from which no sensor ever reaches the scene."""
    sight = max((sensor.max_range for sensor in sensors), default=0.0)
    xmin, ymin, xmax, ymax = scene.bounds
    xy = trajectory.position[:, :2]
    nearest = float(np.hypot(*(xy - np.clip(xy, [xmin, ymin], [xmax, ymax])).T).min())
    if nearest > sight:
        raise RouteError(
            f"the route comes no closer than {nearest:,.0f} m to {scene.path}, and the sensors see up to"
            f" {sight:g} m; give a route through the scene, or the scene of the route"
        )


def reach_limit(scene: Scene, position: Float, *, sight: float) -> list[Limit]:
    """The limit of what sensors at places (n, 3) see of a scene that was built along a route.

    sight : metres, range of the sensors
    """
    if scene.route is None:
        return []
    reach = float(scene.manifest["options"]["reach"])
    off = float(shapely.distance(scene.route, shapely.points(position[:, :2])).max())
    needed = sight + max(off - OFFSET, 0.0)
    if needed <= reach:
        return []
    where = f" at up to {off:,.0f} m from that route" if off > OFFSET else ""
    advice = (
        f"the scene was built along a route for ranges of {reach:g} m; sensors of this drive see up to"
        f" {sight:g} m{where}, so surfaces that far away may be missing: build the scene with a reach of"
        f" {needed:.0f} m or as a whole"
    )
    return [Limit("reach", round(needed, 1), reach, "m", advice)]


def solar_start(scene: Scene) -> datetime:
    """10:00 mean solar time on 21 June 2026 in a scene's centre, to the minute, in UTC."""
    xmin, ymin, xmax, ymax = scene.bounds
    lon_deg, _ = scene.frame.to_geographic((xmin + xmax) / 2, (ymin + ymax) / 2)
    return datetime(2026, 6, 21, 10, tzinfo=UTC) - timedelta(minutes=round(float(lon_deg) * 4))


def sensors_of(rig: Rig, options: DriveOptions) -> tuple[Scanner | Camera, ...]:
    """Scanners and cameras of a rig; raises InputError if it has no sensors, or stages on unknown ones."""
    sensors: tuple[Scanner | Camera, ...] = (*scanners(rig), *cameras(rig))
    if not sensors and not rig.gnss:
        raise InputError(f"rig {rig.name} has no sensors")
    stages = options.recording_settings.stages
    known = {POSES: True, ROAD_USERS: options.traffic is not None}
    known[LABELS] = known[ROAD_USERS] or bool(stages.at("scene", "scene"))
    stages.check({**sensor_kinds(rig), "scene": "scene"}, known=[need for need, has in known.items() if has])
    return sensors


def schedule(sensors: Sequence[Scanner | Camera], duration_ns: int) -> list[SensorFrame]:
    """Frames of all sensors that end within ``duration_ns``, in order of time."""
    frames = [
        SensorFrame(sensor.frame_start_ns(frame), order, frame, sensor)
        for order, sensor in enumerate(sensors)
        for frame in range(sensor.frame_count(duration_ns))
    ]
    return sorted(frames, key=attrgetter("start_ns", "order", "frame"))


@dataclass(frozen=True, slots=True)
class PlannedMotion:
    """Motion of the ego vehicle without other road users.

    trajectory  : of the vehicle
    road        : its route and path on roads; None for flights and repeated trajectories
    scanning_ns : (k, 2) times from and until which scanners work; None for always
    """

    trajectory: Trajectory
    road: RoadPlan | None = None
    scanning_ns: Ints | None = None


def plan_motion(
    scene: Scene,
    options: DriveOptions,
    *,
    vehicle: Vehicle,
    sensors: Sequence[Scanner | Camera],
    progress: Progress = silent,
) -> PlannedMotion:
    """Motion of the ego vehicle alone.

    Raises RouteError for a route that it cannot take.
    """
    route = options.route or "random"
    if isinstance(route, Path) and route.suffix == ".csv" and not options.survey:
        from lidar.motion.replay import read_replay  # noqa: PLC0415

        replayed = read_replay(route, scene.frame)
        return PlannedMotion(
            replayed if options.duration is None else replayed.until(round(options.duration * 1e9))
        )
    if vehicle.kind != "air":
        options.check_on_roads(vehicle.name)
        on_roads = road_drive_options(options, scene)
        planned = plan_road_drive(scene, route, options=on_roads, progress=progress)
        trajectory = drive_with_signals(
            planned.path,
            vehicle,
            graph=planned.graph,
            seed=options.seed,
            side=options.side_in(scene),
            bounds=scene.bounds,
            duration=planned.duration,
            at_speed=planned.at_speed,
            road=options.road_conditions(),
        )
        if planned.duration is not None:  # what cannot pull up within a short time is recorded until then
            trajectory = trajectory.until(round(planned.duration * 1e9))
        return PlannedMotion(trajectory, planned)
    from lidar.simulation.flight_planning import plan_flight  # noqa: PLC0415

    progress("planning", 0, total=0)
    trajectory, scanning_ns = plan_flight(scene, vehicle=vehicle, sensors=sensors, options=options)
    return PlannedMotion(trajectory, scanning_ns=scanning_ns)


def road_drive_options(options: DriveOptions, scene: Scene | RoadMap) -> RoadDriveOptions:
    """Options of the drive on roads, from those of a drive."""
    return RoadDriveOptions(
        options.vehicle or load_rig(options.rig).vehicle,
        seed=options.seed,
        duration=options.duration,
        side=options.side_in(scene),
        from_rest=options.from_rest,
    )


def _signals(
    scene: Scene,
    options: DriveOptions,
    *,
    vehicle: Vehicle,
    motion: PlannedMotion,
    sensors: Sequence[Scanner | Camera],
) -> SignalStates | None:
    """States of signal heads by the plan that traffic obeys; None if no image shows them.

    Traffic of SUMO has signals of its own, whose states are not known.
    """
    traffic = options.traffic
    if not any(isinstance(sensor, Camera) and "rgb" in sensor.spec.images for sensor in sensors):
        return None
    from lidar.traffic.signal_heads import signal_states  # noqa: PLC0415  (not without cameras)

    if isinstance(traffic, TrafficFile):
        return None
    obeys = motion.road is not None or (traffic is None and vehicle.kind == "air")
    return signal_states(
        scene,
        None if motion.road is None else motion.road.graph,
        seed=options.seed,
        side=options.side_in(scene),
        vehicle=vehicle,
        fixed=None if obeys else motion.trajectory,
    )


def _with_traffic(
    scene: Scene,
    options: DriveOptions,
    *,
    vehicle: Vehicle,
    motion: PlannedMotion,
    progress: Progress,
) -> tuple[Trajectory, Actors | None]:
    """Trajectory of the ego vehicle among other road users, and these; None without traffic."""
    trajectory = motion.trajectory
    if options.traffic is None:
        return trajectory, None
    from lidar.traffic.fcd_replay import replay  # noqa: PLC0415  (0.1 s)
    from lidar.traffic.populate import populate  # noqa: PLC0415

    progress("traffic", 0, total=0)
    traffic = replace(options.traffic, side=options.side_in(scene))
    graph = scene.road_graph() if motion.road is None else motion.road.graph
    seed, road = options.seed, options.road_conditions()
    if isinstance(traffic, TrafficFile):
        return trajectory, replay(scene, graph, ego=trajectory, vehicle=vehicle, seed=seed, options=traffic)
    if motion.road is not None:
        return drive_in_traffic(
            scene, motion.road, vehicle=vehicle, first=trajectory, seed=seed, options=traffic, road=road
        )
    return trajectory, populate(
        scene, graph, ego=trajectory, vehicle=vehicle, seed=seed, options=traffic, road=road
    )

"""The drive: a vehicle follows a route through a scene and its sensors record a dataset."""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.errors import GeosceneError
from geoscene.files import write_json
from geoscene.progress import Progress, silent
from geoscene.scene import Scene
from geoscene.typing import Float
from lidar import __version__
from lidar.dataset.boxes import merge_box_files
from lidar.dataset.layout import Paths, prepare
from lidar.dataset.metadata import write_metadata
from lidar.dataset.record import record_frame
from lidar.dataset.recording import Recording
from lidar.errors import InputError, LidarError
from lidar.geometry.georeference import Georeference, export_crs
from lidar.geometry.poses import Trajectory
from lidar.geometry.trajectory_csv import write_trajectory
from lidar.options import DriveOptions
from lidar.planning.flight import Flight
from lidar.planning.road_drive import RoadPlan, plan_road_drive
from lidar.rig.devices import Camera, Scanner, cameras, scanners
from lidar.rig.specs import Rig, load_rig
from lidar.rig.vehicle import Vehicle, load_vehicle
from lidar.traffic.ego_drive import drive_in_traffic, drive_with_signals
from lidar.traffic.fcd import TrafficFile
from lidar.traffic.fcd_replay import replay
from lidar.traffic.populate import populate
from lidar.traffic.sumo import SumoOptions, drive_in_sumo
from lidar.world.actors import Actors
from lidar.world.thread_worlds import Worlds

_RANDOM_SECONDS = 60.0
_CHUNK = (
    200.0  # scene metres along each axis that a drive may cover before the world around it is moved along
)


@dataclass(frozen=True, slots=True)
class DriveSummary:
    """What a drive made.

    path      : the dataset
    frames    : frames of the first sensor
    resumed   : frames of all sensors that were there already
    points    : returns of each scanner, those that were there already among them
    written   : returns written now
    duration  : seconds of simulated time
    length    : true metres driven
    wall      : seconds it took
    stages    : seconds of all threads by stage
    """

    path: Path
    frames: int
    resumed: int
    points: dict[str, int]
    written: int
    duration: float
    length: float
    wall: float
    stages: dict[str, float]


def solar_start(lon_deg: float) -> datetime:
    """10:00 mean solar time on 21 June 2026 at a longitude, to the minute, in UTC."""
    return datetime(2026, 6, 21, 10, tzinfo=UTC) - timedelta(minutes=round(lon_deg * 4))


class Stopwatch:
    """Seconds by stage, summed over threads."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._lock = threading.Lock()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time until the block ends to a stage."""
        began = time.perf_counter()
        try:
            yield
        finally:
            spent = time.perf_counter() - began
            with self._lock:
                self.seconds[name] = self.seconds.get(name, 0.0) + spent


@dataclass(frozen=True, slots=True)
class RoadDrive:
    """A drive on roads: its path, and its trajectory without other road users."""

    travel: RoadPlan
    trajectory: Trajectory


@dataclass(frozen=True, slots=True)
class Job:
    """One frame of one sensor."""

    start_ns: int
    order: int
    frame: int
    sensor: Scanner | Camera = field(compare=False)


def drive(
    scene: Scene, out: Path, *, options: DriveOptions, overwrite: bool = False, progress: Progress = silent
) -> DriveSummary:
    """Drive a route through a scene and write the dataset; an unfinished one of the same options is finished.

    Raises InputError (also as RouteError, RigError, DatasetError) for what cannot be driven or written.
    """
    began = time.perf_counter()
    rig = load_rig(options.rig)
    lon, _ = scene.frame.to_geographic(*_centre(scene.bounds))
    start = options.start or solar_start(float(lon))
    sensors: list[Scanner | Camera] = [*scanners(rig), *cameras(rig)]
    if not sensors and not rig.gnss:
        raise InputError(f"rig {rig.name} has no sensors")
    options.contents().stages.check(
        {s.name: "lidar" if isinstance(s, Scanner) else "camera" for s in sensors}
    )
    body = load_vehicle(options.vehicle or rig.vehicle)
    planned = plan(scene, options, body=body, sensors=sensors, progress=progress)
    trajectory = planned if isinstance(planned, Trajectory) else planned.trajectory
    on = planned.on if isinstance(planned, Flight) else None
    actors = None
    if options.traffic is not None:
        progress("traffic", 0, total=0)
        traffic = replace(options.traffic, side=options.side_in(scene))
        graph = scene.road_graph()
        if isinstance(traffic, TrafficFile):
            actors = replay(scene, graph, ego=trajectory, vehicle=body, seed=options.seed, options=traffic)
        elif isinstance(planned, RoadDrive):
            simulate = drive_in_sumo if isinstance(traffic, SumoOptions) else drive_in_traffic
            trajectory, actors = simulate(
                scene,
                graph,
                path=planned.travel.path,
                vehicle=body,
                first=trajectory,
                seed=options.seed,
                options=traffic,
                duration=planned.travel.duration,
                under_way=planned.travel.under_way,
            )
        elif isinstance(traffic, SumoOptions):
            raise InputError("traffic: SUMO needs a drive along a route on roads")
        else:
            actors = populate(scene, graph, ego=trajectory, vehicle=body, seed=options.seed, options=traffic)
    geo = Georeference(scene.frame, export_crs(scene.frame, options.crs), exact=options.exact)
    jobs = schedule(sensors, trajectory.duration_ns)
    if sensors and not jobs:
        raise InputError(f"the drive lasts {trajectory.duration_ns / 1e9:.2f} s, less than one frame")

    recipe = options.recipe(scene)
    prepare(out, recipe, overwrite=overwrite)
    length = _length(trajectory)
    manifest = _manifest(
        scene,
        rig,
        options=options,
        start=start,
        geo=geo,
        trajectory=trajectory,
        length=length,
        jobs=jobs,
        sensors=sensors,
    )
    if on is not None:
        manifest["scanners_on_ns"] = np.clip(on, 0, trajectory.duration_ns).tolist()
    manifest["recipe"] = recipe
    with _nothing_half_made(out):
        if not Paths(out).manifest.exists():
            write_json(Paths(out).manifest, manifest | {"frames_done": 0})
        write_trajectory(Paths(out).trajectory, trajectory)
        counts = manifest["sensor_frames"]
        write_metadata(
            out,
            scene,
            rig=rig,
            sensors=sensors,
            trajectory=trajectory,
            start=start,
            frames=counts,
            contents=options.contents(),
        )
        watch = Stopwatch()
        recording = Recording(
            out,
            scene.frame,
            trajectory=trajectory,
            start=start,
            geo=geo,
            contents=options.contents(),
            watch=watch,
            actors=actors,
            max_range=max((s.reach for s in sensors), default=0.0),
            scanning_ns=on,
        )
        there = [job for job in jobs if recording.is_done(job.sensor, job.frame)]
        points = dict.fromkeys((s.name for s in sensors if isinstance(s, Scanner)), 0)
        for job in there:
            if job.sensor.name in points:
                points[job.sensor.name] += recording.count(job.sensor, job.frame)
        written = record_all(
            scene,
            trajectory,
            jobs=jobs,
            sensors=sensors,
            recording=recording,
            actors=actors,
            workers=options.workers,
            progress=progress,
        )
        points = {name: n + written.get(name, 0) for name, n in points.items()}
        if actors is not None:
            merge_box_files(out)
        write_json(Paths(out).manifest, manifest | {"points": points, "frames_done": manifest["frames"]})
    return DriveSummary(
        out,
        int(manifest["frames"]),
        len(there),
        points,
        sum(written.values()),
        trajectory.duration_ns / 1e9,
        length,
        time.perf_counter() - began,
        watch.seconds,
    )


@contextmanager
def _nothing_half_made(out: Path) -> Iterator[None]:
    """Remove a dataset that was begun here if an error ends the drive before any frame is recorded."""
    begun = not Paths(out).manifest.exists()
    try:
        yield
    except (GeosceneError, LidarError):
        if begun and not any(out.glob("*/*/*")):
            shutil.rmtree(out)
        raise


def plan(
    scene: Scene,
    options: DriveOptions,
    *,
    body: Vehicle,
    sensors: Sequence[Scanner | Camera],
    progress: Progress = silent,
) -> Trajectory | RoadDrive | Flight:
    """Where the vehicle of a drive is over time; on streets with its path, in flight with when it scans.

    Raises RouteError for a route that it cannot take.
    """
    from lidar.planning.flight_planning import FlightOptions, plan_flight  # noqa: PLC0415
    from lidar.planning.replay import read_replay  # noqa: PLC0415

    route = options.route or "random"
    if isinstance(route, Path) and route.suffix == ".csv" and not options.survey:
        replayed = read_replay(route, scene.frame)
        return replayed if options.duration is None else replayed.until(round(options.duration * 1e9))
    if body.kind != "air":
        if options.survey or options.altitude is not None:
            option = "survey" if options.survey else "altitude"
            raise InputError(
                f"`{option}` is for aircraft, and a {body.name} does not fly; set `vehicle` to drone or"
                " aircraft, or take the rig of one"
            )
        name = options.vehicle or load_rig(options.rig).vehicle
        travel = plan_road_drive(
            scene,
            route,
            vehicle=name,
            seed=options.seed,
            duration=options.duration,
            side=options.side_in(scene),
            from_rest=options.from_rest,
            progress=progress,
        )
        trajectory = drive_with_signals(
            travel.path,
            body,
            graph=scene.road_graph(),
            seed=options.seed,
            side=options.side_in(scene),
            bounds=scene.bounds,
            duration=travel.duration,
            under_way=travel.under_way,
        )
        if travel.duration is not None:  # what cannot pull up within a short time is recorded until then
            trajectory = trajectory.until(round(travel.duration * 1e9))
        return RoadDrive(travel, trajectory)
    progress("planning", 0, total=0)
    seconds = options.duration
    if seconds is None and route == "random" and not options.survey:
        seconds = _RANDOM_SECONDS
    return plan_flight(
        scene,
        route,
        vehicle=body,
        sensors=sensors,
        options=FlightOptions(
            survey=options.survey,
            altitude=options.altitude,
            overlap=options.overlap,
            turns=options.turns,
            seed=options.seed,
            duration=seconds,
            from_rest=options.from_rest,
        ),
    )


def _length(trajectory: Trajectory) -> float:
    """True metres that a trajectory covers."""
    steps = np.diff(trajectory.position, axis=0)
    steps[:, :2] /= trajectory.scale[1:, None]
    return float(np.linalg.norm(steps, axis=1).sum())


def _centre(bounds: tuple[float, float, float, float]) -> tuple[float, float]:
    return (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2


def schedule(sensors: Sequence[Scanner | Camera], duration_ns: int) -> list[Job]:
    """All frames of all sensors that end within a drive of that length, in order of time."""
    jobs = [
        Job(sensor.frame_start_ns(k), i, k, sensor)
        for i, sensor in enumerate(sensors)
        for k in range(sensor.frame_count(duration_ns))
    ]
    return sorted(jobs, key=lambda job: (job.start_ns, job.order, job.frame))


def _manifest(
    scene: Scene,
    rig: Rig,
    *,
    options: DriveOptions,
    start: datetime,
    geo: Georeference,
    trajectory: Trajectory,
    length: float,
    jobs: Sequence[Job],
    sensors: Sequence[Scanner | Camera],
) -> dict[str, Any]:
    frames = dict.fromkeys((s.name for s in sensors), 0)
    for job in jobs:
        frames[job.sensor.name] += 1
    return {
        "schema": 1,
        "generator": f"geoscene lidar {__version__}",
        "scene": {"name": scene.manifest.get("name", ""), "path": str(scene.path)},
        "attribution": scene.manifest.get("attribution", ""),
        "frame": scene.frame.to_json(),
        "export_crs": geo.crs.to_wkt(),
        "start_time": start.isoformat(),
        "duration_ns": trajectory.duration_ns,
        "length_m": round(length, 3),
        "rig": rig.name,
        "formats": list(options.formats),
        "labels": list(options.labels),
        "deskew": options.deskew,
        "fidelity": options.fidelity,
        "seed": options.seed,
        "frames": next(iter(frames.values()), 0),
        "sensor_frames": frames,
    }


def record_all(
    scene: Scene,
    trajectory: Trajectory,
    *,
    jobs: Sequence[Job],
    sensors: Sequence[Scanner | Camera],
    recording: Recording,
    actors: Actors | None = None,
    workers: int = 1,
    progress: Progress = silent,
) -> dict[str, int]:
    """Do all jobs that are not done yet, chunk by chunk of the route; the points written, by sensor."""
    pending = [job for job in jobs if not recording.is_done(job.sensor, job.frame)]
    progress("driving", len(jobs) - len(pending), total=len(jobs))
    reach = max((s.reach for s in sensors), default=0.0)
    worlds = Worlds(scene, reach, actors=actors)
    points: dict[str, int] = {}
    done = len(jobs) - len(pending)
    workers = min(workers, os.cpu_count() or 1)  # more than cores would only wait for one another
    with ThreadPoolExecutor(workers) as pool:
        for chunk, region in _chunks(pending, trajectory):
            with recording.watch.stage("load"):
                worlds.follow(region)
            running: dict[Future[int], str] = {}
            for job in chunk:
                future = pool.submit(record_frame, recording, job.sensor, frame=job.frame, worlds=worlds)
                running[future] = job.sensor.name
                if len(running) >= 2 * workers:
                    done += _take(running, points, finished=wait(running, return_when=FIRST_COMPLETED).done)
                    progress("driving", done, total=len(jobs))
            done += _take(running, points, finished=wait(running).done)
            progress("driving", done, total=len(jobs))
    return points


def _take(running: dict[Future[int], str], points: dict[str, int], *, finished: set[Future[int]]) -> int:
    """Move finished frames from ``running`` to the sums of points; return how many there were."""
    for future in finished:
        name = running.pop(future)
        points[name] = points.get(name, 0) + future.result()
    return len(finished)


def _chunks(
    jobs: Sequence[Job], trajectory: Trajectory
) -> Iterator[tuple[list[Job], tuple[float, float, float, float]]]:
    """Runs of jobs during which the vehicle stays within a square of `_CHUNK`, with the box it covers."""
    chunk: list[Job] = []
    low = high = np.zeros(2)
    for job in jobs:
        span = np.linspace(job.start_ns, job.start_ns + job.sensor.period_ns, 5).astype(np.int64)
        xy = trajectory.at(span).position[:, :2]
        new_low, new_high = xy.min(axis=0), xy.max(axis=0)
        if chunk:
            new_low, new_high = np.minimum(low, new_low), np.maximum(high, new_high)
            if (new_high - new_low).max() > _CHUNK:
                yield chunk, _box(low, high)
                chunk = []
                new_low, new_high = xy.min(axis=0), xy.max(axis=0)
        chunk.append(job)
        low, high = new_low, new_high
    if chunk:
        yield chunk, _box(low, high)


def _box(low: Float, high: Float) -> tuple[float, float, float, float]:
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])

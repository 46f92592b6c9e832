"""The drive: a vehicle follows a route through a scene and its sensors record a dataset."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from geoscene.progress import Progress, silent
from geoscene.scene import Scene
from lidar import __version__
from lidar.actors import Actors, TrafficOptions, populate
from lidar.crowd import Worlds
from lidar.dataset import prepare, write_json, write_trajectory
from lidar.errors import InputError
from lidar.georeference import Georeference, export_crs
from lidar.physics.effects import effects_of
from lidar.poses import Trajectory
from lidar.record import FORMATS, Camera, Recorder, Scanner, cameras, scanners
from lidar.rig import Rig, load_rig
from lidar.route import Spec
from lidar.sidecars import gather_boxes, write_sidecars
from lidar.travel import Travel, plan_travel, road_graph
from lidar.vehicle import load_vehicle

Float = NDArray[np.float64]

_CHUNK = (
    200.0  # scene metres along each axis that a drive may cover before the world around it is moved along
)


@dataclass(frozen=True, slots=True)
class DriveOptions:
    """How a drive is made. Everything here is stored in the dataset and shapes its bytes, but ``workers``.

    route      : ``random``, a GPX or GeoJSON file, or waypoints (latitude, longitude) in degrees
    duration   : seconds; a whole route, or 60 seconds of a random one, by default
    rig        : name of a rig, or a TOML file
    vehicle    : name of a vehicle, or a TOML file; the rig's by default
    formats    : of clouds, of `FORMATS`
    seed       : of everything random
    start      : UTC time of the drive's start; 10:00 local solar time on 21 June 2026 by default
    crs        : of LAZ files: ``utm``, ``scene`` or any pyproj name
    exact      : georeference every point through the projection instead of a bounded affine map
    side       : side of the road
    fidelity   : level of `lidar.physics.effects.LEVELS`: draft, standard or survey
    traffic    : other road users and parked cars; none by default
    settings   : single effects set apart from the level, as (name, text)
    workers    : threads
    """

    route: Spec = "random"
    duration: float | None = None
    rig: str = "seed"
    vehicle: str = ""
    formats: tuple[str, ...] = ("pcd", "laz")
    seed: int = 0
    start: datetime | None = None
    crs: str = "utm"
    exact: bool = False
    side: str = "right"
    fidelity: str = "standard"
    traffic: TrafficOptions | None = None
    settings: tuple[tuple[str, str], ...] = ()
    workers: int = 2

    def __post_init__(self) -> None:
        """Refuse options that cannot be meant."""
        if not self.formats:
            raise InputError(f"--format: give one or more of {','.join(FORMATS)}")
        if unknown := sorted(set(self.formats) - set(FORMATS)):
            raise InputError(f"--format {','.join(unknown)}: one or more of {','.join(FORMATS)}")
        if self.duration is not None and not 0.1 <= self.duration <= 86400:
            raise InputError(f"--duration {self.duration}: give 0.1 to 86400 seconds")
        if self.side not in ("left", "right"):
            raise InputError(f"--side {self.side}: left or right")
        if not 1 <= self.workers <= 256:
            raise InputError(f"--workers {self.workers}: give 1 to 256")
        effects_of(self.fidelity, dict(self.settings))

    def recipe(self, scene: Scene) -> dict[str, Any]:
        """What the dataset's bytes depend on, as JSON."""
        return {
            "scene": scene.manifest.get("fingerprint", scene.path.name),
            "route": str(self.route)
            if isinstance(self.route, str | Path)
            else [list(point) for point in self.route],
            "duration": self.duration,
            "rig": self.rig,
            "vehicle": self.vehicle,
            "formats": list(self.formats),
            "seed": self.seed,
            "start": self.start.isoformat() if self.start else None,
            "crs": self.crs,
            "exact": self.exact,
            "side": self.side,
            "fidelity": self.fidelity,
            "traffic": asdict(self.traffic) if self.traffic else None,
            "settings": [list(pair) for pair in self.settings],
        }


@dataclass(frozen=True, slots=True)
class DriveSummary:
    """What a drive made.

    path      : the dataset
    frames    : frames of the first sensor
    resumed   : frames that were there already
    points    : returns written now
    duration  : seconds of simulated time
    length    : true metres driven
    wall      : seconds it took
    stages    : seconds of all threads by stage
    """

    path: Path
    frames: int
    resumed: int
    points: int
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
class Job:
    """One frame of one sensor."""

    start_ns: int
    order: int
    frame: int
    sensor: Scanner | Camera = field(compare=False)


def drive(
    scene: Scene, out: Path, options: DriveOptions, *, overwrite: bool = False, progress: Progress = silent
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
    travel = plan_travel(scene, options.route, options.vehicle or rig.vehicle, seed=options.seed,
                         duration=options.duration, side=options.side, progress=progress)  # fmt: skip
    trajectory = travel.trajectory
    actors = None
    if options.traffic is not None:
        progress("traffic", 0, 0)
        body = load_vehicle(options.vehicle or rig.vehicle)
        traffic = replace(options.traffic, side=cast("Literal['left', 'right']", options.side))
        actors = populate(scene, road_graph(scene), trajectory, body, seed=options.seed, options=traffic)
    geo = Georeference(scene.frame, export_crs(scene.frame, options.crs), exact=options.exact)
    jobs = schedule(sensors, trajectory.duration_ns)
    if sensors and not jobs:
        raise InputError(f"the drive lasts {trajectory.duration_ns / 1e9:.2f} s, less than one frame")

    recipe = options.recipe(scene)
    done = prepare(out, recipe, overwrite=overwrite)
    manifest = _manifest(scene, rig, options, start, geo, travel, sensors, jobs) | {"recipe": recipe}
    if not (out / "dataset.json").exists():
        write_json(out / "dataset.json", manifest | {"frames_done": 0})
    write_trajectory(out / "trajectory.csv", trajectory)
    counts = manifest["sensor_frames"]
    write_sidecars(out, scene, rig, sensors, trajectory, start, counts, seed=options.seed)
    watch = Stopwatch()
    recorder = Recorder(
        out,
        scene.frame,
        trajectory,
        start,
        geo,
        options.formats,
        options.seed,
        effects_of(options.fidelity, dict(options.settings)),
        watch,
        actors=actors,
        reach=max((s.reach for s in sensors), default=0.0),
    )
    points = record_all(
        scene,
        trajectory,
        jobs,
        sensors,
        recorder,
        actors=actors,
        workers=options.workers,
        progress=progress,
    )
    if actors is not None:
        gather_boxes(out)
    write_json(out / "dataset.json", manifest | {"frames_done": manifest["frames"]})
    return DriveSummary(
        out,
        int(manifest["frames"]),
        done,
        points,
        trajectory.duration_ns / 1e9,
        travel.length,
        time.perf_counter() - began,
        watch.seconds,
    )


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
    options: DriveOptions,
    start: datetime,
    geo: Georeference,
    travel: Travel,
    sensors: Sequence[Scanner | Camera],
    jobs: Sequence[Job],
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
        "duration_ns": travel.trajectory.duration_ns,
        "length_m": round(travel.length, 3),
        "rig": rig.name,
        "formats": list(options.formats),
        "seed": options.seed,
        "frames": next(iter(frames.values()), 0),
        "sensor_frames": frames,
    }


def record_all(
    scene: Scene,
    trajectory: Trajectory,
    jobs: Sequence[Job],
    sensors: Sequence[Scanner | Camera],
    recorder: Recorder,
    *,
    actors: Actors | None = None,
    workers: int = 1,
    progress: Progress = silent,
) -> int:
    """Do all jobs that are not done yet, chunk by chunk of the route; return the number of points written."""
    pending = [job for job in jobs if not recorder.is_done(job.sensor, job.frame)]
    progress("driving", len(jobs) - len(pending), len(jobs))
    reach = max((s.reach for s in sensors), default=0.0)
    worlds = Worlds(scene, reach, actors)
    points = 0
    done = len(jobs) - len(pending)
    with ThreadPoolExecutor(workers) as pool:
        for chunk, region in _chunks(pending, trajectory):
            with recorder.watch.stage("load"):
                worlds.follow(region)
            running: set[Future[int]] = set()
            for job in chunk:
                running.add(pool.submit(recorder.record, job.sensor, job.frame, worlds))
                if len(running) >= 2 * workers:
                    finished, running = wait(running, return_when=FIRST_COMPLETED)
                    points += sum(f.result() for f in finished)
                    done += len(finished)
                    progress("driving", done, len(jobs))
            finished, running = wait(running)
            points += sum(f.result() for f in finished)
            done += len(finished)
            progress("driving", done, len(jobs))
    return points


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

"""Stored profiles: error and cost of numbers of rays, for a scene, a rig and settings on a machine.

Errors are measured on random drives through the scene, so that one profile holds for all routes in it.
Such drives do not stand for flights, repeated trajectories and road users of SUMO, and may leave the area
that was built along routes: there, and where none is possible, errors are measured on the drive itself.
"""

from __future__ import annotations

import json
import logging
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.errors import reading
from geoscene.files import digest, write_json
from geoscene.progress import Progress, silent
from geoscene.scene import Scene
from geoscene.typing import Float
from lidar import __version__
from lidar.dataset.record import record_frame
from lidar.errors import InputError
from lidar.options import PERCENTS, DriveOptions
from lidar.plan import DrivePlan, plan_drive, sensors_of
from lidar.rig.devices import Camera, Scanner
from lidar.rig.scanner import firings
from lidar.rig.specs import load_rig
from lidar.rig.vehicle import load_vehicle
from lidar.selftest.run import machine
from lidar.tradeoff.errors import Estimate, median
from lidar.tradeoff.sampling import REFERENCE_RAYS, RangeError, SampledError, errors_of, places, range_error
from lidar.tradeoff.simulate import spread_frames, swept
from lidar.traffic.fcd import TrafficFile
from lidar.traffic.sumo import SumoOptions
from lidar.world.thread_worlds import Worlds

log = logging.getLogger(__name__)

RAYS = (1, 7, 13, 19, 37, 61, 91, 127, 169, 217, 331, 499, 665)
"""Numbers of rays per pulse to choose from, the cheapest first.

Poses, precision and the second trace are none of the choice, as they save a few percent at most.
"""

_SCHEMA = 1
_DRIVES, _SECONDS, _FRAMES = 12, 8.0, 2
"""Random drives through the scene, seconds of each, and frames of each."""

_TIMINGS = 3
"""Frames of each sensor that are timed."""

_BLOCKS, _BLOCK_PULSES = 8, 4000
"""Runs of pulses of a frame that are timed with several rays, and their total, or a 16th of the frame."""

_OF_THE_COURSE = ("route", "duration", "from_rest", "survey", "altitude", "overlap", "turns", "seed", "start")
"""Options of a drive on which a profile of random drives does not depend."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A number of rays per pulse.

    errors : of each scanner, by its name
    cpu_s  : CPU seconds per simulated second to record all sensors of the rig
    """

    rays: int
    errors: dict[str, RangeError]
    cpu_s: Estimate


@dataclass(frozen=True, slots=True)
class Profile:
    """Candidates in ascending order of rays, hence of cost.

    path   : of its file
    frames : of each scanner in which errors were measured
    made   : whether it was measured now, not read
    """

    path: Path
    candidates: tuple[Candidate, ...]
    frames: int
    made: bool = False


def default_folder() -> Path:
    """Folder of profiles."""
    return Path.home() / ".cache" / "geoscene" / "profiles"


def profile_of(
    scene: Scene, options: DriveOptions, *, folder: Path | None = None, progress: Progress = silent
) -> Profile:
    """The stored profile of a drive's scene, rig and settings on this machine; measured if there is none.

    folder : of profiles; `default_folder` by default

    Raises InputError (also as RouteError, RigError) for what cannot be driven, and for rigs without scanners.
    """
    folder = folder or default_folder()
    if not any(isinstance(s, Scanner) for s in sensors_of(load_rig(options.rig), options)):
        raise InputError(f"`rig` {options.rig}: has no scanner, whose errors could be measured")
    bare = replace(options, settings=(*options.settings, ("rays", "1")))
    if scene.area is None and _stands_for(options):
        key = _key(scene, options, own_course=False)
        if stored := _read(folder, key):
            return stored
        try:
            plans = [_random_plan(scene, bare, seed=k, progress=progress) for k in range(_DRIVES)]
        except InputError:  # no room for a drive of this length
            plans = []
        if plans:
            return _measured(folder, key, plans=plans, frames=_FRAMES, progress=progress)
    key = _key(scene, options, own_course=True)
    if stored := _read(folder, key):
        return stored
    plan = plan_drive(scene, bare, progress=progress)
    return _measured(folder, key, plans=[plan], frames=_DRIVES * _FRAMES, progress=progress)


def _stands_for(options: DriveOptions) -> bool:
    """Whether random drives on the scene's roads stand for a drive."""
    vehicle = load_vehicle(options.vehicle or load_rig(options.rig).vehicle)
    repeated = isinstance(options.route, Path) and options.route.suffix == ".csv"
    simulated = isinstance(options.traffic, SumoOptions | TrafficFile)
    return not (options.survey or vehicle.kind == "air" or repeated or simulated)


def _random_plan(scene: Scene, options: DriveOptions, *, seed: int, progress: Progress) -> DrivePlan:
    """A random drive with the sensors, vehicle and traffic of another."""
    course: dict[str, Any] = {"route": "random", "duration": _SECONDS, "from_rest": False, "seed": seed}
    return plan_drive(scene, replace(options, **course), progress=progress)


def _key(scene: Scene, options: DriveOptions, *, own_course: bool) -> dict[str, Any]:
    """All that a profile depends on."""
    recipe = options.recipe(scene)
    if not own_course:
        recipe = {name: value for name, value in recipe.items() if name not in _OF_THE_COURSE}
    host = {name: text for name, text in machine().items() if name in ("processor", "system")}
    document = {"schema": _SCHEMA, "version": __version__, "machine": host | {"cores": os.cpu_count()}}
    plain: dict[str, Any] = json.loads(json.dumps(document | {"drive": recipe}, default=str))
    return plain


def _path(folder: Path, key: dict[str, Any]) -> Path:
    return folder / f"{digest(json.dumps(key, sort_keys=True).encode())}.json"


def _read(folder: Path, key: dict[str, Any]) -> Profile | None:
    """A stored profile; None if there is none that can be read."""
    path = _path(folder, key)
    if not path.exists():
        return None
    try:
        with reading(path, InputError, remedy="it is made again"):
            return _profile(path, json.loads(path.read_text("utf-8")))
    except InputError as error:
        log.warning("%s", error)
        return None


def _profile(path: Path, document: dict[str, Any]) -> Profile:
    """The profile of a document."""
    candidates = tuple(
        Candidate(
            int(row["rays"]),
            {name: _range_error(error) for name, error in row["errors"].items()},
            _estimate(row["cpu_s"]),
        )
        for row in document["candidates"]
    )
    if [c.rays for c in candidates] != list(RAYS):
        raise ValueError("other numbers of rays")
    return Profile(path, candidates, int(document["frames"]))


def _range_error(document: dict[str, Any]) -> RangeError:
    quantiles = {percent: _estimate(document[f"range_{percent:g}_m"]) for percent in PERCENTS}
    return RangeError(quantiles, missed=_estimate(document["missed"]), extra=_estimate(document["extra"]))


def _estimate(figures: dict[str, float]) -> Estimate:
    return Estimate(float(figures["value"]), float(figures["low"]), float(figures["high"]))


def _measured(
    folder: Path, key: dict[str, Any], *, plans: Sequence[DrivePlan], frames: int, progress: Progress
) -> Profile:
    """A profile of drives, measured and stored."""
    began = time.perf_counter()
    errors, count = _errors(plans, frames=frames, progress=progress)
    costs = _costs(plans, progress=progress)
    document = {
        "key": key,
        "reference": f"float64 ray casting, {REFERENCE_RAYS} rays per pulse, a pose for every firing",
        "frames": count,
        "candidates": [
            {
                "rays": rays,
                "errors": {name: of_rays[k].to_json() for name, of_rays in errors.items()},
                "cpu_s": costs[k].to_json(),
            }
            for k, rays in enumerate(RAYS)
        ],
        "seconds": round(time.perf_counter() - began, 1),
    }
    path = _path(folder, key)
    write_json(path, document)
    return replace(_profile(path, json.loads(path.read_text("utf-8"))), made=True)


def _errors(
    plans: Sequence[DrivePlan], *, frames: int, progress: Progress
) -> tuple[dict[str, list[RangeError]], int]:
    """Errors of all `RAYS`, by scanner, and the largest number of frames of a scanner."""
    scanners = [s for s in plans[0].sensors if isinstance(s, Scanner)]
    plain = plans[0].options.contents().scanner
    settings = [replace(plain, rays=rays) for rays in RAYS]
    found: dict[str, list[list[SampledError]]] = {s.name: [[] for _ in RAYS] for s in scanners}
    drives: dict[str, list[int]] = {s.name: [] for s in scanners}
    total = len(plans) * frames * len(scanners)
    done = 0
    progress("measuring errors", done, total=total)
    for k, plan in enumerate(plans):
        for bench in places(plan, frames=frames):
            for scanner in scanners:
                for errors in errors_of(bench, scanner, settings=settings):
                    for of_rays, error in zip(found[scanner.name], errors, strict=True):
                        of_rays.append(error)
                    drives[scanner.name].append(k)
                    done += 1
                    progress("measuring errors", done, total=total)
    counts = {name: len(of_rays[0]) for name, of_rays in found.items()}
    if not all(counts.values()):
        idle = ", ".join(name for name, count in counts.items() if not count)
        raise InputError(f"`rig`: {idle} has no frame in this drive, whose errors could be measured")
    by_name = {
        name: [range_error(errors, drives=drives[name]) for errors in of_rays]
        for name, of_rays in found.items()
    }
    return by_name, max(counts.values())


def _costs(plans: Sequence[DrivePlan], *, progress: Progress) -> list[Estimate]:
    """CPU seconds per simulated second of a whole rig with each of `RAYS`.

    Frames of all sensors are recorded with one ray, files and all, each once to warm up; what further rays
    add is timed on runs of pulses. Each repetition is of another frame, or of another drive.
    """
    seconds: list[list[float]] = [[] for _ in RAYS]
    total = _TIMINGS * len(plans[0].sensors)
    with tempfile.TemporaryDirectory() as folder:
        for k in range(_TIMINGS):
            plan = plans[k % len(plans)]
            spent = np.zeros(len(RAYS))
            for row, sensor in enumerate(plan.sensors):
                progress("measuring costs", k * len(plan.sensors) + row, total=total)
                frames = spread_frames(plan.frames[sensor.name], _TIMINGS)
                if frames:
                    spent += _sensor_costs(plan, sensor, frame=frames[k % len(frames)], out=Path(folder))
            for of_rays, one in zip(seconds, spent.tolist(), strict=True):
                of_rays.append(one)
    progress("measuring costs", total, total=total)
    return [median(of_rays, seed=0) for of_rays in seconds]


def _sensor_costs(plan: DrivePlan, sensor: Scanner | Camera, *, frame: int, out: Path) -> Float:
    """CPU seconds per simulated second of a sensor with each of `RAYS`, by one frame."""
    recording, contents = plan.recording(out), plan.options.contents()
    worlds = Worlds(plan.scene, plan.max_range, actors=plan.actors, settings=contents.world)
    start = sensor.frame_start_ns(frame)
    xy = plan.trajectory.at(np.array([start, start + sensor.period_ns])).position[:, :2]
    (x0, y0), (x1, y1) = xy.min(axis=0).tolist(), xy.max(axis=0).tolist()
    worlds.follow((x0, y0, x1, y1))
    record_frame(recording, sensor, frame=frame, worlds=worlds)
    began = time.process_time()
    record_frame(recording, sensor, frame=frame, worlds=worlds)
    spent = np.full(len(RAYS), time.process_time() - began)
    if isinstance(sensor, Scanner):
        world = worlds.during(*sensor.sensor.window_ns(frame))
        count = len(firings(sensor.sensor, frame))
        rows = _runs(count, max(_BLOCK_PULSES, count // 16))
        casts = []
        for rays in RAYS:
            settings = replace(contents.scanner, rays=rays)
            swept(plan, sensor, frame=frame, world=world, settings=settings, pulses=rows[:64])
            began = time.process_time()
            swept(plan, sensor, frame=frame, world=world, settings=settings, pulses=rows)
            casts.append(time.process_time() - began)
        spent += np.maximum.accumulate(np.array(casts) - casts[0]) * count / len(rows)
    return spent * 1e9 / sensor.period_ns


def _runs(count: int, pulses: int) -> NDArray[np.int64]:
    """Rows of about ``pulses`` of the ``count`` pulses of a frame, in `_BLOCKS` runs; all if they are few."""
    if count <= pulses:
        return np.arange(count)
    length = pulses // _BLOCKS
    starts = np.linspace(0, count - length, _BLOCKS).astype(np.int64)
    return np.unique(starts[:, None] + np.arange(length))

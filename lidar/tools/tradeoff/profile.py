"""Stored profiles: errors and costs of numbers of rays, for a scene, a rig and settings on a machine.

Errors are measured on random drives through the scene, so that one profile holds for all routes in it.
Such drives do not stand for flights, repeated trajectories and road users of SUMO, and may leave the area
that was built along routes: there, and where none is possible, errors are measured on the drive itself.
"""

from __future__ import annotations

import json
import logging
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from geoscene import __version__
from geoscene.errors import reading
from geoscene.scene import Scene
from geoscene.support.digests import value_digest
from geoscene.support.files import write_json
from geoscene.support.progress import Progress, silent
from geoscene.support.storage import cache_folder
from lidar.errors import InputError
from lidar.motion.vehicle import load_vehicle
from lidar.options import DriveOptions
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.physics.settings import ScannerSettings
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.sensors.rig.specs import load_rig
from lidar.simulation.plan import DrivePlan, plan_drive, sensors_of
from lidar.tools.selftest.run import machine
from lidar.tools.tradeoff.errors import ErrorEstimate
from lidar.tools.tradeoff.profile_costs import costs
from lidar.tools.tradeoff.profile_errors import Errors, camera_errors, measuring, scanner_errors
from lidar.tools.tradeoff.sampling import REFERENCE_RAYS
from lidar.traffic.fcd import TrafficFile

log = logging.getLogger(__name__)

RAYS = (1, 7, 13, 19, 37, 61, 91, 127, 169, 217, 331, 499, 665)
"""Numbers of rays per pulse to choose from, the cheapest first.

Poses, precision and the second trace are none of the choice, as they save a few percent at most.
"""

SUPERSAMPLES = (1, 2, 3, 4, 6, 8)
"""Rays along each side of a pixel to choose from.

Images without shadows or detail are none of the choice, as they save a quarter and err by 9 levels and more.
"""

EXPOSED = ((1, 5), (2, 9), (3, 17))
"""Rays along each side of a pixel, and moments, to choose from if the exposure of a camera takes time."""

_SCHEMA = 2
_DRIVES, _SECONDS, _FRAMES = 12, 8.0, 2
"""Random drives through the scene, seconds of each, and frames of each."""

_OF_THE_COURSE = ("route", "duration", "from_rest", "survey", "altitude", "overlap", "turns", "seed", "start")
"""Options of a drive on which a profile of random drives does not depend."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """Settings of the scanners or of the cameras of a rig.

    settings : values by name: ``rays``, or ``supersample`` and perhaps ``blur``
    errors   : of each sensor by its name: figures of `sampling.range_figures` or
               `sampled_images.image_figures`, with intervals for the next drive
    cpu_s    : CPU seconds per simulated second to record these sensors
    """

    settings: dict[str, int]
    errors: dict[str, dict[str, ErrorEstimate]]
    cpu_s: ErrorEstimate


@dataclass(frozen=True, slots=True)
class Profile:
    """Candidates for the scanners and for the cameras of a rig, the cheapest first; empty without such.

    path   : of its file
    drives : on which errors were measured; 1 for the drive itself
    load_s : CPU seconds to load the tiles around the vehicle
    made   : whether it was measured now, not read
    """

    path: Path
    scanners: tuple[Candidate, ...]
    cameras: tuple[Candidate, ...]
    drives: int
    load_s: ErrorEstimate
    made: bool = False


@dataclass(frozen=True, slots=True)
class Ladders:
    """Settings to choose from, the cheapest first: those of a drive alone where they are given one by one.

    scanner, camera     : empty without such sensors
    of_scanner, of_camera : names of the settings that differ
    """

    scanner: tuple[ScannerSettings, ...]
    camera: tuple[CameraSettings, ...]
    of_camera: tuple[str, ...]
    of_scanner: tuple[str, ...] = ("rays",)

    @property
    def values(self) -> tuple[list[dict[str, int]], list[dict[str, int]]]:
        """Values by name of both."""
        return (
            [{name: getattr(one, name) for name in self.of_scanner} for one in self.scanner],
            [{name: getattr(one, name) for name in self.of_camera} for one in self.camera],
        )

    @property
    def first(self) -> tuple[tuple[str, str], ...]:
        """The cheapest of both as of `DriveOptions.settings`."""
        return tuple((name, str(value)) for of in self.values for name, value in (of or [{}])[0].items())


def ladders_of(options: DriveOptions, sensors: Sequence[Scanner | Camera]) -> Ladders:
    """The settings to choose from for the sensors of a drive; those of its level are among them."""
    settings, given = options.recording_settings, {name for name, _ in options.settings}
    scanner, camera = settings.scanner, settings.camera
    cameras = [s for s in sensors if isinstance(s, Camera)]
    exposed = any(c.spec.exposure_ns for c in cameras)
    of_camera = ("supersample", "blur") if exposed else ("supersample",)
    rays: list[int] = [scanner.rays]
    if not given & {"rays", "stretch"}:  # more than one ray has no stretch
        rays = sorted({*RAYS, scanner.rays})
    shots = [(camera.supersample, camera.blur)]
    if not given & set(of_camera) and any("rgb" in c.spec.images for c in cameras):
        values = EXPOSED if exposed else tuple((k, camera.blur) for k in SUPERSAMPLES)
        shots = sorted({*values, *shots}, key=lambda v: (v[0] ** 2 * v[1], v))
    scanning = any(isinstance(s, Scanner) for s in sensors)
    return Ladders(
        tuple(replace(scanner, rays=count) for count in rays if scanning),
        tuple(replace(camera, supersample=k, blur=blur) for k, blur in shots if cameras),
        of_camera,
    )


def default_folder() -> Path:
    """Folder of profiles."""
    return cache_folder() / "profiles"


def profile_of(
    scene: Scene, options: DriveOptions, *, folder: Path | None = None, progress: Progress = silent
) -> Profile:
    """The stored profile of a drive's scene, rig and settings on this machine; measured if there is none.

    folder : of profiles; `default_folder` by default

    Raises InputError (also as RouteError, RigError) for what cannot be driven, and for rigs without sensors
    whose errors can be measured.
    """
    folder = folder or default_folder()
    sensors = sensors_of(load_rig(options.rig), options)
    ladders = ladders_of(options, sensors)
    if not ladders.scanner and not measuring([s for s in sensors if isinstance(s, Camera)]):
        raise InputError(
            f"`rig` {options.rig}: has no scanner and no camera of colours or depths, whose errors could be"
            " measured"
        )
    bare = replace(options, settings=(*options.settings, *ladders.first))
    if scene.area is None and scene.route is None and _stands_for(options):
        key = _key(scene, options, ladders=ladders, own_course=False)
        if stored := _read(folder, key):
            return stored
        try:
            plans = [_random_plan(scene, bare, seed=k, progress=progress) for k in range(_DRIVES)]
        except InputError:  # no room for a drive of this length
            plans = []
        if plans:
            return _measure(folder, key, ladders=ladders, plans=plans, frames=_FRAMES, progress=progress)
    key = _key(scene, options, ladders=ladders, own_course=True)
    if stored := _read(folder, key):
        return stored
    plans = [plan_drive(scene, bare, progress=progress)]
    return _measure(folder, key, ladders=ladders, plans=plans, frames=_DRIVES * _FRAMES, progress=progress)


def _stands_for(options: DriveOptions) -> bool:
    """Whether random drives on the scene's roads stand for a drive."""
    vehicle = load_vehicle(options.vehicle or load_rig(options.rig).vehicle)
    repeated = isinstance(options.route, Path) and options.route.suffix == ".csv"
    recorded = isinstance(options.traffic, TrafficFile)
    return not (options.survey or vehicle.kind == "air" or repeated or recorded)


def _random_plan(scene: Scene, options: DriveOptions, *, seed: int, progress: Progress) -> DrivePlan:
    """A random drive with the sensors, vehicle and traffic of another."""
    course: dict[str, Any] = {"route": "random", "duration": _SECONDS, "from_rest": False, "seed": seed}
    return plan_drive(scene, replace(options, **course), progress=progress)


def _key(scene: Scene, options: DriveOptions, *, ladders: Ladders, own_course: bool) -> dict[str, Any]:
    """All that a profile depends on."""
    recipe = options.recipe(scene)
    if not own_course:
        recipe = {name: value for name, value in recipe.items() if name not in _OF_THE_COURSE}
    host = {name: text for name, text in machine().items() if name in ("processor", "system")}
    document = {"schema": _SCHEMA, "version": __version__, "machine": host | {"cores": os.cpu_count()}}
    plain: dict[str, Any] = json.loads(
        json.dumps(document | {"drive": recipe, "choices": ladders.values}, default=str)
    )
    return plain


def _path(folder: Path, key: dict[str, Any]) -> Path:
    return folder / f"{value_digest(key)}.json"


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
    scanners, cameras = (
        tuple(
            Candidate(
                {name: int(value) for name, value in row["settings"].items()},
                {
                    sensor: {name: ErrorEstimate.from_json(error) for name, error in figures.items()}
                    for sensor, figures in row["errors"].items()
                },
                ErrorEstimate.from_json(row["cpu_s"]),
            )
            for row in document[kind]
        )
        for kind in ("scanners", "cameras")
    )
    load = ErrorEstimate.from_json(document["load_cpu_s"])
    return Profile(path, scanners, cameras, int(document["drives"]), load)


def _measure(
    folder: Path,
    key: dict[str, Any],
    *,
    ladders: Ladders,
    plans: Sequence[DrivePlan],
    frames: int,
    progress: Progress,
) -> Profile:
    """A profile of drives, measured and stored."""
    began = time.perf_counter()
    of_scanners = scanner_errors(plans, ladders.scanner, frames=frames, progress=progress)
    of_cameras = camera_errors(plans, ladders.camera, frames=frames, progress=progress)
    for_scanners, for_cameras, load = costs(
        plans, scanner=ladders.scanner, camera=ladders.camera, progress=progress
    )
    document = {
        "key": key,
        "reference": f"float64 ray casting, {REFERENCE_RAYS} rays per pulse, a pose for every firing",
        "drives": len(plans),
        "scanners": _rows(ladders.values[0], errors=of_scanners, seconds=for_scanners),
        "cameras": _rows(ladders.values[1], errors=of_cameras, seconds=for_cameras),
        "load_cpu_s": load.to_json(),
        "seconds": round(time.perf_counter() - began, 1),
    }
    path = _path(folder, key)
    write_json(path, document)
    return replace(_profile(path, json.loads(path.read_text("utf-8"))), made=True)


def _rows(
    settings: Sequence[dict[str, int]], *, errors: Errors, seconds: Sequence[ErrorEstimate]
) -> list[dict[str, Any]]:
    """Candidates as JSON."""
    return [
        {
            "settings": one,
            "errors": {
                sensor: {name: error.to_json() for name, error in of[k].items()}
                for sensor, of in errors.items()
            },
            "cpu_s": seconds[k].to_json(),
        }
        for k, one in enumerate(settings)
    ]

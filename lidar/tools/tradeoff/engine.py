"""Errors and costs of the settings of a drive, on the user's own scene, route and rig."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from geoscene.scene import Scene
from geoscene.support.progress import Progress, silent
from geoscene.support.registry import unknown_name
from lidar.errors import InputError
from lidar.geometry.georeference import Georeference
from lidar.options import DriveOptions, TradeoffOptions
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.simulation.plan import DrivePlan, plan_drive, schedule
from lidar.tools.tradeoff.cameras import compared_camera
from lidar.tools.tradeoff.comparison import Listing, SensorComparison
from lidar.tools.tradeoff.errors import percentile
from lidar.tools.tradeoff.files import formats_listing
from lidar.tools.tradeoff.projections import frames_listing
from lidar.tools.tradeoff.scanners import compared_scanner
from lidar.tools.tradeoff.simulate import EXACT, Bench, bench_of, measured_frame
from lidar.tools.tradeoff.variants import CAMERA_VALUES, SCANNER_VALUES, WORLD_VALUES
from lidar.tools.tradeoff.voxels import voxels_listing

_OF_SENSORS = (*WORLD_VALUES, "scene", "traffic")
_OF_DRIVE = ("georeferencing", "files", "voxel", "frame")
COMPARED = tuple(dict.fromkeys((*SCANNER_VALUES, *CAMERA_VALUES, *_OF_SENSORS, *_OF_DRIVE)))
"""Names that `TradeoffOptions.compare` may hold."""


@dataclass(frozen=True, slots=True)
class DriveTradeoff:
    """Comparisons of all sensors of a rig on a drive.

    georeferencing : metres between the affine map and the full projection; empty where not compared
    listings       : tables of formats and maps of each scanner, and of frames
    """

    plan: DrivePlan
    comparisons: tuple[SensorComparison, ...]
    georeferencing: dict[str, float]
    listings: tuple[Listing, ...]


def tradeoff(
    scene: Scene,
    options: DriveOptions,
    *,
    compared: TradeoffOptions = TradeoffOptions(),
    others: Sequence[Scene] = (),
    progress: Progress = silent,
) -> DriveTradeoff:
    """Errors and costs of settings on a drive; the drive is planned once, in the first scene.

    others : further scenes of the same place, in the same frame

    Raises InputError (also as RouteError, RigError) for what cannot be driven or compared.
    """
    if unknown := sorted(set(compared.compare) - set(COMPARED)):
        raise InputError(unknown_name("`compare`", unknown[0], known=COMPARED))
    plan = plan_drive(scene, options, progress=progress)
    for other in others:
        if other.frame.to_json() != scene.frame.to_json():
            raise InputError(f"{other.path}: has another frame than {scene.path}; build both with one `crs`")
    plan = _with_sensors(plan, compared.sensors)
    _check_applicable(plan, compared.compare, others=others)
    bench = bench_of(plan, others, frames=compared.frames)
    scenes = [scene_label(scene, other) for other in others]
    found = []
    for sensor in plan.sensors:
        if _compares(sensor, compared.compare):
            if isinstance(sensor, Scanner):
                found.append(
                    compared_scanner(bench, sensor, compared=compared, scenes=scenes, progress=progress)
                )
            else:
                found.append(
                    compared_camera(bench, sensor, compared=compared, scenes=scenes, progress=progress)
                )
            bench.close(backend=EXACT)
    wanted = compared.compare or COMPARED
    geo = _georeferencing(bench) if "georeferencing" in wanted else {}
    return DriveTradeoff(plan, tuple(found), geo, tuple(_listings(bench, wanted, progress=progress)))


def _listings(bench: Bench, wanted: Sequence[str], *, progress: Progress) -> Iterator[Listing]:
    scanners = [s for s in bench.plan.sensors if isinstance(s, Scanner)]
    for scanner in scanners:
        if "files" in wanted:
            yield formats_listing(bench, scanner, progress=progress)
        if "voxel" in wanted:
            yield voxels_listing(bench, scanner, progress=progress)
    if scanners and "frame" in wanted:
        yield frames_listing(bench, scanners[0])


def _with_sensors(plan: DrivePlan, names: Sequence[str]) -> DrivePlan:
    """The plan with some of its sensors, all by default, that have a frame in the drive."""
    if unknown := sorted(set(names) - {s.name for s in plan.sensors}):
        known = ", ".join(s.name for s in plan.sensors)
        raise InputError(f"`sensors` {','.join(unknown)}: not in rig {plan.rig.name}; there are {known}")
    sensors = [s for s in plan.sensors if plan.frames[s.name] and (not names or s.name in names)]
    if not sensors:
        raise InputError(f"`rig` {plan.options.rig}: no sensor has a frame in this drive")
    return replace(plan, sensors=tuple(sensors), jobs=schedule(sensors, plan.trajectory.duration_ns))


def _settings_of(sensor: Scanner | Camera) -> Sequence[str]:
    """Names of settings that can be compared for a sensor."""
    return (*(SCANNER_VALUES if isinstance(sensor, Scanner) else CAMERA_VALUES), *_OF_SENSORS)


def _compares(sensor: Scanner | Camera, names: Sequence[str]) -> bool:
    return not names or bool(set(names) & set(_settings_of(sensor)))


def _check_applicable(plan: DrivePlan, names: Sequence[str], *, others: Sequence[Scene]) -> None:
    """Raise InputError for names of comparisons that this drive does not have."""
    known = {name for sensor in plan.sensors for name in _settings_of(sensor)}
    scanning = any(isinstance(s, Scanner) for s in plan.sensors)
    for name in names:
        if name in CAMERA_VALUES and name not in known:
            raise InputError(f"`compare` {name}: a setting of cameras, and none is compared")
        if (name in SCANNER_VALUES and name not in known) or (name in _OF_DRIVE and not scanning):
            raise InputError(f"`compare` {name}: needs a scanner, and none is compared")
    if "scene" in names and not others:
        raise InputError("`compare` scene: no other scene is given with `others`")
    if "relief" in names and plan.scene.relief == "off":
        raise InputError(f"`compare` relief: {plan.scene.location} was built without; build it with `relief`")
    if "traffic" in names and plan.actors is None:
        raise InputError("`compare` traffic: the drive has none; give `traffic`")


def _georeferencing(bench: Bench) -> dict[str, float]:
    """Metres between the affine map and the full projection, on returns of the sampled frames."""
    plan = bench.plan
    scanner = next((s for s in plan.sensors if isinstance(s, Scanner)), None)
    if scanner is None:
        return {}
    affine, full = (Georeference(plan.scene.frame, plan.geo.crs, exact=exact) for exact in (False, True))
    away = []
    for frame in bench.frames[scanner.name]:
        placed = measured_frame(bench, scanner, frame=frame, every=8).placed
        away.append(np.linalg.norm(affine.points(placed) - full.points(placed), axis=1))
    every = np.concatenate(away)
    return {"99.9_m": percentile(every, 0.999), "max_m": percentile(every, 1.0)}


def scene_label(first: Scene, other: Scene) -> str:
    """What distinguishes a scene from the first: the build options that differ, or else its folder."""
    a, b = (_flat(scene.manifest.get("options", {})) for scene in (first, other))
    differ = [f"{k}={b.get(k)}" for k in sorted(a.keys() | b.keys()) if a.get(k) != b.get(k)]
    return ",".join(differ) or other.path.name


def _flat(options: dict[str, Any]) -> dict[str, str]:
    return {name: str(value) for name, value in options.items()}

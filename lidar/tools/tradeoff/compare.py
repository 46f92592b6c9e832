"""Errors and costs of the settings of a drive, on the user's own scene, route and rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from geoscene.scene import Scene
from geoscene.support.progress import Progress, displayed, shows_progress
from geoscene.support.registry import unknown_name
from lidar.errors import InputError
from lidar.geometry.georeference import Georeference
from lidar.options.accuracy import TradeoffOptions
from lidar.options.drive import DriveOptions
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.sensors.rig.scanner import firings
from lidar.simulation.plan import DrivePlan, plan_drive, schedule
from lidar.tools.tradeoff.bench import EXACT, FAST, Bench, bench_of, returns_of
from lidar.tools.tradeoff.errors import SensorComparison, percentile
from lidar.tools.tradeoff.sensors import compare_sensor
from lidar.tools.tradeoff.variants import CAMERA_VALUES, SCANNER_VALUES, WORLD_VALUES, noiseless

_OF_SENSORS = (*WORLD_VALUES, "scene", "traffic")
COMPARED = tuple(dict.fromkeys((*SCANNER_VALUES, *CAMERA_VALUES, *_OF_SENSORS, "georeferencing")))
"""Names that `TradeoffOptions.compare` may hold."""


@dataclass(frozen=True, slots=True)
class DriveTradeoff:
    """Comparisons of all sensors of a rig on a drive.

    georeferencing : metres between the affine map and the full projection; empty where not compared
    """

    plan: DrivePlan
    comparisons: tuple[SensorComparison, ...]
    georeferencing: dict[str, float]


@shows_progress
def compare_settings(
    scene: Scene,
    options: DriveOptions,
    *,
    compared: TradeoffOptions = TradeoffOptions(),
    others: Sequence[Scene] = (),
    progress: Progress = displayed,
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
        if not compared.compare or set(compared.compare) & set(_settings_of(sensor)):
            found.append(compare_sensor(bench, sensor, compared=compared, scenes=scenes, progress=progress))
            bench.close(backend=EXACT)
    geo = _georeferencing(bench) if "georeferencing" in (compared.compare or COMPARED) else {}
    return DriveTradeoff(plan, tuple(found), geo)


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


def _check_applicable(plan: DrivePlan, names: Sequence[str], *, others: Sequence[Scene]) -> None:
    """Raise InputError for names of comparisons that this drive does not have."""
    known = {name for sensor in plan.sensors for name in _settings_of(sensor)}
    scanning = any(isinstance(s, Scanner) for s in plan.sensors)
    for name in names:
        if name in CAMERA_VALUES and name not in known:
            raise InputError(f"`compare` {name}: a setting of cameras, and none is compared")
        if (name in SCANNER_VALUES and name not in known) or (name == "georeferencing" and not scanning):
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
    settings = noiseless(plan.options.recording_settings.scanner).changed(rays=1)
    away = []
    for frame in bench.frames[scanner.name]:
        pulses = np.arange(0, len(firings(scanner.sensor, frame)), 8)
        world = bench.world(scanner, frame, backend=FAST)
        found = returns_of(plan, scanner, frame=frame, world=world, settings=settings, pulses=pulses)
        away.append(np.linalg.norm(affine.points(found.xyz) - full.points(found.xyz), axis=1))
    every = np.concatenate(away)
    return {"99.9_m": percentile(every, 0.999), "max_m": percentile(every, 1.0)}


def scene_label(first: Scene, other: Scene) -> str:
    """The build options in which a scene differs from the first, or else its folder."""
    a, b = (_flat(scene.manifest.get("options", {})) for scene in (first, other))
    differ = [f"{k}={b.get(k)}" for k in sorted(a.keys() | b.keys()) if a.get(k) != b.get(k)]
    return ",".join(differ) or other.path.name


def _flat(options: dict[str, Any]) -> dict[str, str]:
    return {name: str(value) for name, value in options.items()}

"""`lidar odometry`: the motion of a dataset's vehicle by one of several methods; the method ``fused``."""

from __future__ import annotations

import logging
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib import metadata
from math import radians
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.support.files import replaced_folder
from geoscene.support.progress import Progress, displayed, shows_progress
from geoscene.typing import Ints
from lidar.dataset.derived import check_target
from lidar.dataset.layout import Dataset, DatasetLike, open_dataset
from lidar.errors import DatasetError, InputError
from lidar.options.trajectories import OdometryOptions
from lidar.sensors.rig.imu_grades import PRESETS, Noise
from lidar.sensors.rig.specs import ImuSpec, rig_of
from lidar.tools.odometry.estimate import OWN_FILES, MotionEstimate, begun_at, write_estimate
from lidar.tools.odometry.fusion import Fixed, fixes_of, fuse_measurements, unit_of
from lidar.tools.odometry.lidar_methods import lidar_odometry
from lidar.tools.odometry.scans import scans_of
from lidar.tools.odometry.settings import OdometrySettings, read_settings
from lidar.tools.odometry.visual_methods import VISUAL_METHODS, visual_odometry

_QUALITIES = {1: "single", 2: "sbas", 4: "fixed", 5: "float"}
_DRIFT = (0.002, 0.05)  # radians and metres: of a step by methods that state no deviations


def fused_odometry(
    dataset: Dataset,
    relative: str,
    *,
    names: tuple[str, ...],
    grade: str,
    settings: OdometrySettings,
    progress: Progress,
) -> MotionEstimate:
    """Poses of the vehicle in the scene by its receiver and, if available, inertial unit and odometry.

    relative : method of odometry, ``none``, or empty for small_gicp or else stereo, if the data are there
    names    : of the sensors to use; by default the first receiver and unit, and what the method takes
    grade    : of the inertial unit, of `PRESETS`; by default its noise in the drive's rig

    Raises InputError for other names, DatasetError without a receiver or for damaged data, and
    MissingExtraError without a package.
    """
    sensors = dataset.sensors()
    if unknown := [name for name in names if name not in sensors]:
        raise InputError(f"`sensor` {unknown[0]}: not in {dataset.path}; there are {', '.join(sensors)}")
    receiver, unit = (_name_of(dataset, kind, names=names) for kind in ("gnss", "imu"))
    if not receiver:
        raise DatasetError(
            f"{dataset.path}: has no satellite receiver, which georeferences; choose another `method`"
        )
    fixes = fixes_of(dataset, receiver)
    rest = tuple(name for name in names if sensors[name]["kind"] in ("lidar", "camera"))
    odometry = _relative(dataset, relative, names=rest, settings=settings, progress=progress)
    noise = _noise(dataset, unit, grade=grade) if unit else None
    inertial = unit_of(dataset, unit, noise=noise, fixes=fixes) if noise is not None else None
    steps = sigma = None
    if odometry is None:
        time_ns = _knots(fixes, inertial.samples.time_ns if inertial else None, settings=settings)
    else:
        time_ns, steps, sigma = odometry.time_ns, odometry.steps(), odometry.step_sigma
        if sigma is None:
            sigma = np.tile(np.repeat(_DRIFT, 3), (len(steps), 1))
    progress("fusing", 0, total=0)
    found = fuse_measurements(time_ns, fixes, unit=inertial, steps=steps, step_sigma=sigma, settings=settings)
    counts: dict[str, Any] = {"used": {}, "left_out": {}}
    for quality in np.unique(fixes.quality).tolist():
        name, of = _QUALITIES.get(quality, str(quality)), fixes.quality == quality
        counts["used"][name] = int(np.count_nonzero(of & found.used))
        counts["left_out"][name] = int(np.count_nonzero(of & ~found.used))
    used = {receiver, unit, *(odometry.report["sensors"] if odometry else ())} - {""}
    report = {
        "method": "fused",
        "package": f"gtsam {metadata.version('gtsam')}",
        "sensors": [name for name in sensors if name in used],
        "sensors_not_used": [name for name in sensors if name not in used],
        "fixes": counts,
        "odometry": odometry.report if odometry else None,
        "frames": len(time_ns),
    }
    quality_of = dict(odometry.quality) if odometry else {}
    return MotionEstimate(
        time_ns, found.poses, found.sigma, None, quality_of, report, in_scene=True, scale=fixes.scale
    )


def _name_of(dataset: Dataset, kind: str, *, names: tuple[str, ...]) -> str:
    """Name of the sensor of a kind that the user chose, or of the first; empty without any."""
    there = dataset.sensors(kind)
    return next((name for name in (*names, *there) if name in there), "")


def _relative(
    dataset: Dataset, method: str, *, names: tuple[str, ...], settings: OdometrySettings, progress: Progress
) -> MotionEstimate | None:
    """The estimate of a method of odometry; of the first that the data allow, or None, for an empty one."""
    if method == "none":
        return None
    for one in [method] if method else ["small_gicp", "stereo"]:
        with suppress(*(() if method else (DatasetError,))):
            return _estimated(dataset, one, names=names, settings=settings, progress=progress)
    return None


def _estimated(
    dataset: Dataset, method: str, *, names: tuple[str, ...], settings: OdometrySettings, progress: Progress
) -> MotionEstimate:
    """The estimate of a method of scanners or cameras."""
    if method in VISUAL_METHODS:
        return visual_odometry(dataset, method, names=names, settings=settings, progress=progress)
    scans = scans_of(dataset, names, least=settings.min_range, most=settings.max_range or None)
    return lidar_odometry(scans, method, settings=settings, progress=progress)


def _noise(dataset: Dataset, unit: str, *, grade: str) -> Noise:
    """The noise of an inertial unit: of a grade, or by the drive's rig, or the defaults of rigs."""
    if grade:
        return PRESETS[grade]
    specs: tuple[ImuSpec, ...] = ()
    with suppress(InputError):  # the rig's file may be gone since
        specs = tuple(rig_of(str(dataset.manifest["recipe"].get("rig", ""))).imus)
    spec = next((spec for spec in specs if spec.name == unit), None)
    if spec is None:
        return replace(PRESETS["adis16448"], source="default")
    walks = (spec.gyro_noise, spec.gyro_walk, spec.accel_noise, spec.accel_walk)
    return Noise(*walks, "rig", spec.gyro_instability, spec.accel_instability)


def _knots(fixes: Fixed, samples_ns: Ints | None, *, settings: OdometrySettings) -> Ints:
    """Times of poses without odometry: even, from the first fix to the last, within the samples."""
    first, last = int(fixes.time_ns[0]), int(fixes.time_ns[-1])
    if samples_ns is not None:
        first, last = max(first, int(samples_ns[0])), min(last, int(samples_ns[-1]))
    step = round(settings.knot_s * 1e9)
    if last - first < step:
        raise DatasetError("fixes and samples share no time in which poses could be found")
    return np.arange(first, last + 1, step)


log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class OdometrySummary:
    """Summary of `estimate_motion`.

    length_m : of the way from pose to pose
    seconds  : that it took
    """

    estimate: MotionEstimate
    length_m: float
    seconds: float

    def to_json(self) -> dict[str, Any]:
        """The report with the length and the duration."""
        return self.estimate.report | {"length_m": self.length_m, "seconds": round(self.seconds, 3)}


@shows_progress
def estimate_motion(
    path: DatasetLike,
    out: str | Path,
    *,
    options: OdometryOptions,
    overwrite: bool = False,
    progress: Progress = displayed,
) -> OdometrySummary:
    """Estimate the motion of a dataset's vehicle from its measurements, and write it into a folder.

    The folder holds ``trajectory.tum``, ``trajectory.kitti``, ``poses.csv`` and ``odometry.json``. Of the
    dataset the sensors' files and the calibration are read; true poses, depth images, labels and boxes are
    not.

    overwrite : replace an existing folder

    Raises InputError for options that do not fit the dataset, DatasetError for data that are missing or
    damaged, and MissingExtraError without the package of a method.
    """
    begin = time.monotonic()
    settings = read_settings(options.settings, path=options.settings_file)
    dataset, out = open_dataset(path), Path(out)
    check_target(out, source=dataset.path, overwrite=overwrite)
    given: dict[str, Any] = {"names": options.sensors, "settings": settings, "progress": progress}
    if options.method == "fused":
        estimate = fused_odometry(dataset, options.relative, grade=options.imu_grade, **given)
    else:
        estimate = _estimated(dataset, options.method, **given)
    if options.start_pose is not None and not estimate.in_scene:
        x, y, z, roll, pitch, yaw = options.start_pose
        place = (x, y, z, radians(roll), radians(pitch), radians(yaw))
        estimate = begun_at(estimate, place, frame=dataset.frame)
    report = {
        **estimate.report,
        "first_ns": int(estimate.time_ns[0]),
        "last_ns": int(estimate.time_ns[-1]),
        "poses": len(estimate.time_ns),
        "frame": "scene" if estimate.in_scene else "first pose",
        "settings": {name: getattr(settings, name) for name in settings.__slots__},
    }
    estimate = replace(estimate, report=report)
    with replaced_folder(out, own=lambda _: OWN_FILES.__contains__) as part:
        write_estimate(part, estimate, dataset=dataset)
    return OdometrySummary(estimate, estimate.length(), time.monotonic() - begin)

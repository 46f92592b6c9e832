"""`lidar odometry`: the motion of the vehicle of a dataset by one of several methods, in a folder."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import radians
from pathlib import Path
from typing import Any

from geoscene.support.files import replaced_folder
from geoscene.support.progress import Progress, silent
from lidar.dataset.derived import check_target
from lidar.dataset.layout import Dataset, open_dataset
from lidar.options import OdometryOptions
from lidar.tools.odometry.estimate import OWN_FILES, MotionEstimate, begun_at, write_estimate
from lidar.tools.odometry.fused_method import fused_odometry
from lidar.tools.odometry.lidar_methods import LIDAR_METHODS, lidar_odometry
from lidar.tools.odometry.scans import scans_of
from lidar.tools.odometry.settings import OdometrySettings, read_settings
from lidar.tools.odometry.visual_methods import VISUAL_METHODS, visual_odometry

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


def estimate_motion(
    path: str | Path,
    out: str | Path,
    *,
    options: OdometryOptions,
    overwrite: bool = False,
    progress: Progress = silent,
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
    estimate = _METHODS[options.method](dataset, options, settings=settings, progress=progress)
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


def _by_lidar(
    dataset: Dataset, options: OdometryOptions, *, settings: OdometrySettings, progress: Progress
) -> MotionEstimate:
    scans = scans_of(dataset, options.sensors, least=settings.min_range, most=settings.max_range or None)
    return lidar_odometry(scans, options.method, settings=settings, progress=progress)


def _by_camera(
    dataset: Dataset, options: OdometryOptions, *, settings: OdometrySettings, progress: Progress
) -> MotionEstimate:
    return visual_odometry(
        dataset, options.method, names=options.sensors, settings=settings, progress=progress
    )


def _by_fusion(
    dataset: Dataset, options: OdometryOptions, *, settings: OdometrySettings, progress: Progress
) -> MotionEstimate:
    return fused_odometry(
        dataset,
        options.relative,
        names=options.sensors,
        grade=options.imu_grade,
        settings=settings,
        progress=progress,
    )


_METHODS: dict[str, Callable[..., MotionEstimate]] = {
    "fused": _by_fusion,
    **dict.fromkeys(LIDAR_METHODS, _by_lidar),
    **dict.fromkeys(VISUAL_METHODS, _by_camera),
}
"""Function of each method."""

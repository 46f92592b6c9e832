"""Options of estimated trajectories: odometry and its evaluation."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from geoscene.support.console import SEVERAL, WORDS, numbers
from geoscene.support.option_values import take_values
from lidar.errors import InputError
from lidar.options.shared import SETTINGS, check_words, lower, taken_settings
from lidar.sensors.rig.imu_grades import PRESETS

METHODS = ("kiss-icp", "genz-icp", "small_gicp", "orb", "orb+depth", "stereo", "fused")
"""Methods of odometry."""

ALIGNMENTS = ("none", "origin", "se3", "sim3", "yaw-position")
"""Motions of an estimated trajectory onto the true one."""


_POSE = numbers(6, "six numbers, three of metres and three of degrees")


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class OdometryOptions:
    """Options of odometry."""

    method: Annotated[str, Parameter(converter=lower, n_tokens=1)]
    """Method: kiss-icp, genz-icp, small_gicp (laser scanners); orb (a camera), orb+depth (a camera and laser
    scanners), stereo (two cameras); fused (GNSS with an inertial unit and odometry, as far as there are)."""

    sensors: Annotated[tuple[str, ...], Parameter(name="--sensor"), SEVERAL] = ()
    """Names of the sensors to use; repeat for more. By default the scanner whose sweeps have the most points,
    the first camera, and for stereo the next one whose images have the same times; several scanners are
    merged."""

    relative: Annotated[str, Parameter(converter=lower, n_tokens=1)] = ""
    """Odometry that fused takes: one of the other methods, or none; by default small_gicp, without a scanner
    stereo, and none without both."""

    imu_grade: Annotated[str, Parameter(converter=lower, n_tokens=1)] = ""
    """Noise of the inertial unit that fused takes: adis16448, vn100, mti-g-700 or tactical; by default that
    of the drive's rig."""

    start_pose: Annotated[
        tuple[float, ...] | None, Parameter(converter=_POSE, n_tokens=1, metavar="X,Y,Z,ROLL,PITCH,YAW")
    ] = None
    """Where the vehicle begins: scene metres, and degrees as alpha, beta and gamma of poses.csv. By default
    poses are relative to the first."""

    settings: Annotated[
        tuple[tuple[str, str], ...],
        SETTINGS,
    ] = ()
    """Settings of the method: NAME=VALUE,NAME=VALUE, or repeat. lidar settings lists them."""

    settings_file: Path | None = None
    """TOML file of settings; --set goes before it."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError, readers={"settings": taken_settings})
        others = [name for name in METHODS if name != "fused"]
        check_words(self, method=METHODS, relative=("", "none", *others), imu_grade=("", *PRESETS))
        if self.method != "fused" and (self.relative or self.imu_grade):
            raise InputError("`relative` and `imu_grade` are for the `method` fused")
        if self.method == "fused" and self.start_pose is not None:
            raise InputError("`start_pose`: fused begins where the fixes are; leave it out")


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class EvaluateOptions:
    """Options of an evaluation of an estimate against the truth."""

    align: Annotated[str, Parameter(converter=lower)] = "se3"
    """Motion of the estimated trajectory onto the true one: none, origin (first poses), se3 or sim3 (least
    squares, with scale), yaw-position (turn about z only)."""

    associate: Annotated[str, Parameter(converter=lower)] = "interpolated"
    """Poses at the same times: interpolated (the truth at the estimate's times) or nearest."""

    max_gap: float | None = None
    """Seconds between poses of the truth that are interpolated (1 by default), or between matched poses
    (nearest: 0.01 by default), at most."""

    delta: Annotated[tuple[str, ...], WORDS] = ("1f", "10m", "100m")
    """Frames (1f) and metres of the true way (10m) of relative errors, separated by commas; those longer than
    the way are left out."""

    sensor: str = ""
    """Sensor whose poses the estimate holds, by default the vehicle; camera that tracks of MOT are of."""

    map_error: Annotated[bool, Parameter(negative=())] = False
    """Map the dataset's clouds with the aligned estimate, and measure the distances to the scene's true
    surfaces."""

    def __post_init__(self) -> None:
        """Validate the options."""
        take_values(self, error=InputError)
        check_words(self, align=ALIGNMENTS, associate=("interpolated", "nearest"))
        if self.max_gap is not None and self.max_gap < 0:
            raise InputError(f"`max_gap` {self.max_gap:g}: give seconds, 0 or more")
        for word in self.delta:
            if not re.fullmatch(r"[1-9]\d{0,8}f|\d{1,9}(\.\d+)?m", word) or not float(word[:-1]):
                raise InputError(f"`delta` {word}: give frames or metres, such as 1f or 10m")

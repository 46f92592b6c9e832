"""Trajectories read from an earlier dataset."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from geoscene.errors import FrameError, reason_of
from geoscene.geometry.frames import Frame
from geoscene.typing import Float
from lidar.errors import DatasetError, FormatError, RouteError
from lidar.geometry.poses import Trajectory
from lidar.geometry.trajectory_files import MANIFEST, read_trajectory

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


_STEP_NS = 10_000_000
_LATEST_NS = 10**15
_FASTEST = 1000.0  # m/s
_STAMP = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d{1,9})?Z?")
_QUAT = ("qx", "qy", "qz", "qw")
_POSE = ("timestamp", "lon", "lat", "h", *_QUAT)
_SHOWN = 100
_WANTED = (
    f"a CSV file is a drive to repeat: a poses.csv with the columns {', '.join(_POSE)}, or the trajectory.csv"
    " of a dataset; give waypoints as LAT,LON LAT,LON ..., GPX or GeoJSON"
)


def read_replay(path: Path, frame: Frame) -> Trajectory:
    """The trajectory that a ``trajectory.csv`` or ``poses.csv`` of a dataset holds, in a scene's frame.

    The vehicle is where it was at the same time after the start. Heights are taken as they are. The first is
    followed exactly in a scene of the same frame; between the rows of the second, positions are interpolated
    by a cubic spline and rotations by great arcs. The frame that they were recorded in is read from the
    ``dataset.json`` beside them; without it, axes are taken as those of this scene.

    Raises RouteError for a file that is missing or holds too few poses and FormatError for another table.
    """
    if not path.is_file():
        raise RouteError(f"{path} does not exist")
    try:
        with path.open(encoding="utf-8-sig") as file:
            names = file.readline().strip().split(",")
    except UnicodeDecodeError as error:
        raise FormatError(f"{path}: not text in UTF-8; {_WANTED}") from error
    manifest = path.with_name(MANIFEST)
    recorded = _recorded_frame(manifest) if manifest.is_file() else frame
    if names[0] == "time_ns":
        found = read_trajectory(path)
        _check_speed(path, found.time_ns, position=found.position)
        return found if recorded == frame else _move(found, recorded, frame=frame)
    if missing := [name for name in _POSE if name not in names]:
        has = ", ".join(names)[:_SHOWN] or "no columns"
        raise FormatError(f"{path}: has {has}; no {', '.join(missing)}; {_WANTED}")
    return _from_poses(path, recorded, frame=frame)


def _recorded_frame(manifest: Path) -> Frame:
    try:
        return Frame.from_json(json.loads(manifest.read_text("utf-8-sig"))["frame"])
    except (ValueError, KeyError, TypeError, FrameError) as error:
        raise DatasetError(f"{manifest}: damaged ({reason_of(error)})") from error


def _from_poses(path: Path, recorded: Frame, *, frame: Frame) -> Trajectory:
    from scipy.interpolate import CubicSpline  # noqa: PLC0415
    from scipy.spatial.transform import Rotation, Slerp  # noqa: PLC0415

    with path.open(encoding="utf-8-sig", newline="") as file:
        rows = list(csv.DictReader(file))
    if len(rows) < 2:
        raise RouteError(f"{path}: {len(rows)} poses; a drive needs two or more")
    try:
        time = _nanoseconds([row["timestamp"] for row in rows])
        lon, lat, h = (np.array([float(row[k]) for row in rows]) for k in ("lon", "lat", "h"))
        quat = np.array([[float(row[k]) for k in _QUAT] for row in rows])
    except (ValueError, TypeError) as error:
        raise FormatError(f"{path}: a row that cannot be read ({reason_of(error)})") from error
    if (np.diff(time) <= 0).any() or time[-1] > _LATEST_NS:
        raise FormatError(f"{path}: its times do not increase, or span over eleven days")
    x, y = frame.from_geographic(lon, lat)
    sound = np.isfinite([x, y, h]).all(axis=0) & (np.abs(np.linalg.norm(quat, axis=1) - 1) < 1e-3)
    if not sound.all():
        raise FormatError(f"{path}: line {sound.argmin() + 2} holds no pose")
    _check_speed(path, time, position=np.column_stack([x, y, h]))
    seconds = time * 1e-9
    at = np.append(np.arange(0, time[-1], _STEP_NS), time[-1])
    spline = CubicSpline(
        seconds, np.column_stack([x, y, h]), bc_type="natural" if len(rows) > 2 else "not-a-knot"
    )
    turn = _turn(recorded, frame, lon=lon, lat=lat) * Rotation.from_quat(quat)
    position = spline(at * 1e-9)
    scale = np.asarray(frame.scale_at(*position[:, :2].T), float)
    velocity = spline(at * 1e-9, 1)
    velocity[:, :2] /= scale[:, None]
    return Trajectory(at, position, Slerp(seconds, turn)(at * 1e-9).as_quat(), velocity, scale)


def _check_speed(path: Path, time_ns: NDArray[np.int64], *, position: Float) -> None:
    """Raise FormatError if rows of a trajectory are too far apart for their times."""
    with np.errstate(over="ignore"):
        speed = np.linalg.norm(np.diff(position, axis=0), axis=1) / (np.diff(time_ns) * 1e-9)
    fastest = int(speed.argmax())
    if speed[fastest] > _FASTEST:
        raise FormatError(
            f"{path}: row {fastest + 2} is {speed[fastest]:.3g} m/s from the row before; repeats are of up to"
            f" {_FASTEST:g} m/s"
        )


def _nanoseconds(stamps: list[str]) -> NDArray[np.int64]:
    """Nanoseconds of ISO 8601 UTC time stamps after the first."""
    for stamp in stamps:
        if not _STAMP.fullmatch(stamp):
            raise ValueError(f"{stamp!r} is not a time stamp such as 2026-06-21T08:00:00.1Z")
    times = np.array([stamp.removesuffix("Z") for stamp in stamps], "datetime64[ns]").astype(np.int64)
    since: NDArray[np.int64] = times - times[0]
    return since


def _turn(recorded: Frame, frame: Frame, *, lon: Float, lat: Float) -> Rotation:
    """Turns (n,) about the vertical from the axes of one frame to those of another.

    Raises FormatError for places where the axes of either are not known.
    """
    from scipy.spatial.transform import Rotation  # noqa: PLC0415

    angle = np.zeros((len(lon), 3))
    if recorded != frame:
        with np.errstate(invalid="ignore"):
            angle[:, 2] = frame.convergence(lon, lat) - recorded.convergence(lon, lat)
        if not np.isfinite(angle).all():
            raise FormatError(
                f"the drive to repeat is not within the area of {recorded.name} and {frame.name}"
            )
    return Rotation.from_rotvec(angle)


def _move(old: Trajectory, recorded: Frame, *, frame: Frame) -> Trajectory:
    """A trajectory in another frame."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415

    lon, lat = recorded.to_geographic(*old.position[:, :2].T)
    x, y = frame.from_geographic(lon, lat)
    turn = _turn(recorded, frame, lon=lon, lat=lat)
    return Trajectory(
        old.time_ns,
        np.column_stack([x, y, old.position[:, 2]]),
        (turn * Rotation.from_quat(old.quat_xyzw)).as_quat(),
        turn.apply(old.velocity),
        np.asarray(frame.scale(lon, lat), float),
    )

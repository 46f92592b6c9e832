"""A recorded drive in the layout of KITTI's raw recordings (synchronised and rectified), with OXTS files.

Geiger et al. 2013. OXTS files hold ground truth of the first inertial unit: `gnss.csv` and `imu.csv` of the
dataset have the measurements.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.support.files import write_lines
from geoscene.support.progress import Progress
from geoscene.typing import Float
from lidar.dataset.layout import Dataset, read_rows, reading_file
from lidar.dataset.layouts.kitti_drive import CAMERAS, KittiDrive, numbers, read_drive, write_stamps
from lidar.dataset.recorded import nearest
from lidar.geometry.attitude import euler_from_quat, quat_from_matrix
from lidar.sensors.navigation.gnss import antenna_motion
from lidar.sensors.navigation.imu import true_inertial
from lidar.sensors.rig.specs import GnssSpec, ImuSpec

_NAVSTAT = 4
"""OXTS's navigation status ``real time``."""

_OXTS = {
    "lat": "latitude (deg)",
    "lon": "longitude (deg)",
    "alt": "height as in the scene (m)",
    "roll": "rotation about the forward axis (rad), 0 is level, positive is left side up",
    "pitch": "rotation about the left axis (rad), 0 is level, positive is front down",
    "yaw": "heading (rad), 0 is east, positive is counter-clockwise",
    "vn": "velocity towards north (m/s)",
    "ve": "velocity towards east (m/s)",
    "vf": "forward velocity, parallel to the Earth's surface (m/s)",
    "vl": "leftward velocity, parallel to the Earth's surface (m/s)",
    "vu": "upward velocity (m/s)",
    "ax": "specific force along the unit's x axis, forward (m/s^2)",
    "ay": "specific force along the unit's y axis, left (m/s^2)",
    "az": "specific force along the unit's z axis, up (m/s^2)",
    "af": "specific force forward, parallel to the Earth's surface (m/s^2)",
    "al": "specific force leftward, parallel to the Earth's surface (m/s^2)",
    "au": "specific force upward (m/s^2)",
    "wx": "angular rate about the unit's x axis (rad/s)",
    "wy": "angular rate about the unit's y axis (rad/s)",
    "wz": "angular rate about the unit's z axis (rad/s)",
    "wf": "angular rate about the forward axis (rad/s)",
    "wl": "angular rate about the leftward axis (rad/s)",
    "wu": "angular rate about the upward axis (rad/s)",
    "pos_accuracy": "0: values are true",
    "vel_accuracy": "0: values are true",
    "navstat": "4: real time",
    "numsats": "satellites that the receiver used",
    "posmode": "0",
    "velmode": "0",
    "orimode": "0",
}
"""Values of an OXTS file, in order, with their meanings."""


def export(dataset: Dataset, folder: Path, *, progress: Progress) -> dict[str, int]:
    """Write ``<date>/<date>_drive_0001_sync``; return the numbers of clouds, images and poses.

    Raises DatasetError for a drive without clouds in the sensor frame.
    """
    drive = read_drive(dataset)
    date = dataset.start.strftime("%Y_%m_%d")
    _write_calibrations(drive, folder / date)
    write_lines(folder / "dataformat.txt", (f"{name}: {meaning}" for name, meaning in _OXTS.items()))
    out = folder / date / f"{date}_drive_0001_sync"
    time_ns = drive.clouds.time_ns
    period_ns = round(1e9 / float(drive.clouds.sensor["rate_hz"]))
    for name, times in {"": time_ns, "_start": time_ns, "_end": time_ns + period_ns}.items():
        write_stamps(out / "velodyne_points" / f"timestamps{name}.txt", dataset, times=times)
    drive.write_times(out, "image_{0:02d}/timestamps.txt")
    write_stamps(out / "oxts" / "timestamps.txt", dataset, times=time_ns)
    oxts = oxts_columns(drive)
    rows = zip(*(oxts[name].tolist() for name in _OXTS), strict=True)
    for row, values in enumerate(rows):
        write_lines(out / "oxts" / "data" / f"{row:010d}.txt", [" ".join(map(str, values))])
        drive.write_cloud(out / "velodyne_points" / "data" / f"{row:010d}.bin", row=row)
        drive.write_images(out, f"image_{{0:02d}}/data/{row:010d}.png", row=row)
        progress("KITTI raw", row + 1, total=len(drive))
    return {"clouds": len(drive), "images": len(drive) * len(drive.cameras), "poses": len(drive)}


def oxts_columns(drive: KittiDrive) -> dict[str, NDArray[Any]]:
    """The values of OXTS files (n,) of each frame, by name: true motion of the inertial unit.

    Angles are roll, pitch and yaw with R = Rz(yaw) Ry(pitch) Rx(roll), east, north, up from the unit's axes
    (x forward, y left, z up). x, y, z are along these axes; f, l, u along the level ones: forward, left, up.
    Accelerations include gravity, as accelerometers measure them. Accuracies and modes are 0.
    """
    frame, trajectory, mount = drive.dataset.frame, drive.trajectory, drive.inertial_unit
    time_ns = drive.clouds.time_ns
    position, velocity = antenna_motion(trajectory, frame, spec=GnssSpec("oxts", mount), time_ns=time_ns)
    rate, force = true_inertial(trajectory, frame, spec=ImuSpec("oxts", mount), time_ns=time_ns)
    lon, lat = frame.to_geographic(position[:, 0], position[:, 1])
    turn = trajectory.at(time_ns).mounted(mount.translation, mount.rotation).rotation
    north = _about_z(-frame.convergence(lon, lat))  # true east, north, up from the scene's axes
    roll, pitch, yaw = euler_from_quat(quat_from_matrix(north @ turn)).T
    level = _about_z(-yaw)
    tilt = level @ north @ turn
    columns = {"lat": lat, "lon": lon, "alt": position[:, 2], "roll": roll, "pitch": pitch, "yaw": yaw}
    columns |= {"vn": velocity[:, 1], "ve": velocity[:, 0]}
    columns |= dict(zip(("vf", "vl", "vu"), _apply(level, velocity).T, strict=True))
    for letter, vectors in (("a", force), ("w", rate)):
        columns |= {f"{letter}{axis}": vectors[:, k] for k, axis in enumerate("xyz")}
        columns |= {f"{letter}{axis}": v for axis, v in zip("flu", _apply(tilt, vectors).T, strict=True)}
    zero = np.zeros(len(drive), np.int64)
    columns |= {"pos_accuracy": zero, "vel_accuracy": zero, "navstat": zero + _NAVSTAT}
    return columns | {"numsats": _satellites(drive), "posmode": zero, "velmode": zero, "orimode": zero}


def _about_z(angle: Float) -> Float:
    """Rotations (n, 3, 3) about the z axis."""
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    return np.moveaxis(np.array([[c, -s, zero], [s, c, zero], [zero, zero, zero + 1]]), 2, 0)


def _apply(rotation: Float, vectors: Float) -> Float:
    """Vectors (n, 3) rotated by their rotations (n, 3, 3)."""
    return np.asarray(np.einsum("nij,nj->ni", rotation, vectors))


def _satellites(drive: KittiDrive) -> NDArray[np.int64]:
    """Satellites (n,) that the first receiver used at the epoch nearest to each frame; 0 without one."""
    for name in drive.dataset.sensors("gnss"):
        path, times = drive.dataset.paths.measurements(name), drive.dataset.sample_times(name)
        rows = read_rows(path)
        with reading_file(path):
            used = np.array([int(row["satellites"]) for row in rows], np.int64)
        if len(used):
            return used[nearest(times, drive.clouds.time_ns)]
    return np.zeros(len(drive), np.int64)


def _write_calibrations(drive: KittiDrive, folder: Path) -> None:
    """Write ``calib_imu_to_velo.txt``, ``calib_velo_to_cam.txt`` and ``calib_cam_to_cam.txt``."""
    stamp = drive.dataset.start.strftime("%d-%b-%Y %H:%M:%S")
    _write_calibration(folder / "calib_imu_to_velo.txt", stamp, values=_rigid(drive.lidar_from_imu))
    pixels = {"delta_f": np.zeros(2), "delta_c": np.zeros(2)}
    _write_calibration(
        folder / "calib_velo_to_cam.txt", stamp, values=_rigid(drive.camera_from_lidar) | pixels
    )
    cameras: dict[str, ArrayLike] = {"corner_dist": 0.0}
    for number in range(CAMERAS):
        values = drive.rectified(number) | {"P_rect": drive.projections[number]}
        cameras |= {f"{name}_{number:02d}": value for name, value in values.items()}
    _write_calibration(folder / "calib_cam_to_cam.txt", stamp, values=cameras)


def _rigid(transform: Float) -> dict[str, ArrayLike]:
    """Rotation and translation of a transformation (4, 4)."""
    return {"R": transform[:3, :3], "T": transform[:3, 3]}


def _write_calibration(path: Path, stamp: str, *, values: dict[str, ArrayLike]) -> None:
    lines = (f"{name}: {numbers(value)}" for name, value in values.items())
    write_lines(path, [f"calib_time: {stamp}", *lines])

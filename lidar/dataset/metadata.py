"""What a dataset holds beside clouds and images: poses, calibration, fixes, time stamps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.files import write_atomically, write_columns, write_json
from geoscene.frames import Frame
from geoscene.scene import Scene
from lidar.dataset.formats import kitti
from lidar.dataset.record import Contents
from lidar.geometry.attitude import euler_from_quat
from lidar.geometry.mounts import OPTICAL, Mount
from lidar.geometry.poses import Trajectory
from lidar.navigation.gnss import antenna_motion, epochs, gnss_columns, observe_gnss
from lidar.navigation.imu import imu_columns, observe_imu
from lidar.navigation.nmea import nmea
from lidar.navigation.satellite_visibility import sky_view
from lidar.rig.camera_model import intrinsic_matrix
from lidar.rig.devices import Camera, Scanner
from lidar.rig.specs import GnssSpec, Rig
from lidar.world.world import World


def iso_times(start: datetime, time_ns: NDArray[np.integer]) -> list[str]:
    """ISO 8601 UTC time stamps with nanoseconds of times since a start."""
    whole = start.replace(tzinfo=None)
    base = np.datetime64(whole - timedelta(microseconds=whole.microsecond), "ns")
    stamps = base + np.asarray(time_ns, "timedelta64[ns]") + np.timedelta64(whole.microsecond, "us")
    return [f"{s}Z" for s in np.datetime_as_string(stamps, unit="ns")]


def pose_columns(
    trajectory: Trajectory, frame: Frame, *, start: datetime, time_ns: NDArray[np.integer]
) -> dict[str, Any]:
    """Columns of ``poses.csv``: the vehicle at given times.

    x, y, z in scene metres; alpha, beta, gamma in radians with R = Rz(gamma) Ry(beta) Rx(alpha), scene axes
    from vehicle axes; lon, lat in degrees (WGS 84) and h in metres as the scene's heights.
    """
    poses = trajectory.at(time_ns)
    x, y, z = poses.position.T
    quat = _quaternions(poses.rotation)
    alpha, beta, gamma = np.moveaxis(euler_from_quat(quat), -1, 0)
    lon, lat = frame.to_geographic(x, y)
    return {
        "timestamp": iso_times(start, time_ns),
        "frame": np.arange(len(time_ns)),
        "x": x,
        "y": y,
        "z": z,
        "alpha": alpha,
        "beta": beta,
        "gamma": gamma,
        "qx": quat[:, 0],
        "qy": quat[:, 1],
        "qz": quat[:, 2],
        "qw": quat[:, 3],
        "lon": lon,
        "lat": lat,
        "h": z,
    }


def _quaternions(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    from scipy.spatial.transform import Rotation  # noqa: PLC0415

    quat: NDArray[np.float64] = Rotation.from_matrix(rotation).as_quat(canonical=True)
    return quat


def _mounted(mount: Mount) -> dict[str, Any]:
    return {
        "vehicle_from_sensor": _matrix(mount).tolist(),
        "translation": list(mount.translation),
        "quat_xyzw": list(mount.quat_xyzw),
    }


def calibration(rig: Rig, sensors: Sequence[Scanner | Camera]) -> dict[str, Any]:
    """What ``calibration.json`` says: mounts, rates and intrinsics."""
    out: dict[str, Any] = {}
    for kind, specs in (("gnss", rig.gnss), ("imu", rig.imus)):
        for spec in specs:
            rates = {"rate_hz": spec.rate_hz, "time_offset_ns": spec.time_offset_ns}
            out[spec.name] = {"kind": kind, **rates, **_mounted(spec.mount)}
    for sensor in sensors:
        if isinstance(sensor, Scanner):
            s = sensor.sensor
            out[sensor.name] = {
                "kind": "lidar",
                "model": f"{s.maker} {s.model}",
                "rate_hz": s.rate_hz,
                "time_offset_ns": s.start_ns,
                "wavelength_nm": s.wavelength_nm,
                "min_range": s.min_range,
                "max_range": s.max_range,
                "range_quantum": s.range_quantum,
                "return_mode": s.return_mode,
                "fmcw": s.fmcw,
                **_mounted(sensor.spec.mount),
            }
        else:
            c = sensor.spec
            out[sensor.name] = {
                "kind": "camera",
                "model": c.model,
                "rate_hz": c.rate_hz,
                "time_offset_ns": c.time_offset_ns,
                "width": c.width,
                "height": c.height,
                "K": intrinsic_matrix(c).tolist(),
                "distortion": list(c.distortion),
                "depth_counts_per_metre": 256,
                "exposure_ns": c.exposure_ns,
                "row_ns": c.row_ns,
                **_mounted(c.mount),
            }
    return {
        "frames": {
            "vehicle": "x forward, y left, z up; origin: the rear axle's centre on the ground",
            "lidar": "x forward, y left, z up",
            "camera": "x right, y down, z forward; the centre of the top-left pixel is (0, 0)",
        },
        "sensors": out,
    }


def write_sidecars(
    out: Path,
    scene: Scene,
    *,
    rig: Rig,
    sensors: Sequence[Scanner | Camera],
    trajectory: Trajectory,
    start: datetime,
    frames: Mapping[str, int],
    contents: Contents,
) -> None:
    """Write all but clouds and images.

    ``poses.csv`` (a row a frame of the first sensor), ``calibration.json``, time stamps by sensor, and
    ``<name>.csv`` of every receiver (also as NMEA sentences) and inertial unit of the rig; with KITTI's
    clouds or labels what makes a sequence of each scanner's folder.
    """
    seed = contents.seed
    sequences = "kitti" in contents.formats or "semantickitti" in contents.labels
    write_json(out / "calibration.json", calibration(rig, sensors))
    for k, sensor in enumerate(sensors):
        times = np.array([sensor.frame_start_ns(f) for f in range(frames[sensor.name])], np.int64)
        folder = out / sensor.name
        folder.mkdir(parents=True, exist_ok=True)
        stamps: dict[str, Any] = {"frame": np.arange(len(times)), "time_ns": times}
        write_columns(folder / "timestamps.csv", stamps | {"timestamp": iso_times(start, times)})
        if k == 0:
            write_columns(
                out / "poses.csv", pose_columns(trajectory, scene.frame, start=start, time_ns=times)
            )
        if sequences and isinstance(sensor, Scanner):
            _write_sequence(folder, rig, mount=sensor.spec.mount, trajectory=trajectory, times=times)
    for receiver in rig.gnss:
        _write_fixes(out, scene, spec=receiver, trajectory=trajectory, start=start, seed=seed)
    for unit in rig.imus:
        rows = observe_imu(trajectory, scene.frame, spec=unit, seed=seed)
        stamped: dict[str, Any] = {"timestamp": iso_times(start, rows.time_ns), **imu_columns(rows)}
        write_columns(out / f"{unit.name}.csv", stamped)


def _write_fixes(
    out: Path, scene: Scene, *, spec: GnssSpec, trajectory: Trajectory, start: datetime, seed: int
) -> None:
    times = epochs(spec, trajectory.duration_ns)
    antenna, _ = antenna_motion(trajectory, scene.frame, spec=spec, time_ns=times)

    def world_at(region: tuple[float, float, float, float]) -> World:
        return World.load(scene, region=region)

    sky = sky_view(
        scene.frame,
        antenna,
        start=start,
        time_ns=times,
        world_at=world_at,
        mask_deg=spec.mask_deg,
        systems=spec.constellations,
    )
    fixes = observe_gnss(trajectory, scene.frame, spec=spec, seed=seed, start=start, sky=sky)
    stamped: dict[str, Any] = {"timestamp": iso_times(start, fixes.time_ns), **gnss_columns(fixes)}
    write_columns(out / f"{spec.name}.csv", stamped)
    write_atomically(out / f"{spec.name}.nmea", "".join(nmea(fixes, start)).encode("ascii"))


def _write_sequence(
    folder: Path, rig: Rig, *, mount: Mount, trajectory: Trajectory, times: NDArray[np.int64]
) -> None:
    """Write KITTI's calib.txt, times.txt and poses.txt.

    The cameras are the rig's first four; without one, a camera at the scanner that looks along its x axis.
    """
    vehicle_from_lidar = _matrix(mount)
    if rig.cameras:
        first = _matrix(rig.cameras[0].mount)
        projections = [
            intrinsic_matrix(camera) @ (np.linalg.inv(_matrix(camera.mount)) @ first)[:3]
            for camera in rig.cameras
        ]
        camera_from_lidar = np.linalg.inv(first) @ vehicle_from_lidar
    else:
        projections = [np.eye(3, 4)]
        camera_from_lidar = np.eye(4)
        camera_from_lidar[:3, :3] = OPTICAL.T
    kitti.write_calibration(folder / "calib.txt", projections, camera_from_lidar=camera_from_lidar)
    if not len(times):
        return
    kitti.write_times(folder / "times.txt", times)
    at = trajectory.at(times).mounted(mount.translation, mount.rotation)
    world_from_lidar = np.tile(np.eye(4), (len(times), 1, 1))
    world_from_lidar[:, :3, :3] = at.rotation
    world_from_lidar[:, :3, 3] = at.position / at.scale[0]  # true metres
    kitti.write_poses(folder / "poses.txt", world_from_lidar, camera_from_lidar=camera_from_lidar)


def _matrix(mount: Mount) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3, :3] = mount.rotation
    matrix[:3, 3] = mount.translation
    return matrix

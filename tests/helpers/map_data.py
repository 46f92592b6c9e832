"""A small dataset whose points are known in the world."""

from datetime import UTC, datetime

import numpy as np
from pyproj import CRS

from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from geoscene.support.files import write_json
from lidar.dataset.formats import las, pcd
from lidar.dataset.formats.las import LasInfo
from lidar.dataset.layout import open_dataset
from lidar.geometry.georeference import Georeference
from lidar.geometry.poses import Trajectory
from lidar.geometry.time_scales import gps_seconds
from lidar.geometry.trajectory_files import write_trajectory

START = datetime(2026, 6, 21, 8, tzinfo=UTC)
FRAME = Frame.at(24.945, 60.167)
CRS_OUT = CRS.from_epsg(32635)
MOUNT = np.array([[0.0, -1, 0, 1.0], [1, 0, 0, 0.2], [0, 0, 1, 1.9], [0, 0, 0, 1]])


def trajectory():
    """Ten seconds at 10 m/s in a bend."""
    t = np.linspace(0, 10, 1001)
    yaw = 0.3 * t
    position = np.column_stack([np.sin(yaw), 1 - np.cos(yaw), 0 * t]) * 10 / 0.3
    quat = np.column_stack([0 * t, 0 * t, np.sin(yaw / 2), np.cos(yaw / 2)])
    velocity = 10 * np.column_stack([np.cos(yaw), np.sin(yaw), 0 * t])
    return Trajectory((t * 1e9).astype(np.int64), position, quat, velocity, np.ones(len(t)))


def world_points(k, n):
    """Points of frame k around the vehicle, scene metres, on a 1 cm lattice off voxel borders."""
    rng = np.random.default_rng(k)
    centre = trajectory().at([k * 100_000_000]).position[0]
    return np.round(centre + rng.uniform(-15, 15, (n, 3)) * [1, 1, 0.05] + [0, 0, 1], 2) + 0.0002


def dataset(path, *, first=0, frames=6, n=400, kinds=("laz",)):
    """A dataset of points known in the world, written as a drive would."""
    path.mkdir()
    write_json(
        path / "dataset.json",
        {
            "schema": 1,
            "scene": {"path": "scene"},
            "frame": FRAME.to_json(),
            "export_crs": CRS_OUT.to_wkt(),
            "start_time": START.isoformat(),
            "frames": frames,
            "frames_done": frames,
            "recipe": {},
        },
    )
    sensor = {"kind": "lidar", "rate_hz": 10.0, "time_offset_ns": 0, "vehicle_from_sensor": MOUNT.tolist()}
    write_json(path / "calibration.json", {"sensors": {"top": sensor, "camera": {"kind": "camera"}}})
    write_trajectory(path / "trajectory.csv", trajectory())
    geo = Georeference(FRAME, CRS_OUT, exact=True)
    for k in range(first, first + frames):
        xyz = world_points(k, n)
        time_ns = np.linspace(0, 99_000_000, n).astype(np.uint32)
        base = {
            "intensity": np.linspace(0, 100, n).astype(np.float32),
            "time_ns": time_ns,
            "ring": np.zeros(n, np.uint16),
            "label": np.resize([Class.ROAD, Class.BUILDING], n).astype(np.uint16),
            "instance": np.arange(n, dtype=np.int32),
        }
        if "laz" in kinds:
            east, north, up = geo.points(xyz).T
            gps = gps_seconds(START, time_ns + np.int64(k * 100_000_000))
            (path / "top" / "laz").mkdir(parents=True, exist_ok=True)
            table = {"x": east, "y": north, "z": up, "gps_time": gps} | base
            las.write(path / "top" / "laz" / f"{k:06d}.laz", table, info=LasInfo(CRS_OUT, geo.offset, START))
        if "pcd" in kinds:
            poses = (
                trajectory()
                .at(k * 100_000_000 + time_ns.astype(np.int64))
                .mounted(MOUNT[:3, 3], MOUNT[:3, :3])
            )
            local = np.einsum("nji,nj->ni", poses.rotation, xyz - poses.position).astype(np.float32)
            (path / "top" / "pcd").mkdir(parents=True, exist_ok=True)
            table = {"x": local[:, 0], "y": local[:, 1], "z": local[:, 2]} | base
            pcd.write(path / "top" / "pcd" / f"{k:06d}.pcd", table)
    return open_dataset(path)


def expected(frames=6, n=400):
    xyz = np.concatenate([world_points(k, n) for k in range(frames)])
    return Georeference(FRAME, CRS_OUT, exact=True).points(xyz)

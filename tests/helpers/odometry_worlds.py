"""A street of planes, and recorded drives along it whose sensors see points that are known."""

import numpy as np

from geoscene.support.files import write_json
from helpers.map_data import FRAME, START
from lidar.dataset.formats import pcd
from lidar.dataset.layout import open_dataset
from lidar.geometry.poses import Trajectory
from lidar.geometry.trajectory_files import write_trajectory

MOUNT = np.array([[0.0, -1, 0, 1.0], [1, 0, 0, 0.2], [0, 0, 1, 1.9], [0, 0, 0, 1]])
CALIBRATION = {"kind": "lidar", "rate_hz": 10.0, "time_offset_ns": 0, "max_range": 100.0}


def trajectory(seconds=10.0, *, speed=8.0, turn=0.1, climb=0.03):
    """A drive at even speed in a bend, uphill."""
    t = np.linspace(0, seconds, round(seconds * 100) + 1)
    yaw = turn * t
    if turn:
        position = np.column_stack([np.sin(yaw), 1 - np.cos(yaw), climb * turn * t]) * speed / turn
        position[:, 2] = climb * speed * t
    else:
        position = np.column_stack([speed * t, 0 * t, climb * speed * t])
    quat = np.column_stack([0 * t, 0 * t, np.sin(yaw / 2), np.cos(yaw / 2)])
    velocity = np.gradient(position, t, axis=0)
    return Trajectory((t * 1e9).astype(np.int64), position, quat, velocity, np.ones(len(t)))


def truth(path, time_ns):
    """True poses (n, 4, 4) of a trajectory."""
    found = path.at(time_ns)
    poses = np.tile(np.eye(4), (len(time_ns), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = found.rotation, found.position
    return poses


def surfaces(rng, count, *, around):
    """Points (count, 3) of a street around a place: ground, and houses with gaps and corners on a grid."""
    kind = rng.integers(0, 3, count)
    distance, angle = 40 * rng.random(count) ** 1.5, rng.uniform(0, 2 * np.pi, count)
    x, y = around[0] + distance * np.cos(angle), around[1] + distance * np.sin(angle)
    z = rng.uniform(-2, 6, count)
    # Houses are blocks of 12 by 12 m, every 20 m.
    wall_x = 20 * np.round((x - 6) / 20) + 12 * rng.integers(0, 2, count)
    wall_y = 20 * np.round((y - 6) / 20) + 12 * rng.integers(0, 2, count)
    within_y = (y % 20) < 12
    within_x = (x % 20) < 12
    points = np.column_stack([x, y, 0 * z - 3])
    on_x, on_y = (kind == 1) & within_y, (kind == 2) & within_x
    points[on_x] = np.column_stack([wall_x, y, z])[on_x]
    points[on_y] = np.column_stack([x, wall_y, z])[on_y]
    return points


def dataset(path, *, frames=12, points=12000, drive=None, mounts=None, rest=0):
    """A drive of scanners (``top`` by default), written as `lidar drive` does.

    rest : frames at the end without points
    """
    drive = drive or trajectory()
    mounts = mounts or {"top": MOUNT}
    path.mkdir()
    manifest = {"schema": 1, "scene": {"path": "scene"}, "frame": FRAME.to_json(), "export_crs": "EPSG:32635"}
    manifest |= {"start_time": START.isoformat(), "frames": frames, "frames_done": frames, "recipe": {}}
    write_json(path / "dataset.json", manifest)
    sensors = {name: CALIBRATION | {"vehicle_from_sensor": mount.tolist()} for name, mount in mounts.items()}
    write_json(path / "calibration.json", {"sensors": sensors})
    write_trajectory(path / "trajectory.csv", drive)
    for which, (name, mount) in enumerate(mounts.items()):
        (path / name / "pcd").mkdir(parents=True)
        lines = [f"{k},{k * 100_000_000},x\n" for k in range(frames)]
        (path / name / "timestamps.csv").write_text("frame,time_ns,timestamp\n" + "".join(lines))
        for k in range(frames):
            rng = np.random.default_rng([which, k])
            count = 0 if k >= frames - rest else points
            time_ns = np.linspace(0, 99_900_000, count).astype(np.uint32)
            poses = drive.at(k * 100_000_000 + time_ns.astype(np.int64)).mounted(mount[:3, 3], mount[:3, :3])
            world = surfaces(rng, count, around=drive.at([k * 100_000_000]).position[0])
            local = np.einsum("nji,nj->ni", poses.rotation, world - poses.position).astype(np.float32)
            table = {"x": local[:, 0], "y": local[:, 1], "z": local[:, 2]}
            table |= {"intensity": np.zeros(count, np.float32), "time_ns": time_ns}
            table |= {"ring": np.zeros(count, np.uint16), "label": np.zeros(count, np.uint16)}
            pcd.write(path / name / "pcd" / f"{k:06d}.pcd", table | {"instance": np.zeros(count, np.int32)})
    return open_dataset(path)

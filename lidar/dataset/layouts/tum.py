"""Trajectories as text files of TUM and of KITTI, for evo and other programs that compare trajectories.

Positions of TUM's are true metres from the scene's origin, x east, y north, z up. A line of KITTI's is the
same pose relative to the first, as 12 numbers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoscene.support.progress import Progress
from lidar.dataset.layout import Dataset
from lidar.dataset.layouts.kitti_drive import write_poses
from lidar.geometry.attitude import quat_from_matrix
from lidar.geometry.poses import Poses
from lidar.geometry.time_scales import posix_ns
from lidar.geometry.trajectory_files import write_tum


def export(dataset: Dataset, folder: Path, *, progress: Progress) -> dict[str, int]:
    """Write ``vehicle`` and ``sensors/<name>`` as ``.tum`` and ``.kitti``; return their numbers and of poses.

    The vehicle's poses are those of ``trajectory.csv``. A sensor's are at the start of each of its frames, or
    at each of its measurements; a camera's axes are x right, y down, z forward.
    """
    trajectory, sensors = dataset.trajectory(), dataset.sensors()
    times = {name: dataset.sample_times(name) for name in sensors}
    base_ns = posix_ns(dataset.start)
    _write(folder / "vehicle", trajectory.at(trajectory.time_ns), time_ns=base_ns + trajectory.time_ns)
    for k, (name, time_ns) in enumerate(times.items()):
        mount = np.array(sensors[name]["vehicle_from_sensor"])
        poses = trajectory.at(time_ns).mounted(mount[:3, 3], mount[:3, :3])
        _write(folder / "sensors" / name, poses, time_ns=base_ns + time_ns)
        progress("TUM", k + 1, total=len(times))
    return {"trajectories": 1 + len(times), "poses": sum(map(len, (trajectory.time_ns, *times.values())))}


def _write(path: Path, poses: Poses, *, time_ns: NDArray[np.int64]) -> None:
    """Write poses at times in nanoseconds since 1970 to ``<path>.tum`` and ``<path>.kitti``."""
    quat = quat_from_matrix(poses.rotation)
    write_tum(
        path.with_name(f"{path.name}.tum"),
        time_ns,
        position=poses.position / poses.scale[:1],
        quat_xyzw=quat,
    )
    if len(time_ns):
        write_poses(path.with_name(f"{path.name}.kitti"), poses)

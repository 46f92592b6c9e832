"""Trajectories as text files of TUM and of KITTI, for evo and other programs that compare trajectories.

A line of TUM's is ``timestamp tx ty tz qx qy qz qw`` (Sturm et al. 2012): POSIX seconds (UTC) with
nanoseconds; position in true metres from the scene's origin, x east, y north, z up; rotation of those axes
from the body's axes. A line of KITTI's is the same pose relative to the first, as 12 numbers.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoscene.files import write_atomically
from geoscene.progress import Progress
from lidar.dataset.kitti_sequence import write_poses
from lidar.dataset.layout import Dataset
from lidar.geometry.attitude import quat_from_matrix
from lidar.geometry.poses import Poses


def export(dataset: Dataset, folder: Path, *, progress: Progress) -> dict[str, int]:
    """Write ``vehicle`` and ``sensors/<name>`` as ``.tum`` and ``.kitti``; return their numbers and of poses.

    The vehicle's poses are those of ``trajectory.csv``. A sensor's are at the start of each of its frames, or
    at each of its measurements; a camera's axes are x right, y down, z forward.
    """
    trajectory, sensors = dataset.trajectory(), dataset.sensors()
    times = {name: dataset.sample_times(name) for name in sensors}
    base_ns = (dataset.start - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1) * 1000
    _write(folder / "vehicle", trajectory.at(trajectory.time_ns), time_ns=base_ns + trajectory.time_ns)
    for k, (name, time_ns) in enumerate(times.items()):
        mount = np.array(sensors[name]["vehicle_from_sensor"])
        poses = trajectory.at(time_ns).mounted(mount[:3, 3], mount[:3, :3])
        _write(folder / "sensors" / name, poses, time_ns=base_ns + time_ns)
        progress("TUM", k + 1, total=len(times))
    return {"trajectories": 1 + len(times), "poses": sum(map(len, (trajectory.time_ns, *times.values())))}


def _write(path: Path, poses: Poses, *, time_ns: NDArray[np.int64]) -> None:
    """Write poses at times in nanoseconds since 1970 to ``<path>.tum`` and ``<path>.kitti``."""
    columns = np.hstack([poses.position / poses.scale[:1], quat_from_matrix(poses.rotation)]).tolist()
    seconds, rest = np.divmod(time_ns, 10**9)
    rows = zip(seconds.tolist(), rest.tolist(), columns, strict=True)
    lines = [f"{s}.{ns:09d} {' '.join(map(str, row))}\n" for s, ns, row in rows]
    write_atomically(path.with_name(f"{path.name}.tum"), "".join(lines).encode("ascii"))
    if len(time_ns):
        write_poses(path.with_name(f"{path.name}.kitti"), poses)

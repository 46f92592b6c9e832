"""Motion of a vehicle from its scanner and what else it measured: every sweep is aligned to those before."""

from __future__ import annotations

import numpy as np

from geoscene.support.progress import Progress
from geoscene.typing import Float
from lidar.dataset.recorded import Stream, cloud_points
from lidar.tools.maps.measured_poses import RelativeMotion
from lidar.tools.odometry.deskewing import still
from lidar.tools.odometry.local_map import LocalMap

_NEAREST = 3.0  # metres from the scanner, below which returns may be of the vehicle itself
_DRIFT = (0.0006, 0.006)
"""Radians and metres per root of a second: standard deviation of aligned motion, of each component."""


def aligned_motion(clouds: Stream, motion: RelativeMotion, *, progress: Progress) -> RelativeMotion:
    """Motion of the vehicle from the start of each frame to that of the next, by alignment.

    motion : measured, from the start of each frame to that of the next, and to the end of the last one

    Sweeps are de-skewed with the measured motion and aligned to the planes of a map of sweeps before from
    where that motion leads (`odometry.local_map`). Sweeps with few points, and the last frame, keep the
    measured motion. Labels are not used.

    Raises MissingExtraError without small_gicp, and DatasetError for damaged clouds.
    """
    step, sigma = motion.step.copy(), motion.sigma.copy()
    duration_ns = np.diff(motion.time_ns)
    pose, local = np.eye(4), LocalMap("registration")
    for k in range(len(clouds.files)):
        progress("aligning sweeps", k + 1, total=len(clouds.files))
        points = _still_points(clouds, k, motion=motion.step[k], duration_ns=int(duration_ns[k]))
        sweep = local.thinned(points)
        start = pose @ motion.step[k - 1] if k else pose
        found = local.aligned(sweep, start, sigma=motion.sigma[k - 1]) if k else None
        if found is not None:
            step[k - 1] = np.linalg.inv(pose) @ found.pose
            sigma[k - 1] = np.repeat(_DRIFT, 3) * np.sqrt(duration_ns[k - 1] * 1e-9)
        pose = start if found is None else found.pose
        local.add(sweep, pose)
    return RelativeMotion(motion.time_ns, step, sigma)


def _still_points(clouds: Stream, row: int, *, motion: Float, duration_ns: int) -> Float:
    """Points (n, 3) of a sweep in the frame of the vehicle at its start, without the vehicle's motion.

    motion : (4, 4) of the vehicle within ``duration_ns`` of the start
    """
    table, mount = cloud_points(clouds.files[row]), clouds.mount.matrix
    points = np.column_stack([table[axis] for axis in "xyz"]).astype(float)
    seen = np.einsum("ij,ij->i", points, points) > _NEAREST**2
    points = points[seen] @ mount[:3, :3].T + mount[:3, 3]
    return still(points, table["time_ns"][seen] / duration_ns, motion=motion)

"""LiDAR odometry by packages: KISS-ICP, GenZ-ICP and small_gicp.

All get the same sweeps: in the vehicle's frame at the end of the sweep, without the motion that the vehicle
has if it moves on as in the sweep before (the motion compensation of Vizzo et al. 2023).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import metadata
from typing import Protocol

import numpy as np

from geoscene.errors import need
from geoscene.progress import Progress
from geoscene.typing import Float, Ints
from lidar.odometry.deskewing import still
from lidar.odometry.estimate import Estimate, propagated
from lidar.odometry.local_map import LocalMap
from lidar.odometry.scans import Scans
from lidar.odometry.settings import OdometrySettings

_LEAST = 50  # points of a sweep, below which the vehicle moves on as before
_SPEEDS = np.arange(0.0, 41.0, 2.0)  # m/s ahead, with which the first sweeps are tried
_OPEN = (0.1, 10.0)  # rad/s and m/s: standard deviations of the motion about these


class _Registration(Protocol):
    """Aligns sweeps one after the other."""

    def __call__(self, points: Float, last: Float, *, step: Float) -> tuple[Float, Float | None]:
        """The pose (4, 4) of the next sweep, and its information (6, 6) if it is stated.

        points : (n, 3) of the sweep without motion
        last   : (4, 4) pose of the sweep before
        step   : (4, 4) expected motion since then
        """


def lidar_odometry(scans: Scans, method: str, *, settings: OdometrySettings, progress: Progress) -> Estimate:
    """Poses of the vehicle at the ends of sweeps, relative to the first.

    method : of `LIDAR_METHODS`

    Sweeps with few points move on as before, and are counted. Runs give the same bytes.

    Raises MissingExtraError without the package, and FormatError or DatasetError for damaged clouds.
    """
    first = first_motion(scans, settings)
    register = LIDAR_METHODS[method](scans, settings)
    poses, information, counts, step = [np.eye(4)], [], [], first
    for k in range(len(scans)):
        points = _still_sweep(scans, k, motion=step)
        counts.append(len(points))
        pose, found = poses[-1] @ step if k else poses[-1], None
        if len(points) >= _LEAST:
            pose, found = register(points, poses[-1], step=step if k else np.eye(4))
        if k:
            step = np.linalg.inv(poses[-1]) @ pose
            poses.append(pose)
            information.append(found)
        progress("aligning sweeps", k + 1, total=len(scans))
    covered = np.array(poses)
    sigma = step_sigma = None
    if any(one is not None for one in information):
        free = np.diag(_usual(scans, settings) ** 2)
        covariance = [free if one is None else np.linalg.inv(one) for one in information]
        sigma = propagated(covered, np.array(covariance))
        step_sigma = np.sqrt(np.einsum("nii->ni", np.array(covariance)))
    points_of = np.array(counts, np.int64)
    return Estimate(
        scans.time_ns,
        covered,
        sigma,
        step_sigma,
        {"points": points_of},
        _report(scans, method, counts=points_of),
    )


def _report(scans: Scans, method: str, *, counts: Ints) -> dict[str, object]:
    return {
        "method": method,
        "package": f"{method} {metadata.version(method)}",
        "sensors": [stream.name for stream in scans.streams],
        "frames": len(scans),
        "pose_of_a_frame": "at its end" if scans.period_ns else "at its start",
        "times_of_points": bool(scans.period_ns),
        "frames_without_alignment": int(np.count_nonzero(counts < _LEAST)),
    }


def first_motion(scans: Scans, settings: OdometrySettings) -> Float:
    """Motion (4, 4) of the vehicle in the first sweep.

    The first two sweeps are de-skewed and aligned with several speeds ahead; that counts with which most
    points match. An alignment without one errs by the skew of the sweeps, which is as long as the way.

    Raises MissingExtraError without small_gicp, and FormatError or DatasetError for damaged clouds.
    """
    seconds, best, most = _seconds(scans), np.eye(4), 0.0
    sigma = np.repeat(_OPEN, 3) * seconds
    for speed in _SPEEDS:
        step, local = np.eye(4), LocalMap("odometry", **_voxels(settings))
        step[0, 3] = speed * seconds
        first, second = (local.thinned(_still_sweep(scans, k, motion=step)) for k in (0, 1))
        local.add(first, np.eye(4))
        found = local.aligned(second, step, sigma=sigma)
        if found is not None and found.matched > most:
            best, most = found.pose, found.matched
    return best


def _still_sweep(scans: Scans, row: int, *, motion: Float) -> Float:
    """Points (n, 3) of a sweep in the vehicle's frame at the time of its pose.

    motion : (4, 4) of the vehicle in a sweep
    """
    points, share = scans.sweep(row)
    return still(points, share, motion=motion) if scans.period_ns else points


def _kiss_icp(scans: Scans, settings: OdometrySettings) -> _Registration:
    """Point to point with an adaptive threshold (Vizzo et al. 2023)."""
    package, config_of = need("kiss_icp.kiss_icp", "odometry"), need("kiss_icp.config", "odometry")
    config = config_of.KISSConfig()
    config.data.max_range, config.data.min_range, config.data.deskew = scans.farthest, 0.0, False
    config.mapping.voxel_size = settings.voxel or scans.farthest / 100
    config.registration.max_num_threads = 1  # sums of several threads differ from run to run
    odometry = package.KissICP(config)

    def register(points: Float, last: Float, *, step: Float) -> tuple[Float, None]:
        odometry.last_pose, odometry.last_delta = last, step
        odometry.register_frame(points, np.empty(0))
        return np.array(odometry.last_pose), None

    return register


def _genz_icp(scans: Scans, settings: OdometrySettings) -> _Registration:
    """Point to point and point to plane, weighted by what surfaces are planar (Lee et al. 2025)."""
    package, config_of = need("genz_icp.genz_icp", "odometry"), need("genz_icp.config", "odometry")
    config = config_of.GenZConfig()
    config.data.max_range, config.data.min_range, config.data.deskew = scans.farthest, 0.0, False
    config.mapping.map_cleanup_radius = scans.farthest
    if settings.voxel:
        config.mapping.voxel_size = settings.voxel
    odometry = package.GenZICP(config)

    def register(points: Float, last: Float, *, step: Float) -> tuple[Float, None]:
        del last, step  # its motion model is within it
        with _one_core():
            odometry.register_frame(points, np.empty(0))
        return np.array(odometry.last_pose), None

    return register


@contextmanager
def _one_core() -> Iterator[None]:
    """Let this thread and those that it starts run on one core, where the system can tell them to.

    GenZ-ICP has as many threads as there are cores when it first runs, and no setting for it. Sums of several
    threads differ from run to run.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def _small_gicp(scans: Scans, settings: OdometrySettings) -> _Registration:
    """Point to plane to a map of planes, with the motion before as a prior (`lidar.odometry.local_map`)."""
    local, sigma = LocalMap("odometry", **_voxels(settings)), _usual(scans, settings)

    def register(points: Float, last: Float, *, step: Float) -> tuple[Float, Float | None]:
        sweep, pose = local.thinned(points), last @ step
        found = local.aligned(sweep, pose, sigma=sigma)
        if found is not None:
            pose = found.pose
        local.add(sweep, pose)
        return pose, None if found is None else found.information

    return register


def _voxels(settings: OdometrySettings) -> dict[str, float]:
    side = settings.voxel or 0.5
    return {"source_voxel": 2 * side, "target_voxel": side}


def _usual(scans: Scans, settings: OdometrySettings) -> Float:
    """Standard deviations (6,) of the motion from a sweep to the next about that of the sweep before."""
    return np.repeat([settings.turn_acceleration, settings.acceleration], 3) * _seconds(scans) ** 2


def _seconds(scans: Scans) -> float:
    return 1.0 / float(scans.streams[0].sensor["rate_hz"])


LIDAR_METHODS: dict[str, Callable[[Scans, OdometrySettings], _Registration]] = {
    "kiss-icp": _kiss_icp,
    "genz-icp": _genz_icp,
    "small_gicp": _small_gicp,
}
"""Methods by their names."""

"""LiDAR odometry by packages: KISS-ICP, GenZ-ICP and small_gicp.

All get the same sweeps: in the vehicle's frame at the end of the sweep, without the motion that the vehicle
has if it moves on as in the sweep before (the motion compensation of Vizzo et al. 2023).
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from typing import Any, NamedTuple, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from geoscene.errors import need
from geoscene.support.progress import Progress
from geoscene.typing import Float, Ints
from lidar.tools.odometry.estimate import MotionEstimate, propagate
from lidar.tools.odometry.scans import SweepSequence, still
from lidar.tools.odometry.settings import OdometrySettings

_NEIGHBOURS = 20  # points of the map that tell the normal of one
_THICK = 0.05  # metres: standard deviation of neighbours from their plane, up to which they are in one
_WIDE = 0.02  # variance across over variance along, from which neighbours are not on a line
_KEYS = 20  # sweeps of which the map is made
_APART = (1.5, 0.1)  # metres or radians from the last of them to the next
_FEWEST = 50  # points on which an alignment stands, at least
_NOISE = 0.2  # metres: standard deviation of a point from the planes, which are not everywhere flat
_REACH = (1.0, 0.3)  # metres between a point and the map: first, and then, without what moves
_LEAST = 50  # points of a sweep, below which the vehicle moves on as before
_SPEEDS = np.arange(0.0, 41.0, 10.0)  # m/s ahead, from which the first motion is sought
_ROUNDS = 4  # of de-skewing and alignment from each, at most
_SAME = 0.02  # metres between motions that are the same
_FIRST_VOXEL = 0.25  # metres: in larger ones, rings of two sweeps match wherever the vehicle is
_CLEARLY = 1.05  # times as many points match at a greater speed that is preferred
_OPEN = (0.1, 10.0)  # rad/s and m/s: standard deviations of the motion about these
_UNSURE = 0.3  # metres: error of the expected motion with which KISS-ICP and GenZ-ICP begin
_GENZ_POINTS = 4000  # of a sweep, which GenZ-ICP aligns: its 2000 are too few for the 64 rings of a street


class ScanAlignment(NamedTuple):
    """The most likely pose (4, 4) of a sweep.

    information : (6, 6) of small rotations and translations along the sweep's own axes
    matched     : share of the thinned sweep's points that are on the map
    """

    pose: Float
    information: Float
    matched: float


class LocalMap:
    """Points of the last sweeps that are some way apart, with normals.

    Normals are those of the map, at points whose neighbours are in a plane: elsewhere a ring of one sweep
    would be drawn to the same ring of another, which hides pitch.

    source_voxel  : metres, to which a sweep is thinned
    target_voxel  : metres, to which the map is thinned

    Raises MissingExtraError without small_gicp.
    """

    def __init__(self, *, source_voxel: float, target_voxel: float) -> None:
        self._gicp = need("small_gicp", "odometry")
        self._source_voxel, self._target_voxel = source_voxel, target_voxel
        self._keys: deque[Float] = deque(maxlen=_KEYS)
        self._last = np.eye(4)
        self._target: tuple[Any, Any] | None = None  # points with normals, and their tree

    def thinned(self, points: Float) -> Any:
        """A sweep (n, 3) without its motion, thinned for `add` and `aligned`."""
        return self._gicp.voxelgrid_sampling(points, self._source_voxel, num_threads=1)

    def add(self, sweep: Any, pose: Float) -> None:
        """Add a sweep if its pose is some way from that of the last one."""
        moved = np.linalg.inv(self._last) @ pose
        turned = Rotation.from_matrix(moved[:3, :3]).magnitude()
        near = np.linalg.norm(moved[:3, 3]) < _APART[0] and turned < _APART[1]
        if sweep.size() < _FEWEST or (near and self._keys):
            return
        self._last = pose
        self._keys.append(sweep.points()[:, :3] @ pose[:3, :3].T + pose[:3, 3])
        thinned = self._gicp.voxelgrid_sampling(np.concatenate(self._keys), self._target_voxel, num_threads=1)
        self._target = self._gicp.preprocess_points(
            self._planar(thinned),
            downsampling_resolution=self._target_voxel / 10,  # which keeps the points as they are
            num_neighbors=_NEIGHBOURS,
            num_threads=1,
        )

    def _planar(self, cloud: Any) -> Float:
        """The points (n, 3) of a cloud whose neighbours are in a plane, and not on a line."""
        points: Float = cloud.points()[:, :3]
        index, _ = self._gicp.KdTree(cloud, num_threads=1).batch_knn_search(
            cloud.points(), min(_NEIGHBOURS, len(points)), num_threads=1
        )
        near = points[index.astype(np.int64)]
        near -= near.mean(axis=1, keepdims=True)
        spread = np.linalg.eigvalsh(np.swapaxes(near, 1, 2) @ near / near.shape[1])
        flat = (spread[:, 0] < _THICK**2) & (spread[:, 1] > _WIDE * spread[:, 2])
        return points[flat] if np.count_nonzero(flat) >= _FEWEST else points

    def aligned(self, sweep: Any, start: Float, *, sigma: Float) -> ScanAlignment | None:
        """The most likely pose of a sweep from an expected one and its alignment; None if few points match.

        sigma : (6,) standard deviations of the expected pose's rotation and translation

        Alignment and expectation have the weight of their information: between flat walls an alignment says
        little about the motion along a street.
        """
        if self._target is None or sweep.size() < _FEWEST:
            return None
        aligned = start
        for reach in _REACH:
            found = self._gicp.align(
                self._target[0],
                sweep,
                self._target[1],
                init_T_target_source=aligned,
                registration_type="PLANE_ICP",
                max_correspondence_distance=reach,
                num_threads=1,  # sums of several threads differ from run to run
                max_iterations=30,
                rotation_epsilon=1e-5,
                translation_epsilon=1e-4,
            )
            if found.num_inliers < _FEWEST:
                return None
            aligned = np.asarray(found.T_target_source)
        back = np.linalg.inv(aligned) @ start
        wanted = np.concatenate([Rotation.from_matrix(back[:3, :3]).as_rotvec(), back[:3, 3]])
        given = np.diag(sigma**-2)
        information = np.asarray(found.H) / _NOISE**2 + given
        shift = np.linalg.solve(information, given @ wanted)
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = Rotation.from_rotvec(shift[:3]).as_matrix(), shift[3:]
        return ScanAlignment(aligned @ step, information, found.num_inliers / sweep.size())


class _Registration(Protocol):
    """Aligns sweeps one after the other."""

    def __call__(self, points: Float, last: Float, *, step: Float) -> tuple[Float, Float | None]:
        """The pose (4, 4) of the next sweep, and its information (6, 6) if it is stated.

        points : (n, 3) of the sweep without motion
        last   : (4, 4) pose of the sweep before
        step   : (4, 4) expected motion since then
        """


class _Method(Protocol):
    """Begins the alignment of sweeps.

    first : (4, 4) motion of the vehicle in the first sweep
    """

    def __call__(
        self, scans: SweepSequence, settings: OdometrySettings, *, first: Float
    ) -> _Registration: ...


def lidar_odometry(
    scans: SweepSequence, method: str, *, settings: OdometrySettings, progress: Progress
) -> MotionEstimate:
    """Poses of the vehicle at the ends of sweeps, relative to the first.

    method : of `LIDAR_METHODS`

    Sweeps with few points move on as before, and are counted. Runs give the same bytes.

    Raises MissingExtraError without the package, and FormatError or DatasetError for damaged clouds.
    """
    first = first_motion(scans)
    register = LIDAR_METHODS[method](scans, settings, first=first)
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
        sigma = propagate(covered, np.array(covariance))
        step_sigma = np.sqrt(np.einsum("nii->ni", np.array(covariance)))
    points_of = np.array(counts, np.int64)
    return MotionEstimate(
        scans.time_ns,
        covered,
        sigma,
        step_sigma,
        {"points": points_of},
        _report(scans, method, counts=points_of),
    )


def _report(scans: SweepSequence, method: str, *, counts: Ints) -> dict[str, object]:
    return {
        "method": method,
        "package": f"{method} {metadata.version(method)}",
        "sensors": [stream.name for stream in scans.streams],
        "frames": len(scans),
        "pose_of_a_frame": "at its end" if scans.period_ns else "at its start",
        "times_of_points": bool(scans.period_ns),
        "frames_without_alignment": int(np.count_nonzero(counts < _LEAST)),
    }


def first_motion(scans: SweepSequence) -> Float:
    """Motion (4, 4) of the vehicle in the first sweep.

    The second sweep is aligned to the first with the motion by which both are de-skewed; what is found
    de-skews them again, until it is the motion that it was found with. Such motions are sought from several
    speeds ahead. That with which most points match counts, and of about equal ones the slowest: on a plane
    all match.

    An alignment without de-skewing errs by the skew of the sweeps, which is as long as the way.

    Raises MissingExtraError without small_gicp, and FormatError or DatasetError for damaged clouds.
    """
    seconds = _seconds(scans)
    sigma = np.repeat(_OPEN, 3) * seconds
    best, most, known = np.eye(4), 0.0, list[Float]()
    for speed in _SPEEDS:
        motion, matched = np.eye(4), 0.0
        motion[0, 3] = speed * seconds
        for _ in range(_ROUNDS):
            local = LocalMap(source_voxel=_FIRST_VOXEL, target_voxel=_FIRST_VOXEL)
            first, second = (local.thinned(_still_sweep(scans, row, motion=motion)) for row in (0, 1))
            local.add(first, np.eye(4))
            found = local.aligned(second, motion, sigma=sigma)
            if found is None:
                break
            known.append(motion[:3, 3])
            motion, matched = found.pose, found.matched
            if np.linalg.norm(motion[:3, 3] - known, axis=1).min() < _SAME:
                break
        if matched > _CLEARLY * most:
            best, most = motion, matched
    return best


def _still_sweep(scans: SweepSequence, row: int, *, motion: Float) -> Float:
    """Points (n, 3) of a sweep in the vehicle's frame at the time of its pose.

    motion : (4, 4) of the vehicle in a sweep
    """
    points, share = scans.sweep(row)
    return still(points, share, motion=motion) if scans.period_ns else points


def _kiss_icp(scans: SweepSequence, settings: OdometrySettings, *, first: Float) -> _Registration:
    """Point to point with an adaptive threshold (Vizzo et al. 2023).

    The threshold begins at what is open once the first motion is known. The package's own, 2 m, holds as
    long as a vehicle moves evenly, and draws sweeps to the rings of the one before.
    """
    del first  # each sweep has its expected motion
    package, config_of = need("kiss_icp.kiss_icp", "odometry"), need("kiss_icp.config", "odometry")
    config = config_of.KISSConfig()
    config.data.max_range, config.data.min_range, config.data.deskew = scans.farthest, 0.0, False
    config.mapping.voxel_size = settings.voxel or scans.farthest / 100
    config.adaptive_threshold.initial_threshold = _UNSURE
    config.registration.max_num_threads = 1  # sums of several threads differ from run to run
    odometry = package.KissICP(config)

    def register(points: Float, last: Float, *, step: Float) -> tuple[Float, None]:
        odometry.last_pose, odometry.last_delta = last, step
        odometry.register_frame(points, np.empty(0))
        return np.array(odometry.last_pose), None

    return register


def _genz_icp(scans: SweepSequence, settings: OdometrySettings, *, first: Float) -> _Registration:
    """Point to point and point to plane, weighted by what surfaces are planar (Lee et al. 2025).

    Its motion model is within it and begins at rest. So the first sweep goes before itself, as seen from
    where the vehicle was a sweep earlier.
    """
    package, config_of = need("genz_icp.genz_icp", "odometry"), need("genz_icp.config", "odometry")
    config = config_of.GenZConfig()
    config.data.max_range, config.data.min_range, config.data.deskew = scans.farthest, 0.0, False
    config.mapping.map_cleanup_radius = scans.farthest
    config.mapping.desired_num_voxelized_points = _GENZ_POINTS
    config.adaptive_threshold.initial_threshold = _UNSURE
    if settings.voxel:
        config.mapping.voxel_size = settings.voxel
    _set_voxel(package.GenZICP, config_of.GenZConfig(), metres=config.mapping.voxel_size)
    odometry = package.GenZICP(config)
    begin: list[Float] = []  # pose of the package's map

    def register(points: Float, last: Float, *, step: Float) -> tuple[Float, None]:
        with _one_core():
            if not begin:
                odometry.register_frame(points @ first[:3, :3].T + first[:3, 3], np.empty(0))
            odometry.register_frame(points, np.empty(0))
        found = np.array(odometry.last_pose)
        if not begin:
            begin.append(last @ step @ np.linalg.inv(found))
        return begin[0] @ found, None

    return register


def _set_voxel(odometry_of: Any, config: Any, *, metres: float) -> None:
    """Let GenZ-ICP begin with voxels of a size.

    The package keeps their size in the process (a static variable), so that a run would depend on those
    before it. It multiplies the size by the occupied voxels over those wanted, and keeps it above 2 cm: a
    single point brings it there, and a lattice of points to where it should be.
    """
    least, wanted = 0.02, 50
    config.data.min_range, config.data.deskew = 0.0, False
    config.mapping.desired_num_voxelized_points = wanted
    count = round(metres / least * wanted)
    lattice = np.stack(np.unravel_index(np.arange(count), (20, 20, 1 + count // 400)), axis=1) * 0.05
    with _one_core():
        odometry = odometry_of(config)
        for points in (lattice[:1], lattice[:1], lattice):
            odometry.register_frame(points, np.empty(0))


@contextmanager
def _one_core() -> Iterator[None]:
    """Restrict this thread and its children to one core, where the system supports it.

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


def _small_gicp(scans: SweepSequence, settings: OdometrySettings, *, first: Float) -> _Registration:
    """Point to plane to a map of planes, with the motion before as a prior (`LocalMap`)."""
    del first  # each sweep has its expected motion
    side = settings.voxel or 0.25
    local = LocalMap(source_voxel=2 * side, target_voxel=side)
    sigma = _usual(scans, settings)

    def register(points: Float, last: Float, *, step: Float) -> tuple[Float, Float | None]:
        sweep, pose = local.thinned(points), last @ step
        found = local.aligned(sweep, pose, sigma=sigma)
        if found is not None:
            pose = found.pose
        local.add(sweep, pose)
        return pose, None if found is None else found.information

    return register


def _usual(scans: SweepSequence, settings: OdometrySettings) -> Float:
    """Standard deviations (6,) of the motion from a sweep to the next about that of the sweep before."""
    return np.repeat([settings.turn_acceleration, settings.acceleration], 3) * _seconds(scans) ** 2


def _seconds(scans: SweepSequence) -> float:
    return 1.0 / float(scans.streams[0].sensor["rate_hz"])


LIDAR_METHODS: dict[str, _Method] = {"kiss-icp": _kiss_icp, "genz-icp": _genz_icp, "small_gicp": _small_gicp}
"""Methods by their names."""

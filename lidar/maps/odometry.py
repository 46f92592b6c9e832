"""Motion of a vehicle from its scanner: every sweep is aligned to the sweeps before (scan to map)."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from geoscene.errors import need
from geoscene.progress import Progress
from geoscene.typing import Float
from lidar.dataset.recorded import Stream, cloud_points
from lidar.maps.measured_poses import Motion

_NEAREST = 3.0  # metres from the scanner, below which returns may be of the vehicle itself
_SOURCE = 1.0  # metres: voxels to which a sweep is thinned
_TARGET = 0.5  # metres: voxels to which the map is thinned
_NEIGHBOURS = 20  # points of the map that tell the normal of one
_THICK = 0.05  # metres: standard deviation of neighbours from their plane, up to which they are in one
_WIDE = 0.02  # variance across over variance along, from which neighbours are not on a line
_REACH = (1.0, 0.3)  # metres between a point and the map: first, and then, without what moves
_KEYS = 20  # sweeps of which the map is made
_APART = (1.5, 0.1)  # metres or radians from the last of them to the next
_LEAST = 50  # points on which an alignment stands, at least
_NOISE = 0.2  # metres: standard deviation of a point from the planes, which are not everywhere flat
_DRIFT = (0.0006, 0.006)
"""Radians and metres per root of a second: standard deviation of aligned motion, of each component."""


def aligned_motion(clouds: Stream, motion: Motion, *, progress: Progress) -> Motion:
    """Motion of the vehicle from the start of each frame to that of the next, by alignment.

    motion : measured, from the start of each frame to that of the next, and to the end of the last one

    Sweeps are de-skewed with the measured motion and aligned to the planes of a map of sweeps before (ICP of
    points to planes, by small_gicp) from where that motion leads. Normals are those of the map, at points
    whose neighbours are in a plane: elsewhere a ring of one sweep would be drawn to the same ring of another,
    which hides pitch. Alignment and measured motion have the weight of their information: between flat walls
    an alignment says little about the motion along a street. Sweeps with few points, and the last frame, keep
    the measured motion. Labels are not used.

    Raises MissingExtraError without small_gicp, and DatasetError for damaged clouds.
    """
    gicp = need("small_gicp", "registration")
    step, sigma = motion.step.copy(), motion.sigma.copy()
    duration_ns = np.diff(motion.time_ns)
    pose, local = np.eye(4), _LocalMap(gicp)
    for k in range(len(clouds.files)):
        progress("aligning sweeps", k + 1, total=len(clouds.files))
        points = _still_points(clouds, k, motion=motion.step[k], duration_ns=int(duration_ns[k]))
        sweep = gicp.voxelgrid_sampling(points, _SOURCE, num_threads=1)
        start = pose @ motion.step[k - 1] if k else pose
        found = local.aligned(sweep, start, sigma=motion.sigma[k - 1]) if k else None
        if found is not None:
            step[k - 1] = np.linalg.inv(pose) @ found
            sigma[k - 1] = np.repeat(_DRIFT, 3) * np.sqrt(duration_ns[k - 1] * 1e-9)
        pose = start if found is None else found
        local.add(sweep, pose)
    return Motion(motion.time_ns, step, sigma)


class _LocalMap:
    """Points of the last sweeps that are some way apart, with normals."""

    def __init__(self, gicp: Any) -> None:
        self._gicp = gicp
        self._keys: deque[Float] = deque(maxlen=_KEYS)
        self._last = np.eye(4)
        self._target: tuple[Any, Any] | None = None  # points with normals, and their tree

    def add(self, sweep: Any, pose: Float) -> None:
        """Add a sweep if its pose is some way from that of the last one."""
        moved = np.linalg.inv(self._last) @ pose
        turned = Rotation.from_matrix(moved[:3, :3]).magnitude()
        near = np.linalg.norm(moved[:3, 3]) < _APART[0] and turned < _APART[1]
        if sweep.size() < _LEAST or (near and self._keys):
            return
        self._last = pose
        self._keys.append(sweep.points()[:, :3] @ pose[:3, :3].T + pose[:3, 3])
        thinned = self._gicp.voxelgrid_sampling(np.concatenate(self._keys), _TARGET, num_threads=1)
        self._target = self._gicp.preprocess_points(
            self._planar(thinned),
            downsampling_resolution=_TARGET / 10,  # which keeps the points as they are
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
        return points[flat] if np.count_nonzero(flat) >= _LEAST else points

    def aligned(self, sweep: Any, start: Float, *, sigma: Float) -> Float | None:
        """The most likely pose of a sweep, from a measured one and its alignment; None if few points match.

        sigma : (6,) standard deviations of the measured pose's rotation and translation
        """
        if self._target is None:
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
            if found.num_inliers < _LEAST:
                return None
            aligned = np.asarray(found.T_target_source)
        back = np.linalg.inv(aligned) @ start
        wanted = np.concatenate([Rotation.from_matrix(back[:3, :3]).as_rotvec(), back[:3, 3]])
        information, given = np.asarray(found.H) / _NOISE**2, sigma**-2
        shift = np.linalg.solve(information + np.diag(given), given * wanted)
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = Rotation.from_rotvec(shift[:3]).as_matrix(), shift[3:]
        pose: Float = aligned @ step
        return pose


def _still_points(clouds: Stream, row: int, *, motion: Float, duration_ns: int) -> Float:
    """Points (n, 3) of a sweep in the frame of the vehicle at its start, without the vehicle's motion.

    motion : (4, 4) of the vehicle within ``duration_ns`` of the start
    """
    table, mount = cloud_points(clouds.files[row]), clouds.mount.matrix
    points = np.column_stack([table[axis] for axis in "xyz"]).astype(float)
    seen = np.einsum("ij,ij->i", points, points) > _NEAREST**2
    points = points[seen] @ mount[:3, :3].T + mount[:3, 3]
    share = (table["time_ns"][seen] / duration_ns)[:, None]
    turn = Rotation.from_rotvec(share * Rotation.from_matrix(motion[:3, :3]).as_rotvec())
    still: Float = turn.apply(points) + share * motion[:3, 3]
    return still

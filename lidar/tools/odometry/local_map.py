"""A map of the last sweeps, and the alignment of a sweep to it: points to planes, by small_gicp."""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from geoscene.errors import need
from geoscene.typing import Float

_NEIGHBOURS = 20  # points of the map that tell the normal of one
_THICK = 0.05  # metres: standard deviation of neighbours from their plane, up to which they are in one
_WIDE = 0.02  # variance across over variance along, from which neighbours are not on a line
_KEYS = 20  # sweeps of which the map is made
_APART = (1.5, 0.1)  # metres or radians from the last of them to the next
_LEAST = 50  # points on which an alignment stands, at least
_NOISE = 0.2  # metres: standard deviation of a point from the planes, which are not everywhere flat

_REACH = (1.0, 0.3)  # metres between a point and the map: first, and then, without what moves


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
        if sweep.size() < _LEAST or (near and self._keys):
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
        return points[flat] if np.count_nonzero(flat) >= _LEAST else points

    def aligned(self, sweep: Any, start: Float, *, sigma: Float) -> ScanAlignment | None:
        """The most likely pose of a sweep from an expected one and its alignment; None if few points match.

        sigma : (6,) standard deviations of the expected pose's rotation and translation

        Alignment and expectation have the weight of their information: between flat walls an alignment says
        little about the motion along a street.
        """
        if self._target is None or sweep.size() < _LEAST:
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
        given = np.diag(sigma**-2)
        information = np.asarray(found.H) / _NOISE**2 + given
        shift = np.linalg.solve(information, given @ wanted)
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = Rotation.from_rotvec(shift[:3]).as_matrix(), shift[3:]
        return ScanAlignment(aligned @ step, information, found.num_inliers / sweep.size())

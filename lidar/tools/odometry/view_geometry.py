"""Geometry of views: poses of a camera from bearings of known points, and points from two views.

Bearings are unit vectors in the camera's frame, so that everything holds for pinhole and fisheye cameras
alike. A pose (4, 4) takes points from the camera's frame to that of the map.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from geoscene.errors import need
from geoscene.typing import Bools, Float
from lidar.tools.odometry.scans import moved_back

_FORWARD = 0.34  # cosine of 70 degrees: bearings nearer to the axis have image coordinates
_CERTAIN = 0.999  # probability that a sample of the trials is without outliers
_GATE = 3.0  # standard deviations of a bearing, up to which it is an inlier
_ROUNDS = 15


@dataclass(frozen=True)
class Sighted:
    """Known points and their bearings from a camera.

    point   : (n, 3) in the map's frame
    bearing : (n, 3) unit vectors in the camera's frame
    sigma   : (n,) radians, one standard deviation of a bearing
    fuzz    : (n,) one standard deviation of a point's distance over the distance
    origin  : (3,) from where points were measured: their errors are along the rays from there
    share   : (n,) times of the bearings in steps of ``motion``, after the time of the pose
    motion  : (4, 4) of the camera in one step
    """

    point: Float
    bearing: Float
    sigma: Float
    fuzz: Float
    origin: Float
    share: Float
    motion: Float

    def errors(self, pose: Float) -> tuple[Float, Float, Float]:
        """Errors (n, 2) in standard deviations, weights (n,) in 1 / radians, and the visible points (n, 3).

        Points are in the camera's frame at the time at which they are seen.
        """
        seen = (self.point - pose[:3, 3]) @ pose[:3, :3]
        seen = moved_back(seen, self.share, motion=self.motion)
        distance = np.maximum(np.linalg.norm(seen, axis=1), 1e-9)
        away = (self.point - self.origin) @ pose[:3, :3]
        # An error along the ray from the origin shows as an angle as far as it is across the new ray.
        across = np.linalg.norm(np.cross(away, seen), axis=1) / distance**2
        weight = 1.0 / np.hypot(self.sigma, self.fuzz * across)
        found = np.einsum("nij,ni->nj", tangents(self.bearing), seen / distance[:, None])
        behind = np.einsum("ni,ni->n", self.bearing, seen) <= 0
        found[behind] = 10.0
        return found * weight[:, None], weight, seen

    def take(self, rows: Any) -> Sighted:
        """Subset of the points."""
        columns = (self.point, self.bearing, self.sigma, self.fuzz, self.share)
        point, bearing, sigma, fuzz, share = (column[rows] for column in columns)
        return Sighted(point, bearing, sigma, fuzz, self.origin, share, self.motion)


def tangents(bearing: Float) -> Float:
    """Two unit vectors (n, 3, 2) across each bearing (n, 3)."""
    least = np.argmin(np.abs(bearing), axis=1)
    other = np.zeros_like(bearing)
    other[np.arange(len(bearing)), least] = 1.0
    first = np.cross(bearing, other)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(bearing, first)], axis=2)


def pose_of(
    sighted: Sighted, *, start: Float, trials: int, rng: np.random.Generator, prior: Float | None = None
) -> tuple[Float, Bools, Float] | None:
    """Camera pose from known points (PnP), the inliers (n,) and the pose's covariance (6, 6).

    start  : (4, 4) expected pose, which is tried first
    trials : of three points each (P3P in a random sample consensus; Fischler and Bolles 1981), at most; fewer
             if a sample without outliers is certain
    prior  : (6,) standard deviations of the rotation and position of ``start``; None if it says nothing

    The pose is refined by Gauss and Newton's method with the weights of Cauchy. The covariance is of small
    rotations and translations along the camera's axes. None if fewer than six points agree.
    """
    count = len(sighted.point)
    if count < 6:
        return None
    cv2 = need("cv2", "odometry")
    best, most = start, int(np.count_nonzero(_inliers(sighted, start)))
    forward = np.flatnonzero((sighted.bearing[:, 2] > _FORWARD) & (sighted.fuzz < 0.1))
    needed, trial = float(trials), 0
    while trial < needed and len(forward) >= 4:
        trial += 1
        rows = rng.choice(forward, 3, replace=False)
        image = sighted.bearing[rows, :2] / sighted.bearing[rows, 2:]
        found, turns, shifts = cv2.solveP3P(
            sighted.point[rows], image, np.eye(3), None, flags=cv2.SOLVEPNP_AP3P
        )
        for turn, shift in zip(turns[:found], shifts[:found], strict=True):
            pose = np.eye(4)
            pose[:3, :3] = Rotation.from_rotvec(turn.ravel()).as_matrix().T
            pose[:3, 3] = -pose[:3, :3] @ shift.ravel()
            agree = int(np.count_nonzero(_inliers(sighted, pose))) if np.isfinite(pose).all() else 0
            if agree > most:
                best, most = pose, agree
                good = np.clip((agree / count) ** 3, 1e-9, 1 - 1e-9)
                needed = min(needed, np.log(1 - _CERTAIN) / np.log(1 - good))
    if most < 6:
        return None
    pose, covariance = _refine(sighted.take(_inliers(sighted, best)), best, start=start, prior=prior)
    inliers = _inliers(sighted, pose)
    if np.count_nonzero(inliers) < 6:
        return None
    pose, covariance = _refine(sighted.take(inliers), pose, start=start, prior=prior)
    return pose, _inliers(sighted, pose), covariance


def _inliers(sighted: Sighted, pose: Float) -> Bools:
    errors, _, _ = sighted.errors(pose)
    inliers: Bools = (errors**2).sum(axis=1) < _GATE**2
    return inliers


def _refine(sighted: Sighted, pose: Float, *, start: Float, prior: Float | None) -> tuple[Float, Float]:
    """The pose of least errors next to one, and its covariance; see `pose_of`."""
    across, covariance = tangents(sighted.bearing), np.eye(6)
    given = np.diag(prior**-2) if prior is not None else 1e-9 * np.eye(6)
    for _ in range(_ROUNDS):
        errors, weight, seen = sighted.errors(pose)
        distance = np.linalg.norm(seen, axis=1)[:, None, None]
        unit = seen[:, :, None] / distance
        flat = (np.eye(3) - unit @ np.swapaxes(unit, 1, 2)) / distance
        front = np.swapaxes(across, 1, 2) @ flat * weight[:, None, None]
        jacobian = np.concatenate([front @ _skew(seen), -front], axis=2)
        robust = 1.0 / (1.0 + (errors**2).sum(axis=1))
        information = np.einsum("nij,n,nik->jk", jacobian, robust, jacobian)
        wanted = np.einsum("nij,n,ni->j", jacobian, robust, errors)
        covariance = np.linalg.inv(information + given)
        if prior is not None:
            off = np.linalg.inv(start) @ pose
            wanted += given @ np.concatenate([Rotation.from_matrix(off[:3, :3]).as_rotvec(), off[:3, 3]])
        shift = -covariance @ wanted
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = Rotation.from_rotvec(shift[:3]).as_matrix(), shift[3:]
        pose = pose @ step
        if np.abs(shift).max() < 1e-9:
            break
    return pose, covariance


def _skew(vectors: Float) -> Float:
    """Matrices (n, 3, 3) of the cross products with vectors (n, 3)."""
    out = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -z, y, -x
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = z, -y, x
    return out


def two_view_pose(first: Float, second: Float, *, sigma: float) -> tuple[Float, Bools] | None:
    """The pose (4, 4) of a second view in the frame of the first, a unit away, and the inliers (n,).

    first, second : (n, 3) bearings of the same points
    sigma         : radians, of a bearing

    The essential matrix with a random sample consensus (Nistér 2004), and of its poses that with most points
    before both cameras. None if there is none.
    """
    cv2 = need("cv2", "odometry")
    ahead = (first[:, 2] > _FORWARD) & (second[:, 2] > _FORWARD)
    if np.count_nonzero(ahead) < 8:
        return None
    here, there = (one[ahead, :2] / one[ahead, 2:] for one in (first, second))
    essential, mask = cv2.findEssentialMat(
        here, there, np.eye(3), method=cv2.RANSAC, prob=_CERTAIN, threshold=2 * sigma
    )
    if essential is None or essential.shape != (3, 3):
        return None
    good, turn, shift, mask = cv2.recoverPose(essential, here, there, np.eye(3), mask=mask)
    if good < 8:
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.T, -turn.T @ shift.ravel()
    inliers = np.zeros(len(first), bool)
    inliers[np.flatnonzero(ahead)[mask.ravel() > 0]] = True
    return pose, inliers


def triangulate(first: Float, second: Float, *, pose: Float, sigma: Float) -> tuple[Float, Float]:
    """Distances (n,) of points from the first view, and their standard deviations over them.

    first, second : (n, 3) bearings in each view
    pose          : (4, 4) of the second view in the first one's frame
    sigma         : (n,) radians, of a bearing

    NaN where the bearings do not meet before both views, within three standard deviations.
    """
    base, ahead = pose[:3, 3], second @ pose[:3, :3].T
    cosine = np.einsum("ni,ni->n", first, ahead)
    sine2 = np.maximum(1 - cosine**2, 1e-16)
    along, other = first @ base, ahead @ base
    distance, back = (along - cosine * other) / sine2, (cosine * along - other) / sine2
    gap = np.linalg.norm(distance[:, None] * first - base - back[:, None] * ahead, axis=1)
    meet = (distance > 0) & (back > 0)
    meet &= gap < _GATE * sigma * np.hypot(distance, back)
    # Two bearings whose rays meet at an angle: the error across one ray moves the point along the other.
    fuzz = sigma * np.sqrt(2.0) * np.maximum(back, 1e-9) / (np.sqrt(sine2) * np.maximum(distance, 1e-9))
    return np.where(meet, distance, np.nan), np.where(meet, fuzz, np.nan)

"""Tracking of a camera through its images.

Each image is matched to the last keyframe, whose features have distances: the pose follows from known points
and the bearings at which they are seen (perspective n points). Keyframes are refined together in a window,
and loops between them are found.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from geoscene.errors import need
from geoscene.support.progress import Progress
from geoscene.typing import Bools, Float, Ints
from lidar.dataset.recorded import Stream
from lidar.sensors.rig.specs import CameraSpec
from lidar.tools.odometry.features import ImageFeatures, matches, read_features
from lidar.tools.odometry.keyframes import Keyframe, refine_window
from lidar.tools.odometry.scans import scaled_motion, still, turns
from lidar.tools.odometry.settings import OdometrySettings
from lidar.tools.odometry.view_geometry import Sighted, pose_of, triangulate, two_view_pose

ENOUGH = 15
"""Inliers from which a pose is that of the image."""

_SEED = 20260621  # of the trials of three points
_FAR = 50.0  # metres: where features without a distance are expected
_WITHIN = (0.04, 0.15)  # radians from where they are expected, of features with a distance and without one
_LOOP_INLIERS = 30
_LOOP_CANDIDATES = 3
_LOOP_DRIFT = 0.02  # of the way between keyframes, by which their distance may be wrong
_FIRST_ANGLE = 0.01  # radians between the bearings of two views, from which they tell distances
_UNKNOWN = 3  # first frames, whose motion before is not known well
_OPEN = (0.05, 0.5)  # radians and metres: standard deviations of a step without matches
_SPEEDS = np.arange(0.0, 41.0, 4.0)  # m/s ahead, from which the first motion is sought
_ROUNDS = 2  # of distances and pose from each


class FeatureDepths(Protocol):
    """Depths of image features."""

    def __call__(self, row: int, features: ImageFeatures, *, motion: Float) -> tuple[Float, Float]:
        """Distances (n,) of a frame's features and their deviations over them; NaN where unknown.

        motion : (4, 4) of the camera in a second
        """


@dataclass(frozen=True)
class Tracked:
    """Result of tracking a camera.

    reference : (n,) rows of the keyframes that frames are relative to
    relative  : (n, 4, 4) poses of frames in their keyframes' frames
    """

    keyframes: list[Keyframe]
    reference: Ints
    relative: Float
    covariance: Float
    matched: Ints
    inliers: Ints
    loops: list[tuple[int, int, Float, Float]]


def _at_start(features: ImageFeatures, distance: Float, *, motion: Float) -> tuple[ImageFeatures, Float]:
    """Features and distances as at the frame's start, of rows exposed later by a motion (4, 4) in a second.

    Where the distance is unknown, the turn alone is undone.
    """
    if not features.seconds.any():
        return features, distance
    known = np.isfinite(distance)
    local = np.where(known, distance, 1.0)[:, None] * features.bearing
    moved = still(local, features.seconds, motion=motion)
    length = np.linalg.norm(moved, axis=1)
    bearing = np.where(
        known[:, None], moved / length[:, None], turns(motion, features.seconds).apply(features.bearing)
    )
    return replace(features, bearing=bearing), np.where(known, length, np.nan)


def track_camera(
    images: Stream,
    camera: CameraSpec,
    *,
    measure: FeatureDepths | None,
    settings: OdometrySettings,
    progress: Progress,
) -> Tracked:
    """Poses of a camera by its images; see the module.

    measure : distances of features; without it they follow from motion, in units of the first step
    """
    need("gtsam", "odometry")
    count = len(images.frames)
    seconds = np.diff(images.time_ns, prepend=images.time_ns[0]) * 1e-9
    poses = np.tile(np.eye(4), (count, 1, 1))
    reference, relative = np.zeros(count, np.int64), np.tile(np.eye(4), (count, 1, 1))
    covariance = np.tile(np.diag(np.repeat(_OPEN, 3) ** 2), (count, 1, 1))
    matched, inliers = np.zeros(count, np.int64), np.zeros(count, np.int64)
    keyframes: list[Keyframe] = []
    loops: list[tuple[int, int, Float, Float]] = []
    rate = np.eye(4) if measure is None else _first_rate(images, camera, measure=measure, settings=settings)
    best, tracks = 0, 0
    for row in range(count):
        progress("tracking features", row + 1, total=count)
        features = read_features(images.files[row], camera, settings=settings)
        if not keyframes:
            first = _keyframe(row, features, pose=np.eye(4), rate=rate, measure=measure, tracks=tracks)
            tracks = int(first.track.max(initial=-1)) + 1
            keyframes.append(first)
            inliers[row] = matched[row] = len(features)
            continue
        last = keyframes[-1]
        expected = poses[row - 1] @ scaled_motion(rate, seconds[row])
        rows, mine = _matches(last, features, expected=None if row == 1 and measure is None else expected)
        matched[row] = len(rows)
        rng = np.random.default_rng([_SEED, row])
        pose, good, found = expected, np.zeros(len(rows), bool), None
        unknown = np.count_nonzero(np.isfinite(last.distance[rows])) < ENOUGH
        if measure is None and unknown:
            begun = _begun(last, features, rows=rows, mine=mine)
            if begun is not None:
                pose, good = begun
                inliers[row] = np.count_nonzero(good)
        else:
            prior = None
            if measure is not None and row > _UNKNOWN:
                usual = np.repeat([settings.turn_acceleration, settings.acceleration], 3)
                prior = usual * seconds[row] ** 2
            found = _pose_in(
                last,
                features,
                rows=rows,
                mine=mine,
                start=expected,
                prior=prior,
                rate=rate,
                settings=settings,
                rng=rng,
            )
            if found is not None:
                pose, good, covariance[row] = found
                inliers[row] = np.count_nonzero(good)
        if inliers[row] < ENOUGH:
            pose = expected
        best = max(best, int(inliers[row]))
        poses[row] = pose
        step = np.linalg.inv(poses[row - 1]) @ pose
        rate = scaled_motion(step, 1.0 / max(seconds[row], 1e-9))
        reference[row], relative[row] = len(keyframes) - 1, np.linalg.inv(last.pose) @ pose
        first_pair = measure is None and unknown and good.any()
        if (inliers[row] < settings.keyframe_matches * best and (measure or not unknown)) or first_pair:
            frame = _keyframe(row, features, pose=pose, rate=rate, measure=measure, tracks=tracks)
            _link(frame, last, rows=rows[good], mine=mine[good], sigma=settings.pixel / camera.fx)
            frame.way = last.way + float(np.linalg.norm(pose[:3, 3] - last.pose[:3, 3]))
            tracks = int(frame.track.max(initial=tracks - 1)) + 1
            keyframes.append(frame)
            if settings.window:
                refine_window(keyframes[-settings.window :], scaled=measure is not None)
            poses[row], reference[row], relative[row] = frame.pose, len(keyframes) - 1, np.eye(4)
            if settings.loop_distance:
                loops += _loops(keyframes, settings=settings, rng=rng)
            best = 0
    return Tracked(keyframes, reference, relative, covariance, matched, inliers, loops)


def _first_rate(
    images: Stream, camera: CameraSpec, *, measure: FeatureDepths, settings: OdometrySettings
) -> Float:
    """Motion (4, 4) of the camera in a second, at the first image.

    Setts, slabs and windows look alike: without an expectation, features are matched to others of their
    kind. So the second image is matched near to where several speeds ahead lead the features of the first.
    That counts with which most matches agree on a pose.
    """
    first, second = (read_features(images.files[row], camera, settings=settings) for row in (0, 1))
    seconds = float(images.time_ns[1] - images.time_ns[0]) * 1e-9
    best, most = np.eye(4), 0
    for speed in _SPEEDS:
        rate, agree = np.eye(4), 0
        rate[:3, 3] = images.mount.matrix[0, :3] * speed
        for _ in range(_ROUNDS):
            begin = _keyframe(0, first, pose=np.eye(4), rate=rate, measure=measure, tracks=0)
            start = scaled_motion(rate, seconds)
            rows, mine = _matches(begin, second, expected=start)
            rng = np.random.default_rng([_SEED, 1])
            found = _pose_in(
                begin, second, rows=rows, mine=mine, start=start, rate=rate, settings=settings, rng=rng
            )
            if found is None:
                break
            rate, agree = scaled_motion(found[0], 1.0 / seconds), int(np.count_nonzero(found[1]))
        if agree > most:
            best, most = rate, agree
    return best if most >= ENOUGH else np.eye(4)


def _matches(last: Keyframe, features: ImageFeatures, *, expected: Float | None) -> tuple[Ints, Ints]:
    """Rows of the same features in a keyframe and a frame, near to where they are expected.

    Windows of a facade look alike: without an expectation, features may be matched to those of the next one.

    expected : (4, 4) pose of the frame; None if unknown
    """
    allowed = None
    if expected is not None:
        known = np.isfinite(last.distance)
        distance = np.where(known, last.distance, _FAR)[:, None]
        placed = (distance * last.features.bearing) @ last.pose[:3, :3].T + last.pose[:3, 3]
        local = (placed - expected[:3, 3]) @ expected[:3, :3]
        local /= np.maximum(np.linalg.norm(local, axis=1, keepdims=True), 1e-9)
        bound = np.cos(np.where(known, *_WITHIN))
        allowed = local @ features.bearing.T > bound[:, None]
    rows, mine = matches(last.features.descriptor, features.descriptor, allowed=allowed)
    if len(rows) < ENOUGH and allowed is not None:
        return matches(last.features.descriptor, features.descriptor)
    return rows, mine


def _keyframe(
    row: int, features: ImageFeatures, *, pose: Float, rate: Float, measure: FeatureDepths | None, tracks: int
) -> Keyframe:
    """A keyframe with the distances that are measured."""
    distance, fuzz = np.full(len(features), np.nan), np.full(len(features), np.nan)
    if measure is not None:
        distance, fuzz = measure(row, features, motion=rate)
    known = np.isfinite(distance)
    features, distance = _at_start(features, distance, motion=rate)
    track = tracks + np.arange(len(features))
    return Keyframe(row, pose, features, distance, fuzz, known, track)


def _link(frame: Keyframe, last: Keyframe, *, rows: Ints, mine: Ints, sigma: float) -> None:
    """Give the features of a keyframe the points of the map that they match, and new ones distances."""
    frame.track[mine] = last.track[rows]
    pose = np.linalg.inv(last.pose) @ frame.pose
    lack = ~np.isfinite(last.distance[rows])
    if lack.any():
        here, there = last.features.bearing[rows[lack]], frame.features.bearing[mine[lack]]
        distance, fuzz = triangulate(here, there, pose=pose, sigma=np.full(len(here), sigma))
        turned = np.einsum("ni,ni->n", here, there @ pose[:3, :3].T)
        wide = (np.arccos(np.clip(turned, -1, 1)) > _FIRST_ANGLE) & (fuzz < 0.3)
        last.distance[rows[lack]] = np.where(wide, distance, np.nan)
        last.fuzz[rows[lack]] = np.where(wide, fuzz, np.nan)
    carried = ~frame.measured[mine] & np.isfinite(last.distance[rows])
    points = last.points(rows[carried])
    frame.distance[mine[carried]] = np.linalg.norm(points - frame.pose[:3, 3], axis=1)
    frame.fuzz[mine[carried]] = last.fuzz[rows[carried]]


def _begun(last: Keyframe, features: ImageFeatures, *, rows: Ints, mine: Ints) -> tuple[Float, Bools] | None:
    """The pose of the second view of a map without distances, a unit away; None for equal views."""
    here, there = last.features.bearing[rows], features.bearing[mine]
    if len(rows) < ENOUGH:
        return None
    found = two_view_pose(here, there, sigma=float(np.median(features.sigma)))
    if found is None:
        return None
    pose, good = found
    angle = np.arccos(np.clip(np.einsum("ni,ni->n", here, there @ pose[:3, :3].T), -1, 1))
    if np.count_nonzero(good) < ENOUGH or np.median(angle[good]) < _FIRST_ANGLE:
        return None
    return last.pose @ pose, good


def _pose_in(
    last: Keyframe,
    features: ImageFeatures,
    *,
    rows: Ints,
    mine: Ints,
    start: Float,
    rate: Float,
    settings: OdometrySettings,
    rng: np.random.Generator,
    prior: Float | None = None,
) -> tuple[Float, Bools, Float] | None:
    """The pose of a frame by the points of a keyframe, the inliers among matches, and the covariance."""
    known = np.isfinite(last.distance[rows])
    rows, mine = rows[known], mine[known]
    sighted = Sighted(
        last.points(rows),
        features.bearing[mine],
        np.hypot(features.sigma[mine], last.features.sigma[rows]),
        last.fuzz[rows],
        last.pose[:3, 3],
        features.seconds[mine],
        rate,
    )
    found = pose_of(sighted, start=start, trials=settings.ransac, rng=rng, prior=prior)
    if found is None:
        return None
    pose, good, covariance = found
    inliers = np.zeros(len(known), bool)
    inliers[np.flatnonzero(known)[good]] = True
    return pose, inliers, covariance


def _loops(
    keyframes: list[Keyframe], *, settings: OdometrySettings, rng: np.random.Generator
) -> list[tuple[int, int, Float, Float]]:
    """Loops of the last keyframe to earlier ones nearby: pairs of numbers, relative poses and deviations.

    Candidates are keyframes that are near by the estimate and far by the way. One counts if enough features
    match and agree on a pose.
    """
    new = keyframes[-1]
    drift = _LOOP_DRIFT * np.array([new.way - frame.way for frame in keyframes])
    apart = np.linalg.norm([frame.pose[:3, 3] - new.pose[:3, 3] for frame in keyframes], axis=1)
    old = np.array([new.way - frame.way >= settings.loop_path for frame in keyframes])
    near = np.flatnonzero(old & (apart < settings.loop_distance + drift))
    for k in near[np.argsort(apart[near], kind="stable")][:_LOOP_CANDIDATES].tolist():
        earlier = keyframes[k]
        rows, mine = matches(earlier.features.descriptor, new.features.descriptor)
        found = _pose_in(
            earlier,
            replace(new.features, seconds=np.zeros(len(new.features))),
            rows=rows,
            mine=mine,
            start=new.pose,
            rate=np.eye(4),
            settings=settings,
            rng=rng,
        )
        if found is not None and np.count_nonzero(found[1]) >= _LOOP_INLIERS:
            sigma = np.sqrt(np.maximum(np.diag(found[2]), 1e-10)) + np.repeat([0.001, 0.01], 3)
            return [(k, len(keyframes) - 1, np.linalg.inv(earlier.pose) @ found[0], sigma)]
    return []

"""Visual odometry: ORB features, with distances from laser points, from a second camera, or from motion."""

from __future__ import annotations

from importlib import metadata

import numpy as np

from geoscene.support.progress import Progress
from geoscene.typing import Float
from lidar.dataset.layout import Dataset
from lidar.dataset.recorded import Stream, color_images
from lidar.errors import DatasetError, InputError
from lidar.sensors.rig.specs import CameraSpec
from lidar.tools.odometry.estimate import MotionEstimate, propagate
from lidar.tools.odometry.features import (
    ImageFeatures,
    camera_of,
    laser_distances,
    read_features,
    stereo_distances,
)
from lidar.tools.odometry.keyframes import Keyframe, close_loops
from lidar.tools.odometry.scans import SweepSequence, scaled_motion, scans_of, still
from lidar.tools.odometry.settings import OdometrySettings
from lidar.tools.odometry.visual_tracking import ENOUGH, FeatureDepths, Tracked, track_camera

VISUAL_METHODS = ("orb", "orb+depth", "stereo")
"""Methods by their names."""

_ROAD = (-0.15, -0.7)  # vertical component of the bearings of the road ahead
_ROAD_POINTS = 4  # of a keyframe and those beside it, from which its scale counts
_BESIDE = 2  # keyframes before and after, whose points count, too: a road shows few that hold
_ROAD_WIDTH = 0.1  # share of a height by which points are of the same plane; a road is cambered and rough
_NEAR_ROAD = 3.0  # metres to the side of the camera, within which the road is


def visual_odometry(
    dataset: Dataset, method: str, *, names: tuple[str, ...], settings: OdometrySettings, progress: Progress
) -> MotionEstimate:
    """Poses of the vehicle at the starts of a camera's frames, relative to the first.

    method : of `VISUAL_METHODS`
    names  : of sensors: a camera, for ``stereo`` two, for ``orb+depth`` a camera and scanners; by default the
             first ones that fit

    Raises InputError for other sensors, DatasetError for data that are missing or damaged, and
    MissingExtraError without OpenCV or gtsam.
    """
    images, other, scanners = _sensors(dataset, method, names=names)
    camera = camera_of(images.name, images.sensor)
    measure: FeatureDepths | None = None
    sensors = [images.name, *([other.name] if other else [])]
    if method == "orb+depth":
        scans = scans_of(dataset, scanners, least=settings.min_range, most=settings.max_range or None)
        sensors += [stream.name for stream in scans.streams]
        measure = _by_laser(scans, images, camera=camera, settings=settings)
    elif other is not None:
        measure = _by_stereo(images, other, settings=settings)
    found = track_camera(images, camera, measure=measure, settings=settings, progress=progress)
    corrected = np.array([frame.pose for frame in found.keyframes])
    if found.loops:
        corrected = close_loops(found.keyframes, found.loops)
    poses = corrected[found.reference] @ found.relative
    mount = images.mount.matrix
    scale = "measured distances"
    if measure is None:
        factors, scale = _scale_by_road(found, images, height=float(mount[2, 3]))
        poses = _rescale(poses, factors[found.reference])
    back = np.asarray(np.linalg.inv(mount), float)
    vehicle = mount @ np.linalg.inv(poses[0]) @ poses @ back
    report = {
        "method": method,
        "package": f"opencv-python-headless {metadata.version('opencv-python-headless')},"
        f" gtsam {metadata.version('gtsam')}",
        "sensors": sensors,
        "frames": len(images.frames),
        "pose_of_a_frame": "at its start",
        "scale": scale,
        "keyframes": len(found.keyframes),
        "matches": int(found.matched.sum()),
        "inliers": int(found.inliers.sum()),
        "frames_without_pose": int(np.count_nonzero(found.inliers[1:] < ENOUGH)),
        "loop_closures": len(found.loops),
    }
    covariance = _of_vehicle(found.covariance[1:], back=back)
    sigma = step_sigma = None
    if measure is not None:
        sigma, step_sigma = propagate(vehicle, covariance), np.sqrt(np.einsum("nii->ni", covariance))
    quality = {"matches": found.matched, "inliers": found.inliers}
    return MotionEstimate(images.time_ns, vehicle, sigma, step_sigma, quality, report)


def _sensors(
    dataset: Dataset, method: str, *, names: tuple[str, ...]
) -> tuple[Stream, Stream | None, tuple[str, ...]]:
    """The images of a camera, for stereo those of a second one, and the names of scanners."""
    cameras, lidars = dataset.sensors("camera"), dataset.sensors("lidar")
    if unknown := [name for name in names if name not in cameras and name not in lidars]:
        known = ", ".join((*cameras, *lidars)) or "none"
        raise InputError(f"`sensor` {unknown[0]}: no camera or scanner in {dataset.path}; there are {known}")
    chosen = [name for name in names if name in cameras] or list(cameras)
    streams = [found for name in chosen if (found := color_images(dataset, name)) is not None]
    if not streams:
        raise DatasetError(
            f"{dataset.path}: no colour images; drive with a rig whose cameras have `images` rgb"
        )
    images = streams[0]
    if len(images.frames) < 2:
        raise DatasetError(
            f"{dataset.path}: {len(images.frames)} image of {images.name}; odometry needs two or more"
        )
    scanners = tuple(name for name in names if name in lidars)
    if method != "stereo":
        return images, None, scanners
    for other in streams[1:]:
        if np.array_equal(other.time_ns, images.time_ns):
            return images, other, scanners
    raise DatasetError(
        f"{dataset.path}: no second camera with images at the times of {images.name}; choose another `method`"
    )


def _by_laser(
    scans: SweepSequence, images: Stream, *, camera: CameraSpec, settings: OdometrySettings
) -> FeatureDepths:
    """Distances by the sweep during which, or nearest to which, an image is taken."""
    into = np.linalg.inv(images.mount.matrix)
    period_ns = 1e9 / float(scans.streams[0].sensor["rate_hz"])

    def measured(row: int, features: ImageFeatures, *, motion: Float) -> tuple[Float, Float]:
        at = int(images.time_ns[row])
        middle = scans.time_ns - scans.period_ns / 2
        sweep = int(np.argmin(np.abs(middle - at)))
        points, share = scans.sweep(sweep)
        late = share + (int(scans.time_ns[sweep]) - at) / period_ns
        mount = images.mount.matrix
        of_vehicle = scaled_motion(mount @ motion @ into, period_ns * 1e-9)
        points = still(points, late, motion=of_vehicle) @ into[:3, :3].T + into[:3, 3]
        return laser_distances(features, camera, points=points, motion=motion, radius=settings.depth_radius)

    return measured


def _by_stereo(images: Stream, other: Stream, *, settings: OdometrySettings) -> FeatureDepths:
    """Distances by a second camera."""
    pose = np.linalg.inv(images.mount.matrix) @ other.mount.matrix
    second = camera_of(other.name, other.sensor)
    if np.linalg.norm(pose[:3, 3]) < 1e-3:
        raise InputError(f"`sensor` {other.name}: is where {images.name} is; stereo needs two places")

    def measured(row: int, features: ImageFeatures, *, motion: Float) -> tuple[Float, Float]:
        del motion  # rows of both cameras that see a point are exposed at about the same time
        there = read_features(other.files[row], second, settings=settings)
        return stereo_distances(features, there, pose=pose)

    return measured


def _scale_by_road(found: Tracked, images: Stream, *, height: float) -> tuple[Float, str]:
    """Scale factors (k,) of keyframes from the camera's height over the road, and their source.

    The points of the road ahead lie on a plane, whose distance below the camera is known. Keyframes that
    follow one another share points of the map, hence a scale, which drifts slowly.
    """
    factor = np.full(len(found.keyframes), np.nan)
    heights = [_below(frame, turn=images.mount.matrix[:3, :3], height=height) for frame in found.keyframes]
    for k in range(len(heights)):
        below = np.concatenate(heights[max(k - _BESIDE, 0) : k + _BESIDE + 1])
        if len(below) >= _ROAD_POINTS:
            votes = (np.abs(below[:, None] - below) < _ROAD_WIDTH).sum(axis=1)
            same = np.abs(below - below[np.argmax(votes)]) < _ROAD_WIDTH
            if np.count_nonzero(same) >= _ROAD_POINTS:
                factor[k] = height / np.exp(np.median(below[same]))
    seen = np.flatnonzero(np.isfinite(factor))
    if height <= 0 or not len(seen):
        return np.ones(len(factor)), "unknown: the first two keyframes are a unit apart"
    smooth = np.array([np.median(factor[seen[max(0, i - 2) : i + 3]]) for i in range(len(seen))])
    return np.interp(np.arange(len(factor)), seen, smooth), "height of the camera over the road"


def _below(frame: Keyframe, *, turn: Float, height: float) -> Float:
    """Logarithms (n,) of how far the points of a keyframe that may be of the road lie below the camera.

    turn   : (3, 3) camera in the vehicle's axes
    height : of the camera over the road, metres
    """
    ahead = frame.features.bearing @ turn.T
    known = np.isfinite(frame.distance) & (ahead[:, 2] < _ROAD[0]) & (ahead[:, 2] > _ROAD[1])
    known &= np.abs(ahead[:, 1]) < -ahead[:, 2] * _NEAR_ROAD / max(height, 0.1)
    below: Float = np.log(-(frame.distance * ahead[:, 2])[known])
    return below


def _rescale(poses: Float, factor: Float) -> Float:
    """Poses whose steps are longer by factors (n,), those of the later poses."""
    step = np.diff(poses[:, :3, 3], axis=0) * factor[1:, None]
    out = poses.copy()
    out[:, :3, 3] = np.concatenate([[[0.0, 0.0, 0.0]], np.cumsum(step, axis=0)]) + poses[0, :3, 3]
    return out


def _of_vehicle(covariance: Float, *, back: Float) -> Float:
    """Covariances (n, 6, 6) of small motions of the vehicle by those of its camera.

    back : (4, 4) vehicle in the camera's frame
    """
    turn, (x, y, z) = back[:3, :3], back[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    adjoint = np.zeros((6, 6))
    adjoint[:3, :3] = adjoint[3:, 3:] = turn.T
    adjoint[3:, :3] = -turn.T @ cross
    found: Float = adjoint @ covariance @ adjoint.T
    return found

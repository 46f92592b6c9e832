"""ORB features of images, their matches (Rublee et al. 2011), and their distances by laser or stereo."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from geoscene.errors import need
from geoscene.typing import Bools, Float, Ints
from lidar.dataset.layout import reading_file
from lidar.dataset.recorded import mount_of
from lidar.sensors.rig.camera_model import project, unproject
from lidar.sensors.rig.specs import CameraSpec
from lidar.tools.odometry.scans import moved_back
from lidar.tools.odometry.settings import OdometrySettings
from lidar.tools.odometry.view_geometry import tangents, triangulate

_FARTHEST_MATCH = 64  # differing bits of 256, up to which two features may be the same
_SURPLUS = 6  # times as many features are detected as are kept, so that weak parts of the image have some
_CONTRAST = 7  # grey levels by which a corner differs from its surroundings, at least
_CELL = 60.0  # pixels: side of the cells that give as many features as the others
_SCALE = 1.2  # between the levels of the pyramid of images
_NEIGHBOURS = 8
_HIDING_CELL = 8.0  # pixels: side of the cells in which nearer points hide farther ones
_DEEPER = (1.1, 0.5)  # share and metres, by which a point is farther than those that hide it
_FLAT = 0.02  # share of a distance by which neighbours lie off their plane, at most
_SURE = 1.0  # leverage of a feature on the plane of its neighbours, up to which it is not beyond them
_LEAST_FUZZ = 0.005  # of a distance: errors of laser ranges and of the time of points
_EPIPOLAR = 3.0  # standard deviations of a match from its epipolar plane


@dataclass(frozen=True)
class ImageFeatures:
    """Features of an image.

    pixel      : (n, 2)
    bearing    : (n, 3) unit vectors in the camera's frame, without distortion
    sigma      : (n,) radians, one standard deviation of the bearing
    seconds    : (n,) from the frame's start to the exposure of the feature's row
    descriptor : (n, 32) bytes
    """

    pixel: Float
    bearing: Float
    sigma: Float
    seconds: Float
    descriptor: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.pixel)


def camera_of(name: str, sensor: dict[str, Any]) -> CameraSpec:
    """The camera of an entry of ``calibration.json``."""
    K = np.array(sensor["K"], float)
    return CameraSpec(
        name,
        mount_of(sensor),
        width=int(sensor["width"]),
        height=int(sensor["height"]),
        fx=float(K[0, 0]),
        fy=float(K[1, 1]),
        cx=float(K[0, 2]),
        cy=float(K[1, 2]),
        distortion=tuple(float(value) for value in sensor["distortion"]),
        rate_hz=float(sensor["rate_hz"]),
        exposure_ns=int(sensor.get("exposure_ns", 0)),
        row_ns=int(sensor.get("row_ns", 0)),
        model=str(sensor["model"]),
    )


def read_features(path: Path, camera: CameraSpec, *, settings: OdometrySettings) -> ImageFeatures:
    """The ORB features of a colour image, spread over it; rows of a rolling shutter have their own times.

    The strongest features of a street are on few things, often on road users. So the image is divided into
    cells, of which each gives as many as the others, as far as it has them.

    Raises MissingExtraError without OpenCV, and DatasetError for a damaged image.
    """
    cv2 = need("cv2", "odometry")
    with reading_file(path):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None or image.shape != (camera.height, camera.width):
            raise ValueError(f"no image of {camera.width} x {camera.height} pixels")
    orb = cv2.ORB_create(nfeatures=_SURPLUS * settings.features, scaleFactor=_SCALE, fastThreshold=_CONTRAST)
    found = orb.detect(image, None)
    place = np.array([key.pt for key in found], float).reshape(-1, 2)
    strength = np.array([key.response for key in found], float)
    kept = _spread(place, strength, count=settings.features)
    keys, descriptor = orb.compute(image, [found[k] for k in kept.tolist()])
    pixel = np.array([key.pt for key in keys], float).reshape(-1, 2)
    level = np.array([key.octave for key in keys], float)
    bearing = unproject(camera, pixel)
    seen = np.isfinite(bearing).all(axis=1)
    sigma = settings.pixel * _SCALE**level / np.sqrt(camera.fx * camera.fy)
    seconds = (camera.row_ns * pixel[:, 1] + camera.exposure_ns / 2) * 1e-9
    if descriptor is None:
        descriptor = np.empty((0, 32), np.uint8)
    return ImageFeatures(pixel[seen], bearing[seen], sigma[seen], seconds[seen], descriptor[seen])


def _spread(place: Float, strength: Float, *, count: int) -> Ints:
    """Rows of at most ``count`` features: the strongest of each cell, then the second ones, and so on."""
    order = np.argsort(-strength, kind="stable")
    cell = np.floor(place[order] / _CELL).astype(np.int64)
    number = cell[:, 0] * 100_000 + cell[:, 1]
    by_cell = np.argsort(number, kind="stable")
    grouped = number[by_cell]
    first = np.searchsorted(grouped, grouped)
    rank = np.empty(len(order), np.int64)
    rank[by_cell] = np.arange(len(order)) - first
    chosen: Ints = order[np.argsort(rank, kind="stable")[:count]]
    return chosen


def matches(
    first: NDArray[np.uint8], second: NDArray[np.uint8], *, allowed: Bools | None = None
) -> tuple[Ints, Ints]:
    """Rows (m,) of descriptors of two images that are each other's nearest by Hamming distance.

    allowed : (n, k) whether two features may be the same; all by default
    """
    if not len(first) or not len(second):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    words = (np.ascontiguousarray(one).view(np.uint64) for one in (first, second))
    here, there = words
    differing = np.zeros((len(first), len(second)), np.int64)
    for k in range(here.shape[1]):
        differing += np.bitwise_count(here[:, None, k] ^ there[None, :, k])
    if allowed is not None:
        differing[~allowed] = 257
    nearest, back = differing.argmin(axis=1), differing.argmin(axis=0)
    rows = np.arange(len(first))
    both = (back[nearest] == rows) & (differing[rows, nearest] <= _FARTHEST_MATCH)
    return rows[both], nearest[both]


def unhidden(pixel: Float, distance: Float) -> Bools:
    """Visibility (n,) of points: whether no nearer surface hides them.

    pixel    : (n, 2) at which they appear
    distance : (n,) from the camera

    A laser scanner looks past the camera: it has points on what walls and vehicles hide from it. Points much
    farther than the nearest one of the cells around their own are left out.
    """
    cell = np.floor(pixel / _HIDING_CELL).astype(np.int64)
    cell -= cell.min(axis=0, initial=0) - 1
    nearest = np.full(cell.max(axis=0, initial=0) + 2, np.inf)
    np.minimum.at(nearest, (cell[:, 0], cell[:, 1]), distance)
    around = [nearest[cell[:, 0] + i, cell[:, 1] + j] for i in (-1, 0, 1) for j in (-1, 0, 1)]
    bound = np.min(around, axis=0)
    seen: Bools = distance <= np.maximum(_DEEPER[0] * bound, bound + _DEEPER[1])
    return seen


def laser_distances(
    features: ImageFeatures, camera: CameraSpec, *, points: Float, motion: Float, radius: float
) -> tuple[Float, Float]:
    """Distances (n,) of features by laser points, and their standard deviations over them; NaN if unknown.

    Distances are from the camera at the time when the feature's row is exposed.

    points : (m, 3) in the camera's frame at the frame's start
    motion : (4, 4) of the camera in a second
    radius : pixels around a feature, within which points count

    A plane through the neighbours of a feature tells its distance: the inverse distance of a plane's points
    is linear in their bearings. Neighbours that are in no plane, such as those on both sides of an edge, and
    features beyond their neighbours have no distance.
    """
    unknown = np.full(len(features), np.nan)
    pixel, _ = project(camera, points)
    if camera.row_ns or camera.exposure_ns:
        seconds = (camera.row_ns * np.nan_to_num(pixel[:, 1]) + camera.exposure_ns / 2) * 1e-9
        points = moved_back(points, seconds, motion=motion)
        pixel, _ = project(camera, points)
    inside = np.isfinite(pixel).all(axis=1)
    margin = radius + 1
    inside &= ((pixel > -margin) & (pixel < [camera.width + margin, camera.height + margin])).all(axis=1)
    points, pixel = points[inside], pixel[inside]
    distance = np.linalg.norm(points, axis=1)
    seen = unhidden(pixel, distance) if len(points) else np.zeros(0, bool)
    points, pixel, distance = points[seen], pixel[seen], distance[seen]
    if len(points) < _NEIGHBOURS or not len(features):
        return unknown, unknown.copy()
    away, rows = cKDTree(pixel).query(features.pixel, k=_NEIGHBOURS, distance_upper_bound=radius)
    near = np.isfinite(away)
    rows = np.where(near, rows, 0)
    unit = points[rows] / distance[rows][:, :, None]
    across = np.einsum("nij,nki->nkj", tangents(features.bearing), unit)
    design = np.concatenate([np.ones((*across.shape[:2], 1)), across], axis=2) * near[:, :, None]
    inverse = np.where(near, 1.0 / distance[rows], 0.0)
    normal = np.swapaxes(design, 1, 2) @ design
    normal += np.diag([1e-12, 1e-9, 1e-9])  # neighbours of one ring are on a line
    spread = np.linalg.inv(normal)
    plane = np.einsum("nij,nkj,nk->ni", spread, design, inverse)
    off = (np.einsum("nki,ni->nk", design, plane) - inverse) * near
    count = near.sum(axis=1)
    level = np.maximum(plane[:, 0], 1e-9)
    rough = np.sqrt((off**2).sum(axis=1) / np.maximum(count - 3, 1)) / level
    leverage = spread[:, 0, 0]
    known = (count >= 5) & (plane[:, 0] > 1e-4) & (rough < _FLAT) & (leverage < _SURE)
    fuzz = np.hypot(_LEAST_FUZZ, rough * np.sqrt(np.maximum(leverage, 0)))
    return np.where(known, 1.0 / level, np.nan), np.where(known, fuzz, np.nan)


def stereo_distances(first: ImageFeatures, second: ImageFeatures, *, pose: Float) -> tuple[Float, Float]:
    """Distances (n,) of features by those of a second camera, and their deviations over them; NaN if unknown.

    pose : (4, 4) of the second camera in the first one's frame

    Matches are those near their epipolar planes. The cameras may look anywhere, and be of any model.
    """
    distance, fuzz = np.full(len(first), np.nan), np.full(len(first), np.nan)
    here, there = matches(first.descriptor, second.descriptor)
    ahead = second.bearing[there] @ pose[:3, :3].T
    normal = np.cross(pose[:3, 3], first.bearing[here])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    sigma = np.hypot(first.sigma[here], second.sigma[there])
    on = np.abs(np.einsum("ni,ni->n", normal, ahead)) < _EPIPOLAR * sigma
    here, there, sigma = here[on], there[on], sigma[on]
    found, deviation = triangulate(
        first.bearing[here], second.bearing[there], pose=pose, sigma=sigma / np.sqrt(2.0)
    )
    distance[here], fuzz[here] = found, deviation
    return distance, fuzz

"""ORB features of images and their matches (Rublee et al. 2011)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.errors import need
from geoscene.typing import Bools, Float, Ints
from lidar.dataset.layout import reading_file
from lidar.dataset.recorded import mount_of
from lidar.sensors.rig.camera_model import unproject
from lidar.sensors.rig.specs import CameraSpec
from lidar.tools.odometry.settings import OdometrySettings

_FARTHEST_MATCH = 64  # differing bits of 256, up to which two features may be the same
_SURPLUS = 6  # times as many features are detected as are kept, so that weak parts of the image have some
_CONTRAST = 7  # grey levels by which a corner differs from its surroundings, at least
_CELL = 60.0  # pixels: side of the cells that give as many features as the others
_SCALE = 1.2  # between the levels of the pyramid of images


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

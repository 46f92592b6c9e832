"""Distances of image features: from laser points projected into the image, or from a second camera."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from geoscene.typing import Bools, Float
from lidar.sensors.rig.camera_model import project
from lidar.sensors.rig.specs import CameraSpec
from lidar.tools.odometry.deskewing import moved_back
from lidar.tools.odometry.features import ImageFeatures, matches
from lidar.tools.odometry.view_geometry import tangents, triangulate

_NEIGHBOURS = 8
_CELL = 8.0  # pixels: side of the cells in which nearer points hide farther ones
_DEEPER = (1.1, 0.5)  # share and metres, by which a point is farther than those that hide it
_FLAT = 0.02  # share of a distance by which neighbours lie off their plane, at most
_SURE = 1.0  # leverage of a feature on the plane of its neighbours, up to which it is not beyond them
_LEAST_FUZZ = 0.005  # of a distance: errors of laser ranges and of the time of points
_EPIPOLAR = 3.0  # standard deviations of a match from its epipolar plane


def unhidden(pixel: Float, distance: Float) -> Bools:
    """Visibility (n,) of points: whether no nearer surface hides them.

    pixel    : (n, 2) at which they appear
    distance : (n,) from the camera

    A laser scanner looks past the camera: it has points on what walls and vehicles hide from it. Points much
    farther than the nearest one of the cells around their own are left out.
    """
    cell = np.floor(pixel / _CELL).astype(np.int64)
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

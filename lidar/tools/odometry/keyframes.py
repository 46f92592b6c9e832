"""Keyframes of a camera, their refinement in a window, and loops between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from geoscene.errors import need
from geoscene.typing import Float, Ints
from lidar.tools.odometry.features import ImageFeatures

_FIRM = 1e-4  # radians and metres: of the pose that a window or a graph hangs on
_SCALE_FIRM = 1e-3  # share of the way between the first two poses of a window without distances
_HUBER = 1.5  # standard deviations, from which an error counts linearly
_CAUCHY = 1.0  # likewise, from which loops lose weight
_DRIFT = (0.002, 0.02)  # radians and metres per root of a metre: of a step, which drifts as a random walk
_LEAST_VIEWS = 2
_WEIGHINGS = 3  # times that a window with ranges is fitted, with weights by the distances found before


@dataclass
class Keyframe:
    """An image whose features others are matched to.

    row      : of the frame
    pose     : (4, 4) of the camera in the map
    features : of the image, bearings at the time of the pose
    distance : (n,) metres from the camera; NaN where unknown
    fuzz     : (n,) one standard deviation of the distance over it
    measured : (n,) whether the distance was measured here
    track    : (n,) number of the point of the map
    way      : metres to it from the first
    """

    row: int
    pose: Float
    features: ImageFeatures
    distance: Float
    fuzz: Float
    measured: np.ndarray[Any, np.dtype[np.bool_]]
    track: Ints
    way: float = 0.0

    def points(self, rows: Ints) -> Float:
        """Points (m, 3) of features in the map."""
        local = self.distance[rows][:, None] * self.features.bearing[rows]
        placed: Float = local @ self.pose[:3, :3].T + self.pose[:3, 3]
        return placed


def refine_window(window: list[Keyframe], *, scaled: bool) -> None:
    """Move the keyframes of a window, but for the first, to where their bearings and distances fit best.

    scaled : whether distances were measured; else the way between the first two keeps its length

    Bundle adjustment with bearings (and ranges) by gtsam, with Huber's loss. Distances of features are those
    to the points found.
    """
    gtsam = need("gtsam", "odometry")
    tracks = [frame.track[np.isfinite(frame.distance)] for frame in window]
    number, views = np.unique(np.concatenate(tracks), return_counts=True)
    shared = number[views >= _LEAST_VIEWS]
    if len(shared) < 10:
        return
    pose_key, point_key = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L
    values, place = gtsam.Values(), dict[int, Float]()
    for k, frame in enumerate(window):
        values.insert(pose_key(k), gtsam.Pose3(frame.pose))
        rows = np.flatnonzero(np.isin(frame.track, shared) & np.isfinite(frame.distance))
        for row, point in zip(rows.tolist(), frame.points(rows), strict=True):
            track = int(frame.track[row])
            if track not in place:
                place[track] = point
                values.insert(point_key(track), point)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(10)
    found = values
    for _ in range(_WEIGHINGS if scaled else 1):
        graph = _window_graph(window, found, place=place, scaled=scaled)
        try:
            found = gtsam.LevenbergMarquardtOptimizer(graph, found, parameters).optimize()
        except RuntimeError:  # of an indeterminate system: the window stays as it was
            return
    poses = [found.atPose3(pose_key(k)).matrix() for k in range(len(window))]
    if not all(np.isfinite(pose).all() for pose in poses):
        return
    for frame, pose in zip(window[1:], poses[1:], strict=True):
        frame.pose = pose
    points = {track: np.asarray(found.atPoint3(point_key(track))) for track in place}
    for frame in window:
        rows = np.flatnonzero(np.isin(frame.track, shared) & np.isfinite(frame.distance) & ~frame.measured)
        if len(rows):
            there = np.array([points[int(frame.track[row])] for row in rows])
            frame.distance[rows] = np.linalg.norm(there - frame.pose[:3, 3], axis=1)


def _window_graph(window: list[Keyframe], values: Any, *, place: dict[int, Float], scaled: bool) -> Any:
    """The factors of a window; ``values`` are its present poses and points, ``place`` the first ones.

    Ranges from two bearings have symmetric errors as inverse ranges only; as ranges, those measured too short
    would count more, and the way would shrink. So each counts as the range whose difference from the present
    distance is, to first order, that of the inverse ranges.
    """
    gtsam = need("gtsam", "odometry")
    pose_key, point_key = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L
    graph = gtsam.NonlinearFactorGraph()
    huber = gtsam.noiseModel.mEstimator.Huber.Create(_HUBER)
    for k, frame in enumerate(window):
        centre = values.atPose3(pose_key(k)).translation()
        for row in np.flatnonzero(np.isin(frame.track, list(place)) & np.isfinite(frame.distance)).tolist():
            track = int(frame.track[row])
            sigma = float(frame.features.sigma[row])
            bearing = gtsam.Unit3(frame.features.bearing[row])
            if frame.measured[row]:
                away = float(np.linalg.norm(values.atPoint3(point_key(track)) - centre))
                measured = float(frame.distance[row])
                spread = np.array([sigma, sigma, float(frame.fuzz[row]) * away**2 / measured])
                noise = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Diagonal.Sigmas(spread))
                distance = 2.0 * away - away**2 / measured
                graph.add(gtsam.BearingRangeFactor3D(pose_key(k), point_key(track), bearing, distance, noise))
            else:
                plain = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
                noise = gtsam.noiseModel.Robust.Create(huber, plain)
                graph.add(gtsam.BearingFactor3D(pose_key(k), point_key(track), bearing, noise))
    firm = gtsam.noiseModel.Isotropic.Sigma(6, _FIRM)
    graph.add(gtsam.PriorFactorPose3(pose_key(0), gtsam.Pose3(window[0].pose), firm))
    if not scaled and len(window) > 1:
        base = window[1].pose[:3, 3] - window[0].pose[:3, 3]
        length = max(float(np.linalg.norm(base)), 1e-6)
        noise = gtsam.noiseModel.Isotropic.Sigma(1, _SCALE_FIRM * length)
        graph.add(gtsam.RangeFactorPose3(pose_key(0), pose_key(1), length, noise))
    for track, point in place.items():  # a point far away has no distance from bearings alone
        away = float(np.linalg.norm(point - window[0].pose[:3, 3]))
        loose = gtsam.noiseModel.Isotropic.Sigma(3, 10.0 * away)
        graph.add(gtsam.PriorFactorPoint3(point_key(track), point, loose))
    return graph


def close_loops(keyframes: list[Keyframe], loops: list[tuple[int, int, Float, Float]]) -> Float:
    """Poses (n, 4, 4) of keyframes that fit their edges and loops best: a pose graph by gtsam.

    loops : pairs of keyframes, the pose of the second in the frame of the first, and the standard
            deviations (6,) of that
    """
    gtsam = need("gtsam", "odometry")
    edges, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    firm = gtsam.noiseModel.Isotropic.Sigma(6, _FIRM)
    edges.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(keyframes[0].pose), firm))
    for k, frame in enumerate(keyframes):
        values.insert(k, gtsam.Pose3(frame.pose))
        if k:
            step = np.linalg.inv(keyframes[k - 1].pose) @ frame.pose
            length = float(np.linalg.norm(step[:3, 3]))
            sigma = np.repeat(_DRIFT, 3) * np.sqrt(max(length, 0.1))
            noise = gtsam.noiseModel.Diagonal.Sigmas(sigma)
            edges.add(gtsam.BetweenFactorPose3(k - 1, k, gtsam.Pose3(step), noise))
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(_CAUCHY)
    # With Cauchy's loss alone, loops would have no weight against the drift that they are to take out.
    for robust in (False, True):
        graph = gtsam.NonlinearFactorGraph(edges)
        for first, second, pose, sigma in loops:
            plain = gtsam.noiseModel.Diagonal.Sigmas(sigma)
            noise = gtsam.noiseModel.Robust.Create(cauchy, plain) if robust else plain
            graph.add(gtsam.BetweenFactorPose3(first, second, gtsam.Pose3(pose), noise))
        values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return np.array([values.atPose3(k).matrix() for k in range(len(keyframes))])

"""Signal heads in images: states and bounding boxes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from lidar.geometry.poses import Poses
from lidar.sensors.camera.light import Lamps
from lidar.sensors.camera.render import CameraImage as Image
from lidar.traffic.signal_heads import STATES, SignalStates

_LAMPS_Z = 2.9  # metres of the middle of the lamps above the foot of the post


def lamps_at(signals: SignalStates, time_ns: int) -> Lamps:
    """The lamps that are lit at a time, nanoseconds since the drive's start."""
    return Lamps(signals.heads.feature, signals.at(time_ns * 1e-9))


def signal_columns(
    signals: SignalStates, image: Image, *, pose: Poses, frame: int, time_ns: int
) -> dict[str, NDArray[Any]]:
    """Columns of ``signals.csv``: the signal heads (k,) in an image.

    image   : as it was rendered, before stages
    pose    : of the camera, one
    time_ns : at which the heads show their states, nanoseconds since the drive's start
    """
    heads = signals.heads
    v, u = np.nonzero(image.klass == Class.TRAFFIC_LIGHT)
    seen = image.feature[v, u]
    known = np.isin(seen, heads.feature)
    v, u, seen = v[known], u[known], seen[known]
    feature, which, pixels = np.unique(seen, return_inverse=True, return_counts=True)
    row = np.searchsorted(heads.feature, feature)
    k = len(feature)
    low, high = np.full((k, 2), np.inf), np.full((k, 2), -np.inf)
    for side, at in enumerate((u, v)):
        np.minimum.at(low[:, side], which, at - 0.5)
        np.maximum.at(high[:, side], which, at + 0.5)
    toward = pose.position - heads.place[row] - [0.0, 0.0, _LAMPS_Z]
    front = np.column_stack([np.cos(heads.heading[row]), np.sin(heads.heading[row]), np.zeros(k)])
    cosine = np.einsum("ij,ij->i", toward, front) / np.maximum(np.linalg.norm(toward, axis=1), 1e-9)
    return {
        "frame": np.full(k, frame),
        "time_ns": np.full(k, time_ns),
        "instance": feature,
        "state": np.array(STATES, np.str_)[signals.at(time_ns * 1e-9)[row]],
        "angle_deg": np.round(np.degrees(np.arccos(np.clip(cosine, -1, 1))), 1),
        "junction": heads.zone[row],
        "left": low[:, 0],
        "top": low[:, 1],
        "right": high[:, 0],
        "bottom": high[:, 1],
        "pixels": pixels,
    }

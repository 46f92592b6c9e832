"""Radial velocities of returns, as frequency-modulated scanners measure them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lidar.cloud import Cloud
from lidar.poses import Trajectory
from lidar.rig import Mount

Float = NDArray[np.float64]

_HALF_NS = 500_000  # half the span over which the sensor's own velocity is taken


def radial_velocity(
    cloud: Cloud,
    mount: Mount,
    trajectory: Trajectory,
    *,
    features: NDArray[np.integer] | None = None,
    velocities: Float | None = None,
) -> NDArray[np.float32]:
    """Radial velocity (n,) of each return against the sensor in m/s, positive away from it.

    features   : (k,) feature numbers of things that move
    velocities : (k, 3) their velocities in true m/s along the scene's axes; all else stands still
    """
    time = cloud.start_ns + cloud.time_ns.astype(np.int64)
    moments, moment = np.unique(time, return_inverse=True)
    before, after = (
        trajectory.at(moments + shift).mounted(mount.translation, mount.rotation)
        for shift in (-_HALF_NS, _HALF_NS)
    )
    # The ends of a drive are held, so the span is what is left of it there.
    inside = np.clip([moments - _HALF_NS, moments + _HALF_NS], trajectory.time_ns[0], trajectory.time_ns[-1])
    seconds = (inside[1] - inside[0])[:, None] * 1e-9
    own = (after.position - before.position) / after.scale / np.maximum(seconds, 1e-9)
    pose = trajectory.at(moments).mounted(mount.translation, mount.rotation)
    way = np.einsum("nij,nj->ni", pose.rotation[moment], cloud.xyz.astype(np.float64))
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
    relative = -own[moment]
    if features is not None and velocities is not None and len(features):
        rank = np.argsort(features)
        place = np.minimum(np.searchsorted(features[rank], cloud.feature), len(features) - 1)
        row = rank[place]
        relative = relative + np.where((features[row] == cloud.feature)[:, None], velocities[row], 0.0)
    radial: NDArray[np.float32] = np.einsum("ij,ij->i", relative, way).astype(np.float32)
    return radial

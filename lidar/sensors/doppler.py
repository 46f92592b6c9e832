"""Radial velocities of returns, as frequency-modulated scanners measure them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.geometry.mounts import Mount
from lidar.geometry.poses import Trajectory
from lidar.sensors.cloud import Cloud
from lidar.world.actors import Actors, rotations, states

_HALF_NS = 500_000  # half the span over which velocities are taken


def radial_velocity(
    cloud: Cloud, mount: Mount, *, trajectory: Trajectory, moving: Float | None = None
) -> NDArray[np.float32]:
    """Radial velocity (n,) of each return against the sensor in m/s, positive away from it.

    moving : (n, 3) true m/s along the scene's axes of what each return lies on; all stands still by default
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
    relative = -own[moment] if moving is None else moving - own[moment]
    radial: NDArray[np.float32] = np.einsum("ij,ij->i", relative, way).astype(np.float32)
    return radial


def surface_velocity(
    actors: Actors, feature: NDArray[np.integer], *, placed: Float, time_ns: NDArray[np.int64]
) -> Float:
    """Velocity (n, 3) in true m/s along the scene's axes of what points lie on; 0 for what stands still.

    A point goes with the rigid body that it lies on, which drives and turns; limbs do not swing.

    feature : (n,) feature numbers
    placed  : (n, 3) scene metres at each point's time
    time_ns : (n,) nanoseconds since the drive's start
    """
    out = np.zeros((len(feature), 3))
    if not len(actors):
        return out
    row = feature.astype(np.int64) - int(actors.feature[0])
    on = np.flatnonzero((row >= 0) & (row < len(actors)))
    on = on[~actors.parked[row[on]]]
    row, time = row[on], time_ns[on]
    across = np.array([actors.scale, actors.scale, 1.0])
    now = states(actors, row, time_ns=time)
    local = np.einsum("nji,nj->ni", rotations(now.angles), (placed[on] - now.position) / across)
    ends = []
    for shift in (-_HALF_NS, _HALF_NS):
        at = states(actors, row, time_ns=time + shift)
        ends.append(at.position / across + np.einsum("nij,nj->ni", rotations(at.angles), local))
    out[on] = (ends[1] - ends[0]) / (2e-9 * _HALF_NS)
    return out

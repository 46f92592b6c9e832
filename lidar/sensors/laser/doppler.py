"""Radial velocities of returns, as frequency-modulated (FMCW) scanners measure them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.geometry.attitude import Mount
from lidar.geometry.poses import Trajectory
from lidar.sensors.laser.cloud import Cloud
from lidar.world.actors import Actors, rotations, states

_HALF_NS = 500_000  # half the interval of the finite differences


def radial_velocity(
    cloud: Cloud, mount: Mount, *, trajectory: Trajectory, moving: Float | None = None
) -> NDArray[np.float32]:
    """Radial velocity (n,) of each return relative to the sensor in m/s, positive away from it.

    moving : (n, 3) velocity of the surface of each return, true m/s along the scene's axes; 0 by default
    """
    time = cloud.start_ns + cloud.time_ns.astype(np.int64)
    moments, moment = np.unique(time, return_inverse=True)
    before, after = (
        trajectory.at(moments + shift).mounted(mount.translation, mount.rotation)
        for shift in (-_HALF_NS, _HALF_NS)
    )
    # Poses are constant beyond the ends of a drive, so the interval is cut there.
    ends_ns = np.clip([moments - _HALF_NS, moments + _HALF_NS], trajectory.time_ns[0], trajectory.time_ns[-1])
    seconds = (ends_ns[1] - ends_ns[0])[:, None] * 1e-9
    sensor_velocity = (after.position - before.position) / after.scale / np.maximum(seconds, 1e-9)
    pose = trajectory.at(moments).mounted(mount.translation, mount.rotation)
    direction = np.einsum("nij,nj->ni", pose.rotation[moment], cloud.xyz.astype(np.float64))
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    relative = (0.0 if moving is None else moving) - sensor_velocity[moment]
    radial: NDArray[np.float32] = np.einsum("ij,ij->i", relative, direction).astype(np.float32)
    return radial


def surface_velocity(
    actors: Actors, feature: NDArray[np.integer], *, placed: Float, time_ns: NDArray[np.int64]
) -> Float:
    """Velocity (n, 3) of the surfaces that points lie on, true m/s along the scene's axes; 0 if static.

    Road users are rigid bodies that translate and rotate; the swing of limbs is left out.

    feature : (n,) feature numbers
    placed  : (n, 3) scene metres at each point's time
    time_ns : (n,) nanoseconds since the drive's start
    """
    out = np.zeros((len(feature), 3))
    if not len(actors):
        return out
    row = feature.astype(np.int64) - int(actors.feature[0])
    moves = np.flatnonzero((row >= 0) & (row < len(actors)))
    moves = moves[~actors.parked[row[moves]]]
    row, time = row[moves], time_ns[moves]
    scale = np.array([actors.scale, actors.scale, 1.0])
    now = states(actors, row, time_ns=time)
    local = np.einsum("nji,nj->ni", rotations(now.angles), (placed[moves] - now.position) / scale)
    ends = []
    for shift in (-_HALF_NS, _HALF_NS):
        at = states(actors, row, time_ns=time + shift)
        ends.append(at.position / scale + np.einsum("nij,nj->ni", rotations(at.angles), local))
    out[moves] = (ends[1] - ends[0]) / (2e-9 * _HALF_NS)
    return out

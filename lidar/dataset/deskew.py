"""De-skewing: point clouds without the ego vehicle's motion during a frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.geometry.mounts import Mount
from lidar.geometry.poses import Trajectory

MOMENTS = {"start": 0.0, "middle": 0.5, "end": 1.0}
"""Moments of a frame to which points can be de-skewed, as fractions of its period."""


def deskew(placed: Float, trajectory: Trajectory, *, mount: Mount, time_ns: int) -> NDArray[np.float32]:
    """Points (n, 3) in the frame that the sensor has at ``time_ns``, from the true poses.

    placed : (n, 3) scene metres: each point at its own time

    The ego vehicle's motion is removed; the motion of other road users is not.
    """
    pose = trajectory.at([time_ns]).mounted(mount.translation, mount.rotation)
    local: NDArray[np.float32] = (((placed - pose.position) / pose.scale) @ pose.rotation[0]).astype(
        np.float32
    )
    return local

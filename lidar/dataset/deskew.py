"""Clouds as if all of their points had been measured at one moment."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.geometry.mounts import Mount
from lidar.geometry.poses import Trajectory

MOMENTS = {"start": 0.0, "middle": 0.5, "end": 1.0}
"""Moments of a frame that points can be brought to, as shares of its period."""


def deskewed(placed: Float, trajectory: Trajectory, *, mount: Mount, time_ns: int) -> NDArray[np.float32]:
    """Points (n, 3) in the frame that the sensor has at ``time_ns``, from the true poses.

    placed : (n, 3) scene metres: each point where it was at its own time

    What stands still is as it is, without the vehicle's motion during the frame; what moves by itself stays
    smeared along its own way.
    """
    pose = trajectory.at([time_ns]).mounted(mount.translation, mount.rotation)
    local: NDArray[np.float32] = (((placed - pose.position) / pose.scale) @ pose.rotation[0]).astype(
        np.float32
    )
    return local

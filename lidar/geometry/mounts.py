"""Extrinsics: where sensors are mounted on the vehicle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geoscene.typing import Float
from lidar.geometry.attitude import matrix_from_quat

OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Axes of a body (x forward, y left, z up) from those of the camera in it (x right, y down, z forward)."""
OPTICAL_QUAT = (-0.5, 0.5, -0.5, 0.5)


@dataclass(frozen=True, slots=True)
class Mount:
    """Where a sensor sits on the vehicle: a point s of the sensor is at translation + rotation @ s.

    translation : metres in the vehicle frame (origin: the rear axle's centre on the ground)
    quat_xyzw   : vehicle axes from sensor axes
    """

    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quat_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)

    @property
    def rotation(self) -> Float:
        """Vehicle axes from sensor axes, (3, 3)."""
        return matrix_from_quat(self.quat_xyzw)

    @property
    def matrix(self) -> Float:
        """Vehicle frame from sensor frame, (4, 4) homogeneous."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.translation
        return matrix

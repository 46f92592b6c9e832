"""Extrinsics: where sensors are mounted on the vehicle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geoscene.typing import Float
from lidar.geometry.attitude import matrix_from_quat

OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation from optical axes (x right, y down, z forward) to body axes (x forward, y left, z up)."""
OPTICAL_QUAT = (-0.5, 0.5, -0.5, 0.5)


@dataclass(frozen=True, slots=True)
class Mount:
    """Extrinsics of a sensor: its point s lies at translation + rotation @ s in the vehicle frame.

    translation : metres in the vehicle frame (origin: the rear axle's centre on the ground)
    quat_xyzw   : rotation from sensor axes to vehicle axes
    """

    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quat_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)

    @property
    def rotation(self) -> Float:
        """Rotation (3, 3) from sensor axes to vehicle axes."""
        return matrix_from_quat(self.quat_xyzw)

    @property
    def matrix(self) -> Float:
        """Homogeneous transform (4, 4) from the sensor frame to the vehicle frame."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.translation
        return matrix

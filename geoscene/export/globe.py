"""Earth-centred coordinates of a scene, and local east, north, up coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import Transformer

from geoscene.geometry.frames import Frame
from geoscene.typing import Float


@dataclass(frozen=True)
class Globe:
    """Cartesian east, north, up coordinates about a point of the ellipsoid, metres.

    frame  : the scene's
    lift   : metres added to heights of the scene to make them ellipsoidal
    matrix : (4, 4) from east, north, up to WGS 84 Earth-centred (EPSG:4978)
    """

    frame: Frame
    lift: float
    matrix: Float

    @classmethod
    def at(cls, frame: Frame, x: float, *, y: float, lift: float = 0.0) -> Globe:
        """Local coordinates with their origin at a point of the scene."""
        lon, lat = (np.radians(float(v)) for v in frame.to_geographic(x, y))
        matrix = np.eye(4)
        matrix[:3, 0] = -np.sin(lon), np.cos(lon), 0
        matrix[:3, 1] = -np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)
        matrix[:3, 2] = np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)
        matrix[:3, 3] = to_earth_centred(frame, np.array([[x, y, 0.0]]), lift=lift)[0]
        return cls(frame, lift, matrix)

    def local(self, points: Float) -> Float:
        """East, north, up (n, 3) of points in scene metres."""
        return (to_earth_centred(self.frame, points, lift=self.lift) - self.matrix[:3, 3]) @ self.matrix[
            :3, :3
        ]

    def jacobian(self, points: Float) -> Float:
        """(n, 3, 3) derivatives of east, north, up by scene x, y, z at points in scene metres."""
        steps = np.concatenate([np.eye(3), -np.eye(3)])
        around = self.local((points[:, None] + steps).reshape(-1, 3)).reshape(-1, 6, 3)
        return ((around[:, :3] - around[:, 3:]) / 2).transpose(0, 2, 1)


def to_earth_centred(frame: Frame, points: Float, *, lift: float = 0.0) -> Float:
    """WGS 84 Earth-centred coordinates (n, 3), EPSG:4978, of points in scene metres."""
    lon, lat = frame.to_geographic(points[:, 0], points[:, 1])
    change = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    return np.column_stack(change.transform(lon, lat, points[:, 2] + lift))

"""Point cloud of one frame, as columns with one row per return."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.columns import Columns
from geoscene.support.registry import Previewed
from lidar.errors import LidarError


@dataclass(frozen=True, slots=True)
class Cloud(Previewed, Columns):
    """The returns of one frame, in the order of their pulses.

    start_ns : time of the frame's first firing, nanoseconds since the drive's start
    xyz       : (n, 3) float32, metres, sensor frame (x forward, y left, z up) at each point's own firing time
    time_ns   : (n,) int32, nanoseconds after ``start_ns``
    ring      : (n,) uint16, rank of the beam's elevation, 0 lowest
    column    : (n,) int32, firing block (azimuth step) within the frame
    range     : (n,) float64, metres as the sensor reports it
    intensity : (n,) float32, calibrated reflectivity as the sensor codes it, 0 to 255
    klass     : (n,) uint8, `geoscene.classes.Class`
    feature   : (n,) int32, feature number in the scene (the instance), -1 for none
    incidence : (n,) float32, radians between beam and surface normal
    true_range : (n,) float64, metres, before noise and quantisation
    echo      : (n,) uint8, 1 for the first echo of its pulse
    echoes    : (n,) uint8, echoes of its pulse
    """

    start_ns: int
    xyz: NDArray[np.float32]
    time_ns: NDArray[np.int32]
    ring: NDArray[np.uint16]
    column: NDArray[np.int32]
    range: NDArray[np.float64]
    intensity: NDArray[np.float32]
    klass: NDArray[np.uint8]
    feature: NDArray[np.int32]
    incidence: NDArray[np.float32]
    true_range: NDArray[np.float64]
    echo: NDArray[np.uint8]
    echoes: NDArray[np.uint8]

    def __post_init__(self) -> None:
        """Check that all columns have the same length."""
        for name, column in self.columns().items():
            if len(column) != len(self.xyz):
                raise LidarError(f"cloud column {name} has {len(column)} rows for {len(self.xyz)}")


@dataclass(frozen=True, slots=True)
class TracedCloud(Cloud):
    """A cloud with the ground truth of its returns, as stages change them.

    The original cloud is what the scanner reports without stages.

    origin : (n,) uint8, `lidar.sensors.physics.echoes.Origin`
    source : (n,) int32, row of the original return that this one is, or was moved from; -1 for an added one
    hidden : (n,) int32, row of the original return that this one hides or replaces; -1 for none
    """

    origin: NDArray[np.uint8]
    source: NDArray[np.int32]
    hidden: NDArray[np.int32]


def no_returns(start_ns: int) -> Cloud:
    """An empty cloud, as of a scanner that is off."""
    kinds = (np.int32, np.uint16, np.int32, np.float64, np.float32, np.uint8, np.int32, np.float32)
    rest: list[Any] = [np.empty(0, kind) for kind in (*kinds, np.float64, np.uint8, np.uint8)]
    return Cloud(start_ns, np.empty((0, 3), np.float32), *rest)

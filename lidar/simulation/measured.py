"""Frames of sensors as they are measured, before any file: point clouds and images with ground truth."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.dataset.deskew import MOMENTS, deskew
from lidar.errors import InputError
from lidar.geometry.mounts import Mount
from lidar.geometry.poses import Poses, Trajectory
from lidar.sensors.laser.cloud import Cloud
from lidar.sensors.rig.specs import CameraSpec

if TYPE_CHECKING:
    from lidar.sensors.camera.render import CameraImage as Image

Columns = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class MeasuredFrame:
    """A frame of a sensor.

    sensor     : name on the rig
    frame      : number, from 0
    time_ns    : start, nanoseconds since the drive's start
    mount      : extrinsics of the sensor
    trajectory : of the ego vehicle
    boxes      : columns of the bounding boxes of road users: as in ``boxes.csv``, see
                 `lidar.dataset.boxes.box_rows`; empty without traffic
    truth      : what stages did, as in truth files; empty without stages
    """

    sensor: str
    frame: int
    time_ns: int
    mount: Mount
    trajectory: Trajectory
    boxes: Columns
    truth: Columns

    @property
    def pose(self) -> Poses:
        """The one pose of the sensor in the scene at the frame's start."""
        return self.trajectory.at([self.time_ns]).mounted(self.mount.translation, self.mount.rotation)

    @property
    def points(self) -> int:
        """Number of returns; 0 for images."""
        return 0


@dataclass(frozen=True)
class MeasuredCloud(MeasuredFrame):
    """A frame of a scanner.

    cloud     : its returns, in the sensor frame at each return's own time; a `TracedCloud` with stages
    period_ns : duration of a frame
    velocity  : (n,) radial velocities as a Doppler scanner measures them, m/s, positive away; else None
    """

    cloud: Cloud
    period_ns: int
    velocity: NDArray[np.float32] | None = None

    @property
    def points(self) -> int:
        """Number of returns."""
        return len(self.cloud)

    @functools.cached_property
    def placed(self) -> Float:
        """The returns (n, 3) in the scene, metres, each placed with the pose at its own time."""
        return placed_cloud(self.cloud, self.trajectory, mount=self.mount)

    def deskewed(self, moment: str = "start") -> NDArray[np.float32]:
        """The returns (n, 3) without the ego vehicle's motion, in the sensor's frame at one moment, metres.

        moment : of the frame: start, middle or end

        Raises InputError for another moment.
        """
        if moment not in MOMENTS:
            raise InputError(f"`moment` {moment}: one of {', '.join(MOMENTS)}")
        time_ns = self.time_ns + int(MOMENTS[moment] * self.period_ns)
        return deskew(self.placed, self.trajectory, mount=self.mount, time_ns=time_ns)


@dataclass(frozen=True)
class MeasuredImages(MeasuredFrame):
    """A frame of a camera.

    camera  : intrinsics and exposure
    image   : colour, depth, classes and instances
    signals : columns of the signal heads in it: as in ``signals.csv``, see
              `lidar.simulation.signals.signal_columns`; empty where their states are not known
    flow    : (h, w, 2) optical flow to the next frame in pixels, NaN where unknown; None if not recorded
    """

    camera: CameraSpec
    image: Image
    signals: Columns
    flow: NDArray[np.float32] | None = None


def firing_times(cloud: Cloud) -> NDArray[np.int64]:
    """Times (n,) of a cloud's returns, nanoseconds since the drive's start."""
    return cloud.start_ns + cloud.time_ns.astype(np.int64)


def placed_cloud(cloud: Cloud, trajectory: Trajectory, *, mount: Mount) -> Float:
    """A cloud's returns (n, 3) in the scene, metres, each placed with the pose at its own time.

    mount : extrinsics of the scanner
    """
    return trajectory.place(
        cloud.xyz, firing_times(cloud), translation=mount.translation, rotation=mount.rotation
    )

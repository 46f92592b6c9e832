"""Input of a defence: a frame's measurements, never labels or ground truth."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from geoscene.typing import Float, Ints
from lidar.geometry.mounts import Mount
from lidar.geometry.poses import Poses, Trajectory
from lidar.sensors.rig.patterns.beams import Firings
from lidar.sensors.rig.scanner import Sensor, firings
from lidar.sensors.rig.specs import CameraSpec
from lidar.tools.detection import RULES, Detections, Detector
from lidar.tools.detection.detector import inside
from lidar.tools.detection.ground import Ground, ground_of

GROUND_BAND = 0.3
"""Metres above the ground up to which returns count as of the ground, as for the detector."""
_DIRECTIONS = 360, 120  # cells of azimuth and elevation in which the depth of view is kept
_MARGIN = 0.1  # metres by which boxes are grown on each side


@dataclass(frozen=True, slots=True)
class Picture:
    """A camera's colour image that was taken during a frame, or just before or after it.

    camera    : intrinsics and mount
    time_ns   : nanoseconds since the drive's start
    file      : PNG of the colours
    """

    camera: CameraSpec
    time_ns: int
    file: Path

    def rgb(self) -> NDArray[np.uint8]:
        """Colours (h, w, 3)."""
        return pixels_of(self.file)


@functools.lru_cache(maxsize=4)
def pixels_of(file: Path) -> NDArray[np.uint8]:
    """Colours (h, w, 3) of a PNG file."""
    from lidar.dataset.png import read_png  # noqa: PLC0415

    return read_png(file)[..., :3].astype(np.uint8)


@dataclass(frozen=True, slots=True)
class NavigationMeasurements:
    """Measurements of the vehicle's receiver and inertial unit over the whole drive.

    gnss      : columns ``time_ns``, ``lon``, ``lat``, ``h``, ``quality``, ``hdop``
    imu       : columns ``time_ns``, ``gyro_z``, ``accel_x`` in the unit's frame
    antenna   : (3,) metres, mount of the antenna on the vehicle
    east_north : scene coordinates (n, 2) of the fixes
    """

    gnss: Mapping[str, NDArray[Any]]
    imu: Mapping[str, NDArray[Any]]
    antenna: Float
    east_north: Float


@dataclass(frozen=True)
class Observation:
    """A frame of a scanner as a reader of the dataset has it; one row per return.

    number    : of the frame
    start_ns  : of the frame, nanoseconds since the drive's start
    sensor    : the scanner, from its data sheet
    mount     : of the scanner on the vehicle
    trajectory : of the vehicle, as recorded
    xyz       : (n, 3) metres, sensor frame at each return's own time
    time_ns   : (n,) nanoseconds since the drive's start
    ring, column, echo, echoes, range, intensity : (n,) as in `lidar.sensors.laser.cloud.Cloud`
    pictures  : images that were taken near the frame
    navigation : fixes and inertial measurements
    detector  : that gives the boxes
    """

    number: int
    start_ns: int
    sensor: Sensor
    mount: Mount
    trajectory: Trajectory
    xyz: Float
    time_ns: Ints
    ring: Ints
    column: Ints
    echo: Ints
    echoes: Ints
    range: Float
    intensity: Float
    pictures: tuple[Picture, ...] = ()
    navigation: NavigationMeasurements | None = None
    detector: Detector = RULES

    def __len__(self) -> int:
        """Number of returns."""
        return len(self.xyz)

    @functools.cached_property
    def distance(self) -> Float:
        """Metres (n,) from the sensor's origin."""
        away: Float = np.linalg.norm(self.xyz, axis=1)
        return away

    @functools.cached_property
    def direction(self) -> Float:
        """Unit vectors (n, 3) from the sensor's origin."""
        unit: Float = self.xyz / np.maximum(self.distance, 1e-9)[:, None]
        return unit

    @functools.cached_property
    def azimuth(self) -> Float:
        """Radians (n,) from the sensor's x axis, counter-clockwise."""
        return np.arctan2(self.xyz[:, 1], self.xyz[:, 0])

    @functools.cached_property
    def scene_xyz(self) -> Float:
        """Scene coordinates (n, 3), each return placed at its own time."""
        return self.placed(self.xyz, self.time_ns)

    def placed(self, points: Float, time_ns: Ints) -> Float:
        """Scene coordinates (n, 3) of points of the sensor frame at times (n,)."""
        mount = self.mount
        return self.trajectory.place(points, time_ns, translation=mount.translation, rotation=mount.rotation)

    def poses(self, time_ns: Any) -> Poses:
        """Poses of the sensor at times in nanoseconds since the drive's start."""
        return self.trajectory.at(time_ns).mounted(self.mount.translation, self.mount.rotation)

    @functools.cached_property
    def firings(self) -> Firings:
        """The pulses of the frame by the sensor's data sheet, in the order they are fired."""
        return firings(self.sensor, self.number)

    @functools.cached_property
    def pulse(self) -> Ints:
        """Row (n,) of `firings` of each return, by ring and column; -1 for a pulse that is not fired."""
        fired = self.firings
        rings = int(max(fired.ring.max(initial=0), self.ring.max(initial=0))) + 1
        known = fired.column.astype(np.int64) * rings + fired.ring
        order = np.argsort(known, kind="stable")
        wanted = self.column.astype(np.int64) * rings + self.ring
        at = np.minimum(np.searchsorted(known[order], wanted), len(known) - 1)
        found: Ints = np.where(known[order][at] == wanted, order[at], -1)
        return found

    @functools.cached_property
    def empty(self) -> NDArray[np.intp]:
        """Rows (k,) of `firings` of the pulses without a return."""
        has = np.zeros(len(self.firings), bool)
        has[self.pulse[self.pulse >= 0]] = True
        return np.flatnonzero(~has)

    @functools.cached_property
    def answered(self) -> tuple[Float, Float]:
        """Pulses that are fired, and the share of them with a return, by ring and degree of azimuth.

        Both have the shape (rings, 360), from -180 degrees on.
        """
        fired = self.firings
        direction = fired.direction
        turn = np.degrees(np.arctan2(direction[:, 1], direction[:, 0])) + 180
        cell = fired.ring.astype(np.int64) * 360 + np.clip(turn, 0, 359).astype(np.int64)
        size = (int(fired.ring.max(initial=0)) + 1) * 360
        has = np.ones(len(fired), bool)
        has[self.empty] = False
        count = np.bincount(cell, minlength=size).reshape(-1, 360).astype(float)
        share = np.bincount(cell, weights=has, minlength=size).reshape(-1, 360) / np.maximum(count, 1)
        return count, share

    @functools.cached_property
    def surface(self) -> Ground:
        """Height of the ground around the sensor."""
        return ground_of(self.xyz)

    @functools.cached_property
    def height(self) -> Float:
        """Metres (n,) above the ground."""
        above: Float = self.xyz[:, 2] - self.surface.below(self.xyz)
        return above

    @functools.cached_property
    def ground(self) -> NDArray[np.bool_]:
        """Whether each return (n,) is of the ground."""
        return self.height <= GROUND_BAND

    @functools.cached_property
    def obstacles(self) -> cKDTree:
        """Tree of the scene coordinates of the returns that are not of the ground."""
        return cKDTree(self.scene_xyz[~self.ground])

    @functools.cached_property
    def _depths(self) -> Float:
        """Least range in cells of direction, of returns; 0 in those without."""
        depth = np.full(_DIRECTIONS, np.inf)
        np.minimum.at(depth, _direction_cell(self.xyz), self.distance)
        return np.where(np.isfinite(depth), depth, 0.0)

    def depth_towards(self, points: Float) -> Float:
        """Range (n,) in metres of the nearest return towards points (n, 3); 0 without a return."""
        depth: Float = self._depths[_direction_cell(points)]
        return depth

    @functools.cached_property
    def objects(self) -> Detections:
        """Boxes that the detector finds, in the sensor frame."""
        return self.detector.detect(self)

    @functools.cached_property
    def members(self) -> tuple[NDArray[np.intp], ...]:
        """Rows of the returns in each box that are not of the ground."""
        boxes, rows = self.objects, np.flatnonzero(~self.ground)
        xyz = self.xyz[rows]
        found = []
        for k in range(len(boxes)):
            near = np.flatnonzero(np.abs(xyz - boxes.centre[k]).max(axis=1) < boxes.size[k].max())
            size = boxes.size[k] + 2 * _MARGIN
            found.append(rows[near[inside(xyz[near], boxes.centre[k], size=size, yaw=float(boxes.yaw[k]))]])
        return tuple(found)


def _direction_cell(points: Float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Cells of azimuth and elevation of points (n, 3)."""
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) + 180
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))) + 90
    cells = (azimuth / 360 * _DIRECTIONS[0], elevation / 180 * _DIRECTIONS[1])
    first, second = (
        np.clip(cell, 0, most - 1).astype(np.int64) for cell, most in zip(cells, _DIRECTIONS, strict=True)
    )
    return first, second

"""Input of a defence: a frame's measurements as a dataset has them, never labels or ground truth."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from geoscene.typing import Float, Ints
from lidar.dataset.formats import FORMATS
from lidar.dataset.layout import Dataset, opened_rows, reading_file
from lidar.dataset.png import read_png
from lidar.dataset.recorded import Stream, cloud_points, clouds_in, color_images
from lidar.errors import DatasetError
from lidar.geometry.attitude import Mount
from lidar.geometry.poses import Poses, Trajectory
from lidar.sensors.physics.link import amplitude, apparent_of_code
from lidar.sensors.rig.devices import Scanner, cameras, scanners
from lidar.sensors.rig.patterns.beams import Firings
from lidar.sensors.rig.scanner import Sensor, firings
from lidar.sensors.rig.specs import CameraSpec, rig_of
from lidar.tools.detection import RULES, Detections, Detector
from lidar.tools.detection.detector import inside
from lidar.tools.detection.ground import Ground, ground_of

SEEN = ("x", "y", "z", "intensity", "time_ns", "ring", "column", "range", "echo", "echoes")
"""Columns of a recorded cloud that come from the scanner; the others are ground truth."""

_FIXES = ("lon", "lat", "h", "quality", "hdop")
_INERTIAL = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")

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
    def apparent(self) -> Float:
        """Apparent reflectance (n,) by the intensity."""
        return apparent_of_code(self.intensity, diffuse_code=self.sensor.diffuse_code)

    def power(self, apparent: Float, distance: Float) -> Float:
        """Power over the detection threshold of targets of an apparent reflectance, metres away."""
        return amplitude(self.sensor, apparent, distance=distance)

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


@dataclass(frozen=True)
class RecordedScans:
    """The frames of a scanner.

    pictures   : images of the cameras, by camera
    navigation : of the vehicle; None without a receiver or an inertial unit
    detector   : of road users
    """

    dataset: Dataset
    sensor: Sensor
    clouds: Stream
    trajectory: Trajectory
    pictures: tuple[tuple[CameraSpec, Stream], ...]
    navigation: NavigationMeasurements | None
    detector: Detector = RULES

    @property
    def frames(self) -> Ints:
        """Numbers of the frames."""
        return self.clouds.frames

    def __iter__(self) -> Iterator[Observation]:
        """The frames in order."""
        return map(self.frame, range(len(self.clouds.frames)))

    def frame(self, row: int) -> Observation:
        """A frame by its row of `frames`.

        Raises DatasetError for a damaged file.
        """
        start, number = int(self.clouds.time_ns[row]), int(self.clouds.frames[row])
        table = {name: c for name, c in cloud_points(self.clouds.files[row]).items() if name in SEEN}
        xyz = np.column_stack([table[axis] for axis in "xyz"]).astype(np.float64)
        whole = {
            name: table[name].astype(np.int64) for name in ("time_ns", "ring", "column", "echo", "echoes")
        }
        return Observation(
            number=number,
            start_ns=start,
            sensor=self.sensor,
            mount=self.clouds.mount,
            trajectory=self.trajectory,
            xyz=xyz,
            range=table["range"].astype(np.float64),
            intensity=table["intensity"].astype(np.float64),
            pictures=tuple(
                picture
                for camera, images in self.pictures
                for picture in _pictures_during(camera, images, window_ns=self.sensor.window_ns(number))
            ),
            navigation=self.navigation,
            detector=self.detector,
            **(whole | {"time_ns": start + whole["time_ns"]}),
        )


def read_scans(dataset: Dataset, *, detector: Detector = RULES) -> list[RecordedScans]:
    """The frames of each scanner of a dataset, with the boxes of a detector.

    Raises InputError if the rig's files have changed since the drive, and DatasetError if clouds are not in
    the sensor frame with ring, column and time.
    """
    with reading_file(dataset.paths.manifest):
        rig = rig_of(str(dataset.manifest["recipe"]["rig"]))
    trajectory = dataset.trajectory()
    specs = {camera.name: camera.spec for camera in cameras(rig)}
    streams = ((name, color_images(dataset, name)) for name in dataset.sensors("camera") if name in specs)
    pictures = tuple((specs[name], stream) for name, stream in streams if stream is not None)
    navigation = _navigation(dataset)
    found = [
        RecordedScans(
            dataset,
            scanner.sensor,
            _clouds(dataset, scanner),
            trajectory=trajectory,
            pictures=pictures,
            navigation=navigation,
            detector=detector,
        )
        for scanner in scanners(rig)
    ]
    if not found:
        raise DatasetError(f"{dataset.path}: has no scanner")
    return found


def _clouds(dataset: Dataset, scanner: Scanner) -> Stream:
    able = [form for form in FORMATS.values() if form.frame == "sensor" and set(SEEN) <= set(form.columns)]
    for form in able:
        if (stream := clouds_in(dataset, scanner.name, form=form)) is not None:
            return stream
    raise DatasetError(
        f"{dataset.path}: {scanner.name} has no clouds in the sensor frame with ring, column and time;"
        f" drive again with `formats` {' or '.join(form.name for form in able)}"
    )


def _pictures_during(camera: CameraSpec, images: Stream, *, window_ns: tuple[int, int]) -> list[Picture]:
    """A camera's pictures from just before to just after a frame."""
    room = int(0.5e9 / camera.rate_hz)
    near = (images.time_ns >= window_ns[0] - room) & (images.time_ns <= window_ns[1] + room)
    return [Picture(camera, int(images.time_ns[k]), images.files[k]) for k in np.flatnonzero(near)]


def _navigation(dataset: Dataset) -> NavigationMeasurements | None:
    receivers, units = dataset.sensors("gnss"), dataset.sensors("imu")
    if not receivers or not units:
        return None
    receiver, unit = next(iter(receivers)), next(iter(units))
    gnss = _columns(dataset, receiver, names=_FIXES)
    imu = _columns(dataset, unit, names=_INERTIAL)
    x, y = dataset.frame.from_geographic(np.nan_to_num(gnss["lon"]), np.nan_to_num(gnss["lat"]))
    place = np.column_stack([x, y])
    place[~np.isfinite(gnss["lon"])] = np.nan
    mount = np.array(receivers[receiver]["vehicle_from_sensor"], float)
    return NavigationMeasurements(gnss, imu, mount[:3, 3], place)


def _columns(dataset: Dataset, name: str, *, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    """Columns of a device's measurements; none of its ground truth."""
    path = dataset.paths.measurements(name)
    with reading_file(path), opened_rows(path) as rows:
        table = [(int(row["time_ns"]), *(float(row[column]) for column in names)) for row in rows]
    values = np.array([row[1:] for row in table], float).reshape(-1, len(names))
    time_ns = np.array([row[0] for row in table], np.int64)
    return {"time_ns": time_ns, **dict(zip(names, values.T, strict=True))}

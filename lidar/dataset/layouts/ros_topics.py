"""The topics of a recorded drive as a ROS 2 recording has them, and their messages in order of time.

Frames: ``map`` (REP 105: true metres from the scene's origin, x east, y north, z up), ``base_link`` (the
vehicle) and one of each sensor's name; a camera has ``<name>`` with the axes of a body (x forward, y left,
z up) and ``<name>_optical`` (REP 103: x right, y down, z forward), in which its images are.
"""

from __future__ import annotations

import functools
import logging
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from geoscene.errors import GeosceneError
from geoscene.typing import Float, Ints
from lidar.dataset.ground_truth import COLUMNS, read_boxes
from lidar.dataset.layout import Dataset, frame_numbers, reading_file
from lidar.dataset.layouts import ros_messages as ros
from lidar.dataset.navigation_files import read_fixes, read_samples
from lidar.dataset.png import counts_to_depth, read_png
from lidar.dataset.recorded import cloud_points, labelled_clouds, labelled_formats, mount_of
from lidar.errors import DatasetError, LidarError
from lidar.geometry.attitude import OPTICAL, OPTICAL_QUAT, body_rates, matrix_from_quat, quat_from_matrix
from lidar.geometry.poses import Trajectory
from lidar.geometry.time_scales import posix_ns
from lidar.parameters import Parameters, parameter
from lidar.sensors.navigation.measurements import fix_variances
from lidar.sensors.rig.devices import Scanner, scanners
from lidar.sensors.rig.patterns.repeating import Scan2d
from lidar.sensors.rig.specs import Rig

log = logging.getLogger(__name__)

MAP, BASE = "map", "base_link"
"""Frames of the scene and of the vehicle (REP 105)."""

ODOMETRY = "/ground_truth/odometry"
"""Topic of the true motion."""

_TAKEN = {MAP, BASE, "tf", "tf_static", "ground_truth"}
"""Names that are not free for sensors."""

_COPIED = {
    "rgb": ("image_raw", "rgb8"),
    "semantic": ("semantic", "mono8"),
    "instance": ("instance", "rgb8"),
}
"""Images that are copied as PNG files: their topic below the camera's name, and the encoding of pixels.

``/compressed`` follows, by the convention of image_transport.
"""


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic.

    kind    : message type
    time_ns : (n,) when each message is complete, rising, nanoseconds since the drive's start
    make    : makes the message of a row, when it is its turn
    counted : what the messages are, for the summary; empty for those that are not counted
    latched : whether late subscribers get the last message, too
    """

    name: str
    kind: str
    time_ns: Ints
    make: Callable[[int], Any]
    counted: str = ""
    latched: bool = False


@dataclass(frozen=True)
class RosOptions(Parameters):
    """Choices of a recording."""

    points: str = parameter(
        "auto",
        "fields of clouds, those of a driver; auto: of the scanner's maker, velodyne for others",
        among=("auto", *ros.POINTS, ros.CUSTOM),
    )
    imu: str = parameter(
        "none",
        "orientation in messages of inertial units: none, or the true attitude",
        among=("none", "truth"),
    )

    def layout_of(self, sensor: Mapping[str, Any]) -> str:
        """Layout of the points of a scanner's entry of ``calibration.json``."""
        if self.points != "auto":
            return self.points
        maker = str(sensor.get("model", "")).partition(" ")[0].lower()
        return maker if maker in ros.POINTS else "velodyne"


@dataclass(frozen=True)
class RosDrive:
    """A drive and what all of its topics share."""

    dataset: Dataset
    options: RosOptions = RosOptions()

    @functools.cached_property
    def base_ns(self) -> int:
        """The drive's start, nanoseconds since 1970."""
        return posix_ns(self.dataset.start)

    @functools.cached_property
    def trajectory(self) -> Trajectory:
        """The ego vehicle's poses."""
        return self.dataset.trajectory()

    @property
    def scale(self) -> Float:
        """Scene metres per true metre (3,)."""
        return np.array([self.trajectory.scale[0], self.trajectory.scale[0], 1.0])

    @functools.cached_property
    def sensors(self) -> dict[str, dict[str, Any]]:
        """Entries of ``calibration.json`` by the sensors' names."""
        return self.dataset.sensors()

    @functools.cached_property
    def names(self) -> dict[str, str]:
        """Names of the sensors' frames and topics, by the sensors' own names.

        Raises DatasetError for sensors without distinct names.
        """
        names = {name: ros_name(name) for name in self.sensors}
        frames = [f"{names[k]}_optical" for k, s in self.sensors.items() if s["kind"] == "camera"]
        used = [*names.values(), *frames, *_TAKEN]
        if twice := sorted({name for name in used if used.count(name) > 1}):
            raise DatasetError(
                f"{self.dataset.paths.calibration}: {', '.join(twice)}: frames of ROS need distinct names;"
                " rename sensors in the rig and drive again"
            )
        return names

    @functools.cached_property
    def rig(self) -> Rig | None:
        """The rig, if its files are as they were for the drive."""
        try:
            return self.dataset.rig()
        except (GeosceneError, LidarError) as error:
            log.warning("no laser scans of 2D scanners and no covariances of inertial units: %s", error)
            return None

    def stamp(self, time_ns: int) -> int:
        """Nanoseconds since 1970 of a time since the drive's start."""
        return self.base_ns + int(time_ns)

    @functools.cached_property
    def flat_scanners(self) -> dict[str, Scanner]:
        """The rig's 2D scanners by name."""
        devices = [] if self.rig is None else scanners(self.rig)
        return {device.name: device for device in devices if isinstance(device.sensor.pattern, Scan2d)}


def ros_name(name: str) -> str:
    """A sensor's name as a token of a ROS 2 topic: letters, digits and single underscores, no digit first."""
    token = re.sub(r"[-_]+", "_", name)
    return f"sensor_{token}" if token[:1].isdigit() else token


def topics_of(drive: RosDrive) -> list[Topic]:
    """All topics of a drive; messages of the same time are written in the order of their topics.

    Raises DatasetError for sensors that cannot be told apart, and for images without a time.
    """
    found = _motion_topics(drive)
    for name, sensor in drive.sensors.items():
        add = {"imu": _imu, "gnss": _gnss, "camera": _camera, "lidar": _scanner}[sensor["kind"]]
        found += add(drive, name)
    return found


def _motion_topics(drive: RosDrive) -> list[Topic]:
    trajectory = drive.trajectory
    time_ns = trajectory.time_ns
    place, quat = trajectory.position / drive.scale, trajectory.quat_xyzw
    velocity = np.einsum("nji,nj->ni", matrix_from_quat(quat), trajectory.velocity)
    rates = body_rates(time_ns * 1e-9, quat)

    def pose(k: int) -> Any:
        return ros.transforms([(MAP, BASE, place[k], quat[k])], drive.stamp(time_ns[k]))

    def motion(k: int) -> Any:
        return ros.odometry(
            place[k],
            quat[k],
            stamp_ns=drive.stamp(time_ns[k]),
            frame_id=MAP,
            child=BASE,
            velocity=velocity[k],
            rates=rates[k],
        )

    kind = "tf2_msgs/msg/TFMessage"
    return [
        Topic("/tf_static", kind, np.zeros(1, np.int64), lambda _: _mounts(drive), latched=True),
        Topic("/tf", kind, time_ns, pose),
        Topic(ODOMETRY, "nav_msgs/msg/Odometry", time_ns, motion, "poses"),
    ]


def _mounts(drive: RosDrive) -> Any:
    """The message of all mounts: sensors on the vehicle, optical frames on cameras."""
    rows: list[tuple[str, str, Any, Any]] = []
    for name, sensor in drive.sensors.items():
        mount, frame = mount_of(sensor), drive.names[name]
        if sensor["kind"] != "camera":
            rows.append((BASE, frame, mount.translation, mount.quat_xyzw))
            continue
        rows.append((BASE, frame, mount.translation, quat_from_matrix(mount.rotation @ OPTICAL.T)))
        rows.append((frame, f"{frame}_optical", (0, 0, 0), OPTICAL_QUAT))
    return ros.transforms(rows, drive.stamp(0))


def _imu(drive: RosDrive, name: str) -> list[Topic]:
    """Samples, with the variances of the white noise of rates and forces; 0 for unknown ones."""
    spec = next((unit for unit in (drive.rig.imus if drive.rig else ()) if unit.name == name), None)
    variances = (0.0, 0.0)
    if spec is not None:
        variances = spec.gyro_noise**2 * spec.rate_hz, spec.accel_noise**2 * spec.rate_hz
    samples = read_samples(drive.dataset.paths.measurements(name))
    quat: Float | None = None
    if drive.options.imu == "truth":
        mount = mount_of(drive.sensors[name])
        poses = drive.trajectory.at(samples.time_ns).mounted(mount.translation, mount.rotation)
        quat = quat_from_matrix(poses.rotation)

    def make(k: int) -> Any:
        stamp_ns, frame = drive.stamp(samples.time_ns[k]), drive.names[name]
        return ros.imu(
            samples.gyro[k],
            samples.accel[k],
            stamp_ns=stamp_ns,
            frame_id=frame,
            variances=variances,
            quat_xyzw=None if quat is None else quat[k],
        )

    topic = f"/{drive.names[name]}/data_raw"
    return [Topic(topic, "sensor_msgs/msg/Imu", samples.time_ns, make, "inertial samples")]


def _gnss(drive: RosDrive, name: str) -> list[Topic]:
    """Fixes, at heights above the ellipsoid."""
    fixes, heights = read_fixes(drive.dataset.paths, name, vertical=drive.dataset.frame.vertical)
    lift = np.zeros(len(fixes))
    if heights.vertical == "orthometric" and heights.separation is not None:
        lift = heights.separation
    elif heights.vertical == "orthometric":
        lift[:] = np.nan
        log.warning("%s: no altitudes: the geoid's height above the ellipsoid is not known", name)
    variances, systems = fix_variances(fixes), ros.letters(fixes.used, fixes.names)

    def make(k: int) -> Any:
        return ros.fix(
            fixes.lonlath[k] + [0, 0, lift[k]],
            drive.stamp(fixes.time_ns[k]),
            frame_id=drive.names[name],
            quality=int(fixes.quality[k]),
            variance=variances[k],
            systems=systems[k],
        )

    return [Topic(f"/{drive.names[name]}/fix", "sensor_msgs/msg/NavSatFix", fixes.time_ns, make, "fixes")]


def _scanner(drive: RosDrive, name: str) -> list[Topic]:
    """Clouds, scans of a 2D scanner, and boxes; complete when the frame ends, with the stamp of its start."""
    clouds = labelled_clouds(drive.dataset, name)
    if clouds is None:
        formats = ", ".join(form.name for form in labelled_formats())
        log.warning("%s: no clouds in the sensor frame with labels: drive with `formats` %s", name, formats)
        return []
    frame_id, flat = drive.names[name], drive.flat_scanners
    ends = clouds.time_ns + round(1e9 / float(clouds.sensor["rate_hz"]))

    points = drive.options.layout_of(clouds.sensor)

    def cloud(row: int) -> Any:
        table, stamp_ns = cloud_points(clouds.files[row]), drive.stamp(clouds.time_ns[row])
        with reading_file(clouds.files[row]):
            if points == ros.CUSTOM:
                return ros.custom_cloud(table, stamp_ns, frame_id=frame_id)
            return ros.point_cloud(table, stamp_ns, frame_id=frame_id, points=points)

    def scan(row: int) -> Any:
        table, sensor = cloud_points(clouds.files[row]), flat[name].sensor
        assert isinstance(sensor.pattern, Scan2d)  # noqa: S101
        with reading_file(clouds.files[row]):
            return ros.laser_scan(
                table,
                drive.stamp(clouds.time_ns[row]),
                frame_id=frame_id,
                pattern=sensor.pattern,
                rate_hz=sensor.rate_hz,
                limits=(sensor.min_range, sensor.max_range),
            )

    def boxes(row: int) -> Any:
        rows = read_boxes(drive.dataset.paths.frame_boxes(name, int(clouds.frames[row])), COLUMNS)
        return ros.markers(rows, drive.stamp(clouds.time_ns[row]), frame_id=MAP, scale=drive.scale)

    kind = ros.CUSTOM_MESSAGE if points == ros.CUSTOM else "sensor_msgs/msg/PointCloud2"
    found = [Topic(f"/{frame_id}/points", kind, ends, cloud, "clouds")]
    if name in flat:
        found.append(Topic(f"/{frame_id}/scan", "sensor_msgs/msg/LaserScan", ends, scan, "scans"))
    others = [other for other, s in drive.sensors.items() if s["kind"] == "lidar" and other not in flat]
    folder = drive.dataset.frame_file(drive.dataset.paths.frame_boxes(name, 0)).parent
    if folder.is_dir() and (name in others or not others):
        kind = "visualization_msgs/msg/MarkerArray"
        found.append(Topic(f"/{frame_id}/boxes", kind, ends, boxes, "box arrays"))
    return found


def _camera(drive: RosDrive, name: str) -> list[Topic]:
    """The calibration of a camera with each image, and its images; none without images.

    The stamp is that of boxes in images: the middle of the exposure, of a rolling shutter of the middle row.
    A message is complete when the exposure ends.
    """
    dataset, sensor = drive.dataset, drive.sensors[name]
    frame_id = f"{drive.names[name]}_optical"
    frames: dict[str, Ints] = {}
    for kind in (*_COPIED, "depth"):
        numbers = frame_numbers(dataset.frame_file(dataset.paths.image(name, 0, kind=kind)).parent, ".png")
        if len(numbers):
            frames[kind] = numbers
    if not frames:
        log.warning("%s: no images", name)
        return []
    times = dataset.sample_times(name)
    every = functools.reduce(np.union1d, frames.values())
    if every[-1] >= len(times):
        stamps = dataset.paths.timestamps(name)
        raise DatasetError(f"{stamps}: has no time of frame {every[-1]}; drive again with `overwrite`")
    with reading_file(dataset.paths.calibration):
        if not np.isfinite(np.array(sensor["K"], float).reshape(3, 3)).all():
            raise ValueError("intrinsics are not finite")
        _ = ros.camera_info(sensor, 0, frame_id="")
    exposure, row_ns, height = (int(sensor.get(k, 0)) for k in ("exposure_ns", "row_ns", "height"))
    middle = times + exposure // 2 + height // 2 * row_ns

    def info(row: int) -> Any:
        return ros.camera_info(sensor, drive.stamp(middle[every[row]]), frame_id=frame_id)

    def image(row: int, kind: str) -> Any:
        frame = int(frames[kind][row])
        path, stamp_ns = dataset.paths.image(name, frame, kind=kind), drive.stamp(middle[frame])
        with reading_file(path):
            if kind in _COPIED:
                return ros.png_image(
                    path.read_bytes(), stamp_ns, frame_id=frame_id, encoding=_COPIED[kind][1]
                )
            counts = read_png(path)
            if counts.dtype != np.uint16:
                raise ValueError("is no image of 16 bits")
        return ros.depth_image(counts_to_depth(counts.astype(np.uint16)), stamp_ns, frame_id=frame_id)

    ends = times + exposure + height * row_ns
    base = f"/{drive.names[name]}"
    found = [Topic(f"{base}/camera_info", "sensor_msgs/msg/CameraInfo", ends[every], info)]
    for kind, numbers in frames.items():
        of, type_ = f"{base}/depth", "sensor_msgs/msg/Image"
        if kind in _COPIED:
            of, type_ = f"{base}/{_COPIED[kind][0]}/compressed", "sensor_msgs/msg/CompressedImage"
        found.append(Topic(of, type_, ends[numbers], functools.partial(image, kind=kind), "images"))
    return found

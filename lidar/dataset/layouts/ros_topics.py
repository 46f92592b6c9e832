"""The topics of a recorded drive as a ROS 2 recording has them, and their messages in order of time."""

from __future__ import annotations

import functools
import logging
from collections.abc import Iterator
from typing import Any

import numpy as np

from geoscene.typing import Float
from lidar.dataset.boxes import COLUMNS, read_boxes
from lidar.dataset.layout import reading_file
from lidar.dataset.layouts import ros_messages as ros
from lidar.dataset.layouts.ros_cameras import camera_topics
from lidar.dataset.layouts.ros_drive import BASE, MAP, Message, RosDrive, Topic
from lidar.dataset.navigation_files import read_fixes, read_samples
from lidar.dataset.recorded import Stream, cloud_points, labelled_clouds, labelled_formats, mount_of
from lidar.geometry.attitude import body_rates, matrix_from_quat, quat_from_matrix
from lidar.geometry.mounts import OPTICAL, OPTICAL_QUAT
from lidar.sensors.navigation.measurements import Fixes, fix_variances
from lidar.sensors.rig.devices import Scanner, scanners
from lidar.sensors.rig.patterns.repeating import Scan2d
from lidar.sensors.rig.specs import ImuSpec

log = logging.getLogger(__name__)

ODOMETRY = "/ground_truth/odometry"
"""Topic of the true motion."""


def topics_of(drive: RosDrive) -> list[Topic]:
    """All topics of a drive; messages of the same time are written in the order of their topics.

    Raises DatasetError for sensors that cannot be told apart.
    """
    found = [*_motion_topics(drive)]
    for name, sensor in drive.sensors.items():
        add = {"imu": _imu, "gnss": _gnss, "camera": camera_topics, "lidar": _scanner}[sensor["kind"]]
        found += add(drive, name)
    return found


def _motion_topics(drive: RosDrive) -> list[Topic]:
    count = len(drive.trajectory.time_ns)
    static = iter([(0, functools.partial(_mounts, drive))])
    return [
        Topic("/tf_static", "tf2_msgs/msg/TFMessage", static, 1, latched=True),
        Topic("/tf", "tf2_msgs/msg/TFMessage", _poses(drive), count),
        Topic(ODOMETRY, "nav_msgs/msg/Odometry", _odometry(drive), count, counted="poses"),
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


def _poses(drive: RosDrive) -> Iterator[Message]:
    trajectory = drive.trajectory
    place, quat = trajectory.position / drive.scale, trajectory.quat_xyzw
    for k, time_ns in enumerate(trajectory.time_ns.tolist()):
        row = (MAP, BASE, place[k], quat[k])
        yield time_ns, functools.partial(ros.transforms, [row], drive.stamp(time_ns))


def _odometry(drive: RosDrive) -> Iterator[Message]:
    trajectory = drive.trajectory
    place, quat = trajectory.position / drive.scale, trajectory.quat_xyzw
    velocity = np.einsum("nji,nj->ni", matrix_from_quat(quat), trajectory.velocity)
    rates = body_rates(trajectory.time_ns * 1e-9, quat)
    for k, time_ns in enumerate(trajectory.time_ns.tolist()):
        make = functools.partial(
            ros.odometry,
            place[k],
            quat[k],
            stamp_ns=drive.stamp(time_ns),
            frame_id=MAP,
            child=BASE,
            velocity=velocity[k],
            rates=rates[k],
        )
        yield time_ns, make


def _imu(drive: RosDrive, name: str) -> list[Topic]:
    units = {} if drive.rig is None else {spec.name: spec for spec in drive.rig.imus}
    messages = _samples(drive, name, variances=_imu_variances(units.get(name)))
    count = len(drive.dataset.sample_times(name))
    topic = f"/{drive.names[name]}/data_raw"
    return [Topic(topic, "sensor_msgs/msg/Imu", messages, count, counted="inertial samples")]


def _imu_variances(spec: ImuSpec | None) -> tuple[float, float]:
    """Variances of the white noise of a sample's rates and forces; 0, unknown, without a specification."""
    if spec is None:
        return 0.0, 0.0
    return spec.gyro_noise**2 * spec.rate_hz, spec.accel_noise**2 * spec.rate_hz


def _samples(drive: RosDrive, name: str, *, variances: tuple[float, float]) -> Iterator[Message]:
    samples = read_samples(drive.dataset.paths.measurements(name))
    for k, time_ns in enumerate(samples.time_ns.tolist()):
        make = functools.partial(
            ros.imu,
            samples.gyro[k],
            samples.accel[k],
            stamp_ns=drive.stamp(time_ns),
            frame_id=drive.names[name],
            variances=variances,
        )
        yield time_ns, make


def _gnss(drive: RosDrive, name: str) -> list[Topic]:
    fixes, heights = read_fixes(drive.dataset.paths, name, vertical=drive.dataset.frame.vertical)
    lift = np.zeros(len(fixes))
    if heights.vertical == "orthometric" and heights.separation is not None:
        lift = heights.separation
    elif heights.vertical == "orthometric":
        lift[:] = np.nan
        log.warning("%s: no altitudes: the geoid's height above the ellipsoid is not known", name)
    topic, messages = f"/{drive.names[name]}/fix", _fixes(drive, name, fixes=fixes, lift=lift)
    return [Topic(topic, "sensor_msgs/msg/NavSatFix", messages, len(fixes), counted="fixes")]


def _fixes(drive: RosDrive, name: str, *, fixes: Fixes, lift: Float) -> Iterator[Message]:
    """Fixes with their heights lifted by (n,) metres to those above the ellipsoid."""
    variances = fix_variances(fixes)
    systems = ros.letters(fixes.used, fixes.names)
    for k, time_ns in enumerate(fixes.time_ns.tolist()):
        make = functools.partial(
            ros.fix,
            fixes.lonlath[k] + [0, 0, lift[k]],
            drive.stamp(time_ns),
            frame_id=drive.names[name],
            quality=int(fixes.quality[k]),
            variance=variances[k],
            systems=systems[k],
        )
        yield time_ns, make


def _scanner(drive: RosDrive, name: str) -> list[Topic]:
    clouds = labelled_clouds(drive.dataset, name)
    if clouds is None:
        formats = ", ".join(form.name for form in labelled_formats())
        log.warning("%s: no clouds in the sensor frame with labels: drive with `formats` %s", name, formats)
        return []
    base, count = f"/{drive.names[name]}", len(clouds.files)
    found = [
        Topic(
            f"{base}/points",
            "sensor_msgs/msg/PointCloud2",
            _clouds(drive, clouds),
            count,
            counted="clouds",
        )
    ]
    flat = _flat_scanners(drive)
    if name in flat:
        scans = _scans(drive, clouds, device=flat[name])
        found.append(Topic(f"{base}/scan", "sensor_msgs/msg/LaserScan", scans, count, counted="scans"))
    others = [other for other, s in drive.sensors.items() if s["kind"] == "lidar" and other not in flat]
    boxes = drive.dataset.frame_file(drive.dataset.paths.frame_boxes(name, 0)).parent
    if boxes.is_dir() and (name in others or not others):
        shown = _boxes(drive, clouds)
        found.append(
            Topic(f"{base}/boxes", "visualization_msgs/msg/MarkerArray", shown, count, counted="box arrays")
        )
    return found


def _flat_scanners(drive: RosDrive) -> dict[str, Scanner]:
    """The rig's 2D scanners by name."""
    devices = [] if drive.rig is None else scanners(drive.rig)
    return {device.name: device for device in devices if isinstance(device.sensor.pattern, Scan2d)}


def _ends(clouds: Stream) -> Iterator[tuple[int, int, int]]:
    """Row, start and end of each frame of a scanner, nanoseconds since the drive's start."""
    period_ns = round(1e9 / float(clouds.sensor["rate_hz"]))
    for row, start_ns in enumerate(clouds.time_ns.tolist()):
        yield row, start_ns, start_ns + period_ns


def _clouds(drive: RosDrive, clouds: Stream) -> Iterator[Message]:
    def make(row: int, start_ns: int) -> Any:
        table = cloud_points(clouds.files[row])
        return ros.point_cloud(table, drive.stamp(start_ns), frame_id=drive.names[clouds.name])

    for row, start_ns, end_ns in _ends(clouds):
        yield end_ns, functools.partial(make, row, start_ns)


def _scans(drive: RosDrive, clouds: Stream, *, device: Scanner) -> Iterator[Message]:
    sensor = device.sensor
    assert isinstance(sensor.pattern, Scan2d)  # noqa: S101
    make_scan = functools.partial(
        ros.laser_scan,
        frame_id=drive.names[clouds.name],
        pattern=sensor.pattern,
        rate_hz=sensor.rate_hz,
        limits=(sensor.min_range, sensor.max_range),
    )

    def make(row: int, start_ns: int) -> Any:
        table = cloud_points(clouds.files[row])
        with reading_file(clouds.files[row]):
            return make_scan(table, drive.stamp(start_ns))

    for row, start_ns, end_ns in _ends(clouds):
        yield end_ns, functools.partial(make, row, start_ns)


def _boxes(drive: RosDrive, clouds: Stream) -> Iterator[Message]:
    def make(row: int, start_ns: int) -> Any:
        boxes = read_boxes(drive.dataset.paths.frame_boxes(clouds.name, int(clouds.frames[row])), COLUMNS)
        return ros.markers(boxes, drive.stamp(start_ns), frame_id=MAP, scale=drive.scale)

    for row, start_ns, end_ns in _ends(clouds):
        yield end_ns, functools.partial(make, row, start_ns)

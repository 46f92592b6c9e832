"""Messages of ROS 2, made of arrays by the definitions that rosbags carries (ROS 2 Humble and later).

Times are integer nanoseconds since 1970 (UTC), which header stamps hold as seconds and nanoseconds.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.classes import Class
from geoscene.errors import need
from geoscene.typing import Float
from lidar.dataset.formats.table import Table
from lidar.sensors.rig.patterns.repeating import Scan2d

_FIELDS = {
    "x": ("x", np.float32),
    "y": ("y", np.float32),
    "z": ("z", np.float32),
    "intensity": ("intensity", np.float32),
    "t": ("time_ns", np.uint32),
    "ring": ("ring", np.uint16),
    "label": ("label", np.uint16),
    "instance": ("instance", np.int32),
    "velocity": ("velocity", np.float32),
}
"""Fields of a cloud: the column of a point table and its type; velocity of FMCW scanners only."""

_DATATYPES = {np.uint16: 4, np.int32: 5, np.uint32: 6, np.float32: 7}
"""Constants of sensor_msgs/PointField."""

_DISTORTIONS = {"pinhole": "plumb_bob", "fisheye": "equidistant"}
"""Names of our camera models in sensor_msgs/distortion_models."""

_STATUS = {0: -1, 1: 0, 2: 1, 4: 2, 5: 2}
"""NavSatStatus by NMEA's fix quality: none, single, corrected by satellites, by stations."""

_SERVICES = {"G": 1, "R": 2, "C": 4, "E": 8}
"""Services of sensor_msgs/NavSatStatus by the letter of a satellite system."""

_CUBE, _ADD, _DELETE_ALL = 1, 0, 3
"""Constants of visualization_msgs/Marker."""

_COLORS = {
    **dict.fromkeys((Class.CAR, Class.VAN), (0.12, 0.47, 0.71)),
    **dict.fromkeys((Class.TRUCK, Class.BUS), (0.58, 0.40, 0.74)),
    **dict.fromkeys((Class.MOTORCYCLE, Class.BICYCLE, Class.CYCLIST, Class.MOTORCYCLIST), (1.0, 0.50, 0.05)),
    Class.PEDESTRIAN: (0.84, 0.15, 0.16),
}
_GREY = (0.5, 0.5, 0.5)


@functools.cache
def typestore() -> Any:
    """The message types; raises MissingExtraError without rosbags."""
    module = need("rosbags.typesys", "ros")
    return module.get_typestore(module.Stores.ROS2_HUMBLE)


def encode(message: Any) -> memoryview:
    """The bytes of a message, CDR in little-endian order."""
    packed: memoryview = typestore().serialize_cdr(message, message.__msgtype__, little_endian=True)
    return packed


def _make(kind: str, *values: object) -> Any:
    return typestore().types[kind](*values)


def _time(stamp_ns: int) -> Any:
    return _make("builtin_interfaces/msg/Time", *divmod(stamp_ns, 10**9))


def _header(stamp_ns: int, frame_id: str) -> Any:
    return _make("std_msgs/msg/Header", _time(stamp_ns), frame_id)


def _vector(values: ArrayLike) -> Any:
    return _make("geometry_msgs/msg/Vector3", *np.asarray(values, float).tolist())


def _point(values: ArrayLike) -> Any:
    return _make("geometry_msgs/msg/Point", *np.asarray(values, float).tolist())


def _quaternion(quat_xyzw: ArrayLike) -> Any:
    return _make("geometry_msgs/msg/Quaternion", *np.asarray(quat_xyzw, float).tolist())


def point_cloud(table: Table, stamp_ns: int, *, frame_id: str) -> Any:
    """A PointCloud2 of a point table in the sensor frame, one row of points in the order of firing.

    Fields, packed without gaps: x, y, z (float32, metres), intensity (float32, 0 to 255), t (uint32,
    nanoseconds after the stamp), ring, label (uint16), instance (int32), and the velocity (float32, m/s) of
    FMCW scanners.
    """
    kept = {field: row for field, row in _FIELDS.items() if row[0] in table}
    rows = np.empty(len(table["x"]), np.dtype([(field, kind) for field, (_, kind) in kept.items()]))
    for field, (column, _) in kept.items():
        rows[field] = table[column]
    assert rows.dtype.fields is not None  # noqa: S101
    fields = [
        _make("sensor_msgs/msg/PointField", field, rows.dtype.fields[field][1], _DATATYPES[kind], 1)
        for field, (_, kind) in kept.items()
    ]
    step = rows.dtype.itemsize
    return _make(
        "sensor_msgs/msg/PointCloud2",
        _header(stamp_ns, frame_id),
        1,
        len(rows),
        fields,
        False,
        step,
        step * len(rows),
        rows.view(np.uint8),
        True,
    )


def laser_scan(
    table: Table,
    stamp_ns: int,
    *,
    frame_id: str,
    pattern: Scan2d,
    rate_hz: float,
    limits: tuple[float, float],
) -> Any:
    """A LaserScan of a 2D scanner's point table: the nearest return of each beam, +inf without one (REP 117).

    limits : least and largest range, metres
    """
    count = len(pattern.fire(0, rate_hz, start_ns=0))
    ranges, intensities = np.full(count, np.inf, np.float32), np.zeros(count, np.float32)
    order = np.argsort(-table["range"], kind="stable")  # the nearest of a beam is written last
    ranges[table["column"][order]] = table["range"][order]
    intensities[table["column"][order]] = table["intensity"][order]
    step = 2 * np.pi / pattern.steps
    angles = pattern.first, pattern.first + (count - 1) * step, step
    times = 1 / (rate_hz * pattern.steps), 1 / rate_hz
    return _make(
        "sensor_msgs/msg/LaserScan",
        _header(stamp_ns, frame_id),
        *angles,
        *times,
        *limits,
        ranges,
        intensities,
    )


def png_image(data: bytes, stamp_ns: int, *, frame_id: str, encoding: str) -> Any:
    """A CompressedImage of the bytes of a PNG file; ``encoding`` of its pixels: rgb8 or mono8.

    The format is that of image_transport's plugin, whose readers take OpenCV's order of colours.
    """
    name = f"{encoding}; png compressed {'bgr8' if encoding == 'rgb8' else ''}"
    pixels = np.frombuffer(data, np.uint8)
    return _make("sensor_msgs/msg/CompressedImage", _header(stamp_ns, frame_id), name, pixels)


def depth_image(depth: NDArray[np.float32], stamp_ns: int, *, frame_id: str) -> Any:
    """An Image of depths (h, w) in metres, 32FC1 (REP 118), +inf without a surface."""
    height, width = depth.shape
    pixels = np.ascontiguousarray(depth, "<f4").view(np.uint8).ravel()
    header = _header(stamp_ns, frame_id)
    return _make("sensor_msgs/msg/Image", header, height, width, "32FC1", 0, 4 * width, pixels)


def camera_info(sensor: Mapping[str, Any], stamp_ns: int, *, frame_id: str) -> Any:
    """A CameraInfo of a camera's entry of ``calibration.json``; a rectified image has the same K."""
    matrix = np.array(sensor["K"], float)
    return _make(
        "sensor_msgs/msg/CameraInfo",
        _header(stamp_ns, frame_id),
        int(sensor["height"]),
        int(sensor["width"]),
        _DISTORTIONS[sensor["model"]],
        np.array(sensor["distortion"], float),
        matrix.ravel(),
        np.eye(3).ravel(),
        np.hstack([matrix, np.zeros((3, 1))]).ravel(),
        0,
        0,
        _make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False),
    )


def fix(
    lonlath: ArrayLike, stamp_ns: int, *, frame_id: str, quality: int, variance: Float, systems: Iterable[str]
) -> Any:
    """A NavSatFix; NaN and of unknown covariance without a fix.

    lonlath  : (3,) degrees, degrees, metres above the ellipsoid
    quality  : of the fix, as in NMEA
    variance : (3,) m^2 east, north, up
    systems  : letters of the satellite systems that were used: G, R, E, C
    """
    lon, lat, height = np.asarray(lonlath, float).tolist()
    known = quality > 0
    status = _make(
        "sensor_msgs/msg/NavSatStatus",
        _STATUS.get(quality, 0),
        sum(_SERVICES.get(name, 0) for name in set(systems)),
    )
    covariance = np.diag(variance if known else np.zeros(3)).ravel()
    header = _header(stamp_ns, frame_id)
    return _make("sensor_msgs/msg/NavSatFix", header, status, lat, lon, height, covariance, int(known))


def imu(gyro: Float, accel: Float, *, stamp_ns: int, frame_id: str, variances: tuple[float, float]) -> Any:
    """An Imu of angular rates and specific forces (3,) in the unit's axes, without an orientation.

    variances : of each axis, (rad/s)^2 and (m/s^2)^2; 0 if unknown
    """
    none = np.zeros(9)
    none[0] = -1.0  # no orientation
    rates, forces = (np.eye(3).ravel() * variance for variance in variances)
    header, turn = _header(stamp_ns, frame_id), _quaternion((0, 0, 0, 1))
    return _make("sensor_msgs/msg/Imu", header, turn, none, _vector(gyro), rates, _vector(accel), forces)


def odometry(
    position: Float,
    quat_xyzw: Float,
    *,
    stamp_ns: int,
    frame_id: str,
    child: str,
    velocity: Float,
    rates: Float,
) -> Any:
    """An Odometry of a true pose and the true motion (m/s, rad/s) along the child frame's axes."""
    pose = _make("geometry_msgs/msg/Pose", _point(position), _quaternion(quat_xyzw))
    twist = _make("geometry_msgs/msg/Twist", _vector(velocity), _vector(rates))
    return _make(
        "nav_msgs/msg/Odometry",
        _header(stamp_ns, frame_id),
        child,
        _make("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36)),
        _make("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36)),
    )


def transforms(rows: Iterable[tuple[str, str, ArrayLike, ArrayLike]], stamp_ns: int) -> Any:
    """A TFMessage of rows: parent, child, translation (3,) in metres, rotation (4,) from child to parent."""
    return _make(
        "tf2_msgs/msg/TFMessage",
        [
            _make(
                "geometry_msgs/msg/TransformStamped",
                _header(stamp_ns, parent),
                child,
                _make("geometry_msgs/msg/Transform", _vector(translation), _quaternion(quat_xyzw)),
            )
            for parent, child, translation, quat_xyzw in rows
        ],
    )


def markers(boxes: Iterable[Mapping[str, Any]], stamp_ns: int, *, frame_id: str, scale: Float) -> Any:
    """A MarkerArray that deletes all earlier markers and adds a cube for each 3D box.

    boxes : rows of a file of boxes; a marker's namespace is the road user's class, its id its number, and its
            text the body and the number in points
    scale : (3,) scene metres per true metre
    """
    cubes = (
        _marker(
            _header(stamp_ns, frame_id),
            action=_ADD,
            name=box["class"],
            number=box["id"],
            pose=(np.array([box[k] for k in "xyz"]) / scale, [box[k] for k in ("qx", "qy", "qz", "qw")]),
            size=[box[k] for k in ("length", "width", "height")],
            color=_COLORS.get(Class[box["class"].upper()], _GREY),
            text=f"{box['kind']} {box['instance']}",
        )
        for box in boxes
    )
    found = [_marker(_header(stamp_ns, frame_id), action=_DELETE_ALL), *cubes]
    return _make("visualization_msgs/msg/MarkerArray", found)


def _marker(
    header: Any,
    *,
    action: int,
    name: str = "",
    number: int = 0,
    pose: tuple[ArrayLike, ArrayLike] = ((0, 0, 0), (0, 0, 0, 1)),
    size: ArrayLike = (0, 0, 0),
    color: tuple[float, float, float] = _GREY,
    text: str = "",
) -> Any:
    return _make(
        "visualization_msgs/msg/Marker",
        header,
        name,
        number,
        _CUBE,
        action,
        _make("geometry_msgs/msg/Pose", _point(pose[0]), _quaternion(pose[1])),
        _vector(size),
        _make("std_msgs/msg/ColorRGBA", *color, 0.4),
        _make("builtin_interfaces/msg/Duration", 0, 0),
        False,
        [],
        [],
        "",
        _make("sensor_msgs/msg/CompressedImage", header, "", np.empty(0, np.uint8)),
        [],
        text,
        "",
        _make("visualization_msgs/msg/MeshFile", "", np.empty(0, np.uint8)),
        False,
    )


def letters(used: NDArray[np.bool_], names: NDArray[np.str_]) -> list[set[str]]:
    """Letters of the satellite systems of which each fix (n,) uses a satellite.

    used  : (n, k)
    names : (k,) of the satellites, such as G01
    """
    initials = np.array([name[:1] for name in names.tolist()], np.str_)
    return [set(initials[row].tolist()) for row in used]

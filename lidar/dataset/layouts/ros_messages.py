"""Messages of ROS 2, made of arrays by the definitions that rosbags carries (ROS 2 Humble and later).

Times are integer nanoseconds since 1970 (UTC), which header stamps hold as seconds and nanoseconds.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.classes import Class
from geoscene.errors import need
from geoscene.typing import Float
from lidar.dataset.formats.table import Table
from lidar.sensors.rig.patterns.repeating import Scan2d

Fields = dict[str, tuple[type[np.generic], Callable[[Table, int], NDArray[Any]]]]
"""Fields of a cloud: type, and values by the point table and the stamp in nanoseconds."""


def _copied(column: str) -> Callable[[Table, int], NDArray[Any]]:
    return lambda table, _: table[column]


_PLACE: Fields = {name: (np.float32, _copied(name)) for name in ("x", "y", "z", "intensity")}
_RING: Fields = {"ring": (np.uint16, _copied("ring"))}
_EXTRA: Fields = {
    "label": (np.uint16, _copied("label")),
    "instance": (np.int32, _copied("instance")),
    "velocity": (np.float32, _copied("velocity")),
}

POINTS: dict[str, Fields] = {
    "velodyne": _PLACE | _RING | {"time": (np.float32, lambda table, _: table["time_ns"] * 1e-9)},
    "ouster": _PLACE
    | {
        "t": (np.uint32, _copied("time_ns")),
        "reflectivity": (np.uint16, lambda table, _: np.rint(table["intensity"])),
        "ring": (np.uint8, _copied("ring")),
        "range": (np.uint32, lambda table, _: np.rint(table["range"] * 1e3)),
    },
    "livox": _PLACE
    | {
        "tag": (np.uint8, lambda table, _: _tag(table)),
        "line": (np.uint8, _copied("ring")),
        "timestamp": (np.float64, lambda table, stamp_ns: stamp_ns + table["time_ns"].astype(np.int64)),
    },
}
"""Fields of clouds by the driver that publishes the same: velodyne (ros-drivers), ouster (ouster-ros), livox
(livox_ros_driver2, PointXYZRTLT). PCL fills a member of a point only where name and type agree."""

CUSTOM = "livox-custom"
"""Layout of livox_ros_driver2's own message, which is no PointCloud2."""

_DATATYPES = {np.uint8: 2, np.uint16: 4, np.int32: 5, np.uint32: 6, np.float32: 7, np.float64: 8}
"""Constants of sensor_msgs/PointField."""

_CUSTOM_POINT = "livox_ros_driver2/msg/CustomPoint"
CUSTOM_MESSAGE = "livox_ros_driver2/msg/CustomMsg"
_CUSTOM = {
    _CUSTOM_POINT: "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\n"
    "uint8 reflectivity\nuint8 tag\nuint8 line",
    CUSTOM_MESSAGE: "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\n"
    "uint8[3] rsvd\nlivox_ros_driver2/CustomPoint[] points",
}
"""Definitions of livox_ros_driver2."""

_CUSTOM_RECORD = np.dtype(
    [
        ("offset_time", "<u4"),
        ("xyz", "<f4", 3),
        *((name, "u1") for name in ("reflectivity", "tag", "line", "_")),
    ]
)
"""A point of its message in CDR: each begins at a multiple of four bytes."""

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
    store = module.get_typestore(module.Stores.ROS2_HUMBLE)
    for name, text in _CUSTOM.items():
        store.register(module.get_types_from_msg(text, name))
    return store


def encode(message: Any) -> memoryview | bytes:
    """The bytes of a message, CDR in little-endian order; of a message in bytes these."""
    if isinstance(message, bytes):
        return message
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


def point_cloud(table: Table, stamp_ns: int, *, frame_id: str, points: str) -> Any:
    """A PointCloud2 of a point table in the sensor frame, one row of points in the order of firing.

    points : layout, a name in `POINTS`

    The fields of the layout are packed without gaps: x, y, z (metres) and intensity (0 to 255), the time
    since the stamp (``time``, seconds; ``t``, nanoseconds) or since 1970 (``timestamp``, nanoseconds), ring
    or ``line``, reflectivity (0 to 255), range (mm). Label, instance, and the velocity (m/s) of FMCW scanners
    follow.

    Raises ValueError for more rings than the layout can number.
    """
    kept = POINTS[points] | {name: row for name, row in _EXTRA.items() if name in table}
    rows = np.empty(len(table["x"]), np.dtype([(name, kind) for name, (kind, _) in kept.items()]))
    _check_rings(table, byte=points != "velodyne")
    for name, (_, values) in kept.items():
        rows[name] = values(table, stamp_ns)
    assert rows.dtype.fields is not None  # noqa: S101
    fields = [
        _make("sensor_msgs/msg/PointField", name, rows.dtype.fields[name][1], _DATATYPES[kind], 1)
        for name, (kind, _) in kept.items()
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


def custom_cloud(table: Table, stamp_ns: int, *, frame_id: str) -> bytes:
    """The bytes of livox_ros_driver2's CustomMsg of a point table: times in nanoseconds since the stamp.

    rosbags packs points one by one, which takes seconds a cloud.

    Raises ValueError for more than 256 lines.
    """
    _check_rings(table, byte=True)
    rows = np.zeros(len(table["x"]), _CUSTOM_RECORD)
    rows["offset_time"], rows["line"], rows["tag"] = table["time_ns"], table["ring"], _tag(table)
    rows["reflectivity"] = np.rint(table["intensity"])
    rows["xyz"] = np.column_stack([table[axis] for axis in "xyz"])
    header, reserved, points = _header(stamp_ns, frame_id), np.zeros(3, np.uint8), list[Any]()
    head = _make(CUSTOM_MESSAGE, header, stamp_ns, len(rows), 0, reserved, points)
    packed = bytes(encode(head))  # ends with the number of points
    return packed[:-4] + len(rows).to_bytes(4, "little") + rows.tobytes()[: -1 if len(rows) else None]


def _tag(table: Table) -> NDArray[np.uint8]:
    """Livox' tags (n,): the number of the return in bits 4 and 5, no confidence that is low."""
    echo = table.get("echo", np.ones(len(table["x"]), np.uint8))
    return (np.clip(echo.astype(np.int64) - 1, 0, 3) << 4).astype(np.uint8)


def _check_rings(table: Table, *, byte: bool) -> None:
    if byte and table["ring"].max(initial=0) > 255:
        raise ValueError(
            f"ring {table['ring'].max()}, and this layout has rings to 255; give points=velodyne"
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


def imu(
    gyro: Float,
    accel: Float,
    *,
    stamp_ns: int,
    frame_id: str,
    variances: tuple[float, float],
    quat_xyzw: Float | None = None,
) -> Any:
    """An Imu of angular rates and specific forces (3,) in the unit's axes.

    variances : of each axis, (rad/s)^2 and (m/s^2)^2; 0 if unknown
    quat_xyzw : attitude of the unit in a frame with x east, y north, z up; without it the covariance of the
                orientation begins with -1 (REP 145)
    """
    covariance = np.zeros(9)
    covariance[0] = -1.0 if quat_xyzw is None else 0.0
    rates, forces = (np.eye(3).ravel() * variance for variance in variances)
    header, turn = _header(stamp_ns, frame_id), _quaternion((0, 0, 0, 1) if quat_xyzw is None else quat_xyzw)
    return _make(
        "sensor_msgs/msg/Imu", header, turn, covariance, _vector(gyro), rates, _vector(accel), forces
    )


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

"""Exported ROS 2 recordings say what was recorded, read by rosbags and by the MCAP project's own reader."""

import json
import shutil
import sys
from datetime import UTC, datetime
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.scenes import same_files
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation, Slerp

from geoscene.classes import Class
from geoscene.errors import MissingExtraError
from geoscene.support.files import write_json
from lidar.dataset.formats import FORMATS, read_table
from lidar.dataset.ground_truth import COLUMNS, read_boxes
from lidar.dataset.layout import open_dataset, read_rows
from lidar.dataset.layouts import EXPORTERS, ros_topics
from lidar.dataset.layouts.ros_messages import laser_scan, point_cloud, typestore
from lidar.dataset.layouts.ros_topics import RosDrive, RosOptions, ros_name, topics_of
from lidar.dataset.navigation_files import FixHeights, read_fixes
from lidar.dataset.png import counts_to_depth, image_to_feature, read_png
from lidar.errors import DatasetError, FormatError, InputError
from lidar.options.drive import DriveOptions
from lidar.sensors.navigation.measurements import fix_variances
from lidar.sensors.rig.camera_model import project
from lidar.sensors.rig.patterns.repeating import Scan2d
from lidar.sensors.rig.specs import load_rig
from lidar.simulation.drive import drive
from lidar.tools.convert import convert
from lidar.traffic.options import TrafficOptions

RIG = """
name = "robot"
vehicle = "car"

[[lidar]]
name = "lidar-top"
preset = "vlp16"
translation = [1.2, 0.1, 1.9]
rpy_deg = [1.0, 2.0, 3.0]

[[lidar]]
name = "front"
preset = "utm30lx"
translation = [3.6, 0.0, 0.5]

[[camera]]
name = "ahead"
translation = [1.2, 0.1, 1.9]
rpy_deg = [0.0, 5.0, 2.0]
width = 320
height = 240
fov_deg = 90.0
distortion = [-0.2, 0.03, 0.001, -0.002, 0.0]
rate_hz = 10.0
exposure_ns = 4000000
row_ns = 10000
images = ["rgb", "depth", "semantic", "instance"]

[[camera]]
name = "left"
model = "fisheye"
translation = [1.2, 0.6, 1.7]
rpy_deg = [0.0, 0.0, 90.0]
width = 160
height = 120
fov_deg = 150.0
distortion = [0.01, -0.002, 0.0, 0.0]
rate_hz = 5.0
images = ["rgb"]

[[gnss]]
name = "gnss"
translation = [0.6, 0.0, 1.6]
rate_hz = 10.0
mode = "rtk"

[[imu]]
name = "imu"
translation = [0.1, 0.0, 0.6]
"""
BASE_NS = 1_782_028_800_250_000_000  # date -u -d 2026-06-21T08:00:00.25 +%s%N


@pytest.fixture(scope="module")
def recorded(scene_utm, tmp_path_factory):
    """A drive of half a second in UTM, where scene metres are not true metres."""
    folder = tmp_path_factory.mktemp("ros")
    (folder / "rig.toml").write_text(RIG)
    options = DriveOptions(
        route="random",
        rig=str(folder / "rig.toml"),
        duration=0.5,
        seed=4,
        relief="off",
        formats=("pcd",),
        start=datetime(2026, 6, 21, 8, 0, 0, 250_000, tzinfo=UTC),
        traffic=TrafficOptions(vehicles=40, parked=0.8, pedestrians=30, cyclists=5),
    )
    return open_dataset(drive(scene_utm, folder / "drive", options=options).path)


@pytest.fixture(scope="module")
def bags(recorded, tmp_path_factory):
    """The drive by all exporters of ROS 2 messages, by their names."""
    folder = tmp_path_factory.mktemp("bags")
    names = ("ros2", "mcap")
    for name in names:
        EXPORTERS[name].export(recorded, folder / name)
    return {name: folder / name for name in names}


def by_rosbags(folder):
    """(topic, log time, message) as rosbags reads them, with the definitions in the file."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Reader(folder) as reader:
        for connection, log_ns, data in reader.messages():
            yield connection.topic, log_ns, store.deserialize_cdr(data, connection.msgtype)


def by_mcap(folder):
    """The same as the MCAP project's reader reads them, in the order of the file."""
    with (folder / "drive.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
            yield channel.topic, message.log_time, decoded


@pytest.fixture(scope="module", params=["rosbags", "mcap"])
def messages(request, bags):
    """(log time, message) by topic, by either reader."""
    rows = by_rosbags(bags["ros2"]) if request.param == "rosbags" else by_mcap(bags["mcap"])
    found = {}
    for topic, log_ns, message in rows:
        found.setdefault(topic, []).append((log_ns, message))
    return found


def ns(header):
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def matrix(transform):
    p, q = transform.translation, transform.rotation
    out = np.eye(4)
    out[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    out[:3, 3] = p.x, p.y, p.z
    return out


class Tree:
    """The transforms of a recording, composed and interpolated as tf2 does."""

    def __init__(self, messages):
        rows = [m.transforms[0] for _, m in messages["/tf"]]
        assert {(r.header.frame_id, r.child_frame_id) for r in rows} == {("map", "base_link")}
        self.time = np.array([ns(row.header) for row in rows])
        poses = np.array([matrix(row.transform) for row in rows])
        self.place, self.turn = (
            poses[:, :3, 3],
            Slerp(self.time - BASE_NS, Rotation.from_matrix(poses[:, :3, :3])),
        )
        ((_, static),) = messages["/tf_static"]
        self.parent = {t.child_frame_id: (t.header.frame_id, matrix(t.transform)) for t in static.transforms}

    def vehicle(self, time_ns):
        """Matrices (..., 4, 4) at times (...,)."""
        after = time_ns - BASE_NS
        out = np.zeros((*np.shape(after), 4, 4))
        out[..., 3, 3] = 1.0
        for k in range(3):
            out[..., k, 3] = np.interp(after, self.time - BASE_NS, self.place[:, k])
        out[..., :3, :3] = self.turn(after).as_matrix()
        return out

    def mount(self, frame):
        out = np.eye(4)
        while frame != "base_link":
            frame, step = self.parent[frame]
            out = step @ out
        return out


DTYPES = {2: np.uint8, 8: np.float64, 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4"}


def points(cloud):
    kind = {
        "names": [f.name for f in cloud.fields],
        "formats": [DTYPES[f.datatype] for f in cloud.fields],
        "offsets": [f.offset for f in cloud.fields],
        "itemsize": cloud.point_step,
    }
    rows = np.frombuffer(bytes(cloud.data), np.dtype(kind))
    assert cloud.height * cloud.width == len(rows) == cloud.row_step // cloud.point_step
    return rows


def nanoseconds(rows):
    """Times of points since their stamp."""
    return np.rint(rows["time"].astype(float) * 1e9).astype(np.int64)


F4, U1, U2, U4, F8 = 7, 2, 4, 6, 8
PCL = {
    "velodyne": {"x": F4, "y": F4, "z": F4, "intensity": F4, "ring": U2, "time": F4},
    "ouster": {"x": F4, "z": F4, "intensity": F4, "t": U4, "reflectivity": U2, "ring": U1, "range": U4},
    "livox": {"x": F4, "z": F4, "intensity": F4, "tag": U1, "line": U1, "timestamp": F8},
}
"""Members of points of drivers by name and PointField's constant: PCL fills those that agree."""


@pytest.mark.parametrize("layout", PCL)
def test_points_have_the_fields_of_a_driver(recorded, tmp_path, layout):
    convert(recorded.path, tmp_path / "bag", to=f"ros2:points={layout},imu=truth")
    rows = list(by_rosbags(tmp_path / "bag"))
    clouds = [message for topic, _, message in rows if topic == "/lidar_top/points"]
    assert {f.name: f.datatype for f in clouds[0].fields}.items() >= PCL[layout].items()
    table, found = read_table(next(recorded.files("lidar-top", FORMATS["pcd"]))[1]), points(clouds[0])
    time_ns, ring = {
        "velodyne": lambda: (nanoseconds(found), found["ring"]),
        "ouster": lambda: (found["t"], found["ring"]),
        "livox": lambda: (found["timestamp"] - ns(clouds[0].header), found["line"]),
    }[layout]()
    np.testing.assert_allclose(
        time_ns, table["time_ns"], atol=260
    )  # float64 nanoseconds since 1970, here and in the file
    np.testing.assert_array_equal(ring, table["ring"])
    if layout == "ouster":
        np.testing.assert_allclose(found["range"] / 1e3, table["range"], atol=6e-4)
        np.testing.assert_allclose(found["reflectivity"], table["intensity"], atol=0.51)
    imu = [message for topic, _, message in rows if topic == "/imu/data_raw"]
    poses, mount = recorded.trajectory(), np.array(recorded.sensors()["imu"]["vehicle_from_sensor"])
    for message in imu[:: max(len(imu) // 5, 1)]:
        turn = poses.at([ns(message.header) - BASE_NS]).mounted(mount[:3, 3], mount[:3, :3]).rotation[0]
        q = message.orientation
        np.testing.assert_allclose(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), turn, atol=1e-9)
        assert message.orientation_covariance[0] == 0


def test_the_message_of_livox_has_the_points(recorded, tmp_path):
    convert(recorded.path, tmp_path / "bag", to="ros2:points=livox-custom")
    with AnyReader([tmp_path / "bag"]) as reader:
        (connection,) = [c for c in reader.connections if c.topic == "/lidar_top/points"]
        assert connection.msgtype == "livox_ros_driver2/msg/CustomMsg"
        raw = next(data for _, _, data in reader.messages([connection]))
        message = reader.deserialize(raw, connection.msgtype)
    table = read_table(next(recorded.files("lidar-top", FORMATS["pcd"]))[1])
    assert message.point_num == len(message.points) == len(table["x"])
    assert message.timebase == ns(message.header)
    for field, column in (("offset_time", "time_ns"), ("x", "x"), ("z", "z"), ("line", "ring")):
        np.testing.assert_array_equal([getattr(p, field) for p in message.points], table[column])


def test_points_are_those_of_the_scanners_driver_by_default():
    found = {m: RosOptions().layout_of({"model": m}) for m in ("Ouster OS1-128", "Livox Avia", "Hesai OT128")}
    assert list(found.values()) == ["ouster", "livox", "velodyne"]
    assert RosOptions(points="velodyne").layout_of({"model": "Ouster OS1-128"}) == "velodyne"


@pytest.mark.parametrize(
    ("to", "says"),
    [
        ("ros2:points=velodine", "points = 'velodine' is none of"),
        ("ros2:point=velodyne", "parameter 'point' is unknown; is points meant"),
        ("kitti:points=velodyne", "`to` kitti: has no parameters, and not points"),
        ("ros2,kitti", "give one layout"),
    ],
)
def test_unknown_parameters_of_layouts_are_refused(recorded, tmp_path, to, says):
    with pytest.raises(InputError, match=says):
        convert(recorded.path, tmp_path / "out", to=to)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "topic"), [("lidar-top", "lidar_top"), ("front", "front")])
def test_clouds_are_the_recorded_ones_bit_for_bit(recorded, messages, name, topic):
    clouds, times = messages[f"/{topic}/points"], recorded.sample_times(name)
    files = list(recorded.files(name, FORMATS["pcd"]))
    assert len(clouds) == len(files) == len(times) > 3
    for (_, cloud), (frame, path) in zip(clouds, files, strict=True):
        table, rows = read_table(path), points(cloud)
        assert len(rows) > 100
        assert ns(cloud.header) == BASE_NS + times[frame]
        assert cloud.header.frame_id == topic
        for field in set(rows.dtype.names) - {"time"}:
            np.testing.assert_array_equal(rows[field], table[field], strict=False)
        np.testing.assert_allclose(nanoseconds(rows), table["time_ns"], atol=4)  # float32 of 0.1 s
        assert {"x", "y", "z", "intensity", "time", "ring", "label", "instance"} == set(rows.dtype.names)
        assert all(rows.dtype[k] == np.float32 for k in ("x", "y", "z", "intensity"))


def test_log_times_never_go_back_and_no_message_is_logged_before_it_is_complete(bags, messages):
    for rows in (by_rosbags(bags["ros2"]), by_mcap(bags["mcap"])):
        logged = [log_ns for _, log_ns, _ in rows]
        assert logged == sorted(logged)
    for log_ns, cloud in messages["/lidar_top/points"]:
        assert int(nanoseconds(points(cloud)).max()) > 90_000_000, "the scanner turns for a tenth of a second"
        assert ns(cloud.header) + int(nanoseconds(points(cloud)).max()) <= log_ns
    for log_ns, image in messages["/ahead/image_raw/compressed"]:
        assert log_ns - ns(image.header) == 2_000_000 + 120 * 10_000, "half the exposure and half the rows"


def test_poses_through_the_tree_of_frames_are_the_true_ones(recorded, messages):
    tree, trajectory = Tree(messages), recorded.trajectory()
    scale = trajectory.scale[0]
    assert abs(scale - 1) > 1e-4, "UTM shrinks"
    for name, sensor in recorded.sensors().items():
        frame = ros_name(name) + ("_optical" if sensor["kind"] == "camera" else "")
        mount = np.array(sensor["vehicle_from_sensor"])
        for time_ns in (0, 123_456_789, 400_000_000):
            pose = trajectory.at([time_ns]).mounted(mount[:3, 3], mount[:3, :3])
            found = tree.vehicle(BASE_NS + time_ns) @ tree.mount(frame)
            place = pose.position[0] / [scale, scale, 1.0]
            np.testing.assert_allclose(found[:3, 3], place, rtol=0, atol=1e-6)
            np.testing.assert_allclose(found[:3, :3], pose.rotation[0], rtol=0, atol=1e-8)
    body = tree.parent["ahead"][1][:3, 0]
    assert body[0] > 0.9, "the body of a camera that looks ahead has its x axis ahead"
    assert tree.parent["ahead_optical"][0] == "ahead"


def test_odometry_is_the_true_motion_in_the_vehicles_axes(recorded, messages):
    trajectory = recorded.trajectory()
    rows = messages["/ground_truth/odometry"]
    assert len(rows) == len(trajectory.time_ns)
    for k, (log_ns, row) in enumerate(rows):
        assert (row.header.frame_id, row.child_frame_id) == ("map", "base_link")
        assert ns(row.header) == log_ns == BASE_NS + trajectory.time_ns[k]
        turn = Rotation.from_quat(trajectory.quat_xyzw[k])
        linear, angular = row.twist.twist.linear, row.twist.twist.angular
        velocity = turn.apply([linear.x, linear.y, linear.z])
        np.testing.assert_allclose(velocity, trajectory.velocity[k], atol=1e-9)
        assert linear.x > 1, "it drives ahead"
        if k:
            step = Rotation.from_quat(trajectory.quat_xyzw[k - 1]).inv() * turn
            np.testing.assert_allclose([angular.x, angular.y, angular.z], step.as_rotvec() / 0.01, atol=5e-3)


def test_images_are_the_recorded_files_and_depth_is_in_metres(recorded, messages):
    paths = recorded.paths
    for topic, name, kind, form in (
        ("/ahead/image_raw/compressed", "ahead", "rgb", "rgb8; png compressed bgr8"),
        ("/ahead/semantic/compressed", "ahead", "semantic", "mono8; png compressed "),
        ("/ahead/instance/compressed", "ahead", "instance", "rgb8; png compressed bgr8"),
        ("/left/image_raw/compressed", "left", "rgb", "rgb8; png compressed bgr8"),
    ):
        assert len(messages[topic]) == len(recorded.sample_times(name))
        for frame, (_, image) in enumerate(messages[topic]):
            assert bytes(image.data) == paths.image(name, frame, kind=kind).read_bytes()
            assert (image.format, image.header.frame_id) == (form, f"{name}_optical")
    for frame, (_, image) in enumerate(messages["/ahead/depth"]):
        assert (image.encoding, image.step, image.is_bigendian) == ("32FC1", 4 * 320, 0)
        depth = np.frombuffer(bytes(image.data), "<f4").reshape(image.height, image.width)
        counts = read_png(paths.image("ahead", frame, kind="depth"))
        np.testing.assert_array_equal(depth, counts_to_depth(counts))
        assert np.isfinite(depth).any()


def brown(info, p):
    """Pixels of points (n, 3), by the formula of plumb_bob."""
    k1, k2, p1, p2, k3 = info.d
    x, y = p[:, 0] / p[:, 2], p[:, 1] / p[:, 2]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return (np.column_stack([xd, yd, np.ones(len(p))]) @ np.reshape(info.k, (3, 3)).T)[:, :2]


def equidistant(info, p):
    """Pixels of points (n, 3), by the formula of equidistant."""
    flat = np.hypot(p[:, 0], p[:, 1])
    theta = np.arctan2(flat, p[:, 2])
    radius = theta * (1 + sum(k * theta ** (2 * i + 2) for i, k in enumerate(info.d)))
    rays = np.column_stack([p[:, 0] / flat * radius, p[:, 1] / flat * radius, np.ones(len(p))])
    return (rays @ np.reshape(info.k, (3, 3)).T)[:, :2]


@pytest.mark.parametrize(
    ("name", "model", "formula"), [("ahead", "plumb_bob", brown), ("left", "equidistant", equidistant)]
)
def test_camera_info_projects_as_the_camera_was_simulated(recorded, messages, name, model, formula):
    rig = load_rig(str(recorded.manifest["recipe"]["rig"]).rpartition(" (")[0])
    spec = next(camera for camera in rig.cameras if camera.name == name)
    (_, info), *_ = messages[f"/{name}/camera_info"]
    assert (info.distortion_model, info.width, info.height) == (model, spec.width, spec.height)
    ahead = np.random.default_rng(1).uniform([-3, -2, 4], [3, 2, 20], (100, 3))
    np.testing.assert_allclose(formula(info, ahead), project(spec, ahead)[0], atol=1e-9)
    np.testing.assert_array_equal(np.reshape(info.p, (3, 4))[:, :3], np.reshape(info.k, (3, 3)))
    np.testing.assert_array_equal(np.reshape(info.r, (3, 3)), np.eye(3))
    stamps = [ns(m.header) for _, m in messages[f"/{name}/camera_info"]]
    assert stamps == [ns(m.header) for _, m in messages[f"/{name}/image_raw/compressed"]]


def test_laser_returns_fall_on_the_pixels_of_what_they_hit(recorded, messages):
    """Through frames, times and CameraInfo of the recording alone: the same surface at the same depth."""
    tree, info = Tree(messages), messages["/ahead/camera_info"][0][1]
    moving = [int(k) for k in Class if Class.CAR <= k <= Class.MOTORCYCLIST]
    shift = {offset: [] for offset in (0, 24)}
    errors = []
    clouds, images = messages["/lidar_top/points"], messages["/ahead/instance/compressed"]
    for frame, ((_, cloud), (_, image)) in enumerate(zip(clouds, images, strict=True)):
        instance = image_to_feature(read_png(recorded.paths.image("ahead", frame, kind="instance")))
        depth = counts_to_depth(read_png(recorded.paths.image("ahead", frame, kind="depth")))
        rows = points(cloud)
        rows = rows[(np.abs(rows["y"]) < 0.5 * rows["x"]) & ~np.isin(rows["label"], moving)]
        eye = np.linalg.inv(tree.vehicle(ns(image.header)) @ tree.mount(image.header.frame_id))
        turns = eye @ tree.vehicle(ns(cloud.header) + nanoseconds(rows))
        xyz1 = np.column_stack([rows[k] for k in "xyz"] + [np.ones(len(rows))]) @ tree.mount("lidar_top").T
        seen = np.einsum("nij,nj->ni", turns, xyz1)[:, :3]
        u, v = np.rint(brown(info, seen)).astype(int).T
        inside = (u > 0) & (u < 293) & (v > 0) & (v < 239)
        u, v, rows, seen = u[inside], v[inside], rows[inside], seen[inside]
        for offset in shift:
            around = [instance[v + i, u + j + offset] for i in (-1, 0, 1) for j in (-1, 0, 1)]
            shift[offset] += (np.array(around) == rows["instance"]).any(axis=0).tolist()
        errors += (np.abs(depth[v, u] - seen[:, 2]) / seen[:, 2]).tolist()
    assert len(errors) > 1000
    assert np.mean(shift[0]) > 0.98, "within a pixel, but for what moves or is hidden meanwhile"
    assert np.mean(shift[24]) < 0.75, "elsewhere there are other surfaces"
    assert np.median(errors) < 0.01


def test_a_scan_has_the_nearest_return_of_each_beam(messages):
    scans, clouds = messages["/front/scan"], messages["/front/points"]
    assert "/lidar_top/scan" not in messages
    for (_, scan), (_, cloud) in zip(scans, clouds, strict=True):
        rows, ranges = points(cloud), np.asarray(scan.ranges)
        assert ns(scan.header) == ns(cloud.header)
        assert len(ranges) == 1081  # 270 degrees in steps of a quarter
        assert scan.angle_max - scan.angle_min == pytest.approx(1.5 * np.pi, abs=1e-6)
        hit = np.isfinite(ranges)
        assert 0 < hit.sum() <= len(rows)
        angle = scan.angle_min + np.flatnonzero(hit) * scan.angle_increment
        xy = ranges[hit, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        gaps = np.linalg.norm(xy[:, None] - np.column_stack([rows["x"], rows["y"]])[None], axis=2)
        assert gaps.min(axis=1).max() < 1e-4
        fired = np.arange(len(ranges))[hit] * scan.time_increment
        np.testing.assert_allclose(nanoseconds(rows)[gaps.argmin(axis=1)] * 1e-9, fired, atol=2e-6)


def test_of_two_returns_of_a_beam_the_nearer_one_is_in_the_scan():
    table = {
        "column": np.array([1, 1, 3]),
        "range": np.array([9.0, 4.0, 7.0], np.float32),
        "intensity": np.array([1.0, 2.0, 3.0], np.float32),
    }
    pattern = Scan2d(steps=360, first=-0.05, last=0.05)
    scan = laser_scan(table, 0, frame_id="a", pattern=pattern, rate_hz=10.0, limits=(0.1, 30.0))
    np.testing.assert_array_equal(scan.ranges, [np.inf, 4, np.inf, 7, np.inf, np.inf])
    np.testing.assert_array_equal(scan.intensities, [0, 2, 0, 3, 0, 0])


def test_fixes_and_inertial_samples_are_the_measured_ones(recorded, messages):
    rows = read_rows(recorded.paths.measurements("gnss"))
    assert len(messages["/gnss/fix"]) == len(rows)
    for (_, fix), row in zip(messages["/gnss/fix"], rows, strict=True):
        assert ns(fix.header) == BASE_NS + int(row["time_ns"])
        found = [fix.longitude, fix.latitude, fix.altitude]
        np.testing.assert_allclose(found, [float(row[k]) for k in ("lon", "lat", "h")], rtol=1e-14)
        assert fix.status.status == {0: -1, 1: 0, 2: 1, 4: 2, 5: 2}[int(row["quality"])]
        assert fix.status.service == 15, "GPS, GLONASS, BeiDou and Galileo"
        covariance = np.reshape(fix.position_covariance, (3, 3))
        assert fix.position_covariance_type == 1
        np.testing.assert_array_equal(covariance, np.diag(np.diag(covariance)))
        assert (np.diag(covariance) >= 0.008**2).all()
    rows = read_rows(recorded.paths.measurements("imu"))
    for (_, sample), row in zip(messages["/imu/data_raw"], rows, strict=True):
        assert ns(sample.header) == BASE_NS + int(row["time_ns"])
        turn, force = sample.angular_velocity, sample.linear_acceleration
        assert [turn.x, turn.y, turn.z] == [float(row[f"gyro_{k}"]) for k in "xyz"]
        assert [force.x, force.y, force.z] == [float(row[f"accel_{k}"]) for k in "xyz"]
        assert sample.orientation_covariance[0] == -1, "it has no orientation"
        assert sample.linear_acceleration_covariance[0] == pytest.approx(2.0e-3**2 * 100)


def test_a_missing_fix_has_no_position_and_no_covariance(recorded):
    fixes, _ = read_fixes(recorded.paths, "gnss", vertical="flat")
    fixes.state[:], fixes.dop[:] = 0, np.nan
    assert not fix_variances(fixes).any()


def test_altitudes_are_above_the_ellipsoid(recorded, monkeypatch, caplog):
    """Heights above the geoid are raised by its height; without it there is no altitude."""
    fixes, _ = read_fixes(recorded.paths, "gnss", vertical="flat")
    separation = np.linspace(17, 18, len(fixes))
    for known, altitude in ((separation, fixes.lonlath[:, 2] + separation), (None, np.nan)):
        heights = FixHeights("orthometric", known)
        monkeypatch.setattr(ros_topics, "read_fixes", lambda *_, h=heights, **__: (fixes, h))
        (topic,) = (t for t in topics_of(RosDrive(recorded)) if t.name == "/gnss/fix")
        np.testing.assert_allclose([topic.make(k).altitude for k in range(len(fixes))], altitude)
    assert "no altitudes" in caplog.text


def test_damaged_files_are_named_and_nothing_is_left(recorded, tmp_path):
    copy = tmp_path / "drive"
    shutil.copytree(recorded.path, copy)
    for name, data in (
        ("lidar-top/pcd/000002.pcd", b"VERSION 0.7"),
        ("lidar-top/boxes/000001.csv", b"frame,id\n1,2\n"),
        ("ahead/depth/000003.png", b"no image"),
        ("ahead/rgb/000099.png", b"without a time"),
        ("imu.csv", b"time_ns,gyro_x\n0,1\n"),
    ):
        path = copy / name
        good = path.read_bytes() if path.exists() else None
        path.write_bytes(data)
        with pytest.raises((DatasetError, FormatError), match=r"damaged|no time of frame 99"):
            EXPORTERS["ros2"].export(open_dataset(copy), tmp_path / "out")
        path.unlink()
        if good is not None:
            path.write_bytes(good)
        assert [entry.name for entry in tmp_path.iterdir()] == ["drive"]


def test_boxes_are_cubes_where_the_road_users_are(recorded, messages):
    scale, shown = recorded.trajectory().scale[0], 0
    for frame, (_, array) in enumerate(messages["/lidar_top/boxes"]):
        first, *cubes = array.markers
        assert first.action == 3, "earlier markers vanish"
        boxes = read_boxes(recorded.paths.frame_boxes("lidar-top", frame), COLUMNS)
        assert len(cubes) == len(boxes)
        for cube, box in zip(cubes, boxes, strict=True):
            assert (cube.ns, cube.id, cube.type, cube.header.frame_id) == (box["class"], box["id"], 1, "map")
            place = [cube.pose.position.x, cube.pose.position.y, cube.pose.position.z]
            np.testing.assert_allclose(place, np.array([box[k] for k in "xyz"]) / [scale, scale, 1])
            assert [cube.scale.x, cube.scale.y, cube.scale.z] == [
                box[k] for k in ("length", "width", "height")
            ]
        shown += len(cubes)
    assert shown > 10
    assert "/front/boxes" not in messages, "40 times a second, and the same road users"


def test_the_recording_and_the_lone_file_hold_the_same_messages(bags):
    assert (bags["ros2"] / "drive.mcap").read_bytes() == (bags["mcap"] / "drive.mcap").read_bytes()
    with Reader(bags["ros2"]) as reader:
        (latched,) = (c for c in reader.connections if c.topic == "/tf_static")
        assert latched.ext.offered_qos_profiles[0].durability is QosDurability.TRANSIENT_LOCAL
    metadata = YAML(typ="safe").load((bags["ros2"] / "metadata.yaml").read_text())
    about = metadata["rosbag2_bagfile_information"]["custom_data"]
    assert "OpenStreetMap" in about["attribution"]
    assert float(about["map_scale"]) == pytest.approx(0.9996, abs=1e-3)


def test_the_removed_layout_names_its_successor(recorded, tmp_path):
    with pytest.raises(InputError, match=r"`to` ros2-sqlite3: no longer written; use ros2"):
        convert(recorded.path, tmp_path / "out", to="ros2-sqlite3")


def test_the_layout_names_topics_of_the_recording(bags):
    layout = json.loads((bags["mcap"] / "foxglove.json").read_text())
    topics = {topic for topic, _, _ in by_mcap(bags["mcap"])}
    panels = layout["configById"]
    shown = set(panels["3D!scene"]["topics"])
    images = [panel["imageMode"] for name, panel in panels.items() if name.startswith("Image!")]
    shown |= {mode[key] for mode in images for key in ("imageTopic", "calibrationTopic")}
    assert len(images) == 2
    assert shown <= topics
    assert set(panels) == {word for word in json.dumps(layout["layout"]).split('"') if "!" in word}


@pytest.mark.full
def test_the_same_drive_gives_the_same_bytes(recorded, bags, tmp_path):
    for name in ("ros2", "mcap"):
        EXPORTERS[name].export(recorded, tmp_path / name)
        same_files(tmp_path / name, bags[name])


def test_fmcw_clouds_have_velocities():
    table = {k: np.zeros(2, np.float32) for k in ("x", "y", "z", "intensity", "velocity")}
    table |= {k: np.zeros(2, np.int64) for k in ("time_ns", "ring", "label", "instance")}
    table["velocity"] = np.array([1.5, -2.5], np.float32)
    cloud = point_cloud(table, 0, frame_id="a", points="velodyne")
    np.testing.assert_array_equal(points(cloud)["velocity"], [1.5, -2.5])


def test_names_become_tokens_of_topics_and_clashes_are_refused(recorded, tmp_path):
    assert [ros_name(k) for k in ("LIDAR-TOP", "a__b-_c", "3d")] == ["LIDAR_TOP", "a_b_c", "sensor_3d"]
    clash = SimpleNamespace(path=tmp_path, paths=recorded.paths)
    sensors = recorded.sensors()
    for names in (("map",), ("a-b", "a_b"), ("ahead", "ahead_optical")):
        clash.sensors = lambda names=names: dict.fromkeys(names, sensors["ahead"])
        with pytest.raises(DatasetError, match="need distinct names"):
            _ = RosDrive(clash).names


def test_without_the_rigs_files_scans_are_left_out_with_a_warning(recorded, tmp_path, caplog):
    manifest = recorded.manifest | {"recipe": recorded.manifest["recipe"] | {"rig": "gone.toml (123)"}}
    for path in recorded.path.iterdir():
        (tmp_path / "drive").mkdir(exist_ok=True)
        if path.name != "dataset.json":
            (tmp_path / "drive" / path.name).symlink_to(path)
    write_json(tmp_path / "drive" / "dataset.json", manifest)
    EXPORTERS["mcap"].export(open_dataset(tmp_path / "drive"), tmp_path / "out")
    found = {topic: message for topic, _, message in by_mcap(tmp_path / "out")}
    assert "/front/scan" not in found
    assert "/front/points" in found
    assert not any(found["/imu/data_raw"].angular_velocity_covariance)
    assert "no laser scans" in caplog.text


def test_without_rosbags_the_extra_is_named(recorded, tmp_path, monkeypatch):
    typestore.cache_clear()
    for name in [name for name in sys.modules if name.partition(".")[0] == "rosbags"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(MissingExtraError, match=r"geoscene\[ros\]"):
        EXPORTERS["ros2"].export(recorded, tmp_path / "out")
    assert not list(tmp_path.iterdir())
    typestore.cache_clear()

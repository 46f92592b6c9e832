"""Outputs of a drive besides points: boxes, labels, velocities, de-skewed clouds, images, exports."""

import csv
import json
import re
import resource
import shutil
import zlib
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import laspy
import numpy as np
import pytest
from helpers.programs import SMALL_FILES, run_process, run_program
from helpers.sensor_worlds import driven, plate, world
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from geoscene.classes import Class, class_codes
from geoscene.scene import open_scene
from lidar.dataset.formats import read_table
from lidar.dataset.formats.kitti import semantic_kitti_labels
from lidar.dataset.formats.table import MOMENTS, PointLabels, deskew, placed_returns
from lidar.dataset.layout import open_dataset
from lidar.dataset.layouts import EXPORTERS
from lidar.dataset.layouts.nuscenes import CATEGORIES, VERSION
from lidar.errors import DatasetError, InputError
from lidar.geometry.attitude import Mount
from lidar.geometry.georeference import Georeference
from lidar.motion.vehicle import load_vehicle
from lidar.options.drive import DriveOptions
from lidar.sensors.laser.scan import scan
from lidar.sensors.rig.scanner import load_sensor
from lidar.settings import RecordingSettings
from lidar.simulation.drive import drive
from lidar.tools.maps.aggregate import aggregate
from lidar.traffic.options import TrafficOptions
from lidar.traffic.signal_heads import STATES, signal_states

ROADS = [k for k in Class if Class.CAR <= k <= Class.MOTORCYCLIST]

SENSOR = """
kind = "flash"
maker = "nobody"
model = "small FMCW scanner"
wavelength_nm = 1550.0
rates_hz = [20.0]
min_range = 0.5
max_range = 200.0
range_sigma = 0.02
reference_range = 200.0
reference_reflectance = 0.1
divergence_mrad = 1.0
pulse_ns = 5.0
fmcw = true

[flash]
columns = 160
rows = 24
fov_deg = [120.0, 24.0]
lens = "angular"
row_us = 2000.0

[source]
"""

RIG = """
name = "mine"

[[lidar]]
name = "top"
preset = "vlp16"
translation = [1.2, 0.0, 1.9]
rpy_deg = [0.0, 2.0, 5.0]

[[lidar]]
name = "ahead"
preset = "small.toml"
translation = [3.5, 0.3, 0.7]

[[camera]]
name = "front"
translation = [1.5, 0.2, 1.7]
width = 320
height = 180
fov_deg = 80.0
rate_hz = 10.0
images = ["rgb", "depth", "semantic", "instance", "flow"]

[[camera]]
name = "side"
translation = [1.0, 0.8, 1.6]
rpy_deg = [0.0, 0.0, 80.0]
model = "fisheye"
width = 200
height = 200
fov_deg = 170.0
rate_hz = 5.0
row_ns = 50000
exposure_ns = 2000000
images = ["rgb", "depth", "instance"]
"""

OPTIONS = DriveOptions(
    duration=2.0,
    seed=12,
    formats=("pcd", "ply", "csv", "laz", "kitti", "nuscenes"),
    labels=("semantickitti", "nuscenes"),
    deskew="end",
    traffic=TrafficOptions(vehicles=25.0, parked=0.8, pedestrians=40.0),
)


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rig")
    (folder / "small.toml").write_text(SENSOR)
    (folder / "mine.toml").write_text(RIG)
    return str(folder / "mine.toml")


@pytest.fixture(scope="module")
def recorded(scene, rig, tmp_path_factory):
    out = tmp_path_factory.mktemp("drive") / "a"
    summary = drive(scene, out, options=replace(OPTIONS, rig=rig))
    return open_dataset(out), summary


@pytest.fixture(scope="module")
def dataset(recorded):
    return recorded[0]


def table(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def mounts(dataset):
    calibration = json.loads((dataset.path / "calibration.json").read_text())["sensors"]
    return calibration, {k: np.array(s["vehicle_from_sensor"]) for k, s in calibration.items()}


def instance_image(path):
    red, green, blue = np.moveaxis(np.array(Image.open(path)).astype(int), -1, 0)
    return red + 256 * green + 65536 * blue - 1


def placed(dataset, sensor, frame, cloud):
    """Points of a cloud in the scene, and their times."""
    mount = mounts(dataset)[1][sensor]
    start = int(table(dataset.path / sensor / "timestamps.csv")[frame]["time_ns"])
    time_ns = start + cloud["time_ns"].astype(np.int64)
    xyz = np.column_stack([cloud[k] for k in "xyz"])
    return dataset.trajectory().place(xyz, time_ns, translation=mount[:3, 3], rotation=mount[:3, :3]), time_ns


def test_every_camera_frame_has_boxes_around_its_instances(dataset):
    first = max(stop for _, stop in _layers(dataset).values())
    shown = hidden = 0
    for camera, frames in (("front", 20), ("side", 10)):
        files = sorted((dataset.path / camera / "boxes").glob("*.csv"))
        assert len(files) == frames
        for path in files[::3]:
            image = instance_image(dataset.path / camera / "instance" / f"{path.stem}.png")
            rows = {int(row["instance"]): row for row in table(path)}
            assert set(np.unique(image[image >= first])) <= set(rows)
            for instance, row in rows.items():
                v, u = np.nonzero(image == instance)
                assert int(row["pixels"]) == len(u)
                box = [float(row[k]) for k in ("left", "top", "right", "bottom")]
                assert -0.51 <= box[0] < box[2] <= image.shape[1]
                assert -0.51 <= box[1] < box[3] <= image.shape[0]
                if not len(u):
                    assert (row["seen_left"], float(row["visibility"])) == ("nan", 0.0)
                    hidden += 1
                    continue
                seen = [float(row[f"seen_{k}"]) for k in ("left", "top", "right", "bottom")]
                assert seen == [u.min() - 0.5, v.min() - 0.5, u.max() + 0.5, v.max() + 0.5]
                assert 0 < float(row["visibility"]) <= 1
                if camera == "front":  # a rolling shutter's box is that of its middle row's moment
                    assert box[0] - 1.5 <= seen[0] < seen[2] <= box[2] + 1.5
                    assert box[1] - 1.5 <= seen[1] < seen[3] <= box[3] + 1.5
                shown += 1
    assert shown > 20
    assert hidden > 20


def test_every_camera_frame_tells_what_its_signal_heads_show(dataset, scene):
    side = "left" if scene.left_hand else "right"
    states = signal_states(scene, None, seed=OPTIONS.seed, side=side, vehicle=load_vehicle("car"))
    rows = 0
    for camera, frames in (("front", 20), ("side", 10)):
        files = sorted((dataset.path / camera / "signals").glob("*.csv"))
        assert len(files) == frames
        whole = (dataset.path / camera / "signals.csv").read_text().splitlines()
        assert whole[1:] == [line for path in files for line in path.read_text().splitlines()[1:]]
        for path in files:
            image = instance_image(dataset.path / camera / "instance" / f"{path.stem}.png")
            for row in table(path):
                v, u = np.nonzero(image == int(row["instance"]))
                box = [float(row[k]) for k in ("left", "top", "right", "bottom")]
                assert u.min() - 0.5 <= box[0] < box[2] <= u.max() + 0.5
                assert v.min() - 0.5 <= box[1] < box[3] <= v.max() + 0.5
                assert 0 < int(row["pixels"]) <= len(u)
                head = np.flatnonzero(states.heads.feature == int(row["instance"]))
                shown = states.at(int(row["time_ns"]) * 1e-9)[head]
                assert [row["state"]] == [STATES[k] for k in shown.tolist()]
                assert 0 <= float(row["angle_deg"]) <= 180
                rows += 1
    assert rows > 2


def _layers(dataset):
    scene = json.loads((Path(dataset.manifest["scene"]["path"]) / "scene.json").read_text())
    return scene["layers"]


def test_boxes_in_3d_give_visibility_and_points_of_each_scanner(dataset):
    rows = table(dataset.path / "boxes.csv")
    calibration = mounts(dataset)[0]
    assert calibration["ahead"]["rate_hz"] == 20.0
    rich = [row for row in rows if int(row["points_top"]) + int(row["points_ahead"]) > 20]
    assert len(rich) > 20
    for row in rich[:: max(1, len(rich) // 25)]:
        frame = int(row["frame"])
        for sensor, frames in (("top", [frame]), ("ahead", [2 * frame, 2 * frame + 1])):
            clouds = [read_table(dataset.path / sensor / "pcd" / f"{k:06d}.pcd") for k in frames]
            count = sum(int((c["instance"] == int(row["instance"])).sum()) for c in clouds)
            assert count == int(row[f"points_{sensor}"])
        assert int(row["points"]) == int(row["points_top"])
        assert float(row["visibility"]) > 0 or int(row["points_top"]) < 5
    unseen = [row for row in rows if float(row["visibility"]) == 0]
    assert len(unseen) > 20
    assert np.mean([int(row["points_top"]) <= 2 for row in unseen]) > 0.99
    assert all(0 <= float(row["visibility"]) <= 1 for row in rows)
    assert (dataset.path / "ahead" / "boxes.csv").exists()


def test_a_static_wall_is_straight_after_deskewing_while_the_vehicle_turns():
    sensor, mount = load_sensor("vlp16"), Mount((1.0, 0.5, 1.8), (0.0, 0.0, 0.0998334, 0.9950042))
    trajectory = driven((6.0, 2.0, 0.0), yaw_rate=1.0, start=(0, 0, 0))
    cloud = scan(sensor, mount, trajectory=trajectory, world=world(plate(25.0, tilt=0.3)), frame=7)
    times = cloud.start_ns + cloud.time_ns.astype(np.int64)
    where = trajectory.place(cloud.xyz, times, translation=mount.translation, rotation=mount.rotation)

    def bend(points):
        """Largest distance from the best plane."""
        away = points - points.mean(axis=0)
        return np.abs(away @ np.linalg.svd(away, full_matrices=False)[2][2]).max()

    assert bend(cloud.xyz.astype(float)) > 0.3
    for share in MOMENTS.values():
        moment = sensor.frame_start_ns(7) + int(share * 1e8)
        points = deskew(where, trajectory, mount=mount, time_ns=moment)
        assert bend(points.astype(float)) < 2e-5
        pose = trajectory.at([moment]).mounted(mount.translation, mount.rotation)
        np.testing.assert_allclose(pose.place(points.astype(float)), where, atol=1e-4)


def test_deskewed_files_have_the_sensor_frame_at_the_frames_end(dataset):
    for sensor, period in (("top", 100_000_000), ("ahead", 50_000_000)):
        frame = 15
        raw = read_table(dataset.path / sensor / "pcd" / f"{frame:06d}.pcd")
        moved = read_table(dataset.path / sensor / "deskewed" / f"{frame:06d}.pcd")
        where, _ = placed(dataset, sensor, frame, raw)
        mount = mounts(dataset)[1][sensor]
        pose = dataset.trajectory().at([(frame + 1) * period]).mounted(mount[:3, 3], mount[:3, :3])
        np.testing.assert_allclose(
            pose.place(np.column_stack([moved[k] for k in "xyz"]).astype(float)), where, atol=1e-4
        )
        np.testing.assert_array_equal(raw["time_ns"], moved["time_ns"])
        assert len(read_table(dataset.path / sensor / "deskewed" / f"{frame:06d}.bin")["x"]) == len(where)


def test_radial_velocities_include_ego_motion_and_moving_surfaces(dataset):
    mount = mounts(dataset)[1]["ahead"]
    trajectory = dataset.trajectory()
    boxes = table(dataset.path / "ahead" / "boxes.csv")
    still = moving = 0
    for frame in range(1, 39, 3):
        cloud = read_table(dataset.path / "ahead" / "pcd" / f"{frame:06d}.pcd")
        where, times = placed(dataset, "ahead", frame, cloud)
        ends = [trajectory.at(times + s).mounted(mount[:3, 3], mount[:3, :3]) for s in (-(10**6), 10**6)]
        own = (ends[1].position - ends[0].position) / 2e-3
        eye = trajectory.at(times).mounted(mount[:3, 3], mount[:3, :3]).position
        way = where - eye
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        of_road_users = np.isin(cloud["label"], ROADS)
        expected = -(own * way).sum(axis=1)
        np.testing.assert_allclose(cloud["velocity"][~of_road_users], expected[~of_road_users], atol=0.01)
        still += int((~of_road_users).sum())
        for row in (r for r in boxes if int(r["frame"]) == frame and r["moving"] == "True"):
            on = cloud["instance"] == int(row["instance"])
            velocity = np.array([float(row[k]) for k in ("vx", "vy", "vz")])
            key = str(frame + 1), row["instance"]
            later = next((r for r in boxes if (r["frame"], r["instance"]) == key), row)
            turned = np.angle(np.exp(1j * (float(later["yaw"]) - float(row["yaw"])))) / 0.05
            arm = where[on] - [float(row[k]) for k in "xyz"]
            velocity = velocity + turned * np.column_stack([-arm[:, 1], arm[:, 0], np.zeros(len(arm))])
            wanted = expected[on] + (way[on] * velocity).sum(axis=1)
            np.testing.assert_allclose(cloud["velocity"][on], wanted, atol=0.3)  # the turn changes, too
            moving += int((np.linalg.norm(velocity, axis=1) > 1).sum())
    assert still > 10_000
    assert moving > 20


def test_all_formats_hold_the_same_velocities_and_true_ranges(dataset):
    folder = dataset.path / "ahead"
    pcd, ply = read_table(folder / "pcd" / "000030.pcd"), read_table(folder / "ply" / "000030.ply")
    text, las = read_table(folder / "csv" / "000030.csv"), laspy.read(folder / "laz" / "000030.laz")
    assert np.ptp(pcd["velocity"]) > 0.5
    for name in ("velocity", "true_range"):
        np.testing.assert_array_equal(ply[name], pcd[name])
        np.testing.assert_array_equal(np.asarray(las[name]), pcd[name])
        np.testing.assert_allclose(text[name], pcd[name], atol=1e-4)
    plain = read_table(dataset.path / "top" / "pcd" / "000010.pcd")
    assert "velocity" not in plain
    np.testing.assert_allclose(plain["true_range"], plain["range"], atol=1e-5)


def test_labels_are_those_of_semantic_kitti_nuscenes_and_asprs(dataset):
    folder = dataset.path / "top"
    kitti_yaml = {Class.ROAD: 40, Class.SIDEWALK: 48, Class.BUILDING: 50, Class.TREE_CROWN: 70}
    first = max(stop for _, stop in _layers(dataset).values())
    seen_moving, pulled = 0, 0.0
    trajectory = dataset.trajectory()
    mount = np.array(dataset.sensors()["top"]["vehicle_from_sensor"])
    moving = {int(r["instance"]) for r in table(dataset.path / "boxes.csv") if r["moving"] == "True"}
    for path in sorted((folder / "pcd").glob("*.pcd"))[::4]:
        cloud = read_table(path)
        labels = np.fromfile(folder / "labels" / f"{path.stem}.label", np.uint32)
        rows = np.fromfile(folder / "velodyne" / f"{path.stem}.bin", np.float32).reshape(-1, 4)
        start_ns = int(dataset.sample_times("top")[int(path.stem)])
        placed, _ = placed_returns(cloud, trajectory, start_ns=start_ns, vehicle_from_sensor=mount)
        here = trajectory.at([start_ns]).mounted(mount[:3, 3], mount[:3, :3])
        still = ((placed - here.position[0]) / here.scale[0]) @ here.rotation[0]
        np.testing.assert_allclose(rows[:, :3], still, atol=1e-4)
        pulled = max(pulled, np.abs(rows[:, :3] - np.column_stack([cloud[k] for k in "xyz"])).max())
        assert ((rows[:, 3] >= 0) & (rows[:, 3] <= 1)).all()
        semantic, instance = labels & 0xFFFF, labels >> 16
        for klass, code in kitti_yaml.items():
            assert (semantic[cloud["label"] == klass] == code).all()
        users = np.isin(cloud["label"], ROADS)
        assert (instance[~users] == 0).all()
        assert (instance[users] == cloud["instance"][users] - first + 1).all()
        goes = np.isin(cloud["instance"], list(moving))
        assert (semantic[goes] >= 252).all()
        assert (semantic[users & ~goes] < 252).all()
        seen_moving += int(goes.sum())
        lidarseg = np.fromfile(folder / "lidarseg" / f"{path.stem}_lidarseg.bin", np.uint8)
        np.testing.assert_array_equal(lidarseg, class_codes().nuscenes[cloud["label"]])
        five = np.fromfile(folder / "nuscenes" / f"{path.stem}.pcd.bin", np.float32).reshape(-1, 5)
        np.testing.assert_array_equal(five[:, 4], cloud["ring"])
        las = laspy.read(folder / "laz" / f"{path.stem}.laz")
        np.testing.assert_array_equal(las.classification, class_codes().asprs[cloud["label"]])
    assert seen_moving > 50
    assert pulled > 0.1  # metres: raw points are not those of the frame's start


def test_moving_road_users_have_their_own_semantic_kitti_classes():
    klass = np.array(
        [
            *(Class.CAR, Class.CAR, Class.PEDESTRIAN, Class.CYCLIST, Class.BUS, Class.TRUCK, Class.ROAD),
            *(Class.MOTORCYCLE, Class.MOTORCYCLIST, Class.MOTORCYCLIST, Class.BICYCLE),
        ]
    )
    thing = np.array([7, 8, 9, 10, 11, 70_000, 0, 12, 13, 14, 15])
    moves = np.array([False, True, True, True, True, True, False, False, False, True, False])
    labels = semantic_kitti_labels(PointLabels(klass, thing, moves))
    assert (labels & 0xFFFF).tolist() == [10, 252, 254, 253, 257, 258, 40, 15, 32, 255, 11]
    assert (labels >> 16).tolist() == [7, 8, 9, 10, 11, 0, 0, 12, 13, 14, 15]


# learning_map of semantic-kitti-api
TRAINING = {
    0: 0,
    1: 0,
    10: 1,
    11: 2,
    13: 5,
    15: 3,
    16: 5,
    18: 4,
    20: 5,
    30: 6,
    31: 7,
    32: 8,
    40: 9,
    44: 10,
    48: 11,
    49: 12,
    50: 13,
    51: 14,
    52: 0,
    60: 9,
    70: 15,
    71: 16,
    72: 17,
    80: 18,
    81: 19,
    99: 0,
    252: 1,
    253: 7,
    254: 6,
    255: 8,
    256: 5,
    257: 5,
    258: 4,
    259: 5,
}


def test_the_classes_have_all_training_classes_of_semantic_kitti():
    klass = np.array(Class)
    for moves in (False, True):
        labels = PointLabels(klass, np.arange(len(klass)), np.full(len(klass), moves))
        codes = (semantic_kitti_labels(labels) & 0xFFFF).tolist()
        assert {TRAINING[code] for code in codes} >= set(range(1, 20))


def test_a_scanners_folder_is_a_kitti_sequence(dataset):
    """Read as semantic-kitti-api does: pose = inv(Tr) P Tr is the scanner in the first scan's frame."""
    folder = dataset.path / "top"
    calib = {}
    for line in (folder / "calib.txt").read_text().splitlines():
        name, values = line.split(":")
        calib[name] = np.vstack([np.array(values.split(), float).reshape(3, 4), [0, 0, 0, 1]])
    poses = [
        np.linalg.inv(calib["Tr"])
        @ np.vstack([np.array(line.split(), float).reshape(3, 4), [0, 0, 0, 1]])
        @ calib["Tr"]
        for line in (folder / "poses.txt").read_text().splitlines()
    ]
    times = np.loadtxt(folder / "times.txt")
    assert len(poses) == len(times) == 20
    np.testing.assert_allclose(np.diff(times), 0.1, atol=1e-8)
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-9)
    mount = mounts(dataset)[1]["top"]
    at = dataset.trajectory().at(np.array([0, 1_900_000_000])).mounted(mount[:3, 3], mount[:3, :3])
    shift = at.rotation[0].T @ (at.position[1] - at.position[0])
    np.testing.assert_allclose(poses[19][:3, 3], shift, atol=1e-6)
    np.testing.assert_allclose(poses[19][:3, :3], at.rotation[0].T @ at.rotation[1], atol=1e-9)
    # a point straight ahead of the scanner falls where the first camera sees it
    camera_from_lidar = np.linalg.inv(mounts(dataset)[1]["front"]) @ mount
    np.testing.assert_allclose(calib["Tr"], camera_from_lidar, atol=1e-9)
    # a point in the first camera's frame falls where each camera says; there are four for every loader
    calibration, mount = mounts(dataset)
    assert sorted(calib) == ["P0", "P1", "P2", "P3", "Tr"]
    point = np.array([0.3, -0.2, 12.0, 1.0])
    cameras = [s for s in calibration.values() if s["kind"] == "camera"]
    for k, camera in enumerate(cameras):
        seen = (
            np.array(camera["K"])
            @ (np.linalg.inv(camera["vehicle_from_sensor"]) @ mount["front"] @ point)[:3]
        )
        there = (calib[f"P{k}"] @ point)[:3]
        np.testing.assert_allclose(there[:2] / there[2], seen[:2] / seen[2], atol=1e-6)


def test_a_scanners_points_lie_at_the_depth_of_their_pixels_on_a_real_drive(dataset):
    calibration, mount = mounts(dataset)
    camera = calibration["front"]
    trajectory = dataset.trajectory()
    near = before = total = 0
    for frame in range(3, 20, 4):
        start = frame * 100_000_000
        counts = np.array(Image.open(dataset.path / "front" / "depth" / f"{frame:06d}.png")).astype(float)
        depth = np.where(counts > 0, counts / 256, np.inf)
        cloud = read_table(dataset.path / "top" / "pcd" / f"{frame:06d}.pcd")
        still = ~np.isin(cloud["label"], ROADS)
        where, _ = placed(dataset, "top", frame, cloud)
        eye = trajectory.at([start]).mounted(mount["front"][:3, 3], mount["front"][:3, :3])
        local = (where[still] - eye.position) @ eye.rotation[0]
        local = local[local[:, 2] > 1.0]
        pixel = (np.array(camera["K"]) @ (local / local[:, 2:]).T).T[:, :2]
        u, v = np.rint(pixel).astype(int).T
        inside = (u >= 1) & (v >= 1) & (u < camera["width"] - 1) & (v < camera["height"] - 1)
        u, v, z = u[inside], v[inside], local[inside, 2]
        around = np.stack([depth[v + j, u + i] for i in (-1, 0, 1) for j in (-1, 0, 1)])
        low, high = around.min(axis=0), around.max(axis=0)
        near += int(((z > 0.998 * low - 0.02) & (z < 1.002 * high + 0.02)).sum())
        before += int((z < 0.998 * low - 0.02).sum())
        total += len(z)
    assert total > 5000
    # the scanner sees over some surfaces from 20 cm higher up; no point is in front of a pixel's depth
    assert near / total > 0.97
    assert before / total < 0.003


def test_flow_gives_the_pixel_of_the_surface_in_the_next_frame(dataset):
    """For static surfaces, flow computed from depth and poses equals the flow file."""
    calibration, mount = mounts(dataset)
    camera, trajectory = calibration["front"], dataset.trajectory()
    speed = np.linalg.norm(trajectory.velocity, axis=1)[: len(trajectory.time_ns) - 20]
    frame = int(trajectory.time_ns[np.argmax(speed)] // 100_000_000)
    data = _sixteen_bit_colour(dataset.path / "front" / "flow" / f"{frame:06d}.png")
    flow, known = (data[..., :2].astype(float) - 32768) / 64, data[..., 2] == 1
    counts = np.array(Image.open(dataset.path / "front" / "depth" / f"{frame:06d}.png")).astype(float)
    label = np.array(Image.open(dataset.path / "front" / "semantic" / f"{frame:06d}.png"))
    v, u = np.nonzero(known & (counts > 0) & ~np.isin(label, ROADS))
    z = counts[v, u] / 256
    ray = np.linalg.solve(np.array(camera["K"]), np.stack([u, v, np.ones(len(u))]))
    here, later = (
        dataset.trajectory().at([k * 100_000_000]).mounted(mount["front"][:3, 3], mount["front"][:3, :3])
        for k in (frame, frame + 1)
    )
    point = here.place((ray * z).T)
    seen = (point - later.position) @ later.rotation[0]
    expected = (np.array(camera["K"]) @ (seen / seen[:, 2:]).T).T[:, :2] - np.stack([u, v], axis=1)
    assert np.hypot(*expected.T).max() > 1
    assert np.abs(flow[v, u] - expected).max() < 0.2


def _sixteen_bit_colour(path):
    """A 16-bit colour PNG as its rows are stored: each as its difference from the one above (filter 2)."""
    raw = path.read_bytes()
    width, height = (int.from_bytes(raw[k : k + 4], "big") for k in (16, 20))
    assert raw[24:26] == b"\x10\x02"
    at, packed = 8, b""
    while at < len(raw):
        size = int.from_bytes(raw[at : at + 4], "big")
        if raw[at + 4 : at + 8] == b"IDAT":
            packed += raw[at + 8 : at + 8 + size]
        at += size + 12
    rows = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(height, -1)
    assert (rows[:, 0] == 2).all()
    image = np.cumsum(rows[:, 1:], axis=0, dtype=np.uint8)
    return image.copy().view(">u2").reshape(height, width, 3).astype(int)


@pytest.mark.full
def test_a_resumed_drive_counts_all_of_its_points(scene, rig, recorded, tmp_path):
    dataset, summary = recorded
    assert set(summary.points) == {"top", "ahead"}
    counted = sum(len(read_table(p)["x"]) for p in (dataset.path / "top" / "pcd").glob("*.pcd"))
    assert summary.points["top"] == counted == dataset.manifest["points"]["top"]
    for kinds in (("ply",), ("csv",), ("laz",), ("kitti",)):
        options = replace(OPTIONS, rig=rig, duration=0.4, traffic=None, labels=(), deskew="", formats=kinds)
        first = drive(scene, tmp_path / kinds[0], options=options)
        again = drive(scene, tmp_path / kinds[0], options=options)
        assert again.points == first.points
        assert (first.resumed, again.written) == (0, 0)
        assert again.resumed == 4 + 8 + 4 + 2
        if kinds == ("ply",):
            with pytest.raises(DatasetError, match=r"formats ply \(now csv\), seed 12 \(now 13\)"):
                drive(scene, tmp_path / "ply", options=replace(options, formats=("csv",), seed=13))


@pytest.mark.full
def test_camera_settings_change_colours_but_not_ground_truth(scene, rig, tmp_path):
    options = replace(OPTIONS, rig=rig, duration=0.2, traffic=None, formats=("pcd",), labels=(), deskew="")
    changes = {
        "plain": {},
        "noise": {"settings": (("camera_noise", "on"),)},
        "shadows": {"settings": (("shadows", "off"),)},
        "fine": {"settings": (("supersample", "2"),)},
        "sharp": {"settings": (("blur", "1"),)},
        "evening": {"start": dataset_start(18)},
    }
    images = {}
    for name, change in changes.items():
        drive(scene, tmp_path / name, options=replace(options, **change))
        rgb, depth = (
            np.array(Image.open(tmp_path / name / "front" / kind / "000001.png")) for kind in ("rgb", "depth")
        )
        side = np.array(Image.open(tmp_path / name / "side" / "rgb" / "000000.png"))
        images[name] = rgb.astype(int), depth, side.astype(int)
    plain = images["plain"]
    for name in ("noise", "shadows", "fine", "evening"):
        assert np.abs(images[name][0] - plain[0]).mean() > 0.2, name
        np.testing.assert_array_equal(images[name][1], plain[1])
    np.testing.assert_array_equal(images["sharp"][0], plain[0])  # its exposure time is zero
    assert np.abs(images["noise"][0] - plain[0]).mean() < 10


def dataset_start(hour):
    return datetime(2026, 6, 21, hour, tzinfo=UTC)


def _resolve(tables, row, key):
    """The row that a token of a table names."""
    return tables[key.removesuffix("_token")][row[key]]


@pytest.mark.full
def test_nuscenes_tables_link_samples_to_points_boxes_and_pixels(dataset, tmp_path):
    counts = EXPORTERS["nuscenes"].export(dataset, tmp_path / "n").counts
    root = tmp_path / "n"
    tables = {p.stem: {r["token"]: r for r in json.loads(p.read_text())} for p in (root / VERSION).iterdir()}
    for name, rows in tables.items():  # every token refers to a row, and chains are complete
        for row in rows.values():
            for key in row:
                if key.endswith("_token") and key not in ("first_sample_token", "last_sample_token"):
                    if "annotation_token" in key:
                        assert row[key] in tables["sample_annotation"]
                    else:
                        _resolve(tables, row, key)
            for way, back in (("next", "prev"), ("prev", "next")):
                if row.get(way):
                    assert rows[row[way]][back] == row["token"], name
    (described,) = tables["scene"].values()
    assert described["description"].endswith(f"; {dataset.manifest['attribution']}")
    samples = sorted(tables["sample"].values(), key=lambda s: s["timestamp"])
    assert len(samples) == counts["samples"] == 4  # two a second for two seconds
    assert np.diff([s["timestamp"] for s in samples]).tolist() == [500_000] * 3
    assert {_resolve(tables, s, "scene_token")["name"] for s in samples} == {"scene-0103"}  # of mini_val
    (drawn,) = tables["map"].values()
    with Image.open(root / drawn["filename"]) as image:
        mask = np.asarray(image)
    ego = np.array([pose["translation"][:2] for pose in tables["ego_pose"].values()])
    column, row = np.round(ego * [10, -10] + [0, len(mask)]).astype(int).T  # as the development kit does
    assert min(column.min(), row.min(), mask.shape[1] - column.max(), len(mask) - row.max()) > 600
    assert (mask[row, column] == 255).mean() > 0.95
    assert 0.01 < (mask == 255).mean() < 0.5
    data = list(tables["sample_data"].values())
    assert counts["clouds"] + counts["images"] == len(data)
    channels = {d["filename"].split("/")[1] for d in data}
    assert channels == {"LIDAR_TOP", "AHEAD", "FRONT", "SIDE"}
    for channel in channels:
        keys = [d for d in data if d["is_key_frame"] and f"/{channel}/" in d["filename"]]
        assert len({d["sample_token"] for d in keys}) == len(keys) == 4
        assert all((root / d["filename"]).exists() for d in keys)
    inside = total = 0
    place = np.array([dataset.trajectory().scale[0]] * 2 + [1.0])
    walls = []
    for row in data:
        if not (row["is_key_frame"] and "/LIDAR_TOP/" in row["filename"]):
            continue
        points = np.fromfile(root / row["filename"], "<f4").reshape(-1, 5)[:, :3].astype(float)
        labels = np.fromfile(root / f"lidarseg/{VERSION}/{row['token']}_lidarseg.bin", np.uint8)
        assert len(labels) == len(points)
        for step in ("calibrated_sensor_token", "ego_pose_token"):
            pose = _resolve(tables, row, step)
            turn = Rotation.from_quat(np.roll(pose["rotation"], -1))
            points = turn.apply(points) + pose["translation"]
        walls.append(points[labels == CATEGORIES.index("static.manmade")])
        for box in tables["sample_annotation"].values():
            if box["sample_token"] != row["sample_token"] or box["num_lidar_pts"] < 20:
                continue
            thing = tables["instance"][box["instance_token"]]
            kind = tables["category"][thing["category_token"]]["name"]
            local = Rotation.from_quat(np.roll(box["rotation"], -1)).inv().apply(points - box["translation"])
            size = np.array(box["size"])[[1, 0, 2]] / 2 + [
                1.4,
                0.05,
                0.03,
            ]  # and motion during the frame
            held = (np.abs(local) < size).all(axis=1) & (labels == CATEGORIES.index(kind))
            inside, total = inside + held.sum(), total + box["num_lidar_pts"]
    assert total > 200
    assert inside == pytest.approx(total, rel=0.03)
    # Distances between points equal those of the drive's georeferenced clouds.
    scene = tables["scene"].popitem()[1]["description"]
    east, north = map(float, re.search(r"zero at (-?[\d.]+), (-?[\d.]+) of", scene).groups())
    earth = np.concatenate(walls) * place + [east, north, 0.0] - [*dataset.frame.origin, 0.0]
    there = []
    for frame in range(0, 20, 5):
        cloud = laspy.read(dataset.path / "top" / "laz" / f"{frame:06d}.laz")
        there.append(np.column_stack([cloud.x, cloud.y, cloud.z])[np.asarray(cloud.label) == Class.BUILDING])
    geo = Georeference(dataset.frame, dataset.crs, exact=True)
    away, _ = cKDTree(np.concatenate(there)).query(geo.points(earth))
    assert np.quantile(away, 0.9) < 0.002


def test_datasets_without_the_files_that_nuscenes_needs_are_refused(dataset, scene, tmp_path):
    (tmp_path / "n").mkdir()
    with pytest.raises(InputError, match="`overwrite`"):
        EXPORTERS["nuscenes"].export(dataset, tmp_path / "n")
    options = replace(
        OPTIONS, rig="vlp16", duration=0.3, traffic=None, formats=("laz",), labels=(), deskew=""
    )
    drive(scene, tmp_path / "d", options=options)
    with pytest.raises(DatasetError, match="--format pcd"):
        EXPORTERS["nuscenes"].export(open_dataset(tmp_path / "d"), tmp_path / "m")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["d", "n"]


def _calibration(path):
    """Matrices of a calibration file of KITTI by name."""
    lines = (line.split(":", 1) for line in path.read_text().splitlines() if line)
    return {name: np.array(values.split(), float) for name, values in lines if "time" not in name}


@pytest.mark.full
def test_kitti_sequence_has_one_index_for_clouds_labels_images_and_poses(dataset, tmp_path):
    """Read as pykitti's odometry class does; the fisheye camera has no place in it."""
    counts = EXPORTERS["kitti"].export(dataset, tmp_path / "k").counts
    sequence, recorded = tmp_path / "k" / "sequences" / "00", dataset.path / "top"
    assert (counts["clouds"], counts["images"]) == (20, 20)
    assert not any(path.is_symlink() for path in (tmp_path / "k").rglob("*"))
    for folder in ("velodyne", "labels", "image_2", "label_2", "calib"):
        assert [int(path.stem) for path in sorted((sequence / folder).iterdir())] == list(range(20)), folder
    assert {path.name for path in sequence.iterdir() if path.name.startswith("image")} == {"image_2"}
    times = np.loadtxt(sequence / "times.txt")
    np.testing.assert_allclose(times, np.arange(20) / 10, atol=1e-8)
    calibration = _calibration(sequence / "calib.txt")
    Tr = np.vstack([calibration["Tr"].reshape(3, 4), [0, 0, 0, 1]])
    sensors, mount = mounts(dataset)
    np.testing.assert_allclose(Tr, np.linalg.inv(mount["front"]) @ mount["top"], atol=1e-9)
    np.testing.assert_allclose(calibration["P2"].reshape(3, 4)[:, :3], sensors["front"]["K"], atol=1e-9)
    poses = np.loadtxt(tmp_path / "k" / "poses" / "00.txt").reshape(-1, 3, 4)
    at = dataset.trajectory().at(np.arange(20) * 10**8).mounted(mount["front"][:3, 3], mount["front"][:3, :3])
    np.testing.assert_allclose(poses[:, :, 3], (at.position - at.position[0]) @ at.rotation[0], atol=1e-6)
    np.testing.assert_allclose(poses[:, :, :3], at.rotation[0].T @ at.rotation, atol=1e-9)
    for frame in range(0, 20, 7):
        name = f"{frame:06d}"
        written, own = (
            np.fromfile(p / "velodyne" / f"{name}.bin", "<f4").reshape(-1, 4) for p in (sequence, recorded)
        )
        labels, own_labels = (
            np.fromfile(p / "labels" / f"{name}.label", "<u4") for p in (sequence, recorded)
        )
        # laser by laser, where the drive has them in the order of time
        distance, row = cKDTree(own[:, :3]).query(written[:, :3])
        assert len(written) == len(own) == len(np.unique(row))
        assert distance.max() < 1e-3
        np.testing.assert_allclose(written[:, 3], own[row, 3], atol=1e-6)
        np.testing.assert_array_equal(labels, own_labels[row])
        image = (sequence / "image_2" / f"{name}.png").read_bytes()
        assert image == (dataset.path / "front" / "rgb" / f"{name}.png").read_bytes()


@pytest.mark.full
def test_kitti_objects_hold_their_points_and_project_onto_their_2d_boxes(dataset, tmp_path):
    EXPORTERS["kitti"].export(dataset, tmp_path / "k")
    sequence = tmp_path / "k" / "sequences" / "00"
    held, boxes, kinds = 0, 0, set()
    for path in sorted((sequence / "label_2").iterdir()):
        calibration = _calibration(sequence / "calib" / path.name)
        P2, camera_from_lidar = (calibration[name].reshape(3, 4) for name in ("P2", "Tr_velo_to_cam"))
        points = np.fromfile(sequence / "velodyne" / f"{path.stem}.bin", "<f4").reshape(-1, 4)[:, :3]
        points = points @ camera_from_lidar[:, :3].T + camera_from_lidar[:, 3]
        users = np.fromfile(sequence / "labels" / f"{path.stem}.label", "<u4") >> 16
        for line in path.read_text().splitlines():
            kind, *values = line.split()
            truncated, occluded, alpha, *box = map(float, values)
            left, top, right, bottom, height, width, length, x, y, z, yaw = box
            assert 0 <= truncated <= 1
            assert occluded in (0, 1, 2)
            assert alpha == pytest.approx((yaw - np.arctan2(x, z) + np.pi) % (2 * np.pi) - np.pi, abs=1e-3)
            assert 0 <= left <= right <= 319
            assert 0 <= top <= bottom <= 179
            turn = Rotation.from_euler("y", yaw).as_matrix()  # as KITTI's development kit
            own = (points - [x, y, z]) @ turn
            inside = (np.abs(own[:, 0]) < length / 2) & (np.abs(own[:, 2]) < width / 2)
            inside &= (own[:, 1] < -0.2) & (own[:, 1] > -height)
            if inside.sum() > 20:
                found, count = np.unique(users[inside], return_counts=True)
                assert found[count.argmax()] > 0
                assert count.max() > 0.9 * inside.sum()
                held += int(inside.sum())
            corners = [
                [a * length / 2, -b * height, c * width / 2] for a in (-1, 1) for b in (0, 1) for c in (-1, 1)
            ]
            seen = np.column_stack([np.array(corners) @ turn.T + [x, y, z], np.ones(8)]) @ P2.T
            if seen[:, 2].min() > 0.5 and truncated == 0:
                pixels = seen[:, :2] / seen[:, 2:]
                sides = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
                size = max(right - left, bottom - top)
                room = 2.0 + (0.3 if kind == "Misc" else 0.12) * size  # bicycles do not reach their corners
                np.testing.assert_allclose([left, top, right, bottom], sides, atol=room)
                boxes += 1
            kinds.add(kind)
    assert held > 200
    assert boxes > 20
    assert "Car" in kinds


def test_kitti_exports_take_clouds_and_labels_of_kitti_as_they_are(dataset, tmp_path):
    source = tmp_path / "d"
    shutil.copytree(
        dataset.path, source, ignore=shutil.ignore_patterns("pcd", "ply", "csv", "front", "side", "ahead")
    )
    for kind, name in (
        ("kitti", "sequences/00/velodyne/000007.bin"),
        ("kitti-raw", "velodyne_points/data/{:010d}.bin"),
    ):
        hint = EXPORTERS[kind].export(open_dataset(source), tmp_path / kind).hint
        (copied,) = (tmp_path / kind).rglob(name.format(7))
        assert copied.read_bytes() == (source / "top" / "velodyne" / "000007.bin").read_bytes()
    assert f"'{copied.relative_to(tmp_path / kind).parts[0]}', '0001'" in hint
    labels = tmp_path / "kitti" / "sequences" / "00" / "labels" / "000007.label"
    assert labels.read_bytes() == (source / "top" / "labels" / "000007.label").read_bytes()
    shutil.rmtree(source / "top" / "velodyne")
    with pytest.raises(DatasetError, match=r"--format pcd .*kitti"):
        EXPORTERS["kitti"].export(open_dataset(source), tmp_path / "none")


@pytest.mark.full
def test_a_dataset_finds_its_scene_beside_it_from_any_directory(scene, tmp_path, monkeypatch):
    for name in ("work", "elsewhere"):
        (tmp_path / name).mkdir()
    (tmp_path / "work" / "scene").symlink_to(scene.path)
    monkeypatch.chdir(tmp_path / "work")
    options = DriveOptions(route="random", rig="vlp16", duration=0.1, formats=("pcd",))
    drive(open_scene("scene"), "drive", options=options)
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert open_dataset("../work/drive").scene_path.samefile(scene.path)


@pytest.mark.full
def test_a_map_reports_missing_frames(scene, rig, tmp_path):
    options = replace(OPTIONS, rig=rig, duration=0.5, traffic=None, formats=("pcd",), labels=(), deskew="")
    drive(scene, tmp_path / "d", options=options)
    assert aggregate(open_dataset(tmp_path / "d"), tmp_path / "m.ply").missing == {}
    (tmp_path / "d" / "top" / "pcd" / "000002.pcd").unlink()
    assert aggregate(open_dataset(tmp_path / "d"), tmp_path / "n.ply").missing == {"top": 1}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"formats": ("laz",), "deskew": "end"}, "sensor frame"),
        ({"formats": ("pcd",), "deskew": "noon"}, "start, middle, end"),
        ({"formats": ("pcd",), "labels": ("cityscapes",)}, "semantickitti"),
        ({"formats": ()}, "pcd, pcd-ascii, ply"),
    ],
)
def test_invalid_contents_are_refused(change, says):
    with pytest.raises(InputError, match=says):
        RecordingSettings(**change)


def test_a_sensor_without_returns_is_reported(scene, tmp_path):
    text = 'name = "up"\n[[lidar]]\nname = "sky"\npreset = "ust10lx"\ntranslation = [0.0, 0.0, 60.0]\n'
    (tmp_path / "up.toml").write_text(text)
    words = ["--rig", tmp_path / "up.toml", "--route", "random", "--duration", "0.5", "--format", "pcd"]
    done = run_program("lidar", "drive", scene.path, *words, "-o", tmp_path / "d")
    assert done.returncode == 0
    assert "sky has no returns" in done.stderr
    assert "no frame ends" not in done.stderr


def test_a_sensor_that_is_too_slow_for_a_drive_is_named(scene, tmp_path):
    rig = [
        'name = "slow"\n[[lidar]]\nname = "top"\npreset = "vlp16"\ntranslation = [1.2, 0.0, 1.9]',
        '[[camera]]\nname = "rare"\nrate_hz = 1.0\nfov_deg = 90.0\nwidth = 16\nheight = 16',
        "translation = [1.2, 0.0, 2.9]",
    ]
    (tmp_path / "slow.toml").write_text("\n".join(rig))
    words = ["--rig", tmp_path / "slow.toml", "--route", "random", "--duration", "0.2", "--format", "pcd"]
    done = run_program("lidar", "drive", scene.path, *words, "-o", tmp_path / "d")
    assert done.returncode == 0
    assert "rare: no frame ends within 0.2 s, so nothing is recorded" in done.stderr
    assert "no returns" not in done.stderr


@pytest.mark.full
@pytest.mark.usefixtures("dataset")  # its drive compiles the functions, whose cache is larger than the limit
def test_a_full_disk_ends_the_drive_with_one_line(scene, tmp_path):
    """Files are limited to 100 kB here, less than a sweep as LAZ."""

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))

    words = [
        "drive",
        scene.path,
        "--rig",
        "vlp16",
        "--route",
        "random",
        "--duration",
        "0.5",
        "--format",
        "laz",
    ]
    done = run_process("lidar", *words, "-o", tmp_path / "d", env=SMALL_FILES, preexec_fn=limit)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1, done.stderr
    assert "Traceback" not in done.stderr
    assert ".laz" in done.stderr
    assert not list((tmp_path / "d").rglob("*.part"))


def test_boxes_of_rotated_bodies_follow_the_body_axes(dataset):
    rows = table(dataset.path / "boxes.csv")[::40]
    yaw = Rotation.from_quat([[float(r[k]) for k in ("qx", "qy", "qz", "qw")] for r in rows]).as_euler("ZYX")[
        :, 0
    ]
    given = np.array([float(r["yaw"]) for r in rows])
    np.testing.assert_allclose(np.angle(np.exp(1j * (yaw - given))), 0, atol=1e-6)

"""A drive in layouts of image and driving datasets, read as their own tools read them."""

import json
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pycocotools.mask as rle
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image
from pycocotools.coco import COCO
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from geoscene.classes import Class
from lidar.dataset.formats import read_table
from lidar.dataset.formats.kitti import laser_order
from lidar.dataset.ground_truth import read_boxes
from lidar.dataset.layout import open_dataset
from lidar.dataset.layouts import EXPORTERS
from lidar.dataset.layouts.coco import THINGS, encoded_mask
from lidar.dataset.layouts.kitti_360 import SEQUENCE
from lidar.dataset.layouts.kitti_drive import read_drive
from lidar.dataset.layouts.waymo_components import RangeImageGrid, pixels
from lidar.dataset.recorded import Stream, labelled_clouds, still_points
from lidar.errors import DatasetError
from lidar.options.drive import DriveOptions
from lidar.simulation.drive import drive
from lidar.traffic.options import TrafficOptions

pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # pycocotools

RIG = """
name = "layouts"
[[lidar]]
name = "top"
preset = "vlp16"
translation = [1.2, 0.0, 1.9]
rpy_deg = [0.0, 2.0, 5.0]
[[lidar]]
name = "flat"
preset = "utm30lx"
translation = [3.5, 0.0, 0.5]
[[camera]]
name = "front"
translation = [1.5, 0.2, 1.7]
width = 320
height = 180
fov_deg = 80.0
rate_hz = 10.0
images = ["rgb", "semantic", "instance"]
[[camera]]
name = "front_right"
translation = [1.5, -0.4, 1.7]
width = 320
height = 180
fov_deg = 80.0
rate_hz = 10.0
images = ["rgb"]
[[camera]]
name = "side"
translation = [1.0, 0.8, 1.6]
rpy_deg = [0.0, 0.0, 80.0]
model = "fisheye"
width = 100
height = 100
fov_deg = 170.0
rate_hz = 5.0
images = ["rgb"]
[[gnss]]
name = "gnss"
"""
OPTIONS = DriveOptions(
    route="random",
    duration=0.5,
    seed=7,
    formats=("pcd",),
    settings=(("supersample", "1"), ("shadows", "off")),
    workers=1,
    relief="off",
    traffic=TrafficOptions(vehicles=60, parked=0.9, pedestrians=60, cyclists=20),
)


@pytest.fixture(scope="module")
def dataset(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("layouts")
    (folder / "rig.toml").write_text(RIG)
    return open_dataset(
        drive(scene, folder / "drive", options=replace(OPTIONS, rig=str(folder / "rig.toml"))).path
    )


@pytest.fixture(scope="module")
def coco(dataset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("coco") / "out"
    return folder, EXPORTERS["coco"].export(dataset, folder).counts


@given(arrays(bool, st.tuples(st.integers(1, 9), st.integers(1, 9))), st.integers(0, 40), st.integers(0, 40))
def test_masks_are_the_run_lengths_of_the_coco_api(mask, top, left):
    image = np.zeros((top + mask.shape[0] + 3 * (top % 2), left + mask.shape[1] + left % 3), bool)
    image[top : top + mask.shape[0], left : left + mask.shape[1]] = mask
    theirs = rle.encode(np.asfortranarray(image, np.uint8))
    assert encoded_mask(mask, top=top, left=left, size=image.shape) == {
        "size": list(image.shape),
        "counts": theirs["counts"].decode(),
    }


def recorded(dataset, camera, kind, frame):
    return np.asarray(Image.open(dataset.paths.image(camera, frame, kind=kind))).astype(int)


def test_coco_objects_are_the_visible_pixels_of_each_recorded_instance(dataset, coco):
    folder, counts = coco
    read = COCO(folder / "annotations" / "instances.json")
    assert counts["images"] == len(read.imgs) == 12
    assert counts["objects"] == len(read.anns) > 50
    masked = {number: image for number, image in read.imgs.items() if image["camera"] == "front"}
    for number, image in masked.items():
        frame = image["frame_number"]
        copied = (folder / "images" / image["file_name"]).read_bytes()
        assert copied == dataset.paths.image("front", frame, kind="rgb").read_bytes()
        klass = recorded(dataset, "front", "semantic", frame)
        instance = recorded(dataset, "front", "instance", frame) @ [1, 256, 65536]
        things = np.isin(klass, THINGS)
        assert {Class(k) for k in np.unique(klass[things])} & {Class.CAR, Class.PEDESTRIAN}
        covered = np.zeros(klass.shape, int)
        for annotation in read.imgToAnns[number]:
            mask = read.annToMask(annotation).astype(bool)
            covered += mask
            assert len(np.unique(instance[mask])) == 1
            assert set(klass[mask]) == {annotation["category_id"]}
            assert annotation["area"] == mask.sum()
            assert rle.toBbox(annotation["segmentation"]).tolist() == annotation["bbox"]
        assert (covered == things).all()


def test_coco_boxes_of_cameras_without_instance_images_are_the_recorded_ones(dataset, coco):
    read = COCO(coco[0] / "annotations" / "instances.json")
    images = {n: i for n, i in read.imgs.items() if i["camera"] == "front_right"}
    found = {
        (image["frame_number"], a["track_id"]): a for n, image in images.items() for a in read.imgToAnns[n]
    }
    boxes = read_boxes(dataset.paths.sensor_boxes("front_right"), ("pixels",))
    visible = {(box["frame"], box["id"]): box for box in boxes if box["pixels"]}
    assert found.keys() == visible.keys()
    assert len(found) > 10
    for key, box in visible.items():
        left, top, width, height = found[key]["bbox"]  # COCO's pixels begin at 0, the dataset's at -0.5
        sides = [left - 0.5, top - 0.5, left + width - 0.5, top + height - 0.5]
        assert sides == pytest.approx([box[f"seen_{side}"] for side in ("left", "top", "right", "bottom")])
        assert read.cats[found[key]["category_id"]]["name"] == box["class"]
        assert "segmentation" not in found[key]


def test_panoptic_pixels_belong_to_one_segment_each(dataset, coco):
    """Kirillov et al. 2019: a class and an instance for each pixel; all stuff of a class is one segment."""
    folder, counts = coco
    document = json.loads((folder / "annotations" / "panoptic.json").read_text())
    kinds = {category["id"]: category for category in document["categories"]}
    images = {image["id"]: image for image in document["images"]}
    assert counts["panoptic images"] == len(document["annotations"]) == len(images) == 5
    for annotation in document["annotations"]:
        frame = images[annotation["image_id"]]["frame_number"]
        klass = recorded(dataset, "front", "semantic", frame)
        path = folder / "annotations" / "panoptic" / annotation["file_name"]
        number = np.asarray(Image.open(path)).astype(int) @ [1, 256, 65536]
        segments = {segment["id"]: segment for segment in annotation["segments_info"]}
        assert len(segments) == len(annotation["segments_info"])
        assert set(np.unique(number)) - {0} == segments.keys()
        assert ((number == 0) == (klass == Class.UNLABELED)).all()
        for key, segment in segments.items():
            rows, columns = np.nonzero(number == key)
            assert segment["area"] == len(rows)
            x, y = columns.min(), rows.min()
            assert segment["bbox"] == [x, y, columns.max() - x + 1, rows.max() - y + 1]
            assert set(klass[rows, columns]) == {segment["category_id"]}
        stuff = [s["category_id"] for s in segments.values() if not kinds[s["category_id"]]["isthing"]]
        assert len(stuff) == len(set(stuff)) > 3
        assert len(segments) > len(stuff)


def test_a_drive_without_cameras_has_no_coco_images(scene, tmp_path):
    options = DriveOptions(rig="vlp16", duration=0.1, formats=("pcd",))
    driven = drive(scene, tmp_path / "drive", options=options).path
    with pytest.raises(DatasetError, match="holds no colour images; drive with a rig that has cameras"):
        EXPORTERS["coco"].export(open_dataset(driven), tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["drive"]


def rigid(values):
    return np.vstack([np.reshape(values, (3, 4)), [0, 0, 0, 1]])


def matrices(path):
    """Named matrices of a calibration file."""
    rows = (line.split(": ") for line in path.read_text().splitlines())
    return {name: np.array(values.split(), float) for name, values in rows}


def opencv_matrix(node):
    shape = int(node.find("rows").text), int(node.find("cols").text)
    return np.array(node.find("data").text.split(), float).reshape(shape)


def xml_objects(folder):
    path = folder / "data_3d_bboxes" / "train" / f"{SEQUENCE}.xml"
    return ET.parse(path).getroot()  # noqa: S314  (our own file)


@pytest.fixture(scope="module")
def kitti_360(dataset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("kitti_360") / "out"
    return folder, EXPORTERS["kitti-360"].export(dataset, folder).counts


def test_kitti_360_boxes_hold_the_points_of_their_road_users(dataset, kitti_360):
    """World from velodyne as kitti360scripts chains it: pose, camera to pose, camera to velodyne."""
    folder, counts = kitti_360
    assert counts["clouds"] == 5
    poses = np.loadtxt(folder / "data_poses" / SEQUENCE / "poses.txt")
    cam0 = np.loadtxt(folder / "data_poses" / SEQUENCE / "cam0_to_world.txt")
    mounts = matrices(folder / "calibration" / "calib_cam_to_pose.txt")
    unit_from_cam0 = rigid(mounts["image_00"])
    velo_from_cam0 = rigid(np.loadtxt(folder / "calibration" / "calib_cam_to_velo.txt"))
    assert poses[:, 0].tolist() == cam0[:, 0].tolist() == list(range(5))
    assert rigid(poses[0, 1:])[2, 2] < -0.99  # the unit's z axis points down
    objects = xml_objects(folder)
    boxes = {}
    for node in objects:
        numbers = {name: int(node.find(name).text) for name in ("semanticId", "instanceId", "timestamp")}
        boxes[tuple(numbers.values())] = opencv_matrix(node.find("transform"))
        assert np.abs(opencv_matrix(node.find("vertices"))).tolist() == [[0.5] * 3] * 8
        assert numbers["timestamp"] == -1 or node.find("dynamic").text == "1"
    assert len(boxes) == counts["boxes"] == len(objects)
    owner, inside = {}, {True: [], False: []}
    clouds, trajectory = read_drive(dataset).clouds, dataset.trajectory()
    for frame in range(5):
        world_from_unit = rigid(poses[frame, 1:])
        np.testing.assert_allclose(cam0[frame, 1:].reshape(4, 4), world_from_unit @ unit_from_cam0, atol=1e-9)
        path = folder / "data_3d_raw" / SEQUENCE / "velodyne_points" / "data" / f"{frame:010d}.bin"
        points = np.fromfile(path, "<f4").reshape(-1, 4)
        world = points[:, :3] @ (world_from_unit @ unit_from_cam0 @ np.linalg.inv(velo_from_cam0))[:3, :3].T
        world += (world_from_unit @ unit_from_cam0 @ np.linalg.inv(velo_from_cam0))[:3, 3]
        recorded_cloud = still_points(clouds, trajectory, row=frame)
        order = laser_order(recorded_cloud)
        recorded_cloud = {name: column[order] for name, column in recorded_cloud.items()}
        for key, transform in boxes.items():
            if key[2] not in (-1, frame):
                continue
            local = (world - transform[:3, 3]) @ np.linalg.inv(transform[:3, :3]).T
            within = (np.abs(local) < 0.5 + 0.05).all(axis=1) & (recorded_cloud["label"] >= Class.CAR)
            if not within.any():
                continue
            instances, hits = np.unique(recorded_cloud["instance"][within], return_counts=True)
            owner.setdefault(key[:2], int(instances[hits.argmax()]))
            mine = recorded_cloud["instance"] == owner[key[:2]]
            inside[key[2] == -1].append((within & mine).sum() / mine.sum())
    assert len(owner) == len(set(owner.values())) > 10
    assert min(len(shares) for shares in inside.values()) > 2
    assert min(inside[True]) == 1
    assert np.median(inside[False]) > 0.9  # they move within a frame


def test_kitti_360_pixels_name_the_boxes_of_their_road_users(dataset, kitti_360):
    folder, _ = kitti_360
    labels = folder / "data_2d_semantics" / "train" / SEQUENCE
    assert {path.name for path in labels.glob("image_*")} == {"image_00"}  # front_right has no such images
    known = {"car": 26, "person": 24, "rider": 25, "road": 7, "building": 11, "sky": 23}
    objects = xml_objects(folder)
    boxed = {(node.find("label").text, int(node.find("instanceId").text)) for node in objects}
    feature_of = {}
    for frame in range(5):
        image = np.asarray(Image.open(labels / "image_00" / "instance" / f"{frame:010d}.png")).astype(int)
        semantic = np.asarray(Image.open(labels / "image_00" / "semantic" / f"{frame:010d}.png"))
        assert (image // 1000 == semantic).all()
        klass = recorded(dataset, "front", "semantic", frame)
        feature = recorded(dataset, "front", "instance", frame) @ [1, 256, 65536]
        for name, classes in (("road", [Class.ROAD]), ("building", [Class.BUILDING]), ("sky", [Class.SKY])):
            assert set(image[np.isin(klass, classes)]) == {known[name] * 1000}
        users = (klass >= Class.CAR) & (klass <= Class.MOTORCYCLIST)
        assert (image[users] % 1000 > 0).all()
        assert (image[~users] % 1000 == 0).all()
        for value in np.unique(image[users]).tolist():
            (one,) = np.unique(feature[image == value])
            assert feature_of.setdefault(value, one) == one
    assert len(set(feature_of.values())) == len(feature_of) > 5
    names = {number: name for name, number in known.items()}
    near = {(names[value // 1000], value % 1000) for value in feature_of if value // 1000 in names}
    assert len(near & boxed) > 0.9 * len(near)
    found = json.loads((labels / "instanceDict.json").read_text())
    assert feature_of.keys() == {int(value) for value in found if int(value) % 1000}


def test_kitti_360_cameras_project_with_their_own_intrinsics(dataset, kitti_360):
    calibration = matrices(kitti_360[0] / "calibration" / "perspective.txt")
    mounts = matrices(kitti_360[0] / "calibration" / "calib_cam_to_pose.txt")
    sensors = dataset.sensors()
    for number, name in enumerate(("front", "front_right")):
        P = calibration[f"P_rect_{number:02d}"].reshape(3, 4)
        np.testing.assert_allclose(P[:, :3], sensors[name]["K"])
        assert calibration[f"S_rect_{number:02d}"].tolist() == [320, 180]
        assert (calibration[f"R_rect_{number:02d}"].reshape(3, 3) == np.eye(3)).all()
    baseline = np.linalg.inv(rigid(mounts["image_01"])) @ rigid(mounts["image_00"])
    np.testing.assert_allclose(baseline[:3, 3], [-0.6, 0, 0], atol=1e-9)
    P = calibration["P_rect_01"].reshape(3, 4)
    np.testing.assert_allclose(P[:, 3], P[:, :3] @ baseline[:3, 3], atol=1e-6)


@pytest.fixture(scope="module")
def waymo(dataset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("waymo") / "out"
    return folder, EXPORTERS["waymo"].export(dataset, folder).counts


def rows_of(folder, tag):
    """Rows of a component, by the names of its columns without the component's."""
    table = pq.read_table(folder / tag / "drive.parquet")
    names = [name.removeprefix("key.").split("].")[-1] for name in table.column_names]
    return table.rename_columns(names).to_pylist()


def range_image(row, number=1):
    shape = row[f"range_image_return{number}.shape"]
    return np.reshape(row[f"range_image_return{number}.values"], shape)


def waymo_points(lidar, pose, calibration, vehicle):
    """Points in the vehicle's frame as Waymo's range_image_utils computes them, and their pixels' values."""
    image, turned = range_image(lidar), range_image(pose)
    mount = np.reshape(calibration["extrinsic.transform"], (4, 4))
    width = image.shape[1]
    inclination = np.array(calibration["beam_inclination.values"])[::-1]
    correction = np.arctan2(mount[1, 0], mount[0, 0])
    azimuth = ((width - np.arange(width) - 0.5) / width * 2 - 1) * np.pi - correction
    hit = image[..., 0] > 0
    row, column = np.nonzero(hit)
    level, distance = np.cos(inclination[row]), image[hit][:, 0]
    ray = [level * np.cos(azimuth[column]), level * np.sin(azimuth[column]), np.sin(inclination[row])]
    local = np.column_stack(ray) * distance[:, None] @ mount[:3, :3].T + mount[:3, 3]
    roll, pitch, yaw, *place = turned[hit].T
    turn = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll]))
    world_from_vehicle = np.reshape(vehicle["world_from_vehicle.transform"], (4, 4))
    world = turn.apply(local) + np.column_stack(place)
    return (world - world_from_vehicle[:3, 3]) @ world_from_vehicle[:3, :3], image[hit]


def test_waymo_range_images_hold_the_recorded_points(dataset, waymo):
    folder, counts = waymo
    lidar, poses = rows_of(folder, "lidar"), rows_of(folder, "lidar_pose")
    calibrations = {row["laser_name"]: row for row in rows_of(folder, "lidar_calibration")}
    vehicles = rows_of(folder, "vehicle_pose")
    segments = rows_of(folder, "lidar_segmentation")
    assert counts["frames"] == len(vehicles) == len(segments) == 5
    assert [row["laser_name"] for row in lidar] == [1, 2] * 5
    assert range_image(lidar[0]).shape[0] == 16
    assert range_image(lidar[1]).shape[0] == 1  # the second scanner is a plane
    trajectory, start = dataset.trajectory(), round(dataset.start.timestamp() * 1e6)
    clouds = labelled_clouds(dataset, "top")
    total = kept = 0
    for frame, vehicle in enumerate(vehicles):
        time_ns = (vehicle["frame_timestamp_micros"] - start) * 1000
        assert time_ns == clouds.time_ns[frame]
        truth = trajectory.at([time_ns])
        found = np.reshape(vehicle["world_from_vehicle.transform"], (4, 4))
        np.testing.assert_allclose(found[:3, :3], truth.rotation[0], atol=1e-12)
        np.testing.assert_allclose(found[:3, 3], truth.position[0] / truth.scale[0], atol=1e-9)
        points, values = waymo_points(lidar[2 * frame], poses[2 * frame], calibrations[1], vehicle)
        table = still_points(clouds, trajectory, row=frame)
        local = np.column_stack([table[axis] for axis in "xyz"]).astype(float)
        local = local @ clouds.mount.rotation.T + clouds.mount.translation
        away, nearest = cKDTree(local).query(points)
        assert away.max() < 3e-4  # float32 at 100 m and in the pose
        assert len(np.unique(nearest)) == len(points)
        np.testing.assert_allclose(values[:, 1], table["intensity"][nearest] / 255, atol=1e-6)
        pixels = range_image(segments[frame])[range_image(lidar[2 * frame])[..., 0] > 0]
        vehicles_hit = np.isin(table["label"][nearest], [Class.CAR, Class.VAN])
        assert ((pixels[:, 1] == 1) == vehicles_hit).all()
        assert (pixels[vehicles_hit, 0] > 0).all()
        total, kept = total + len(local), kept + len(points)
    assert kept > 0.999 * total
    flat = sum(np.count_nonzero(range_image(row)[..., 0] > 0) for row in lidar[1::2])
    assert (
        counts["points without pixel"]
        == total - kept + sum(len(labelled_points) for labelled_points in flat_points(dataset)) - flat
    )


def flat_points(dataset):
    """Points of the second scanner nearest to each frame of the first."""
    top, flat = (labelled_clouds(dataset, name) for name in ("top", "flat"))
    for time_ns in top.time_ns:
        yield read_table(flat.files[int(np.abs(flat.time_ns - time_ns).argmin())])["x"]


@given(st.floats(-np.pi, np.pi), st.floats(-np.pi, np.pi), st.integers(4, 5000))
def test_columns_of_range_images_are_the_nearest_azimuths(yaw, azimuth, width):
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    stream = Stream("top", {"vehicle_from_sensor": turned.tolist()}, np.arange(1), np.arange(1), ())
    grid = RangeImageGrid(1, stream, np.zeros(1), width)
    column = grid.column(np.array([azimuth]))
    assert 0 <= column[0] < width
    away = np.angle(np.exp(1j * (grid.azimuth(column)[0] - azimuth)))
    assert abs(away) <= np.pi / width + 1e-9


def test_second_echoes_are_in_the_second_range_image_and_third_ones_in_none():
    stream = Stream("top", {"vehicle_from_sensor": np.eye(4).tolist()}, np.arange(1), np.arange(1), ())
    grid = RangeImageGrid(1, stream, np.array([-0.1, 0.1]), 360)
    columns = {"x": [9, 8, 7, 9, 0], "y": [0, 0, 0, 0, -9], "ring": [1, 1, 1, 1, 0], "echo": [1, 2, 3, 1, 1]}
    kept, pixel = pixels(grid, {name: np.array(values) for name, values in columns.items()})
    assert kept.tolist() == [0, 4, 1]  # the fourth has the pixel of the first
    size, ahead = 2 * 360, pixel[0]
    assert ahead in (179, 180)  # the highest ring is the first row; columns go from behind by the left
    assert pixel.tolist() == [ahead, 360 + ahead + 90, size + ahead]


@pytest.mark.full
def test_waymo_boxes_are_the_recorded_ones_and_hold_their_points(dataset, waymo):
    folder, counts = waymo
    boxes = rows_of(folder, "lidar_box")
    assert counts["3D boxes"] == len(boxes) > 50
    recorded_boxes = read_boxes(dataset.paths.sensor_boxes("top"), ("points", "visibility"))
    start = round(dataset.start.timestamp() * 1e6)
    known = {(start + box["time_ns"] // 1000, str(box["id"])): box for box in recorded_boxes}
    kinds = {"car": 1, "van": 1, "truck": 1, "bus": 1, "pedestrian": 2, "cyclist": 4}
    lidar = [row for row in rows_of(folder, "lidar") if row["laser_name"] == 1]
    poses = [row for row in rows_of(folder, "lidar_pose") if row["laser_name"] == 1]
    calibration, vehicles = rows_of(folder, "lidar_calibration")[0], rows_of(folder, "vehicle_pose")
    parts = zip(lidar, poses, vehicles, strict=True)
    clouds = {v["frame_timestamp_micros"]: waymo_points(i, p, calibration, v)[0] for i, p, v in parts}
    parked = 0
    for box in boxes:
        source = known[box["frame_timestamp_micros"], box["laser_object_id"]]
        assert kinds.get(source["class"], box["type"]) == box["type"]
        assert [box[f"speed.{axis}"] for axis in "xyz"] == [source[f"ego_v{axis}"] for axis in "xyz"]
        assert box["num_top_lidar_points_in_box"] == source["points"] <= box["num_lidar_points_in_box"]
        centre = np.array([box[f"box.center.{axis}"] for axis in "xyz"])
        size = np.array([box[f"box.size.{axis}"] for axis in "xyz"])
        local = (clouds[box["frame_timestamp_micros"]] - centre) @ Rotation.from_euler(
            "z", box["box.heading"]
        ).as_matrix()
        inside = (np.abs(local) < size / 2 + 0.05).all(axis=1).sum()
        if not source["moving"] and source["points"]:
            parked += 1
            assert inside >= source["points"]
    assert parked > 2
    assert {box["type"] for box in boxes} >= {1, 2}


def test_waymo_cameras_have_their_images_axes_and_boxes(dataset, waymo):
    folder, counts = waymo
    images = rows_of(folder, "camera_image")
    calibrations = {row["camera_name"]: row for row in rows_of(folder, "camera_calibration")}
    assert counts["images"] == len(images) == 10
    names = dict(zip(calibrations, ("front", "front_right"), strict=True))
    trajectory = dataset.trajectory()
    for number, calibration in calibrations.items():
        mount = np.reshape(calibration["extrinsic.transform"], (4, 4))
        np.testing.assert_allclose(mount[:3, :3], np.eye(3), atol=1e-9)  # they look ahead: x forward, z up
        K = np.array(dataset.sensors()[names[number]]["K"])
        found = [calibration[f"intrinsic.{name}"] for name in ("f_u", "f_v", "c_u", "c_v")]
        np.testing.assert_allclose(found, [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5])
    start = dataset.start.timestamp()
    for k, row in enumerate(images):
        path = dataset.paths.image(names[row["camera_name"]], k // 2, kind="rgb")
        assert row["image"] == path.read_bytes()
        at = np.round((row["pose_timestamp"] - start) * 1e9)
        ends = trajectory.at([at - 5_000_000, at + 5_000_000])
        truth = np.diff(ends.position / ends.scale, axis=0)[0] / 0.01
        velocity = [row[f"velocity.linear_velocity.{axis}"] for axis in "xyz"]
        if k > 1:  # a drive begins at its first pose
            np.testing.assert_allclose(velocity, truth, atol=0.05)
    flat = [row for row in rows_of(folder, "camera_box") if names[row["camera_name"]] == "front"]
    seen = [b for b in read_boxes(dataset.paths.sensor_boxes("front"), ("pixels",)) if b["pixels"]]
    assert len(flat) == len(seen) > 10
    for row, box in zip(flat, seen, strict=True):
        sides = [row["box.center.x"] - row["box.size.x"] / 2, row["box.center.y"] + row["box.size.y"] / 2]
        assert sides == pytest.approx([box["seen_left"] + 0.5, box["seen_bottom"] + 0.5])
        assert row["camera_object_id"] == str(box["id"])


def test_waymo_columns_have_the_names_and_types_of_the_second_version(waymo):
    """As `Component.schema` of waymo_open_dataset.v2 gives them."""
    schemas = {path.parent.name: pq.read_schema(path) for path in waymo[0].glob("*/drive.parquet")}
    wanted = {
        "lidar": {
            "key.segment_context_name": "string",
            "key.frame_timestamp_micros": "int64",
            "key.laser_name": "int8",
            "[LiDARComponent].range_image_return1.values": "list<float>",
            "[LiDARComponent].range_image_return1.shape": "fixed_size_list<int32>[3]",
            "[LiDARComponent].range_image_return2.values": "list<float>",
            "[LiDARComponent].range_image_return2.shape": "fixed_size_list<int32>[3]",
        },
        "vehicle_pose": {
            "key.segment_context_name": "string",
            "key.frame_timestamp_micros": "int64",
            "[VehiclePoseComponent].world_from_vehicle.transform": "fixed_size_list<double>[16]",
        },
        "camera_box": {
            "key.segment_context_name": "string",
            "key.frame_timestamp_micros": "int64",
            "key.camera_name": "int8",
            "key.camera_object_id": "string",
            "[CameraBoxComponent].box.center.x": "double",
            "[CameraBoxComponent].box.center.y": "double",
            "[CameraBoxComponent].box.size.x": "double",
            "[CameraBoxComponent].box.size.y": "double",
            "[CameraBoxComponent].type": "int8",
            "[CameraBoxComponent].difficulty_level.detection": "int8",
            "[CameraBoxComponent].difficulty_level.tracking": "int8",
        },
    }
    assert len(schemas) == 10
    for tag, columns in wanted.items():
        kinds = {field.name: str(field.type).replace("element: ", "") for field in schemas[tag]}
        assert kinds == columns


@pytest.mark.full
def test_layouts_have_the_same_bytes_each_time(dataset, coco, kitti_360, waymo, tmp_path):
    for name, (folder, _) in (("coco", coco), ("kitti-360", kitti_360), ("waymo", waymo)):
        EXPORTERS[name].export(dataset, tmp_path / name)
        assert (tmp_path / name / "checksums.sha256").read_bytes() == (
            folder / "checksums.sha256"
        ).read_bytes()

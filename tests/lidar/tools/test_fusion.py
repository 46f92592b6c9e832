"""Products of several sensors: depth in images, colours of points, views from above, range images, tracks."""

import json
import shutil
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio
from PIL import Image

from geoscene.classes import Class
from lidar import drive
from lidar.dataset.layout import open_dataset
from lidar.dataset.layouts import EXPORTERS
from lidar.dataset.layouts.sweep_images import REACH, points
from lidar.dataset.png import image_to_feature, write_png
from lidar.dataset.recorded import cloud_points, scanner_clouds, still_points
from lidar.dataset.seen_points import motions_of, returns_of, views_of
from lidar.errors import DatasetError
from lidar.geometry.georeference import Georeference
from lidar.options.drive import DriveOptions
from lidar.options.maps import MapOptions
from lidar.tools.evaluation.objects import evaluate_objects
from lidar.tools.maps.aggregate import aggregate
from lidar.traffic.options import TrafficOptions

RIG = """
name = "fusion"
[[lidar]]
name = "top"
preset = "hdl32e"
translation = [1.0, 0.0, 1.9]
rpy_deg = [0.0, 0.0, 30.0]
rate_hz = 10.0
[[camera]]
name = "image_2"
translation = [1.5, 0.1, 1.6]
rpy_deg = [0.0, 5.0, 3.0]
width = 480
height = 320
fov_deg = 80.0
rate_hz = 10.0
row_ns = 60000
exposure_ns = 2000000
images = ["rgb", "depth", "semantic", "instance"]
[[camera]]
name = "bent"
translation = [1.5, -0.1, 1.6]
rpy_deg = [0.0, 5.0, 0.0]
width = 480
height = 320
fov_deg = 80.0
distortion = [-0.2, 0.05, 0.001, -0.001, 0.0]
rate_hz = 10.0
images = ["rgb", "depth", "semantic", "instance"]
[[camera]]
name = "side"
translation = [1.0, 0.8, 1.6]
rpy_deg = [0.0, 0.0, 80.0]
model = "fisheye"
width = 300
height = 300
fov_deg = 170.0
rate_hz = 10.0
images = ["rgb", "depth", "semantic", "instance"]
"""


@pytest.fixture(scope="module")
def dataset(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("fusion")
    (folder / "rig.toml").write_text(RIG)
    options = DriveOptions(
        route="random",
        duration=0.5,
        seed=20,
        formats=("pcd",),
        settings=(("supersample", "1"), ("shadows", "off")),
        workers=1,
        relief="off",
        traffic=TrafficOptions(vehicles=60, parked=0.9, pedestrians=60, cyclists=20),
        rig=str(folder / "rig.toml"),
    )
    return open_dataset(drive(scene, folder / "drive", options=options).path)


def sights(dataset, view):
    """Table and sight of the cloud nearest to each image."""
    clouds, trajectory = scanner_clouds(dataset), dataset.trajectory()
    motions = motions_of(dataset, clouds.name)
    for row in range(len(view.images.files)):
        table = cloud_points(clouds.files[row])
        own = motions.get(int(clouds.frames[row]), {})
        returns = returns_of(
            table, trajectory, start_ns=int(clouds.time_ns[row]), mount=clouds.mount.matrix, motions=own
        )
        yield row, table, view.sight(returns, row)


def pixels(dataset, view, row, kind):
    path = dataset.paths.image(view.camera.name, int(view.images.frames[row]), kind=kind)
    return np.asarray(Image.open(path))


@pytest.mark.full
@pytest.mark.parametrize("camera", ["image_2", "bent", "side"])
def test_points_that_a_camera_sees_are_on_what_their_pixels_show(dataset, camera):
    """Rolling shutter, distortion and fisheye; edges of half a pixel are the rest."""
    view = next(view for view in views_of(dataset) if view.camera.name == camera)
    same, count = 0, 0
    for row, table, sight in sights(dataset, view):
        shown = image_to_feature(pixels(dataset, view, row, "instance"))[sight.cell]
        same, count = same + int((shown == table["instance"][sight.seen]).sum()), count + len(shown)
    assert count > 5000
    assert same / count > 0.97


def test_points_behind_others_are_hidden_with_and_without_depth_images(dataset, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(dataset.path, copy)
    shutil.rmtree(copy / "image_2" / "depth")
    wrong = {}
    for name, data in (("depth", dataset), ("points", open_dataset(copy))):
        view = next(view for view in views_of(data) if view.camera.name == "image_2")
        missed = hidden = seen = 0
        for row, table, sight in sights(data, view):
            u, v = sight.pixel.T
            inside = (u > 0) & (v > 0) & (u < view.camera.width - 1) & (v < view.camera.height - 1)
            inside &= sight.depth > 0.5
            at = np.rint(sight.pixel[inside]).astype(int)
            depth = pixels(dataset, view, row, "depth")[at[:, 1], at[:, 0]] / 256
            behind = sight.depth[inside] > 1.2 * depth + 2.0  # not the same surface, seen at a low angle
            hidden += int(behind.sum())
            missed += int((behind & sight.seen[inside]).sum())
            seen += int(sight.seen.sum())
            assert len(table["x"]) == len(sight.seen)
        wrong[name] = missed / max(hidden, 1)
        assert hidden > 20
        assert seen > 5000
    assert wrong["depth"] < 0.02
    assert wrong["points"] < 0.5


def test_sparse_depth_is_the_true_depth_where_the_scanner_hit(dataset, tmp_path):
    counts = EXPORTERS["kitti-depth"].export(dataset, tmp_path / "d").counts
    place = tmp_path / "d" / "train" / "drive_sync"
    assert counts["images"] == 15
    depths = 0
    for sparse in sorted(place.glob("proj_depth/velodyne_raw/*/*.png")):
        channel, name = sparse.parent.name, sparse.name
        found = np.asarray(Image.open(sparse)).astype(float) / 256
        true = np.asarray(Image.open(place / "proj_depth" / "groundtruth" / channel / name)) / 256
        off = (found - true)[found > 0]
        assert (found > 0).sum() > 300
        assert np.median(np.abs(off)) < 0.05
        assert (off > 2.0).mean() < 0.01  # nothing is seen through surfaces
        assert (place / channel / "data" / name).is_file()
        depths += int((found > 0).sum())
    assert depths == counts["depths"]
    K = np.loadtxt(place / "intrinsics" / "image_02.txt").reshape(3, 3)
    np.testing.assert_allclose(K, dataset.sensors()["image_2"]["K"])


def test_points_come_back_from_range_images(dataset, tmp_path):
    counts = EXPORTERS["range-images"].export(dataset, tmp_path / "r").counts
    folder, clouds = tmp_path / "r" / "top", scanner_clouds(dataset)
    assert counts["returns"] + counts["left out"] == sum(len(cloud_points(f)["x"]) for f in clouds.files)
    assert counts["left out"] == 0
    for frame, path in zip(clouds.frames.tolist(), clouds.files, strict=True):
        table = cloud_points(path)
        image = np.load(folder / "range" / f"{frame:06d}.npy")
        label = np.asarray(Image.open(folder / "label" / f"{frame:06d}.png"))
        instance = np.load(folder / "instance" / f"{frame:06d}.npy")
        known = np.isfinite(image[..., 0])
        found = np.column_stack([points(image), label[known], instance[known]])
        true = np.column_stack([table[k] for k in ("x", "y", "z", "label", "instance")]).astype(float)
        order = [np.lexsort(np.round(rows[:, :3], 2).T) for rows in (found, true)]
        np.testing.assert_allclose(
            np.sort(np.linalg.norm(found[:, :3], axis=1)),
            np.sort(np.linalg.norm(true[:, :3], axis=1)),
            rtol=1e-6,
        )
        assert len(order[0]) == len(order[1])
        np.testing.assert_array_equal(np.bincount(label[known]), np.bincount(table["label"]))
        spread = np.abs(np.diff(np.unwrap(image[..., 1], axis=0), axis=0))
        assert (
            np.nanpercentile(spread, 95) < 0.02
        )  # a column is one azimuth: its rings differ by a step at most
        shown = np.asarray(Image.open(folder / "png" / f"{frame:06d}.png")) / 128
        np.testing.assert_allclose(shown[known], image[known, 0], atol=1 / 256 + 1e-6)
    geometry = json.loads((folder / "geometry.json").read_text())
    assert geometry["shape"] == list(image.shape[:2])


def test_each_point_is_the_point_of_its_range_image_s_pixel(dataset, tmp_path):
    EXPORTERS["range-images"].export(dataset, tmp_path / "r")
    table = cloud_points(scanner_clouds(dataset).files[0])
    folder = tmp_path / "r" / "top"
    image = np.load(folder / "range" / "000000.npy")
    shift = np.array(json.loads((folder / "geometry.json").read_text())["column_shift"])
    row = image.shape[0] - 1 - table["ring"].astype(int)
    column = (table["column"].astype(int) + shift[row]) % image.shape[1]
    distance, azimuth, elevation = image[row, column, :3].astype(float).T
    flat = np.cos(elevation)
    back = distance[:, None] * np.column_stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)]
    )
    np.testing.assert_allclose(back, np.column_stack([table[k] for k in "xyz"]), atol=2e-5)


def test_images_from_above_lie_where_their_points_are(dataset, tmp_path):
    EXPORTERS["bev"].export(dataset, tmp_path / "b")
    clouds, trajectory = scanner_clouds(dataset), dataset.trajectory()
    geo = Georeference(dataset.frame, dataset.crs)
    for row, frame in enumerate(clouds.frames.tolist()):
        table = still_points(clouds, trajectory, row=row)
        pose = trajectory.at([int(clouds.time_ns[row])])
        xyz = np.column_stack([table[k] for k in "xyz"]).astype(float)[table["label"] != Class.NOISE]
        mount = clouds.mount
        vehicle = xyz @ mount.rotation.T + np.array(mount.translation)
        world = geo.points(pose.place(vehicle))
        inside = (np.abs(vehicle[:, :2]) < REACH - 0.2).all(axis=1)
        with rasterio.open(tmp_path / "b" / "top" / f"{frame:06d}.tif") as raster:
            height, intensity, count = raster.read()
            column, line = _cells(raster, world[inside])
        assert count.sum() == (np.abs(vehicle[:, :2]) <= REACH).all(axis=1).sum()
        filled = count[np.clip(line, 0, 999), np.clip(column, 0, 999)] > 0
        assert filled.mean() > 0.9  # a level vehicle's points; rounding at the borders of cells
        assert np.isnan(height[count == 0]).all()
        assert np.nanmax(height) == pytest.approx(vehicle[inside, 2].max(), abs=1.0)
        assert np.nanmin(intensity) >= 0


def _cells(raster, world):
    inverse = ~raster.transform
    x, y = world[:, 0], world[:, 1]
    column, line = (m[0] * x + m[1] * y + m[2] for m in (inverse[:3], inverse[3:6]))
    return np.floor(column).astype(int), np.floor(line).astype(int)


def test_true_tracks_of_kitti_and_of_mot_have_no_errors(dataset, tmp_path):
    EXPORTERS["kitti-tracking"].export(dataset, tmp_path / "k")
    tracks = tmp_path / "k" / "training" / "label_02" / "0000.txt"
    scores = evaluate_objects(tracks, dataset.path)
    assert scores.kind == "kitti tracks"
    assert sum(one.objects for one in scores.scores) > 0
    for one in scores.scores:
        if one.objects:
            assert (one.mota, one.idf1, one.switches) == (1.0, 1.0, 0), one
    counts = EXPORTERS["mot"].export(dataset, tmp_path / "m").counts
    assert counts["tracks"] > 3
    for camera in ("image_2", "side"):
        gt = tmp_path / "m" / "train" / camera / "gt" / "gt.txt"
        one = evaluate_objects(gt, dataset.path, sensor=camera).scores[0]
        assert (one.mota, one.idf1, one.missed, one.wrong) == (1.0, 1.0, 0, 0)
        assert one.objects > 0


@pytest.mark.full
def test_a_track_is_one_road_user_all_along(dataset, tmp_path):
    EXPORTERS["kitti-tracking"].export(dataset, tmp_path / "k")
    EXPORTERS["kitti"].export(dataset, tmp_path / "o")
    sizes, lines = {}, {}
    for text in (tmp_path / "k" / "training" / "label_02" / "0000.txt").read_text().splitlines():
        frame, track, line = text.split(maxsplit=2)
        words = line.split()
        assert sizes.setdefault(track, (words[0], *words[8:11])) == (words[0], *words[8:11])
        lines.setdefault(int(frame), []).append(line)
    for frame, own in lines.items():
        objects = tmp_path / "o" / "sequences" / "00" / "label_2" / f"{frame:06d}.txt"
        assert objects.read_text().splitlines() == own


def test_points_have_the_colours_of_what_they_are(dataset, tmp_path):
    """In images painted by class, each point of a map has the colour of its class."""
    copy = tmp_path / "copy"
    shutil.copytree(dataset.path, copy)
    for camera in ("image_2", "bent", "side"):
        for path in sorted((copy / camera / "semantic").glob("*.png")):
            klass = np.asarray(Image.open(path))
            write_png(copy / camera / "rgb" / path.name, np.stack([klass, 255 - klass, klass // 2], axis=-1))
    data = open_dataset(copy)
    summary = aggregate(data, tmp_path / "m.laz", options=MapOptions(color="image", moving=True))
    assert summary.left_out["image"] > 0
    assert summary.points + summary.left_out["image"] + summary.left_out.get("noise", 0) == summary.points_in
    las = laspy.read(tmp_path / "m.laz")
    red = np.asarray(las.red) // 256
    label = (
        np.asarray(las.classification) if "label" not in las.point_format.dimension_names else las["label"]
    )
    assert len(red) > 5000
    assert (red == np.asarray(label)).mean() > 0.97


def test_products_lack_nothing_or_say_what(dataset, tmp_path):
    bare = tmp_path / "bare"
    shutil.copytree(dataset.path, bare)
    for camera in ("image_2", "bent", "side"):
        shutil.rmtree(bare / camera / "rgb")
    data = open_dataset(bare)
    for name in ("kitti-depth", "kitti-tracking", "mot"):
        with pytest.raises(DatasetError, match="images"):
            EXPORTERS[name].export(data, tmp_path / name)
        assert not (tmp_path / name).exists()
    with pytest.raises(DatasetError, match="colour images"):
        aggregate(data, tmp_path / "m.laz", options=MapOptions(color="image"))
    for name in ("bev", "range-images"):
        shutil.rmtree(bare / "top" / "pcd", ignore_errors=True)
        with pytest.raises(DatasetError, match="no clouds"):
            EXPORTERS[name].export(data, tmp_path / name)


@pytest.mark.full
@pytest.mark.parametrize("name", ["kitti-depth", "range-images", "bev", "kitti-tracking", "mot"])
def test_products_have_the_same_bytes_each_time_and_replace_their_own(dataset, tmp_path, name):
    def bytes_of(folder):
        files = (p for p in sorted(folder.rglob("*")) if p.is_file() and p.name != "provenance.json")
        return {p.relative_to(folder).as_posix(): p.read_bytes() for p in files if p.suffix != ".sha256"}

    EXPORTERS[name].export(dataset, tmp_path / "a")
    first = bytes_of(tmp_path / "a")
    EXPORTERS[name].export(dataset, Path(tmp_path / "a"), overwrite=True)
    assert bytes_of(tmp_path / "a") == first
    assert len(first) > 1

"""A drive in layouts of image and driving datasets, read as their own tools read them."""

import json
from dataclasses import replace

import numpy as np
import pycocotools.mask as rle
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image
from pycocotools.coco import COCO

from geoscene.classes import Class
from lidar.dataset.boxes import read_boxes
from lidar.dataset.export import EXPORTERS
from lidar.dataset.export.coco import THINGS, encoded_mask
from lidar.dataset.layout import open_dataset
from lidar.errors import DatasetError
from lidar.options import DriveOptions
from lidar.pipeline import drive
from lidar.traffic.populate import TrafficOptions

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
    seed=11,
    formats=("pcd",),
    settings=(("supersample", "1"), ("shadows", "off")),
    workers=1,
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

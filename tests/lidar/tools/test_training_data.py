"""Samples for training hold what was recorded, and worker processes can load them."""

import multiprocessing
import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest

import lidar
from geoscene.classes import Class
from lidar.dataset.png import counts_to_depth, read_png
from lidar.errors import DatasetError, InputError
from lidar.options.drive import DriveOptions
from lidar.simulation.drive import drive
from lidar.traffic.options import TrafficOptions

RIG = """
name = "tilted"
vehicle = "car"
source = "made up"

[[lidar]]
name = "top"
preset = "vlp16"
translation = [1.2, 0.0, 1.9]
quat_wxyz = [0.9238795325, 0.0, 0.0, 0.3826834324]

[[camera]]
name = "front"
translation = [2.0, 0.0, 1.5]
width = 160
height = 120
fov_deg = 90.0
rate_hz = 10.0
images = ["rgb", "depth"]
"""
"""A scanner that is turned to the left by 45 degrees, and a camera that looks ahead."""

OPTIONS = DriveOptions(
    route="random",
    duration=0.5,
    seed=5,
    relief="off",
    formats=("pcd",),
    traffic=TrafficOptions(vehicles=60.0, parked=0.9, pedestrians=40.0, cyclists=10.0),
)


@pytest.fixture(scope="module")
def recorded(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("training")
    (folder / "rig.toml").write_text(RIG)
    options = replace(OPTIONS, rig=str(folder / "rig.toml"))
    return drive(scene, folder / "drive", options=options).path


def inside(points, box, margin):
    """Which points (n, 3) are in a box (7,), wider by a margin."""
    x, y, z, *size, yaw = box
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    return (np.abs((points - [x, y, z]) @ turn) <= np.array(size) / 2 + margin).all(axis=1)


def test_the_points_of_a_road_user_are_those_in_its_box(recorded):
    data = lidar.training_data(recorded, min_points=5)
    assert len(data) == 5
    boxes = 0
    for sample in data:
        xyz = sample["points"][:, :3].astype(float)
        assert len(sample["label"]) == len(sample["instance"]) == len(xyz) > 10_000
        assert (sample["box_points"] >= 5).all()
        for k, box in enumerate(sample["boxes"]):
            on = sample["instance"] == sample["box_instance"][k]
            assert on.sum() == sample["box_points"][k]
            assert (sample["label"][on] == sample["box_label"][k]).all()
            slow = np.linalg.norm(sample["box_velocity"][k]) < 0.1
            # who moves is where it was at the points' own times; limbs of people swing out of their box
            margin = 0.05 if slow else 0.1 * np.linalg.norm(sample["box_velocity"][k]) + 0.2
            assert inside(xyz[on], box, margin).mean() > 0.98, Class(int(sample["box_label"][k]))
            others = inside(xyz[~on], box, -0.1).sum()
            assert others <= 0.02 * on.sum() + 2
            boxes += 1
    assert boxes > 30


def test_points_with_motion_are_those_of_the_file(recorded):
    data = lidar.training_data(recorded, deskewed=False, columns=("x", "y", "z", "range", "ring", "time_ns"))
    table = lidar.read_cloud(recorded / "top" / "pcd" / "000003.pcd")
    sample = data[3]
    np.testing.assert_array_equal(sample["points"][:, :3], table.xyz)
    np.testing.assert_array_equal(sample["points"][:, 4], table.ring)
    np.testing.assert_array_equal(sample["label"], table.klass)
    assert (sample["frame"], sample["drive"], sample["time_ns"]) == (3, 0, 300_000_000)
    still = lidar.training_data(recorded)[3]["points"][:, :3]
    moved = np.linalg.norm(still - table.xyz, axis=1)
    assert moved[table.time_ns < 1e6].max() < 0.02 < moved[table.time_ns > 9e7].max()


def test_points_project_onto_the_surfaces_that_an_image_shows(recorded):
    sample = lidar.training_data(recorded, cameras=["front"])[2]
    assert sample["image_front"].shape == (120, 160, 3)
    np.testing.assert_array_equal(sample["image_front"], read_png(recorded / "front" / "rgb" / "000002.png"))
    depth = counts_to_depth(read_png(recorded / "front" / "depth" / "000002.png"))
    homogeneous = np.column_stack([sample["points"][:, :3], np.ones(len(sample["points"]))])
    x, y, z = (homogeneous @ sample["front_from_sensor"].T)[:, :3].T
    u, v = (sample["K_front"] @ [x / z, y / z, np.ones(len(z))])[:2]
    column, row = np.rint(u), np.rint(v)
    seen = (z > 1) & (column >= 0) & (column < 160) & (row >= 0) & (row < 120)
    at_pixel = depth[row[seen].astype(int), column[seen].astype(int)]
    assert seen.sum() > 500
    assert np.median(np.abs(at_pixel - z[seen]) / z[seen]) < 0.02


def largest(sample):
    """A transform that worker processes can be given."""
    return int(sample["box_points"].max(initial=0)), float(sample["points"].sum())


def test_worker_processes_give_the_samples_of_this_one(recorded):
    data = lidar.training_data([recorded, recorded], transform=largest)
    _ = data[0]  # reads a trajectory, which is not pickled
    assert len(pickle.dumps(data)) < 20_000
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        assert pool.map(data.__getitem__, range(len(data))) == list(data)


def test_data_are_a_sequence_that_splits_by_time(recorded):
    data = lidar.training_data([recorded, str(recorded)])
    assert len(data) == 10
    np.testing.assert_array_equal(data[-1]["points"], data[9]["points"])
    with pytest.raises(IndexError):
        data[10]
    early, late = ([(s["drive"], s["frame"]) for s in part] for part in data.split(0.6))
    assert early == [(drive, frame) for drive in (0, 1) for frame in (0, 1, 2)]
    assert late == [(drive, frame) for drive in (0, 1) for frame in (3, 4)]
    assert [s["frame"] for s in data[::2]] == [0, 2, 4, 1, 3]
    with pytest.raises(InputError, match="`share` 1: give a number between 0 and 1"):
        data.split(1.0)


@pytest.mark.full
def test_a_drive_without_road_users_has_no_boxes(scene, tmp_path):
    options = replace(OPTIONS, traffic=None, rig="vlp16", duration=0.2)
    sample = lidar.training_data(drive(scene, tmp_path / "d", options=options).path)[0]
    assert sample["boxes"].shape == (0, 7)
    assert sample["box_velocity"].shape == (0, 3)
    assert sample["box_label"].shape == (0,)


def test_what_cannot_be_read_is_named(recorded, tmp_path):
    with pytest.raises(InputError, match=r"`sensor` roof: no scanner of .* which has top"):
        lidar.training_data(recorded, sensor="roof")
    with pytest.raises(InputError, match=r"`cameras` rear: no camera of .* which has front"):
        lidar.training_data(recorded, cameras=["rear"])
    with pytest.raises(InputError, match=r"`columns` colour: .*000000\.pcd has x, y, z"):
        _ = lidar.training_data(recorded, columns=("x", "colour"))[0]
    with pytest.raises(InputError, match="give one or more directories"):
        lidar.training_data([])
    shutil.copytree(recorded, tmp_path / "laz")
    shutil.rmtree(tmp_path / "laz" / "top" / "pcd")
    with pytest.raises(DatasetError, match="top has no clouds with labels and instances; drive again"):
        lidar.training_data(tmp_path / "laz")

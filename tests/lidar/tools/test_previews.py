"""Pictures and tables that notebooks show of clouds, drives, maps and frames."""

import io

import numpy as np
import pytest
from PIL import Image

import lidar
from geoscene.classes import Class, class_codes
from lidar.options.drive import DriveOptions
from lidar.options.maps import MapOptions


@pytest.fixture(scope="module")
def recorded(scene, tmp_path_factory):
    options = DriveOptions(route="random", rig="vlp16", duration=0.5, seed=2, formats=("pcd",))
    return lidar.drive(scene, tmp_path_factory.mktemp("previews") / "way", options=options).path


def colours(shown, klass):
    """Number of pixels of a picture in the colour of a class, nearly."""
    image = np.asarray(Image.open(io.BytesIO(shown._repr_png_())).convert("RGB")).astype(int)
    return int((np.abs(image - class_codes().color[klass]).max(axis=2) < 40).sum())


def test_pictures_show_the_points_in_the_colours_of_their_classes(recorded, tmp_path):
    cloud = lidar.read_cloud(recorded / "lidar_top" / "pcd" / "000000.pcd")
    dataset = lidar.open_dataset(recorded)
    drawn = lidar.aggregate(dataset, tmp_path / "map.laz", options=MapOptions(color="class"))
    walls = cloud.where(cloud.klass == Class.BUILDING)
    for shown in (cloud, dataset, drawn, walls):
        assert colours(shown, Class.BUILDING) > 100
    assert colours(cloud, Class.ROAD) > 50
    assert colours(walls, Class.ROAD) < 10
    assert drawn._repr_html_().count("<img") == 1


def test_tables_state_what_was_recorded(scene, recorded):
    dataset = lidar.open_dataset(recorded)
    text = dataset._repr_html_()
    points = dataset.manifest["points"]["lidar_top"]
    assert "Drive way" in text
    assert f"{points:,}" in text
    assert f"{dataset.frames} of {dataset.frames}</td>" in text
    assert "OpenStreetMap contributors" in text
    cloud = lidar.read_cloud(recorded / "lidar_top" / "pcd" / "000000.pcd")
    road = int((cloud.klass == Class.ROAD).sum())
    assert f"{len(cloud):,} returns" in cloud._repr_html_()
    assert f">{road:,}<" in cloud._repr_html_()
    options = DriveOptions(route="random", rig="vlp16", duration=0.2, seed=2)
    frame = next(iter(lidar.simulate(scene, options)))
    assert f"{len(frame.clouds['lidar_top']):,} returns" in frame._repr_html_()


def test_nothing_is_drawn_of_an_empty_cloud_but_the_scanner(recorded):
    cloud = lidar.read_cloud(recorded / "lidar_top" / "pcd" / "000000.pcd")
    empty = cloud.take(slice(0))
    assert colours(empty, Class.BUILDING) == 0
    assert "0 returns" in empty._repr_html_()

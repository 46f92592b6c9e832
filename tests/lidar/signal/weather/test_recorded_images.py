"""Weather in the images of drives and of their records."""

from dataclasses import replace

import numpy as np
import pytest

from lidar.dataset.png import read_png
from lidar.errors import InputError
from lidar.options.data import ApplyOptions
from lidar.options.drive import DriveOptions
from lidar.signal.weather.setting import read_weather
from lidar.simulation.drive import drive
from lidar.tools.apply import apply_stages

RIG = """
name = "eye"
[[camera]]
name = "front"
translation = [3.6, 0.0, 0.8]
width = 96
height = 64
fov_deg = 80.0
rate_hz = 5.0
exposure_ns = 4_000_000
images = {images}
"""
FOG = read_weather("rain=20mm/h,fog=60m,drops=0.05,dirt=0.05")
CLEAR = (("cloud", "0"), ("wetness", "0"))


@pytest.fixture
def options(tmp_path):
    rig = tmp_path / "eye.toml"
    rig.write_text(RIG.format(images='["rgb", "depth", "semantic"]'))
    return DriveOptions(rig=str(rig), duration=0.5, seed=3, settings=CLEAR, relief="off")


def images(folder):
    return np.stack([read_png(path) for path in sorted((folder / "front" / "rgb").iterdir())]).astype(int)


@pytest.mark.full
def test_weather_on_a_record_gives_the_images_of_the_drive(scene, options, tmp_path):
    drive(scene, tmp_path / "plain", options=options)
    drive(scene, tmp_path / "wet", options=replace(options, weather=FOG))
    apply_stages(tmp_path / "plain", tmp_path / "applied", options=ApplyOptions(weather=FOG))
    plain, wet, applied = (images(tmp_path / name) for name in ("plain", "wet", "applied"))
    assert (np.abs(plain - wet) > 10).mean() > 0.3
    assert (np.abs(applied - wet) > 1).mean() < 0.001  # depth images are in steps of 1/256 m
    for name in ("wet", "applied"):
        truth = np.load(tmp_path / name / "front" / "truth" / "000001.npz")
        assert np.array_equal(plain[1][truth["changed"]], truth["removed"])


@pytest.mark.full
def test_bytes_do_not_depend_on_workers(scene, options, tmp_path):
    for workers in (1, 2):
        drive(scene, tmp_path / str(workers), options=replace(options, weather=FOG, workers=workers))
    assert np.array_equal(images(tmp_path / "1"), images(tmp_path / "2"))


def test_recorded_cameras_without_depth_are_refused_with_nothing_written(scene, options, tmp_path):
    rig = tmp_path / "flat.toml"
    rig.write_text(RIG.format(images='["rgb"]'))
    drive(scene, tmp_path / "plain", options=replace(options, rig=str(rig)))
    with pytest.raises(
        InputError, match=r"needs depth images of front, which were not recorded.*on a scanner alone"
    ):
        apply_stages(tmp_path / "plain", tmp_path / "out", options=ApplyOptions(weather=FOG))
    assert not (tmp_path / "out").exists()
    drive(scene, tmp_path / "wet", options=replace(options, rig=str(rig), weather=FOG))
    assert images(tmp_path / "wet").shape == images(tmp_path / "plain").shape

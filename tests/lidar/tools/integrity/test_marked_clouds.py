"""Watermarks of drives in weather and in clouds of the world frame, and what cannot be signed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidar.dataset.formats import FORMATS
from lidar.dataset.formats.las import LasInfo
from lidar.dataset.layout import open_dataset
from lidar.errors import DatasetError, InputError
from lidar.options.data import ApplyOptions
from lidar.options.drive import DriveOptions
from lidar.signal.registry import read_stages
from lidar.simulation.drive import drive
from lidar.tools.apply import apply_stages
from lidar.tools.integrity.keys import Hmac
from lidar.tools.integrity.marked_clouds import coarseness
from lidar.tools.integrity.watermark import WatermarkKey
from lidar.tools.sign import sign_dataset
from lidar.tools.verify import verify_dataset

MARK = WatermarkKey(b"0123456789abcdef")
HMAC = Hmac(b"fedcba9876543210")


@pytest.fixture(scope="module")
def driven(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("driven") / "a"
    options = DriveOptions(rig="vlp16", duration=0.3, seed=3, formats=("pcd", "las"), workers=1)
    drive(scene, out, options=options)
    return out


@pytest.mark.full
def test_signed_drives_in_weather_can_be_attacked(driven, tmp_path):
    fog = read_stages(["false_weather:share=0.2"]).stages
    apply_stages(driven, tmp_path / "foggy", options=ApplyOptions(fog))
    sign_dataset(tmp_path / "foggy", tmp_path / "signed", watermark=MARK, signer=HMAC)
    assert verify_dataset(tmp_path / "signed", watermark=MARK, signer=HMAC).intact
    attack = read_stages(["delete:bearing=0,distance=8,long=8,wide=8,high=6"]).stages
    apply_stages(tmp_path / "signed", tmp_path / "attacked", options=ApplyOptions(attack))
    report = verify_dataset(tmp_path / "attacked", watermark=MARK, signer=HMAC)
    assert {f.what for f in report.chain.findings} == {"changed"}
    for frame in report.watermark.frames:
        with np.load(tmp_path / "attacked" / frame.sensor / "truth" / f"{frame.frame:06d}.npz") as truth:
            assert len(truth["removed"]) > 0
            assert {0, 3} <= set(truth["origin"].tolist())
    assert report.watermark.frames


def test_watermarks_are_read_from_world_coordinates(driven, tmp_path):
    sign_dataset(driven, tmp_path / "a", watermark=MARK)
    dataset = open_dataset(tmp_path / "a")
    (name,) = dataset.sensors("lidar")
    for path in (tmp_path / "a").glob(f"{name}/pcd/*"):
        path.unlink()
    report = verify_dataset(tmp_path / "a", watermark=MARK).watermark
    assert {f.what for f in report.findings} == {"missing"}
    assert (report.clouds, report.wrong, report.tampered) == (3, 0, 0)
    path = tmp_path / "a" / name / "las" / "000001.las"
    table = FORMATS["las"].read(path)
    near = np.flatnonzero(np.asarray(table["range"]) < 12)
    table["z"][near] += 0.4
    info = LasInfo(dataset.crs, (np.round(table["x"][0]), np.round(table["y"][0]), 0.0), dataset.start)
    FORMATS["las"].write(path, table, info=info)
    (frame,) = verify_dataset(tmp_path / "a", watermark=MARK).watermark.frames
    assert frame.file.endswith("las/000001.las")
    assert frame.forged == pytest.approx(len(near), rel=0.1)
    for axis in "xyz":
        table[axis] = np.round(table[axis] / 0.05) * 0.05
    FORMATS["las"].write(path, table, info=info)
    with pytest.raises(InputError, match=r"are multiples of 0\.05 m; a watermark with a step"):
        verify_dataset(tmp_path / "a", watermark=MARK)


@given(st.sampled_from([1.0, 0.5, 0.1, 0.05, 0.02, 0.01, 0.005]), st.integers(0, 99))
def test_rounded_coordinates_are_noticed(step, seed):
    exact = np.random.default_rng(seed).uniform(-100, 100, (200, 3))
    assert coarseness(exact) == 0
    assert coarseness((np.round(exact / step) * step).astype(np.float32)) == pytest.approx(step)


def test_folders_that_are_no_datasets_are_refused_with_nothing_written(tmp_path):
    (tmp_path / "velodyne").mkdir()
    with pytest.raises(DatasetError, match=r"no dataset\.json"):
        sign_dataset(tmp_path, tmp_path / "out", watermark=MARK)
    with pytest.raises(DatasetError, match=r"no dataset\.json"):
        verify_dataset(tmp_path, signer=HMAC)
    assert [path.name for path in tmp_path.iterdir()] == ["velodyne"]

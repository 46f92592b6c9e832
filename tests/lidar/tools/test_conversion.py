"""Clouds that `lidar convert` writes in another format are those of a drive with that format."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from helpers.programs import run_program

from lidar.dataset.formats import read_table
from lidar.dataset.layout import open_dataset
from lidar.errors import DatasetError, InputError
from lidar.options.data import CONVERTED_FORMATS
from lidar.options.drive import DriveOptions
from lidar.signal.registry import read_stages
from lidar.simulation.drive import drive
from lidar.tools.convert import convert
from lidar.tools.verify import verify_dataset
from lidar.traffic.options import TrafficOptions

RIG = """
name = "two"
[[lidar]]
name = "top"
preset = "vlp16"
translation = [1.2, 0.0, 1.9]
[[lidar]]
name = "doppler"
preset = "fmcw"
translation = [3.5, 0.3, 0.7]
"""
OPTIONS = DriveOptions(
    route="random",
    duration=0.2,
    seed=3,
    formats=("pcd",),
    labels=("semantickitti",),
    deskew="end",
    workers=1,
    traffic=TrafficOptions(vehicles=30, parked=0.5),
    stages=read_stages(["dropped_packets:loss=0.1"]).stages,
)


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory):
    """The same drive recorded as PCD, ``plain``, and in all formats, ``all``."""
    folder = tmp_path_factory.mktemp("drives")
    (folder / "rig.toml").write_text(RIG)
    options = replace(OPTIONS, rig=str(folder / "rig.toml"))
    drive(scene, folder / "plain", options=options)
    drive(scene, folder / "all", options=replace(options, formats=(*CONVERTED_FORMATS, "kitti")))
    return folder


def files(folder):
    """Bytes of the files of a dataset by their paths, but for those that name its formats."""
    own = {"dataset.json", "checksums.sha256", "frames.csv"}
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.name not in own
    }


@pytest.mark.full
@pytest.mark.parametrize("name", [name for name in CONVERTED_FORMATS if name != "pcd"])
def test_converted_clouds_have_the_bytes_of_a_drive_with_that_format(folder, tmp_path, name):
    summary = convert(folder / "plain", tmp_path / "out", to=name)
    found, driven = files(tmp_path / "out"), files(folder / "all")
    assert summary.counts == {"clouds": 4}
    assert sum(f"/{name}/" in path for path in found) == 4
    assert found == {path: driven[path] for path in found}
    other = {path for path in files(folder / "plain") if "/pcd/" not in path and "/deskewed/" not in path}
    assert other <= found.keys()
    manifest = open_dataset(tmp_path / "out").manifest
    assert manifest["formats"] == manifest["recipe"]["formats"] == [name]
    assert manifest["derived_from"][-1]["by"] == f"lidar convert --to {name}"
    assert manifest["points"] == open_dataset(folder / "all").manifest["points"]
    assert verify_dataset(tmp_path / "out").intact


def test_las_becomes_laz_and_back(folder, tmp_path):
    convert(folder / "plain", tmp_path / "laz", to="laz")
    convert(tmp_path / "laz", tmp_path / "las", to="las")
    convert(tmp_path / "las", tmp_path / "again", to="laz")
    driven = files(folder / "all")
    for name in ("las", "again"):
        found = files(tmp_path / name)
        assert found == {path: driven[path] for path in found}


@pytest.mark.full
def test_clouds_of_fewer_digits_are_converted_with_a_warning(folder, tmp_path, caplog):
    convert(folder / "plain", tmp_path / "csv", to="csv")
    assert "digits" not in caplog.text
    convert(tmp_path / "csv", tmp_path / "npz", to="npz")
    assert "points have the digits of csv files" in caplog.text
    exact = read_table(folder / "all" / "doppler" / "npz" / "000001.npz")
    found = read_table(tmp_path / "npz" / "doppler" / "npz" / "000001.npz")
    assert found.keys() == exact.keys()
    for name, column in exact.items():
        assert found[name].dtype == column.dtype
        np.testing.assert_allclose(found[name], column, rtol=0, atol=6e-3 if name == "intensity" else 1e-4)


@pytest.mark.parametrize("name", ["laz", "e57"])
def test_clouds_of_the_world_frame_return_to_the_scanners(folder, tmp_path, caplog, name):
    """Times and firing blocks are exact, from the pulses; positions to the steps of LAZ or float32."""
    convert(folder / "plain", tmp_path / name, to=name)
    convert(tmp_path / name, tmp_path / "npz", to="npz")
    assert f"points have the digits of {name} files" in caplog.text
    for sensor in ("top", "doppler"):
        for frame in range(2):
            exact = read_table(folder / "all" / sensor / "npz" / f"{frame:06d}.npz")
            found = read_table(tmp_path / "npz" / sensor / "npz" / f"{frame:06d}.npz")
            assert {n: c.dtype for n, c in found.items()} == {n: c.dtype for n, c in exact.items()}
            same = [n for n in exact if n not in ("x", "y", "z", "intensity", "range")]
            for column in ["range", *same]:
                np.testing.assert_array_equal(found[column], exact[column], err_msg=column)
            assert len(found["x"]) > 1000
            away = np.sqrt(sum((found[axis].astype(float) - exact[axis]) ** 2 for axis in "xyz"))
            assert away.max() < 1.1e-3
            np.testing.assert_allclose(found["intensity"], exact["intensity"], atol=0.5 / 257 + 1e-5)


def test_clouds_that_lack_what_a_format_holds_are_refused(folder, tmp_path):
    driven = open_dataset(folder / "all")
    source = shutil.copytree(folder / "all", tmp_path / "source")
    recipe = driven.manifest["recipe"] | {"formats": ["kitti"]}
    (source / "dataset.json").write_text(json.dumps(driven.manifest | {"recipe": recipe}))
    with pytest.raises(
        DatasetError, match=r"clouds in kitti lack what pcd files hold; drive with `formats` pcd"
    ):
        convert(source, tmp_path / "pcd", to="pcd")
    with pytest.raises(InputError, match=r"`to` 'pandaset' is unknown .*nuscenes.*, pcd, "):
        convert(folder / "plain", tmp_path / "out", to="pandaset")
    with pytest.raises(InputError, match="give a directory outside of"):
        convert(folder / "plain", folder / "plain" / "laz", to="laz")
    with pytest.raises(DatasetError, match="is not empty"):
        convert(folder / "plain", source, to="las")
    with pytest.raises(InputError, match="its clouds are in pcd already"):
        convert(folder / "plain", tmp_path / "out", to="pcd")
    assert [path.name for path in tmp_path.iterdir()] == ["source"]


def test_a_signature_of_the_former_files_is_left_out(folder, tmp_path, caplog):
    source = shutil.copytree(folder / "plain", tmp_path / "source")
    (tmp_path / "key").write_text("5f" * 32)
    done = run_program("lidar", "sign", source, "--chain", tmp_path / "key")
    assert (done.returncode, (source / "integrity" / "chain.json").is_file()) == (0, True)
    convert(source, tmp_path / "npz", to="npz")
    assert f"{source / 'integrity'}: left out" in caplog.text
    assert not (tmp_path / "npz" / "integrity").exists()
    assert verify_dataset(tmp_path / "npz").intact


def test_a_damaged_cloud_ends_a_conversion_and_nothing_is_left(folder, tmp_path):
    source = shutil.copytree(folder / "plain", tmp_path / "source")
    cloud = source / "doppler" / "pcd" / "000001.pcd"
    cloud.write_bytes(cloud.read_bytes()[:-100])
    done = run_program("lidar", "convert", source, "--to", "npz", "-o", tmp_path / "out")
    assert done.returncode == 2
    assert "000001.pcd" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["source"]
    manifest = json.loads((source / "dataset.json").read_text())
    (source / "dataset.json").write_text(json.dumps(manifest | {"frames_done": 1}))
    with pytest.raises(DatasetError, match="was not finished"):
        convert(source, tmp_path / "out", to="laz")

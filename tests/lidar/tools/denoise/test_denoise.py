"""Filters against the returns of rain and snow, and their scores."""

import json
import shutil
from math import isnan

import numpy as np
import pytest
from helpers.programs import run_program

from lidar.dataset.formats import read_cloud
from lidar.dataset.layout import open_dataset
from lidar.errors import DatasetError, InputError, LidarError
from lidar.options.data import ApplyOptions
from lidar.options.drive import DriveOptions
from lidar.sensors.physics.origin import Origin
from lidar.signal.weather.setting import read_weather
from lidar.simulation.drive import drive
from lidar.tools.apply import apply_stages
from lidar.tools.denoise.denoise import FilterTally, denoise
from lidar.tools.denoise.filters import METHODS, Ddior, Dror, Dsor, Lior, StatisticalFilter, read_methods


def wall(distance, *, step=0.05):
    """A wall ahead as a scanner with a spacing of ``step`` metres in both directions sees it."""
    y, z = np.meshgrid(np.arange(-5, 5, step), np.arange(-1, 1, step))
    return np.column_stack([np.full(y.size, distance), y.ravel(), z.ravel()])


WALL = wall(10.0)
FLAKES = np.random.default_rng(1).uniform([2, -4, -1], [9, 4, 1], (40, 3))
SCENE = np.concatenate([WALL, FLAKES])
CODE = np.concatenate([np.full(len(WALL), 40.0), np.full(len(FLAKES), 0.5)])
IS_FLAKE = np.arange(len(SCENE)) >= len(WALL)


@pytest.mark.parametrize("name", METHODS)
def test_lone_dim_returns_are_removed_and_walls_stay(name):
    method = Dsor(factor=0.15) if name == "dsor" else METHODS[name]()  # 0.05 is for clouds to 100 m
    kept = method.kept(SCENE, CODE)
    assert kept.dtype == bool
    assert kept[~IS_FLAKE].mean() > (0.85 if name == "statistical" else 0.95)
    assert kept[IS_FLAKE].mean() < 0.1


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("count", [0, 1, 2])
def test_clouds_of_few_returns_are_no_error(name, count):
    assert METHODS[name]().kept(SCENE[:count], CODE[:count]).shape == (count,)


def test_dror_asks_for_neighbours_within_a_radius_that_grows_with_the_distance():
    near, far = wall(5.0, step=0.03), wall(50.0, step=0.3)
    code = np.zeros(len(far))
    assert Dror().kept(far, code).mean() > 0.95  # radius 0.42 m
    assert not Dror(multiplier=0.5, radius=0.0).kept(far, code).any()  # 0.07 m
    assert Dror().kept(near, np.zeros(len(near))).mean() > 0.95
    line = np.array([[5.0, 0, 0], [5.0, 0.02, 0], [5.0, 0, 0.02], [5.0, 0.02, 0.02]])
    assert Dror(neighbours=3).kept(line, np.zeros(4)).all()
    assert not Dror(neighbours=4).kept(line, np.zeros(4)).any()
    close = np.array([[0.1, 0, 0], [0.13, 0, 0], [0.1, 0.03, 0], [0.1, 0, 0.03]])
    assert Dror().kept(close, np.zeros(4))[0]  # the least radius, 40 mm


def test_lior_removes_only_dim_lonely_returns_within_its_range():
    place = np.array([[10.0, 0, 0], [20.0, 0, 0], [80.0, 0, 0]])
    assert Lior().kept(place, np.array([5.0, 5.1, 0.0])).tolist() == [False, True, True]
    cluster = np.repeat([[10.0, 0, 0]], 4, axis=0) + np.eye(4, 3) * 0.01
    assert Lior().kept(cluster, np.zeros(4)).all()
    assert not Lior(neighbours=4).kept(cluster, np.zeros(4)).any()


def test_the_limits_of_dsor_and_ddior_are_those_of_their_papers():
    xyz = np.array([[20.0, 0, 0], [20.0, 1.0, 0], [20.0, 0, 2.0]])
    spacing = np.array([1.5, (1 + np.hypot(1, 2)) / 2, (2 + np.hypot(1, 2)) / 2])
    limit = spacing.mean() + 0.01 * spacing.std(ddof=1)
    distance = np.linalg.norm(xyz, axis=1)
    for factor in (0.03, 0.05, 0.07):
        kept = Dsor(neighbours=2, factor=factor).kept(xyz, np.zeros(3))
        assert kept.tolist() == (spacing < limit * factor * distance).tolist()
    for code in (0.0, 0.2, 0.5):
        kept = Ddior(neighbours=2).kept(xyz, np.full(3, code))
        assert kept.tolist() == (spacing < (0.02 + 0.1 * code) * spacing.mean() * distance).tolist()


def test_the_statistical_filter_is_that_of_the_point_cloud_library():
    rng = np.random.default_rng(2)
    xyz = rng.normal(size=(300, 3))
    away = np.sort(np.linalg.norm(xyz[:, None] - xyz[None], axis=2), axis=1)[:, 1:9].mean(axis=1)
    kept = StatisticalFilter(neighbours=8, deviations=0.5).kept(xyz, np.zeros(300))
    assert kept.tolist() == (away < away.mean() + 0.5 * away.std(ddof=1)).tolist()


def test_scores_of_counts():
    kept = np.array([True, True, False, False, False, True])
    weather = np.array([False, False, True, True, False, True])
    tally = FilterTally().with_frame(kept, weather)
    assert (tally.precision, tally.recall, tally.lost) == (2 / 3, 2 / 3, 1 / 3)
    assert tally.f1 == pytest.approx(2 / 3)
    both = tally.with_frame(kept, weather)
    assert (both.frames, both.returns, both.weather_removed) == (2, 12, 4)
    unknown = tally.with_frame(kept, None)
    assert isnan(unknown.precision)
    assert unknown.to_json()["recall"] is None
    assert unknown.to_json()["removed"] == 6
    json.dumps(unknown.to_json(), allow_nan=False)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("drorr", "method 'drorr' is unknown; is dror meant"),
        ("dror:angle=0", "angle = 0 is not within 0.001 to 10"),
        ("dror:angel=1", "parameter 'angel' is unknown; is angle meant"),
        ("lior:neighbours=2.5", "not a whole number"),
        ("lior:5", "give NAME:KEY=VALUE"),
        ("lior:range=5,range=6", "range is given twice"),
        ("dror:neighbours=5:angle=0.2", "as in dror:neighbours=5,angle=0.2"),
    ],
)
def test_faulty_methods_end_in_one_line(text, match, tmp_path):
    with pytest.raises(InputError, match=match):
        read_methods([text])
    result = run_program("lidar", "denoise", tmp_path, "--method", text, "-o", tmp_path / "out")
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def snowy(scene, tmp_path_factory):
    """A drive through snow of a scanner and a camera, with labels."""
    folder = tmp_path_factory.mktemp("snowy")
    rig = folder / "small.toml"
    rig.write_text(
        'name = "small"\n[[lidar]]\nname = "top"\npreset = "vlp16"\ntranslation = [1.2, 0.0, 1.9]\n'
    )
    options = DriveOptions(
        rig=str(rig),
        duration=0.3,
        seed=3,
        formats=("pcd", "kitti", "nuscenes"),
        labels=("semantickitti",),
        weather=read_weather("snow=10mm/h,snow_cover=0"),
    )
    drive(scene, folder / "drive", options=options)
    return folder / "drive"


@pytest.mark.full
def test_a_filtered_dataset_holds_what_the_filter_keeps(snowy, tmp_path):
    found = denoise(snowy, read_methods(["ddior"]), out=tmp_path / "clean")
    tally = found.scores["ddior"]["top"]
    assert found.scores["ddior"]["all"] == tally
    assert tally.frames == 3
    assert tally.recall > 0.8
    before, after = open_dataset(snowy), open_dataset(tmp_path / "clean")
    assert after.manifest["recipe"]["denoised"] == "ddior"
    assert sum(after.manifest["points"].values()) == tally.returns - tally.removed
    place = before.paths.truth("top", 1).relative_to(snowy)
    truth, left = np.load(snowy / place), np.load(tmp_path / "clean" / place)
    removed = left["filtered"]
    assert np.array_equal(np.delete(truth["origin"], removed), left["origin"])
    assert np.array_equal(np.delete(truth["source"], removed), left["source"])
    given = read_cloud(snowy / "top" / "pcd" / "000001.pcd")
    kept = read_cloud(tmp_path / "clean" / "top" / "pcd" / "000001.pcd")
    assert np.array_equal(np.delete(given.xyz, removed, axis=0), kept.xyz)
    assert np.array_equal(np.delete(given.intensity, removed), kept.intensity)
    labels = [np.fromfile(f / "top" / "labels" / "000001.label", "<u4") for f in (snowy, tmp_path / "clean")]
    assert np.array_equal(np.delete(labels[0], removed), labels[1])
    assert (truth["origin"][removed] == Origin.WEATHER).sum() > 0
    again = denoise(tmp_path / "clean", read_methods(["ddior"])).scores["ddior"]["top"]
    assert again.weather == tally.weather - tally.weather_removed


@pytest.mark.full
def test_a_drive_without_weather_has_none_to_remove(scene, tmp_path):
    drive(scene, tmp_path / "dry", options=DriveOptions(rig="vlp16", duration=0.2, seed=3))
    tally = denoise(tmp_path / "dry", read_methods(["dror"])).scores["dror"]["all"]
    assert (tally.weather, tally.precision) == (0, 0)
    assert isnan(tally.recall)
    assert tally.lost > 0


def test_clouds_of_kitti_and_nuscenes_are_filtered_byte_by_byte(snowy, tmp_path):
    kitti = tmp_path / "kitti"
    (kitti / "velodyne").mkdir(parents=True)
    (kitti / "labels").mkdir()
    for k in range(2):
        source = snowy / "top" / "velodyne" / f"{k:06d}.bin"
        (kitti / "velodyne" / source.name).write_bytes(source.read_bytes())
        count = source.stat().st_size // 16
        np.arange(count, dtype="<u4").tofile(kitti / "labels" / f"{k:06d}.label")
    methods = read_methods(["lior", "dror"])
    unknown = denoise(kitti, methods).scores["lior"]["velodyne"]
    assert unknown.weather == -1
    assert unknown.removed > 0
    apply_stages(
        kitti, tmp_path / "worse", options=ApplyOptions(weather=read_weather("snow=5mm/h"), sensor="vlp16")
    )
    found = denoise(tmp_path / "worse", read_methods(["lior"]), out=tmp_path / "out")
    tally = found.scores["lior"]["velodyne"]
    assert tally.weather > 0
    rows = np.fromfile(tmp_path / "worse" / "velodyne" / "000000.bin", np.float32).reshape(-1, 4)
    left = np.fromfile(tmp_path / "out" / "velodyne" / "000000.bin", np.float32).reshape(-1, 4)
    gone = np.load(tmp_path / "out" / "truth" / "velodyne" / "000000.npz")["filtered"]
    assert np.array_equal(np.delete(rows, gone, axis=0), left)
    codes = np.fromfile(tmp_path / "worse" / "labels" / "000000.label", "<u4")
    assert np.array_equal(
        np.delete(codes, gone), np.fromfile(tmp_path / "out" / "labels" / "000000.label", "<u4")
    )


def test_what_cannot_be_filtered_is_refused_with_nothing_written(snowy, tmp_path):
    methods = read_methods(["dror"])
    with pytest.raises(DatasetError, match="no velodyne"):
        denoise(tmp_path, methods, out=tmp_path.parent / "out")
    with pytest.raises(InputError, match="method dror: given twice"):
        read_methods(["dror", "dror"])
    with pytest.raises(InputError, match="one method, not of 2"):
        denoise(snowy, read_methods(["dror", "lior"]), out=tmp_path / "out")
    with pytest.raises(InputError, match="outside of"):
        denoise(snowy, methods, out=snowy / "out")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "note").write_text("mine")
    with pytest.raises(DatasetError, match="is not empty"):
        denoise(snowy, methods, out=tmp_path / "full")
    assert not (tmp_path / "out").exists()
    assert not (tmp_path.parent / "out").exists()


@pytest.mark.full
def test_a_damaged_later_cloud_leaves_what_was_there(snowy, tmp_path):
    source, out = tmp_path / "snowy", tmp_path / "out"
    shutil.copytree(snowy, source)
    denoise(source, {"lior": Lior()}, out=out)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    max(source.rglob("*.pcd")).write_bytes(b"no cloud")
    for target in (out, tmp_path / "new"):
        with pytest.raises(LidarError):
            denoise(source, {"dror": Dror()}, out=target, overwrite=True)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    assert {path.name for path in tmp_path.iterdir()} == {"snowy", "out"}


def test_the_program_prints_a_table_or_json(snowy, tmp_path):
    result = run_program("lidar", "denoise", snowy, "--method", "dror,lior:intensity=3", "-q")
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[0].split()[:3] == ["method", "scanner", "frames"]
    assert "lior:intensity=3" in result.stdout
    result = run_program(
        "lidar", "denoise", snowy, "--method", "dror", "--json", "-q", "-o", tmp_path / "out"
    )
    found = json.loads(result.stdout)
    assert found["methods"]["dror"]["top"]["recall"] > 0.5
    assert (tmp_path / "out" / "dataset.json").exists()

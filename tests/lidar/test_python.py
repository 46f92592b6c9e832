"""The interface of Python: values as the command line takes them, opened or by path, and errors by name."""

from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest

import geoscene
import lidar
from geoscene.errors import InputError as SceneInputError
from geoscene.export import export_scene
from geoscene.sources import demo_path
from lidar.errors import InputError
from lidar.options.data import ApplyOptions
from lidar.options.look import PlaybackOptions
from lidar.options.trajectories import OdometryOptions
from lidar.tools.convert import convert
from lidar.tools.defences.defend import defend
from lidar.tools.info import describe
from lidar.tools.maps.aggregate import aggregate
from lidar.tools.view.page import view_drive
from lidar.traffic.options import TrafficOptions, read_traffic


def options(**values):
    return lidar.DriveOptions(**{"route": "random", **values})


@pytest.mark.parametrize(
    ("name", "given", "taken"),
    [
        ("traffic", "on", TrafficOptions()),
        ("traffic", "on:vehicles=20,parked=0.5", read_traffic("vehicles=20,parked=0.5")),
        ("traffic", "off", None),
        ("weather", "rain=10mm/h", lidar.read_weather("rain=10mm/h")),
        ("weather", ["rain=10mm/h", "fog=50m"], lidar.read_weather("rain=10mm/h,fog=50m")),
        ("weather", lidar.read_weather("rain=10mm/h")[0], lidar.read_weather("rain=10mm/h")),
        ("stages", "dropped_packets", lidar.read_stages(["dropped_packets"]).stages),
        ("stages", lidar.read_stages(["dropped_packets"]), lidar.read_stages(["dropped_packets"]).stages),
        ("attacks", ["gnss_spoof"], lidar.read_attacks(["gnss_spoof"])),
        ("formats", "pcd", ("pcd",)),
        ("formats", "PCD,laz", ("pcd", "laz")),
        ("formats", ["pcd", "laz"], ("pcd", "laz")),
        ("labels", "semantickitti", ("semantickitti",)),
        ("rig", Path("my/rig.toml"), "my/rig.toml"),
        ("route", "60.1,24.9 60.2,24.8", [(60.1, 24.9), (60.2, 24.8)]),
        ("route", "60.1,24.9  track.gpx", Path("60.1,24.9  track.gpx")),
        ("route", "my track.gpx", Path("my track.gpx")),
        ("route", Path("track.gpx"), Path("track.gpx")),
        ("route", np.array([(60.1, 24.9), (60.2, 24.8)]), [(60.1, 24.9), (60.2, 24.8)]),
        ("settings", "rays=7,poses=frame", (("rays", "7"), ("poses", "frame"))),
        ("settings", {"rays": 7}, (("rays", "7"),)),
        ("settings", [("rays", "7")], (("rays", "7"),)),
        ("duration", 5, 5.0),
        ("duration", np.float32(5), 5.0),
        ("seed", np.int64(3), 3),
        ("exact", np.bool_(True), True),
        ("start", "2026-06-21T08:00:00", datetime(2026, 6, 21, 8, tzinfo=UTC)),
        ("start", datetime(2026, 6, 21, 8), datetime(2026, 6, 21, 8, tzinfo=UTC)),  # noqa: DTZ001
        (
            "start",
            datetime(2026, 6, 21, 8, tzinfo=timezone(timedelta(hours=1))),
            datetime(2026, 6, 21, 7, tzinfo=UTC),
        ),
    ],
)  # fmt: skip
def test_options_take_what_the_command_line_takes(name, given, taken):
    value = getattr(options(**{name: given}), name)
    assert value == taken
    assert type(value) is type(taken)


@pytest.mark.parametrize(
    ("name", "given", "words"),
    [
        ("traffic", True, "`traffic` True: give a text such as on"),
        ("traffic", "off-road", "traffic 'off-road' is unknown"),
        ("weather", 5, "`weather` 5: give a list"),
        ("weather", "hail", "kind 'hail' is unknown"),
        ("stages", [7], r"`stages` \[7\]: give texts"),
        ("attacks", {"a": 1}, "`attacks` {'a': 1}: give a list"),
        ("formats", 3, "`formats` 3: give a list"),
        ("formats", ["pcd", 3], r"`formats` \['pcd', 3\]: give a text"),
        ("seed", "1", "`seed` '1': give a whole number"),
        ("seed", True, "`seed` True: give a whole number"),
        ("workers", 2.5, "`workers` 2.5: give a whole number"),
        ("duration", "5", "`duration` '5': give a number"),
        ("exact", "yes", "`exact` 'yes': give True or False"),
        ("rig", 4, "`rig` 4: give a text"),
        ("route", [(60.1, 24.9)], r"`route` \[\(60.1, 24.9\)\]: give two or more places"),
        ("route", [(60.1, 24.9), (100, 0)], r"\(100, 0\) is no latitude and longitude"),
        ("route", 3, "`route` 3: give a list"),
        ("settings", 3, "`settings` 3: give a list"),
        ("settings", [1], r"`settings` \[1\]: give NAME=VALUE"),
        ("start", 3, "`start` 3: give a datetime"),
        ("start", "noon", "`start` 'noon': give an ISO 8601 time"),
    ],
)
def test_an_unusable_value_is_named_with_what_is_allowed(name, given, words):
    with pytest.raises(InputError, match=words) as caught:
        options(**{name: given})
    assert "\n" not in str(caught.value)
    assert "object" not in str(caught.value)


def test_options_of_other_commands_are_taken_alike():
    assert geoscene.BuildOptions(dem="heights.tif", only="Buildings,roads").only == ("buildings", "roads")
    assert geoscene.BuildOptions(dem=Path("heights.tif")).dem == ("heights.tif",)
    assert geoscene.ExportOptions(layers="buildings").layers == ("buildings",)
    found = lidar.MapOptions(
        voxel=1, time=[0, 10], polygon="a.geojson", raster="dsm,dtm", sensors="lidar_top"
    )
    assert (found.voxel, found.time, found.polygon) == (1.0, (0.0, 10.0), Path("a.geojson"))
    assert (found.raster, found.sensors) == (("dsm", "dtm"), ("lidar_top",))
    assert ApplyOptions(weather="rain=10mm/h").weather == lidar.read_weather("rain=10mm/h")
    assert OdometryOptions(method="kiss-icp", settings={"voxel": 0.5}).settings == (("voxel", "0.5"),)
    assert PlaybackOptions(sensors=["a", "b"]).sensors == ("a", "b")
    for kind, name, value in (
        (geoscene.BuildOptions, "lod", "2"),
        (geoscene.BuildOptions, "crs", 32618),
        (geoscene.ExportOptions, "resolution", "fine"),
    ):
        with pytest.raises(SceneInputError, match=f"`{name}` {value!r}: give"):
            kind(**{name: value})
    with pytest.raises(InputError, match=r"`time` \(0, 1, 2\): give 2 values"):
        lidar.MapOptions(time=(0, 1, 2))


def test_tools_take_paths_texts_and_opened_datasets(plain_drive, tmp_path):
    dataset = lidar.open_dataset(plain_drive)
    assert lidar.open_dataset(dataset) is dataset
    for k, given in enumerate((str(plain_drive), dataset)):
        assert aggregate(given, tmp_path / f"{k}.laz").points > 0
        assert describe(given)["path"] == str(plain_drive)
        assert convert(given, tmp_path / f"{k}", to="tum").counts
        assert view_drive(given, tmp_path / f"{k}.html").frames == 10
        assert defend(given, "occlusion").frames == 10
        assert len(lidar.training_data(given)) == 10
    assert (tmp_path / "0.laz").read_bytes() == (tmp_path / "1.laz").read_bytes()
    assert describe(plain_drive) == describe(dataset)
    for wrong in (5, None, [plain_drive]):
        with pytest.raises(InputError, match=r"`dataset` .*: give the directory or URL of a dataset"):
            aggregate(wrong, tmp_path / "x.laz")
    with pytest.raises(InputError, match=r"`options` 'color=height': give a MapOptions"):
        aggregate(dataset, tmp_path / "x.laz", options="color=height")


def test_a_drive_takes_the_path_of_a_scene_and_gives_the_same_bytes(scene, tmp_path):
    chosen = options(rig="vlp16", duration=0.3, formats="pcd", seed=4)
    for name, given in (("opened", scene), ("text", str(scene.path))):
        lidar.drive(given, str(tmp_path / name), options=chosen)
    sums = [(tmp_path / name / "checksums.sha256").read_text() for name in ("opened", "text")]
    assert sums[0] == sums[1]
    assert len(lidar.simulate(str(scene.path), chosen)) == 3
    with pytest.raises(SceneInputError, match="`scene` 5: give the directory or URL of a scene"):
        lidar.drive(5, tmp_path / "x", options=chosen)
    with pytest.raises(InputError, match=r"`options` 'random': give a DriveOptions"):
        lidar.drive(scene, tmp_path / "x", options="random")
    with pytest.raises(InputError, match="nowhere: no such scene or map"):
        lidar.drive("nowhere", tmp_path / "x", options=chosen)


def test_builds_and_exports_take_paths(tmp_path):
    chosen = geoscene.BuildOptions(only="buildings", lod=0)
    scene = geoscene.build(str(demo_path()), str(tmp_path / "scene"), options=chosen)
    assert scene.manifest["counts"]["buildings"] > 100
    assert geoscene.open_scene(scene) is scene
    for given in (scene, scene.path, str(scene.path)):
        assert export_scene(given, tmp_path / "a.gpkg", overwrite=True).objects > 100
    with pytest.raises(SceneInputError, match=r"nowhere\.osm: no such file"):
        geoscene.build("nowhere.osm", tmp_path / "x")
    with pytest.raises(SceneInputError, match="`options` 2: give a BuildOptions"):
        geoscene.build(demo_path(), tmp_path / "x", options=2)


def test_representations_are_a_few_lines(scene, plain_drive, town_drive):
    text = repr(scene)
    assert text.startswith(f"Scene {scene.path}")
    assert f"{scene.manifest['counts']['solids']} buildings" in text
    assert "OpenStreetMap" in text
    dataset = lidar.open_dataset(plain_drive)
    points = sum(dataset.manifest["points"].values())
    assert repr(dataset).startswith(f"Dataset {plain_drive}: 10 frames, 1.0 s, ")
    assert f"10 frames, {points:,} points" in repr(dataset)
    data = lidar.training_data([plain_drive, town_drive], columns=["x", "y", "z"])
    assert repr(data).splitlines()[0] == f"TrainingData: {len(data)} samples; points: x, y, z"
    assert f"  {plain_drive}: 10 of 10 frames of lidar_top, no boxes" in repr(data).splitlines()
    many = lidar.training_data([plain_drive] * 50)
    for found in (scene, dataset, data, many):
        assert len(repr(found).splitlines()) < 10
        assert max(map(len, repr(found).splitlines())) < 300

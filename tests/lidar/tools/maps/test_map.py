"""Aggregated maps: all points at their world coordinates, in constant memory."""

import json
import tracemalloc
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
import trimesh
from helpers.map_data import CRS_OUT, FRAME, START, dataset, expected, trajectory, world_points
from pypcd4 import PointCloud

from geoscene.classes import Class, class_codes
from lidar.dataset.formats import las, pcd
from lidar.dataset.formats.las import LasInfo
from lidar.dataset.layout import open_dataset
from lidar.errors import DatasetError, InputError
from lidar.geometry.georeference import Georeference
from lidar.geometry.time_scales import gps_seconds
from lidar.geometry.trajectory_files import read_trajectory, write_trajectory
from lidar.options.maps import ORIGINS, MapOptions
from lidar.sensors.physics.origin import Origin
from lidar.tools.maps.aggregate import aggregate


def test_trajectories_round_trip_exactly(tmp_path):
    write_trajectory(tmp_path / "t.csv", trajectory())
    back = read_trajectory(tmp_path / "t.csv")
    for name in ("time_ns", "position", "quat_xyzw", "velocity", "scale"):
        np.testing.assert_array_equal(getattr(back, name), getattr(trajectory(), name))


@pytest.mark.parametrize("kinds", [("laz",), ("pcd",)])
def test_map_points_have_their_world_coordinates(tmp_path, kinds):
    summary = aggregate(dataset(tmp_path / "d", kinds=kinds), tmp_path / "m.laz")
    las = laspy.read(tmp_path / "m.laz")
    assert summary.points == summary.points_in == len(las) == 2400
    assert las.header.parse_crs().to_epsg() == 32635
    found = np.column_stack([las.x, las.y, las.z])
    assert np.abs(found - expected()).max() < 0.002
    seconds = np.asarray(las.gps_time) - gps_seconds(START, np.zeros(1, np.int64))
    assert (np.diff(seconds) >= -1e-6).all()
    road = np.asarray(las.label) == Class.ROAD
    assert (np.asarray(las.red)[road] == 257 * int(class_codes().color[Class.ROAD, 0])).all()


def test_ply_and_pcd_maps_hold_the_same_points(tmp_path):
    data = dataset(tmp_path / "d")
    aggregate(data, tmp_path / "m.ply", options=MapOptions(color="height"))
    aggregate(data, tmp_path / "m.pcd", options=MapOptions(color="intensity"))
    ply = np.asarray(trimesh.load(tmp_path / "m.ply").vertices)
    assert np.abs(ply - expected()).max() < 0.001
    pcd = PointCloud.from_path(tmp_path / "m.pcd")
    comment = (tmp_path / "m.pcd").read_bytes().splitlines()[1].decode()
    offset = np.array([float(v) for v in comment.split()[2:5]])
    found = np.column_stack([pcd.pc_data[k] for k in "xyz"]).astype(float) + offset
    assert np.abs(found - expected()).max() < 0.001


@pytest.mark.full
@pytest.mark.parametrize("voxel", [0.5003, 2.0007, 100.0001])  # no border on the millimetres of LAZ
def test_a_voxel_keeps_the_one_return_nearest_to_its_centre(tmp_path, voxel):
    data = dataset(tmp_path / "d")
    aggregate(data, tmp_path / "m.laz", options=MapOptions(voxel=voxel))
    las = laspy.read(tmp_path / "m.laz")
    offset = np.array(Georeference(FRAME, CRS_OUT).offset)
    kept = np.round(np.column_stack([las.x, las.y, las.z]) - offset, 3)
    points = np.round(expected() - offset, 3)  # what the LAZ files hold
    cells = {}
    for p in points:
        cell = tuple(np.floor(p / voxel))
        away = ((p - (np.array(cell) + 0.5) * voxel) ** 2).sum()
        if cell not in cells or away < cells[cell][0] - 1e-9:
            cells[cell] = (away, p)
    assert len(kept) == len(cells)
    for p in kept:
        away, _ = cells[tuple(np.floor(p / voxel))]
        centre = (np.floor(p / voxel) + 0.5) * voxel
        assert ((p - centre) ** 2).sum() == pytest.approx(away, abs=1e-6)
    assert not [p for p in tmp_path.iterdir() if "voxels" in p.name or "part" in p.name]


@pytest.mark.full
@pytest.mark.parametrize("voxel", [None, 0.5])
def test_memory_does_not_grow_with_the_number_of_frames(tmp_path, monkeypatch, voxel):
    monkeypatch.setattr("lidar.tools.maps.squares._SHRINK_AT", 200_000)
    peaks = []
    for frames in (10, 60):
        data = dataset(tmp_path / f"d{frames}", first=100, frames=frames, n=5000)  # at rest
        aggregate(data, tmp_path / "warm.laz", options=MapOptions(voxel=voxel), overwrite=True)
        tracemalloc.start()
        aggregate(data, tmp_path / f"{frames}.laz", options=MapOptions(voxel=voxel))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 2 * peaks[0]  # six times the frames


def test_the_same_dataset_gives_the_same_bytes(tmp_path):
    data = dataset(tmp_path / "d")
    for name in ("a.laz", "b.laz"):
        aggregate(data, tmp_path / name, options=MapOptions(voxel=0.3))
    assert (tmp_path / "a.laz").read_bytes() == (tmp_path / "b.laz").read_bytes()


@pytest.mark.parametrize(
    ("out", "change", "words"),
    [
        ("m.xyz", {}, "m.xyz"),
        ("m.laz", {"voxel": 0.0}, "`voxel`"),
        ("m.laz", {"voxel": float("nan")}, "`voxel`"),
        ("m.laz", {"color": "mood"}, "`color` 'mood'"),
        ("m.laz", {"without": ("carr",)}, "`without` 'carr' is unknown; is car meant"),
        ("m.laz", {"sensors": ("bottom",)}, "no scanner bottom"),
        ("m.laz", {"only": ("carr",)}, "`only` 'carr' is unknown; is car meant"),
        ("m.laz", {"echo": "loud"}, "`echo` 'loud'"),
        ("m.laz", {"origin": ("mars",)}, "`origin` 'mars'"),
        ("m.laz", {"time": (3.0, 3.0)}, "`time` 3,3"),
        ("m.laz", {"bounds_deg": (25.0, 60.0, 24.0, 61.0)}, "`bounds_deg`"),
    ],
)
def test_bad_options_are_named(tmp_path, out, change, words):
    with pytest.raises(InputError, match=words):
        aggregate(dataset(tmp_path / "d"), tmp_path / out, options=MapOptions(**change))


def kept_by(tmp_path, data, **options):
    """The map with options; the instance of a test point is its row in its frame."""
    summary = aggregate(data, tmp_path / "m.laz", options=MapOptions(**options), overwrite=True)
    las = laspy.read(tmp_path / "m.laz")
    assert summary.points == len(las) == summary.points_in - sum(summary.left_out.values())
    return las


def test_points_keep_their_frame_and_time(tmp_path):
    las = kept_by(tmp_path, dataset(tmp_path / "d", first=3, frames=4))
    assert np.array_equal(las.frame, np.repeat([3, 4, 5, 6], 400))
    seconds = np.asarray(las.gps_time) - gps_seconds(START, np.zeros(1, np.int64))
    assert np.array_equal(np.floor(seconds * 10 + 1e-4), las.frame)


def test_a_time_selects_the_returns_within_it(tmp_path):
    data = dataset(tmp_path / "d")
    las = kept_by(tmp_path, data, time=(0.15, 0.32))
    seconds = np.asarray(las.gps_time) - gps_seconds(START, np.zeros(1, np.int64))
    assert seconds.min() >= 0.15
    assert seconds.max() < 0.32
    every = (np.arange(6)[:, None] * 0.1 + np.linspace(0, 0.099, 400)).ravel()
    assert len(las) == np.count_nonzero((every >= 0.15) & (every < 0.32))
    with pytest.raises(InputError, match="no frames at that time"):
        kept_by(tmp_path, data, time=(60.0, 70.0))


def test_a_box_and_a_polygon_select_the_returns_within_both(tmp_path):
    data = dataset(tmp_path / "d")
    xyz = np.concatenate([world_points(k, 400) for k in range(6)])
    lon, lat = FRAME.to_geographic(xyz[:, 0], xyz[:, 1])
    west, south, east, north = np.quantile(lon, 0.3), lat.min() - 1, np.quantile(lon, 0.8), np.median(lat)
    inside = (lon > west) & (lon < east) & (lat < north)
    assert len(kept_by(tmp_path, data, bounds_deg=(west, south, east, north))) == inside.sum()

    left, low, wide, high = lon.min() - 1e-5, lat.min() - 1e-5, np.ptp(lon), np.ptp(lat)
    corners = [[left, low], [left + wide, low], [left, low + high], [left, low]]
    area = {"type": "Polygon", "coordinates": [corners]}
    share = (lon - left) / wide + (lat - low) / high
    assert np.abs(share - 1).min() > 1e-7  # no point on the hypotenuse
    for document in (area, {"type": "Feature", "properties": {}, "geometry": area}):
        (tmp_path / "area.geojson").write_text(json.dumps(document))
        found = kept_by(tmp_path, data, polygon=tmp_path / "area.geojson")
        assert len(found) == np.count_nonzero(share < 1)
    both = kept_by(tmp_path, data, polygon=tmp_path / "area.geojson", bounds_deg=(west, south, east, north))
    assert len(both) == np.count_nonzero(inside & (share < 1))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"type": "Point", "coordinates": [24.9, 60.1]}', "no polygons"),
        ("not json", "not a readable GeoJSON"),
        (
            '{"type": "Polygon", "coordinates": [[[385000, 1], [385100, 1], [385100, 9], [385000, 1]]]}',
            "degrees",
        ),
    ],
)
def test_a_file_that_is_no_region_is_named(tmp_path, text, words):
    (tmp_path / "area.geojson").write_text(text)
    with pytest.raises(InputError, match=words):
        kept_by(tmp_path, dataset(tmp_path / "d", frames=1), polygon=tmp_path / "area.geojson")
    with pytest.raises(InputError, match="no such file"):
        kept_by(tmp_path, open_dataset(tmp_path / "d"), polygon=tmp_path / "none.geojson")


@pytest.mark.parametrize("kinds", [("laz",), ("pcd",)])
def test_echoes_and_classes_select_returns(tmp_path, kinds):
    data = dataset(tmp_path / "d", frames=1, kinds=kinds)
    path = next((tmp_path / "d" / "top").rglob("000000.*"))
    form = las if kinds == ("laz",) else pcd
    second = np.arange(400) % 3 == 1  # of three rows the first two are echoes of one pulse
    first_of_two = np.append(second[1:], False)
    table = dict(form.read(path)) | {
        "echo": np.where(second, 2, 1).astype(np.uint8),
        "echoes": np.where(second | first_of_two, 2, 1).astype(np.uint8),
    }
    info = {"info": LasInfo(CRS_OUT, Georeference(FRAME, CRS_OUT).offset, START)} if form is las else {}
    form.write(path, {k: table[k] for k in table if k != "classification"}, **info)
    rows_of = {
        "all": np.full(400, True),
        "first": ~second,
        "last": ~first_of_two,
        "single": ~second & ~first_of_two,
    }
    for echo, expected_rows in rows_of.items():
        found = kept_by(tmp_path, data, echo=echo)
        assert np.array_equal(found.instance, np.flatnonzero(expected_rows))
        assert np.array_equal(found.return_number, table["echo"][expected_rows])
    only = kept_by(tmp_path, data, only=("road",), echo="last")
    assert np.array_equal(only.instance, np.flatnonzero(~first_of_two & (table["label"] == Class.ROAD)))


def test_origins_are_those_of_the_truth_of_stages(tmp_path):
    data = dataset(tmp_path / "d", frames=2)
    truth = tmp_path / "d" / "top" / "truth"
    truth.mkdir()
    origin = np.where(np.arange(400) < 30, Origin.INJECTED, Origin.SURFACE).astype(np.uint8)
    np.savez(truth / "000001.npz", origin=origin)
    assert len(kept_by(tmp_path, data, origin=("injected",))) == 30
    assert len(kept_by(tmp_path, data, origin=("surface",))) == 770
    assert len(kept_by(tmp_path, data, origin=("surface", "injected"))) == 800
    assert set(kept_by(tmp_path, data, origin=("injected",)).frame) == {1}
    np.savez(truth / "000001.npz", origin=origin[:100])
    with pytest.raises(DatasetError, match=r"000001\.npz"):
        kept_by(tmp_path, data, origin=("injected",))


def test_origins_of_options_are_those_of_echoes():
    assert tuple(one.name.lower() for one in Origin) == ORIGINS


def test_noise_is_left_out_and_counted_by_default(tmp_path):
    data = dataset(tmp_path / "d", frames=2, kinds=("pcd",))
    path = tmp_path / "d" / "top" / "pcd" / "000001.pcd"
    table = dict(pcd.read(path))
    pcd.write(path, table | {"label": np.where(np.arange(400) < 7, Class.NOISE, table["label"])})
    summary = aggregate(data, tmp_path / "m.laz")
    assert (summary.points, summary.left_out["noise"], summary.points_in) == (793, 7, 800)
    kept = aggregate(data, tmp_path / "n.laz", options=MapOptions(noise=True))
    assert (kept.points, kept.left_out.get("noise", 0)) == (800, 0)


def test_moving_road_users_are_left_out_by_default_and_classes_on_request(tmp_path):
    data = dataset(tmp_path / "d", frames=2, kinds=("pcd",))
    path = tmp_path / "d" / "top" / "pcd" / "000001.pcd"
    table = dict(pcd.read(path))
    row = np.arange(400)
    klass = np.select([row < 5, row < 11, row < 14], [Class.CAR, Class.PEDESTRIAN, Class.VAN], table["label"])
    instance = np.select([row < 5, row < 11, row < 14], [7000, 7001, 7002], -1)
    pcd.write(path, table | {"label": klass.astype(np.uint16), "instance": instance.astype(np.int32)})
    boxes = tmp_path / "d" / "top" / "boxes" / "000001.csv"
    boxes.parent.mkdir()
    boxes.write_text("instance,moving\n7000,True\n7001,True\n7002,False\n")

    def counts(**options):
        made = aggregate(data, tmp_path / "m.laz", options=MapOptions(**options), overwrite=True)
        return made.points, made.left_out.get("moving", 0), made.left_out.get("without", 0)

    assert counts() == (789, 11, 0)
    assert counts(moving=True) == (800, 0, 0)
    assert counts(without=("vehicles",)) == (786, 6, 8)
    assert counts(without=("vehicles", "pedestrian"), moving=True) == (786, 0, 14)
    boxes.write_text("instance,moving\n7000,perhaps\n")
    with pytest.raises(DatasetError, match=r"000001\.csv"):
        counts()


@pytest.mark.parametrize(
    ("column", "value"), [("x", np.nan), ("y", np.inf), ("z", 1e30), ("label", 37603), ("label", 254)]
)
def test_a_cloud_with_impossible_points_is_refused_by_name(tmp_path, column, value):
    data = dataset(tmp_path / "d", frames=2, kinds=("pcd",))
    path = tmp_path / "d" / "top" / "pcd" / "000001.pcd"
    table = dict(pcd.read(path))
    values = np.where(np.arange(400) == 7, table[column].dtype.type(value), table[column])
    pcd.write(path, table | {column: values})
    with pytest.raises(DatasetError, match=r"000001\.pcd: damaged"):
        aggregate(data, tmp_path / "m.laz")
    assert not (tmp_path / "m.laz").exists()


def test_an_existing_map_is_replaced_only_on_request(tmp_path):
    data = dataset(tmp_path / "d", frames=1)
    (tmp_path / "m.ply").write_text("mine")
    with pytest.raises(InputError, match="`overwrite`"):
        aggregate(data, tmp_path / "m.ply")
    assert (tmp_path / "m.ply").read_text() == "mine"
    assert aggregate(data, tmp_path / "m.ply", overwrite=True).points == 400


def test_a_dataset_without_clouds_is_named(tmp_path):
    data = dataset(tmp_path / "d", frames=0)
    with pytest.raises(DatasetError, match="no clouds"):
        aggregate(data, tmp_path / "m.laz")
    with pytest.raises(DatasetError, match=r"no dataset\.json"):
        open_dataset(tmp_path)
    manifest = json.loads((data.path / "dataset.json").read_text())
    (data.path / "dataset.json").write_text(json.dumps(manifest | {"schema": 7}))
    with pytest.raises(DatasetError, match=r"schema version 7.*a newer version wrote it: upgrade"):
        open_dataset(data.path)
    assert isinstance(replace(data, path=Path("x")).path, Path)


def test_a_thinned_map_of_frames_without_wanted_returns_is_empty(tmp_path):
    options = MapOptions(voxel=0.5, only=("water",))
    assert aggregate(dataset(tmp_path / "d"), tmp_path / "m.laz", options=options).points == 0
    assert len(laspy.read(tmp_path / "m.laz")) == 0

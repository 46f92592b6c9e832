"""Recorded drives: georeferencing, reproducibility, resuming after a kill."""

import csv
import hashlib
import json
import os
import shutil
import signal
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from threading import Event

import laspy
import numpy as np
import pytest
from helpers.drives import PLAIN
from helpers.mutations import mutated
from helpers.programs import ENVIRONMENT, command
from pyproj import CRS, Transformer
from scipy.spatial.transform import Rotation

from geoscene.classes import Class
from geoscene.errors import GeosceneError
from geoscene.scene import open_scene
from lidar.dataset.formats import read_table
from lidar.dataset.layout import open_dataset, prepare
from lidar.errors import DatasetError, InputError, LidarError
from lidar.geometry.attitude import quat_from_euler
from lidar.motion.road_drive import RoadDriveOptions, plan_road_drive
from lidar.motion.vehicle import load_vehicle
from lidar.simulation.drive import drive
from lidar.simulation.frame_loop import _pool
from lidar.traffic.ego_drive import drive_with_signals
from lidar.traffic.options import TrafficOptions


@pytest.fixture(scope="module")
def dataset(plain_drive):
    return open_dataset(plain_drive)


def digest(folder):
    """Name and hash of every file of a dataset."""
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def distance_to_triangles(points, triangles):
    """Distance (n,) of points (n, 3) to the nearest of triangles (m, 3, 3)."""
    best = np.full(len(points), np.inf)
    for a, b, c in triangles:
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length > 0:
            unit = normal / length
            height = (points - a) @ unit
            foot = points - height[:, None] * unit
            inside = np.ones(len(points), bool)
            for p, q in ((a, b), (b, c), (c, a)):
                inside &= np.cross(q - p, foot - p) @ unit >= 0
            best = np.where(inside, np.minimum(best, np.abs(height)), best)
        for p, q in ((a, b), (b, c), (c, a)):
            along = np.clip((points - p) @ (q - p) / max((q - p) @ (q - p), 1e-30), 0, 1)
            best = np.minimum(best, np.linalg.norm(points - p - along[:, None] * (q - p), axis=1))
    return best


def solids_by_feature(scene):
    out = {}
    for tile in scene.tiles():
        mesh = tile.mesh
        corners = mesh.vertices[mesh.faces] + tile.origin
        for feature in np.unique(mesh.feature[mesh.closed]):
            out[int(feature)] = corners[(mesh.feature == feature) & mesh.closed]
    return out


@pytest.mark.full
@pytest.mark.parametrize("crs", ["local", "utm"])
def test_returns_from_buildings_lie_on_those_buildings_after_georeferencing_and_back(
    crs, scene, scene_utm, tmp_path
):
    where = scene if crs == "local" else scene_utm
    drive(where, tmp_path / "d", options=replace(PLAIN, duration=0.2, formats=("laz",), relief="off"))
    solids = solids_by_feature(where)
    frame = where.manifest["frame"]
    near, count = 0, 0
    for path in sorted((tmp_path / "d" / "lidar_top" / "laz").glob("*.laz")):
        las = laspy.read(path)
        # an independent inverse: the file's own CRS to degrees, degrees to the scene's CRS
        to_degrees = Transformer.from_crs(las.header.parse_crs(), CRS.from_epsg(4326), always_xy=True)
        to_scene = Transformer.from_crs(CRS.from_epsg(4326), CRS.from_wkt(frame["wkt"]), always_xy=True)
        x, y = to_scene.transform(*to_degrees.transform(np.asarray(las.x), np.asarray(las.y)))
        points = np.column_stack([x - frame["origin"][0], y - frame["origin"][1], np.asarray(las.z)])
        building = np.asarray(las.classification) == 6
        assert building.sum() > 1000
        for feature in np.unique(np.asarray(las.instance)[building]):
            mine = points[building & (np.asarray(las.instance) == feature)]
            distance = distance_to_triangles(mine, solids[int(feature)])
            near += int((distance < 0.01).sum())
            count += len(mine)
    assert near / count > 0.999


@pytest.mark.full
def test_the_georeferencing_error_budget_is_half_a_millimetre(scene, tmp_path):
    drive(scene, tmp_path / "d", options=replace(PLAIN, duration=0.2))
    drive(scene, tmp_path / "e", options=replace(PLAIN, duration=0.2, exact=True))
    for path in sorted((tmp_path / "d" / "lidar_top" / "laz").glob("*.laz")):
        quick, exact = laspy.read(path), laspy.read(tmp_path / "e" / "lidar_top" / "laz" / path.name)
        for axis in "xyz":
            assert np.abs(np.asarray(quick[axis]) - np.asarray(exact[axis])).max() <= 0.001 + 1e-9


@pytest.mark.full
def test_any_number_of_workers_gives_the_same_bytes(scene, dataset, tmp_path):
    drive(scene, tmp_path / "b", options=replace(PLAIN, workers=1))
    assert digest(tmp_path / "b") == digest(dataset.path)


@pytest.mark.full
def test_a_killed_drive_resumes_and_gives_the_same_bytes(scene, tmp_path):
    dataset = open_dataset(drive(scene, tmp_path / "whole", options=replace(PLAIN, duration=4.0)).path)
    out = tmp_path / "c"
    options = "--route random --rig vlp16 --duration 4 --seed 3 --format pcd,laz"
    program = command("lidar", "drive", scene.path, "-o", out, *options.split())
    process = subprocess.Popen(program, env=ENVIRONMENT)
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not list(out.glob("lidar_top/laz/*5.laz")):
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert json.loads((out / "dataset.json").read_text())["frames_done"] == 0
    assert len(list(out.glob("lidar_top/laz/0*.laz"))) < dataset.frames
    subprocess.run(program, env=ENVIRONMENT, check=True)
    done = {name: value for name, value in digest(out).items() if ".part" not in name}
    assert done == digest(dataset.path)


def test_a_drive_with_other_options_is_not_overwritten(scene, dataset):
    with pytest.raises(DatasetError, match=r"other options: seed 3 \(now 4\);.*`overwrite`"):
        drive(scene, dataset.path, options=replace(PLAIN, seed=4))
    assert digest(dataset.path)


def test_pose_rows_agree_with_each_other_and_with_the_earth(scene, dataset):
    with (dataset.path / "poses.csv").open() as file:
        rows = list(csv.DictReader(file))
    names = "timestamp frame x y z alpha beta gamma qx qy qz qw lon lat h"
    assert list(rows[0]) == names.split()
    assert len(rows) == dataset.frames
    stamps = [datetime.fromisoformat(r["timestamp"]) for r in rows]
    assert stamps[0] == dataset.start.astimezone(UTC)
    steps = np.diff([s.timestamp() for s in stamps])
    np.testing.assert_allclose(steps, 0.1, atol=1e-5)
    columns = {k: np.array([float(r[k]) for r in rows]) for k in rows[0] if k != "timestamp"}
    lon, lat = scene.frame.to_geographic(columns["x"], columns["y"])
    np.testing.assert_allclose(lon, columns["lon"], atol=1e-12)
    np.testing.assert_allclose(lat, columns["lat"], atol=1e-12)
    quat = quat_from_euler(columns["alpha"], columns["beta"], gamma=columns["gamma"])
    given = np.column_stack([columns[k] for k in ("qx", "qy", "qz", "qw")])
    np.testing.assert_allclose(np.abs((quat * given).sum(axis=1)), 1.0, atol=1e-12)


def test_intensity_depends_on_material_and_incidence(dataset):
    cloud = read_table(dataset.path / "lidar_top" / "pcd" / "000005.pcd")
    wall = cloud["label"] == Class.BUILDING
    steep = wall & (cloud["incidence"] < 0.5)
    grazing = wall & (cloud["incidence"] > 1.2)
    assert cloud["intensity"][steep].mean() > 1.5 * cloud["intensity"][grazing].mean()
    assert len(np.unique(cloud["intensity"])) > 50


def test_every_point_of_a_revolution_has_its_own_time_and_ring(dataset):
    cloud = read_table(dataset.path / "lidar_top" / "pcd" / "000005.pcd")
    assert (np.diff(cloud["time_ns"].astype(np.int64)) > 0).all()
    assert cloud["time_ns"].max() < 100_000_000 + 55_296  # its last block may end after it
    assert set(np.unique(cloud["ring"])) == set(range(16))
    azimuths = [
        read_table(dataset.path / "lidar_top" / "pcd" / f"{k:06d}.pcd")["time_ns"][:1] for k in (5, 6, 7)
    ]
    assert len({int(a[0]) for a in azimuths}) > 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rig": "nonsense"}, "nonsense"),
        ({"formats": ("pcd", "xyz")}, "xyz"),
        ({"duration": -1.0}, "duration"),
        ({"route": [(10.0, 10.0), (10.1, 10.1)]}, "10.0"),
        ({"vehicle": "ship"}, "ship"),
    ],
)
def test_invalid_drives_are_refused_in_one_line(scene, tmp_path, change, words):
    with pytest.raises(InputError, match=words) as error:
        drive(scene, tmp_path / "x", options=replace(PLAIN, **change))
    assert "\n" not in str(error.value)
    assert not (tmp_path / "x").exists()


def test_a_drive_that_fails_before_its_first_frame_leaves_nothing(scene, tmp_path):
    broken = tmp_path / "broken"
    shutil.copytree(scene.path, broken)
    for tile in (broken / "tiles").iterdir():
        tile.write_bytes(tile.read_bytes()[:300])
    with pytest.raises((GeosceneError, LidarError)):
        drive(open_scene(broken), tmp_path / "d", options=replace(PLAIN, duration=1.0))
    assert not (tmp_path / "d").exists()


def test_a_written_scene_opens(scene):
    again = open_scene(scene.path)
    assert again.frame == scene.frame
    assert again.tile_indices == scene.tile_indices


@pytest.mark.full
def test_traffic_is_labelled_boxed_and_the_same_for_any_number_of_workers(scene, tmp_path):
    options = replace(
        PLAIN, duration=0.5, formats=("pcd",), traffic=TrafficOptions(vehicles=30.0, parked=1.0)
    )
    drive(scene, tmp_path / "a", options=options)
    drive(scene, tmp_path / "b", options=replace(options, workers=1))
    assert digest(tmp_path / "a") == digest(tmp_path / "b")
    with (tmp_path / "a" / "boxes.csv").open() as file:
        rows = list(csv.DictReader(file))
    hit = [row for row in rows if int(row["points"]) > 30]
    assert len(hit) > 5
    first = max(stop for _, stop in scene.layers.values())
    trajectory = open_dataset(tmp_path / "a").trajectory()
    calibration = json.loads((tmp_path / "a" / "calibration.json").read_text())
    mount = np.array(calibration["sensors"]["lidar_top"]["vehicle_from_sensor"])
    for row in hit[:: max(1, len(hit) // 20)]:
        frame = int(row["frame"])
        cloud = read_table(tmp_path / "a" / "lidar_top" / "pcd" / f"{frame:06d}.pcd")
        on_it = cloud["instance"] == int(row["instance"])
        assert on_it.sum() == int(row["points"])
        assert int(row["instance"]) >= first
        xyz = np.column_stack([cloud[k][on_it] for k in "xyz"])
        times = int(row["time_ns"]) + cloud["time_ns"][on_it].astype(np.int64)
        placed = trajectory.place(xyz, times, translation=mount[:3, 3], rotation=mount[:3, :3])
        centre = np.array([float(row[k]) for k in "xyz"])
        velocity = np.array([float(row[k]) for k in ("vx", "vy", "vz")])
        away = placed - centre - (times - int(row["time_ns"]))[:, None] * 1e-9 * velocity
        turn = Rotation.from_quat([float(row[k]) for k in ("qx", "qy", "qz", "qw")])
        inside = np.abs(turn.inv().apply(away)) <= np.array(
            [float(row[k]) / 2 + 0.15 for k in ("length", "width", "height")]
        )
        assert inside.all(axis=1).mean() > 0.98


@pytest.mark.full
def test_a_random_drive_starts_and_ends_at_speed_by_default(scene):
    """Also a record of a few seconds, which would otherwise show a parked car."""
    for seed in (0, 1, 2):
        options = replace(PLAIN, duration=3.0, seed=seed)
        speeds = {}
        for from_rest in (False, True):
            on_roads = RoadDriveOptions("car", seed=seed, duration=3.0, from_rest=from_rest)
            travel = plan_road_drive(scene, "random", options=on_roads)
            trajectory = drive_with_signals(
                travel.path, load_vehicle("car"), graph=scene.road_graph(), seed=seed, bounds=scene.bounds,
                duration=3.0, at_speed=travel.at_speed,
            )  # fmt: skip
            speeds[from_rest] = np.linalg.norm(trajectory.velocity, axis=1)
        assert speeds[False][0] > 2.0
        assert speeds[False].mean() > 2.0
        assert speeds[True][0] == 0.0
        assert speeds[True][-1] < 2e-3
        assert options.recipe(scene) != replace(options, from_rest=True).recipe(scene)


@pytest.mark.full
def test_the_number_of_threads_does_not_exceed_the_cores(scene, tmp_path, monkeypatch):
    sizes = []

    class Pool(ThreadPoolExecutor):
        def __init__(self, size):
            sizes.append(size)
            super().__init__(size)

    monkeypatch.setattr("lidar.simulation.frame_loop.ThreadPoolExecutor", Pool)
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    for workers in (1, 64):
        drive(scene, tmp_path / str(workers), options=replace(PLAIN, duration=0.2, workers=workers))
    assert sizes == [1, 2]


def test_an_interruption_waits_for_no_frame_and_an_error_for_the_running_ones():
    release, frames = Event(), []
    with pytest.raises(KeyboardInterrupt), _pool(1) as pool:  # noqa: PT012
        frames = [pool.submit(release.wait, 60) for _ in range(3)]
        raise KeyboardInterrupt
    assert not frames[0].done()
    assert frames[2].cancelled()
    release.set()
    frames.clear()

    def until_the_last_is_cancelled():
        while not (frames and frames[-1].cancelled()):
            time.sleep(0.01)

    with pytest.raises(OSError, match="disk"), _pool(1) as pool:  # noqa: PT012
        frames += [pool.submit(work) for work in (until_the_last_is_cancelled, release.wait, release.wait)]
        raise OSError("disk")
    assert [frame.cancelled() for frame in frames] == [False, True, True]
    assert frames[0].done()


@pytest.mark.full
@pytest.mark.parametrize("damage", ["cut", "changed", "removed", "journal"])
def test_a_resumed_drive_makes_damaged_frames_anew(scene, dataset, damage, tmp_path):
    shutil.copytree(dataset.path, tmp_path / "again")
    victim = sorted((tmp_path / "again").glob("*/pcd/*.pcd"))[1]
    data = victim.read_bytes()
    if damage == "removed":
        victim.unlink()
    elif damage == "journal":
        (tmp_path / "again" / "frames.csv").write_bytes(b"\xffsensor\n1,2")
    else:
        victim.write_bytes(data[:-100] if damage == "cut" else data[:-1] + bytes([data[-1] ^ 1]))
    drive(scene, tmp_path / "again", options=PLAIN)
    assert digest(tmp_path / "again") == digest(dataset.path)


def test_a_finished_drive_is_not_planned_again(scene, dataset, tmp_path, monkeypatch):
    out = tmp_path / "again"
    shutil.copytree(dataset.path, out)
    (out / "notes.txt").write_text("mine")
    planned = []
    monkeypatch.setattr("lidar.simulation.drive.plan_drive", lambda *_, **__: planned.append(1))
    found = drive(scene, out, options=PLAIN)
    manifest = dataset.manifest
    assert not planned
    assert (found.frames, found.written) == (manifest["frames"], 0)
    assert found.points == manifest["points"]
    assert found.resumed == sum(manifest["sensor_frames"].values())
    assert (found.duration, found.length) == (manifest["duration_ns"] / 1e9, manifest["length_m"])
    with pytest.raises(AttributeError):  # what is planned is None here
        drive(scene, out, options=PLAIN, overwrite=True)
    (out / "poses.csv").write_text("")
    with pytest.raises(AttributeError):
        drive(scene, out, options=PLAIN)


def test_a_replaced_dataset_keeps_the_files_of_others(dataset, tmp_path, caplog):
    copy = tmp_path / "again"
    shutil.copytree(dataset.path, copy)
    foreign = [copy / "notes.csv", copy / "thesis" / "000001.pcd", copy / "lidar_top" / "pcd" / "mine.txt"]
    for path in foreign:
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine")
    prepare(copy, {"seed": 5}, overwrite=True)
    assert sorted(path for path in copy.rglob("*") if path.is_file()) == sorted(foreign)
    assert all(f"{path}: kept" in caplog.text for path in foreign)


@pytest.mark.parametrize("name", ["dataset.json", "calibration.json", "trajectory.csv", "timestamps.csv"])
def test_a_damaged_dataset_is_refused_with_a_clear_error(dataset, name, tmp_path):
    shutil.copytree(dataset.path, tmp_path / "again")
    victim = next((tmp_path / "again").rglob(name))
    data = victim.read_bytes()
    for seed in range(25):
        victim.write_bytes(mutated(data, np.random.default_rng(seed)))
        with suppress(GeosceneError, LidarError):
            opened = open_dataset(tmp_path / "again")
            for sensor in opened.sensors():
                opened.sample_times(sensor)
            opened.trajectory()

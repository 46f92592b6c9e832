"""Traffic simulated by SUMO, with the ego vehicle as one of its vehicles."""

import tempfile

import numpy as np
import pytest
import rasterio
import shapely
from cyclopts import CoercionError

from geoscene.errors import MissingExtraError
from lidar.cli import app
from lidar.motion.motion import drive_path
from lidar.motion.road_drive import plan_road_drive
from lidar.motion.vehicle import load_vehicle
from lidar.traffic.sumo import SumoOptions, drive_in_sumo
from lidar.traffic.sweep import rectangles
from lidar.world.actors import existing_actors, states

CAR = load_vehicle("car")
SECONDS = 8.0


@pytest.fixture(scope="module")
def path(scene):
    return plan_road_drive(scene, "random", vehicle="car", seed=2, duration=SECONDS).path


def simulated(scene, path, seed=2):
    options = SumoOptions(vehicles=20.0, cyclists=3.0, pedestrians=20.0, parked=0.3, radius=150.0)
    return drive_in_sumo(
        scene, scene.road_graph(), path=path, vehicle=CAR, seed=seed, options=options, duration=SECONDS,
        first=drive_path(path, CAR, duration=SECONDS, at_speed=True), at_speed=True,
    )  # fmt: skip


@pytest.fixture(scope="module")
def drive(scene, path):
    pytest.importorskip("sumo", reason="the extra sumo is not installed")
    return simulated(scene, path)


def test_the_ego_vehicle_follows_its_path_and_touches_no_road_user(drive, path):
    ego, actors = drive
    assert ego.duration_ns == SECONDS * 1e9
    line = shapely.linestrings(path.position[:, :2])
    assert shapely.distance(line, shapely.points(ego.position[:, :2])).max() < 0.05
    assert {"adult", "hatchback"} <= set(actors.kind[~actors.parked])
    for t in range(0, ego.duration_ns, 500_000_000):
        rows = existing_actors(actors, t, end_ns=t)
        at = states(actors, rows, time_ns=t)
        length, width, _ = actors.size[rows].T
        boxes = rectangles(at.position[:, :2], at.angles[:, 0], length=length, width=width)
        pose = ego.at([t])
        forward = pose.rotation[:, :2, 0]
        middle = pose.position[:, :2] + (CAR.length / 2 - CAR.rear_overhang) * forward
        own = rectangles(middle, np.arctan2(forward[:, 1], forward[:, 0]), length=CAR.length, width=CAR.width)
        assert not shapely.intersects(own, boxes).any()


def test_the_same_seed_gives_the_same_traffic_and_no_file_remains(drive, scene, path, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    ego, actors = simulated(scene, path)
    assert ego.position.tobytes() == drive[0].position.tobytes()
    assert actors.position.tobytes() == drive[1].position.tobytes()
    assert simulated(scene, path, seed=3)[1].position.tobytes() != actors.position.tobytes()
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("drive")
def test_gdal_finds_its_own_database_of_reference_systems_beside_sumo():
    assert rasterio.CRS.from_epsg(32635).is_projected


def test_without_sumo_the_extra_is_named(scene, path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "sumo", None)
    with pytest.raises(MissingExtraError, match=r"geoscene\[sumo\]"):
        simulated(scene, path)


def test_unknown_words_after_sumo_are_named(scene, tmp_path):
    words = ["drive", str(scene.path), "--route", "random", "-o", str(tmp_path / "d"), "-q"]
    with pytest.raises(CoercionError, match="parameter 'speed' is unknown"):
        app([*words, "--traffic", "sumo,speed=3"], exit_on_error=False, result_action="return_value")

"""Flights over scenes, and replays of recorded poses."""

import csv
import json
import shutil
from dataclasses import replace

import laspy
import numpy as np
import pytest
import shapely
from helpers import DEMO_BOX
from helpers.programs import run_program
from helpers.rasters import write_slope

from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.sources import demo_path, read_osm
from lidar.dataset.formats import read_table
from lidar.dataset.layout import open_dataset
from lidar.errors import FormatError, InputError, RouteError
from lidar.geometry.trajectory_files import read_trajectory
from lidar.motion.replay import read_replay
from lidar.motion.vehicle import load_vehicle
from lidar.options.drive import DriveOptions
from lidar.sensors.rig.devices import cameras, scanners
from lidar.sensors.rig.specs import load_rig
from lidar.simulation.drive import drive
from lidar.simulation.flight_planning import survey_area, swath
from lidar.simulation.plan import plan_motion
from lidar.world.ground import ground_heights


def flight(scene, rig="drone", **change):
    options = DriveOptions(rig=rig, **change)
    kit = load_rig(rig)
    return planned(scene, options, kit).trajectory


def planned(scene, options, kit):
    return plan_motion(
        scene, options, vehicle=load_vehicle(kit.vehicle), sensors=[*scanners(kit), *cameras(kit)]
    )


@pytest.mark.full
def test_scanners_are_off_between_survey_lines_by_default(scene, tmp_path):
    options = DriveOptions(rig="drone", survey="all", altitude=90.0, overlap=0.0, formats=("pcd",))
    kit = load_rig("drone")
    whole = planned(scene, options, kit)
    xy = whole.trajectory.position[:, :2]
    since = whole.trajectory.time_ns[:, None]
    on = ((since >= whole.scanning_ns[:, 0]) & (since <= whole.scanning_ns[:, 1])).any(axis=1)
    track = shapely.linestrings(xy[on])
    half = swath(scanners(kit), 90.0) / 2
    area = survey_area(scene, "all")
    assert shapely.difference(area, shapely.buffer(track, half)).area < 0.002 * area.area
    course = np.arctan2(*whole.trajectory.velocity[:, 1::-1].T)
    turning = np.abs(np.gradient(np.unwrap(course), 0.01)) > 0.2
    assert not on[turning & (np.hypot(*whole.trajectory.velocity[:, :2].T) > 1.0)].any()
    assert 0.2 < on.mean() < 0.95
    assert planned(scene, replace(options, turns=True), kit).scanning_ns is None
    with pytest.raises(RouteError, match="before the first line"):
        planned(scene, replace(options, duration=0.5), kit)

    first = int(whole.scanning_ns[0, 0]) / 1e9
    summary = drive(scene, tmp_path / "x", options=replace(options, duration=first + 1.35))
    files = sorted((tmp_path / "x").glob("*/pcd/*.pcd"))
    assert len(files) == summary.frames
    sizes = [len(read_table(file)["x"]) for file in files]
    assert sizes[:3] == [0, 0, 0]
    assert sizes[-1] > 0


@pytest.mark.full
def test_a_survey_flies_over_every_part_of_its_area(scene):
    trajectory = flight(scene, survey="all", altitude=90.0, overlap=0.2)
    kit = load_rig("drone")
    half = swath([*scanners(kit), *cameras(kit)], 90.0) / 2
    track = shapely.linestrings(trajectory.position[:, :2])
    area = survey_area(scene, "all")
    assert shapely.difference(area, shapely.buffer(track, half)).area < 0.002 * area.area
    height = trajectory.position[:, 2]
    level = np.abs(height - np.median(height)) < 0.2  # the height of a kerb, and of the camber
    assert level.mean() > 0.98  # but over the ramp of a garage, into which it descends
    assert trajectory.position[0, 2] == pytest.approx(90.0, abs=3.0)  # the scene is level


@pytest.fixture(scope="module")
def hillside(tmp_path_factory):
    """A scene on a slope of about one in three."""
    folder = tmp_path_factory.mktemp("hillside")
    box = (24.9430, 60.1669, 24.9455, 60.1684)
    raster = write_slope(folder / "hill.tif", box, rise=10.0)
    osm = read_osm(demo_path(), bounds=box)
    return build(osm, folder / "scene", options=BuildOptions(dem=(str(raster),), use="lidar"))


def test_drones_survey_at_a_height_above_the_ground_below_them_and_aircraft_fly_level(hillside):
    drone = flight(hillside, survey="all", altitude=60.0).position
    xmin, ymin, xmax, ymax = hillside.bounds
    inside = (np.abs(drone[:, :2] - [(xmin + xmax) / 2, (ymin + ymax) / 2]) < 50.0).all(axis=1)
    over = drone[inside][::50]
    ground = ground_heights(hillside, over - [0.0, 0.0, 60.0], above=30.0, below=30.0)
    known = np.isfinite(ground)  # other surfaces, such as those of bridges, are none
    assert known.mean() > 0.9
    assert np.ptp(ground[known]) > 10.0
    np.testing.assert_allclose((over[:, 2] - ground)[known], 60.0, atol=3.0)
    level = flight(hillside, "aircraft", survey="all", altitude=600.0).position[:, 2]
    assert np.ptp(level) < 1e-6
    assert 537.0 < level[0] - drone[:, 2].max() < 560.0


@pytest.mark.full
@pytest.mark.parametrize("side", ["west", "south", "east", "north"])
def test_beyond_the_scene_the_ground_is_that_of_the_nearest_border(hillside, side):
    xmin, ymin, xmax, ymax = hillside.bounds
    along = np.linspace(0.2, 0.8, 3)
    line = {
        "west": [xmin + 0 * along, ymin + (ymax - ymin) * along, -1.0, 0.0],
        "south": [xmin + (xmax - xmin) * along, ymin + 0 * along, 0.0, -1.0],
        "east": [xmax + 0 * along, ymin + (ymax - ymin) * along, 1.0, 0.0],
        "north": [xmin + (xmax - xmin) * along, ymax + 0 * along, 0.0, 1.0],
    }

    def heights(out):
        x, y, dx, dy = line[side]
        lon, lat = hillside.frame.to_geographic(x + out * dx, y + out * dy)
        route = list(zip(lat.tolist(), lon.tolist(), strict=True))
        position = flight(hillside, route=route, altitude=60.0).position
        return position[np.linspace(0, len(position) - 1, 50).astype(int), 2]

    within, beyond = heights(-0.1), heights(40.0)
    np.testing.assert_allclose(beyond, within, atol=0.5)
    assert np.ptp(within) > 10.0


def test_the_swath_follows_from_the_field_of_view():
    aircraft = load_rig("aircraft")
    # 30 degrees to each side
    assert swath(scanners(aircraft), 600.0) == pytest.approx(2 * 600 * np.tan(np.radians(30)), rel=0.05)
    with pytest.raises(RouteError, match="is 6000 m"):
        swath(scanners(aircraft), 7000.0)
    with pytest.raises(RouteError, match="needs a rig with a scanner or a camera"):
        swath([], 60.0)


def test_more_overlap_gives_more_strips_and_areas_come_from_files_or_boxes(scene, tmp_path):
    wide, narrow = (flight(scene, survey="all", altitude=90.0, overlap=o) for o in (0.0, 0.7))
    assert narrow.duration_ns > 2 * wide.duration_ns
    west, south, east, north = 24.942, 60.166, 24.945, 60.168
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    (tmp_path / "a.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    of_file = survey_area(scene, str(tmp_path / "a.geojson"))
    of_box = survey_area(scene, f"{west},{south},{east},{north}")
    assert shapely.symmetric_difference(of_file, of_box).area < 1e-6 * of_box.area
    assert of_box.area == pytest.approx(166.7 * 222.7, rel=0.01)


def test_a_flight_passes_over_its_waypoints_above_the_ground(scene, tmp_path):
    places = [(60.1660, 24.9420), (60.1680, 24.9450), (60.1670, 24.9465)]
    trajectory = flight(scene, route=places, altitude=70.0)
    x, y = scene.frame.from_geographic(*np.array(places)[:, ::-1].T)
    for place in zip(x, y, strict=True):
        assert np.hypot(*(trajectory.position[:, :2] - place).T).min() < 5.0
    assert trajectory.position[:, 2] == pytest.approx(70.0, abs=3.0)
    line = {"type": "LineString", "coordinates": [[lon, lat, 95.0] for lat, lon in places]}
    (tmp_path / "way.geojson").write_text(json.dumps(line))
    assert flight(scene, route=tmp_path / "way.geojson").position[:, 2] == pytest.approx(95.0, abs=1e-6)


def test_a_drone_flies_over_streets_and_scans_them_by_default(scene, tmp_path):
    summary = drive(scene, tmp_path / "d", options=DriveOptions(rig="drone", duration=1.0, formats=("laz",)))
    assert summary.points["lidar_down"] > 50_000
    las = laspy.read(next((tmp_path / "d" / "lidar_down" / "laz").glob("*5.laz")))
    assert np.isin(11, las.classification)  # road surface
    position = open_dataset(tmp_path / "d").trajectory().position
    assert position[:, 2].min() > 55.0


@pytest.mark.parametrize(
    ("rig", "change", "says"),
    [
        ("drone", {"survey": "all", "altitude": 12.0}, "would collide with the scene"),
        ("vlp16", {"survey": "all"}, "a car does not"),
        ("vlp16", {"altitude": 50.0}, "`altitude` is for aircraft"),
        ("aircraft", {"route": "random"}, "cannot follow streets"),
        ("drone", {"survey": "nowhere.geojson"}, "neither all"),
        ("drone", {"survey": "3,4,5,6"}, "does not touch"),
        ("drone", {"survey": "all", "altitude": 800.0}, "is 450 m"),
        ("drone", {"survey": "all", "altitude": 60.0, "overlap": 0.9999}, "lower the `overlap`"),
        ("drone", {"survey": "20,55,30,65"}, "takes over 4 hours"),
        ("drone", {"route": [(60.1669, 24.9446), (-60.1669, 24.9446)]}, "point 2 lies 13[0-9]* km"),
    ],
)
def test_impossible_flights_are_refused_in_one_line(scene, rig, change, says):
    with pytest.raises(InputError, match=says) as error:
        flight(scene, rig, **change)
    assert "\n" not in str(error.value)


# ---------------------------------------------------------------------------------------------- replays


def test_a_replayed_trajectory_is_bit_identical(scene, plain_drive, tmp_path):
    options = DriveOptions(rig="vlp16", route=plain_drive / "trajectory.csv", formats=("pcd",), duration=0.5)
    drive(scene, tmp_path / "b", options=options)
    again = read_trajectory(tmp_path / "b" / "trajectory.csv")
    first = read_trajectory(plain_drive / "trajectory.csv").until(500_000_000)
    np.testing.assert_array_equal(again.position, first.position)
    for k in (0, 4):
        name = f"lidar_top/pcd/{k:06d}.pcd"
        assert (tmp_path / "b" / name).read_bytes() == (plain_drive / name).read_bytes()


def test_replayed_poses_agree_within_centimetres(scene, plain_drive):
    again = read_replay(plain_drive / "poses.csv", scene.frame)
    first = read_trajectory(plain_drive / "trajectory.csv")
    span = again.time_ns[again.time_ns < 800_000_000]
    np.testing.assert_allclose(again.at(span).position, first.at(span).position, atol=0.02)
    np.testing.assert_allclose(again.at(span).rotation, first.at(span).rotation, atol=0.01)


@pytest.mark.parametrize(("rows", "word"), [(1, "row 2 is"), (None, "area")])
def test_a_damaged_trajectory_is_refused(scene_utm, plain_drive, tmp_path, rows, word):
    """A single place far away needs an impossible speed; where all are, the axes are not known."""
    shutil.copy(plain_drive / "dataset.json", tmp_path)
    first, *lines = (plain_drive / "trajectory.csv").read_text().splitlines()
    for k, line in enumerate(lines[:rows]):
        time, _, *rest = line.split(",")
        lines[k] = ",".join([time, "1e12", *rest])
    (tmp_path / "trajectory.csv").write_text("\n".join([first, *lines]))
    with pytest.raises(FormatError, match=word):
        read_replay(tmp_path / "trajectory.csv", scene_utm.frame)


@pytest.mark.parametrize("name", ["trajectory.csv", "poses.csv"])
def test_a_drive_replayed_in_another_frame_keeps_its_geographic_positions(
    scene, scene_utm, plain_drive, name
):
    here, there = (
        read_replay(plain_drive / name, scene.frame),
        read_replay(plain_drive / name, scene_utm.frame),
    )
    lon, lat = scene.frame.to_geographic(*here.position[::20, :2].T)
    np.testing.assert_allclose(
        scene_utm.frame.to_geographic(*there.position[::20, :2].T), (lon, lat), atol=1e-9
    )
    # one metre ahead of the vehicle is the same place too: axes are turned by the convergence
    ahead = np.tile([1.0, 0.0, 0.0], (len(lon), 1))
    one, other = (t.at(t.time_ns[::20]).place(ahead) for t in (here, there))
    found = scene.frame.from_geographic(*scene_utm.frame.to_geographic(*other[:, :2].T))
    np.testing.assert_allclose(np.column_stack(found), one[:, :2], atol=1e-4)


def test_a_replay_that_never_comes_near_the_scene_is_refused(scene, plain_drive, tmp_path):
    first, *lines = (plain_drive / "trajectory.csv").read_text().splitlines()
    column = first.split(",").index("x")
    rows = [line.split(",") for line in lines]
    moved = [[*row[:column], str(float(row[column]) + 5000.0), *row[column + 1 :]] for row in rows]
    (tmp_path / "trajectory.csv").write_text("\n".join([first, *map(",".join, moved)]))
    options = DriveOptions(rig="vlp16", route=tmp_path / "trajectory.csv", formats=("pcd",))
    with pytest.raises(RouteError, match=r"comes no closer than 4,[0-9]{3} m"):
        drive(scene, tmp_path / "x", options=options)
    assert not (tmp_path / "x").exists()


def test_tables_without_poses_are_refused(scene, tmp_path):
    (tmp_path / "x.csv").write_text("a,b\n1,2\n")
    with pytest.raises(
        InputError, match=r"has a, b; no timestamp, lon, lat, h, qx, qy, qz, qw; a CSV file is"
    ):
        read_replay(tmp_path / "x.csv", scene.frame)
    with pytest.raises(RouteError, match="does not exist"):
        read_replay(tmp_path / "y.csv", scene.frame)


def test_poses_of_other_programs_need_no_dataset(scene, plain_drive, tmp_path):
    shutil.copy(plain_drive / "poses.csv", tmp_path / "poses.csv")
    with (tmp_path / "poses.csv").open() as file:
        rows = list(csv.DictReader(file))
    trajectory = read_replay(tmp_path / "poses.csv", scene.frame)
    assert trajectory.position[0, 0] == pytest.approx(float(rows[0]["x"]), abs=1e-6)


# ------------------------------------------------------------------------------------- the command line


def program(*words, cwd):
    return run_program("lidar", *words, cwd=cwd)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--route", "random", "--seed", "-1"], "--seed -1"),
        (["--route", "random", "--set", "ray=7"], "is rays"),
        (["--route", "random", "--survey", "all"], "one of --route and --survey"),
        ([], "one of --route and --survey"),
        (["--survey", "all", "--rig", "vlp16"], "a car does not"),
        (["--route", "random", "--deskew", "noon"], "start, middle, end"),
    ],
)
def test_invalid_flight_options_end_with_one_line_and_exit_code_2(scene, tmp_path, words, says):
    done = program("drive", scene.path, *words, "-o", "x", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1, done.stderr
    assert says in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_scene_without_roads_can_be_flown_over_but_not_driven_through(tmp_path):
    build(
        read_osm(demo_path(), bounds=DEMO_BOX), tmp_path / "bare", options=BuildOptions(only=("buildings",))
    )
    done = program("drive", "bare", "--route", "random", "-o", "x", cwd=tmp_path)
    assert done.returncode == 2
    assert "no drivable roads" in done.stderr
    words = [
        "--rig",
        "drone",
        "--survey",
        "all",
        "--altitude",
        "90",
        "--duration",
        "0.3",
        "--format",
        "laz",
        "--turns",
    ]
    done = program("drive", "bare", *words, "-o", "x", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["frames"] == 3


def test_options_of_flights_are_part_of_the_recipe(scene):
    plain = DriveOptions(rig="drone", survey="all")
    assert plain.recipe(scene) != replace(plain, altitude=70.0).recipe(scene)
    with pytest.raises(InputError, match="overlap"):
        replace(plain, overlap=1.0)

"""Damaged routes, rigs, vehicles, sensors, stages and traffic files: one clear error, no other exception."""

import gzip
import json
import shutil
from contextlib import suppress
from importlib import resources

import numpy as np
import pytest
from helpers.mutations import mutated

from geoscene.errors import GeosceneError
from geoscene.geometry.frames import Frame
from geoscene.sources.tracks import read_track
from lidar.dataset.formats import FORMATS
from lidar.dataset.journal import read_journal
from lidar.dataset.layout import open_dataset, read_rows, read_sensors
from lidar.dataset.recorded import all_clouds, cloud_points
from lidar.errors import LidarError
from lidar.geometry.poses import Trajectory
from lidar.geometry.trajectory_files import read_tum, write_trajectory
from lidar.motion.replay import read_replay
from lidar.motion.vehicle import load_vehicle
from lidar.motion.waypoints import read_track as read_route
from lidar.sensors.rig.devices import cameras, scanners
from lidar.sensors.rig.scanner import load_sensor
from lidar.sensors.rig.specs import load_rig, rig_digest
from lidar.signal.registry import read_stages
from lidar.signal.weather.setting import read_weather
from lidar.tools.convert import convert
from lidar.tools.defences.calibration import read_calibration
from lidar.tools.maps.aggregate import aggregate
from lidar.tools.redteam.plan import read_plan
from lidar.tools.sweep.grid import read_grid
from lidar.traffic.fcd import read_fcd

FRAME = Frame.at(24.945, 60.168)
ROUNDS = 40
RIGS = resources.files("lidar.sensors.rig") / "rigs"
SENSORS = resources.files("lidar.sensors.rig") / "sensors"
VEHICLES = resources.files("lidar.motion") / "vehicles"

GPX = """<?xml version="1.0" encoding="{}"?>
<gpx version="1.1" creator="a" xmlns="http://www.topografix.com/GPX/1/1"><trk><name>Mäki</name><trkseg>
<trkpt lat="60.1670556" lon="24.9476424"><ele>3.5</ele></trkpt>
<trkpt lat="60.1660556" lon="24.9486424"><ele>3.5</ele></trkpt>
<trkpt lat="60.1648194" lon="24.9512607"><ele>3.5</ele></trkpt>
</trkseg></trk></gpx>
"""
GEOJSON = """{"type": "FeatureCollection", "features": [
{"type": "Feature", "properties": {}, "geometry": {"type": "LineString",
"coordinates": [[24.9476424, 60.1670556], [24.9486, 60.1660, 3.5], [24.9512607, 60.1648194]]}}]}
"""
STAGES = """[[stage]]
name = "dropped_packets"
loss = 0.1
burst = 4
[[stage]]
name = "cover_glass"
transmission = 0.7
sensor = "lidar"
"""
FCD = """<?xml version="1.0" encoding="UTF-8"?>
<fcd-export>
<timestep time="0.00">
<vehicle id="a" x="24.947" y="60.167" angle="10.0" type="car" speed="3.0"/>
<person id="p" x="24.9475" y="60.1671" angle="10.0" speed="1.0"/>
</timestep>
<timestep time="1.00">
<vehicle id="a" x="24.9471" y="60.1671" angle="10.0" type="car" speed="3.0"/>
</timestep>
</fcd-export>
"""
POSES = """timestamp,frame,x,y,z,qx,qy,qz,qw,lon,lat,h
2026-06-21T08:20:00.000000000Z,0,147.1,-133.0,0.0,0.0,0.0,0.45,0.893,24.9476,60.1670,0.0
2026-06-21T08:20:00.100000000Z,1,147.2,-133.0,0.0,0.0,0.0,0.45,0.893,24.9477,60.1670,0.0
2026-06-21T08:20:00.200000000Z,2,147.4,-133.0,0.0,0.0,0.0,0.45,0.893,24.9478,60.1670,0.0
"""


def load_whole_rig(path):
    rig = load_rig(path)
    rig_digest(path)
    scanners(rig)
    cameras(rig)


def trajectory_text(tmp_path):
    time_ns = np.arange(5, dtype=np.int64) * 10_000_000
    still = np.zeros((5, 3))
    quat = np.tile([0.0, 0.0, 0.0, 1.0], (5, 1))
    write_trajectory(tmp_path / "t.csv", Trajectory(time_ns, still, quat, still, np.ones(5)))
    return (tmp_path / "t.csv").read_text()


def seeds():
    for folder, use in ((RIGS, load_whole_rig), (VEHICLES, load_vehicle), (SENSORS, load_sensor)):
        files = sorted((f for f in folder.iterdir() if f.name.endswith(".toml")), key=str)
        for file in files[:: max(len(files) // 4, 1)]:
            yield pytest.param(use, file.read_text("utf-8"), ".toml", id=file.name)
    yield pytest.param(lambda p: read_route(p, FRAME), GPX.format("UTF-8"), ".gpx", id="gpx")
    yield pytest.param(lambda p: read_route(p, FRAME), GEOJSON, ".geojson", id="geojson")
    yield pytest.param(lambda p: read_stages([str(p)]), STAGES, ".toml", id="stages")
    yield pytest.param(read_fcd, FCD, ".xml", id="fcd")
    yield pytest.param(lambda p: read_replay(p, FRAME), POSES, ".csv", id="poses")
    yield pytest.param(lambda p: read_replay(p, FRAME), "", ".csv", id="trajectory")


@pytest.mark.parametrize(("use", "text", "suffix"), list(seeds()))
def test_a_damaged_file_is_read_or_refused_with_a_clear_error(use, text, suffix, tmp_path):
    data = (text or trajectory_text(tmp_path)).encode()
    path = tmp_path / f"file{suffix}"
    path.write_bytes(data)
    use(path)
    for seed in range(ROUNDS):
        path.write_bytes(mutated(data, np.random.default_rng(seed)))
        with suppress(GeosceneError, LidarError):
            use(path)


@pytest.mark.parametrize("frame", ["", "{}", '{"frame": []}', '{"frame": {"origin": [1]}}'])
def test_a_damaged_manifest_beside_a_trajectory_is_an_error(frame, tmp_path):
    (tmp_path / "trajectory.csv").write_text(trajectory_text(tmp_path))
    (tmp_path / "dataset.json").write_text(frame)
    with pytest.raises(LidarError, match=r"dataset\.json"):
        read_replay(tmp_path / "trajectory.csv", FRAME)


@pytest.mark.parametrize("codec", ["utf-8", "utf-8-sig", "iso-8859-1", "utf-16", "utf-16-le"])
def test_gpx_is_read_in_the_encoding_that_it_declares(codec, tmp_path):
    path = tmp_path / "track.gpx"
    path.write_bytes(GPX.format(codec.removesuffix("-sig").removesuffix("-le")).encode(codec))
    assert read_track(path) == pytest.approx(
        np.array(
            [[24.9476424, 60.1670556, 3.5], [24.9486424, 60.1660556, 3.5], [24.9512607, 60.1648194, 3.5]]
        )
    )


@pytest.mark.parametrize("codec", ["utf-8", "utf-8-sig", "utf-16", "utf-32"])
def test_geojson_is_read_in_unicode(codec, tmp_path):
    path = tmp_path / "track.geojson"
    path.write_bytes(GEOJSON.encode(codec))
    assert len(read_track(path)) == 3


@pytest.mark.parametrize(
    "document",
    [
        {"type": "FeatureCollection", "features": None},
        {"type": "FeatureCollection", "features": {"type": "Feature"}},
        {"type": "LineString", "coordinates": {"a": 1}},
        {"type": "LineString", "coordinates": [[24.9, 60.1, 1e300], [24.9, 60.2, 0]]},
        {"type": "LineString", "coordinates": [[24.9, 60.1, float("nan")], [24.9, 60.2, 0]]},
        [1, 2],
    ],
)
def test_geojson_of_another_structure_is_refused(document, tmp_path):
    path = tmp_path / "track.geojson"
    path.write_text(json.dumps(document))
    with pytest.raises(GeosceneError, match=r"track\.geojson"):
        read_track(path)


@pytest.mark.parametrize(
    ("folder", "name", "old", "new", "use"),
    [
        (RIGS, "vlp16", "[[lidar]]", "[[lidar]]\nrate_hz = 1e-12", load_whole_rig),
        (SENSORS, "vlp16", "rates_hz = [", "rates_hz = [1e18, ", load_sensor),
        (VEHICLES, "car", "turning_radius = ", "turning_radius = 9e9", load_vehicle),
        (VEHICLES, "car", "turning_radius = ", "turning_radius = 0.006", load_vehicle),
        (SENSORS, "mid40", "pulse_hz = ", "pulse_hz = 1e-308 # ", load_sensor),
        (SENSORS, "ust10lx", "step_deg = ", "step_deg = 1e-308 # ", load_sensor),
        (RIGS, "seed", "height = 720", "height = 65535", load_whole_rig),
    ],
)
def test_numbers_far_out_of_range_are_refused(folder, name, old, new, use, tmp_path):
    text = folder.joinpath(f"{name}.toml").read_text("utf-8")
    (tmp_path / "a.toml").write_text(text.replace(old, new, 1), "utf-8")
    with pytest.raises(LidarError, match=r"a\.toml"):
        use(tmp_path / "a.toml")


@pytest.mark.parametrize("value", ["9" * 5000, "[" * 5000])
@pytest.mark.parametrize(
    "use",
    [
        load_sensor,
        lambda path: read_stages([str(path)]),
        lambda path: read_weather(str(path)),
        read_calibration,
        read_grid,
        read_plan,
    ],
)
def test_toml_without_an_end_is_refused(use, value, tmp_path):
    (tmp_path / "a.toml").write_text(f"a = {value}")
    with pytest.raises(LidarError, match=r"a\.toml"):
        use(tmp_path / "a.toml")


def test_gzipped_traffic_with_a_flipped_byte_is_refused(tmp_path):
    more = " ".join(map(str, range(500)))
    path, data = tmp_path / "fcd.xml.gz", gzip.compress(f"{FCD}<!-- {more} -->".encode())
    path.write_bytes(data)
    read_fcd(path)
    for at in range(len(data) // 4, len(data) - 8, 3):
        path.write_bytes(data[:at] + bytes([data[at] ^ 255]) + data[at + 1 :])
        with pytest.raises(LidarError, match=r"fcd\.xml\.gz"):
            read_fcd(path)


def test_numbers_without_an_end_in_a_journal_are_left_out(tmp_path):
    (tmp_path / "frames.csv").write_text(f"sensor,frame,points,digest\ntop,{'9' * 5000},1,a\ntop,1,5,b\n")
    assert read_journal(tmp_path / "frames.csv").of("top").frame.tolist() == [1]


@pytest.mark.parametrize("row", ["count = inf\nshare = [0.5]", "count = 5\nshare = [nan]"])
def test_a_calibration_with_numbers_that_are_not_finite_is_refused(row, tmp_path):
    text = f'note = "a"\n[defence.shadow.frames]\nsuspicion = [1.0]\n{row}\n'
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(LidarError, match=r"a\.toml: is no calibration"):
        read_calibration(tmp_path / "a.toml")


@pytest.mark.parametrize("time", ["1e999999", "-1e99999999", "9" * 5000, "nan", "inf", "4294967296"])
def test_times_of_a_trajectory_that_are_no_times_are_refused_at_once(time, tmp_path):
    """Decimals hold up to 1e999999, and raise errors of their own beyond."""
    (tmp_path / "a.tum").write_text(f"1.5 0 0 0 0 0 0 1\n{time} 0 0 0 0 0 0 1\n")
    with pytest.raises(LidarError, match=r"a\.tum"):
        read_tum(tmp_path / "a.tum")


def test_traffic_that_unpacks_to_gigabytes_is_refused(tmp_path):
    (tmp_path / "fcd.xml.gz").write_bytes(gzip.compress(b"<fcd-export>" + b" " * (2**26 + 10)))
    with pytest.raises(LidarError, match=r"fcd\.xml\.gz: is unpacked to more than 64 MiB"):
        read_fcd(tmp_path / "fcd.xml.gz")


@pytest.fixture
def drive_copy(plain_drive, tmp_path):
    return open_dataset(shutil.copytree(plain_drive, tmp_path / "drive"))


def test_a_mount_that_mirrors_is_refused(drive_copy):
    path = drive_copy.paths.calibration
    document = json.loads(path.read_text())
    name = next(name for name, row in document["sensors"].items() if row["kind"] == "lidar")
    for row in document["sensors"][name]["vehicle_from_sensor"][:3]:
        row[1] = -row[1]
    path.write_text(json.dumps(document))
    with pytest.raises(LidarError, match=rf"calibration\.json: .*the mount of {name} mirrors"):
        read_sensors(drive_copy.paths)


def test_a_table_that_is_cut_by_one_byte_is_refused(drive_copy):
    path = drive_copy.paths.poses
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(LidarError, match=r"poses\.csv: .*ends within a line"):
        read_rows(path)


def test_a_cloud_as_text_that_is_cut_is_reported(tmp_path, caplog):
    (tmp_path / "a.csv").write_text("x,y,z\n1,2,3\n4,5,6.2")
    assert FORMATS["csv"].read(tmp_path / "a.csv")["z"].tolist() == [3, 6.2]
    assert "a.csv: does not end with a line break" in caplog.text


@pytest.mark.parametrize(
    ("column", "value"),
    [("range", -1.0), ("range", np.nan), ("x", np.nan), ("intensity", -5.0), ("ring", 60_000)],
)
def test_values_that_no_scanner_measures_are_refused(drive_copy, column, value):
    path = all_clouds(drive_copy)[0].files[0]
    table = FORMATS["pcd"].read(path)
    table[column] = np.concatenate([table[column][:-1], [value]]).astype(table[column].dtype)
    FORMATS["pcd"].write(path, table)
    with pytest.raises(LidarError, match=rf"{path.name}: damaged"):
        cloud_points(path)


@pytest.mark.parametrize("ring", [-1.0, 3.5, 1e6])
def test_rings_of_nuscenes_that_are_none_are_refused(tmp_path, ring):
    np.array([[1, 2, 3, 4, 5], [1, 2, 3, 4, ring]], "<f4").tofile(tmp_path / "a.pcd.bin")
    with pytest.raises(LidarError, match=r"a\.pcd\.bin: row 1 has ring"):
        FORMATS["nuscenes"].read(tmp_path / "a.pcd.bin")


def test_a_drive_without_clouds_is_not_converted(drive_copy, tmp_path):
    for name in drive_copy.sensors("lidar"):
        for form in FORMATS.values():
            shutil.rmtree(form.path(drive_copy.paths.sensor(name), 0).parent, ignore_errors=True)
    with pytest.raises(LidarError, match=r"has no .* clouds to convert"):
        convert(drive_copy.path, tmp_path / "out", to="e57")
    assert not (tmp_path / "out").exists()


def test_a_map_does_not_replace_a_file_of_its_dataset(drive_copy):
    path = all_clouds(drive_copy)[0].files[0]
    before = path.read_bytes()
    with pytest.raises(LidarError, match=f"{path.name}: is a file of the dataset"):
        aggregate(drive_copy.path, path, overwrite=True)
    assert path.read_bytes() == before

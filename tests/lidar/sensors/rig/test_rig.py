"""Rigs and sensors as TOML files."""

import contextlib
from importlib import resources

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidar.errors import InputError, RigError
from lidar.sensors.rig.devices import scanners
from lidar.sensors.rig.scanner import load_sensor, sensor_names
from lidar.sensors.rig.specs import load_rig, rig_digest, rig_names, rig_of
from lidar.simulation.metadata import calibration


def test_all_rigs_load_and_their_sensors_too():
    assert {"seed", "vlp16", "kitti", "nuscenes", "drone"} <= set(rig_names())
    for name in rig_names():
        rig = load_rig(name)
        assert rig.lidars
        for spec in rig.lidars:
            load_sensor(spec.preset, name=spec.name, rate_hz=spec.rate_hz, return_mode=spec.return_mode)


def test_a_preset_that_is_unknown_is_named_with_its_line_and_what_is_meant(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        'name = "mine"\n[[lidar]]\nname = "top"\npreset = "vlp61"\ntranslation = [0.0, 0.0, 1.9]\n'
    )
    with pytest.raises(
        RigError, match=r"mine.toml, line 4: lidar.preset: sensor 'vlp61' .*; is vlp16 meant\?"
    ):
        load_rig(path)


def test_the_seed_rig_matches_the_paper():
    rig = load_rig("seed")
    roof, front = rig.lidars
    assert (roof.preset, roof.mount.translation) == ("vlp16", (1.2, 0.0, 1.9))
    assert load_sensor(front.preset).kind == "scan2d"
    assert front.mount.translation[2] == 0.5
    (camera,) = rig.cameras
    assert (camera.width, camera.height) == (1280, 720)
    # A camera without a turn looks forward: its z is the vehicle's x, its x the vehicle's right.
    assert camera.mount.rotation @ [0, 0, 1] == pytest.approx([1, 0, 0])
    assert camera.mount.rotation @ [1, 0, 0] == pytest.approx([0, -1, 0])
    assert len(rig.gnss) == 1


def seen_by(camera, lidar, point):
    """Pixel and depth of a point of the lidar's frame."""
    on_vehicle = np.array(lidar.mount.translation) + lidar.mount.rotation @ point
    x, y, z = camera.mount.rotation.T @ (on_vehicle - camera.mount.translation)
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, z


@pytest.mark.parametrize(
    ("point", "pixel", "depth"),
    [((10, 0, 0), (613.964, 175.007), 9.7301), ((20, 3, -1), (502.441, 215.485), 19.7194)],
)
def test_kitti_points_fall_on_the_published_pixels(point, pixel, depth):
    rig = load_rig("kitti")
    camera = next(c for c in rig.cameras if c.name == "image_2")
    u, v, z = seen_by(camera, rig.lidars[0], point)
    assert (u, v) == pytest.approx(pixel, abs=0.01)
    assert z == pytest.approx(depth, abs=1e-4)


def test_nuscenes_points_fall_on_the_published_pixels():
    rig = load_rig("nuscenes")
    camera = next(c for c in rig.cameras if c.name == "cam_front")
    u, v, z = seen_by(camera, rig.lidars[0], (1, 15, -0.5))
    assert (u, v) == pytest.approx((910.705, 532.505), abs=0.01)
    assert z == pytest.approx(14.2254, abs=1e-4)


def test_nuscenes_cameras_cover_all_directions():
    yaw = {}
    for camera in load_rig("nuscenes").cameras:
        axis = camera.mount.rotation[:, 2]
        yaw[camera.name] = np.degrees(np.arctan2(axis[1], axis[0]))
    expected = {"cam_front": 0.33, "cam_front_left": 55.16, "cam_front_right": -56.40}
    expected |= {"cam_back_left": 108.60, "cam_back": 179.86, "cam_back_right": -110.79}
    assert yaw == pytest.approx(expected, abs=0.01)


RIG = """
name = "mine"

[[lidar]]
name = "top"
preset = "vlp16"
translation = [1.0, 0.0, 2.0]

[[lidar]]
name = "side"
preset = "xt32"
rpy_deg = [0.0, 0.0, 90.0]

[[camera]]
name = "eye"
width = 640
height = 480
fov_deg = 90.0
"""


def written(tmp_path, text):
    path = tmp_path / "rig.toml"
    path.write_text(text)
    return path


def test_a_user_adds_a_rig_without_python(tmp_path):
    rig = load_rig(written(tmp_path, RIG))
    assert [s.name for s in rig.lidars] == ["top", "side"]
    assert rig.lidars[1].mount.rotation @ [1, 0, 0] == pytest.approx([0, 1, 0])
    assert rig.cameras[0].fx == pytest.approx(320)
    assert (rig.cameras[0].cx, rig.cameras[0].cy) == (319.5, 239.5)


def test_the_model_of_an_inertial_unit_sets_its_noise(tmp_path):
    text = RIG + '\n[[imu]]\nname = "unit"\nmodel = "tactical"\ngyro_walk = 0.5\n'
    unit = load_rig(written(tmp_path, text)).imus[-1]
    assert (unit.gyro_noise, unit.gyro_instability, unit.gyro_walk) == (1.75e-5, 2.18e-6, 0.5)


def test_a_rig_names_a_sensor_file_beside_it(tmp_path):
    own = tmp_path / "own.toml"
    own.write_text(SENSOR)
    rig = load_rig(written(tmp_path, RIG.replace('"xt32"', '"own.toml"')))
    assert load_sensor(rig.lidars[1].preset).model == "Own"


def test_a_rigs_digest_covers_its_sensor_files_and_lists_of_directions(tmp_path):
    rig = written(tmp_path, RIG.replace('"xt32"', '"own.toml"'))
    own, rows = tmp_path / "own.toml", tmp_path / "rows.csv"
    own.write_text(SENSOR)
    before = rig_digest(rig)
    assert rig_digest(rig) == before
    own.write_text(SENSOR + "# another\n")
    changed = rig_digest(rig)
    assert changed != before
    own.write_text(SENSOR.replace("[spinning]", '[table]\nfile = "rows.csv"\n[spinning]'))
    rows.write_text("0,0,90\n")
    listed = rig_digest(rig)
    rows.write_text("0,0,91\n")
    assert len({before, changed, listed, rig_digest(rig)}) == 4


@pytest.mark.parametrize(
    ("change", "line", "words"),
    [
        (('preset = "xt32"', 'presett = "xt32"'), 9, ["lidar.preset", "missing", "presett"]),
        (
            ("rpy_deg = [0.0, 0.0, 90.0]", "rpy = [0, 0, 90]"),
            12,
            ["lidar.rpy", "unknown", "known are"],
        ),
        (("width = 640", 'width = "640"'), 16, ["camera.width", "not a whole number"]),
        (("[1.0, 0.0, 2.0]", "[1.0, 2.0]"), 7, ["lidar.translation", "2 numbers where 3"]),
        (('"side"', '"top"'), 10, ["lidar.name", "taken"]),
        (('"side"', '"a/b"'), 10, ["lidar.name", "letters"]),
        (("fov_deg = 90.0", "fov_deg = 180.0"), 18, ["camera.fov_deg", "fisheye"]),
        (('name = "mine"', 'name = "mine"\nspeed = 3'), 3, ["speed", "unknown"]),
        (('name = "mine"', 'name = "mine'), 2, ["not valid TOML"]),
    ],
)
def test_a_mistake_in_a_rig_is_named_with_file_line_and_key(tmp_path, change, line, words):
    path = written(tmp_path, RIG.replace(*change))
    with pytest.raises(RigError) as caught:
        load_rig(path)
    message = str(caught.value)
    for word in [str(path), f"line {line}", *words]:
        assert word in message
    assert "\n" not in message


def test_unknown_names_list_the_known(tmp_path):
    with pytest.raises(RigError, match="nuscenes"):
        load_rig("audi")
    with pytest.raises(RigError, match="no such rig file"):
        load_rig(tmp_path / "none.toml")
    with pytest.raises(RigError, match="vlp16"):
        load_sensor("vlp17")


SENSOR = """
kind = "spinning"
maker = "Me"
model = "Own"
wavelength_nm = 905.0
rates_hz = [10.0, 20.0]
min_range = 1.0
max_range = 80.0
range_sigma = 0.02
reference_range = 40.0
reference_reflectance = 0.1
divergence_mrad = 2.0
pulse_ns = 5.0

[spinning]
elevation_deg = [-10.0, 0.0, 10.0]
fire_us = [0.0, 5.0, 10.0]
block_us = 50.0
"""


@pytest.mark.parametrize(
    ("change", "line", "words"),
    [
        (
            ("fire_us = [0.0, 5.0, 10.0]", "fire_us = [0.0, 5.0]"),
            17,
            ["fire_us", "2 numbers where 3"],
        ),
        (("block_us = 50.0", "columns = 1024\nblock_us = 50.0"), 19, ["block_us", "not both"]),
        (("block_us = 50.0", "block_us = 0.0"), 18, ["block_us", "not over 0"]),
        (('kind = "spinning"', 'kind = "spining"'), 2, ["kind", "'spining'", "spinning, prism"]),
        (("max_range = 80.0", "max_range = 0.5"), 8, ["max_range", "not over 1"]),
        (("max_range = 80.0", "max_rang = 80.0"), 8, ["max_range", "missing"]),
        (("pulse_ns = 5.0", "pulse_ns = nan"), 13, ["pulse_ns", "not a number"]),
        (("block_us = 50.0", "block_us = 50.0\ncolour = 1"), 19, ["spinning.colour", "unknown"]),
    ],
)
def test_a_mistake_in_a_sensor_is_named_with_file_line_and_key(tmp_path, change, line, words):
    path = written(tmp_path, SENSOR.replace(*change))
    with pytest.raises(RigError) as caught:
        load_sensor(path)
    message = str(caught.value)
    for word in [str(path), *words]:
        assert word in message
    if "missing" not in words:
        assert f"line {line}" in message


def test_a_rig_states_random_delays_and_codes_of_its_pulses(tmp_path):
    rig = tmp_path / "rig.toml"
    text = 'name = "a"\n[[lidar]]\nname = "top"\npreset = "vlp16"\ntranslation = [0.0, 0.0, 2.0]\n'
    rig.write_text(text + "firing_jitter_ns = 100.0\ncode_bits = 8\n")
    guarded = load_rig(rig)
    (scanner,) = scanners(guarded)
    assert (scanner.sensor.firing_jitter_ns, scanner.sensor.code_bits) == (100.0, 8)
    stated = calibration(guarded, [scanner])["sensors"]["top"]
    assert (stated["firing_jitter_ns"], stated["code_bits"]) == (100.0, 8)
    digest = rig_digest(rig)
    rig.write_text(text)
    assert rig_digest(rig) != digest
    plain = load_rig(rig)
    assert not {"firing_jitter_ns", "code_bits"} & set(calibration(plain, scanners(plain))["sensors"]["top"])
    rig.write_text(text + "code_bits = 65\n")
    with pytest.raises(RigError, match=r"code_bits"):
        load_rig(rig)


def test_an_unsupported_rate_or_return_mode_is_refused():
    with pytest.raises(RigError, match="30 Hz is not within 5 to 20"):
        load_sensor("vlp16", rate_hz=30)
    with pytest.raises(RigError, match="strongest, last, dual"):
        load_sensor("vlp16", return_mode="all")


def test_every_number_of_every_preset_has_a_source():
    words = {"kind", "maker", "model", "note", "divergence_at", "second_strongest", "fmcw", "law", "lens"}
    folder = resources.files("lidar.sensors.rig") / "sensors"
    for name in sensor_names():
        sensor = load_sensor(name)
        text = (folder / f"{name}.toml").read_text()
        keys = {line.split(" = ")[0] for line in text.split("[source]")[0].splitlines() if " = " in line}
        assert keys - words == set(sensor.source), name


def test_the_rig_of_a_drive_is_found_again_only_as_it_was(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('name = "mine"\nvehicle = "car"\n')
    recorded = f"{path} ({rig_digest(path)})"
    assert rig_of(recorded).name == "mine"
    path.write_text('name = "other"\nvehicle = "car"\n')
    with pytest.raises(InputError, match="has changed since the drive"):
        rig_of(recorded)
    path.unlink()
    with pytest.raises(RigError, match="run the command in the directory of"):
        rig_of(recorded)


@settings(max_examples=60, deadline=None)
@given(st.text(alphabet='abk_=[]"#.\n 019-{}', max_size=120))
def test_the_loader_raises_only_rig_errors(tmp_path_factory, text):
    path = tmp_path_factory.mktemp("rig") / "rig.toml"
    path.write_text(text)
    with contextlib.suppress(RigError):
        load_rig(path)

"""Fidelity levels, settings and the listings of both."""

import json
import re
from dataclasses import fields

import pytest
from cyclopts import CoercionError
from helpers.programs import run_program

from lidar.cli import app
from lidar.errors import InputError
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.physics.settings import ScannerSettings
from lidar.sensors.rig.devices import rig_rows, sensor_rows
from lidar.sensors.rig.scanner import load_sensor, sensor_names
from lidar.sensors.rig.specs import load_rig, rig_names
from lidar.settings import levels, setting_rows, settings_of
from lidar.world.settings import WorldSettings


def program(*words, cwd="."):
    return run_program("lidar", *words, cwd=cwd)


def test_every_setting_is_listed_with_its_value_at_each_level_and_a_meaning():
    found = setting_rows()
    assert [s["name"] for s in found] == [
        f.name for kind in (ScannerSettings, CameraSettings, WorldSettings) for f in fields(kind)
    ]
    for setting in found:
        assert list(setting)[2:4] == list(levels())
        assert len(setting["meaning"]) > 10
        assert "\n" not in setting["meaning"]
    by_name = {s["name"]: s for s in found}
    assert [by_name["rays"][level] for level in levels()] == ["1", "19"]
    assert [by_name["camera_noise"][level] for level in levels()] == ["off", "on"]
    assert "oren-nayar" in by_name["law"]["meaning"]


def test_each_listed_value_can_be_set():
    for level in levels():
        pairs = [(s["name"], s[level]) for s in setting_rows()]
        assert settings_of("standard", pairs) == settings_of(level)


def test_settings_that_need_each_other_may_come_in_any_order():
    pairs = [("daylight_lux", "20000"), ("detection", "on")]
    assert settings_of("standard", pairs) == settings_of("standard", pairs[::-1])


def test_a_setting_that_scanners_and_cameras_share_changes_both():
    pairs = [("precision", "float32"), ("retrace", "off"), ("reach", "40")]
    scanner, camera, world = settings_of("standard", pairs)
    assert scanner.precision == camera.precision == "float32"
    assert not scanner.retrace
    assert not camera.retrace
    assert world == WorldSettings(reach=40.0)


@pytest.mark.parametrize(
    ("level", "given", "says"),
    [
        ("standard", [("ray", "7")], "is rays"),
        ("standard", [("shadow", "off")], "shadows"),
        ("standard", [("qqq", "1")], "lidar settings lists all"),
        ("standard", [("rays", "many")], "whole number"),
        ("standard", [("shadows", "perhaps")], "on or off"),
        ("standard", [("supersample", "99")], "supersample = 99 is not within 1 to 16"),
        ("standard", [("poses", "colum")], "is none of firing, column, frame; is column meant?"),
        ("standard", [("precision", "half")], "is none of exact, refined, float32"),
        ("standard", [("origin", "far")], "is none of near, scene"),
        ("standard", [("reach", "0")], "reach = 0 is not at least 0.001 m, or unlimited"),
        ("standard", [("reach", "nan")], "reach = nan is not at least 0.001 m"),
        ("standard", [("daylight_lux", "20000")], "no effect without detection or false_alarms"),
        ("survey", [("stretch", "on")], "no effect with rays=19"),
        ("surve", [], "is survey meant? (known are standard, survey)"),
    ],
)
def test_unknown_settings_are_named_with_similar_ones(level, given, says):
    with pytest.raises(InputError, match=re.escape(says)) as error:
        settings_of(level, given)
    assert "\n" not in str(error.value)


@pytest.mark.full
def test_listings_contain_all_built_in_rigs_and_sensors():
    assert [row["name"] for row in sensor_rows()] == sensor_names()
    assert [row["name"] for row in rig_rows()] == rig_names()
    vlp16 = next(row for row in sensor_rows() if row["name"] == "vlp16")
    assert (vlp16["channels"], vlp16["rate_hz"], vlp16["max_range_m"]) == (16, 10.0, 100.0)
    # the maker's 300,000 points per second, less the time of the blocks' recharge
    assert vlp16["pulses_per_s"] == pytest.approx(16 / 55.296e-6, rel=1e-3)
    for row in sensor_rows():
        assert row["source"]
    assert load_rig("aircraft").vehicle == "aircraft"
    assert load_sensor(load_rig("aircraft").lidars[0].preset).kind == "line"


@pytest.mark.parametrize(
    ("command", "key"), [("rigs", "rigs"), ("sensors", "sensors"), ("settings", "settings")]
)
def test_listings_have_a_text_and_a_json_form(command, key):
    rows = json.loads(program(command, "--json").stdout)[key]
    text = program(command).stdout
    assert len(rows) > 4
    for row in rows:
        assert row["name"] in text


def test_a_bad_rig_or_sensor_is_named_with_line_and_key(tmp_path):
    (tmp_path / "mine.toml").write_text(
        'name = "mine"\n\n[[lidar]]\nname = "top"\npreset = "s.toml"\n\n[[camera]]\nname = "c"\nwidht = 10\n'
    )
    (tmp_path / "s.toml").write_text('kind = "flash"\nmaker = "a"\nmodel = "b"\nwavelength_nm = 20.0\n')
    with pytest.raises(InputError, match=r"mine.toml, line \d+: camera.width: .*widht a misspelling"):
        load_rig(tmp_path / "mine.toml")
    with pytest.raises(InputError, match=r"s.toml(, line \d+)?: rates_hz: this key is missing"):
        load_sensor(tmp_path / "s.toml")
    (tmp_path / "s.toml").write_text('kind = "flash"\nrates_hz = [10.0]\nmin_range = "near"\n')
    with pytest.raises(InputError, match=r"s.toml, line 3: min_range: 'near' is not a number"):
        load_sensor(tmp_path / "s.toml")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("vehicles=abc", "vehicles = 'abc' is not a number within 0 to 60"),
        ("vehicles", "traffic 'vehicles' is unknown (known are on, off, FILE.xml)"),
        ("parked=0.5,radius=", "parked=0.5,radius=: radius has no value"),
        ("cars=3", "parameter 'cars' is unknown (known are vehicles, cyclists"),
        ("on:vehicle=3", "is vehicles meant?"),
        ("on,off", "give one of on, off, FILE.xml"),
        ("sumo,pedestrians=3", "traffic sumo: run SUMO first and give its file"),
        ("fcd.xml,net=", "fcd.xml,net=: net has no value"),
        ("fcd.xml,begin=soon", "traffic fcd.xml: begin = 'soon' is not a number"),
    ],
)
def test_values_of_traffic_are_named_with_what_is_expected(text, said, tmp_path):
    words = ["drive", str(tmp_path), "--route", "random", "-o", str(tmp_path / "d"), "--traffic", text]
    with pytest.raises(CoercionError, match=re.escape(said)):
        app(words, exit_on_error=False, result_action="return_value")


def test_options_are_read_where_pydantic_is_imported(tmp_path):
    """The command-line parser checks values against types if pydantic is imported."""
    pytest.importorskip("pydantic")
    words = ["drive", str(tmp_path / "none"), "--route", "60.1,24.9", "60.2,24.8", "--traffic", "vehicles=3"]
    with pytest.raises(InputError, match="no such scene"):
        app([*words, "-o", str(tmp_path / "out")], exit_on_error=False, result_action="return_value")

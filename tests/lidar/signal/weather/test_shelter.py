"""Weather under roofs and in tunnels, for scanners and cameras alike."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.sensor_worlds import box, driven, world

from geoscene.classes import Class
from geoscene.geometry.frames import Frame as GeoFrame
from lidar.geometry.attitude import Mount
from lidar.geometry.poses import Poses
from lidar.sensors.camera.light import daylight
from lidar.sensors.camera.render import CameraImage
from lidar.sensors.laser.scan import cast
from lidar.sensors.physics.origin import Origin
from lidar.sensors.physics.settings import ScannerSettings
from lidar.sensors.rig.scanner import load_sensor
from lidar.sensors.rig.specs import CameraSpec
from lidar.signal.registry import Stages
from lidar.signal.run import altered_sweep
from lidar.signal.situation import Situation
from lidar.signal.weather.camera import add_weather
from lidar.signal.weather.setting import read_weather

GROUND = box((-90, -90, -1), (90, 90, 0))
WALL = box((40, -20, 0), (42, 20, 20), feature=8)


def tunnel(start, end):
    """A tube along x that is 8 m wide and 5 m high."""
    sides = box((start, -6, 0), (end, -4, 5)), box((start, 4, 0), (end, 6, 5))
    return world(GROUND, WALL, *sides, box((start, -6, 5), (end, 6, 6)))


OPEN, LONG, GATE = world(GROUND, WALL), tunnel(-50, 40), tunnel(8, 12)
SENSOR = replace(load_sensor("hdl64e_s2"), min_range=2.0)
CAMERA = CameraSpec("front", Mount(), 320, 180, 300.0, 300.0, 159.5, 89.5, exposure_ns=5_000_000)
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Scene from camera: it looks along the scene's x axis."""


def scan(text, around, *, knows=None):
    """A scan through weather that knows the roofs of a world, 1.9 m over its ground."""
    still = driven((0.0, 0, 0), start=(0, 0, 0))
    options = {"frame": 0, "seed": 5, "settings": ScannerSettings(link=True), "trajectory": still}
    sweep = cast(SENSOR, Mount((0, 0, 1.9)), world=around, **options)

    def poses(time_ns):
        n = len(time_ns)
        return Poses(np.tile([0.0, 0, 1.9], (n, 1)), np.tile(np.eye(3), (n, 1, 1)), np.ones((n, 3)))

    at = Situation("hdl64e_s2", 0, poses=poses, geo=GeoFrame.at(7.0, 50.0), world=knows or around)
    return altered_sweep(sweep, Stages(read_weather(text), 3), at=at)


def image(text, around):
    """The middle of an image of the wall, black and 40 m away, from a camera 1.9 m over the ground."""

    def poses(time_ns):
        n = len(time_ns)
        return Poses(np.tile([0.0, 0, 1.9], (n, 1)), np.tile(AHEAD, (n, 1, 1)), np.ones((n, 3)))

    shape = CAMERA.height, CAMERA.width
    black = CameraImage(
        np.zeros((*shape, 3), np.uint8),
        np.full(shape, 40.0, np.float32),
        np.full(shape, Class.BUILDING, np.uint8),
        np.full(shape, -1, np.int32),
    )
    light = daylight(np.array([0.3, 0.5, 0.8]), cloud=1.0)
    at = Situation(
        "front", 0, 10**9, poses=poses, camera=CAMERA, light=light, world=around, geo=GeoFrame.at(7.0, 50.0)
    )
    found = add_weather(black, read_weather(text)[0].stage, at=at, rng=np.random.default_rng(1)).rgb
    assert found is not None
    return found[75:100, 135:185].astype(int)  # 6.7 by 3.3 m of the wall


@pytest.mark.full
@pytest.mark.parametrize("text", ["rain=50mm/h", "snow=5mm/h"])
def test_nothing_falls_in_a_tunnel(text):
    found = scan(text, LONG)
    inside = np.isin(np.arange(len(found.original)), found.cloud.source)
    kept = np.abs(found.original.xyz[:, 1]) < 4
    assert kept.sum() > 10_000
    assert inside[kept].all()
    np.testing.assert_array_equal(
        found.cloud.intensity[found.cloud.source >= 0], found.original.intensity[found.cloud.source]
    )
    assert not np.any(found.cloud.origin == Origin.WEATHER)
    assert np.any(scan(text, LONG, knows=OPEN).cloud.origin == Origin.WEATHER)
    assert image(text, LONG).max() == 0
    assert image(text, OPEN).max() > 20


@pytest.mark.full
def test_snow_falls_before_and_behind_a_gate_but_not_under_it():
    """The grid of what is covered has cells of 1 m: its edges are within half a metre."""
    found = scan("snow=20mm/h", GATE).cloud
    flakes = found.xyz[found.origin == Origin.WEATHER]
    under = (flakes[:, 0] > 8.5) & (flakes[:, 0] < 11.5) & (np.abs(flakes[:, 1]) < 4) & (flakes[:, 2] < 3.1)
    assert len(flakes) > 500
    assert not under.any()
    open_air = scan("snow=20mm/h", GATE, knows=OPEN).cloud
    flakes = open_air.xyz[open_air.origin == Origin.WEATHER]
    under = (flakes[:, 0] > 8.5) & (flakes[:, 0] < 11.5) & (np.abs(flakes[:, 1]) < 4) & (flakes[:, 2] < 3.1)
    assert under.sum() > 5


def test_rain_veils_by_the_length_of_the_open_air():
    """Four of forty metres are under the gate."""
    covered, open_air = (np.median(image("rain=200mm/h", around)) for around in (GATE, OPEN))
    assert 0 < covered <= open_air


@pytest.mark.full
def test_fog_fills_a_gate_and_thins_out_in_a_tunnel():
    np.testing.assert_array_equal(image("fog=60m", GATE), image("fog=60m", OPEN))
    assert 0 < np.median(image("fog=60m", LONG)) < 0.8 * np.median(image("fog=60m", OPEN))
    lost = []
    for around in (LONG, OPEN):
        found = scan("fog=30m", LONG, knows=around)
        lost.append(1 - np.count_nonzero(found.cloud.source >= 0) / len(found.original))
    assert lost[0] < 0.3 * lost[1]

"""Satellite receivers: error statistics, satellite visibility and NMEA sentences."""

import os
import struct
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
import pyproj
import pytest
import shapely
from pynmeagps import NMEAReader
from pyproj import Geod

from geoscene.geometry.frames import Frame
from lidar.errors import InputError
from lidar.geometry.attitude import Mount, quat_from_euler
from lidar.geometry.poses import Trajectory
from lidar.geometry.random_streams import generator
from lidar.sensors.navigation.gnss import antenna_motion, epochs, gauss_markov, gnss_columns, observe_gnss
from lidar.sensors.navigation.measurements import NAMES, STATES
from lidar.sensors.navigation.nmea import checksum, geoid_at, height_note, latitude, longitude, nmea, sentence
from lidar.sensors.navigation.satellite_visibility import (
    Sky,
    constellations,
    dilution,
    ecef,
    enu_axes,
    look_up,
    open_sky,
    satellite_names,
    satellites,
    sky_view,
)
from lidar.sensors.rig.specs import SYSTEMS, GnssSpec

START = datetime(2026, 5, 1, 9, 30, tzinfo=UTC)
FRAME = Frame.at(-76.3059, 36.8853, crs="EPSG:32618")  # convergence -0.78 degrees, scale 0.99977
GEOD = Geod(ellps="WGS84")


def spec(mode="ideal", rate=10.0, arm=(0.0, 0.0, 0.0), **options):
    return GnssSpec("gnss", Mount(arm), rate, mode=mode, **options)


def standing(seconds, height=3.0):
    n = 2
    still = np.zeros((n, 3))
    return Trajectory(
        np.array([0, round(seconds * 1e9)]),
        still + np.array([10.0, 2.0, height]),
        np.tile([0.0, 0, 0, 1], (n, 1)),
        still,
        np.full(n, 0.99976683),
    )


def eastward(seconds=60.0, speed=10.0, heading=0.0):
    """Straight along a grid direction at constant speed."""
    t = np.arange(round(seconds * 100) + 1) * 0.01
    d = np.array([np.cos(heading), np.sin(heading), 0.0])
    k = 0.99976683
    return Trajectory(
        np.round(t * 1e9).astype(np.int64),
        k * speed * t[:, None] * d,
        quat_from_euler(np.zeros(len(t)), np.zeros(len(t)), gamma=np.full(len(t), heading)),
        np.broadcast_to(speed * d, (len(t), 3)).copy(),
        np.full(len(t), k),
    )


def circle(radius=20.0, rate=0.2, seconds=40.0):
    t = np.arange(round(seconds * 100) + 1) * 0.01
    yaw = rate * t
    position = radius * np.column_stack([np.sin(yaw), 1 - np.cos(yaw), np.zeros(len(t))])
    velocity = radius * rate * np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(t))])
    quat = quat_from_euler(0 * t, 0 * t, gamma=yaw)
    return Trajectory(np.round(t * 1e9).astype(np.int64), position, quat, velocity, np.ones(len(t)))


def test_an_ideal_receiver_reports_the_antenna():
    fixes = observe_gnss(circle(), FRAME, spec=spec(arm=(1.0, 0.5, 1.6)), seed=0, start=START)
    np.testing.assert_array_equal(fixes.error, 0.0)
    x, y = FRAME.from_geographic(*fixes.lonlath[:, :2].T)
    yaw = 0.2 * fixes.time_ns * 1e-9
    px, py = 20 * np.sin(yaw), 20 * (1 - np.cos(yaw))
    np.testing.assert_allclose(x, px + np.cos(yaw) * 1.0 - np.sin(yaw) * 0.5, atol=1e-4)
    np.testing.assert_allclose(y, py + np.sin(yaw) * 1.0 + np.cos(yaw) * 0.5, atol=1e-4)
    np.testing.assert_allclose(fixes.lonlath[:, 2], 1.6, atol=1e-9)


def test_an_antenna_ahead_of_the_axle_is_swung_sideways_in_a_turn():
    _, velocity = antenna_motion(circle(), FRAME, spec=spec(arm=(3.0, 0.0, 0.0)), time_ns=np.array([0]))
    turn = float(FRAME.convergence(*FRAME.to_geographic(0.0, 0.0)))
    grid = np.array([4.0, 0.2 * 3.0, 0.0])  # v + omega x l, heading grid east
    east = grid[0] * np.cos(turn) + grid[1] * np.sin(turn)
    north = grid[1] * np.cos(turn) - grid[0] * np.sin(turn)
    np.testing.assert_allclose(velocity[0], [east, north, 0.0], atol=1e-3)


@pytest.mark.parametrize("heading_deg", [0.0, 90.0, 200.0])
def test_course_and_speed_are_those_of_the_geodesic(heading_deg):
    fixes = observe_gnss(eastward(heading=np.radians(heading_deg)), FRAME, spec=spec(), seed=0, start=START)
    (lon0, lat0), (lon1, lat1) = fixes.lonlath[0, :2], fixes.lonlath[-1, :2]
    azimuth, _, metres = GEOD.inv(lon0, lat0, lon1, lat1)
    middle = np.degrees(fixes.course[len(fixes) // 2])
    assert (middle - azimuth + 180) % 360 - 180 == pytest.approx(0.0, abs=0.01)
    assert metres / 60.0 == pytest.approx(10.0, abs=2e-3)
    np.testing.assert_allclose(fixes.speed, 10.0, atol=1e-9)
    # grid heading instead of true heading would be an error of 0.78 degrees
    assert abs((90.0 - heading_deg - azimuth + 180) % 360 - 180) > 0.7


def test_a_gauss_markov_process_has_its_variance_and_correlation_time():
    n, dt, tau = 100_000, 1.0, 30.0
    u = gauss_markov(generator(1, "test"), dt, tau=np.full(n, tau))
    assert u.std() == pytest.approx(1.0, rel=0.05)
    lag = round(tau / dt)
    assert (u[lag:] * u[:-lag]).mean() == pytest.approx(np.exp(-1), rel=0.1)
    assert np.diff(u, axis=0).std() == pytest.approx(np.sqrt(2 * (1 - np.exp(-dt / tau))), rel=0.02)


@pytest.mark.parametrize(
    ("mode", "state"),
    [("single", "single"), pytest.param("sbas", "sbas", marks=pytest.mark.full), ("rtk", "fixed")],
)
def test_errors_have_the_deviations_of_the_table(mode, state):
    # one epoch in ten correlation times: practically independent
    table = STATES[state]
    rate = 0.1 / table.tau
    n = 4000
    fixes = observe_gnss(
        standing((n - 1) / rate), FRAME, spec=spec(mode, rate, mask_deg=5.0), seed=3, start=START
    )
    held = fixes.state == NAMES.index(state)
    assert held.mean() > 0.95
    across, up = fixes.error[held][:, :2].std(), fixes.error[held][:, 2].std()
    assert across == pytest.approx(np.hypot(table.white[0], table.bias[0]), rel=0.05)
    assert up == pytest.approx(np.hypot(table.white[1], table.bias[1]), rel=0.05)
    assert np.abs(fixes.error.mean(axis=0)).max() < 0.1 * up
    # white noise only: the bias is constant from one fix to the next, 0.1 s apart
    quick = observe_gnss(standing(400.0), FRAME, spec=spec(mode, 10.0), seed=3, start=START)
    step = np.diff(quick.error, axis=0)[:, :2].std()
    assert step == pytest.approx(np.sqrt(2) * table.white[0], rel=0.06)


def test_a_fix_does_not_depend_on_later_motion():
    short, long = (
        observe_gnss(standing(s), FRAME, spec=spec("rtk"), seed=9, start=START) for s in (20.0, 60.0)
    )
    for name, column in gnss_columns(short).items():
        np.testing.assert_array_equal(column, gnss_columns(long)[name][: len(short)], err_msg=name)
    other = observe_gnss(standing(20.0), FRAME, spec=spec("rtk"), seed=10, start=START)
    assert (other.lonlath != short.lonlath).all()


def test_a_fix_is_the_true_position_plus_the_error():
    fixes = observe_gnss(eastward(), FRAME, spec=spec("single"), seed=2, start=START)
    azimuth, _, metres = GEOD.inv(*fixes.true_lonlath[:, :2].T, *fixes.lonlath[:, :2].T)
    a = np.radians(azimuth)
    np.testing.assert_allclose(metres * np.sin(a), fixes.error[:, 0], atol=1e-3)
    np.testing.assert_allclose(metres * np.cos(a), fixes.error[:, 1], atol=1e-3)
    np.testing.assert_allclose(fixes.lonlath[:, 2] - fixes.true_lonlath[:, 2], fixes.error[:, 2], atol=1e-9)


def test_epochs_come_at_the_rate_from_the_offset_on():
    s = GnssSpec("g", Mount(), 4.0, time_offset_ns=100_000_000)
    assert epochs(s, 1_000_000_000).tolist() == [100_000_000, 350_000_000, 600_000_000, 850_000_000]
    assert len(epochs(spec(rate=10.0), 1_000_000_000)) == 11
    assert len(epochs(s, 50_000_000)) == 0


def test_an_unknown_mode_is_refused():
    with pytest.raises(InputError, match="unknown mode ppp; choose one of ideal, single, sbas, rtk"):
        observe_gnss(standing(1.0), FRAME, spec=spec("ppp"), seed=0, start=START)


# ------------------------------------------------------------------------------------------------- the sky


def test_coordinates_agree_with_known_values():
    np.testing.assert_allclose(
        ecef(-76.3059, 36.8853, h=0.0), [1209173.8058, -4962451.0372, 3807219.6582], atol=1e-3
    )
    d = ecef(-76.2959, 36.8953, h=25.0) - ecef(-76.3059, 36.8853, h=10.0)
    np.testing.assert_allclose(enu_axes(-76.3059, 36.8853) @ d, [891.33917, 1109.80692, 14.84095], atol=1e-4)


def test_the_constellation_repeats_every_sidereal_day_and_is_as_full_as_gps():
    day = round(86164.0905 * 1e9)
    one, two = satellites(START, np.array([0, day]), systems=("gps",))
    # twice a period of 43077.3 s against the sidereal day: some hundred metres of 26 560 km
    assert np.linalg.norm(one - two, axis=1).max() < 100e3
    np.testing.assert_allclose(np.linalg.norm(one, axis=1), 26559.7e3)
    hours = np.arange(0, 24 * 3600, 600) * 10**9
    for lat in (0.0, 36.9, 60.2, -33.9, 85.0):
        full = np.full(len(hours), lat)
        azimuth, elevation = look_up(
            np.zeros(len(hours)), full, h=0 * full, start=START, time_ns=hours, systems=("gps",)
        )
        count = (elevation > np.radians(5)).sum(axis=1)
        assert count.min() >= 5  # the standard guarantees four in view
        assert 7 <= count.mean() <= 10
        assert elevation.max() > np.radians(45 if lat > 80 else 70)
        used = elevation > np.radians(5)
        assert np.median(dilution(azimuth, elevation, used=used, names=satellite_names(("gps",)))[:, 2]) < 3.5


def test_dilution_of_four_satellites_is_that_of_the_textbook():
    # one overhead and three on the horizon, evenly round: HDOP = sqrt(4/3), VDOP = sqrt(4/3)
    azimuth = np.array([[0.0, 0.0, 2 * np.pi / 3, 4 * np.pi / 3]])
    elevation = np.array([[np.pi / 2, 0.0, 0.0, 0.0]])
    one = np.array(["G01", "G02", "G03", "G04"])
    dop = dilution(azimuth, elevation, used=np.ones((1, 4), bool), names=one)
    np.testing.assert_allclose(dop[0, :2], np.sqrt(4 / 3), atol=1e-12)
    assert np.isinf(dilution(azimuth, elevation, used=np.array([[True, True, True, False]]), names=one)).all()
    # the clock of a second system needs one more satellite
    two = np.array(["G01", "G02", "G03", "E01"])
    assert np.isinf(dilution(azimuth, elevation, used=np.ones((1, 4), bool), names=two)).all()


# days and nights per revolution, radius in km and inclination in degrees that the interface documents give
ORBITS = {"gps": (24, 43077.3, 55.0), "glonass": (24, 40544.0, 64.8), "galileo": (24, 50680.7, 56.0)}


@pytest.mark.parametrize("system", ORBITS)
def test_orbits_have_the_published_periods_and_inclinations(system):
    count, period, tilt = ORBITS[system]
    time_ns = np.arange(0, 86_400, 300) * 10**9
    place = satellites(START, time_ns, systems=(system,))
    assert place.shape[1] == count
    # earth-fixed latitudes reach the inclination
    top = np.degrees(np.arcsin(place[..., 2] / np.linalg.norm(place, axis=-1))).max()
    assert top == pytest.approx(tilt, abs=0.1)
    # after a period each is at the same height over the equator, on its way up or down again
    later = satellites(START, time_ns + round(period * 1e9), systems=(system,))
    np.testing.assert_allclose(later[..., 2], place[..., 2], atol=150e3)


def test_beidou_geosynchronous_satellites_stay_over_asia():
    time_ns = np.arange(0, 86_164, 600) * 10**9
    place = satellites(START, time_ns, systems=("beidou",))
    assert place.shape[1] == 30
    lon = np.degrees(np.arctan2(place[..., 1], place[..., 0]))
    still, eight = lon[:, 24:27], lon[:, 27:]
    np.testing.assert_allclose(still, np.broadcast_to([80.0, 110.5, 140.0], still.shape), atol=1.0)
    crossing = np.abs(place[:, 27:, 2]) < 2e6
    assert np.abs(eight[crossing] - 118.0).max() < 5.0


def test_satellites_of_a_walker_constellation_keep_apart():
    """A wrong phase between planes would put two satellites at one position."""
    for system in ("glonass", "galileo"):
        place = satellites(START, np.arange(0, 43_200, 900) * 10**9, systems=(system,))
        for moment in place:
            gap = np.linalg.norm(moment[:, None] - moment[None], axis=-1)
            assert gap[~np.eye(len(moment), dtype=bool)].min() > 5e5


def test_four_systems_see_more_and_place_better_than_one():
    hours = np.arange(0, 24 * 3600, 900) * 10**9
    full = np.full(len(hours), 50.0)
    median = {}
    for systems in (("gps",), SYSTEMS):
        azimuth, elevation = look_up(0 * full, full, h=0 * full, start=START, time_ns=hours, systems=systems)
        used = elevation > np.radians(10)
        median[len(systems)] = (
            np.median(used.sum(axis=1)),
            np.median(dilution(azimuth, elevation, used=used, names=satellite_names(systems))[:, 2]),
        )
    assert median[4][0] > 3 * median[1][0]
    assert median[4][1] < 0.8 * median[1][1]
    assert set(constellations()) == set(SYSTEMS)


def test_unknown_constellations_are_refused():
    for systems in (("gps", "loran"), (), ("gps", "gps")):
        with pytest.raises(InputError, match="give one or more of gps, glonass"):
            satellites(START, np.array([0]), systems=systems)


@dataclass
class Walls:
    """A caster of an endless street along grid east between walls, ``half`` metres to each side."""

    half: float
    height: float

    def occluded(self, origins, directions):
        d, o = np.asarray(directions), np.asarray(origins)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.where(d[:, 1] > 0, self.half - o[:, 1], -self.half - o[:, 1]) / d[:, 1]
            return (t > 0) & np.isfinite(t) & (o[:, 2] + t * d[:, 2] < self.height)


@dataclass
class Street:
    caster: Walls


def view(trajectory, s, height):
    time_ns = epochs(s, trajectory.duration_ns)
    position, _ = antenna_motion(trajectory, FRAME, spec=s, time_ns=time_ns)
    asked = []

    def world_at(region):
        asked.append(region)
        return Street(Walls(10.0, height))

    return (
        sky_view(
            FRAME,
            position,
            start=START,
            time_ns=time_ns,
            world_at=world_at,
            mask_deg=s.mask_deg,
            systems=s.constellations,
        ),
        asked,
        position,
    )


def test_high_walls_hide_the_satellites_beside_the_street_and_not_those_along_it():
    s = spec("rtk", rate=0.2, arm=(0.0, 0.0, 1.6))
    sky, asked, position = view(eastward(600.0, 1.0), s, 60.0)
    assert sky.blocked.mean() > 0.5
    turn = FRAME.convergence(*FRAME.to_geographic(*position[:, :2].T))[:, None]
    across = np.abs(np.cos(sky.azimuth - turn)) * np.cos(
        sky.elevation
    )  # share of the direction across the street
    steep = np.sin(sky.elevation) / np.maximum(across, 1e-9) * 10.0 + 1.6 > 60.0
    np.testing.assert_array_equal(sky.visible, sky.above & steep)
    for x, y, _ in position[::10]:
        assert any(r[0] <= x - 300 and r[2] >= x + 300 and r[1] <= y - 300 and r[3] >= y + 300 for r in asked)
    assert len(asked) < 10


def test_in_the_open_nothing_blocks_the_sky():
    s = spec("rtk", rate=1.0, arm=(0.0, 0.0, 1.6))
    sky, _, position = view(eastward(30.0), s, 1.0)
    open_ = open_sky(FRAME, position, start=START, time_ns=epochs(s, 30 * 10**9), mask_deg=10.0)
    np.testing.assert_array_equal(sky.visible, open_.visible)
    np.testing.assert_array_equal(sky.blocked, 0.0)
    fixes = [observe_gnss(eastward(30.0), FRAME, spec=s, seed=1, start=START, sky=k) for k in (sky, None)]
    np.testing.assert_array_equal(fixes[0].lonlath, fixes[1].lonlath)


@pytest.mark.full
def test_a_street_canyon_degrades_fixes():
    s = spec("single", rate=0.02, arm=(0.0, 0.0, 1.6), constellations=("gps",))
    trajectory = standing(200_000.0)
    low, high = (view(trajectory, s, h)[0] for h in (1.0, 15.0))
    free, walled = (observe_gnss(trajectory, FRAME, spec=s, seed=4, start=START, sky=k) for k in (low, high))
    fixed = walled.quality > 0
    assert 0.1 < fixed.mean() < 1.0
    assert np.nanstd(walled.error[fixed, :2]) > 2 * np.std(free.error[:, :2])
    assert np.isnan(walled.lonlath[~fixed]).all()
    assert ((walled.satellites[~fixed] < 4) | (walled.dop[~fixed, 2] > 25.0)).all()


@pytest.mark.full
def test_in_a_street_of_five_storeys_four_systems_nearly_always_have_a_fix():
    """Errors are those of receivers in street canyons, 5 to 10 m, where GPS alone has no fix."""
    trajectory = standing(100_000.0)
    shares, errors = {}, {}
    for systems in (("gps",), SYSTEMS):
        s = spec("single", rate=0.02, arm=(0.0, 0.0, 1.6), constellations=systems)
        fixes = observe_gnss(trajectory, FRAME, spec=s, seed=4, start=START, sky=view(trajectory, s, 17.0)[0])
        shares[len(systems)] = (fixes.quality > 0).mean()
        errors[len(systems)] = np.nanstd(fixes.error[:, :2])
    assert shares[1] < 0.75
    assert shares[4] > 0.98
    assert 3.0 < errors[4] < 10.0


def test_rtk_degrades_at_once_and_recovers_after_the_settling_time():
    n, s = 200, spec("rtk", rate=10.0)
    visible = np.zeros((n, 24), bool)
    visible[:, :9] = True
    visible[50:60, 3:] = False  # three satellites for a second: a bridge
    elevation = np.tile(np.linspace(0.3, 1.4, 24), (n, 1))
    azimuth = np.tile(np.arange(24) * 2.4, (n, 1))
    sky = Sky(azimuth, elevation, visible, np.ones((n, 24), bool), np.zeros(n), satellite_names(("gps",)))
    fixes = observe_gnss(standing(19.9), FRAME, spec=s, seed=0, start=START, sky=sky)
    assert (fixes.quality[:50] == 4).all()
    assert (fixes.quality[50:89] == 0).all()  # ten epochs under the bridge, three seconds to settle less one
    assert (fixes.quality[90:] == 4).all()


# --------------------------------------------------------------------------------------------------- NMEA


def test_sentences_are_those_of_the_standard():
    assert sentence("GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,").endswith("*47\r\n")
    assert checksum("GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W") == "6A"
    assert latitude(-(48 + 7.038 / 60)) == "4807.038000,S"
    assert longitude(-7.0) == "00700.000000,W"
    assert latitude(59.99999999999) == "6000.000000,N"  # never 60 minutes


def read(lines):
    return [NMEAReader.parse(line.encode()) for line in lines]


@pytest.mark.parametrize("mode", ["single", "sbas", "rtk"])
def test_pynmeagps_reads_the_fixes(mode):
    fixes = observe_gnss(eastward(5.0), FRAME, spec=spec(mode, constellations=("gps",)), seed=1, start=START)
    lines = list(nmea(fixes, START))
    assert max(map(len, lines)) <= 82
    assert all(line.endswith("\r\n") for line in lines)
    messages = read(lines)
    assert [m.msgID for m in messages[:4]] == ["GGA", "RMC", "VTG", "GSA"]
    for k in (0, 17, len(fixes) - 1):
        gga, rmc, vtg, gsa = messages[4 * k : 4 * k + 4]
        lon, lat, h = fixes.lonlath[k]
        assert (gga.lat, gga.lon) == (pytest.approx(lat, abs=1e-8), pytest.approx(lon, abs=1e-8))
        assert (rmc.lat, rmc.lon) == (gga.lat, gga.lon)
        assert gga.alt == pytest.approx(h, abs=6e-4)
        assert gga.quality == fixes.quality[k]
        assert gga.numSV == fixes.satellites[k]
        assert abs(gga.HDOP - fixes.dop[k, 0]) < 0.051
        assert rmc.spd * 1852 / 3600 == pytest.approx(fixes.speed[k], abs=1e-3)
        assert vtg.sogk / 3.6 == pytest.approx(fixes.speed[k], abs=1e-3)
        assert rmc.cog == pytest.approx(np.degrees(fixes.course[k]), abs=0.051)
        assert rmc.status == "A"
        assert rmc.date == START.date()
        assert gga.time.microsecond == (fixes.time_ns[k] // 1000) % 10**6
        prn = [getattr(gsa, f"svid_{i:02d}") for i in range(1, 13)]
        assert [int(p) for p in prn if p != ""] == (np.flatnonzero(fixes.used[k]) + 1).tolist()[:12]
        assert gsa.navMode == 3


def test_a_receiver_of_four_systems_names_the_satellites_of_each():
    fixes = observe_gnss(eastward(1.0), FRAME, spec=spec("single"), seed=1, start=START)
    lines = list(nmea(fixes, START))
    assert max(map(len, lines)) <= 82
    assert all(line.startswith("$GN") for line in lines)
    gga, _, _, *gsa = read(lines[:7])
    assert gga.numSV == fixes.satellites[0] > 20
    assert [int(m.systemId) for m in gsa] == [1, 2, 3, 4]
    for message, letter, added in zip(gsa, "GREC", (0, 64, 0, 0), strict=True):
        own = [int(n[1:]) + added for n in fixes.names[fixes.used[0]].tolist() if n[0] == letter]
        said = [getattr(message, f"svid_{i:02d}") for i in range(1, 13)]
        assert [int(p) for p in said if p != ""] == own[:12]


def test_sentences_without_a_fix_have_empty_fields_and_quality_0():
    sky = Sky(
        *(np.full((6, 24), 0.5),) * 2, *(np.zeros((6, 24), bool),) * 2, np.ones(6), satellite_names(("gps",))
    )
    fixes = observe_gnss(standing(0.5), FRAME, spec=spec("single"), seed=0, start=START, sky=sky)
    gga, rmc, _, gsa = read(list(nmea(fixes, START))[:4])
    assert gga.quality == 0
    assert gga.lat == ""
    assert rmc.status == "V"
    assert gsa.navMode == 1


@pytest.mark.parametrize(
    ("vertical", "altitude"), [("ellipsoidal", 8.0), ("orthometric", -30.0), ("flat", -30.0)]
)
def test_sentences_give_the_geoid_separation(vertical, altitude):
    fixes = observe_gnss(standing(0.5, height=-30.0), FRAME, spec=spec(), seed=0, start=START)
    known = np.full(len(fixes), -38.0)
    gga = read(list(nmea(fixes, START, vertical=vertical, separation=known))[:1])[0]
    assert gga.alt == pytest.approx(altitude)
    assert gga.sep == -38.0
    plain = read(list(nmea(fixes, START, vertical=vertical))[:1])[0]
    assert (plain.alt, plain.sep) == (pytest.approx(-30.0), "")


@pytest.mark.parametrize(
    ("vertical", "geoid", "says"),
    [
        ("flat", "", "heights above an assumed level ground"),
        ("ellipsoidal", "", "heights above the ellipsoid"),
        ("ellipsoidal", "EGM96", "heights above the geoid (separation of EGM96)"),
    ],
)
def test_a_sentence_says_what_heights_are_above(vertical, geoid, says):
    line = height_note(vertical, geoid)
    assert len(line) <= 82
    assert read([line])[0].text == says


def test_the_geoid_comes_from_grids_that_proj_finds(tmp_path):
    """A grid of 20 m in GTX format: south-west corner, steps, rows and columns, then float32, big-endian."""
    place = np.array([-76.3]), np.array([36.9])
    assert geoid_at(*place) is None
    head = struct.pack(">4d2i", -90.0, -180.0, 10.0, 10.0, 19, 36)
    (tmp_path / "egm96_15.gtx").write_bytes(head + np.full((19, 36), 20.0, ">f4").tobytes())
    before = pyproj.datadir.get_data_dir()
    try:
        pyproj.datadir.set_data_dir(f"{before}{os.pathsep}{tmp_path}")
        found = geoid_at(*place)
    finally:
        pyproj.datadir.set_data_dir(before)
    assert found is not None
    assert found.name == "EGM96"
    assert found.separation == pytest.approx([20.0])


def test_columns_have_one_value_per_fix():
    fixes = observe_gnss(eastward(2.0), FRAME, spec=spec("rtk"), seed=1, start=START)
    columns = gnss_columns(fixes)
    assert {len(c) for c in columns.values()} == {21}
    assert columns["course_deg"][0] == pytest.approx(90.0 - 0.78, abs=0.5)
    assert (
        shapely.Point(columns["true_lon"][0], columns["true_lat"][0]).distance(
            shapely.Point(-76.3059, 36.8853)
        )
        < 1e-4
    )

"""Time at the extremes: a day, rates that do not divide each other, speeds, years and leap seconds."""

import itertools
import tracemalloc
from datetime import UTC, datetime, timedelta
from fractions import Fraction

import numpy as np
import pytest

from geoscene.geometry.frames import Frame
from lidar.geometry.attitude import Mount
from lidar.geometry.poses import Trajectory
from lidar.geometry.time_scales import GPS_EPOCH, LEAPS, check_start, gps_seconds, iso_times, leap_seconds
from lidar.sensors.navigation.gnss import epochs, observe_gnss
from lidar.sensors.navigation.imu import observe_imu
from lidar.sensors.navigation.nmea import nmea
from lidar.sensors.rig.devices import cameras, scanners
from lidar.sensors.rig.patterns.beams import frame_window_ns
from lidar.sensors.rig.specs import GnssSpec, ImuSpec, load_rig
from lidar.simulation.plan import schedule
from lidar.tools.selftest.run import outcome
from lidar.tools.selftest.times import CASES

FRAME = Frame.at(9.52, 47.14)
DAY_S = 86400
DAY_NS = DAY_S * 10**9
RATES = (0.1, 0.3, 1.0, 3.0, 7.0, 9.97, 10.0, 11.0, 12.5, 19.98, 23.976, 29.97, 30.0, 59.94, 70.0, 99.9)
MOUNT = Mount((0.0, 0.0, 1.5), (0.0, 0.0, 0.0, 1.0))


def straight(speed, seconds, *, every=1.0):
    """A straight, level drive to the east."""
    time = np.arange(0, round(seconds / every) + 1) * every
    n = len(time)
    east = np.tile([1.0, 0.0, 0.0], (n, 1))
    level = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
    at = np.round(time * 1e9).astype(np.int64)
    return Trajectory(at, east * (speed * time)[:, None], level, speed * east, np.ones(n))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_time_stays_within_the_bound(case):
    done = outcome(case, case.quick)
    assert done.error == ""
    assert done.measured <= case.bound


@pytest.mark.parametrize("rate", RATES)
def test_frames_of_a_day_start_within_a_nanosecond_of_their_time(rate):
    count = int(DAY_S * Fraction(str(rate)))
    draw = np.random.default_rng(1).integers(0, count, 500).tolist()
    for frame in (*range(50), *draw, *range(count - 50, count)):
        first, end = frame_window_ns(frame, rate, start_ns=7)
        exact = frame * 10**9 / Fraction(str(rate)) + 7
        assert isinstance(first, int)
        assert 0 <= exact - first < 1
        assert end == frame_window_ns(frame + 1, rate, start_ns=7)[0]


@pytest.mark.parametrize("rate", RATES)
def test_epochs_of_a_day_do_not_drift(rate):
    at = epochs(GnssSpec("gnss", MOUNT, rate_hz=rate), DAY_NS)
    assert at.dtype == np.int64
    assert len(at) == DAY_S * Fraction(str(rate)) // 1 + 1
    rows = np.linspace(0, len(at) - 1, 1000).astype(int)
    exact = [row * 10**9 / Fraction(str(rate)) for row in rows.tolist()]
    assert max(abs(Fraction(int(at[row])) - e) for row, e in zip(rows, exact, strict=True)) < 1
    steps = np.diff(at)
    assert steps.max() - steps.min() <= 1


def test_sensors_are_scheduled_in_order_of_time():
    rig = load_rig("seed")
    sensors = (*scanners(rig), *cameras(rig))
    until = 600 * 10**9
    jobs = schedule(sensors, until)
    assert len(jobs) == sum(sensor.frame_count(until) for sensor in sensors) > 10**4
    for rows in (slice(0, 300), slice(len(jobs) // 2, len(jobs) // 2 + 300), slice(-300, None)):
        starts = [job.start_ns for job in jobs[rows]]
        assert starts == sorted(starts)
    last = [jobs[len(jobs) - 1 - k] for k in range(20)]
    assert all(job.start_ns + job.sensor.period_ns <= until for job in last)


@pytest.mark.parametrize("speed", [0.0, 100.0])
def test_poses_at_a_days_end_are_exact_at_rest_and_at_100_m_s(speed):
    ego = straight(speed, DAY_S)
    late = DAY_NS - np.array([1, 999_999_999, 86_399_000_000_001])
    error = ego.at(late).position[:, 0] - speed * (late / 1e9)
    assert np.abs(error).max() < 1e-8 * max(speed, 1.0)
    # a point of the scene, as a sensor on the vehicle measures it at its own times
    late = DAY_NS - np.array([1, 20_000_001, 99_999_999])
    wall = ego.at(late).position[:, 0]
    seen = np.column_stack([5.0 + wall[0] - wall, np.full(3, 2.0), np.ones(3)])
    placed = ego.place(seen, late, translation=(0.0, 0.0, 1.5), rotation=np.eye(3))
    assert np.abs(placed - [5.0 + wall[0], 2.0, 2.5]).max() < 1e-7


def test_points_of_a_whole_day_are_placed_with_the_poses_that_they_need():
    ego = straight(20.0, DAY_S, every=10.0)
    draw = np.random.default_rng(3)
    time = draw.integers(0, DAY_NS, 5000)
    points = draw.uniform(-50, 50, (5000, 3))
    mount = {"translation": (1.0, 0.5, 1.5), "rotation": np.eye(3)}
    ego.place(points[:1], time[:1], **mount)  # compiles
    tracemalloc.start()
    placed = ego.place(points, time, **mount)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10_000_000
    at = np.array([1.0, 0.5, 1.5]) + np.outer(time * 2e-8, [1, 0, 0])
    np.testing.assert_allclose(placed, points + at, atol=1e-6)
    alone = [ego.place(points[k : k + 1], time[k : k + 1], **mount)[0] for k in range(50)]
    np.testing.assert_array_equal(placed[:50], alone)


@pytest.mark.parametrize("speed", [0.0, 100.0])
def test_receivers_and_units_at_rest_and_at_100_m_s(speed):
    ego = straight(speed, 60.0, every=0.01)
    imu = observe_imu(ego, FRAME, spec=ImuSpec("imu", MOUNT, rate_hz=7.0), seed=1)
    assert np.isfinite(imu.accel).all()
    assert np.abs(imu.true_accel[:, :2]).max() < 0.05  # Coriolis: 2 w v
    np.testing.assert_allclose(imu.true_accel[:, 2], 9.807, atol=0.05)
    spec = GnssSpec("gnss", MOUNT, rate_hz=3.0, mode="ideal")
    fixes = observe_gnss(ego, FRAME, spec=spec, seed=1, start=datetime(2026, 6, 21, tzinfo=UTC))
    np.testing.assert_allclose(fixes.speed, speed, atol=1e-3)
    assert np.isfinite(fixes.course).all()
    vtg = [line.split(",") for line in nmea(fixes, datetime(2026, 6, 21, tzinfo=UTC)) if "VTG" in line]
    np.testing.assert_allclose([float(cells[7]) for cells in vtg], 3.6 * speed, atol=0.01)


@pytest.mark.parametrize("year", range(1980, 2101, 10))
def test_stamps_of_all_years(year):
    start = datetime(year, 2, 28, 23, 59, 58, 500_000, tzinfo=UTC)
    check_start(start, 3 * 10**9)
    fixes = observe_gnss(
        straight(10.0, 3.0),
        FRAME,
        spec=GnssSpec("gnss", MOUNT, rate_hz=3.0, mode="ideal"),
        seed=1,
        start=start,
    )
    stamps = iso_times(start, fixes.time_ns)
    rmc = [line.split(",") for line in nmea(fixes, start) if "RMC" in line]
    for stamp, cells, ns in zip(stamps, rmc, fixes.time_ns.tolist(), strict=True):
        moment = start + timedelta(microseconds=ns / 1000)
        assert abs(datetime.fromisoformat(stamp[:26] + "+00:00") - moment) <= timedelta(microseconds=1)
        hundredths = moment + timedelta(milliseconds=5)
        assert (cells[9], cells[1][:6]) == (f"{hundredths:%d%m%y}", f"{hundredths:%H%M%S}")
    assert rmc[0][9] == f"2802{year % 100:02d}"
    following = 29 if year % 4 == 0 and year != 2100 else 1  # 2000 is a leap year, 2100 is not
    assert int(rmc[-1][9][:2]) == following
    # GPS time of LAS files: doubles about 1e9 s from the epoch resolve half a microsecond
    seconds = gps_seconds(start, fixes.time_ns) + 1e9
    exact = (start - GPS_EPOCH).total_seconds() + leap_seconds(start) + fixes.time_ns / 1e9
    assert np.abs(seconds - exact).max() < 5e-7
    assert (np.diff(seconds) > 0).all()


@pytest.mark.parametrize("epoch", [0, 1024, 2048, 3072])
def test_gps_time_goes_on_where_ten_bit_weeks_begin_again(epoch):
    rollover = GPS_EPOCH + timedelta(weeks=epoch)
    rollover -= timedelta(seconds=leap_seconds(rollover))  # in UTC
    start = max(rollover - timedelta(seconds=1), GPS_EPOCH)
    elapsed = gps_seconds(start, np.array([0, 10**9, 2 * 10**9])) + 1e9
    assert np.diff(elapsed).tolist() == [1.0, 1.0]
    assert elapsed[round((rollover - start).total_seconds())] == epoch * 604_800


@pytest.mark.parametrize("leap", LEAPS)
def test_leap_seconds_part_drives(leap):
    before, after = leap - timedelta(seconds=1), leap
    step = float(np.diff([gps_seconds(when, np.zeros(1, np.int64))[0] for when in (before, after)])[0])
    assert step == 2.0  # the leap second lies between
    check_start(leap - timedelta(seconds=10), 9 * 10**9)
    check_start(leap, DAY_NS)


def test_time_stamps_of_a_day_are_all_different():
    at = epochs(GnssSpec("gnss", MOUNT, rate_hz=29.97), DAY_NS)
    stamps = iso_times(datetime(2099, 12, 31, 12, tzinfo=UTC), at[-2000:])
    assert all(one < other for one, other in itertools.pairwise(stamps))
    assert stamps[-1] == "2100-01-01T12:00:00.000000000Z"

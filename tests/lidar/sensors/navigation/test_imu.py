"""Inertial units measure rotation and specific force with the noise of their Allan parameters."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geoscene.geometry.frames import Frame
from lidar.geometry.attitude import Mount, quat_from_euler
from lidar.geometry.poses import Trajectory
from lidar.sensors.navigation.imu import (
    EARTH_RATE,
    imu_columns,
    inertial_noise,
    normal_gravity,
    observe_imu,
    true_inertial,
)
from lidar.sensors.rig.imu_grades import PRESETS
from lidar.sensors.rig.specs import ImuSpec

FRAME = Frame.at(13.377704, 52.516275)
PHI = np.radians(52.516275)
TIMES = np.arange(0, 10_000_000_000, 10_000_000)
SILENT = {"gyro_noise": 0.0, "gyro_walk": 0.0, "accel_noise": 0.0, "accel_walk": 0.0}


def allan_deviation(rate, rate_hz, *, windows):
    """Overlapping Allan deviation (w, k) of readings (n, k) for averaging windows (w,), in readings."""
    total = np.concatenate([np.zeros((1, rate.shape[1])), np.cumsum(rate, axis=0)]) / rate_hz
    out = np.empty((len(windows), rate.shape[1]))
    for row, m in enumerate(windows):
        second = total[2 * m :] - 2 * total[m:-m] + total[: -2 * m]
        out[row] = np.sqrt((second**2).mean(axis=0) / 2) * rate_hz / m
    return out


def track(position, velocity, quat):
    t = TIMES * 1e-9
    n = len(t)
    return Trajectory(
        TIMES, np.broadcast_to(position, (n, 3)), np.broadcast_to(quat, (n, 4)),
        np.broadcast_to(velocity, (n, 3)), np.ones(n),
    )  # fmt: skip


def observed(trajectory, *, spec, seed):
    return observe_imu(trajectory, FRAME, spec=spec, seed=seed)


def test_gravity_is_that_of_wgs84():
    assert normal_gravity(0.0, 0.0) == pytest.approx(9.7803253359, abs=1e-10)
    assert normal_gravity(90.0, 0.0) == pytest.approx(9.8321849378, abs=1e-7)
    assert normal_gravity(45.0, 1000.0) == pytest.approx(9.8061977693 - 3.086e-3, abs=1e-6)


@pytest.mark.parametrize("tilt", [0.0, 0.3, 2.5])
def test_an_imu_at_rest_measures_gravity_and_the_earth_rate(tilt):
    still = track(np.zeros(3), np.zeros(3), quat_from_euler(tilt, 0.0, gamma=np.pi / 2))  # heading north
    rate, force = true_inertial(still, FRAME, spec=ImuSpec("imu", Mount()), time_ns=TIMES)
    g = float(normal_gravity(52.516275, 0.0))
    np.testing.assert_allclose(
        force, np.broadcast_to([0, g * np.sin(tilt), g * np.cos(tilt)], force.shape), atol=1e-9
    )
    # along the nose, north: the Earth's rate times the cosine of the latitude
    np.testing.assert_allclose(rate[:, 0], EARTH_RATE * np.cos(PHI), atol=1e-12)
    assert np.linalg.norm(rate, axis=1) == pytest.approx(EARTH_RATE)


def circling(radius=20.0, rate=0.3):
    t = TIMES * 1e-9
    yaw = rate * t
    position = radius * np.column_stack([np.sin(yaw), 1 - np.cos(yaw), 0 * t])
    velocity = radius * rate * np.column_stack([np.cos(yaw), np.sin(yaw), 0 * t])
    return Trajectory(TIMES, position, quat_from_euler(0 * t, 0 * t, gamma=yaw), velocity, np.ones(len(t)))


def test_an_imu_on_a_circle_measures_yaw_rate_and_centripetal_acceleration():
    rate, force = true_inertial(circling(), FRAME, spec=ImuSpec("imu", Mount()), time_ns=TIMES)
    inner = slice(2, -2)
    np.testing.assert_allclose(rate[inner, 2], 0.3 + EARTH_RATE * np.sin(PHI), atol=1e-9)
    coriolis = 2 * EARTH_RATE * np.sin(PHI) * 6.0
    np.testing.assert_allclose(force[inner, 1], 0.3**2 * 20.0 + coriolis, atol=2e-5)
    np.testing.assert_allclose(force[inner, 0], 0.0, atol=1e-4)


def test_an_imu_off_the_axle_measures_its_lever_arm_in_its_own_axes():
    turned = Rotation.from_euler("z", 90, degrees=True).as_quat()
    off = ImuSpec("imu", Mount((2.0, 0.0, 0.0), tuple(turned)))
    _, axle = true_inertial(circling(), FRAME, spec=ImuSpec("imu", Mount()), time_ns=TIMES)
    _, force = true_inertial(circling(), FRAME, spec=off, time_ns=TIMES)
    inner = slice(2, -2)
    # 2 m ahead, -omega^2 l along the nose; the unit's x axis points left
    np.testing.assert_allclose(force[inner, 1], -axle[inner, 0] + 0.3**2 * 2.0, atol=1e-4)
    np.testing.assert_allclose(force[inner, 0], axle[inner, 1], atol=1e-4)


def test_dead_reckoning_of_the_true_signals_reproduces_the_drive():
    trajectory = circling()
    rate, force = true_inertial(trajectory, FRAME, spec=ImuSpec("imu", Mount()), time_ns=TIMES)
    earth = EARTH_RATE * np.array([0.0, np.cos(PHI), np.sin(PHI)])
    turn, v, x = Rotation.from_quat(trajectory.quat_xyzw[0]), trajectory.velocity[0].copy(), np.zeros(3)
    for k in range(len(TIMES) - 1):
        omega = 0.5 * (rate[k] + rate[k + 1]) - turn.inv().apply(earth)
        middle = turn * Rotation.from_rotvec(omega * 0.005)
        a = middle.apply(0.5 * (force[k] + force[k + 1])) - np.cross(2 * earth, v)
        a[2] -= normal_gravity(52.516275, 0.0)
        x = x + (v + a * 0.005) * 0.01
        v = v + a * 0.01
        turn = turn * Rotation.from_rotvec(omega * 0.01)
    np.testing.assert_allclose(x, trajectory.position[-1], atol=0.02)
    np.testing.assert_allclose(v, trajectory.velocity[-1], atol=0.01)


@pytest.mark.full
@pytest.mark.parametrize("name", ["adis16448", "tactical"])
def test_allan_deviation_is_that_of_the_parameters(name):
    p = PRESETS[name]
    values = {k: getattr(p, k) for k in ("gyro_noise", "gyro_walk", "accel_noise", "accel_walk")}
    spec = ImuSpec("imu", Mount(), rate_hz=20.0, **values)
    noise = inertial_noise(spec, 400_000, seed=2)
    windows = np.array([1, 4, 20, 100, 400, 2000])
    tau = windows / 20.0
    measured = allan_deviation(noise, 20.0, windows=windows)
    for columns, n, k in (
        (slice(0, 3), p.gyro_noise, p.gyro_walk),
        (slice(3, 6), p.accel_noise, p.accel_walk),
    ):
        expected = np.sqrt(n**2 / tau + k**2 * tau / 3)
        np.testing.assert_allclose(np.sqrt((measured[:, columns] ** 2).mean(axis=1)), expected, rtol=0.12)
        # single readings are as noisy as the bandwidth says
    assert np.diff(noise[:, 0]).std() / np.sqrt(2) == pytest.approx(p.gyro_noise * np.sqrt(20.0), rel=0.02)


@pytest.mark.full
def test_the_bias_has_the_given_instability():
    spec = ImuSpec(
        "imu", Mount(), rate_hz=10.0, **SILENT, gyro_instability=2.18e-6, accel_instability=7.35e-4
    )
    noise = np.concatenate([inertial_noise(spec, 100_000, seed=seed) for seed in range(4)], axis=1)
    measured = allan_deviation(noise, 10.0, windows=np.array([20, 100, 400, 1500]))
    for columns, b in ((slice(0, 3), 2.18e-6), (slice(3, 6), 7.35e-4)):
        every = np.concatenate([measured[:, 6 * k :][:, columns] for k in range(4)], axis=1)
        np.testing.assert_allclose(np.sqrt((every**2).mean(axis=1)), 0.664 * b, rtol=0.08)


def test_white_noise_and_random_walk_cross_at_the_published_time():
    p = PRESETS["adis16448"]
    assert np.sqrt(3) * p.gyro_noise / p.gyro_walk == pytest.approx(15.2, abs=0.1)


def test_a_reading_does_not_depend_on_later_motion():
    whole = circling()
    half = Trajectory(
        *(getattr(whole, f)[:500] for f in ("time_ns", "position", "quat_xyzw", "velocity", "scale"))
    )
    spec = ImuSpec("imu", Mount(), rate_hz=200.0)
    one, two = observed(half, spec=spec, seed=5), observed(whole, spec=spec, seed=5)
    n = len(one.time_ns) - 4  # the last differences are one-sided
    np.testing.assert_array_equal(one.gyro[:n], two.gyro[:n])
    np.testing.assert_array_equal(one.accel[:n], two.accel[:n])
    assert (observed(whole, spec=spec, seed=6).gyro != two.gyro).all()


def test_an_imu_without_noise_reports_the_truth():
    rows = observed(circling(), spec=ImuSpec("imu", Mount(), rate_hz=50.0, **SILENT), seed=0)
    np.testing.assert_array_equal(rows.gyro, rows.true_gyro)
    np.testing.assert_array_equal(rows.accel, rows.true_accel)
    np.testing.assert_array_equal(np.diff(rows.time_ns), 20_000_000)
    columns = imu_columns(rows)
    assert list(columns)[:4] == ["time_ns", "gyro_x", "gyro_y", "gyro_z"]
    assert {len(c) for c in columns.values()} == {len(rows.time_ns)}


@pytest.mark.parametrize("offset_ns", [0, 3_000_000, 20_000_000_000])
def test_measurements_are_the_truth_plus_noise(offset_ns):
    spec = ImuSpec(
        "imu", Mount(), rate_hz=170.0, gyro_instability=2e-6, accel_instability=7e-4, time_offset_ns=offset_ns
    )
    whole = observed(circling(), spec=spec, seed=4)
    noise = inertial_noise(spec, len(whole), seed=4)
    np.testing.assert_array_equal(whole.gyro, whole.true_gyro + noise[:, :3])
    np.testing.assert_array_equal(whole.accel, whole.true_accel + noise[:, 3:])

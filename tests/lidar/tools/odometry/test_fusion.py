"""Fusion of fixes, inertial samples and odometry: known drives, wrong fixes, and outages."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.map_data import FRAME
from pyproj import Geod
from scipy.spatial.transform import Rotation

from geoscene.geometry.frames import Frame
from lidar.errors import DatasetError, InputError
from lidar.options.trajectories import OdometryOptions
from lidar.sensors.navigation.measurements import NAMES, Fixes, Inertial
from lidar.sensors.rig.imu_grades import PRESETS
from lidar.tools.odometry.fusion import Fixed, Unit, fixes_of, fuse_measurements
from lidar.tools.odometry.run import estimate_motion
from lidar.tools.odometry.settings import OdometrySettings

from .test_recorded import drive  # noqa: F401

SETTINGS = OdometrySettings()
LEVER = np.array([0.6, 0.2, 1.6])
GRAVITY = 9.81
SPEED, TURN = 8.0, 0.15


def poses_at(seconds):
    """Poses (n, 4, 4) on a level circle, far from the origin."""
    yaw = TURN * seconds
    out = np.tile(np.eye(4), (len(seconds), 1, 1))
    out[:, :3, :3] = Rotation.from_euler("z", yaw[:, None]).as_matrix()
    out[:, 0, 3], out[:, 1, 3], out[:, 2, 3] = (
        400 + SPEED / TURN * np.sin(yaw),
        -SPEED / TURN * np.cos(yaw),
        30,
    )
    return out


def fixes(*, seconds=20.0, sigma=0.0, stated=None, rng=None):
    """Fixes five times a second; by default exact ones."""
    t = np.arange(0, seconds + 1e-9, 0.2)
    true = poses_at(t)
    position = true[:, :3, 3] + true[:, :3, :3] @ LEVER
    if rng is not None:
        position = position + rng.normal(0, sigma, position.shape)
    velocity = SPEED * true[:, :3, 0] + np.cross([0, 0, TURN], true[:, :3, :3] @ LEVER)
    spread = np.full(position.shape, stated or max(sigma, 0.02))
    return Fixed(
        np.round(t * 1e9).astype(np.int64), position, velocity, spread, np.full(position.shape, 0.1),
        np.ones(len(t), np.int64), LEVER, 1.0,
    )  # fmt: skip


def unit(*, bias=(0.05, -0.03, 0.02), gyro_bias=(0.001, -0.002, 0.003), seconds=20.0, grade="vn100"):
    """Samples of a unit that is mounted turned, ahead of the axle: what it feels on the circle."""
    t = np.arange(0, seconds + 1e-9, 0.01)
    mount = np.eye(4)
    mount[:3, :3] = Rotation.from_euler("xyz", [0.02, -0.05, 0.7]).as_matrix()
    mount[:3, 3] = [1.0, 0.3, 0.5]
    rate = np.tile([0, 0, TURN], (len(t), 1))
    force = np.tile([-(TURN**2) * mount[0, 3], SPEED * TURN - TURN**2 * mount[1, 3], GRAVITY], (len(t), 1))
    turned = mount[:3, :3]
    samples = Inertial(
        np.round(t * 1e9).astype(np.int64), rate @ turned + gyro_bias, force @ turned + bias,
        np.empty((0, 3)), np.empty((0, 3)),
    )  # fmt: skip
    return Unit(samples, PRESETS[grade], mount, GRAVITY, np.zeros(3))


KNOTS = np.arange(0, 101) * 200_000_000


def steps(*, longer=0.0):
    true = poses_at(KNOTS * 1e-9)
    out = np.linalg.inv(true[:-1]) @ true[1:]
    out[:, :3, 3] *= 1 + longer
    return out


def errors(found):
    return np.linalg.norm(found.poses[:, :3, 3] - poses_at(KNOTS * 1e-9)[:, :3, 3], axis=1)


def run(given, **words):
    words = {"unit": None, "steps": None, "step_sigma": None} | words
    return fuse_measurements(KNOTS, given, settings=SETTINGS, **words)


@pytest.mark.full
@pytest.mark.parametrize("how", ["imu", "odometry", "both"])
def test_exact_measurements_give_the_true_poses(how):
    """Lever arms, a unit that is mounted turned, and its biases are taken into account."""
    words = {"unit": unit()} if how != "odometry" else {}
    if how != "imu":
        words |= {"steps": steps(), "step_sigma": np.full((100, 6), 0.005)}
    found = run(fixes(), **words)
    assert errors(found).max() < 0.1
    heading = np.arctan2(found.poses[:, 1, 0], found.poses[:, 0, 0]) - TURN * KNOTS * 1e-9
    assert np.abs(np.angle(np.exp(1j * heading))).max() < 0.02
    assert found.used.all()


def test_fixes_on_both_sides_carry_a_unit_through_an_outage():
    """Four seconds without fixes, as under a bridge."""
    given = fixes()
    seconds = given.time_ns * 1e-9
    on = (seconds < 8) | (seconds > 12)
    names = ("time_ns", "position", "velocity", "sigma", "velocity_sigma", "quality")
    part = Fixed(*(getattr(given, name)[on] for name in names), LEVER, 1.0)
    found = run(part, unit=unit())
    assert errors(found).max() < 0.3
    within = (KNOTS > 9e9) & (KNOTS < 11e9)
    assert found.sigma[within, 3].min() > found.sigma[KNOTS < 7e9, 3].max()


@pytest.mark.parametrize("grade", PRESETS)
@pytest.mark.parametrize("stated", [0.02, 2.0])
def test_short_drives_with_any_unit_have_poses_and_deviations(grade, stated):
    """Biases are known to 1e-5 rad/s and places to metres: normal equations of both have no digits left."""
    time_ns = np.arange(0, 41) * 50_000_000
    found = fuse_measurements(
        time_ns,
        fixes(seconds=2.0, stated=stated),
        unit=unit(seconds=2.0, grade=grade),
        steps=None,
        step_sigma=None,
        settings=SETTINGS,
    )
    off = found.poses[:, :3, 3] - poses_at(time_ns * 1e-9)[:, :3, 3]
    assert np.linalg.norm(off, axis=1).max() < 0.3
    assert (found.sigma > 0).all()
    assert found.sigma[:, 3:].max() < 2.5 * max(stated, 0.1)


def test_multipath_is_gated_and_does_not_pull():
    """Fixes of six of twenty seconds are 12 m off, but claim 0.5 m."""
    rng = np.random.default_rng(0)
    given = fixes(sigma=0.3, stated=0.5, rng=rng)
    wrong = (given.time_ns > 9e9) & (given.time_ns < 15e9)
    given.position[wrong] += [10.0, -6.0, 3.0]
    found = run(given, unit=unit(), steps=steps(longer=0.003), step_sigma=np.full((100, 6), 0.01))
    assert not found.used[wrong].any()
    assert found.used[~wrong].mean() > 0.95
    assert errors(found).max() < 1.0


def test_the_test_leaves_good_fixes_in_place():
    """Of fixes with the errors that they state, the chi-square test leaves out about one in a thousand."""
    found = run(
        fixes(sigma=0.5, rng=np.random.default_rng(1)), steps=steps(), step_sigma=np.full((100, 6), 0.005)
    )
    assert found.used.mean() > 0.97


def test_fixes_without_odometry_and_unit_still_give_poses():
    found = run(fixes(sigma=0.1, rng=np.random.default_rng(2)))
    assert errors(found).max() < 0.6


def test_a_vehicle_at_rest_has_no_heading():
    given = fixes()
    given.velocity[:] = 0
    with pytest.raises(DatasetError, match="no fix while the vehicle moves"):
        run(given)


def fixed_of(monkeypatch, frame, **columns):
    """What fusion makes of three fixes in a frame, a second apart, with some of their columns."""
    count, none = 3, np.full((3, 3), np.nan)
    recorded = Fixes(
        time_ns=np.arange(count) * 10**9,
        state=np.full(count, NAMES.index("single"), np.int8),
        quality=np.ones(count, np.int8),
        satellites=np.full(count, 32, np.int8),
        dop=np.ones((count, 3)),
        lonlath=np.tile([24.945, 60.167, 5.0], (count, 1)),
        speed=np.full(count, 5.0),
        course=np.zeros(count),
        error=none,
        true_lonlath=none,
        true_velocity=none,
        used=np.ones((count, 4), bool),
        names=np.array(["G01", "R65", "E02", "C03"]),
    )
    recorded = replace(recorded, **columns)
    monkeypatch.setattr("lidar.tools.odometry.fusion.read_fixes", lambda *_, **__: (recorded, None))
    sensor = {"gnss": {"vehicle_from_sensor": np.eye(4).tolist()}}
    return fixes_of(SimpleNamespace(frame=frame, paths=None, sensors=lambda _: sensor), "gnss")


def test_fixes_in_utm_are_in_true_metres_and_their_course_is_from_true_north(monkeypatch):
    """Two and a half degrees east of the central meridian, where grid north is 2.2 degrees from north."""
    frame = Frame.at(23.5, 60.167, crs="utm")
    away = np.array([0.0, 500.0, 1000.0])
    lon, lat, back = Geod(ellps="WGS84").fwd(np.full(3, 23.5), np.full(3, 60.167), np.full(3, 30.0), away)
    given = fixed_of(
        monkeypatch,
        frame,
        lonlath=np.column_stack([lon, lat, np.full(3, 5.0)]),
        course=np.radians(np.asarray(back) + 180.0),
        speed=np.full(3, 500.0),
    )
    step = given.position[1:] - given.position[:-1]
    assert abs(given.scale - 1) > 1e-4
    np.testing.assert_allclose(np.linalg.norm(step, axis=1), 500.0, atol=0.01)
    np.testing.assert_allclose(given.velocity[:-1], step, atol=0.1)


def test_fixes_with_few_satellites_state_multipath(monkeypatch):
    """Of 32 satellites of four systems 12 are left; 7.5 m and 15 m are the errors where all are hidden."""
    dop = np.array([[1.0, 1, 1], [1, 1, 1], [2, 3, 3]])
    satellites = np.array([32, 12, 12], np.int8)
    sigma = fixed_of(monkeypatch, FRAME, dop=dop, satellites=satellites).sigma
    open_sky = np.hypot([0.3, 0.3, 0.6], [1.5, 1.5, 2.5])
    np.testing.assert_allclose(sigma[0], open_sky)
    np.testing.assert_allclose(sigma[1], np.hypot(open_sky, 0.625 * np.array([7.5, 7.5, 15])))
    np.testing.assert_allclose(sigma[2], sigma[1] * [2, 2, 3])


@pytest.mark.full
@pytest.mark.parametrize("relative", ["small_gicp", "none"])
def test_a_recorded_drive_is_georeferenced(drive, tmp_path, relative):  # noqa: F811
    """No farther off than the fixes, which among buildings are by tens of metres, and as far as it says."""
    options = OdometryOptions(method="fused", relative=relative)
    estimate = estimate_motion(drive.path, tmp_path / "e", options=options).estimate
    true = drive.trajectory().at(estimate.time_ns)
    off = estimate.poses[:, :3, 3] - true.position / true.scale
    fixed = fixes_of(drive, "gnss")
    here = drive.trajectory().at(fixed.time_ns)
    wrong = fixed.position - (here.position + here.rotation @ fixed.lever) / here.scale
    assert np.linalg.norm(off, axis=1).max() < np.linalg.norm(wrong, axis=1).max()
    assert math.sqrt((off**2).sum(axis=1).mean()) < 4 * math.sqrt(
        (estimate.sigma[:, 3:] ** 2).sum(axis=1).mean()
    )
    turned = Rotation.from_matrix(np.swapaxes(true.rotation, 1, 2) @ estimate.poses[:, :3, :3]).magnitude()
    assert np.degrees(turned).max() < 5
    report = estimate.report
    assert "gnss" in report["sensors"]
    assert "imu" in report["sensors"]
    assert "right" in report["sensors_not_used"]
    assert sum(report["fixes"]["used"].values()) > 5
    header = (tmp_path / "e" / "poses.csv").read_text().split("\n")[0].split(",")
    assert {"lon", "lat", "sigma_x"} <= set(header)


def test_options_that_do_not_fit_are_refused():
    with pytest.raises(InputError, match=r"`relative` 'fast' is unknown \(known are none, "):
        OdometryOptions(method="fused", relative="fast")
    with pytest.raises(InputError, match=r"`imu_grade` 'cheap' is unknown \(known are adis16448"):
        OdometryOptions(method="fused", imu_grade="cheap")
    with pytest.raises(InputError, match="are for the `method` fused"):
        OdometryOptions(method="orb", relative="none")
    with pytest.raises(InputError, match="`start_pose`: fused begins"):
        OdometryOptions(method="fused", start_pose=(0.0,) * 6)

"""Maps from measured poses: what fixes, files and registration make of a trajectory that is known."""

import json
from datetime import timedelta

import laspy
import numpy as np
import pytest
from helpers.map_data import MOUNT, START, dataset, trajectory
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geoscene.support.progress import silent
from lidar.dataset.formats import FORMATS
from lidar.dataset.recorded import Stream
from lidar.errors import FormatError, InputError
from lidar.geometry.time_scales import posix_ns
from lidar.geometry.trajectory_tum import read_tum, write_tum
from lidar.options import MapOptions
from lidar.tools.maps.aggregate import aggregate
from lidar.tools.maps.aligned_motion import aligned_motion
from lidar.tools.maps.measured_poses import MeasuredPositions, RelativeMotion, measured_motion, poses_by_fixes
from lidar.tools.maps.pose_graph import fit_poses

LEVER = np.array([0.6, 0.2, 1.6])


def circle(count, *, radius=60.0, step=0.1):
    """Poses (count, 4, 4) on a circle, level, heading along it: 6 m each."""
    angle = 0.7 + np.arange(count) * step
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("z", angle[:, None]).as_matrix()
    poses[:, 0, 3], poses[:, 1, 3] = radius * np.sin(angle) + 200, -radius * np.cos(angle) - 90
    return poses


def fixes_of(poses, *, sigma, rng, outliers=0):
    """A fix at each pose but the last, each second, with noise, and some far off."""
    position = poses[:-1, :3, 3] + poses[:-1, :3, :3] @ LEVER
    position = position + rng.normal(0, sigma, position.shape)
    position[:outliers] += [40.0, -25.0, 10.0]
    yaw = np.unwrap(np.arctan2(poses[:-1, 1, 0], poses[:-1, 0, 0]))
    time_ns = np.arange(len(position)) * 10**9
    shape = np.full((len(position), 3), max(sigma, 0.01))
    return MeasuredPositions(time_ns, position, shape, yaw, np.full(len(position), 6.0), LEVER, 1.0)


def motion_of(poses, *, longer=0.0, turned=0.0):
    """The motion between poses that are a second apart, each step too long by a share and turned too far."""
    step = np.linalg.inv(poses[:-1]) @ poses[1:]
    step[:, :3, 3] *= 1 + longer
    step[:, :3, :3] = step[:, :3, :3] @ Rotation.from_euler("z", [turned]).as_matrix()
    sigma = np.tile([0.002] * 3 + [0.02] * 3, (len(step), 1))
    return RelativeMotion(np.arange(len(poses)) * 10**9, step, sigma)


def errors(found, true):
    return np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1)


def rms(values):
    return np.sqrt((values**2).mean())


@pytest.mark.parametrize("count", [3, 60, 400])
def test_exact_fixes_and_motion_give_the_true_poses(count):
    true = circle(count)
    fixes = fixes_of(true, sigma=0.0, rng=np.random.default_rng(0))
    found = fit_poses(motion_of(true), fixes)
    assert errors(found, true).max() < 1e-4
    assert (
        Rotation.from_matrix(np.swapaxes(found[:, :3, :3], 1, 2) @ true[:, :3, :3]).magnitude().max() < 1e-5
    )


@pytest.mark.parametrize("outliers", [0, 8])
def test_a_graph_is_nearer_to_the_truth_than_fixes_and_motion(outliers):
    true, rng = circle(60), np.random.default_rng(1)
    fixes = fixes_of(true, sigma=1.0, rng=rng, outliers=outliers)
    motion = motion_of(true, longer=0.002, turned=0.001)
    found = errors(fit_poses(motion, fixes), true)
    by_motion = errors(true[0] @ motion.poses(), true)
    by_fixes = errors(poses_by_fixes(fixes, fixes.time_ns), true[:-1])
    assert rms(found) < 0.6 * rms(by_fixes)
    assert rms(found) < 0.5 * rms(by_motion)


@pytest.mark.parametrize("slope", [-0.2, 0.1])
def test_a_drive_on_a_hill_is_not_levelled(slope):
    """Precise fixes tell the heights of a street of 10 or 20 %, however firm the motion is."""
    true = circle(60, radius=600.0, step=0.01)
    pitch = -np.arctan(slope)
    true[:, :3, :3] = true[:, :3, :3] @ Rotation.from_euler("y", [pitch]).as_matrix()
    true[:, 2, 3] = slope * 6.0 * np.arange(60)
    motion = motion_of(true)
    motion.sigma[:] = [0.0006] * 3 + [0.006] * 3
    found = fit_poses(motion, fixes_of(true, sigma=0.02, rng=np.random.default_rng(0)))
    assert errors(found, true).max() < 0.1


def test_precise_fixes_before_an_outage_place_the_poses_within_it():
    """Half of the drive has fixes to 1 cm, and half of them 3 m off: the motion carries the first on."""
    true = circle(60)
    fixes = fixes_of(true, sigma=0.0, rng=np.random.default_rng(0))
    fixes.position[30:] += [2.0, -2.0, 1.0]
    fixes.sigma[30:] = 1.0
    motion = motion_of(true)
    motion.sigma[:] = [0.0006] * 3 + [0.006] * 3
    assert errors(fit_poses(motion, fixes), true).max() < 0.3


def test_poses_by_exact_fixes_are_the_true_ones():
    true = circle(30)
    fixes = fixes_of(true, sigma=0.0, rng=np.random.default_rng(0))
    found = poses_by_fixes(fixes, fixes.time_ns)
    np.testing.assert_allclose(found, true[:-1], atol=1e-9)


def test_speeds_of_an_antenna_off_the_rear_axle_give_the_axle_s_motion():
    """On a circle of 60 m the antenna at (0.6, 0.2) drives one of 59.8 m, and 0.6 m ahead."""
    poses = circle(601, step=0.01)
    fixes = fixes_of(poses, sigma=0.0, rng=np.random.default_rng(0))
    time_ns = np.arange(601) * 10**8
    speed = np.hypot(60.0 - 0.2, 0.6) * 0.1
    fixes = MeasuredPositions(time_ns[:-1], *(getattr(fixes, k) for k in ("position", "sigma", "yaw")),
                     np.full(600, speed), LEVER, 1.0)  # fmt: skip
    found = measured_motion(None, fixes, unit="", time_ns=time_ns[100:500])
    true = np.linalg.inv(poses[100:499]) @ poses[101:500]
    np.testing.assert_allclose(found.step, true, atol=1e-5)


def test_true_poses_are_not_refined():
    with pytest.raises(InputError, match="`refine`"):
        MapOptions(refine=True)


numbers = st.floats(-1e6, 1e6)


@settings(deadline=None, max_examples=50)
@given(
    seconds=st.lists(st.integers(0, 10**18), min_size=2, max_size=9, unique=True),
    position=st.tuples(numbers, numbers, numbers),
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
)
def test_tum_files_hold_poses_exactly(tmp_path_factory, seconds, position, turn):
    path = tmp_path_factory.mktemp("tum") / "t.tum"
    time_ns = np.sort(np.array(seconds, np.int64))
    place = np.tile(position, (len(time_ns), 1))
    quat = np.tile(Rotation.from_rotvec(turn).as_quat(), (len(time_ns), 1))
    write_tum(path, time_ns, position=place, quat_xyzw=quat)
    back = read_tum(path)
    for found, given_one in zip(back, (time_ns, place, quat), strict=True):
        np.testing.assert_array_equal(found, given_one)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "0 poses"),
        ("1 0 0 0 0 0 0 1\n", "1 poses"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "do not increase"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 1\n", "line 2: 7 numbers"),
        ("# comment\n1 0 0 zero 0 0 0 1\n", "line 2: not numbers"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 2\n", "unit quaternions"),
        ("1 0 0 nan 0 0 0 1\n2 0 0 0 0 0 0 1\n", "not finite"),
        ("1e30 0 0 0 0 0 0 1\n2e30 0 0 0 0 0 0 1\n", "POSIX"),
        ("nan 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n", "line 1: not numbers"),
    ],
)
def test_damaged_tum_files_are_refused(tmp_path, text, message):
    (tmp_path / "t.tum").write_text(text)
    with pytest.raises(FormatError, match=message):
        read_tum(tmp_path / "t.tum")


def tum_of(path, *, until=10.0, shift=(0.0, 0.0, 0.0), start=START):
    """The true trajectory of `dataset`, moved, as a TUM file."""
    true = trajectory()
    keep = true.time_ns <= until * 1e9
    write_tum(
        path,
        posix_ns(start) + true.time_ns[keep],
        position=true.position[keep] / [true.scale[0], true.scale[0], 1] + shift,
        quat_xyzw=true.quat_xyzw[keep],
    )
    return path


def points_of(path):
    las = laspy.read(path)
    return np.column_stack([las.x, las.y, las.z])


def test_a_file_of_poses_places_the_points_and_its_error_is_stated(tmp_path):
    data = dataset(tmp_path / "d", kinds=("pcd",))
    aggregate(data, tmp_path / "true.laz")
    moved = str(tum_of(tmp_path / "moved.tum", shift=(3.0, 4.0, 1.0)))
    summary = aggregate(data, tmp_path / "m.laz", options=MapOptions(poses=moved))
    away = points_of(tmp_path / "m.laz") - points_of(tmp_path / "true.laz")
    assert np.abs(np.hypot(away[:, 0], away[:, 1]) - 5.0).max() < 0.01
    assert np.abs(away[:, 2] - 1.0).max() < 0.002
    assert summary.poses.horizontal_m == pytest.approx(5.0, abs=1e-3)
    assert summary.poses.vertical_m == pytest.approx(1.0, abs=1e-6)
    assert summary.poses.yaw_deg == pytest.approx(0.0, abs=1e-6)
    assert tmp_path / "m.tum" in summary.beside
    again = aggregate(data, tmp_path / "again.laz", options=MapOptions(poses=str(tmp_path / "m.tum")))
    assert again.points == summary.points
    np.testing.assert_allclose(points_of(tmp_path / "again.laz"), points_of(tmp_path / "m.laz"), atol=0.0011)


def test_returns_of_times_without_poses_are_left_out_and_counted(tmp_path):
    data = dataset(tmp_path / "d", kinds=("pcd",))
    given_poses = str(tum_of(tmp_path / "t.tum", until=0.25))
    summary = aggregate(data, tmp_path / "m.laz", options=MapOptions(poses=given_poses))
    seconds = np.concatenate([0.1 * k + np.linspace(0, 0.099, 400) for k in range(6)])
    assert summary.points == np.count_nonzero(seconds <= 0.25)
    assert summary.left_out["poses"] == summary.points_in - summary.points > 0


def test_poses_of_another_day_are_refused(tmp_path):
    data = dataset(tmp_path / "d", kinds=("pcd",))
    other = tum_of(tmp_path / "t.tum", start=START + timedelta(days=1))
    with pytest.raises(InputError, match="POSIX"):
        aggregate(data, tmp_path / "m.laz", options=MapOptions(poses=str(other)))
    assert not (tmp_path / "m.laz").exists()


@pytest.mark.parametrize("poses", ["gnss", "top", "gnss+imu", "+", "missing.tum"])
def test_unknown_poses_are_refused(tmp_path, poses):
    with pytest.raises(InputError, match=r"poses|TUM"):
        aggregate(
            dataset(tmp_path / "d", kinds=("pcd",)), tmp_path / "m.laz", options=MapOptions(poses=poses)
        )


def street(rng, count):
    """Points (count, 3) on the ground and the walls of a street with side streets, metres."""
    points = rng.uniform([-40, -9, 0], [70, 9, 8], (count, 3))
    kind = rng.integers(0, 3, count)
    points[kind == 0, 2] = 0.0
    side = np.sign(points[kind == 1, 1])
    points[kind == 1, 1] = 9.0 * side
    points[kind == 2, 0] = 15.0 * np.round(points[kind == 2, 0] / 15.0)
    points[kind == 2, 1] = np.sign(points[kind == 2, 1]) * rng.uniform(9, 14, np.count_nonzero(kind == 2))
    return points


def driven(folder, *, frames, rng):
    """Clouds at 10 Hz of a vehicle in a street that speeds up, turns and pitches, and its true poses."""
    time_s = np.arange(0, frames / 10 + 0.2, 0.001)
    x, yaw = 5.0 * time_s + 0.5 * time_s**2, 0.1 * np.sin(1.5 * time_s)
    turn = Rotation.from_euler("zyx", np.column_stack([yaw, 0.02 * np.sin(3 * time_s), 0 * time_s]))
    place = np.column_stack([x, 0.3 * np.sin(time_s), 0 * time_s])
    files = []
    for k in range(frames):
        seen = street(rng, 9000)
        when = np.sort(rng.integers(0, 100, len(seen))) * 1_000_000
        row = 100 * k + when // 1_000_000
        local = turn[row].inv().apply(seen - place[row])
        local = (local - MOUNT[:3, 3]) @ MOUNT[:3, :3]
        table = dict(zip("xyz", local.T.astype(np.float32), strict=True)) | {
            "intensity": np.ones(len(seen), np.float32),
            "time_ns": when.astype(np.uint32),
            "ring": np.zeros(len(seen), np.uint16),
            "label": np.ones(len(seen), np.uint16),
            "instance": np.zeros(len(seen), np.int32),
        }
        files.append(folder / f"{k:06d}.pcd")
        FORMATS["pcd"].write(files[-1], table)
    poses = np.tile(np.eye(4), (frames + 1, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = (
        turn[: 100 * frames + 1 : 100].as_matrix(),
        place[: 100 * frames + 1 : 100],
    )
    sensor = {"kind": "lidar", "rate_hz": 10.0, "vehicle_from_sensor": MOUNT.tolist()}
    numbers_of = np.arange(frames)
    return Stream("top", sensor, numbers_of, numbers_of * 10**8, tuple(files)), poses


def test_sweeps_tell_the_motion_between_them(tmp_path):
    pytest.importorskip("small_gicp")
    rng = np.random.default_rng(0)
    clouds, true = driven(tmp_path, frames=25, rng=rng)
    exact = np.linalg.inv(true[:-1]) @ true[1:]
    wrong = exact.copy()
    wrong[:, :3, 3] += rng.normal(0, 0.02, (25, 3))
    wrong[:, :3, :3] = wrong[:, :3, :3] @ Rotation.from_rotvec(rng.normal(0, 0.002, (25, 3))).as_matrix()
    given_motion = RelativeMotion(np.arange(26) * 10**8, wrong, np.tile([0.002] * 3 + [0.02] * 3, (25, 1)))
    found = aligned_motion(clouds, given_motion, progress=silent)
    np.testing.assert_array_equal(found.step[-1], wrong[-1])  # of the last frame's motion no cloud tells
    poses, measured = found.poses()[:-1], given_motion.poses()[:-1]
    away = errors(poses, np.linalg.inv(true[0]) @ true[:-1])
    assert away.max() < 0.05
    assert away.max() < 0.5 * errors(measured, np.linalg.inv(true[0]) @ true[:-1]).max()
    again = aligned_motion(clouds, given_motion, progress=silent)
    np.testing.assert_array_equal(again.step, found.step)


def test_motion_is_kept_where_sweeps_tell_nothing(tmp_path):
    pytest.importorskip("small_gicp")
    clouds, true = driven(tmp_path, frames=4, rng=np.random.default_rng(0))
    nothing = {name: column[:20] for name, column in FORMATS["pcd"].read(clouds.files[2]).items()}
    for path in clouds.files:
        FORMATS["pcd"].write(path, nothing)
    step = np.linalg.inv(true[:-1]) @ true[1:]
    given_motion = RelativeMotion(np.arange(5) * 10**8, step, np.full((4, 6), 0.01))
    found = aligned_motion(clouds, given_motion, progress=silent)
    np.testing.assert_array_equal(found.step, step)
    np.testing.assert_array_equal(found.sigma, given_motion.sigma)


def test_the_poses_in_json_are_those_of_the_summary(tmp_path, capsys):
    from lidar.cli import app  # noqa: PLC0415

    data = dataset(tmp_path / "d", kinds=("pcd",))
    given_poses = str(tum_of(tmp_path / "t.tum", shift=(0.3, 0.4, 0.0)))
    with pytest.raises(SystemExit, match="0"):
        app(
            [
                "map",
                str(data.path),
                "-o",
                str(tmp_path / "m.laz"),
                "--poses",
                given_poses,
                "--json",
                "--quiet",
            ]
        )
    found = json.loads(capsys.readouterr().out)
    assert found["poses"]["horizontal_m"] == pytest.approx(0.5, abs=1e-4)

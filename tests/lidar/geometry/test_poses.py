"""Attitudes convert without loss, and the pose table follows its documentation."""

from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geoscene.geometry.frames import Frame
from lidar.errors import DatasetError, InputError
from lidar.geometry.attitude import (
    body_rates,
    euler_from_quat,
    euler_from_quat_intrinsic,
    matrix_from_quat,
    quat_from_euler,
    quat_from_euler_intrinsic,
)
from lidar.geometry.poses import Trajectory
from lidar.geometry.trajectory_files import read_trajectory, write_trajectory
from lidar.simulation.metadata import pose_columns

angles = st.one_of(st.floats(-np.pi, np.pi), st.sampled_from([0.0, np.pi / 2, -np.pi / 2, np.pi, 1e-9]))


def rx(a):
    return np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])


def ry(b):
    return np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])


def rz(g):
    return np.array([[np.cos(g), -np.sin(g), 0], [np.sin(g), np.cos(g), 0], [0, 0, 1]])


@pytest.mark.full
@given(angles, angles, angles)
@settings(max_examples=200, deadline=None)
def test_the_rotation_matrix_follows_the_convention(a, b, g):
    np.testing.assert_allclose(
        matrix_from_quat(quat_from_euler(a, b, gamma=g)), rz(g) @ ry(b) @ rx(a), atol=1e-12
    )
    np.testing.assert_allclose(
        matrix_from_quat(quat_from_euler_intrinsic(a, b, gamma=g)), rx(a) @ ry(b) @ rz(g), atol=1e-12
    )


@pytest.mark.full
@given(angles, angles, angles)
@settings(max_examples=200, deadline=None)
def test_angles_round_trip_even_at_gimbal_lock(a, b, g):
    for there, back in (
        (quat_from_euler, euler_from_quat),
        (quat_from_euler_intrinsic, euler_from_quat_intrinsic),
    ):
        quat = there(a, b, gamma=g)
        alpha, beta, gamma = back(quat)
        again = there(alpha, beta, gamma=gamma)
        turned = np.linalg.norm((Rotation.from_quat(quat).inv() * Rotation.from_quat(again)).as_rotvec())
        assert turned < 1e-6
        assert np.linalg.norm(quat) == pytest.approx(1.0, abs=1e-12)
        assert quat[3] >= 0.0


def test_both_conventions_agree_with_another_implementation_and_differ_at_large_angles():
    quat = Rotation.random(500, np.random.default_rng(1)).as_quat()
    np.testing.assert_allclose(euler_from_quat(quat), Rotation.from_quat(quat).as_euler("xyz"), atol=1e-12)
    np.testing.assert_allclose(
        euler_from_quat_intrinsic(quat), Rotation.from_quat(quat).as_euler("XYZ"), atol=1e-12
    )
    one, two = quat_from_euler(0.5, 0.6, gamma=0.7), quat_from_euler_intrinsic(0.5, 0.6, gamma=0.7)
    assert np.linalg.norm((Rotation.from_quat(one).inv() * Rotation.from_quat(two)).as_rotvec()) > 0.3


def test_positive_angles_lower_the_nose_raise_the_left_and_turn_left():
    forward = np.array([1.0, 0, 0])
    left = np.array([0, 1.0, 0])
    nose_down = matrix_from_quat(quat_from_euler(0.0, 0.1, gamma=0.0))
    assert (nose_down @ forward)[2] < 0
    left_up = matrix_from_quat(quat_from_euler(0.1, 0.0, gamma=0.0))
    assert (left_up @ left)[2] > 0
    north = matrix_from_quat(quat_from_euler(0.0, 0.0, gamma=np.pi / 2))
    np.testing.assert_allclose(north @ forward, [0, 1, 0], atol=1e-12)


def test_body_rates_of_a_steady_spin_are_exact():
    t = np.linspace(0.0, 2.0, 101)
    rate = np.array([0.3, -0.2, 1.1])
    quat = (Rotation.from_euler("xyz", [0.4, 0.2, 1.0]) * Rotation.from_rotvec(t[:, None] * rate)).as_quat()
    np.testing.assert_allclose(body_rates(t, quat), np.broadcast_to(rate, (101, 3)), atol=1e-12)


def test_the_pose_table_agrees_with_the_trajectory():
    frame = Frame.at(-76.3059, 36.8853, crs="EPSG:32618")
    n = 11
    quat = quat_from_euler(np.full(n, 0.02), np.full(n, -0.05), gamma=np.linspace(0.0, 3.0, n))
    position = np.column_stack([np.linspace(0, 50, n), np.linspace(0, 20, n), np.linspace(3, 4, n)])
    trajectory = Trajectory(np.arange(n) * 10**8, position, quat, np.zeros((n, 3)), np.full(n, 0.99976683))
    start = datetime(2026, 5, 1, 12, 0, 0, 250000, UTC)
    table = pose_columns(trajectory, frame, start=start, time_ns=np.array([0, 5 * 10**8, 10**9]))
    assert list(table) == [
        *("timestamp", "frame", "x", "y", "z", "alpha", "beta", "gamma"),
        *("qx", "qy", "qz", "qw", "lon", "lat", "h"),
    ]
    assert table["timestamp"][1] == "2026-05-01T12:00:00.750000000Z"
    assert datetime.fromisoformat(table["timestamp"][1]) == datetime(2026, 5, 1, 12, 0, 0, 750000, UTC)
    np.testing.assert_allclose(table["gamma"], [0.0, 1.5, 3.0], atol=1e-12)
    np.testing.assert_allclose(table["beta"], -0.05, atol=1e-12)
    x, y = frame.from_geographic(table["lon"], table["lat"])
    np.testing.assert_allclose(np.column_stack([x, y]), position[[0, 5, 10], :2], atol=1e-6)
    quat = np.column_stack([table[k] for k in ("qx", "qy", "qz", "qw")])
    for row in range(3):
        R = rz(table["gamma"][row]) @ ry(table["beta"][row]) @ rx(table["alpha"][row])
        np.testing.assert_allclose(matrix_from_quat(quat[row]), R, atol=1e-12)


def test_trajectories_are_read_as_they_were_written(tmp_path):
    rng = np.random.default_rng(1)
    quat = rng.normal(size=(9, 4))
    quat /= np.linalg.norm(quat, axis=1)[:, None]
    columns = rng.normal(size=(9, 3)), quat, rng.normal(size=(9, 3)), np.full(9, 0.9997)
    whole, path = Trajectory(np.arange(9) * 10, *columns), tmp_path / "trajectory.csv"
    write_trajectory(path, whole)
    again = read_trajectory(path)
    for name, column in whole.columns().items():
        assert column.tobytes() == again.columns()[name].tobytes()
    path.write_text(path.read_text()[:-30])
    with pytest.raises(DatasetError):
        read_trajectory(path)


@pytest.mark.parametrize(("column", "text", "told"), [(1, "nan", "holds no pose"), (0, "10", "not later")])
def test_a_damaged_pose_of_a_trajectory_is_told_with_its_line(tmp_path, column, text, told):
    still, turn, path = np.zeros((4, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (4, 1)), tmp_path / "trajectory.csv"
    write_trajectory(path, Trajectory(np.arange(4) * 10, still, turn, still, np.ones(4)))
    lines = path.read_text().splitlines()
    words = lines[3].split(",")
    words[column] = text
    path.write_text("\n".join([*lines[:3], ",".join(words), lines[4]]) + "\n")
    with pytest.raises(DatasetError, match=rf"trajectory\.csv: line 4 .*{told}"):
        read_trajectory(path)


def test_trajectories_need_poses_at_increasing_times():
    still, turn = np.zeros((4, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (4, 1))
    for time in ([0, 2, 2, 3], [0]):
        n = len(time)
        with pytest.raises(InputError, match="two or more poses at increasing times"):
            Trajectory(np.array(time), still[:n], turn[:n], still[:n], np.ones(n))

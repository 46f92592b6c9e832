"""Maps from the poses of a file."""

import json
from datetime import timedelta

import laspy
import numpy as np
import pytest
from helpers.map_data import START, dataset, trajectory
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lidar.errors import FormatError, InputError
from lidar.geometry.time_scales import posix_ns
from lidar.geometry.trajectory_files import read_tum, write_tum
from lidar.options.maps import MapOptions
from lidar.tools.maps.aggregate import aggregate

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


@pytest.mark.full
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


@pytest.mark.full
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


def test_a_missing_file_of_poses_is_refused(tmp_path):
    options = MapOptions(poses="missing.tum")
    with pytest.raises(InputError, match=r"missing\.tum"):
        aggregate(dataset(tmp_path / "d", kinds=("pcd",)), tmp_path / "m.laz", options=options)


@pytest.mark.parametrize("poses", ["gnss", "gnss+imu", ""])
def test_names_of_receivers_are_refused_with_what_to_do_instead(poses):
    with pytest.raises(InputError, match="lidar odometry --method fused"):
        MapOptions(poses=poses)


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

"""Strips, scan angles and edges of flight lines as LAS has them."""

from datetime import UTC, datetime

import laspy
import numpy as np
import pytest
from pyproj import CRS

from lidar.dataset.formats import las
from lidar.geometry.attitude import Mount
from lidar.geometry.flight_lines import edge_times, flight_columns, scan_angles, strip_numbers
from lidar.geometry.poses import Trajectory

MOUNT = Mount((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def level_flight(heading):
    """Ten seconds at 600 m, at a heading counter-clockwise from east."""
    time_ns = np.arange(11, dtype=np.int64) * 10**9
    ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
    position = time_ns[:, None] * 1e-9 * 50 * ahead + [0, 0, 600]
    quat = np.tile([0.0, 0.0, np.sin(heading / 2), np.cos(heading / 2)], (11, 1))
    return Trajectory(time_ns, position, quat, np.tile(50 * ahead, (11, 1)), np.ones(11)), ahead


@pytest.mark.parametrize("heading", [0.0, np.pi / 2, np.pi, -2.0])
def test_scan_angles_are_positive_to_the_right_of_the_flight(heading):
    flight, ahead = level_flight(heading)
    right = np.array([ahead[1], -ahead[0], 0.0])
    time_ns = np.array([2, 3, 4]) * 10**9
    below = flight.at(time_ns).position * [1, 1, 0]
    shift = 600 * np.tan(np.radians([-25.0, 0.0, 14.0]))
    placed = below + shift[:, None] * right + 30 * ahead
    np.testing.assert_allclose(
        scan_angles(placed, flight, mount=MOUNT, time_ns=time_ns), [-25, 0, 14], atol=1e-9
    )


def test_strips_are_numbered_from_one():
    on = np.array([[0, 10], [20, 30], [40, 50]])
    assert strip_numbers(np.array([0, 9, 20, 30, 45]), on).tolist() == [1, 1, 2, 2, 3]


@pytest.mark.parametrize("way", ["back", "anew"])
def test_edges_are_the_last_pulses_of_lines(way):
    line = np.radians(np.linspace(-20, 20, 9))
    other = line[-2:0:-1] if way == "back" else line
    angle = np.concatenate([line, other, line])
    direction = np.column_stack([0 * angle, -np.sin(angle), -np.cos(angle)])
    times = edge_times(direction, mount=MOUNT, time_ns=np.arange(len(angle)), ring=np.zeros(len(angle), int))
    assert times.tolist() == ([8, 16] if way == "back" else [8, 17])


def test_las_states_strips_angles_and_edges(tmp_path):
    flight, _ = level_flight(0.0)
    time_ns = np.array([10**9, 2 * 10**9, 6 * 10**9])
    placed = flight.at(time_ns).position * [1, 1, 0] + [[0, -200, 0], [0, 0, 0], [0, 250, 0]]
    strips = np.array([[0, 3 * 10**9], [5 * 10**9, 7 * 10**9]])
    columns = flight_columns(
        placed, flight, mount=MOUNT, time_ns=time_ns, strips=strips, edges=np.array([6 * 10**9])
    )
    table = dict(zip("xyz", placed.T, strict=True)) | columns | {"label": np.zeros(3, np.uint8)}
    info = las.LasInfo(CRS("EPSG:32635"), (0.0, 0.0, 0.0), datetime(2026, 6, 21, tzinfo=UTC))
    for rows, number in ((slice(0, 2), 1), (slice(0, 3), 0)):
        las.write(tmp_path / "a.laz", {name: values[rows] for name, values in table.items()}, info=info)
        found = laspy.read(tmp_path / "a.laz")
        assert found.header.file_source_id == number
        assert np.asarray(found.point_source_id).tolist() == [1, 1, 2][rows]
        assert np.asarray(found.edge_of_flight_line).tolist() == [0, 0, 1][rows]
        angle = np.degrees(np.arctan2([200, 0, -250], 600))[rows]
        np.testing.assert_allclose(np.asarray(found.scan_angle) * 0.006, angle, atol=0.003)
        back = las.read(tmp_path / "a.laz")
        np.testing.assert_allclose(back["scan_angle"], angle, atol=0.003)

"""Long drives are planned and written in blocks of rows, with the bytes of those worked on at once."""

import mmap
import os
import platform
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import shapely
from helpers.roadgrids import grid

from geoscene.geometry.frames import Frame
from geoscene.support import csv_tables
from geoscene.support.csv_tables import write_columns
from lidar.dataset.journal import Journal, frame_digest, read_journal
from lidar.dataset.layout import frame_numbers
from lidar.errors import DatasetError, InputError
from lidar.geometry import poses
from lidar.geometry.mounts import Mount
from lidar.geometry.poses import Trajectory
from lidar.geometry.trajectory_csv import read_trajectory, write_trajectory
from lidar.motion import clearance, speed_profile, steering
from lidar.motion import path as path_module
from lidar.motion.clearance import PathParameters, RouteLine, touching
from lidar.motion.motion import drive_path, poses_along, speed_limits
from lidar.motion.path import plan_path
from lidar.motion.route import RouteOptions, free_route, plan_route
from lidar.motion.speed_profile import motion_within
from lidar.motion.steering import follow
from lidar.motion.vehicle import load_vehicle
from lidar.sensors.navigation.gnss import antenna_motion
from lidar.sensors.navigation.imu import true_inertial
from lidar.sensors.rig.devices import scanners
from lidar.sensors.rig.specs import GnssSpec, ImuSpec, load_rig
from lidar.simulation.drive import trim_memory
from lidar.simulation.plan import schedule
from lidar.traffic.ego_trip import ego_trip

FRAME = Frame.at(-76.3, 36.88)
ARM = Mount((1.2, 0.3, 1.5), (0.0, 0.0, 0.0, 1.0))


@pytest.fixture(scope="module")
def path():
    graph = grid(gap=80.0)
    route = plan_route(graph, FRAME, spec="random", options=RouteOptions(seed=3, length=600.0))
    return plan_path(route, load_vehicle("car"), frame=FRAME)


def backing(column):
    while isinstance(column, np.ndarray):
        column = column.base
    return column.obj if isinstance(column, memoryview) else column


def test_long_trajectory_is_kept_in_a_file_with_the_same_values(path, monkeypatch, tmp_path):
    whole = drive_path(path, load_vehicle("car"))
    write_trajectory(tmp_path / "whole.csv", whole)
    monkeypatch.setattr(poses, "BLOCK_POSES", 257)
    monkeypatch.setattr(poses, "_IN_MEMORY", 500)
    monkeypatch.setattr(csv_tables, "BLOCK_ROWS", 100)
    parts = drive_path(path, load_vehicle("car"))
    assert len(parts) == len(whole) > 2000
    for name, column in parts.columns().items():
        assert isinstance(backing(column), mmap.mmap)
        assert column.tobytes() == whole.columns()[name].tobytes()
    parts.release()
    write_trajectory(tmp_path / "parts.csv", parts)
    assert (tmp_path / "parts.csv").read_bytes() == (tmp_path / "whole.csv").read_bytes()
    again = read_trajectory(tmp_path / "parts.csv")
    assert all(
        column.tobytes() == again.columns()[name].tobytes() for name, column in whole.columns().items()
    )


def in_small_blocks(monkeypatch):
    monkeypatch.setattr(poses, "BLOCK_POSES", 500)
    monkeypatch.setattr(poses, "_IN_MEMORY", 500)
    monkeypatch.setattr(steering, "_FOLLOWED", 500)


@pytest.mark.parametrize("ground", [None, lambda x, y, z: z + 0.1 * np.sin(x / 9) * np.cos(y / 7)])
def test_long_path_is_kept_in_files_with_the_same_values(ground, monkeypatch):
    car, graph = load_vehicle("car"), grid(gap=80.0)
    route = plan_route(graph, FRAME, spec="random", options=RouteOptions(seed=3, length=1500.0))
    time_s = np.arange(0.0, 120.0, 0.2)
    allowed = np.minimum(12.0 * time_s, 700.0)

    def planned():
        path = plan_path(route, car, frame=FRAME, ground=ground)
        trip = ego_trip(path, car)
        motion = motion_within(path, car, time_s=time_s, max_distance=allowed)
        return path, {
            **path.columns(),
            **trip.course.path.columns(),
            "desired": trip.course.desired_speed,
            "limits": speed_limits(path, car),
            **motion.columns(),
            **poses_along(path, car, motion=motion).columns(),
        }

    whole, columns = planned()
    in_small_blocks(monkeypatch)
    path, parts = planned()
    assert len(path) == len(whole) > 5000
    assert all(isinstance(backing(column), mmap.mmap) for column in path.columns().values())
    for name, column in columns.items():
        assert parts[name].tobytes() == column.tobytes(), name


def test_planning_of_a_longer_route_needs_no_more_memory(monkeypatch):
    car = load_vehicle("car")

    def planned(metres):
        along = np.arange(0.0, metres, 20.0)
        route = free_route(np.column_stack([along, 9 * np.sin(along / 60), 0 * along]), limit=13.9)
        path = plan_path(route, car, frame=FRAME)
        ego_trip(path, car)
        return sum(column.nbytes for column in path.columns().values())

    def peak(metres):
        tracemalloc.start()
        held = planned(metres)
        bytes_at_most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return bytes_at_most, held

    in_small_blocks(monkeypatch)
    monkeypatch.setattr(steering, "_SOLVED", 1000)
    monkeypatch.setattr(steering, "_OVERLAP", 400)
    monkeypatch.setattr(clearance, "_BODIES", 500)
    planned(500.0)  # imports
    (short, _), (long, held) = peak(1000.0), peak(3000.0)
    assert held > 1_000_000
    assert long < short + 0.1 * held


def test_receivers_and_units_measure_the_same_along_parts_of_a_trajectory(path, monkeypatch):
    whole = drive_path(path, load_vehicle("car"))
    times = np.arange(0, whole.duration_ns, 33_333_333)
    specs = GnssSpec("gnss", ARM), ImuSpec("imu", ARM)

    def measured():
        gnss, imu = specs
        return [
            *antenna_motion(whole, FRAME, spec=gnss, time_ns=times),
            *true_inertial(whole, FRAME, spec=imu, time_ns=times),
        ]

    expected = measured()
    monkeypatch.setattr(poses, "BLOCK_POSES", 311)
    for part, one in zip(measured(), expected, strict=True):
        # differences over even and over uneven times round differently
        np.testing.assert_allclose(part, one, rtol=0, atol=1e-9)


def test_long_lines_are_smoothed_in_windows(monkeypatch):
    along = np.arange(0.0, 2000.0, 0.5)
    line = np.column_stack([along, 30.0 * np.floor(along / 40.0) % 2])  # jumps that no car can follow
    whole = steering.relax(line, 0.17, reach=2.6)
    monkeypatch.setattr(steering, "_SOLVED", 500)
    monkeypatch.setattr(steering, "_OVERLAP", 400)
    assert np.abs(steering.relax(line, 0.17, reach=2.6) - whole).max() < 1e-6
    monkeypatch.setattr(steering, "_OVERLAP", 100)
    plain = steering.relax(line, 1e9, reach=2.6)
    monkeypatch.setattr(steering, "_SOLVED", 1 << 17)
    assert np.abs(steering.relax(line, 1e9, reach=2.6) - plain).max() < 1e-9


def test_the_ground_is_loaded_in_regions_around_the_vehicle(monkeypatch):
    graph = grid(gap=80.0)
    route = plan_route(graph, FRAME, spec="random", options=RouteOptions(seed=3, length=600.0))
    boxes = []

    def ground(x, y, z):
        boxes.append((np.ptp(x), np.ptp(y)))
        return z + 0.1 * np.sin(x / 9) * np.cos(y / 7)

    whole = plan_path(route, load_vehicle("car"), frame=FRAME, ground=ground)
    boxes.clear()
    monkeypatch.setattr(path_module, "_REGION", 150.0)
    parts = plan_path(route, load_vehicle("car"), frame=FRAME, ground=ground)
    assert len(boxes) > 9
    assert np.max(boxes) < 150.0 + 2 * 4.0  # and the axles beside and ahead
    for name, column in whole.columns().items():
        assert column.tobytes() == parts.columns()[name].tobytes()


def test_limits_are_looked_up_in_the_rows_around_a_place():
    limit = np.random.default_rng(1).uniform(1.0, 20.0, 4000)
    for first in (-0.2, 0.0, 313.7, 990.0, 999.9):
        s = np.linspace(first, first + 12.0, 41)
        expected = np.interp(s, 0.25 * np.arange(len(limit)), limit)
        assert speed_profile._looked_up(limit, s).tobytes() == expected.tobytes()


def test_poses_that_do_not_follow_each_other_are_refused_across_blocks(monkeypatch):
    monkeypatch.setattr(poses, "BLOCK_POSES", 2)
    still = np.zeros((4, 3))
    turn = np.tile([0.0, 0.0, 0.0, 1.0], (4, 1))
    with pytest.raises(InputError, match="increasing times"):
        Trajectory(np.array([0, 2, 2, 3]), still, turn, still, np.ones(4))
    with pytest.raises(InputError, match="two or more"):
        Trajectory(np.array([0]), still[:1], turn[:1], still[:1], np.ones(1))


def test_jobs_are_in_order_of_time_and_made_on_demand():
    sensors = scanners(load_rig("seed"))
    jobs = schedule(sensors, 3_000_000_000)
    order = [(job.start_ns, job.order, job.frame) for job in jobs]
    assert order == sorted(order)
    assert len(jobs) == sum(sensor.frame_count(3_000_000_000) for sensor in sensors)
    assert [*jobs[5:9]] == [jobs[k] for k in range(5, 9)]
    assert [job.frame for job in jobs.where(lambda job: job.frame == 7)] == [7] * len(sensors)


@pytest.mark.parametrize("rows", [0, 1, 100, 101])
def test_tables_are_written_in_blocks(rows, monkeypatch, tmp_path):
    columns = {"k": np.arange(rows), "x": np.arange(rows) / 7, "name": [f"a,{k}" for k in range(rows)]}
    write_columns(tmp_path / "whole.csv", columns)
    monkeypatch.setattr(csv_tables, "BLOCK_ROWS", 10)
    write_columns(tmp_path / "parts.csv", columns)
    text = (tmp_path / "parts.csv").read_bytes()
    assert text == (tmp_path / "whole.csv").read_bytes()
    assert text.count(b"\n") == rows + 1
    assert text.startswith(b"k,x,name\n")


def test_obstacles_along_a_track_are_found_block_by_block(monkeypatch):
    xy = np.column_stack([np.arange(0.0, 100.0, 0.25), np.zeros(400)])
    track = follow(xy, load_vehicle("car"), scale=1.0, step=0.25)
    n = len(xy)
    line = RouteLine(
        np.column_stack([xy, np.zeros(n)]),
        np.zeros(n, np.int32),
        np.full(n, 10.0),
        np.zeros(n, bool),
        np.zeros(n, bool),
    )
    tree = shapely.STRtree([shapely.box(20, 0.5, 25, 3), shapely.box(60, -3, 70, 3)])
    setting = PathParameters(load_vehicle("car"), FRAME, tree, margin=0.2, step=0.25, side="right")
    whole = touching(track, line, setting=setting)
    monkeypatch.setattr(clearance, "_BODIES", 7)
    parts = touching(track, line, setting=setting)
    assert len(whole[0])
    assert all((one == other).all() for one, other in zip(whole, parts, strict=True))


def test_journal_keeps_the_last_entry_of_each_frame_in_order(tmp_path):
    path = tmp_path / "frames.csv"
    journal, digests = Journal(path), {frame: bytes([frame % 251]) * 64 for frame in (1_000, 7, 8)}
    journal.begin()
    for frame in (1_000, 7, 8, 7):
        journal.add("top", frame, points=frame + 1, digests=digests[frame])
    journal.add("front", 3, points=0, digests=b"")
    assert journal.file_digests("top", 8, count=2) == [digests[8][:32], digests[8][32:]]
    with path.open("a") as file:
        file.write("top,9,5\ntop,x,1,2\ntop,99999999999999999999,1,ab\n")  # cut off and damaged
    again = read_journal(path)
    assert len(again) == len(journal.entries) == 4
    table = again.of("top")
    assert table.frame.tolist() == [7, 8, 1_000]
    assert table.points.tolist() == [8, 9, 1_001]
    assert (table.row(8), table.row(9)) == (1, -1)
    assert again.of("none").frame.tolist() == []
    journal.close()
    assert path.read_text().splitlines() == [
        "sensor,frame,points,digest",
        "front,3,0,",
        *(f"top,{frame},{frame + 1},{frame_digest(digests[frame])}" for frame in (7, 8, 1_000)),
    ]


def test_frames_beyond_a_million_follow_in_order(tmp_path):
    for frame in (1_000_000, 999_999, 12):
        (tmp_path / f"{frame:06d}.laz").touch()
    for other in ("12.laz", "000013.laz.part", "notes.txt"):
        (tmp_path / other).touch()
    assert frame_numbers(tmp_path, ".laz").tolist() == [12, 999_999, 1_000_000]
    assert not len(frame_numbers(tmp_path / "none", ".laz"))


@pytest.mark.parametrize("rows", [5, 8, 9, 13])
def test_trajectories_of_any_length_are_read_in_blocks(rows, monkeypatch, tmp_path):
    still, turn = np.zeros((rows, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (rows, 1))
    whole = Trajectory(np.arange(rows) * 10, still, turn, still, np.ones(rows))
    monkeypatch.setattr(poses, "BLOCK_POSES", 4)  # a row more than two blocks is no block
    assert [block.stop - block.start for block in poses.blocks_of(9)] == [4, 5]
    write_trajectory(tmp_path / "trajectory.csv", whole)
    again = read_trajectory(tmp_path / "trajectory.csv")
    assert again.time_ns.tolist() == whole.time_ns.tolist()
    text = (tmp_path / "trajectory.csv").read_text()
    (tmp_path / "trajectory.csv").write_text(text[:-30])
    with pytest.raises(DatasetError):
        read_trajectory(tmp_path / "trajectory.csv")


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries keep less")
def test_memory_that_planning_freed_goes_back_to_the_system():
    def resident():
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    rows = [np.ones(1000) for _ in range(20_000)]
    last = rows[::1000]
    rows.clear()
    before = resident()
    trim_memory()
    assert before - resident() > 100_000_000
    assert len(last) == 20

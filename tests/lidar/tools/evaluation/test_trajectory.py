"""Errors of trajectories: those of evo and of KITTI's development kit, and intervals that hold."""

import csv
import json
import math

import numpy as np
import pytest
from evo.core import geometry, metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from helpers.map_data import START, dataset, trajectory
from helpers.programs import run_program
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geoscene.drawing.charts import encode
from lidar.dataset.layouts.kitti_drive import write_poses
from lidar.errors import FormatError, InputError
from lidar.geometry.poses import Trajectory
from lidar.geometry.time_scales import posix_ns
from lidar.options.trajectories import EvaluateOptions
from lidar.tools.evaluation.pose_errors import (
    absolute,
    by_axis,
    correlation_time,
    lengths_for,
    over_frames,
    over_metres,
    segments,
    statistics,
)
from lidar.tools.evaluation.report import qualities
from lidar.tools.evaluation.trajectories import (
    Path3D,
    PosePairs,
    alignment,
    match_poses,
    read_path,
    read_truth,
    true_path,
)
from lidar.tools.evaluation.trajectory import evaluate_trajectory
from lidar.tools.odometry.estimate import MotionEstimate, write_estimate

STEP_NS = 100_000_000


def walk(count, *, seed, step=1.0, stops=0.0):
    """A wandering way with turns about all axes; with some share of the time at rest."""
    rng = np.random.default_rng(seed)
    turns = np.cumsum(rng.normal(0, [0.01, 0.01, 0.05], (count, 3)), axis=0)
    rotation = Rotation.from_euler("xyz", turns).as_matrix()
    moves = rotation[:, :, 0] * (step * rng.uniform(0.5, 1.5, count) * (rng.random(count) >= stops))[:, None]
    position = np.cumsum(moves, axis=0) + rng.normal(0, 50, 3)
    return Path3D(np.arange(count) * STEP_NS + 1_700_000_000 * 10**9, position, rotation)


def wrong(path, *, seed, drift=0.02):
    """An estimate of a path: its motion with noise, begun elsewhere."""
    rng = np.random.default_rng(seed)
    shift = np.cumsum(rng.normal(0, drift, path.position.shape), axis=0)
    turn = Rotation.from_rotvec(np.cumsum(rng.normal(0, drift / 30, path.position.shape), axis=0))
    elsewhere = Rotation.from_rotvec(rng.normal(0, 1, 3)).as_matrix()
    off = path.moved(elsewhere, rng.normal(0, 30, 3), scale=float(rng.uniform(0.7, 1.3)))
    return Path3D(off.time_ns, off.position + shift, off.rotation @ turn.as_matrix())


def evo_of(path):
    quat = Rotation.from_matrix(path.rotation).as_quat()
    return PoseTrajectory3D(path.position, quat[:, [3, 0, 1, 2]], path.time_ns * 1e-9)


def evo_aligned(estimate, truth, kind):
    found = evo_of(estimate)
    if kind == "origin":
        found.align_origin(evo_of(truth))
    elif kind in ("se3", "sim3"):
        found.align(evo_of(truth), correct_scale=kind == "sim3")
    return found


def aligned(estimate, truth, kind):
    pairs = match_poses(estimate, truth, how="nearest")
    return PosePairs(alignment(pairs, kind).of(pairs.estimate), pairs.truth, pairs.left_out)


@pytest.mark.full
@pytest.mark.parametrize("kind", ["none", "origin", "se3", "sim3"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_absolute_errors_are_those_of_evo(kind, seed):
    truth = walk(200, seed=seed)
    estimate = wrong(truth, seed=seed + 10)
    moved, turned = absolute(aligned(estimate, truth, kind))
    data = evo_of(truth), evo_aligned(estimate, truth, kind)
    for relation, ours in (("translation_part", moved), ("rotation_angle_rad", turned)):
        ape = metrics.APE(metrics.PoseRelation[relation])
        ape.process_data(data)
        np.testing.assert_allclose(ours, ape.error, rtol=0, atol=1e-9)
        told = ape.get_all_statistics()
        found = statistics(ours)
        for name in ("rmse", "mean", "median"):
            assert getattr(found, name).value == pytest.approx(told[name], abs=1e-9)
        assert found.max == pytest.approx(told["max"], abs=1e-9)


@pytest.mark.full
@pytest.mark.parametrize(
    ("delta", "unit"), [(1, "frames"), (7, "frames"), (5.0, "meters"), (23.0, "meters"), (120.0, "meters")]
)
@pytest.mark.parametrize("stops", [0.0, 0.5])
def test_relative_errors_are_those_of_evo(delta, unit, stops):
    truth = walk(300, seed=4, stops=stops)
    estimate = wrong(truth, seed=5)
    pairs = match_poses(estimate, truth, how="nearest")
    found = over_frames(pairs, delta) if unit == "frames" else over_metres(pairs, delta)
    for relation, ours in (("translation_part", found.shift), ("rotation_angle_rad", found.turn)):
        rpe = metrics.RPE(
            metrics.PoseRelation[relation],
            delta=delta,
            delta_unit=metrics.Unit[unit],
            all_pairs=True,
            pairs_from_reference=True,
        )
        rpe.process_data((evo_of(truth), evo_of(estimate)))
        assert found.last.tolist() == rpe.delta_ids
        np.testing.assert_allclose(ours, rpe.error, rtol=0, atol=1e-9)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 999), fewer=st.integers(2, 40), jitter=st.integers(0, 9))
def test_the_nearest_poses_in_time_are_those_of_evo(seed, fewer, jitter):
    rng = np.random.default_rng(seed)
    truth = walk(60, seed=seed)
    rows = np.sort(rng.choice(60, fewer, replace=False))
    shifted = truth.time_ns[rows] + rng.integers(-jitter, jitter + 1, fewer) * 2_000_000
    estimate = Path3D(shifted, truth.position[rows], truth.rotation[rows])
    close = np.abs(shifted - truth.time_ns[rows]) <= 10_000_000
    assume(close.sum() >= 2)
    # evo compares seconds as floats, which do not hold nanoseconds: at the limit itself they differ.
    pairs = match_poses(estimate, truth, how="nearest", gap_s=0.010001)
    theirs = sync.associate_trajectories(evo_of(truth), evo_of(estimate), max_diff=0.010001)
    np.testing.assert_array_equal(pairs.truth.position, theirs[0].positions_xyz)
    np.testing.assert_array_equal(pairs.estimate.position, theirs[1].positions_xyz)
    assert pairs.left_out == fewer - len(pairs)


def devkit(truth, estimate, lengths, *, step):
    """KITTI's evaluate_odometry.cpp, statement by statement."""
    pose = []
    for path in (truth, estimate):
        matrix = np.tile(np.eye(4), (len(path), 1, 1))
        matrix[:, :3, :3], matrix[:, :3, 3] = path.rotation, path.position
        pose.append(matrix)
    dist = [0.0]
    for k in range(1, len(truth)):
        dist.append(dist[-1] + math.dist(truth.position[k], truth.position[k - 1]))
    errors = []
    for first in range(0, len(truth), step):
        for length in lengths:
            last = next((i for i in range(first, len(dist)) if dist[i] > dist[first] + length), -1)
            if last == -1:
                continue
            delta = [np.linalg.inv(p[first]) @ p[last] for p in pose]
            error = np.linalg.inv(delta[1]) @ delta[0]
            turn = math.acos(max(min(0.5 * (np.trace(error[:3, :3]) - 1), 1), -1))
            errors.append((first, turn / length, np.linalg.norm(error[:3, 3]) / length, length))
    return np.array(errors)


@pytest.mark.parametrize(
    ("count", "lengths"), [(1200, (100, 200, 300, 400, 500, 600, 700, 800)), (60, (10, 20))]
)
def test_segments_are_those_of_kitti_s_development_kit(count, lengths):
    truth = walk(count, seed=8)
    estimate = wrong(truth, seed=9)
    expected = devkit(truth, estimate, lengths, step=10 if lengths[0] >= 100 else 1)
    found = segments(match_poses(estimate, truth, how="nearest"), lengths)
    np.testing.assert_array_equal(np.column_stack([found.first, found.length]), expected[:, [0, 3]])
    np.testing.assert_allclose(found.shift, expected[:, 2], atol=1e-12)
    np.testing.assert_allclose(found.turn, expected[:, 1], atol=1e-7)  # an arc cosine near 1
    np.testing.assert_allclose(found.speed.mean(), 10.0, rtol=0.1)


def test_segments_of_short_ways_are_shorter_than_kitti_s():
    assert lengths_for(950.0) == (100, 200, 300, 400, 500, 600, 700, 800)
    assert lengths_for(250.0) == (100, 200)
    assert lengths_for(150.0) == (10, 20, 30, 40, 50, 60, 70, 80)
    assert lengths_for(35.0) == (10, 20, 30)
    assert lengths_for(5.0) == ()


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 10_000), kind=st.sampled_from(["origin", "se3", "sim3", "yaw-position"]))
def test_alignment_undoes_any_motion_of_its_kind(seed, kind):
    truth, rng = walk(40, seed=seed), np.random.default_rng(seed)
    about = rng.normal(0, 1, 3) if kind != "yaw-position" else np.array([0, 0, rng.uniform(-3, 3)])
    turn = Rotation.from_rotvec(about).as_matrix()
    scale = float(rng.uniform(0.1, 10)) if kind == "sim3" else 1.0
    moved = truth.moved(turn, rng.normal(0, 100, 3), scale=scale)
    off, angle = absolute(aligned(moved, truth, kind))
    assert off.max() < 1e-8
    assert angle.max() < 1e-8


def test_a_straight_way_tells_no_roll():
    truth = walk(30, seed=0)
    straight = Path3D(truth.time_ns, np.outer(np.arange(30), [1.0, 2, 0.5]), np.tile(np.eye(3), (30, 1, 1)))
    pairs = match_poses(straight, straight, how="nearest")
    with pytest.raises(InputError, match="on a line"):
        alignment(pairs, "se3")
    assert absolute(aligned(straight, straight, "yaw-position"))[0].max() < 1e-9


def test_errors_by_axis_are_those_of_the_body():
    """A body that heads north and is estimated 1 m too far east is 1 m too far right."""
    north = Rotation.from_euler("z", [[90.0], [90.0]], degrees=True).as_matrix()
    truth = Path3D(np.array([0, 10**9]), np.zeros((2, 3)), north)
    tilted = north @ Rotation.from_euler("y", 2.0, degrees=True).as_matrix()
    estimate = Path3D(truth.time_ns, np.tile([1.0, 0.0, 0.25], (2, 1)), tilted)
    off, turn = by_axis(PosePairs(estimate, truth, 0))
    np.testing.assert_allclose(off, [[0, -1, 0.25]] * 2, atol=1e-12)
    np.testing.assert_allclose(np.degrees(turn), [[0, 2, 0]] * 2, atol=1e-9)


def test_the_truth_between_its_poses_is_interpolated():
    true = trajectory()
    full = Path3D(true.time_ns, true.position, Rotation.from_quat(true.quat_xyzw).as_matrix())
    coarse = full.take(slice(None, None, 10))  # every 0.1 s on a circle of 33 m at 10 m/s
    pairs = match_poses(full, coarse, how="interpolated")
    assert len(pairs) == len(full)
    chord = 1 / 8 / (10 / 0.3)  # sagitta of a metre
    assert absolute(pairs)[0].max() == pytest.approx(chord, rel=0.01)
    with pytest.raises(InputError, match="common times"):
        match_poses(full, coarse, how="interpolated", gap_s=0.05)


def correlated(rng, count, strength):
    """A stationary series whose neighbours correlate, with mean 3 and variance 1."""
    noise = rng.normal(0, math.sqrt(1 - strength**2), count)
    series = np.empty(count)
    series[0] = rng.normal()
    for k in range(1, count):
        series[k] = strength * series[k - 1] + noise[k]
    return 3 + series


@pytest.mark.full
def test_intervals_of_correlated_errors_hold_the_true_mean_where_those_of_single_errors_do_not():
    rng = np.random.default_rng(0)
    held = single = 0
    for trial in range(30):
        series = correlated(rng, 2000, 0.9)
        found = statistics(series, seed=trial).mean
        held += found.low <= 3 <= found.high
        half = 1.96 * series.std() / math.sqrt(len(series))
        single += abs(series.mean() - 3) <= half
    assert held >= 25  # 95 % of 30 are 28.5
    assert single < 18


def test_correlation_times_are_those_of_the_process():
    rng = np.random.default_rng(1)
    for strength in (0.0, 0.5, 0.9):
        times = [correlation_time(correlated(rng, 20_000, strength)) for _ in range(5)]
        assert np.mean(times) == pytest.approx((1 + strength) / (1 - strength), rel=0.15)


def test_a_series_that_is_one_stretch_has_no_interval():
    found = statistics(np.linspace(0, 5, 300))
    assert found.mean.interval is None
    assert found.blocks < 5
    assert statistics(np.full(300, 2.0)).mean.interval == (2.0, 2.0)


def drive(path):
    """A dataset with one sensor, a scanner."""
    data = dataset(path, kinds=("pcd",))
    calibration = json.loads((path / "calibration.json").read_text())
    del calibration["sensors"]["camera"]
    (path / "calibration.json").write_text(json.dumps(calibration))
    return data


def tum_of(path, poses):
    poses.write(path)
    return path


def test_an_exact_copy_has_no_error_in_any_form(tmp_path):
    data = drive(tmp_path / "d")
    truth = true_path(data).take(slice(None, None, 10))
    frames = (truth.time_ns - posix_ns(START))[:6]
    (tmp_path / "d" / "top").mkdir(exist_ok=True)
    (tmp_path / "d" / "top" / "timestamps.csv").write_text(
        "frame,time_ns\n" + "".join(f"{k},{t}\n" for k, t in enumerate(frames.tolist()))
    )
    stamps = np.datetime_as_string(truth.time_ns.astype("datetime64[ns]"))
    rows = np.column_stack([truth.position, Rotation.from_matrix(truth.rotation).as_quat()])
    with (tmp_path / "p.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["timestamp", "x", "y", "z", "qx", "qy", "qz", "qw"])
        writer.writerows([f"{s}Z", *row] for s, row in zip(stamps, rows.tolist(), strict=True))
    first = Trajectory(
        frames, *(v[:6] for v in (truth.position, rows[:, 3:], np.zeros((101, 3)))), np.ones(6)
    )
    write_poses(tmp_path / "p.kitti", first.at(frames))
    for estimate, align in (
        (tum_of(tmp_path / "p.tum", truth), "none"),
        (tmp_path / "p.csv", "none"),
        (tmp_path / "p.kitti", "origin"),
        (tmp_path / "d", "none"),
    ):
        errors = evaluate_trajectory(estimate, tmp_path / "d", options=EvaluateOptions(align=align)).errors
        assert errors.translation.max < 1e-6, estimate
        assert errors.rotation.max < 1e-5, estimate
        assert errors.left_out == 0


def test_poses_of_a_sensor_are_compared_with_the_sensor_s(tmp_path):
    data = drive(tmp_path / "d")
    top = true_path(data).mounted(np.array(data.sensors()["top"]["vehicle_from_sensor"]))
    tum = tum_of(tmp_path / "top.tum", top)
    exact = evaluate_trajectory(tum, tmp_path / "d", options=EvaluateOptions(align="none", sensor="top"))
    assert exact.errors.translation.max < 1e-9
    vehicle = evaluate_trajectory(tum, tmp_path / "d", options=EvaluateOptions(align="none"))
    assert vehicle.errors.translation.rmse.value == pytest.approx(math.hypot(1.0, 0.2, 1.9), abs=1e-6)
    assert vehicle.errors.rotation.mean.value == pytest.approx(90.0, abs=1e-6)


def test_files_without_times_are_compared_pose_by_pose(tmp_path):
    truth = walk(80, seed=3)
    for name, path in (("a", truth), ("b", wrong(truth, seed=4))):
        rows = np.concatenate([path.rotation, path.position[:, :, None]], axis=2).reshape(-1, 12)
        np.savetxt(tmp_path / f"{name}.txt", rows)
    errors = evaluate_trajectory(tmp_path / "b.txt", tmp_path / "a.txt").errors
    assert errors.association == "by number"
    assert errors.duration_s is None
    assert errors.poses == 80
    np.savetxt(tmp_path / "short.txt", rows[:50])
    with pytest.raises(InputError, match="50 poses, the truth 80"):
        evaluate_trajectory(tmp_path / "short.txt", tmp_path / "a.txt")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no trajectory"),
        ("1 2 3\n", "3 numbers"),
        ("2 0 0 0 0 0 0 0 1 0 0 0\n" * 3, "no rigid"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n", "two or more"),
        ("1 0 0 0 0 1 0 0 0 0 1 x\n" * 2, "numbers"),
        ("nan 0 0 0 0 1 0 0 0 0 1 0\n" * 2, "no rigid"),
    ],
)
def test_what_is_no_trajectory_is_refused(tmp_path, text, message):
    (tmp_path / "e.txt").write_text(text)
    with pytest.raises(FormatError, match=message):
        read_path(tmp_path / "e.txt", truth=None, sensor="")


def test_a_folder_that_holds_no_estimate_is_refused(tmp_path):
    with pytest.raises(InputError, match="neither a dataset, a folder of lidar odometry, nor"):
        read_path(tmp_path, truth=None, sensor="")


def test_a_folder_is_written_whole_with_figures_and_tables(tmp_path):
    drive(tmp_path / "d")
    truth, _ = read_truth(tmp_path / "d")
    estimate = Path3D(truth.time_ns, truth.position + np.array([0.3, 0, 0]), truth.rotation)
    tum_of(tmp_path / "e.tum", estimate)
    (tmp_path / "e.csv").write_text("frame,inliers,method\n0,120,orb\n1,80,orb\n2,,orb\n")
    run = run_program(
        "lidar", "evaluate", tmp_path / "e.tum", "--against", tmp_path / "d", "--align", "none", "--json",
        "-o", tmp_path / "out", "-q",
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    told = json.loads(run.stdout)
    assert told["translation"]["rmse"]["value"] == pytest.approx(0.3, abs=1e-6)
    names = {path.name for path in (tmp_path / "out").iterdir()}
    figures = {
        f"{name}{suffix}" for name in ("plan", "drift", "axes", "quality") for suffix in (".png", ".svg")
    }
    assert names == figures | {
        "evaluation.json",
        "evaluation.html",
        "errors.csv",
        "segments.csv",
        "aligned.tum",
    }
    assert (
        json.loads((tmp_path / "out" / "evaluation.json").read_text())["translation"] == told["translation"]
    )
    assert 'id="inliers"' in (tmp_path / "out" / "quality.svg").read_text()
    assert "method" not in (tmp_path / "out" / "quality.svg").read_text()
    again = run_program(
        "lidar", "evaluate", tmp_path / "e.tum", "--against", tmp_path / "d", "-o", tmp_path / "out", "-q"
    )
    assert again.returncode == 2
    assert "exists already" in again.stderr


def test_folders_of_odometry_are_estimates_with_their_own_times(tmp_path):
    """Poses are those of the ends of sweeps, as ``poses.csv`` says, in KITTI's form too."""
    data, folder = drive(tmp_path / "d"), tmp_path / "estimate"
    truth = true_path(data).take(slice(10, 600, 10))
    poses = np.tile(np.eye(4), (len(truth), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = truth.rotation, truth.position
    first = np.linalg.inv(poses[0]) @ poses
    folder.mkdir()
    estimate = MotionEstimate(
        truth.time_ns - posix_ns(START), first, quality={"matches": np.arange(len(truth))}
    )
    write_estimate(folder, estimate, dataset=data)
    (tmp_path / "d" / "top" / "timestamps.csv").write_text("frame,time_ns\n0,0\n")
    for source in (folder, folder / "trajectory.tum", folder / "trajectory.kitti", folder / "poses.csv"):
        errors = evaluate_trajectory(source, tmp_path / "d", options=EvaluateOptions(align="origin")).errors
        assert errors.translation.max < 1e-6, source
    picture = qualities(folder)
    assert picture is not None
    assert b'id="matches"' in encode(picture, ".svg")
    assert b'id="qx"' not in encode(picture, ".svg")


def test_an_estimate_that_says_nothing_of_its_frames_has_no_figure_of_it(tmp_path):
    assert qualities(tmp_path / "e.tum") is None
    (tmp_path / "e.csv").write_text("frame,method\n0,orb\n")
    assert qualities(tmp_path / "e.tum") is None
    (tmp_path / "e.csv").write_text("frame,matches\n0,9\n1,7\n")
    assert qualities(tmp_path / "e.tum") is not None


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--align", "best"), "align"),
        (("--delta", "1x"), "delta"),
        (("--sensor", "roof"), "there are top"),
        (("--against", "nowhere"), "nowhere"),
    ],
)
def test_what_cannot_be_compared_ends_with_a_line(tmp_path, words, told):
    drive(tmp_path / "d")
    tum_of(tmp_path / "e.tum", read_truth(tmp_path / "d")[0])
    against = () if "--against" in words else ("--against", tmp_path / "d")
    run = run_program("lidar", "evaluate", tmp_path / "e.tum", *against, *words, "-o", tmp_path / "out")
    assert run.returncode == 2
    assert told in run.stderr
    assert run.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_evo_and_this_program_agree_on_umeyama():
    truth = walk(50, seed=1)
    estimate = wrong(truth, seed=2)
    found = alignment(match_poses(estimate, truth, how="nearest"), "sim3")
    rotation, shift, scale = geometry.umeyama_alignment(
        estimate.position.T, truth.position.T, with_scale=True
    )
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(found.shift, shift, atol=1e-9)
    assert found.scale == pytest.approx(scale, abs=1e-12)

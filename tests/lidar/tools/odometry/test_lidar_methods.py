"""LiDAR odometry: the motion of known drives along streets of planes."""

import json

import numpy as np
import pytest
from helpers.odometry_worlds import MOUNT, dataset, trajectory, truth
from helpers.programs import run_program
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geoscene.support.progress import silent
from lidar.errors import DatasetError, InputError
from lidar.geometry.trajectory_files import read_tum
from lidar.motion.replay import read_replay
from lidar.options.trajectories import OdometryOptions
from lidar.tools.odometry.estimate import propagate
from lidar.tools.odometry.lidar_methods import LIDAR_METHODS, lidar_odometry
from lidar.tools.odometry.run import estimate_motion
from lidar.tools.odometry.scans import scans_of, still
from lidar.tools.odometry.settings import OdometrySettings, read_settings

SETTINGS = OdometrySettings()


def relative(poses):
    return np.linalg.inv(poses[0]) @ poses


def pose(turn, shift):
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    return out


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return dataset(tmp_path_factory.mktemp("street") / "drive")


@pytest.fixture(scope="module")
def estimated(street, tmp_path_factory):
    """The estimate of `small_gicp` of the drive along the street, and its folder."""
    out = tmp_path_factory.mktemp("estimate") / "out"
    options = OdometryOptions(method="small_gicp")
    return estimate_motion(street.path, out, options=options).estimate, out


@pytest.fixture(scope="module")
def start_of_street(tmp_path_factory):
    """The first four frames of a drive along the street."""
    return dataset(tmp_path_factory.mktemp("street") / "drive", frames=4, points=4000)


def assert_follows(found, metres):
    """8.8 m of way at 8 m/s: sweeps are skewed by 0.8 m, and the first has no motion to be de-skewed with."""
    true = relative(truth(trajectory(), found.time_ns))
    np.testing.assert_array_equal(found.time_ns, np.arange(1, 13) * 100_000_000)
    assert np.linalg.norm(found.poses[:, :3, 3] - true[:, :3, 3], axis=1).max() < metres
    turned = Rotation.from_matrix(np.swapaxes(found.poses, 1, 2)[:, :3, :3] @ true[:, :3, :3]).magnitude()
    assert turned.max() < 0.01


@pytest.mark.full
def test_small_gicp_follows_a_drive_in_a_bend_uphill(estimated):
    assert_follows(estimated[0], 0.05)


@pytest.mark.full
@pytest.mark.parametrize("method", ["kiss-icp", "genz-icp"])
def test_other_methods_follow_it_less_closely(street, method):
    assert_follows(lidar_odometry(scans_of(street), method, settings=SETTINGS, progress=silent), 0.25)


def test_stated_deviations_of_small_gicp_cover_its_errors(estimated):
    found, _ = estimated
    true = relative(truth(trajectory(), found.time_ns))
    errors = np.abs(found.poses[:, :3, 3] - true[:, :3, 3])
    assert (errors[1:] < 4 * found.sigma[1:, 3:]).all()
    assert found.sigma[-1, 3:].max() < 0.5


def test_several_scanners_are_merged_into_one_sweep(tmp_path):
    """A second scanner looks backwards from another place; both see the same walls."""
    other = MOUNT.copy()
    other[:3, :3] = Rotation.from_euler("z", 2.0).as_matrix()
    other[:3, 3] = [3.0, -0.4, 1.2]
    drive = dataset(tmp_path / "drive", frames=3, points=2000, mounts={"top": MOUNT, "front": other})
    one, both = scans_of(drive, ("top",)), scans_of(drive, ("top", "front"))
    motion = np.linalg.inv(truth(trajectory(), [100_000_000])[0]) @ truth(trajectory(), [200_000_000])[0]
    points, share = both.sweep(1)
    assert len(points) > 1.9 * len(one.sweep(1)[0])
    placed = still(points, share, motion=motion)
    end = truth(trajectory(), [200_000_000])[0]
    world = placed @ end[:3, :3].T + end[:3, 3]
    on_ground = np.abs(world[:, 2] + 3) < 0.01
    on_walls = np.abs((world[:, :2] % 20)[:, :, None] - [0, 12, 20]).min(axis=(1, 2)) < 0.02
    assert (on_ground | on_walls).all()


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-0.2, 0.2), min_size=3, max_size=3), st.floats(-2, 2), st.floats(-1, 0))
def test_de_skewing_undoes_an_even_turn_and_travel(turn, along, share):
    """A point of the world, seen from a moving vehicle, is where it is seen from at the end."""
    motion = pose(turn, [along, 0, 0])
    world = np.array([[5.0, 3.0, 1.0]])
    then = pose(share * np.array(turn), share * motion[:3, 3])
    seen = (world - then[:3, 3]) @ then[:3, :3]
    np.testing.assert_allclose(still(seen, np.array([share]), motion=motion), world, atol=1e-9)


def test_errors_of_heading_grow_to_errors_across_the_way():
    """After 100 steps of 1 m with 1 mrad each: sum of squares of 1 to 99 mm, by hand."""
    poses = np.tile(np.eye(4), (101, 1, 1))
    poses[:, 0, 3] = np.arange(101)
    covariance = np.zeros((100, 6, 6))
    covariance[:, 2, 2] = 1e-6
    sigma = propagate(poses, covariance)
    assert sigma[-1, 4] == pytest.approx(1e-3 * np.sqrt((np.arange(100.0) ** 2).sum()))
    assert sigma[-1, 2] == pytest.approx(1e-2)
    assert sigma[-1, 3] == 0


@pytest.mark.full
def test_sweeps_without_returns_move_on_as_before(tmp_path):
    drive = dataset(tmp_path / "drive", frames=8, points=6000, rest=3)
    found = lidar_odometry(scans_of(drive), "small_gicp", settings=SETTINGS, progress=silent)
    true = relative(truth(trajectory(), found.time_ns))
    assert found.report["frames_without_alignment"] == 3
    assert np.linalg.norm(found.poses[-1, :3, 3] - true[-1, :3, 3]) < 0.1
    assert found.sigma[-1, 3] > found.sigma[-4, 3]


@pytest.mark.full
@pytest.mark.parametrize("method", LIDAR_METHODS)
def test_the_truth_is_not_read_and_runs_have_the_same_bytes(street, tmp_path, method):
    """Without the true trajectory, its poses and boxes the same files are written."""
    options = OdometryOptions(method=method)
    estimate_motion(street.path, tmp_path / "first", options=options)
    hidden = street.paths.trajectory.rename(tmp_path / "hidden")
    try:
        estimate_motion(street.path, tmp_path / "second", options=options)
    finally:
        hidden.rename(street.paths.trajectory)
    names = {path.name for path in (tmp_path / "first").iterdir()}
    assert names == {"trajectory.tum", "trajectory.kitti", "poses.csv", "odometry.json"}
    for name in names:
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "second" / name).read_bytes()


def test_a_start_pose_georeferences_the_estimate(start_of_street, tmp_path):
    options = OdometryOptions(method="small_gicp", start_pose=(100.0, -50.0, 7.0, 0.0, 0.0, 90.0))
    summary = estimate_motion(start_of_street.path, tmp_path / "out", options=options)
    _, position, _ = read_tum(tmp_path / "out" / "trajectory.tum")
    true = relative(truth(trajectory(), summary.estimate.time_ns))[:, :3, 3]
    turned = np.column_stack([100 - true[:, 1], true[:, 0] - 50, true[:, 2] + 7])
    np.testing.assert_allclose(position, turned, atol=0.1)
    replayed = read_replay(tmp_path / "out" / "poses.csv", start_of_street.frame)
    np.testing.assert_allclose(replayed.position[0], [100, -50, 7], atol=1e-6)


def test_evo_reads_the_trajectories(estimated):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    found, folder = estimated
    tum = file_interface.read_tum_trajectory_file(folder / "trajectory.tum")
    kitti = file_interface.read_kitti_poses_file(folder / "trajectory.kitti")
    np.testing.assert_allclose(tum.positions_xyz, found.poses[:, :3, 3])
    np.testing.assert_allclose(kitti.positions_xyz, found.poses[:, :3, 3], atol=1e-9)


def test_bad_input_is_refused_in_one_line(street, tmp_path):
    with pytest.raises(InputError, match=r"`sensor` back: no scanner in .*; there are top"):
        scans_of(street, ("back",))
    with pytest.raises(InputError, match="`settings` parameter 'voxl' is unknown; is voxel meant"):
        read_settings([("voxl", "1")])
    with pytest.raises(InputError, match="`settings` voxel = nan is not within 0 to 100 m"):
        read_settings([("voxel", "nan")])
    with pytest.raises(InputError, match="`method` 'icp' is unknown"):
        OdometryOptions(method="icp")
    single = dataset(tmp_path / "single", frames=1, points=100)
    with pytest.raises(DatasetError, match="1 sweep of top; odometry needs two or more"):
        scans_of(single)
    document = json.loads(single.paths.calibration.read_text())
    document["sensors"] = {}
    single.paths.calibration.write_text(json.dumps(document))
    with pytest.raises(DatasetError, match="has no laser scanner"):
        scans_of(single)


def test_a_settings_file_goes_before_words(tmp_path):
    file = tmp_path / "settings.toml"
    file.write_text("voxel = 0.7\nmin_range = 2\n")
    found = read_settings([("voxel", "0.4")], path=file)
    assert (found.voxel, found.min_range) == (0.4, 2)
    file.write_text("voxel = true\n")
    with pytest.raises(InputError, match=r"settings\.toml: voxel = True is not a number within 0 to 100 m"):
        read_settings([], path=file)
    file.write_text("voxel")
    with pytest.raises(InputError, match="not a readable TOML file"):
        read_settings([], path=file)


def test_the_command_says_what_it_did(start_of_street, tmp_path):
    words = ("odometry", start_of_street.path, "--method", "small_gicp", "-o", tmp_path / "e")
    done = run_program("lidar", *words, "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["poses"] == 4
    assert document["length_m"] == pytest.approx(2.4, abs=0.2)
    assert document["sensors"] == ["top"]
    again = run_program("lidar", *words)
    assert again.returncode == 2
    assert again.stderr.count("\n") == 1
    assert "is not empty" in again.stderr

"""Odometry on a recorded drive: a scanner, and two cameras with distortion and rolling shutters."""

import json

import numpy as np
import pytest
from helpers.programs import run_program

from lidar.dataset.layout import open_dataset
from lidar.errors import DatasetError, InputError
from lidar.geometry.attitude import quat_from_matrix
from lidar.geometry.time_scales import posix_ns
from lidar.geometry.trajectory_files import write_tum
from lidar.options.trajectories import OdometryOptions
from lidar.tools.odometry.lidar_methods import first_motion
from lidar.tools.odometry.run import estimate_motion
from lidar.tools.odometry.scans import scans_of

RIG = """
name = "stereo"
vehicle = "car"
[[lidar]]
name = "top"
preset = "hdl32e"
translation = [1.0, 0.0, 1.9]
[[camera]]
name = "left"
translation = [1.5, 0.3, 1.5]
width = 640
height = 360
fx = 400.0
cx = 319.5
cy = 179.5
distortion = [-0.1, 0.01, 0.0, 0.0, 0.0]
row_ns = 40000
images = ["rgb"]
[[camera]]
name = "right"
translation = [1.5, -0.4, 1.5]
width = 640
height = 360
fx = 400.0
cx = 319.5
cy = 179.5
distortion = [-0.1, 0.01, 0.0, 0.0, 0.0]
row_ns = 40000
images = ["rgb"]
[[gnss]]
name = "gnss"
translation = [0.6, 0.1, 1.6]
rate_hz = 5.0
mode = "single"
[[imu]]
name = "imu"
translation = [0.2, 0.1, 0.6]
rate_hz = 100.0
"""


@pytest.fixture(scope="session")
def drive(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("odometry")
    (folder / "rig.toml").write_text(RIG)
    words = (
        "--route",
        "random",
        "--duration",
        3,
        "--seed",
        20,
        "--rig",
        folder / "rig.toml",
        "--format",
        "pcd",
    )
    done = run_program("lidar", "drive", scene.path, *words, "-o", folder / "drive", "-q")
    assert done.returncode == 0, done.stderr
    return open_dataset(folder / "drive")


def errors_by_evo(drive, estimate, tmp_path):
    """Absolute errors (n,) in metres by evo, with the first poses aligned, and the length of the true way."""
    file_interface = pytest.importorskip("evo.tools.file_interface")
    metrics, sync = pytest.importorskip("evo.core.metrics"), pytest.importorskip("evo.core.sync")
    true, path = drive.trajectory().at(estimate.time_ns), tmp_path / "truth.tum"
    times = posix_ns(drive.start) + estimate.time_ns
    write_tum(path, times, position=true.position / true.scale, quat_xyzw=quat_from_matrix(true.rotation))
    write_tum(
        tmp_path / "estimate.tum",
        times,
        position=np.ascontiguousarray(estimate.poses[:, :3, 3]),
        quat_xyzw=quat_from_matrix(np.ascontiguousarray(estimate.poses[:, :3, :3])),
    )
    reference = file_interface.read_tum_trajectory_file(path)
    found = file_interface.read_tum_trajectory_file(tmp_path / "estimate.tum")
    reference, found = sync.associate_trajectories(reference, found)
    found.align_origin(reference)
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data((reference, found))
    return error.error, reference.path_length


@pytest.mark.parametrize("seed", [4, *(pytest.param(seed, marks=pytest.mark.full) for seed in (7, 8))])
def test_the_first_motion_is_that_of_the_vehicle_not_of_its_rings(scene, tmp_path, seed):
    """Rings of 64 lasers on level ground match at any speed; the vehicle is under way at the first sweep."""
    lidar = '[[lidar]]\nname = "top"\npreset = "hdl64e_s3"\ntranslation = [0.8, 0.0, 1.7]\nrate_hz = 10.0\n'
    (tmp_path / "rig.toml").write_text('name = "rings"\nvehicle = "car"\n' + lidar)
    words = ("--route", "random", "--duration", 0.3, "--seed", seed, "--format", "pcd", "-q")
    done = run_program(
        "lidar", "drive", scene.path, *words, "--rig", tmp_path / "rig.toml", "-o", tmp_path / "d"
    )
    assert done.returncode == 0, done.stderr
    drive = open_dataset(tmp_path / "d")
    scans = scans_of(drive)
    true = drive.trajectory().at(scans.time_ns[:2])
    ahead = (true.position[1] - true.position[0]) @ true.rotation[0]
    found = first_motion(scans)
    np.testing.assert_allclose(found[:3, 3], ahead, atol=0.05)


@pytest.mark.full
@pytest.mark.parametrize(
    ("method", "share"),
    [
        ("small_gicp", 0.01),
        ("orb+depth", 0.03),
        ("stereo", 0.05),
    ],
)
def test_methods_follow_a_recorded_drive(drive, tmp_path, method, share):
    """Errors against the truth by evo, in parts of the way."""
    summary = estimate_motion(drive.path, tmp_path / "e", options=OdometryOptions(method=method))
    error, length = errors_by_evo(drive, summary.estimate, tmp_path)
    assert length > 5
    assert error.max() < share * length
    assert summary.estimate.report["sensors"][0] in ("top", "left")


@pytest.mark.full
def test_a_single_camera_tells_the_shape_of_the_way(drive, tmp_path):
    """Its scale is that of the camera's height over the road, or unknown: the direction of travel is not."""
    estimate = estimate_motion(drive.path, tmp_path / "e", options=OdometryOptions(method="orb")).estimate
    true = drive.trajectory().at(estimate.time_ns)
    there = (true.position[-1] - true.position[0]) @ true.rotation[0]
    here = estimate.poses[-1, :3, 3]
    assert here @ there / np.linalg.norm(here) / np.linalg.norm(there) > np.cos(0.1)
    assert "scale" in estimate.report


@pytest.mark.full
def test_images_have_the_same_poses_in_every_run_and_without_the_truth(drive, tmp_path):
    options = OdometryOptions(method="stereo")
    estimate_motion(drive.path, tmp_path / "first", options=options)
    hidden = [drive.paths.trajectory, drive.paths.poses]
    for k, path in enumerate(hidden):
        path.rename(tmp_path / f"hidden{k}")
    try:
        estimate_motion(drive.path, tmp_path / "second", options=options)
    finally:
        for k, path in enumerate(hidden):
            (tmp_path / f"hidden{k}").rename(path)
    for path in (tmp_path / "first").iterdir():
        assert path.read_bytes() == (tmp_path / "second" / path.name).read_bytes()


@pytest.mark.full
def test_sensors_that_do_not_fit_are_refused(drive):
    def refused(method, *names):
        with pytest.raises((InputError, DatasetError)) as error:
            estimate_motion(
                drive.path, drive.path.parent / "no", options=OdometryOptions(method=method, sensors=names)
            )
        return str(error.value)

    assert "no second camera" in refused("stereo", "left")
    assert "`sensor` rear: no camera or scanner" in refused("orb", "rear")
    assert "no scanner in" in refused("small_gicp", "left")
    assert not (drive.path.parent / "no").exists()


@pytest.mark.full
def test_sweeps_hold_what_is_within_range(drive):
    points, share = scans_of(drive, least=5.0, most=20.0).sweep(3)
    distance = np.linalg.norm(points - [1.0, 0, 1.9], axis=1)
    assert 5.0 <= distance.min() < 6.0
    assert 19.0 < distance.max() <= 20.001
    assert -1.01 < share.min() < share.max() <= 0


@pytest.mark.full
def test_the_report_counts_features_and_keyframes(drive, tmp_path):
    done = run_program(
        "lidar", "odometry", drive.path, "--method", "orb+depth", "-o", tmp_path / "e", "--json", "-q"
    )
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["sensors"] == ["left", "top"]
    assert document["keyframes"] >= 2
    assert document["matches"] > document["inliers"] > 15 * 20
    lines = (tmp_path / "e" / "poses.csv").read_text().splitlines()
    assert {"sigma_x", "matches", "inliers"} <= set(lines[0].split(","))
    assert len(lines) == 1 + document["poses"]

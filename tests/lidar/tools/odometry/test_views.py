"""Views of known points: poses, distances, rolling shutters, windows and loops, against exact geometry."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lidar.errors import DatasetError
from lidar.geometry.attitude import Mount
from lidar.sensors.rig.camera_model import project, unproject
from lidar.sensors.rig.specs import CameraSpec
from lidar.tools.odometry.features import (
    ImageFeatures,
    _spread,
    laser_distances,
    matches,
    read_features,
    stereo_distances,
    unhidden,
)
from lidar.tools.odometry.keyframes import Keyframe, close_loops, refine_window
from lidar.tools.odometry.scans import moved_back, scaled_motion
from lidar.tools.odometry.settings import OdometrySettings
from lidar.tools.odometry.view_geometry import (
    Sighted,
    pose_of,
    triangulate,
    two_view_pose,
)
from lidar.tools.odometry.visual_tracking import _at_start

PINHOLE = CameraSpec("front", Mount(), width=1280, height=720, fx=700.0, fy=700.0, cx=639.5, cy=359.5)
FISHEYE = CameraSpec(
    "wide",
    Mount(),
    width=1280,
    height=960,
    fx=320.0,
    fy=320.0,
    cx=639.5,
    cy=479.5,
    distortion=(0.02, -0.005, 0.001, 0.0),
    model="fisheye",
)
STILL = np.eye(4)


def pose(turn, shift):
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    return out


def points_ahead(rng, count):
    return rng.uniform([-8, -4, 6], [8, 3, 40], (count, 3))


def seen(points, camera_pose):
    local = (points - camera_pose[:3, 3]) @ camera_pose[:3, :3]
    return local / np.linalg.norm(local, axis=1, keepdims=True)


def sighted(points, bearing, *, share=None, motion=STILL):
    count = len(points)
    share = np.zeros(count) if share is None else share
    return Sighted(points, bearing, np.full(count, 1e-3), np.full(count, 1e-3), np.zeros(3), share, motion)


def features(bearing, camera, *, seed=0, seconds=None):
    """Features whose descriptors tell them apart; those of equal rows and seeds are equal."""
    count = len(bearing)
    descriptor = np.random.default_rng(seed).integers(0, 256, (count, 32), dtype=np.uint8)
    seconds = np.zeros(count) if seconds is None else seconds
    pixel, _ = project(camera, bearing)
    return ImageFeatures(pixel, bearing, np.full(count, 1.0 / camera.fx), seconds, descriptor)


def difference(first, second):
    off = np.linalg.inv(first) @ second
    return Rotation.from_matrix(off[:3, :3]).magnitude(), np.linalg.norm(off[:3, 3])


@pytest.mark.full
@settings(max_examples=12, deadline=None)
@given(
    st.lists(st.floats(-0.3, 0.3), min_size=3, max_size=3),
    st.lists(st.floats(-2, 2), min_size=3, max_size=3),
    st.integers(0, 2**31),
)
def test_a_pose_follows_from_known_points_though_four_of_ten_are_wrong(turn, shift, seed):
    rng = np.random.default_rng(seed)
    points, true = points_ahead(rng, 100), pose(turn, shift)
    bearing = seen(points, true)
    bearing[:40] = seen(points_ahead(rng, 40), true)
    found = pose_of(sighted(points, bearing), start=np.eye(4), trials=500, rng=rng)
    assert found is not None
    angle, metres = difference(true, found[0])
    assert angle < 1e-3
    assert metres < 0.02
    assert found[1][40:].all()
    assert np.count_nonzero(found[1][:40]) < 10


def test_a_pure_turn_moves_nothing():
    rng = np.random.default_rng(3)
    points, true = points_ahead(rng, 60), pose([0.02, 0.2, -0.01], [0, 0, 0])
    found, _, covariance = pose_of(sighted(points, seen(points, true)), start=np.eye(4), trials=200, rng=rng)
    angle, metres = difference(true, found)
    assert angle < 1e-7
    assert metres < 1e-6
    assert 1e-6 < np.sqrt(covariance[0, 0]) < 1e-2


@pytest.mark.full
def test_deviations_of_poses_are_those_of_noisy_bearings():
    """Errors over their stated deviations have the mean square one; of 25 poses it scatters by 0.12."""
    rng, squares = np.random.default_rng(5), []
    true = pose([0.01, 0.05, 0.0], [0.3, 0.0, 0.8])
    for _ in range(25):
        points = points_ahead(rng, 80)
        bearing = seen(points, true) + rng.normal(0, 1e-3, (80, 3))
        bearing /= np.linalg.norm(bearing, axis=1, keepdims=True)
        found, _, covariance = pose_of(sighted(points, bearing), start=true, trials=50, rng=rng)
        off = np.linalg.inv(found) @ true
        error = np.concatenate([Rotation.from_matrix(off[:3, :3]).as_rotvec(), off[:3, 3]])
        squares.append(error @ np.linalg.solve(covariance, error) / 6)
    assert 0.6 < np.mean(squares) < 1.45


def test_a_rolling_shutter_bends_what_moves_and_its_motion_straightens_it():
    """A camera at 15 m/s that turns at 0.3 rad/s and reads its rows in 30 ms."""
    rng = np.random.default_rng(1)
    points, true, motion = (
        points_ahead(rng, 120),
        pose([0, 0.02, 0], [0.2, 0, 1.0]),
        pose([0, 0.3, 0], [0, 0, 15]),
    )
    share = rng.uniform(0, 0.03, 120)
    bearing = np.array(
        [seen(points[k : k + 1], true @ scaled_motion(motion, share[k]))[0] for k in range(120)]
    )
    straight, _, _ = pose_of(
        sighted(points, bearing, share=share, motion=motion), start=np.eye(4), trials=300, rng=rng
    )
    bent = pose_of(sighted(points, bearing), start=np.eye(4), trials=300, rng=rng)
    assert difference(true, straight)[1] < 0.005
    assert difference(true, bent[0])[1] > 0.1


def test_features_of_late_rows_are_those_of_the_frames_start():
    rng = np.random.default_rng(2)
    points, motion, seconds = points_ahead(rng, 50), pose([0.1, 0.3, 0], [1, 0, 10]), rng.uniform(0, 0.03, 50)
    local = moved_back(points, seconds, motion=motion)
    distance = np.linalg.norm(local, axis=1)
    late = features(local / distance[:, None], PINHOLE, seconds=seconds)
    at_start, length = _at_start(late, distance, motion=motion)
    np.testing.assert_allclose(length[:, None] * at_start.bearing, points, atol=1e-9)


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
def test_two_views_tell_turn_and_direction_and_their_distance_the_rest(camera):
    rng = np.random.default_rng(4)
    points, true = points_ahead(rng, 150), pose([0.01, 0.05, 0.0], [0.3, 0.05, 0.9])
    first = unproject(camera, project(camera, points)[0])
    second = unproject(camera, project(camera, (points - true[:3, 3]) @ true[:3, :3])[0])
    found, good = two_view_pose(first, second, sigma=1e-3)
    assert good.mean() > 0.95
    length = np.linalg.norm(true[:3, 3])
    assert difference(pose([0, 0, 0], true[:3, 3] / length), pose([0, 0, 0], found[:3, 3]))[1] < 1e-3
    found[:3, 3] *= length
    distance, _ = triangulate(first, second, pose=found, sigma=np.full(150, 1e-3))
    known = np.isfinite(distance)
    assert known.mean() > 0.9
    np.testing.assert_allclose(distance[known], np.linalg.norm(points, axis=1)[known], rtol=0.02)


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
def test_distances_of_features_on_a_slanted_wall_are_exact(camera):
    """Laser rows 12 pixels apart on a wall and, nearer, on a post: a feature between rows is on the plane."""
    u, v = np.meshgrid(np.arange(300, 900, 4.0), np.arange(200, 500, 6.0))
    ray = unproject(camera, np.column_stack([u.ravel(), v.ravel()]))
    normal = np.array([0.5, 0.0, 1.0]) / np.hypot(0.5, 1)
    wall = 15.0 / (ray @ normal)
    post = (u.ravel() > 500) & (u.ravel() < 540)
    points = np.where(post, 5.0, wall)[:, None] * ray
    there = np.array([[600.0, 333.0], [700.3, 250.7], [520.0, 300.0], [499.0, 300.0], [100.0, 300.0]])
    found, fuzz = laser_distances(
        features(unproject(camera, there), camera), camera, points=points, motion=STILL, radius=12.0
    )
    true = 15.0 / (unproject(camera, there) @ normal)
    np.testing.assert_allclose(found[:2], true[:2], rtol=1e-3)
    assert found[2] == pytest.approx(5.0, rel=1e-3)
    assert np.isnan(found[3:]).all()  # on the edge of the post, and where no laser point is
    assert (fuzz[:3] < 0.02).all()


def test_points_behind_a_nearer_surface_are_hidden():
    pixel = np.array([[100.0, 100], [103, 101], [130, 100], [105, 99]])
    np.testing.assert_array_equal(unhidden(pixel, np.array([5.0, 20, 20, 5.2])), [True, False, True, True])


def test_late_rows_have_the_distances_of_their_time():
    """At 10 m/s towards a wall, a row that is exposed 20 ms later is 0.2 m nearer."""
    camera = CameraSpec(
        "r", Mount(), width=640, height=480, fx=400.0, fy=400.0, cx=319.5, cy=239.5, row_ns=50_000
    )
    u, v = np.meshgrid(np.arange(200, 440, 4.0), np.arange(100, 450, 4.0))
    ray = unproject(camera, np.column_stack([u.ravel(), v.ravel()]))
    there = unproject(camera, np.array([[320.0, 400.0]]))
    found, _ = laser_distances(
        features(there, camera),
        camera,
        points=10.0 * ray / ray[:, 2:],
        motion=pose([0, 0, 0], [0, 0, 10]),
        radius=12.0,
    )
    assert found[0] == pytest.approx((10.0 - 0.2) / there[0, 2], rel=1e-3)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.1, 1.5), st.floats(-0.3, 0.3), st.sampled_from([PINHOLE, FISHEYE]))
def test_two_cameras_measure_distances_by_their_baseline(baseline, turn, camera):
    rng = np.random.default_rng(7)
    points = points_ahead(rng, 60)
    right = pose([0, turn, 0], [baseline, 0.02, 0])
    first = features(seen(points, np.eye(4)), camera)
    second = features(seen(points, right), camera)
    distance, fuzz = stereo_distances(first, second, pose=right)
    known = np.isfinite(distance)
    assert known.all()
    np.testing.assert_allclose(distance, np.linalg.norm(points, axis=1), rtol=1e-6)
    near, far = np.argmin(distance), np.argmax(distance)
    assert fuzz[far] > fuzz[near]


def test_matches_are_those_of_opencv_with_cross_check():
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(0)
    first = rng.integers(0, 256, (80, 32), dtype=np.uint8)
    second = first[rng.permutation(80)] ^ np.where(rng.random((80, 32)) < 0.1, 1, 0).astype(np.uint8)
    rows, mine = matches(first, second)
    found = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(first, second)
    assert sorted(zip(rows.tolist(), mine.tolist(), strict=True)) == sorted(
        (m.queryIdx, m.trainIdx) for m in found if m.distance <= 64
    )
    nothing, _ = matches(first, second, allowed=np.zeros((80, 80), bool))
    assert not len(nothing)


def test_features_are_spread_over_the_image():
    """Of a thousand strong corners in one cell and a weak one in each of nine others, all weak ones stay."""
    place = np.concatenate([np.full((1000, 2), 10.0), 10.0 + 60 * np.arange(1, 10)[:, None] * [1, 1]])
    strength = np.concatenate([np.linspace(2, 3, 1000), np.full(9, 0.1)])
    kept = _spread(place, strength, count=50)
    assert set(range(1000, 1009)) <= set(kept.tolist())
    assert 999 in kept
    assert len(kept) == 50


def window_of(rng, *, measured):
    points, frames = points_ahead(rng, 80), []
    for k in range(4):
        true = pose([0, 0.03 * k, 0], [0.1 * k, 0, 0.8 * k])
        local = (points - true[:3, 3]) @ true[:3, :3]
        distance = np.linalg.norm(local, axis=1)
        frames.append(
            Keyframe(
                k,
                true,
                features(local / distance[:, None], PINHOLE),
                distance,
                np.full(80, 0.01),
                np.full(80, measured),
                np.arange(80),
            )
        )
    return frames


@pytest.mark.parametrize("measured", [True, False])
def test_a_window_is_refined_to_the_true_poses(measured):
    frames = window_of(np.random.default_rng(0), measured=measured)
    true = [frame.pose for frame in frames]
    for k, frame in enumerate(frames[2:], 2):
        frame.pose = frame.pose @ pose([0.005, -0.004, 0.003 * k], [0.08, -0.05, 0.1])
    refine_window(frames, scaled=measured)
    for frame, wanted in zip(frames, true, strict=True):
        angle, metres = difference(wanted, frame.pose)
        assert angle < 5e-4
        assert metres < 5e-3


@pytest.mark.full
def test_ranges_of_two_cameras_do_not_shorten_the_way():
    """Ranges from a base have symmetric errors as inverse ranges; weighed as ranges, they are too short."""
    shares = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        frames = window_of(rng, measured=True)
        true = frames[-1].pose[:3, 3].copy()
        for frame in frames:
            inverse = 1.0 / frame.distance
            spread = 0.012  # 1/m: a quarter of 20 m
            noisy = inverse + rng.normal(0.0, spread, len(inverse))
            frame.distance = 1.0 / np.maximum(noisy, 1e-3)
            frame.fuzz = spread * frame.distance
        refine_window(frames, scaled=True)
        shares.append(frames[-1].pose[:3, 3] @ true / (true @ true))
    assert np.mean(shares) == pytest.approx(1.0, abs=0.02)


def test_a_loop_takes_the_drift_out_of_a_way_around_a_block():
    """Forty keyframes around a circle, each turned by 2 mrad too much; the last is where the first is."""
    turn = 2 * np.pi / 40
    step, wrong = pose([0, turn, 0], [0, 0, 5]), pose([0, turn + 0.002, 0], [0, 0, 5])
    true, drifted = [np.eye(4)], [np.eye(4)]
    for _ in range(40):
        true.append(true[-1] @ step)
        drifted.append(drifted[-1] @ wrong)
    empty = features(np.zeros((0, 3)), PINHOLE)
    frames = [
        Keyframe(k, one, empty, *(np.zeros(0),) * 2, np.zeros(0, bool), np.zeros(0, np.int64))
        for k, one in enumerate(drifted)
    ]
    loop = (0, 40, np.linalg.inv(true[0]) @ true[40], np.repeat([0.001, 0.01], 3))
    found = close_loops(frames, [loop])
    before = max(difference(a, b)[1] for a, b in zip(true, drifted, strict=True))
    after = max(difference(a, b)[1] for a, b in zip(true, found, strict=True))
    assert after < 0.35 * before
    assert difference(true[40], found[40])[1] < 0.05


def test_an_image_without_texture_has_no_features(tmp_path):
    cv2 = pytest.importorskip("cv2")
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((720, 1280, 3), 128, np.uint8))
    found = read_features(tmp_path / "grey.png", PINHOLE, settings=OdometrySettings())
    assert len(found) == 0
    assert matches(found.descriptor, found.descriptor)[0].size == 0
    with pytest.raises(DatasetError, match="640 x 480"):
        read_features(
            tmp_path / "grey.png", replace(PINHOLE, width=640, height=480), settings=OdometrySettings()
        )

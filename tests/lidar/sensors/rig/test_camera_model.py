"""Rays of pixels and pixels of points."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lidar.geometry.attitude import Mount
from lidar.sensors.rig.camera_model import intrinsic_matrix, pixel_rays, project, unproject
from lidar.sensors.rig.specs import CameraSpec

PINHOLE = CameraSpec("c", Mount(), 64, 48, 50.0, 52.0, 30.7, 24.1)
FISHEYE = replace(PINHOLE, model="fisheye", fx=20.0, fy=20.0, distortion=(0.0, 0.0, 0.0, 0.0))


def test_kitti_points_fall_on_the_published_pixels():
    p2 = np.array(
        [[721.5377, 0, 609.5593, 44.85728], [0, 721.5377, 172.854, 0.2163791], [0, 0, 1, 0.002745884]]
    )
    rect = np.array(
        [
            [0.9999239, 0.00983776, -0.007445048],
            [-0.009869795, 0.9999421, -0.004278459],
            [0.007402527, 0.004351614, 0.9999631],
        ]
    )
    velo = np.array(
        [
            [0.007533745, -0.9999714, -0.000616602, -0.004069766],
            [0.01480249, 0.0007280733, -0.9998902, -0.07631618],
            [0.9998621, 0.00752379, 0.01480755, -0.2717806],
        ]
    )
    camera = CameraSpec("image_2", Mount(), 1242, 375, 721.5377, 721.5377, 609.5593, 172.854)
    # The fourth column of P2 is the camera's place beside camera 0, times K.
    beside = np.linalg.solve(p2[:, :3], p2[:, 3])
    points = np.array([[10.0, 0, 0], [20, 3, -1]])
    seen = (points @ velo[:, :3].T + velo[:, 3]) @ rect.T + beside
    pixels, depth = project(camera, seen)
    np.testing.assert_allclose(pixels, [[613.964, 175.007], [502.441, 215.485]], atol=0.01)
    np.testing.assert_allclose(depth, [9.7301, 19.7194], atol=1e-4)


def test_nuscenes_point_falls_on_the_published_pixel():
    def pose(t, wxyz):
        w, *xyz = wxyz
        return np.array(t), Rotation.from_quat([*xyz, w]).as_matrix()

    t_lidar, r_lidar = pose(
        [0.943713, 0, 1.84023],
        [0.7077955119163518, -0.006492242056004365, 0.010646214713995808, -0.7063073142877817],
    )
    t_camera, r_camera = pose(
        [1.70079118954, 0.0159456324149, 1.51095763913],
        [0.4998015430569128, -0.5030316162024876, 0.4997798114386805, -0.49737083824542755],
    )
    camera = CameraSpec(
        "front",
        Mount(),
        1600,
        900,
        1266.417203046554,
        1266.417203046554,
        816.2670197447984,
        491.50706579294757,
    )
    ego = r_lidar @ [1.0, 15.0, -0.5] + t_lidar
    pixels, depth = project(camera, (r_camera.T @ (ego - t_camera))[None])
    np.testing.assert_allclose(pixels, [[910.705, 532.505]], atol=0.01)
    np.testing.assert_allclose(depth, [14.2254], atol=1e-3)


def test_undistorted_pixels_follow_k():
    points = np.random.default_rng(0).uniform([-3, -3, 1], [3, 3, 20], (50, 3))
    homogeneous = points @ intrinsic_matrix(PINHOLE).T
    np.testing.assert_allclose(
        project(PINHOLE, points)[0], homogeneous[:, :2] / homogeneous[:, 2:], atol=1e-12
    )


def test_the_ray_of_the_principal_point_is_the_optical_axis():
    for camera in (PINHOLE, FISHEYE):
        np.testing.assert_allclose(unproject(camera, [[30.7, 24.1]]), [[0, 0, 1]], atol=1e-15)


def test_pixels_run_right_then_down():
    rays = pixel_rays(PINHOLE).reshape(48, 64, 3)
    assert (np.diff(rays[:, :, 0] / rays[:, :, 2], axis=1) > 0).all()
    assert (np.diff(rays[:, :, 1] / rays[:, :, 2], axis=0) > 0).all()


@pytest.mark.full
@settings(max_examples=60, deadline=None)
@given(
    k1=st.floats(-0.4, 0.4),
    k2=st.floats(-0.2, 0.2),
    p1=st.floats(-0.005, 0.005),
    p2=st.floats(-0.005, 0.005),
    k3=st.floats(-0.08, 0.08),
)
def test_projecting_a_pixels_ray_gives_the_pixel(k1, k2, p1, p2, k3):
    camera = replace(PINHOLE, distortion=(k1, k2, p1, p2, k3))
    rays = pixel_rays(camera)
    seen = np.isfinite(rays[:, 0])
    assume(seen.any())
    np.testing.assert_allclose(np.linalg.norm(rays[seen], axis=1), 1.0, atol=1e-12)
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    pixels, _ = project(camera, rays[seen] * 7.0)
    np.testing.assert_allclose(pixels, np.stack([u.ravel(), v.ravel()], 1)[seen], atol=1e-6)


@example(seed=108541, k1=0.375, k2=-0.05859375)  # Newton's method from the distorted point diverges
@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), k1=st.floats(-0.4, 0.4), k2=st.floats(-0.1, 0.1))
def test_the_ray_of_a_points_pixel_passes_through_the_point(seed, k1, k2):
    camera = replace(PINHOLE, distortion=(k1, k2, 1e-3, -1e-3, 0.0))
    points = np.random.default_rng(seed).uniform([-2, -2, 1], [2, 2, 9], (20, 3))
    pixels, depth = project(camera, points)
    seen = np.isfinite(pixels[:, 0])
    np.testing.assert_array_equal(depth, points[:, 2])
    rays = unproject(camera, pixels[seen])
    unit = points[seen] / np.linalg.norm(points[seen], axis=1, keepdims=True)
    np.testing.assert_allclose(rays, unit, atol=1e-8)


def test_every_pixel_of_a_real_strongly_distorted_camera_has_a_ray():
    # The unrectified camera 0 of KITTI.
    raw = CameraSpec(
        "raw", Mount(), 139, 51, 98.4, 98.1, 69.0, 24.4,
        distortion=(-0.3728755, 0.2037299, 0.002219027, 0.001383707, -0.07233722),
    )  # fmt: skip
    assert np.isfinite(pixel_rays(raw)).all()


def test_pixels_beyond_the_distortion_limit_have_no_ray():
    camera = replace(PINHOLE, distortion=(-0.8, 0.0, 0.0, 0.0, 0.0))
    # r (1 - 0.8 r^2) is greatest at r = 0.6455, where it is 0.4303: no ray arrives farther out.
    rays = pixel_rays(camera)
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    radius = np.hypot((u - 30.7) / 50, (v - 24.1) / 52).ravel()
    np.testing.assert_array_equal(np.isnan(rays[:, 0]), radius > 0.43033)


def test_points_behind_the_camera_or_beyond_the_distortion_limit_have_no_pixel():
    folded = replace(PINHOLE, distortion=(-0.8, 0.0, 0.0, 0.0, 0.0))
    pixels, depth = project(folded, [[0, 0, -1], [0.9, 0, 1], [0.3, 0, 1]])
    np.testing.assert_array_equal(np.isnan(pixels[:, 0]), [True, True, False])
    np.testing.assert_array_equal(depth, [-1, 1, 1])


def test_an_equidistant_fisheye_maps_angles_to_radii():
    angles = np.radians([0.0, 30, 60, 90, 120, 170])
    points = np.stack([np.sin(angles), np.zeros(6), np.cos(angles)], axis=1) * 4
    pixels, _ = project(FISHEYE, points)
    np.testing.assert_allclose(pixels[:, 0], 30.7 + 20 * angles, atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(k=st.tuples(*[st.floats(-0.05, 0.05)] * 4))
def test_fisheye_projection_inverts_its_rays(k):
    camera = replace(FISHEYE, distortion=k)
    rays = pixel_rays(camera)
    seen = np.isfinite(rays[:, 0])
    assume(seen.any())
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    pixels, _ = project(camera, rays[seen])
    np.testing.assert_allclose(np.linalg.norm(rays[seen], axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(pixels, np.stack([u.ravel(), v.ravel()], 1)[seen], atol=1e-6)


def test_a_fisheye_sees_nothing_outside_its_circle():
    small = replace(FISHEYE, fx=6.0, fy=6.0)
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    outside = np.hypot(u - 30.7, v - 24.1).ravel() >= 6 * np.pi
    np.testing.assert_array_equal(np.isnan(pixel_rays(small)[:, 0]), outside)
    assert 0 < outside.sum() < outside.size


def test_cached_pixel_rays_are_read_only():
    with pytest.raises(ValueError, match="read-only"):
        pixel_rays(PINHOLE)[0] = 0

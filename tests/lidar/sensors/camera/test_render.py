"""Rendered images: geometry to the pixel, and illumination."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from helpers.facades import with_windows
from helpers.sensor_worlds import MeshWorld, box, plate, world

from geoscene.classes import Class, materials
from geoscene.geometry.mesh import ROOF, WALL, Mesh, concatenate
from lidar.dataset.png import encode_png
from lidar.errors import InputError
from lidar.geometry.attitude import OPTICAL, Mount
from lidar.geometry.poses import Poses
from lidar.raycast import Caster, MeshInstances
from lidar.sensors.camera.edges import edge_pixels
from lidar.sensors.camera.render import _shared_rays, optical_flow, render
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.camera.shade import linear_table, places_in_pixels, straight_rays
from lidar.sensors.rig.camera_model import exposure_times, pixel_rays, project
from lidar.sensors.rig.specs import CameraSpec
from lidar.world.settings import WorldSettings

CAMERA = CameraSpec("c", Mount(), 160, 120, 100.0, 100.0, 79.5, 59.5)
FLAT = CameraSettings(detail=False, haze=np.inf, edge_rays=1, cloud=0.0)
NOON = (0.0, -1.0, 1.0)  # half way up in the south


def looking(position=(0.0, 0.0, 1.5), *, yaw=0.0, down=0.0, scale=1.0):
    """One pose of a camera: forward along x turned by yaw, then nose down; radians."""
    c, s, cd, sd = np.cos(yaw), np.sin(yaw), np.cos(down), np.sin(down)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[cd, 0, sd], [0, 1, 0], [-sd, 0, cd]])
    return Poses(np.array([position], float), (turn @ OPTICAL)[None], np.array([[scale, scale, 1.0]]))


def stacked(poses):
    return Poses(*(np.concatenate([getattr(p, n) for p in poses]) for n in ("position", "rotation", "scale")))


def ground(*, color=(118, 118, 118), material="asphalt", half=400.0):
    """A level square at z = 0."""
    v = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]])
    f = np.array([[0, 1, 2], [0, 2, 3]])
    return Mesh.of(v, f, feature=0, klass=Class.ROAD, material=materials()[material].code, color=color)


def house(low, high, *, feature=1, material="plaster"):
    """A box with the classes of walls and a roof."""
    mesh = box(low, high, feature=feature, material=material)
    up = mesh.normals()[:, 2]
    color = np.broadcast_to(np.array(materials()[material].color, np.uint8), (len(mesh), 3))
    return replace(mesh, surface=np.where(np.abs(up) < 0.5, WALL, ROOF).astype(np.uint8), color=color.copy())


def street():
    return world(
        ground(),
        house((-40, 6, 0), (10, 18, 14), feature=1),
        house((10, 6, 0), (60, 18, 9), feature=2, material="brick"),
        house((-40, -18, 0), (60, -8, 12), feature=3, material="concrete"),
    )


def test_depth_is_measured_along_the_optical_axis():
    frame = render(CAMERA, looking(), world=world(plate(10.0)), sun=NOON)
    # A plate perpendicular to the axis has one depth, though its corners are farther away.
    np.testing.assert_allclose(frame.depth, 10.0, atol=1e-5)


def test_depth_is_in_true_metres_where_the_grid_is_not():
    k = 0.9996
    frame = render(CAMERA, looking(scale=k), world=world(plate(10.0 * k)), sun=NOON)
    np.testing.assert_allclose(frame.depth, 10.0, atol=1e-5)


LENSES = (
    CAMERA,
    replace(CAMERA, distortion=(-0.3, 0.1, 1e-3, -1e-3, 0.0)),
    replace(CAMERA, model="fisheye", fx=60.0, fy=60.0, distortion=(0.02, 0.0, 0.0, 0.0)),
)


@pytest.mark.parametrize("camera", LENSES)
def test_frames_are_the_same_if_their_rays_are_too_many_to_keep(camera, monkeypatch):
    settings = CameraSettings(supersample=2)
    frames = []
    for shared in (1 << 23, 0):
        monkeypatch.setattr("lidar.sensors.camera.render._SHARED", shared)
        frames.append(render(camera, looking((0, 0, 1.5)), world=street(), sun=NOON, settings=settings))
    np.testing.assert_allclose(frames[0].depth, frames[1].depth, rtol=1e-6)
    np.testing.assert_array_equal(frames[0].feature, frames[1].feature)
    np.testing.assert_allclose(frames[0].rgb.astype(int), frames[1].rgb, atol=1)


@pytest.mark.parametrize("camera", LENSES)
def test_points_of_a_scanner_lie_in_the_depth_image(camera):
    town = street()
    poses = looking((0, 0, 1.5), yaw=0.3)
    frame = render(camera, poses, world=town, sun=NOON)
    scanner = np.array([0.5, 0.2, 1.9])
    directions = np.random.default_rng(1).normal(size=(4000, 3)) * [1, 1, 0.2] + [0.5, 0, 0]
    hits = town.caster.cast(scanner, directions)
    hit = np.isfinite(hits.range)
    points = scanner + hits.range[hit, None] * directions[hit]
    seen = (points - poses.position) @ poses.rotation[0]
    pixels, z = project(camera, seen)
    deep = np.linalg.norm(seen, axis=1) if camera.model == "fisheye" else z
    u, v = np.rint(pixels).T
    inside = np.isfinite(u) & (u >= 1) & (v >= 1) & (u < camera.width - 1) & (v < camera.height - 1)
    u, v, deep = u[inside].astype(int), v[inside].astype(int), deep[inside]
    # The point lies within its pixel: its depth is between those of the pixels around it.
    around = np.stack([frame.depth[v + j, u + i] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    visible = deep < around.max(axis=0) * 1.02 + 0.01  # others are hidden from the camera
    within = (deep > around.min(axis=0) * 0.999 - 1e-3) & (deep < around.max(axis=0) * 1.001 + 1e-3)
    assert visible.sum() > 300
    assert within[visible].mean() > 0.99
    surface = town.lookup(hits).feature[hit][inside]
    flat = np.stack([frame.feature[v + j, u + i] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    alone = (flat == flat[0]).all(axis=0) & within & visible
    assert alone.sum() > 200
    np.testing.assert_array_equal(flat[0][alone], surface[alone])


def test_a_box_covers_the_computed_pixels():
    # 4 m wide and 2 m high, its face 20 m away, f = 100 px: 20 by 10 pixels.
    frame = render(
        CAMERA, looking((0, 0, 1.0)), world=world(box((20, -2, 0), (22, 2, 2), feature=7)), sun=NOON
    )
    v, u = np.nonzero(frame.feature == 7)
    assert (np.ptp(u) + 1, np.ptp(v) + 1) == (20, 10)
    assert (u.min() + u.max()) / 2 == pytest.approx(79.5)
    assert (frame.klass[frame.feature == 7] == Class.BUILDING).all()
    assert (frame.klass[frame.feature != 7] == Class.SKY).all()
    assert np.isinf(frame.depth[frame.feature != 7]).all()


def test_a_balls_outline_is_that_of_its_tangent_cone():
    n = 200
    i = np.arange(n + 1) / n
    lat, lon = np.meshgrid((i - 0.5) * np.pi, i * 2 * np.pi, indexing="ij")
    v = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1).reshape(-1, 3)
    a = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    f = np.concatenate([np.stack([a, a + 1, a + n + 2], 1), np.stack([a, a + n + 2, a + n + 1], 1)])
    ball = Mesh.of(v * 2.0 + [10, 0, 1.5], f, feature=3)
    frame = render(CAMERA, looking(), world=world(ball), sun=NOON)
    # sin(half angle) = 2 / 10, radius = f tan(half angle)
    radius = 100 * np.tan(np.arcsin(0.2))
    assert (frame.feature == 3).sum() == pytest.approx(np.pi * radius**2, rel=0.01)
    assert frame.depth.min() == pytest.approx(8.0, abs=0.01)


def test_surfaces_beyond_far_have_colour_but_no_depth():
    frame = render(replace(CAMERA, far=9.0), looking(), world=world(plate(10.0, feature=5)), sun=NOON)
    assert np.isinf(frame.depth).all()
    assert (frame.feature == 5).all()


def test_surfaces_nearer_than_near_are_invisible():
    near = world(plate(0.5, half=0.2, feature=1), plate(10.0, feature=2))
    eye = looking((0, 0, 0.0))
    assert (render(CAMERA, eye, world=near, sun=NOON).feature == 1).any()
    assert (render(replace(CAMERA, near=1.0), eye, world=near, sun=NOON).feature == 2).all()


def _above():
    """A camera 50 m up that looks straight down, x right in the image and y up: 0.5 m a pixel."""
    rotation = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    return Poses(np.array([[0.0, 0.0, 50.0]]), rotation[None], np.ones((1, 3)))


@pytest.mark.parametrize("azimuth_deg", [0, 90, 200, 315])
def test_shadows_point_away_from_the_sun_with_the_computed_length(azimuth_deg):
    town = world(ground(), box((-1, -1, 0), (1, 1, 6), feature=1))
    elevation, azimuth = np.radians(30), np.radians(azimuth_deg)
    flat = np.array([np.sin(azimuth), np.cos(azimuth)])
    sun = [*np.cos(elevation) * flat, np.sin(elevation)]
    frame = render(CAMERA, _above(), world=town, sun=sun, settings=FLAT)
    bright = frame.rgb.astype(int).sum(axis=2)

    def at(xy):
        u, v = 79.5 + xy[0] * 2, 59.5 - xy[1] * 2
        assert frame.feature[round(v), round(u)] == 0
        return bright[round(v), round(u)]

    lit = at(flat * 5)
    length = 6 / np.tan(elevation)
    assert at(-flat * (length - 1.5)) < 0.6 * lit
    assert at(-flat * (length + 2.5)) == lit
    across = np.array([flat[1], -flat[0]])
    assert at(-flat * 5 + across * 4) == lit
    unshaded = render(CAMERA, _above(), world=town, sun=sun, settings=replace(FLAT, shadows=False))
    assert (unshaded.rgb[frame.feature == 0].astype(int).sum(axis=1) == lit).all()


def test_a_mid_grey_floor_in_sun_and_sky_is_a_quarter_of_full_scale():
    # sRGB 118 is 18 % reflectance; a quarter of full scale is sRGB 137.
    for sun in ((0, -1, 1), (1, 0, 0.3), (0.0, 0.0, 1.0)):
        frame = render(CAMERA, _above(), world=world(ground()), sun=sun, settings=FLAT)
        assert frame.rgb.mean() == pytest.approx(137, abs=4)
    camera = replace(CAMERA, exposure_ev=1.0)
    brighter = render(camera, _above(), world=world(ground()), sun=NOON, settings=FLAT)
    # A stop doubles linear light: 0.5 of full scale is sRGB 188.
    assert brighter.rgb.mean() == pytest.approx(188, abs=5)


def test_a_wall_is_lit_by_the_cosine_of_the_suns_angle():
    light = []
    for turn in np.radians([0, 30, 60]):
        sun = (-np.cos(turn), np.sin(turn), 1e-3)
        wall = world(plate(10.0))
        shade = render(CAMERA, looking(), world=wall, sun=(1.0, 0, 1e-3), settings=FLAT).rgb
        assert shade.max() < 255
        raw = render(replace(CAMERA, exposure_ev=-3.0), looking(), world=wall, sun=sun, settings=FLAT).rgb
        s = raw[60, 80] / 255
        light.append(np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)[0])
    assert light[0] > light[1] > light[2]


def test_same_input_same_bytes_on_any_number_of_threads():
    town, poses = street(), looking(yaw=0.2)
    a, b = (render(CAMERA, poses, world=town, sun=NOON, threads=n) for n in (1, 3))
    assert encode_png(a.rgb) == encode_png(b.rgb)
    for name in ("depth", "klass", "feature"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_noise_follows_its_seed_and_the_light():
    camera, settings = replace(CAMERA, full_well=2000.0), replace(FLAT, camera_noise=True)

    def shot(key):
        random = np.random.Generator(np.random.Philox(key=key))
        return render(camera, _above(), world=world(ground()), sun=NOON, random=random, settings=settings).rgb

    np.testing.assert_array_equal(shot(5), shot(5))
    assert (shot(5) != shot(6)).mean() > 0.5
    # A quarter of full scale is 500 electrons, with a spread of 22.7.
    spread = shot(5)[..., 1].astype(float).std()
    slope = 255 * 1.055 / 2.4 * 0.25 ** (1 / 2.4 - 1)
    assert spread == pytest.approx(slope * np.sqrt(500 + 16) / 2000, rel=0.1)
    with pytest.raises(InputError, match="random"):
        render(camera, _above(), world=world(ground()), sun=NOON, settings=settings)


def test_supersampling_softens_edges_and_keeps_labels():
    town, poses = street(), looking(yaw=0.2)
    plain = render(CAMERA, poses, world=town, sun=NOON, settings=FLAT)
    soft = render(CAMERA, poses, world=town, sun=NOON, settings=replace(FLAT, supersample=2))
    np.testing.assert_array_equal(plain.depth, soft.depth)
    np.testing.assert_array_equal(plain.feature, soft.feature)
    a, b = plain.rgb.astype(float), soft.rgb.astype(float)
    assert abs(a.mean() - b.mean()) < 1.5
    # A step taken in two halves has half the energy.
    assert (np.diff(b, axis=1) ** 2).mean() < 0.8 * (np.diff(a, axis=1) ** 2).mean()


def test_rays_at_edges_alone_come_close_to_rays_everywhere():
    town, poses = street(), looking(yaw=0.2)

    def shot(**rays):
        settings = replace(FLAT, **rays)
        return render(CAMERA, poses, world=town, sun=NOON, settings=settings).rgb.astype(float)

    one, few, all_ = shot(), shot(edge_rays=2), shot(supersample=2)
    changed = (one != few).any(axis=2)
    assert 0 < changed.mean() < 0.25
    np.testing.assert_array_equal(few[changed], all_[changed])
    assert ((few - all_) ** 2).mean() < 0.1 * ((one - all_) ** 2).mean()
    np.testing.assert_array_equal(shot(supersample=2, edge_rays=2), all_)


def test_an_edge_lies_between_objects_of_other_colour_or_strong_contrast_on_one():
    rgb = np.full((1, 6, 3), 100, np.uint8)
    rgb[0, 3:] += 20
    rgb[0, 5] += 60
    one, klass = np.zeros((1, 6), np.int32), np.full((1, 6), int(Class.ROAD), np.uint8)
    assert edge_pixels(rgb, one, klass=klass).tolist() == [4, 5]
    two = one.copy()
    two[0, 3:] = 1
    assert edge_pixels(rgb, two, klass=klass).tolist() == [2, 3, 4, 5]
    assert edge_pixels(np.full_like(rgb, 100), two, klass=klass).tolist() == []
    outside = np.where(np.arange(6) >= 5, int(Class.UNLABELED), klass).astype(np.uint8)
    nowhere = np.where(np.arange(6) >= 5, -1, one).astype(np.int32)
    assert edge_pixels(rgb, nowhere, klass=outside).tolist() == []


def test_a_rolling_shutter_slants_an_upright_edge():
    camera = replace(CAMERA, row_ns=100_000)
    times = exposure_times(camera, 5_000)
    assert times.tolist() == [5_000 + 100_000 * v for v in range(120)]
    # 20 m/s to the left, 10 m from an upright edge: 100 / 10 * 20 * 1e-4 = 0.02 pixels a row, right.
    poses = stacked([looking((0.0, 20.0 * 1e-4 * v, 1.5)) for v in range(120)])
    edge = world(box((10, -50, -50), (11, 0, 50), feature=1))
    frame = render(camera, poses, world=edge, sun=NOON)
    first = np.argmax(frame.feature == 1, axis=1)
    slope = np.polyfit(np.arange(120), first, 1)[0]
    assert slope == pytest.approx(0.02, abs=0.002)
    with pytest.raises(InputError, match="exposure_times"):
        render(camera, looking(), world=edge, sun=NOON)


def test_a_finite_exposure_blurs_motion():
    camera = replace(CAMERA, exposure_ns=10_000_000)
    times = exposure_times(camera, 0, samples=5)
    assert times.tolist() == [1_000_000, 3_000_000, 5_000_000, 7_000_000, 9_000_000]
    # 20 m/s for 10 ms is 0.2 m, 2 pixels at 10 m: the edge takes steps instead of one jump.
    poses = stacked([looking((0.0, 20.0 * t * 1e-9, 1.5)) for t in times])
    edge = world(box((10, -50, -50), (11, 0, 50), feature=1, material="tyre"))
    still = render(CAMERA, poses.take([2]), world=edge, sun=NOON, settings=FLAT)
    moved = render(camera, poses, world=edge, sun=NOON, settings=FLAT)
    row = moved.rgb[60].astype(int).sum(axis=1)
    sharp = still.rgb[60].astype(int).sum(axis=1)
    assert (np.diff(sharp) != 0).sum() <= 1 + (np.abs(np.diff(sharp)) < 10).sum()
    between = (row > sharp.min() + 20) & (row < sharp.max() - 20)
    assert 1 <= between.sum() <= 3
    np.testing.assert_array_equal(still.depth, moved.depth)


def test_a_fisheye_measures_along_its_rays_and_is_black_outside_its_circle():
    camera = replace(CAMERA, model="fisheye", fx=15.0, fy=15.0, distortion=(0.0,) * 4)
    frame = render(camera, looking((0, 0, 3.0)), world=world(ground()), sun=NOON)
    outside = np.isnan(pixel_rays(camera)[:, 0]).reshape(120, 160)
    assert outside.any()
    assert (frame.klass[outside] == Class.UNLABELED).all()
    assert (frame.rgb[outside] == 0).all()
    assert (frame.klass[~outside] != Class.UNLABELED).all()
    assert np.isinf(frame.depth[outside]).all()
    # Straight down is 90 degrees off the axis, 3 m away along the ray; on the axis its z would be 0.
    v = round(59.5 + 15 * np.pi / 2)
    assert frame.depth[v, 79:81] == pytest.approx(3.0, abs=0.01)


def _corners(rgb):
    """Number of Harris corners above a fixed strength."""
    grey = rgb.astype(float).mean(axis=2)
    dv, du = np.gradient(grey)

    def box3(a):
        return sum(np.roll(np.roll(a, i, 0), j, 1) for i in (-1, 0, 1) for j in (-1, 0, 1)) / 9

    xx, yy, xy = box3(du * du), box3(dv * dv), box3(du * dv)
    strength = xx * yy - xy * xy - 0.05 * (xx + yy) ** 2
    peak = np.max([np.roll(np.roll(strength, i, 0), j, 1) for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)
    return int(((strength == peak) & (strength > 3000)).sum())


@pytest.mark.full
def test_detail_gives_odometry_features_to_track():
    camera = replace(CAMERA, width=640, height=480, fx=400.0, fy=400.0, cx=319.5, cy=239.5)
    town, poses = street(), looking((-20, 0, 1.5), yaw=0.1)
    windows = MeshWorld(town.mesh, relief=with_windows(town.mesh))
    smooth = CameraSettings(supersample=3)
    drawn = _corners(render(camera, poses, world=windows, sun=NOON, settings=smooth).rgb)
    plain = _corners(render(camera, poses, world=town, sun=NOON, settings=replace(smooth, detail=False)).rgb)
    assert drawn > 300
    assert drawn > 10 * plain


def test_detail_stays_in_its_place_when_the_camera_moves():
    mesh = house((10, -20, -20), (12, 20, 20), material="plaster")
    wall = MeshWorld(mesh, relief=with_windows(mesh))
    camera = replace(CAMERA, width=320, fx=200.0, fy=200.0, cx=159.5)
    settings = CameraSettings(supersample=3, haze=np.inf)
    a, b = (
        render(camera, looking((0, y, 0.0)), world=wall, sun=(-1, -0.5, 0.8), settings=settings)
        .rgb[:, :, 1]
        .astype(float)
        for y in (0.0, 1.0)
    )
    # 1 m to the left at 10 m: everything moves right by 200 / 10 = 20 pixels.
    here = np.abs(a[:, :280] - b[:, 20:300]).mean()
    for shift in (0, 10, 19, 21, 30):
        assert here < 0.6 * np.abs(a[:, :280] - b[:, shift : shift + 280]).mean()
    assert a.std() > 5


def test_far_detail_fades_instead_of_flickering():
    # The farther the ground, the less neighbouring pixels differ.
    camera = replace(CAMERA, width=200, height=200, fx=400.0, fy=400.0, cx=99.5, cy=99.5)
    contrast = []
    for height in (20.0, 100.0, 800.0):
        poses = _above()
        poses = Poses(np.array([[0.0, 0.0, height]]), poses.rotation, poses.scale)
        rgb = render(camera, poses, world=world(ground()), sun=NOON, settings=replace(FLAT, detail=True)).rgb
        contrast.append(np.abs(np.diff(rgb.astype(float), axis=1)).mean())
    assert all(near > far for near, far in pairwise(contrast))


def test_haze_removes_98_percent_of_contrast_at_the_visibility():
    def contrast(visibility):
        settings = CameraSettings(detail=False, haze=visibility)
        pair = world(
            replace(plate(200.0, half=99, feature=1), color=np.full((2, 3), 40, np.uint8)),
            box((199.9, 0, -99), (200.5, 99, 99), feature=2),
        )
        middle = replace(CAMERA, width=20, height=20, cx=9.5, cy=9.5)
        frame = render(middle, looking((0, 0, 0)), world=pair, sun=(-1, 0, 0.5), settings=settings)
        s = frame.rgb / 255
        light = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)[..., 1]
        return abs(light[frame.feature == 1].mean() - light[frame.feature == 2].mean())

    # Koschmieder: 2 % of the contrast is left at the visibility; at half of it the root of that, 14 %.
    assert contrast(400.0) / contrast(np.inf) == pytest.approx(np.exp(-3.912 / 2), rel=0.1)


def test_flow_of_a_still_world_is_the_cameras_own_motion():
    first, second = looking((0, 0, 1.5)), looking((0, 0.5, 1.5))
    flow = optical_flow(CAMERA, first, later=second, world=world(plate(10.0)))
    np.testing.assert_allclose(flow[..., 0], 100 * 0.5 / 10, atol=1e-4)
    np.testing.assert_allclose(flow[..., 1], 0, atol=1e-4)


def test_flow_of_a_rolling_shutter_ends_on_the_row_that_exposes_the_point():
    camera = replace(CAMERA, row_ns=100_000)
    rows, period = np.arange(120) * 1e-4, 0.1
    up, left = 8.0, 3.0  # metres per second

    def exposed(t):
        return stacked([looking((0.0, left * s, 1.5 + up * s)) for s in t])

    flow = optical_flow(camera, exposed(rows), later=exposed(rows + period), world=world(plate(10.0)))
    # A point sinks by k pixels per second and is exposed d rows further down: d = k (period + d row).
    k = 100 / 10 * up
    down = k * period / (1 - k * 1e-4)
    inside = np.arange(120) + down < 119
    np.testing.assert_allclose(flow[inside, :, 1], down, atol=0.01)
    np.testing.assert_allclose(flow[inside, :, 0], 100 / 10 * left * (period + down * 1e-4), atol=0.01)
    assert down - k * period > 0.05
    with pytest.raises(InputError, match="120 poses"):
        optical_flow(camera, looking(), later=looking(), world=world(plate(10.0)))


def test_flow_of_the_sky_depends_on_rotation_alone():
    sky = world(box((-5, -5, -100), (5, 5, -99)))
    np.testing.assert_allclose(
        optical_flow(CAMERA, looking(), later=looking((5, 3, 2)), world=sky), 0, atol=1e-4
    )
    turned = optical_flow(CAMERA, looking(), later=looking(yaw=0.1), world=sky)
    assert turned[60, 79, 0] == pytest.approx(100 * np.tan(0.1), abs=0.1)


def test_a_pixel_follows_its_flow_to_the_same_surface():
    town = street()
    first, second = looking((0, 0, 1.5), yaw=0.1), looking((0.6, 0.1, 1.5), yaw=0.13)
    flow = optical_flow(CAMERA, first, later=second, world=town)
    a, b = (render(CAMERA, p, world=town, sun=NOON) for p in (first, second))
    v, u = np.mgrid[0:120, 0:160]
    to = np.rint(np.stack([u, v], -1) + flow).astype(int)
    inside = (to >= 0).all(-1) & (to[..., 0] < 160) & (to[..., 1] < 120)
    same = a.feature[inside] == b.feature[to[inside][:, 1], to[inside][:, 0]]
    assert same.mean() > 0.97


@dataclass
class ActorWorld:
    """A world of one box that moves by ``way`` from ray time 0 to ray time 1."""

    shift: tuple[float, float, float]
    way: tuple[float, float, float]
    reach = np.inf
    settings = WorldSettings()

    def __post_init__(self):
        self.mesh = box((-1, -1, -1), (1, 1, 1), feature=9)
        shape = Caster(self.mesh.vertices, self.mesh.faces)
        places = [np.array(self.shift, float), np.add(self.shift, self.way)]
        transform = np.array([[np.column_stack([np.eye(3), place]) for place in places]])
        back = plate(50.0)
        self.back = MeshWorld(back)
        self.surfaces, self.walls = self.back.surfaces, self.back.walls
        self.caster = Caster(
            back.vertices, back.faces, instances=[MeshInstances((shape,), np.zeros(1, np.int32), transform)]
        )

    def lookup(self, hits):
        own = self.back.lookup(replace(hits, face=np.where(hits.instance < 0, hits.face, -1)))
        return replace(own, feature=np.where(hits.instance >= 0, 9, own.feature).astype(np.int32))


def test_flow_of_an_actor_is_its_own_motion():
    still = looking((0, 0, 0))
    moving = ActorWorld((11, 0, 0), (0, -0.5, 0))
    flow = optical_flow(CAMERA, still, later=still, world=moving)
    actor = render(CAMERA, still, world=moving, sun=NOON).feature == 9
    assert actor.sum() == 20 * 20
    np.testing.assert_allclose(flow[actor], [[5.0, 0.0]] * actor.sum(), atol=1e-4)
    np.testing.assert_allclose(flow[~actor], 0, atol=1e-4)


def test_flow_between_ray_times_is_that_part_of_an_actors_motion():
    still, part = looking((0, 0, 0)), {"times": np.array([0.2]), "later_times": np.array([0.8])}
    flow = optical_flow(CAMERA, still, later=still, world=ActorWorld((11, 0, 0), (0, -0.5, 0)), **part)
    assert np.nanmax(flow) == pytest.approx(3.0, abs=1e-4)


def test_a_camera_that_does_not_record_colour_skips_it():
    frame = render(replace(CAMERA, images=("depth",)), looking(), world=street(), sun=NOON)
    assert frame.rgb is None
    assert np.isfinite(frame.depth).any()


def test_roofs_without_a_mapped_colour_differ_about_that_of_their_material():
    roofs = [
        house((x, y, 0), (x + 8, y + 8, 5), feature=x + 7 * y, material="tar_roof")
        for x in range(0, 80, 10)
        for y in range(0, 80, 10)
    ]
    over = looking((40.0, 40.0, 70.0), down=np.pi / 2)
    town = world(*roofs)

    def brightness(settings):
        frame = render(CAMERA, over, world=town, sun=NOON, settings=settings)
        light = linear_table()[frame.rgb].mean(axis=2)
        return np.array(
            [light[frame.feature == k].mean() for k in np.unique(frame.feature[frame.feature >= 0])]
        )

    found = brightness(replace(FLAT, detail=True)) / brightness(FLAT)
    assert found.mean() == pytest.approx(1.0, abs=0.1)
    assert found.std() > 0.1


def test_night_is_dark_but_not_empty():
    frame = render(CAMERA, looking(), world=street(), sun=(0.5, 0.0, -0.8), settings=FLAT)
    assert 0 < frame.rgb.mean() < 255
    assert np.ptp(frame.rgb) > 10


def test_settings_out_of_range_are_refused():
    for bad in ({"supersample": 0}, {"edge_rays": 17}, {"haze": 0.0}, {"cloud": 1.1}):
        with pytest.raises(InputError):
            CameraSettings(**bad)


def test_the_whole_street_is_one_mesh():
    assert len(street().mesh) == 2 + 3 * 12
    assert isinstance(concatenate([ground()]), Mesh)


def test_wet_ground_is_darker_and_mirrors_what_stands_on_it():
    tower = replace(house((30, -3, 0), (34, 3, 60)), color=np.tile(np.uint8([220, 20, 20]), (12, 1)))
    dry, damp, wet = (
        render(CAMERA, looking(), world=world(ground(), tower, wetness=w), sun=NOON, settings=FLAT).rgb
        for w in (0.0, 0.4, 1.0)
    )
    near = slice(112, 120), slice(60, 100)
    assert damp[near].mean() < dry[near].mean()
    mirrored = slice(75, 110), slice(74, 86)  # below the tower, on the ground in front of it
    redness = [np.diff(image[mirrored][..., [2, 0]].astype(int)).mean() for image in (dry, damp, wet)]
    assert redness[0] < redness[1] < redness[2]
    assert redness[2] > 5


def test_snow_covers_its_share_of_the_ground_and_none_of_the_walls():
    scene = ground(material="soil", color=(60, 50, 40)), house((30, -80, 0), (34, -20, 40))
    look = {"sun": NOON, "settings": FLAT}
    above = looking((0, 0, 40), down=np.pi / 2)
    for share in (0.2, 0.5, 0.8):
        rgb = render(CAMERA, above, world=world(*scene, snow=share), **look).rgb
        assert (rgb[..., 2] > 170).mean() == pytest.approx(share, abs=0.1)
    bare, deep = (render(CAMERA, looking(yaw=-1.0), world=world(*scene, snow=s), **look) for s in (0.0, 1.0))
    wall = bare.klass == Class.BUILDING
    assert np.median(deep.rgb[bare.klass == Class.ROAD]) > 200  # but for shadows
    assert deep.rgb[bare.klass == Class.ROAD].max() < 255  # exposed for it
    assert deep.rgb[wall].mean() < 180  # though snow lights them


def test_depth_and_labels_are_those_of_the_dry_world():
    dry, wet = (
        render(CAMERA, looking(), world=world(ground(), wetness=w, snow=w), sun=NOON) for w in (0.0, 0.7)
    )
    for name in ("depth", "klass", "feature"):
        assert np.array_equal(getattr(dry, name), getattr(wet, name))


@pytest.mark.full
def test_rays_of_six_lenses_with_distortion_are_computed_once():
    lenses = [replace(CAMERA, fx=100.0 + k, distortion=(-0.2, 0.1, 0.0, 0.0, 0.0)) for k in range(6)]
    scene = world(ground())
    _shared_rays.cache_clear()
    for lens in 2 * lenses:
        render(lens, looking(), world=scene, sun=NOON)
    assert _shared_rays.cache_info().misses == 12  # of each lens and of its finer one, for edges


def test_rays_of_an_undistorted_pinhole_are_those_of_the_camera_model():
    camera = replace(CAMERA, width=41, height=23, fx=37.3, fy=36.1, cx=19.7, cy=11.2)
    number = np.arange(camera.width * camera.height)
    rays = np.empty((len(number), 3))
    straight_rays(number, camera.width, 1, (camera.fx, camera.fy, camera.cx, camera.cy), rays)
    expected = pixel_rays(camera)
    np.testing.assert_allclose(rays, expected / expected[:, 2:], rtol=1e-15, atol=1e-16)


@pytest.mark.parametrize("parts", [2, 3, 4, 7])
def test_no_two_rays_of_a_pixel_are_in_one_column_or_row(parts):
    width = 5 * parts
    number = np.arange(3 * parts * width)
    place = (places_in_pixels(number, width, parts=parts) + 0.5) / parts
    pixel, within = np.divmod(place, 1.0)
    assert (np.bincount((pixel @ [1, 5]).astype(int)) == parts**2).all()
    for axis in range(2):
        steps = within[(pixel == [2, 1]).all(axis=1), axis] * parts**2 - 0.5
        assert np.sort(steps) == pytest.approx(np.arange(parts**2))
    rays = np.empty((len(number), 3))
    straight_rays(number, width, parts, (80.0, 70.0, 3.5, 1.5), rays)
    expected = (places_in_pixels(number, width, parts=parts) - [3.5, 1.5]) / [80.0, 70.0]
    np.testing.assert_allclose(rays[:, :2], expected, atol=1e-14)

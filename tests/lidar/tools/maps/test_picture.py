"""Pictures show points and scenes at their positions and in their colours."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from helpers.sensor_worlds import MeshWorld, box
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.classes import Class, class_codes
from geoscene.geometry.mesh import Mesh, concatenate
from lidar.errors import InputError
from lidar.motion.vehicle import load_vehicle
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.rig.camera_model import project
from lidar.tools.maps.picture import (
    BACKGROUND,
    VIEWS,
    PictureView,
    camera_around,
    class_colors,
    cloud_picture,
    depth_picture,
    sheet,
    sweep_picture,
    with_legend,
)
from lidar.tools.plots.scene_picture import scene_picture

RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)
PLAIN = CameraSettings(detail=False, haze=np.inf)


def _where(image, color):
    """Middle (u, v) of the pixels of a colour."""
    v, u = np.nonzero((image == color).all(axis=2))
    assert len(u), f"no pixel is {color}"
    return u.mean(), v.mean()


@settings(max_examples=40, deadline=None)
@given(
    azimuth=st.floats(0, 360),
    elevation=st.floats(0, 90),
    fov=st.floats(1, 90),
    size=st.tuples(st.integers(20, 2000), st.integers(20, 2000)),
    span=st.tuples(*[st.floats(0.1, 1000)] * 3),
)
def test_all_points_are_in_view_and_fill_it(azimuth, elevation, fov, size, span):
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * span + [50, -70, 9]
    camera, pose = camera_around(corners, PictureView(azimuth, elevation, fov), size=size)
    pixels, depth = project(camera, (corners - pose.position) @ pose.rotation[0])
    assert (depth > 0).all()
    share = (pixels + 0.5) / size
    assert share.min() >= 0
    assert share.max() <= 1
    edges = np.stack([share.min(axis=0), 1 - share.max(axis=0)])
    assert (edges < 0.03).all(axis=0).any()  # along one axis it touches both sides of the picture


def test_from_above_north_is_up_and_east_is_right():
    points = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0]])
    image = cloud_picture(
        points,
        [RED, GREEN, BLUE],
        view="top",
        size=(200, 200),
        bounds=[[-5, -5, 0], [15, 15, 1]],
        depth=False,
    )
    (u, v), (east, level), (upright, north) = (_where(image, c) for c in (RED, GREEN, BLUE))
    assert east - u == pytest.approx(v - north, abs=1.5)
    assert east - u == pytest.approx(200 * 10 / 20 * 0.98, abs=2)
    assert abs(level - v) <= 1
    assert abs(upright - u) <= 1


def test_the_upper_point_hides_the_lower_one_in_either_order():
    for order in ([0, 1], [1, 0]):
        points, colors = np.array([[0, 0, 0.0], [0, 0, 5]])[order], np.array([RED, BLUE])[order]
        bounds = [[-1, -1, 0], [1, 1, 5]]
        image = cloud_picture(points, colors, view="top", size=(60, 60), bounds=bounds, depth=False)
        assert (image == BLUE).all(axis=2).any()
        assert not (image == RED).all(axis=2).any()


def test_every_lone_point_is_drawn():
    rng = np.random.default_rng(0)
    points = np.stack([np.arange(25) % 5, np.arange(25) // 5, rng.uniform(0, 1, 25)], axis=1)
    colors = np.stack([np.arange(25) + 100, np.full(25, 200), np.full(25, 50)], axis=1)
    for view in VIEWS:
        bounds = [points.min(axis=0), points.max(axis=0)]
        image = cloud_picture(points, colors, view=view, size=(300, 200), bounds=bounds, depth=False)
        assert {100 + k for k in range(25)} <= set(image[..., 0][image[..., 1] == 200].tolist()), view


def test_edges_in_depth_are_darkened_and_flats_are_not():
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, 10, 300), np.linspace(0, 10, 300)))
    points = np.stack([x, y, np.where(x > 5, 3.0, 0.0)], axis=1)
    white = np.full((len(points), 3), 200)
    image = cloud_picture(points, white, view="top", size=(200, 200), point=0.1)
    row = image[100, :, 0].astype(int)
    step = int(np.argmin(np.where(np.abs(np.arange(200) - 100) < 20, row, 999)))
    assert row[step] < 150
    assert row[40] == row[160] == 200


def test_invalid_pictures_are_refused():
    with pytest.raises(InputError, match="needs points"):
        cloud_picture(np.empty((0, 3)), np.empty((0, 3)))
    with pytest.raises(InputError, match="top, oblique"):
        cloud_picture(np.zeros((3, 3)), np.zeros((3, 3)), view="askew")
    with pytest.raises(InputError):
        sheet([])


@dataclass
class Area(MeshWorld):
    """A small world with its region."""

    region = (-50.0, -50.0, 50.0, 50.0)


def _village():
    v = np.array([[-50, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]], float)
    ground = Mesh.of(v, np.array([[0, 1, 2], [0, 2, 3]]), color=(100, 100, 100))
    red = replace(box((20, 20, 0), (40, 30, 8), feature=1), color=np.tile(np.uint8(RED), (12, 1)))
    return Area(concatenate([ground, red]))


def test_a_scene_from_above_is_a_map():
    image = scene_picture(_village(), view="top", size=(400, 300), sun=(0, 0, 1), settings=PLAIN)
    redness = (image[..., 0] > 150) & (image[..., 1] < 60)
    v, u = np.nonzero(redness)
    scale = 300 / 100 * 0.98  # pixels per metre: the height of the picture is the tighter fit
    assert np.ptp(u) + 1 == pytest.approx(20 * scale, abs=3)
    assert np.ptp(v) + 1 == pytest.approx(10 * scale, abs=3)
    assert u.mean() == pytest.approx(200 + 30 * scale, abs=3)
    assert v.mean() == pytest.approx(150 - 25 * scale, abs=3)


def test_an_oblique_picture_shows_walls_and_shadows():
    image = scene_picture(_village(), size=(320, 200), settings=PLAIN).astype(int)
    red = (image[..., 0] > 2 * image[..., 1]) & (image[..., 0] > 60)
    assert len(np.unique(image[red][:, 0])) >= 2  # roof and walls are lit differently
    grey = np.abs(np.diff(image, axis=2)).max(axis=2) < 40
    assert (image[grey & ~red].sum(axis=1) < 200).any()  # the shadow on the ground
    plain = scene_picture(_village(), size=(320, 200), settings=replace(PLAIN, shadows=False)).astype(int)
    assert image.sum() < plain.sum()


def test_the_same_scene_gives_the_same_picture():
    a, b = (scene_picture(_village(), size=(160, 100)) for _ in range(2))
    np.testing.assert_array_equal(a, b)


def test_depth_is_bright_near_and_dark_far_and_grey_where_unknown():
    depth = np.array([[2.0, 5, 20, 120, np.inf, 0.0]])
    picture = depth_picture(depth)[0].astype(int)
    light = picture @ [2126, 7152, 722]
    assert (np.diff(light[:4]) < 0).all()
    assert (picture[4:] == (40, 40, 44)).all()


def test_the_legend_names_the_classes_in_the_picture_and_covers_only_a_corner():
    klass = np.full((200, 300), Class.ROAD, np.uint8)
    klass[:50] = Class.CAR
    klass[50:60] = Class.SKY
    image = class_colors(klass)
    keyed = with_legend(image, klass)
    changed = (keyed != image).any(axis=2)
    v, u = np.nonzero(changed)
    assert v.min() > 120
    assert u.max() < 150
    inside = keyed[v.min() : v.max() + 1, u.min() : u.max() + 1].reshape(-1, 3).tolist()
    colors = class_codes().color
    assert colors[Class.ROAD].tolist() in inside
    assert colors[Class.CAR].tolist() in inside
    assert colors[Class.SKY].tolist() not in inside
    assert keyed.flags.writeable
    np.testing.assert_array_equal(image, class_colors(klass))


def test_the_legend_has_room_for_every_class():
    classes = [k for k in Class if k != Class.SKY]
    klass = np.repeat(np.array(classes, np.uint8), 4000)[: 300 * 400].reshape(300, 400)
    keyed = with_legend(np.zeros((300, 400, 3), np.uint8), klass).reshape(-1, 3)
    shown = {tuple(c) for c in keyed.tolist()}
    present = np.unique(klass)
    assert len(present) > 25
    assert {tuple(class_codes().color[k].tolist()) for k in present} <= shown


def test_a_sweep_picture_shows_the_vehicle_and_range_rings():
    """From above: the vehicle's outline in the middle, rings around it at intervals of 10 m."""
    far = np.array([[55.0, 0.0, 0.0], [-55.0, 0.0, 0.0], [0.0, 55.0, 0.0], [90.0, 90.0, 0.0]])
    colors = np.array([RED, RED, RED, BLUE], np.uint8)
    image = sweep_picture(far, colors, vehicle=load_vehicle("car"), view="top", size=(600, 600))
    u, v = _where(image, (255, 255, 255))
    front = load_vehicle("car").length / 2 - load_vehicle("car").rear_overhang
    per_metre = 600 * 0.98 / 120
    assert (u - 299.5) / per_metre == pytest.approx(front, abs=1.5)
    assert v == pytest.approx(299.5, abs=5)
    row = (np.abs(image[299].astype(int) - (110, 116, 130)).max(axis=1) < 40) & (np.arange(600) > 340)
    rings = np.flatnonzero(row)
    rings = rings[np.append(True, np.diff(rings) > 4)]
    np.testing.assert_allclose(np.diff(rings) / per_metre, 10, atol=0.6)
    assert not (image == BLUE).all(axis=2).any()
    with pytest.raises(InputError, match="points"):
        sweep_picture(far[3:], colors[3:])


def test_a_sheet_holds_its_pictures_in_order():
    a, b, c = (np.full((10, 20, 3), k, np.uint8) for k in (10, 20, 30))
    whole = sheet([a, b, c], columns=2, gap=4)
    assert whole.shape == (24, 44, 3)
    assert (whole[:10, :20] == 10).all()
    assert (whole[:10, 24:] == 20).all()
    assert (whole[14:, :20] == 30).all()
    assert (whole[14:, 24:] == 255).all()


def test_a_picture_of_two_points_is_mostly_background():
    image = cloud_picture([[0, 0, 0.0], [1, 1, 1]], [RED, RED], size=(100, 80), depth=False)
    assert (image == BACKGROUND).all(axis=2).mean() > 0.9

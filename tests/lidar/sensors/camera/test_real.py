"""Cameras in a real place."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from geoscene.classes import Class
from geoscene.pipeline.build import build
from geoscene.sources import read_osm
from lidar.dataset.png import depth_to_counts, encode_png
from lidar.geometry.attitude import OPTICAL, Mount
from lidar.geometry.poses import Poses
from lidar.sensors.camera.light import sun_direction
from lidar.sensors.camera.render import render
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.rig.camera_model import project
from lidar.sensors.rig.specs import CameraSpec
from lidar.tools.plots.scene_picture import scene_picture
from lidar.world.world import World

pytestmark = pytest.mark.shared

CAMERA = CameraSpec("c", Mount(), 640, 360, 350.0, 350.0, 319.5, 179.5)


@pytest.fixture(scope="module")
def column(shared_osm, tmp_path_factory):
    """The Victory Column in Berlin: a roundabout in a park, one tall monument in the middle."""
    scene = build(
        read_osm(shared_osm("berlin_siegessaeule.osm.gz")), tmp_path_factory.mktemp("column") / "scene"
    )
    return scene, World.load(scene)


def _column(world):
    """Position (x, y) of the tallest object of the scene."""
    x0, y0, x1, y1 = world.region
    x, y = (g.ravel() for g in np.meshgrid(np.arange(x0, x1), np.arange(y0, y1)))
    hits = world.caster.cast(np.stack([x, y, np.full(x.size, 500.0)], 1), np.tile([0.0, 0, -1], (x.size, 1)))
    top = hits.range < hits.range.min() + 1
    return np.array([x[top].mean(), y[top].mean()])


def _street_view(world, *, yaw):
    """A camera 80 m from the column, 1.6 m above the ground, facing it along a bearing from east."""
    spot = np.array([*_column(world) - 80 * np.array([np.cos(yaw), np.sin(yaw)]), 100.0])
    ground = 100.0 - world.caster.cast(spot, np.array([[0.0, 0.0, -1.0]])).range[0]
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return Poses(np.array([[*spot[:2], ground + 1.6]]), (turn @ OPTICAL)[None], np.ones((1, 3)))


def test_a_scanners_points_lie_on_the_pixels_that_show_them(column):
    scene, world = column
    poses = _street_view(world, yaw=0.4)
    sun = sun_direction(scene.frame, datetime(2026, 6, 21, 9, tzinfo=UTC))
    frame = render(CAMERA, poses, world=world, sun=sun)
    # A scanner at the camera's position has no parallax, so nothing is hidden.
    directions = np.random.default_rng(0).normal(size=(20000, 3)) * [1, 1, 0.3]
    hits = world.caster.cast(poses.position[0], directions)
    hit = np.isfinite(hits.range)
    seen = (hits.range[hit, None] * directions[hit]) @ poses.rotation[0]
    pixels, z = project(CAMERA, seen)
    u, v = np.rint(pixels).T
    inside = (u >= 1) & (v >= 1) & (u < 639) & (v < 359) & (z < CAMERA.far)
    u, v, z = u[inside].astype(int), v[inside].astype(int), z[inside]
    around = np.stack([frame.depth[v + j, u + i] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    within = (z >= around.min(axis=0) * 0.999) & (z <= around.max(axis=0) * 1.001)
    assert len(z) > 1000
    assert within.mean() > 0.99
    feature = world.lookup(hits).feature[hit][inside]
    alone = np.stack([frame.feature[v + j, u + i] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    alone = (alone == alone[0]).all(axis=0)
    # Surfaces thinner than a pixel may lie between the rays of neighbouring pixels.
    assert (frame.feature[v, u] == feature)[alone].mean() > 0.995


def test_the_column_stands_in_the_middle_of_the_picture(column):
    _, world = column
    frame = render(CAMERA, _street_view(world, yaw=0.4), world=world, sun=(0, -1, 1))
    assert {Class.SKY, Class.ROAD, Class.BUILDING} <= set(np.unique(frame.klass).tolist())
    v, u = np.nonzero((frame.klass == Class.BUILDING) & (frame.depth < 90))
    assert abs(np.median(u) - 319.5) < 30
    # It is 67 m tall: from 80 m away it rises above the picture's upper edge.
    assert v.min() == 0


def test_frames_of_a_real_place_are_the_same_every_time(column):
    scene, _ = column
    shots = []
    for threads in (1, 2):
        world = World.load(scene)
        frame = render(
            CAMERA,
            _street_view(world, yaw=2.0),
            world=world,
            sun=(1, 0, 1),
            threads=threads,
        )
        shots.append((encode_png(frame.rgb), encode_png(depth_to_counts(frame.depth))))
    assert shots[0] == shots[1]


def test_an_image_does_not_depend_on_the_tiles_that_were_loaded_before(column):
    scene, world = column
    x0, y0 = scene.bounds[:2]
    moving = World.load(scene, region=(x0, y0, x0 + 1, y0 + 1))
    moving.follow(scene.bounds)
    pose, camera = _street_view(world, yaw=0.4), replace(CAMERA, width=160, height=90, cx=79.5, cy=44.5)
    a, b = (render(camera, pose, world=w, sun=(0, -1, 1)).rgb for w in (world, moving))
    np.testing.assert_array_equal(a, b)


def test_the_scene_fills_its_picture(column):
    _, world = column
    image = scene_picture(world, size=(320, 200), settings=CameraSettings(haze=np.inf))
    plain = (image == image[0, 0]).all(axis=2)
    assert plain.mean() < 0.7
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 500

"""Texture of the ground: it stays in its place, keeps the mean albedo, and gives features to follow."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.sensor_worlds import MeshWorld
from hypothesis import given
from hypothesis import strategies as st

from geoscene.classes import Class, materials
from geoscene.geometry.mesh import Mesh
from lidar.geometry.attitude import OPTICAL, Mount
from lidar.geometry.poses import Poses
from lidar.sensors.camera.ground_texture import (
    ASPHALT,
    BARE,
    CONCRETE,
    GREEN,
    LOOSE,
    PAVING,
    SETTS,
    draw_cracks,
    ground,
)
from lidar.sensors.camera.render import render
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.rig.specs import CameraSpec

KINDS = (ASPHALT, CONCRETE, PAVING, SETTS, LOOSE, GREEN)
DOWN = CameraSpec("down", Mount(), 320, 240, 400.0, 400.0, 159.5, 119.5)
SETTINGS = CameraSettings(haze=np.inf)
NOON = (0.0, -1.0, 1.0)
places = st.floats(-5000.0, 5000.0)


def tones(kind, *, width=0.002, half=40.0, count=260):
    """Factors (count, count) of a square, at places spread evenly but not in step with any pattern."""
    step = 2 * half / count
    jitter = np.random.default_rng(0).uniform(0, step, (count, count, 2))
    at = -half + step * np.stack(np.meshgrid(np.arange(count), np.arange(count)), axis=-1) + jitter
    return np.array([[ground(kind, False, x, y, 1.0, 0.0, width, width) for x, y in row] for row in at])


def level(material, *, klass=Class.ROAD, half=60.0):
    v = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]])
    of = materials()[material]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return MeshWorld(Mesh.of(v, faces, feature=0, klass=klass, material=of.code, color=of.color))


def above(x, y, *, height=4.0, turn=0.0):
    """A camera that looks straight down from above (x, y)."""
    c, s = np.cos(turn), np.sin(turn)
    axes = np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])
    return Poses(np.array([[x, y, height]]), axes[None], np.ones((1, 3)))


@pytest.mark.full
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("width", [0.002, 0.1, 1.0])
def test_texture_keeps_the_mean_albedo_however_far_the_ground_is(kind, width):
    assert tones(kind, width=width, half=150.0).mean() == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("kind", KINDS)
def test_texture_finer_than_a_pixel_fades(kind):
    spread = [tones(kind, width=width, count=80).std() for width in (0.002, 0.3, 20.0)]
    assert spread[0] > spread[1] > spread[2]
    assert spread[0] > 0.1
    assert spread[2] < 0.03


@given(places, places, st.sampled_from(KINDS), st.floats(0, 2 * np.pi))
def test_a_place_has_one_albedo_from_all_sides(x, y, kind, turn):
    fine = 1e-6
    one = ground(kind, False, x, y, 1.0, 0.0, fine, fine)
    other = ground(kind, False, x, y, np.cos(turn), np.sin(turn), fine, fine)
    assert other == pytest.approx(one, abs=1e-3)
    assert one > 0.0


@given(places, places, st.sampled_from(KINDS), st.floats(0.001, 3.0), st.floats(1.0, 30.0))
def test_paint_wears_less_than_the_road_under_it(x, y, kind, across, long):
    road = ground(kind, False, x, y, 0.6, 0.8, across, across * long)
    paint = ground(kind, True, x, y, 0.6, 0.8, across, across * long)
    assert abs(paint - 1.0) <= abs(road - 1.0)
    assert ground(BARE, False, x, y, 0.6, 0.8, across, across * long) == 1.0


def test_asphalt_is_speckled_by_its_stones_and_not_blotchy():
    # Standard deviation of what pixels show that are as wide as a stone, a hand, and a pace.
    stones, hand, pace = (tones(ASPHALT, width=width, half=6.0).std() for width in (0.001, 0.1, 0.7))
    assert 0.12 < stones < 0.35
    assert hand < 0.6 * stones
    assert pace < 0.4 * stones
    near = np.array([[ground(ASPHALT, False, x, y, 1.0, 0.0, 1e-3, 1e-3) for x in np.arange(0, 3, 0.0101)]
                     for y in (0.3, 1.7, 2.9, 4.1)])  # fmt: skip
    # From one stone to the next most of the contrast is there.
    steps = np.diff(near, axis=1).std() / np.sqrt(2)
    assert steps > 0.55 * near.std()


@pytest.mark.full
def test_cracks_are_rare_narrow_and_as_wide_from_along_as_from_across():
    x, y = np.random.default_rng(1).uniform(-300, 300, (2, 60_000))
    share = [draw_cracks(a, b, 1.0, 0.0, 0.002, 0.002, ASPHALT) for a, b in zip(x, y, strict=True)]
    assert 0.003 < np.mean(share) < 0.010
    aside = [draw_cracks(a, b, 0.0, 1.0, 0.002, 0.05, ASPHALT) for a, b in zip(x, y, strict=True)]
    along = [draw_cracks(a, b, 1.0, 0.0, 0.002, 0.05, ASPHALT) for a, b in zip(x, y, strict=True)]
    assert np.mean(aside) == pytest.approx(np.mean(share), rel=0.2)
    assert np.mean(along) == pytest.approx(np.mean(share), rel=0.2)


@pytest.mark.parametrize("material", ["asphalt", "concrete", "paving", "stone", "gravel", "grass"])
def test_ground_looks_the_same_from_another_pose(material):
    town = level(material)
    shots = [
        render(DOWN, above(*at), world=town, sun=NOON, settings=SETTINGS).rgb[:, :, 1].astype(float)
        for at in ((3.0, 5.0), (3.5, 5.0))
    ]
    # Half a metre along x at a height of 4 m is 400 / 4 / 2 = 50 pixels; image x is scene x.
    here = np.abs(shots[0][:, 50:] - shots[1][:, :-50]).mean()
    for shift in (0, 40, 48, 52, 60):
        assert here < 0.25 * np.abs(shots[0][:, shift : shift + 250] - shots[1][:, :250]).mean()
    assert shots[0].std() > 4


def test_detail_off_leaves_the_ground_plain():
    flat = replace(SETTINGS, detail=False)
    image = render(DOWN, above(0, 0), world=level("asphalt"), sun=NOON, settings=flat).rgb
    assert np.ptp(image.reshape(-1, 3).astype(int), axis=0).max() <= 1


def test_oblique_ground_is_as_bright_as_ground_seen_from_above():
    town = level("asphalt", half=400.0)
    ahead = Poses(np.array([[0.0, 0.0, 1.6]]), OPTICAL[None], np.ones((1, 3)))
    frame = render(replace(DOWN, cy=20.0), ahead, world=town, sun=NOON, settings=SETTINGS)
    near, far = frame.rgb[200:, :, 1].mean(), frame.rgb[30:60, :, 1].mean()
    assert far == pytest.approx(near, rel=0.05)

"""Lamps of signal heads in images, by day and by night."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.sensor_worlds import MeshWorld, plate

from geoscene.geometry.mesh import concatenate
from geoscene.objects.shapes import shapes
from lidar.geometry.mounts import OPTICAL, Mount
from lidar.geometry.poses import Poses
from lidar.raycast import Caster, MeshInstances
from lidar.sensors.camera.light import daylight
from lidar.sensors.camera.render import RenderOptions, render
from lidar.sensors.camera.signal_lamps import APART, LENSES, RADIUS, Lamps, emit
from lidar.sensors.rig.specs import CameraSpec

CAMERA = CameraSpec("c", Mount(), 200, 160, 400.0, 400.0, 99.5, 79.5)
NOON, EVENING, NIGHT = (0.3, -0.5, 0.8), (0.98, -0.1, 0.05), (0.6, 0.0, -0.8)
FEATURE = 7


class SignalWorld(MeshWorld):
    """A world with a signal head at the origin that faces a camera on the x axis, before a wall."""

    def __init__(self):
        head = shapes()["traffic_signals"]
        super().__init__(
            concatenate([plate(-30.0, tilt=0.0), replace(head, feature=np.full(len(head), FEATURE))])
        )
        self.wall = len(self.mesh) - len(head)
        back = self.mesh.take(np.arange(self.wall))
        shape = Caster(head.vertices, head.faces)
        still = np.column_stack([np.eye(3), np.zeros(3)])[None]
        self.caster = Caster(
            back.vertices, back.faces, instances=[MeshInstances((shape,), np.zeros(1, np.int32), still)]
        )

    def lookup(self, hits):
        face = np.where(hits.instance >= 0, hits.face + self.wall, hits.face)
        return super().lookup(replace(hits, face=face))


def seen(state, *, sun=NOON, away=10.0, side=1.0, lamps=True, detail=True):
    """Image of the head from the front (side 1) or from behind (-1)."""
    turn = np.array([[-side, 0, 0], [0, -side, 0], [0, 0, 1.0]]) @ OPTICAL
    pose = Poses(np.array([[side * away, 0.0, LENSES]]), turn[None], np.ones((1, 3)))
    shown = Lamps(np.array([3, FEATURE], np.int32), np.array([0, state], np.uint8)) if lamps else None
    options = RenderOptions(detail=detail)
    return render(CAMERA, pose, world=SignalWorld(), sun=sun, lamps=shown, options=options).rgb.astype(int)


def lens(image, k, *, away=10.0):
    """Mean colour of a lens, from the top."""
    row = round(79.5 + 400.0 / (away - 0.38) * APART * (k - 1))
    return image[row - 1 : row + 2, 98:102].reshape(-1, 3).mean(axis=0)


@pytest.mark.parametrize("sun", [NOON, EVENING, NIGHT])
@pytest.mark.parametrize("state", [0, 1, 2])
def test_the_lit_lens_has_its_colour_at_any_hour_and_the_others_stay_dark(state, sun):
    image, dark = seen(state, sun=sun), seen(state, sun=sun, lamps=False)
    red, green, blue = lens(image, state)
    if state == 0:
        assert red > 180
        assert red > 2 * max(green, blue)
    elif state == 1:
        assert red > 150
        assert 0.4 * red < green < 0.85 * red
        assert blue < 0.6 * red
    else:
        assert green > 120
        assert green > 1.5 * red
        assert green > blue
    for other in {0, 1, 2} - {state}:
        np.testing.assert_array_equal(lens(image, other), lens(dark, other))


def test_only_the_front_shines_and_only_heads_whose_state_is_known():
    np.testing.assert_array_equal(seen(0, side=-1.0), seen(0, side=-1.0, lamps=False))
    lit, dark = seen(2), seen(2, lamps=False)
    changed = (lit != dark).any(axis=2)
    v, u = np.nonzero(changed)
    scale = 400.0 / (10.0 - 0.38)
    assert np.hypot(u - 99.5, v - 79.5 - APART * scale).max() < RADIUS * scale + 2
    assert lens(seen(2, detail=False), 2)[1] > 120


def test_light_of_a_lens_is_kept_when_pixels_grow():
    rng = np.random.default_rng(1)
    place = np.column_stack(
        [np.full(200_000, 0.38), rng.uniform(-0.13, 0.13, 200_000), rng.uniform(2.45, 3.3, 200_000)]
    )
    state = np.zeros(len(place), np.uint8)
    exposure = daylight(NOON).exposure
    near, far = (
        emit(state, place=place, width=np.full(len(place), width), exposure=exposure).mean(axis=0)
        for width in (0.001, 1.0)
    )
    np.testing.assert_allclose(near, far, rtol=0.02)

"""Position of the sun and daylight against almanacs and physics."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise

import numpy as np
import pytest
from helpers.sensor_worlds import MeshWorld, plate
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import concatenate
from geoscene.objects.shapes import shapes
from lidar.errors import InputError
from lidar.geometry.attitude import OPTICAL, Mount
from lidar.geometry.poses import Poses
from lidar.raycast import Caster, MeshInstances
from lidar.sensors.camera import shade
from lidar.sensors.camera.facades import facades_of
from lidar.sensors.camera.light import (
    APART,
    LENSES,
    RADIUS,
    Lamps,
    daylight,
    emit,
    refraction,
    sun_direction,
    sun_position,
)
from lidar.sensors.camera.render import render
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.camera.sky import cloud_pattern
from lidar.sensors.rig.specs import CameraSpec

# Computed with Astropy 7 (ERFA): azimuth and elevation without an atmosphere, degrees.
ALMANAC = [
    ("Helsinki", 24.9384, 60.1699, "2024-06-21T10:00:00+00:00", 171.5275, 53.0623),
    ("New York", -73.9857, 40.7484, "2024-03-20T20:30:00+00:00", 242.9588, 28.2044),
    ("Sydney", 151.2093, -33.8688, "2025-01-05T23:00:00+00:00", 86.0738, 48.9016),
    ("Quito", -78.4678, -0.1807, "2023-12-22T17:00:00+00:00", 172.8345, 66.5484),
    ("Tromso", 18.9553, 69.6492, "2024-06-21T22:45:00+00:00", 359.7250, 3.0812),
    ("Monaco", 7.4246, 43.7384, "2026-09-01T07:15:00+00:00", 102.5716, 24.4718),
    ("London", -0.1276, 51.5072, "1999-08-11T10:11:00+00:00", 137.0584, 47.1864),
    ("Tokyo", 139.6917, 35.6895, "2030-11-03T03:00:00+00:00", 190.8990, 38.5865),
]


@pytest.mark.parametrize(("place", "lon", "lat", "when", "azimuth", "elevation"), ALMANAC)
def test_sun_positions_agree_with_astropy(place, lon, lat, when, azimuth, elevation):
    a, e = sun_position(datetime.fromisoformat(when), lon, lat_deg=lat)
    true = e - refraction(np.radians(elevation))
    assert abs(np.degrees(a) - azimuth) < 0.02, place
    assert abs(np.degrees(true) - elevation) < 0.02, place


def test_sun_position_agrees_with_the_published_example():
    # Reda and Andreas, NREL/TP-560-34302 (2008), appendix A.5: zenith 50.11162, azimuth 194.34024.
    when = datetime.fromisoformat("2003-10-17T12:30:30-07:00")
    azimuth, elevation = np.degrees(sun_position(when, -105.1786, lat_deg=39.742476))
    assert abs(azimuth - 194.34024) < 0.01
    assert abs(90 - elevation - 50.11162) < 0.01


def test_refraction_lifts_the_setting_sun_by_its_own_width():
    # 34' at the horizon is the almanacs' round figure; the disc is 32' wide.
    assert abs(np.degrees(refraction(0.0)) * 60 - 29) < 2  # true elevation 0, seen 29' up
    assert abs(np.degrees(refraction(np.radians(-0.575))) * 60 - 34.5) < 1
    assert np.degrees(refraction(np.radians(45.0))) * 3600 == pytest.approx(58, abs=1)
    assert refraction(np.radians(90.0)) == 0


def test_a_time_without_a_zone_is_refused():
    with pytest.raises(InputError, match="zone"):
        sun_position(datetime(2024, 1, 1, 12), 0.0, lat_deg=0.0)  # noqa: DTZ001


def test_sun_directions_are_rotated_to_grid_north():
    # Far from its central meridian a UTM grid is rotated by over a degree.
    when = datetime(2024, 6, 21, 10, tzinfo=UTC)
    local = sun_direction(Frame.at(24.9384, 60.1699), when)
    utm = sun_direction(Frame.at(24.9384, 60.1699, crs="utm"), when)
    turn = np.arctan2(utm[0], utm[1]) - np.arctan2(local[0], local[1])
    lon_from_meridian = np.radians(24.9384 - 27)
    assert turn == pytest.approx(-lon_from_meridian * np.sin(np.radians(60.1699)), rel=0.01)
    assert local[2] == pytest.approx(utm[2], abs=1e-6)


@pytest.mark.full
@settings(max_examples=50, deadline=None)
@given(lon=st.floats(-180, 180), lat=st.floats(-89, 89), hours=st.integers(0, 24 * 365 * 30))
def test_direction_and_position_agree(lon, lat, hours):
    when = datetime(2000, 1, 1, tzinfo=UTC) + timedelta(hours=hours)
    azimuth, elevation = sun_position(when, lon, lat_deg=lat)
    s = sun_direction(Frame.at(lon, lat), when)
    assert np.linalg.norm(s) == pytest.approx(1.0)
    assert np.arcsin(s[2]) == pytest.approx(elevation, abs=1e-4)
    if abs(s[2]) < 0.99:
        off = (np.arctan2(s[0], s[1]) - azimuth + np.pi) % (2 * np.pi) - np.pi
        assert abs(off) < 1e-3


def _sun(elevation_deg):
    e = np.radians(elevation_deg)
    return daylight([np.cos(e), 0.0, np.sin(e)])


def test_light_reddens_and_fades_towards_evening():
    beams = [_sun(e).beam for e in (60, 30, 10, 3)]
    assert all((a > b).all() for a, b in pairwise(beams))
    redness = [b[0] / b[2] for b in beams]
    assert redness == sorted(redness)
    assert _sun(-2).beam.max() == 0.0


def test_the_clear_sky_is_blue_overhead_and_paler_below():
    light = _sun(45)
    zenith, horizon = light.sky[-1].mean(axis=0), light.horizon
    assert zenith[2] > 1.3 * zenith[0]
    assert zenith[2] / zenith[0] > horizon[2] / horizon[0]
    assert horizon.mean() > zenith.mean()


def test_ambient_light_falls_mostly_from_above():
    light = _sun(45)

    def on(normal):
        x, y, z = normal
        basis = [
            0.282095, 0.488603 * y, 0.488603 * z, 0.488603 * x, 1.092548 * x * y, 1.092548 * y * z,
            0.315392 * (3 * z * z - 1), 1.092548 * x * z, 0.546274 * (x * x - y * y),
        ]  # fmt: skip
        return float((np.array(basis) @ light.ambient).mean())

    assert on((0, 0, 1)) > on((0, 1, 0)) > 0
    assert on((1, 0, 0)) > on((-1, 0, 0))  # the sky is brighter around the sun


@pytest.mark.parametrize("elevation", [90, 45, 5, 0, -0.2, -6, -40, -90])
def test_light_and_exposure_are_positive_at_any_hour(elevation):
    light = _sun(elevation)
    for values in (light.beam, light.ambient, light.sky, light.horizon):
        assert np.isfinite(values).all()
    assert (light.sky > 0).all()
    assert 0 < light.exposure < np.inf


@pytest.mark.parametrize(("cloud", "share"), [(0.0, 1.0), (0.5, 0.929), (1.0, 0.25)])
def test_clouds_take_the_share_of_the_light_that_kasten_and_czeplak_measured(cloud, share):
    e = np.radians(40.0)
    towards = [np.cos(e), 0.0, np.sin(e)]
    clear, light = daylight(towards), daylight(towards, cloud=cloud)
    assert clear.exposure / light.exposure == pytest.approx(share, abs=1e-3)
    assert (light.sky > 0).all()


def test_an_overcast_sky_is_three_times_as_bright_overhead_as_at_the_horizon():
    e = np.radians(40.0)
    light = daylight([np.cos(e), 0.0, np.sin(e)], cloud=1.0)
    assert light.beam.max() == 0
    np.testing.assert_allclose(light.sky[-1].mean(axis=0) / light.sky[0].mean(axis=0), 3.0)
    # Fog in this light is bright: 0.7 to 0.9 of full scale.
    assert 0.7 < light.mean[1] * light.exposure < 0.9


@pytest.mark.parametrize("cloud", [0.1, 0.3, 0.8])
def test_clouds_cover_their_share_of_the_sky_and_keep_its_mean_light(cloud):
    """The sky that surfaces are lit by is the mean of the clouds and the clear sky of images."""
    light = daylight([0.5, 0.2, 0.8], cloud=cloud)
    x, y = np.random.default_rng(5).uniform(-3e5, 3e5, (2, 6000))
    up, origin = np.tile([0.0, 0.0, 1.0], (6000, 1)), np.column_stack([x, y, np.full(6000, 2.0)])
    sky = sky_of(light, up, origin=origin)
    clear = sky_of(replace(light, clouds=np.zeros(5)), up[:1], origin=origin[:1])
    cloudy = sky[:, 0] > (clear[0, 0] + light.veil[0]) / 2
    assert cloudy.mean() == pytest.approx(cloud, abs=0.04)
    np.testing.assert_allclose(sky.mean(axis=0), light.sky[-1].mean(axis=0), rtol=0.06)


def test_clouds_hide_the_sun_and_drift_with_the_pattern():
    light = daylight([0.0, 0.0, 1.0], cloud=0.5)
    towards, origin = np.tile([0.0, 0.0, 1.0], (300, 1)), np.zeros((300, 3))
    origin[:, 0] = np.linspace(0, 20_000, 300)
    sky = sky_of(light, towards, origin=origin)
    sunny = sky[:, 1] > 10
    assert 0.2 < sunny.mean() < 0.8
    blown = replace(light, clouds=cloud_pattern(0.5, (700.0, -40.0)))
    np.testing.assert_array_equal(sky_of(blown, towards, origin=origin + np.array([700.0, -40.0, 0.0])), sky)


def sky_of(light, direction, *, origin):
    """Radiance (n, 3) of the sky towards directions (n, 3) from places (n, 3)."""
    n = len(direction)
    out, none = np.empty((n, 3), np.float32), np.zeros(n, np.uint8)
    view = origin, np.arange(n, dtype=np.int32), direction, np.full(n, np.inf), np.zeros((n, 3))
    found = none, none, np.zeros((n, 3), np.uint8), none.astype(np.int32), np.full(n, -1, np.int32)
    tables = *shade.material_tables(), shade.linear_table()
    wet = np.zeros(0, np.float32), np.zeros((0, 3), np.float32)
    settings, dry = (0.0, 0.001, 0.0, True), shade.covers(0.0, 0.0)
    walls = facades_of(MeshWorld(plate(10.0)))
    shade.shade(*view, *found, walls, none > 0, light.columns, tables, settings, dry, out, *wet)
    return out


CAMERA = CameraSpec("c", Mount(), 200, 160, 400.0, 400.0, 99.5, 79.5)
NOON, EVENING, NIGHT = (0.3, -0.5, 0.8), (0.98, -0.1, 0.05), (0.6, 0.0, -0.8)
FEATURE = 7


class SignalWorld(MeshWorld):
    """A world with a signal head at the origin that faces a camera on the x axis, before a wall."""

    def __init__(self):
        head = shapes()["traffic_signals"]
        super().__init__(
            concatenate(
                [plate(-30.0, tilt=0.0), replace(head, feature=np.full(len(head), FEATURE, np.int32))]
            )
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
    settings = CameraSettings(detail=detail)
    return render(CAMERA, pose, world=SignalWorld(), sun=sun, lamps=shown, settings=settings).rgb.astype(int)


def lens(image, k, *, away=10.0):
    """Mean colour of a lens, from the top."""
    row = round(79.5 + 400.0 / (away - 0.38) * APART * (k - 1))
    return image[row - 1 : row + 2, 98:102].reshape(-1, 3).mean(axis=0)


@pytest.mark.full
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

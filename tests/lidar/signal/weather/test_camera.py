"""Weather in camera images: Koschmieder's law, streaks, drops on the window, glare."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from geoscene.classes import Class
from geoscene.geometry.frames import Frame as GeoFrame
from lidar.errors import InputError
from lidar.geometry.attitude import Mount
from lidar.geometry.poses import Poses
from lidar.sensors.camera import shade
from lidar.sensors.camera.light import daylight
from lidar.sensors.camera.render import CameraImage
from lidar.sensors.rig.specs import CameraSpec
from lidar.signal.situation import Situation
from lidar.signal.weather.camera import add_weather, falling, linear_of
from lidar.signal.weather.glass import drops_on, through_drops
from lidar.signal.weather.media import medium_of
from lidar.signal.weather.setting import WeatherSetting
from lidar.signal.weather.streaks import FallingParticles, drawn_depth, drawn_distances, streak_cover

CAMERA = CameraSpec("front", Mount(), 320, 180, 300.0, 300.0, 159.5, 89.5, exposure_ns=5_000_000)
GEO = GeoFrame.at(7.1, 50.7)
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Scene from camera: it looks along the scene's x axis."""
SUN = np.array([0.3, 0.5, 0.8]) / np.linalg.norm([0.3, 0.5, 0.8])


def situation(speed=0.0, cloud=1.0, sun=SUN, camera=CAMERA, **known):
    def poses(time_ns):
        n = len(time_ns)
        place = np.zeros((n, 3))
        place[:, 0] = speed * time_ns / 1e9
        return Poses(place, np.broadcast_to(AHEAD, (n, 3, 3)), np.ones((n, 3)))

    light = daylight(sun, cloud=cloud)
    return Situation(camera.name, 0, 10**9, poses=poses, camera=camera, light=light, **known)


def picture(depth, value=0, camera=CAMERA):
    """A wall that faces the camera at a depth, or the sky if it is inf."""
    shape = camera.height, camera.width
    klass = Class.SKY if np.isinf(depth) else Class.BUILDING
    return CameraImage(
        np.full((*shape, 3), value, np.uint8),
        np.full(shape, depth, np.float32),
        np.full(shape, klass, np.uint8),
        np.full(shape, -1, np.int32),
    )


def seen(image, setting, at=None, seed=1):
    return add_weather(image, setting, at=at or situation(), rng=np.random.default_rng(seed))


def test_light_and_bytes_of_an_image_convert_into_each_other():
    light = np.repeat(linear_of()[:, None], 3, axis=1)
    back = np.empty((256, 3), np.uint8)
    shade.develop(np.ascontiguousarray(light), 1.0, shade.transfer_table(), back)
    assert (back == np.arange(256)[:, None]).all()


def test_clear_air_leaves_an_image_as_it_is():
    image = picture(20.0)
    image.rgb[:] = np.random.default_rng(0).integers(0, 256, image.rgb.shape)
    for setting in (WeatherSetting("clear", 0.0), WeatherSetting("fog", 50.0, start=5.0)):
        np.testing.assert_array_equal(seen(image, setting).rgb, image.rgb)


def test_fog_leaves_two_percent_of_the_contrast_at_its_visibility():
    at, middle = situation(), (90, 160)
    sky = linear_of()[seen(picture(np.inf), WeatherSetting("fog", 60.0), at).rgb[middle]]
    black = linear_of()[seen(picture(60.0), WeatherSetting("fog", 60.0), at).rgb[middle]]
    np.testing.assert_allclose(1 - black / sky, 0.02, atol=0.011)  # a byte is 0.01 of this light
    near = linear_of()[seen(picture(6.0), WeatherSetting("fog", 60.0), at).rgb[middle]]
    np.testing.assert_allclose(1 - near / sky, 0.02**0.1, atol=0.008)


def test_depth_is_along_the_axis_but_light_travels_along_the_ray():
    found = linear_of()[seen(picture(20.0), WeatherSetting("fog", 60.0)).rgb]
    sky = linear_of()[seen(picture(np.inf), WeatherSetting("fog", 60.0)).rgb]
    longer = np.hypot(1.0, 159.5 / 300)
    clear = 1 - found[90, [0, 160], 1] / sky[90, [0, 160], 1]
    assert np.log(clear[0]) / np.log(clear[1]) == pytest.approx(longer, rel=0.03)


@pytest.mark.full
def test_light_passes_as_much_of_a_bank_of_fog_as_lies_in_its_way():
    """A bank of 20 m around the camera before a wall at 60 m is as 20 m of fog; none lies 2 km away."""
    image, middle = picture(60.0), (90, 160)
    lon, lat = map(float, GEO.to_geographic(0.0, 0.0))
    bank = WeatherSetting("fog", 40.0, longitude=lon, latitude=lat, radius=20.0)
    at = situation(geo=GEO)
    found = linear_of()[seen(image, bank, at).rgb[middle]]
    even = linear_of()[seen(picture(20.0), WeatherSetting("fog", 40.0), at).rgb[middle]]
    np.testing.assert_allclose(found, even, atol=0.05)
    lon, lat = map(float, GEO.to_geographic(2000.0, 0.0))
    away = WeatherSetting("rain", 40.0, longitude=lon, latitude=lat, radius=20.0)
    np.testing.assert_array_equal(seen(image, away, at).rgb, image.rgb)


def test_spray_behind_a_car_veils_what_is_low_and_ahead():
    def behind(kmh):
        transform = np.tile(np.eye(3, 4), (1, 2, 1, 1))
        transform[0, :, :, 3] = (25.0, 0, -1.0), (25.0 + kmh / 3.6 * 0.1, 0, -1.0)
        caster = SimpleNamespace(instances=(SimpleNamespace(transform=transform),))
        around = SimpleNamespace(caster=caster, span_ns=(10**9, 10**9 + 10**8))
        setting = WeatherSetting(kind="spray", amount=1.0, medium="plumes")
        return seen(picture(40.0), setting, situation(world=around, seed=3, geo=GEO)).rgb.astype(int)

    image = behind(100)
    ahead, beside, above = image[88:96, 150:170], image[88:96, :20], image[:30, 150:170]
    assert ahead.mean() > 30
    assert ahead.mean() > 2 * max(beside.mean(), above.mean(), 1)
    assert behind(30).max() == 0


def test_plumes_of_dust_veil_parts_of_an_image():
    at = situation(geo=GEO, seed=4)
    light = linear_of()[seen(picture(250.0), WeatherSetting("dust", 30.0), at).rgb[60]]
    even = linear_of()[seen(picture(250.0), WeatherSetting("dust", 30.0, medium="even"), at).rgb[60]]
    assert light.std() > 5 * even.std()
    assert light.mean() < even.mean()


def test_labels_and_depth_stay():
    image = picture(30.0)
    found = seen(image, WeatherSetting("snow", 3.0, drops=0.1, dirt=0.1))
    assert found.depth is image.depth
    assert found.klass is image.klass
    assert (found.rgb != image.rgb).any()


def test_the_same_random_numbers_give_the_same_bytes():
    image, rain = picture(30.0, 90), WeatherSetting("rain", 20.0, drops=0.05)
    np.testing.assert_array_equal(seen(image, rain).rgb, seen(image, rain).rgb)
    assert (seen(image, rain).rgb != seen(image, rain, seed=2).rgb).any()


def test_images_without_a_drive_are_refused_in_one_line():
    with pytest.raises(InputError, match="needs the camera and its poses"):
        seen(picture(30.0), WeatherSetting("rain", 5.0), Situation("front", 0))


def cover_of(particles, exposure, *, air=(0.0, 0.0, 0.0), distance=np.inf, seed=1, camera=CAMERA, far=None):
    far = drawn_distances(camera, particles, exposure=exposure) if far is None else far
    return streak_cover(
        camera,
        particles,
        far=far,
        exposure=exposure,
        down=np.array([0.0, 1.0, 0.0]),
        air=np.array(air),
        distance=np.full((camera.height, camera.width), distance, np.float32),
        rng=np.random.default_rng(seed),
    )


BIG = FallingParticles(np.array([4e-3]), np.array([300.0]), np.array([8.0]))


def test_drops_cover_their_cross_section_whatever_the_exposure():
    """Mean cover is the sum of projected areas: density * pi / 4 * d^2 over the depth that is drawn."""
    wall = 2.5
    expected = 300.0 * np.pi / 4 * 4e-3**2 * (wall - 0.1)
    means = []
    for exposure in (0.0, 2e-3, 4e-3):
        covers = [cover_of(BIG, exposure, distance=wall, seed=seed).mean() for seed in range(5)]
        means.append(np.mean(covers))
    np.testing.assert_allclose(means, expected, rtol=0.15)


def test_rain_fades_with_the_root_of_the_exposure():
    """As Garg and Nayar (IJCV 2007) measured, from 8 to 125 ms."""
    rain = FallingParticles(np.array([3e-3]), np.array([2000.0]), np.array([8.0]))
    spread = [cover_of(rain, t, distance=3.0).std() for t in (4e-3, 16e-3)]
    assert spread[0] / spread[1] == pytest.approx(2.0, rel=0.25)


def test_streaks_are_as_long_as_the_exposure_and_as_the_speed():
    one = FallingParticles(np.array([4e-3]), np.array([3.0]), np.array([8.0]))

    def longest(cover):
        rows = np.flatnonzero((cover > 0).any(axis=1))
        return len(rows)

    still = cover_of(FallingParticles(one.diameter, np.array([0.5]), one.fall), 0.0, distance=3.0)
    moving = cover_of(FallingParticles(one.diameter, np.array([0.5]), one.fall), 10e-3, distance=3.0)
    assert longest(moving) > longest(still)
    # Seen from a fast car the streaks spread from where it drives to.
    driven = cover_of(BIG, 10e-3, air=(0.0, 0.0, -30.0), distance=10.0)
    middle, outer = driven[60:120, 110:210], np.concatenate([driven[:, :50], driven[:, -50:]], axis=1)
    assert np.isfinite(driven).all()
    assert (middle > 0).mean() < (outer > 0).mean()


def test_drops_behind_a_surface_are_not_seen():
    assert cover_of(BIG, 5e-3, distance=0.05).max() == 0
    assert 0 < cover_of(BIG, 5e-3, distance=1.0).mean() < cover_of(BIG, 5e-3, distance=4.0).mean()


def test_more_rain_and_more_snow_are_seen_more():
    for kind in ("rain", "snow"):
        spread = []
        for rate in (1.0, 5.0, 25.0):
            air = medium_of(kind, rate, wavelength_nm=550.0, medium=WeatherSetting(kind, rate).medium)
            particles = falling(WeatherSetting(kind, rate), air)
            spread.append(cover_of(particles, 5e-3, distance=10.0).mean())
        assert 0 < spread[0] < spread[1] < spread[2]


def test_flakes_have_the_cross_section_of_the_medium():
    setting = WeatherSetting("snow", 2.0)
    air = medium_of("snow", 2.0, wavelength_nm=550.0, medium=setting.medium)
    flakes = falling(setting, air)
    area = (flakes.density * np.pi / 4 * flakes.diameter**2).sum()
    assert 2 * area == pytest.approx(air.extinction, rel=0.01)  # but for those under 0.3 mm


HEAVY = WeatherSetting("snow", 10.0)
"""Snow with a visibility of 215 m."""

FLAKES = medium_of("snow", 10.0, wavelength_nm=550.0, medium=HEAVY.medium)


@pytest.mark.parametrize("depth", [4.0, pytest.param(25.0, marks=pytest.mark.full)])
def test_snow_dims_a_wall_by_the_extinction_of_the_medium_flakes_that_are_drawn_included(depth):
    white = linear_of()[seen(picture(np.inf), WeatherSetting("fog", 5.0)).rgb].mean()
    walls = [linear_of()[seen(picture(depth), HEAVY, seed=seed).rgb].mean() for seed in range(4)]
    # The wall faces the camera, so that the way of the light to a corner is longer.
    ray = np.hypot(np.hypot(*(np.indices((180, 320)) - [[[89.5]], [[159.5]]])) / 300, 1.0)
    expected = 1 - np.exp(-FLAKES.extinction * depth * ray).mean()
    assert np.mean(walls) / white == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("depth", [4.0, pytest.param(25.0, marks=pytest.mark.full)])
def test_flakes_that_are_not_drawn_would_change_the_deviation_of_an_image_by_a_few_percent(depth):
    """They are a veil of the same mean, and have at most a tenth of the variance."""
    flakes = falling(HEAVY, FLAKES)
    far = drawn_distances(CAMERA, flakes, exposure=5e-3)
    every = np.full_like(far, 1.3 * depth)

    def mean_depth(far):
        return drawn_depth(flakes, far=far, column=lambda end: np.full((1, 1), min(end, depth), np.float32))

    veil = np.exp(mean_depth(far) - mean_depth(every))
    drawn = [(cover_of(flakes, 5e-3, distance=depth, seed=s) * veil).std() for s in range(9)]
    whole = [cover_of(flakes, 5e-3, distance=depth, seed=s, far=every).std() for s in range(9)]
    assert np.median(drawn) == pytest.approx(np.median(whole), rel=0.1)


def test_heavy_snow_is_drawn_with_a_small_part_of_its_flakes():
    flakes = falling(HEAVY, FLAKES)
    far = drawn_distances(CAMERA, flakes, exposure=5e-3)
    assert (flakes.density * far**3).sum() < 0.1 * (flakes.density * 60.0**3).sum()


def test_a_fisheye_sees_rain_as_dense_as_a_pinhole_does():
    fisheye = replace(CAMERA, model="fisheye", distortion=(0.0,) * 4)
    pinhole = np.mean([cover_of(BIG, 0.0, distance=2.0, seed=s).mean() for s in range(5)])
    found = np.mean([cover_of(BIG, 0.0, distance=2.0, seed=s, camera=fisheye).mean() for s in range(5)])
    assert found == pytest.approx(pinhole, rel=0.2)


def test_drops_on_the_window_cover_their_share_and_stay_for_seconds():
    wide = replace(CAMERA, width=1600, height=900, cx=799.5, cy=449.5)
    centre, radius = drops_on(wide, 0.1, seconds=1.0, seed=3)
    area = np.pi * (radius**2).sum() / (1600 * 900)
    assert 1 - np.exp(-area) == pytest.approx(0.1, abs=0.03)
    (soon, _), (late, _) = (drops_on(wide, 0.1, seconds=seconds, seed=3) for seconds in (1.1, 99.0))
    assert (centre == soon).all(axis=1).mean() > 0.9
    assert (centre == late).all(axis=1).mean() < 0.1
    assert not len(drops_on(wide, 0.0, seconds=1.0, seed=3)[1])


def test_a_drop_shows_the_scene_upside_down():
    big = replace(CAMERA, width=640, height=640, fx=900.0, fy=900.0, cx=319.5, cy=319.5)
    light = np.zeros((640, 640, 3), np.float32)
    light[:320] = 1.0
    drop = np.array([[320.0, 320.0]]), np.array([120.0])
    found = through_drops(light, drop, camera=big)
    assert found[260, 320, 0] < 0.3
    assert found[380, 320, 0] > 0.5
    np.testing.assert_allclose(found[20:60, 20:60], 1.0, atol=1e-3)


@pytest.mark.parametrize(
    ("cloud", "ahead", "glares"), [(0.0, True, True), (1.0, True, False), (0.0, False, False)]
)
def test_the_sun_glares_through_a_dirty_window(cloud, ahead, glares):
    sun = np.array([1.0 if ahead else -1.0, 0.0, 0.2])
    at = situation(cloud=cloud, sun=sun / np.linalg.norm(sun))
    found = seen(picture(np.inf), WeatherSetting("clear", 0.0, dirt=0.1), at).rgb
    assert (found.max() > 0) == glares
    if glares:  # the sun is at row 29, and the veil falls with the square of the angle
        light = linear_of()[found[:, 160, 1]]
        assert light[29:60].min() > light[120:].max()


def test_a_house_in_front_of_the_sun_keeps_the_glare_away():
    sun = np.array([1.0, 0.0, 0.2])
    at = situation(cloud=0.0, sun=sun / np.linalg.norm(sun))
    assert seen(picture(30.0), WeatherSetting("clear", 0.0, dirt=0.1), at).rgb.max() == 0

"""Weather in camera images: air-light, drops and flakes in flight, the wet window, glare."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.geometry.poses import Poses
from lidar.geometry.random_streams import generator
from lidar.sensors.camera import shade
from lidar.sensors.camera.light import Light
from lidar.sensors.camera.render import CameraImage
from lidar.sensors.rig.camera_model import pixel_rays, project
from lidar.sensors.rig.specs import CameraSpec
from lidar.signal.situation import Situation
from lidar.signal.weather.fields import FARTHEST, Field, WeatherBeams, amounts, field_of
from lidar.signal.weather.glass import drops_on, through_drops
from lidar.signal.weather.media import CLEAR, Medium, medium_of
from lidar.signal.weather.setting import WeatherSetting
from lidar.signal.weather.streaks import FallingParticles, drawn_depth, drawn_distances, streak_cover

EXPOSURE_NS = 5_000_000
"""Exposure of streaks for cameras that take an image in an instant (``exposure_ns`` = 0); typical by day."""

_VISIBLE_NM = 550.0

_LEAST = 3e-4
"""Diameter in metres of the smallest drops that are seen one by one."""

_TOP = {"fog": 100.0, "dust": 100.0, "rain": 2000.0, "snow": 2000.0, "spray": 5.0}
"""Height of the weather above the camera in metres, through which the sky is seen; typical."""

_SKYLINE = 20_000.0  # metres through weather towards the horizon, at most
_BETWEEN_NS = 20_000_000  # nanoseconds over which the camera's speed is measured

_STRAY = 0.086
"""Share of the light of a source that scatters by the law of Stiles and Holladay, L = 10 E / theta^2 with the
angle in degrees (CIE), from 1 to 90 degrees."""


def add_weather(
    image: CameraImage, setting: WeatherSetting, *, at: Situation, rng: np.random.Generator
) -> CameraImage:
    """The image in a weather; depth and labels stay ground truth.

    Air between camera and surface dims it and adds the light that it scatters (Koschmieder, at 550 nm); drops
    or flakes that fly past leave streaks; then the light passes the camera's window.

    Raises InputError if camera, light and motion are unknown.
    """
    if at.camera is None or at.light is None or at.poses is None:
        raise InputError(
            "weather in images needs the camera and its poses, which only datasets of drives have"
        )
    assert image.rgb is not None  # noqa: S101
    light, pose = linear_of()[image.rgb], at.poses(np.array([at.start_ns]))
    amount = setting.amount_at(at.start_ns / 1e9)
    air = CLEAR
    if amount and setting.kind in _TOP:
        air = medium_of(setting.kind, amount, wavelength_nm=_VISIBLE_NM, medium=setting.medium)
        light = _through_air(
            light, air, setting=setting, at=at, pose=pose, distance=_distance(image, at.camera), rng=rng
        )
    if setting.drops or setting.dirt:
        light = light + _glare(image, setting, air=air, at=at, pose=pose)
        drops = drops_on(at.camera, setting.drops, seconds=at.start_ns / 1e9, seed=at.seed)
        light = through_drops(light, drops, camera=at.camera)
        light = light * (1 - _dirt(setting, at.camera, seed=at.seed))
    has_ray = np.isfinite(pixel_rays(at.camera)[:, 2]).reshape(*image.rgb.shape[:2], 1)
    return replace(image, rgb=np.where(has_ray, _develop(light), image.rgb))


def _through_air(
    light: NDArray[np.float32],
    air: Medium,
    *,
    setting: WeatherSetting,
    at: Situation,
    pose: Poses,
    distance: NDArray[np.float32],
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """Light (h, w, 3) that is left of that of the surfaces, and what the medium adds."""
    assert at.camera is not None  # noqa: S101
    camera = at.camera
    added = _expose(at, lambda sources: sources.mean)
    path = np.where(np.isfinite(distance), distance, _to_sky(camera, pose, top=_TOP[setting.kind]))
    field = field_of(setting, FARTHEST, at=at)
    column = partial(_column, path, field=field, camera=camera, pose=pose)
    depth = air.extinction * column(math.inf)
    particles, exposure = falling(setting, air), (camera.exposure_ns or EXPOSURE_NS) / 1e9
    if particles is None:
        return _veiled(light, added=added, clear=np.exp(-depth))
    far = drawn_distances(camera, particles, exposure=exposure)
    depth -= drawn_depth(particles, far=far, column=column)
    light = _veiled(light, added=added, clear=np.exp(-depth))
    cover = streak_cover(
        camera,
        particles,
        far=far,
        share=None if field is None else partial(_share_at, field, pose=pose),
        exposure=exposure,
        down=-pose.rotation[0, 2],
        air=(np.array([*setting.drift(1.0), 0.0]) - _velocity(at)) @ pose.rotation[0],
        distance=distance,
        rng=rng,
    )
    return _veiled(light, added=added, clear=1 - cover)


def _veiled(
    light: NDArray[np.float32], *, added: NDArray[np.float32], clear: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Light (h, w, 3) of which the share ``clear`` (h, w) is left; the rest is the colour ``added`` (3,)."""
    clear = clear.astype(np.float32)[..., None]
    veiled: NDArray[np.float32] = light * clear + added * (1 - clear)
    return veiled


def _expose(at: Situation, of: Callable[[Light], Float]) -> NDArray[np.float32]:
    """A colour (3,) of the light, in full scales of the camera."""
    assert at.light is not None  # noqa: S101
    assert at.camera is not None  # noqa: S101
    colour: NDArray[np.float32] = (of(at.light) * at.light.exposure * 2.0**at.camera.exposure_ev).astype(
        np.float32
    )
    return colour


def falling(setting: WeatherSetting, air: Medium) -> FallingParticles | None:
    """Particles of a medium that are drawn one by one; None for kinds without any.

    The fall speed of drops is that of Atlas, Srivastava and Sekhon (1973). Flakes fall at 1 m/s and swing by
    0.3 m/s (typical).
    """
    size, number = air.diameter, air.number
    seen = size > _LEAST
    if setting.kind == "rain":
        fall = np.maximum(9.65 - 10.3 * np.exp(-600.0 * size), 0.1)
        return FallingParticles(size[seen], number[seen], fall[seen])
    if setting.kind == "snow":
        return FallingParticles(size[seen], number[seen], np.full(int(seen.sum()), 1.0), swing=0.3)
    return None


def _distance(image: CameraImage, camera: CameraSpec) -> NDArray[np.float32]:
    """Distance (h, w) in metres along each pixel's ray to the visible surface; inf for sky."""
    depth = image.depth / _depth_per_metre(camera)
    beyond = ~np.isfinite(depth) & ~np.isin(image.klass, (Class.SKY, Class.UNLABELED))
    distance: NDArray[np.float32] = np.where(beyond, np.float32(camera.far), depth)
    return distance


def _depth_per_metre(camera: CameraSpec) -> NDArray[np.float32]:
    """Depth (h, w) of the points at a distance of 1 m: 1 for a fisheye, whose depth is the distance."""
    if camera.model == "fisheye":
        return np.ones((camera.height, camera.width), np.float32)
    return pixel_rays(camera)[:, 2].astype(np.float32).reshape(camera.height, camera.width)


def _to_sky(camera: CameraSpec, pose: Poses, *, top: float) -> NDArray[np.float32]:
    """Metres (h, w) through weather to the sky, where it reaches ``top`` metres above the camera."""
    up = pixel_rays(camera) @ pose.rotation[0, 2]
    path = np.minimum(top / np.maximum(up, 1e-6), _SKYLINE)
    shape = camera.height, camera.width
    through: NDArray[np.float32] = np.nan_to_num(path).astype(np.float32).reshape(shape)
    return through


def _column(
    path: NDArray[np.float32], within: float, *, field: Field | None, camera: CameraSpec, pose: Poses
) -> NDArray[np.float32]:
    """Metres (h, w) through an even medium of the same optical depth.

    path   : (h, w) metres along each pixel's ray
    within : metres up to which it counts, along the optical axis of a pinhole, along the rays of a fisheye
    """
    path = np.fmin(path, within / _depth_per_metre(camera))
    if field is None:
        return path
    direction = pose.directions(np.nan_to_num(pixel_rays(camera)))
    rays = WeatherBeams(np.broadcast_to(pose.position, direction.shape), direction)
    whole = path.ravel().astype(np.float64)
    far = np.minimum(whole, FARTHEST)
    _, column = amounts(field, rays, pulse=np.arange(len(direction)), distance=far)
    through: NDArray[np.float32] = (column + field.beyond * (whole - far)).astype(np.float32)
    return through.reshape(path.shape)


def _share_at(field: Field, position: Float, *, pose: Poses) -> Float:
    """The share (n,) of a medium at places (n, 3), camera frame."""
    rays = WeatherBeams(np.broadcast_to(pose.position, position.shape), pose.directions(position))
    return amounts(field, rays, pulse=np.arange(len(position)), distance=np.ones(len(position)))[0]


def _velocity(at: Situation) -> Float:
    """Velocity (3,) of the sensor, scene axes, m/s."""
    assert at.poses is not None  # noqa: S101
    place = at.poses(at.start_ns + np.array([-_BETWEEN_NS, 0, _BETWEEN_NS])).position
    before, after = np.diff(place, axis=0) / (_BETWEEN_NS / 1e9)  # a drive's first or last pose stands still
    faster: Float = max(before, after, key=np.linalg.norm)
    return faster


def _glare(
    image: CameraImage, setting: WeatherSetting, *, air: Medium, at: Situation, pose: Poses
) -> NDArray[np.float32]:
    """Light (h, w, 3) of the sun that the window scatters over the image, as far as it is wet or dirty."""
    assert at.light is not None  # noqa: S101
    assert at.camera is not None  # noqa: S101
    sun, camera = at.light.direction @ pose.rotation[0], at.camera
    if not (sun[2] > 0 and at.light.beam.any() and _lit(image, at=at, pose=pose)):
        return np.zeros((1, 1, 3), np.float32)
    top = 0.0 if setting.kind == "spray" else _TOP.get(setting.kind, 0.0)
    path = min(top / max(float(at.light.direction[2]), 1e-6), _SKYLINE)
    angle = np.degrees(np.arccos(np.clip(pixel_rays(camera) @ sun, -1, 1)))
    veil = np.nan_to_num(10 / np.maximum(angle, 1.0) ** 2).reshape(camera.height, camera.width, 1)
    share = min(setting.drops + setting.dirt, 1.0) / _STRAY * float(sun[2]) * math.exp(-air.extinction * path)
    glare: NDArray[np.float32] = (share * veil * _expose(at, lambda light: light.beam)).astype(np.float32)
    return glare


def _lit(image: CameraImage, *, at: Situation, pose: Poses) -> bool:
    """Whether the sun shines on a camera: by its rays, or where they are unknown, by the image.

    A sun beside a recorded image is taken to shine.
    """
    assert at.light is not None  # noqa: S101
    assert at.camera is not None  # noqa: S101
    if at.world is not None:
        return not bool(at.world.caster.occluded(pose.position, at.light.direction[None])[0])
    pixel, _ = project(at.camera, (at.light.direction @ pose.rotation[0])[None])
    column, row = np.rint(pixel[0])
    h, w = image.depth.shape
    if not (0 <= column < w and 0 <= row < h):
        return True
    return bool(image.klass[int(row), int(column)] == Class.SKY)


def _dirt(setting: WeatherSetting, camera: CameraSpec, *, seed: int) -> NDArray[np.float32]:
    """Share (h, w, 1) of light that dirt on the window absorbs: blotches, out of focus and lasting."""
    blotches = _blotches(camera.width, camera.height, name=camera.name, seed=seed)
    absorbed: NDArray[np.float32] = np.minimum(np.float32(setting.dirt) * blotches, np.float32(0.99))
    return absorbed


@functools.lru_cache(maxsize=4)
def _blotches(width: int, height: int, *, name: str, seed: int) -> NDArray[np.float32]:
    """Smooth random factors (height, width, 1) of 0.5 to 1.5, their mean about 1."""
    from scipy.ndimage import zoom  # noqa: PLC0415  (0.1 s)

    coarse = generator(seed, name, "dirt").random((9, 16))
    smooth = zoom(coarse, (height / 9, width / 16), order=3, mode="nearest", grid_mode=True)
    factor: NDArray[np.float32] = (0.5 + np.clip(smooth, 0, 1)).astype(np.float32)[..., None]
    return factor


def _develop(light: NDArray[np.float32]) -> NDArray[np.uint8]:
    """The bytes (h, w, 3) of exposed linear light."""
    rgb = np.empty(light.shape, np.uint8)
    flat = np.ascontiguousarray(light.reshape(-1, 3), np.float32)
    shade.develop(flat, 1.0, shade.transfer_table(), rgb.reshape(-1, 3))
    return rgb


@functools.cache
def linear_of() -> NDArray[np.float32]:
    """Exposed linear light (256,) of the bytes of an image: the inverse of `shade.transfer_table`."""
    table = shade.transfer_table()
    light = shade.FULL * (np.arange(len(table)) / (len(table) - 1)) ** 2
    first, last = (np.searchsorted(table, np.arange(256), side=side) for side in ("left", "right"))
    middle: NDArray[np.float32] = light[np.minimum((first + last) // 2, len(table) - 1)].astype(np.float32)
    middle[255] = light[first[255]]
    return middle

"""Drops and dirt on the cover glass of a scanner and the window of a camera, and the sun in a detector."""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

import functools
import math
from dataclasses import replace
from math import ceil, log, log1p, pi

import numpy as np
from numpy.typing import NDArray

from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.geometry.random_streams import generator
from lidar.sensors.camera.light import sun_direction
from lidar.sensors.physics.echoes import TracedEchoes
from lidar.sensors.physics.link import daylight_noise, false_alarm_probability
from lidar.sensors.physics.origin import Origin
from lidar.sensors.rig.specs import CameraSpec
from lidar.signal.situation import Situation
from lidar.signal.stage import Pulses, added_echoes
from lidar.signal.weather.streaks import APERTURE

_CELL = 0.1  # degrees, of the raster of drops
_DROP_RADIUS = (0.5, 1.5)  # degrees, typical values
_DROP_POWER = 0.3  # of an echo through a drop, typical value
_DROPS_STAY = 2.0  # seconds, assumed

_VEIL = 105.0
"""Illuminance of a grey scene that is as bright as stray sunlight, over that of the sun, times the angle in
degrees squared: pi / 0.3 times 10 E / theta^2 (Stiles and Holladay)."""

_DISC = 0.5  # degrees, within which the sun is in the detector's view


def through_glass(
    pulses: Pulses, echoes: TracedEchoes, *, drops: float, dirt: float, at: Situation
) -> TracedEchoes:
    """Echoes through a cover glass, of which drops hide a share and dirt takes a share of the light."""
    factor = np.full(len(pulses), (1 - dirt) ** 2)
    if drops > 0:
        x, y, z = pulses.direction.T
        azimuth, elevation = np.degrees(np.arctan2(y, x)), np.degrees(np.arcsin(np.clip(z, -1, 1)))
        lowest, highest = (float(np.round(v, 1)) for v in (elevation.min(), elevation.max()))
        period = int(at.start_ns / 1e9 // _DROPS_STAY)
        wet = _drop_raster(at.seed, at.sensor, period=period, drops=drops, band=(lowest, highest))
        row = np.clip(((elevation - lowest) / _CELL).astype(int), 0, wet.shape[0] - 1)
        column = ((azimuth + 180) / _CELL).astype(int) % wet.shape[1]
        factor *= np.where(wet[row, column], _DROP_POWER, 1.0)
    return replace(echoes, apparent=echoes.apparent * factor[echoes.pulse])


@functools.lru_cache(maxsize=16)
def _drop_raster(
    seed: int, sensor: str, *, period: int, drops: float, band: tuple[float, float]
) -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
    """Raster of drops by elevation and azimuth: round ones at random places."""
    rng = generator(seed, "weather", "drops", sensor, period)
    rows, columns = max(1, ceil((band[1] - band[0]) / _CELL)), round(360 / _CELL)
    wet = np.zeros((rows, columns), bool)
    low, high = _DROP_RADIUS
    margin = high / _CELL
    mean = pi * (high**3 - low**3) / 3 / (high - low) / _CELL**2
    count = round(-log1p(-min(drops, 0.999)) * (rows + 2 * margin) * columns / mean)
    row, column = rng.uniform(-margin, rows + margin, count), rng.uniform(0, columns, count)
    radius = rng.uniform(low, high, count) / _CELL
    for r, c, size in zip(row, column, radius, strict=True):
        down = np.arange(max(0, int(r - size)), min(rows, int(r + size) + 1))
        along = np.arange(int(c - size), int(c + size) + 1)
        inside = (down[:, None] - r) ** 2 + (along - c) ** 2 <= size**2
        wet[down[:, None], along % columns] |= inside
    return wet


def dazzle(
    pulses: Pulses, echoes: TracedEchoes, *, sunlight: float, at: Situation, rng: np.random.Generator
) -> TracedEchoes:
    """Echoes with the noise that sunlight adds to the detector in beams near the sun, and false ones.

    sunlight : illuminance of the sun, lux
    """
    if at.poses is None or at.geo is None or at.utc is None:
        raise InputError("sunlight needs poses and time, which these clouds do not have")
    noise = glare_noise(pulses, sun=_sun_of(pulses, at=at), sunlight=sunlight)
    if noise is None:
        return echoes
    sensor, own = pulses.sensor, pulses.sensor.noise_ratio
    extra = np.sqrt(np.maximum(noise**2 - own**2, 0.0))
    power = pulses.received(echoes)
    shaken = np.maximum(power + extra[echoes.pulse] * rng.standard_normal(len(echoes)), 0.0)
    scale = np.where(extra[echoes.pulse] > 0.01 * own, shaken / np.maximum(power, 1e-300), 1.0)
    levels = np.linspace(log(own), log(max(float(noise.max()), own)) + 1e-9, 64)
    reach = sensor.max_range - sensor.min_range
    chances = [false_alarm_probability(float(np.exp(level)), reach) for level in levels]
    chance = np.interp(np.log(noise), levels, chances) - chances[0]
    pulse = np.flatnonzero(rng.random(len(pulses)) < chance)
    false = 1 + noise[pulse] ** 2 * rng.standard_exponential(len(pulse))
    place = rng.uniform(sensor.min_range, sensor.max_range, len(pulse)) - sensor.pattern.range_offset
    added = added_echoes(pulse, place, apparent=pulses.apparent(false, place), origin=Origin.RECEIVER)
    return TracedEchoes.concatenate((replace(echoes, apparent=echoes.apparent * scale), added))


def _sun_of(pulses: Pulses, *, at: Situation) -> Float:
    """Direction (3,) of the sun in the sensor's frame at the middle of a frame; a zero vector at night."""
    from datetime import timedelta  # noqa: PLC0415

    assert at.poses is not None  # noqa: S101
    assert at.geo is not None  # noqa: S101
    assert at.utc is not None  # noqa: S101
    middle = pulses.time_ns[len(pulses) // 2 : len(pulses) // 2 + 1]
    pose = at.poses(middle)
    when = at.utc + timedelta(seconds=int(middle[0]) / 1e9)
    x, y = pose.position[0, :2].tolist()
    sun = sun_direction(at.geo, when, at=(x, y))
    if sun[2] <= 0:
        return np.zeros(3)
    turned: Float = pose.rotation[0].T @ sun
    return turned


def glare_noise(pulses: Pulses, *, sun: Float, sunlight: float) -> Float | None:
    """Noise over the threshold (n,) of the pulses; None without the sun."""
    if not sun.any():
        return None
    angle = np.degrees(np.arccos(np.clip(pulses.direction @ sun, -1, 1)))
    lux = sunlight * _VEIL / np.maximum(angle, _DISC) ** 2
    steps = np.linspace(0, log1p(float(lux.max())), 256)
    known = [daylight_noise(pulses.sensor.noise_ratio, float(np.expm1(s))) for s in steps]
    noise: Float = np.interp(np.log1p(lux), steps, known)
    return noise


WINDOW = 0.05
"""Metres from a lens to its window, typical of a camera behind a cover."""

_RADIUS, _SPREAD = (
    1.0e-3,
    0.45,
)  # median radius of drops on glass in metres, deviation of its logarithm, typical
_CONTACT = math.radians(40.0)  # contact angle of water on glass, 20 to 60 degrees, typical
_FOCUS = 1 / (0.333 * math.sin(_CONTACT))  # focal length of a plano-convex drop over its radius, n = 1.333
_STAYS = 8.0, 30.0  # seconds until a drop runs off or another takes its place, typical
_COARSE = 4  # pixels along each side of a cell of the layer of drops, which is out of focus


Drops = tuple[Float, Float]
"""Centres (n, 2) and radii (n,) of drops on a window, pixels of the image."""


def drops_on(camera: CameraSpec, cover: float, *, seconds: float, seed: int) -> Drops:
    """The drops on a camera's window at a time; they stay for some seconds, then others form elsewhere.

    cover   : share of the window under drops, 0 to 1
    seconds : since the drive's start
    """
    scale = math.sqrt(camera.fx * camera.fy) / WINDOW
    size = np.array([camera.width, camera.height])
    mean = math.pi * (_RADIUS * scale) ** 2 * math.exp(2 * _SPREAD**2)
    # Drops overlap: a share c of independent discs covers 1 - exp(-c).
    count = round(-math.log1p(-min(cover, 0.95)) * float(np.prod(size)) / mean)
    centre, radius = np.empty((count, 2)), np.empty(count)
    for k in range(count):
        first = generator(seed, camera.name, "window", k)
        stays = first.uniform(*_STAYS)
        drawn = generator(seed, camera.name, "window", k, int(seconds / stays + first.random()))
        centre[k] = drawn.random(2) * size
        radius[k] = _RADIUS * scale * math.exp(_SPREAD * drawn.standard_normal())
    return centre, radius


def through_drops(light: NDArray[np.float32], drops: Drops, *, camera: CameraSpec) -> NDArray[np.float32]:
    """Linear light (h, w, 3) of an image that is taken through drops.

    A drop is a lens of short focus: it shows the scene upside down and small. Both the drop and its edge are
    blurred by the lens, whose focus is far behind the window.
    """
    from scipy.ndimage import gaussian_filter  # noqa: PLC0415  (0.1 s)

    centre, radius = drops
    if not len(radius):
        return light
    h, w = light.shape[0] // _COARSE, light.shape[1] // _COARSE
    small = np.ascontiguousarray(
        light[: h * _COARSE, : w * _COARSE].reshape(h, _COARSE, w, _COARSE, 3).mean(axis=(1, 3))
    )
    seen, cover = np.zeros_like(small), np.zeros((h, w), np.float32)
    scale = math.sqrt(camera.fx * camera.fy) / WINDOW
    turn = 1 - scale * WINDOW / (_FOCUS * radius)
    _refract(small, centre / _COARSE, radius / _COARSE, turn, seen, cover)
    # A uniform disc of diameter A f / M has the variance of a Gaussian of a quarter of it.
    blur = APERTURE * scale / 4 / _COARSE
    seen = gaussian_filter(seen, (blur, blur, 0), mode="nearest")
    cover = gaussian_filter(cover, blur, mode="nearest")
    seen, cover = _enlarge(seen, light.shape[:2]), _enlarge(cover[..., None], light.shape[:2])
    out: NDArray[np.float32] = light * (1 - cover) + seen
    return out


def _enlarge(coarse: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """A coarse image on a grid of `_COARSE` times as many pixels, bilinear."""
    h, w = shape
    for axis, n in ((0, h), (1, w)):
        low, share = _weights(coarse.shape[axis], n)
        rest = [slice(None) if axis == a else None for a in range(3)]
        part = share[tuple(rest)]
        coarse = np.take(coarse, low, axis=axis) * (1 - part) + np.take(coarse, low + 1, axis=axis) * part
    return coarse


@functools.lru_cache(maxsize=8)
def _weights(coarse: int, fine: int) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """The coarse sample before each of the fine ones, and the share of the next one."""
    at = np.clip((np.arange(fine) + 0.5) / _COARSE - 0.5, 0, coarse - 1)
    low = np.minimum(at.astype(np.intp), coarse - 2)
    return low, (at - low).astype(np.float32)


@njit(cache=True, nogil=True)
def _refract(
    light: NDArray[np.float32],
    centre: Float,
    radius: Float,
    turn: Float,
    seen: NDArray[np.float32],
    cover: NDArray[np.float32],
) -> None:
    """Fill ``seen`` with the light through drops, and ``cover`` with their area.

    turn : (n,) pixels of the scene for a pixel of each drop; negative upside down
    """
    h, w = cover.shape
    for i in range(len(radius)):
        cx, cy, r = centre[i, 0], centre[i, 1], radius[i]
        for y in range(max(int(cy - r), 0), min(int(cy + r) + 2, h)):
            for x in range(max(int(cx - r), 0), min(int(cx + r) + 2, w)):
                off = math.sqrt((x - cx) ** 2 + (y - cy) ** 2)
                if off > r:
                    continue
                # Towards its edge the drop is steep: total reflection leaves a dark rim (to 80 %).
                rim = min(max((r - off) / (0.15 * r), 0.2), 1.0)
                u = min(max(int(cx + turn[i] * (x - cx)), 0), w - 1)
                v = min(max(int(cy + turn[i] * (y - cy)), 0), h - 1)
                for c in range(3):
                    seen[y, x, c] = rim * light[v, u, c]
                cover[y, x] = 1.0

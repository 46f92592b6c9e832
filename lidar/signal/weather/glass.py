"""A scanner's cover glass under drops and dirt, and the sun in its detector."""

from __future__ import annotations

import functools
from dataclasses import replace
from math import ceil, log, log1p, pi

import numpy as np

from geoscene.typing import Float
from lidar.errors import InputError
from lidar.geometry.random_streams import generator
from lidar.sensors.camera.sun import sun_direction
from lidar.sensors.physics.echoes import TracedEchoes
from lidar.sensors.physics.link import daylight_noise, false_alarm_probability
from lidar.sensors.physics.origin import Origin
from lidar.signal.situation import Situation
from lidar.signal.stage import Pulses, added_echoes

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

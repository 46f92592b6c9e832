"""Rain, snow and fog by LISA (Kilic et al. 2021), and rain by Goodin et al. 2019, on measured returns."""

from __future__ import annotations

import math
from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.signal.weather.media import ice_index, rain_slope, snow_slope, water_index

LOST, SCATTERED, TARGET = 0, 1, 2

_LEAST_DIAMETER = 0.05  # mm
_TAIL = 28.0  # slopes of diameter beyond which a particle is met once in 10^12


@dataclass(frozen=True, slots=True)
class Lidar:
    """The scanner of a model; the defaults are LISA's.

    wavelength_nm : nanometres
    max_range     : metres at which a target of the reflectance 0.9 is just seen in clear air
    min_range     : metres from which on particles are seen
    divergence    : radians
    accuracy      : metres, of a return at the threshold
    last          : reports the last return rather than the strongest
    """

    wavelength_nm: float = 905.0
    max_range: float = 200.0
    min_range: float = 1.5
    divergence: float = 3e-3
    accuracy: float = 0.09
    last: bool = False


@dataclass(frozen=True, slots=True)
class RemainingReturns:
    """Returns of a cloud that remain after a weather model.

    state       : (n,) uint8, LOST, SCATTERED or TARGET
    range       : (n,) metres
    reflectance : (n,) as measured
    """

    state: NDArray[np.uint8]
    range: Float
    reflectance: Float


def particle_count(rate: float, distance: Float, *, kind: str = "rain", lidar: Lidar) -> Float:
    """Mean number (n,) of particles in beams that end at distances in metres."""
    n0, slope = rain_slope(rate) if kind == "rain" else snow_slope(rate)
    density = n0 / slope * np.exp(-slope * _LEAST_DIAMETER)
    volume = pi / 3 * distance * (distance * np.tan(lidar.divergence) / 2) ** 2
    count: Float = density * volume
    return count


def lisa(
    distance: Float,
    reflectance: Float,
    *,
    kind: str,
    rate: float,
    extinction: float,
    rng: np.random.Generator,
    lidar: Lidar,
) -> RemainingReturns:
    """The returns in rain or snow (rate in mm/h) or fog, which only dims.

    A particle matters only if it returns more than the threshold, which it cannot beyond a distance; so of
    the particles of a beam only those nearer than that are drawn.
    """
    threshold = 0.9 / lidar.max_range**2
    power = reflectance * np.exp(-2 * extinction * distance) / distance**2
    seen = power >= threshold
    sigma = lidar.accuracy / np.sqrt(2 * np.maximum(power / threshold, 1.0))
    noisy = distance + sigma * rng.standard_normal(len(distance))
    measured = reflectance * np.exp(-2 * extinction * distance)
    best, place, bright = np.zeros((3, len(distance)))
    if kind in ("rain", "snow"):
        best, place, bright = _chosen_particles(
            distance, kind=kind, rate=rate, extinction=extinction, rng=rng, lidar=lidar
        )
    hit = (best > threshold) & (~seen if lidar.last else (best > power))
    state = np.where(hit, SCATTERED, np.where(seen, TARGET, LOST)).astype(np.uint8)
    return RemainingReturns(state, np.where(hit, place, noisy), np.where(hit, bright, measured))


def _chosen_particles(
    distance: Float, *, kind: str, rate: float, extinction: float, rng: np.random.Generator, lidar: Lidar
) -> tuple[Float, Float, Float]:
    """Power, range and reflectance (n,) of the particle that each beam reports; power 0 for none."""
    slope = (rain_slope(rate) if kind == "rain" else snow_slope(rate))[1]
    n = (water_index if kind == "rain" else ice_index)(lidar.wavelength_nm).real
    fresnel = ((n - 1) / (n + 1)) ** 2
    threshold = 0.9 / lidar.max_range**2
    largest = (_LEAST_DIAMETER + _TAIL / slope) / 1000
    wide = np.tan(lidar.divergence)
    cut = min((fresnel / threshold) ** 0.5, (fresnel * (largest / wide) ** 2 / threshold) ** 0.25)
    mean = particle_count(rate, distance, kind=kind, lidar=lidar)
    whole = np.floor(mean + rng.random(len(mean))).astype(np.int64)
    near = np.minimum(distance, cut)
    count = rng.binomial(whole, (near / distance) ** 3)
    beam = np.repeat(np.arange(len(distance)), count)
    r = near[beam] * np.cbrt(rng.random(len(beam)))
    diameter = (_LEAST_DIAMETER + rng.standard_exponential(len(beam)) / slope) / 1000
    share = np.minimum((diameter / np.maximum(r * wide, 1e-12)) ** 2, 1.0)
    bright = fresnel * np.exp(-2 * extinction * r) * share
    power = np.where(r > lidar.min_range, bright / np.maximum(r, 1e-6) ** 2, 0.0)
    usable = power > threshold
    beam, r, bright, power = beam[usable], r[usable], bright[usable], power[usable]
    order = np.lexsort((r if lidar.last else power, beam))
    final = order[np.append(beam[order][1:] != beam[order][:-1], True)] if len(order) else order
    chosen = np.zeros((3, len(distance)))
    chosen[:, beam[final]] = power[final], r[final], bright[final]
    return chosen[0], chosen[1], chosen[2]


def goodin(
    distance: Float, reflectance: Float, *, rate: float, rng: np.random.Generator, max_range: float = 100.0
) -> RemainingReturns:
    """The returns in rain by Goodin et al. 2019: extinction 0.01 R^0.6 and noise that grows with range.

    The extinction was fitted to lost returns; that of the air is about 25 times less.
    """
    extinction = goodin_extinction(rate)
    dimmed = reflectance * np.exp(-2 * extinction * distance)
    seen = dimmed / pi / distance**2 > 0.9 / (pi * max_range**2)
    sigma = 0.02 * distance * (1 - np.exp(-rate)) ** 2
    noisy = distance + sigma * rng.standard_normal(len(distance))
    return RemainingReturns(np.where(seen, TARGET, LOST).astype(np.uint8), noisy, dimmed)


def goodin_extinction(rate: float) -> float:
    """Extinction of Goodin's rain, 1/m; rate in mm/h."""
    return 0.01 * math.pow(rate, 0.6)

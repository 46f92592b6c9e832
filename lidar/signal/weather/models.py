"""Published models of weather on measured returns.

LISA (Kilic et al. 2021), Goodin et al. 2019; fog of Hahner et al. (ICCV 2021), snowfall (CVPR 2022).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from math import log, pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.compiled import njit
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
    the particles of a beam only those nearer than that are drawn. Returns of reflectance 0 are lost, as in
    the authors' program.
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
    hit = (best > threshold) & (~seen if lidar.last else (best > power)) & (reflectance > 0)
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


_LIGHT = 0.299792458  # metres per nanosecond
_MOR = log(20)  # optical depth of the meteorological optical range
_DIFFERENTIAL_REFLECTIVITY = 1e-6
_BACKSCATTER = 0.046  # of fog, 1/(m sr), over the meteorological optical range
_FOG_PULSE, _SNOW_PULSE = 20.0, 10.0  # ns, full width at half maximum

_AREA_RADIUS = 80.0  # metres around the sensor that has flakes
_SNOW_DENSITY = 0.1  # of water's
_FLAKE_SIZE = 0.003  # metres
_LARGEST_FLAKE = 0.02  # metres
_FLAKE_POWER = 0.9 * 255
_BIN = 0.1  # metres
_WAVEFORM_END = 120.0  # metres
_SAME = 0.2  # metres within which the return is still the target's


def fog_response(extinction: float) -> tuple[Float, Float, Float]:
    """The maximum over R of the integral of the pulse with the fog before the target, for all targets.

    Ranges (k,) of the target in metres, ascending, beyond the last of which nothing changes; ranges (k,) of
    the fog's return; and the integral (k,), s/m^2.
    """
    step = 0.01
    r = step * np.arange(1, 3001)
    ramp = np.clip((r - 0.9) / 0.1, 0, 1)
    sent_back = np.exp(-2 * extinction * r) / r**2 * ramp
    length = _LIGHT * _FOG_PULSE
    offset = step * np.arange(round(length / step) + 1)
    pulse = np.sin(pi * offset / length) ** 2 * (2 * step / (_LIGHT * 1e9))
    best = int(np.argmax(np.convolve(sent_back, pulse)))
    target = np.arange(0.1, r[0] + step * best + 0.1, 0.1)
    found = np.empty((2, len(target)))
    for row, end in enumerate(target):
        response = np.convolve(sent_back[r <= end], pulse)[:: round(0.1 / step)]
        peak = int(np.argmax(response))
        found[:, row] = r[0] + 0.1 * peak - length / 2, response[peak]
    return target, found[0], found[1]


def hahner_fog(
    distance: Float, intensity: Float, *, extinction: float, rng: np.random.Generator | None
) -> RemainingReturns:
    """The returns in fog: the target's, dimmed, or the fog's where that is brighter.

    intensity : (n,) codes 0 to 255
    rng       : for the spread of the fog's returns, 10 m times Beta(2, 20) beyond them; None for none
    """
    target, fog, integral = fog_response(extinction)
    row = np.clip(np.searchsorted(target, distance), 0, len(target) - 1)
    ratio = _BACKSCATTER * extinction / _MOR / (_DIFFERENTIAL_REFLECTIVITY / pi)
    soft = np.minimum(intensity * distance**2 * ratio * integral[row], 255.0)
    hard = np.round(intensity * np.exp(-2 * extinction * distance))
    replaced = soft > hard
    place = fog[row]
    if rng is not None:
        place = place + 10 * rng.beta(2, 20, len(distance))
    replaced &= place < distance
    state = np.where(replaced, SCATTERED, TARGET).astype(np.uint8)
    return RemainingReturns(state, np.where(replaced, place, distance), np.where(replaced, soft, hard))


def occupancy(rate: float, fall_speed: float) -> float:
    """Share of the air's area that flakes cover; snowfall rate in mm/h, fall speed in m/s."""
    return rate / (3.6e6 * _SNOW_DENSITY * fall_speed)


def rain_equivalent(rate: float, fall_speed: float) -> float:
    """Rain rate R in mm/h of the size distribution, from the rate 487 density size speed R^(2/3)."""
    return float((rate / (487 * _SNOW_DENSITY * _FLAKE_SIZE * fall_speed)) ** 1.5)


def flake_slope(rain_rate: float, *, medium: str = "gunn-marshall") -> float:
    """Slope of the exponential distribution of diameters, 1/m."""
    if medium == "sekhon-srivastava":
        return 2290.0 * math.pow(rain_rate, -0.45)
    return 2550.0 * math.pow(rain_rate, -0.48)


def flake_disks(
    rate: float, *, fall_speed: float, medium: str, rng: np.random.Generator
) -> tuple[Float, Float, Float]:
    """Azimuth, distance and radius (k,) of flakes cut by the plane that a ring scans, sorted by azimuth.

    Overlaps are not looked for: of flakes as sparse as these, one in 10^5 touches another.
    """
    slope = flake_slope(rain_equivalent(rate, fall_speed), medium=medium)
    wanted = occupancy(rate, fall_speed) * pi * _AREA_RADIUS**2
    # The area of a disk is pi (D^2 - h^2) / 4 with h even from 0 to D: pi/6 D^2; that of D^2 is 2/slope^2.
    guess = wanted * slope**2 * 3 / pi
    count = int(guess + 6 * np.sqrt(guess) + 10)
    diameter = np.minimum(rng.standard_exponential(count) / slope, _LARGEST_FLAKE)
    radius = diameter / 2 * np.sqrt(1 - rng.random(count) ** 2)
    count = int(np.searchsorted(np.cumsum(pi * radius**2), wanted)) + 1
    radius = radius[:count]
    azimuth = rng.uniform(-pi, pi, len(radius))
    distance = _AREA_RADIUS * np.sqrt(rng.random(len(radius)))
    clear = distance > radius
    azimuth, distance, radius = azimuth[clear], distance[clear], radius[clear]
    order = np.argsort(azimuth)
    return azimuth[order], distance[order], radius[order]


def hahner_snow(
    distance: Float,
    intensity: Float,
    *,
    azimuth: Float,
    ring: NDArray[np.integer],
    rate: float,
    rng: np.random.Generator,
    fall_speed: float = 1.6,
    medium: str = "gunn-marshall",
    divergence: float = 3e-3,
) -> RemainingReturns:
    """The returns in snowfall: the strongest maximum of the waveform of target and flakes in the beam.

    intensity : (n,) codes 0 to 255
    azimuth   : (n,) radians
    ring      : (n,) of the same plane of flakes
    """
    state = np.full(len(distance), TARGET, np.uint8)
    place, bright = distance.copy(), intensity.copy()
    for one in np.unique(ring):
        rows = np.flatnonzero(ring == one)
        disks = flake_disks(rate, fall_speed=fall_speed, medium=medium, rng=rng)
        beams = azimuth[rows], distance[rows], intensity[rows]
        found = np.empty((3, len(rows)))
        _snow(beams, disks, divergence / 2, found)
        place[rows], bright[rows] = found[0], np.clip(found[1], 0, 255)
        state[rows] = found[2].astype(np.uint8)
    return RemainingReturns(state, place, bright)


@njit(cache=True, nogil=True)
def _snow(beams: Any, disks: Any, half: Any, found: Any) -> None:
    """Fill ``found``: range, intensity and state of each beam."""
    azimuth, distance, intensity = beams
    where, away, radius = disks
    length = _LIGHT * _SNOW_PULSE
    near = np.flatnonzero(np.arcsin(radius / away) > half)
    count = len(where)
    for i in range(len(azimuth)):
        found[0, i], found[1, i], found[2, i] = distance[i], intensity[i], 2.0
        # Disks that the beam may touch: those within twice its half-width, and the few that are wider.
        low = np.searchsorted(where, azimuth[i] - 2 * half)
        high = np.searchsorted(where, azimuth[i] + 2 * half)
        some = np.empty(high - low + len(near), np.int64)
        size = 0
        for k in range(low, high):
            if away[k] < distance[i]:
                some[size] = k
                size += 1
        for n in range(len(near)):
            if away[near[n]] < distance[i] and not low <= near[n] < high:
                some[size] = near[n]
                size += 1
        if size == 0 or count == 0:
            continue
        order = some[:size][np.argsort(away[some[:size]])]
        left, right = np.empty(size + 1), np.empty(size + 1)
        share, pieces, taken = np.zeros(size), 0, 0.0
        for j in range(size):
            k = order[j]
            off = (where[k] - azimuth[i] + np.pi) % (2 * np.pi) - np.pi
            wide = np.arcsin(radius[k] / away[k])
            a, b = max(off - wide, -half), min(off + wide, half)
            if b <= a:
                continue
            free = b - a
            for p in range(pieces):
                free -= max(0.0, min(b, right[p]) - max(a, left[p]))
            share[j] = max(free, 0.0) / (2 * half)
            taken += share[j]
            # Merge the interval with the pieces that it touches, so that they stay disjoint.
            kept = 0
            for p in range(pieces):
                if right[p] < a or left[p] > b:
                    left[kept], right[kept] = left[p], right[p]
                    kept += 1
                else:
                    a, b = min(a, left[p]), max(b, right[p])
            left[kept], right[kept] = a, b
            pieces = kept + 1
        if taken <= 0.0:
            continue
        wave = np.zeros(int((_WAVEFORM_END + length) / _BIN) + 2)
        _add_pulse(wave, distance[i], intensity[i] * distance[i] ** 2 * max(1.0 - taken, 0.0), length)
        for j in range(size):
            if share[j] > 0.0:
                _add_pulse(wave, away[order[j]], _FLAKE_POWER * share[j], length)
        best = np.argmax(wave)
        d = best * _BIN - length / 2
        if wave[best] <= 0.0:  # a flake before the receiver's view covers the whole beam
            found[2, i] = 0.0
        elif abs(d - distance[i]) < _SAME or distance[i] > _WAVEFORM_END:
            found[1, i] = wave[best]
        else:
            found[0, i], found[1, i], found[2, i] = d, wave[best], 1.0


@njit(cache=True, nogil=True)
def _add_pulse(wave: Any, place: Any, power: Any, length: Any) -> None:
    """Add the pulse that something at a range sends back, to the bins of a waveform."""
    seen = min(max((place - 0.9) / 0.1, 0.0), 1.0) * power / (place * place)
    first = int(np.ceil(place / _BIN))
    for n in range(first, min(int((place + length) / _BIN) + 1, len(wave))):
        wave[n] += seen * np.sin(np.pi * (n * _BIN - place) / length) ** 2

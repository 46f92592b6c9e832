"""Fog (Hahner et al., ICCV 2021) and snowfall (Hahner et al., CVPR 2022) on measured returns."""

from __future__ import annotations

import math
from dataclasses import dataclass
from math import log, pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.signal.weather.lisa import SCATTERED, TARGET, RemainingReturns

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


@dataclass(frozen=True, slots=True)
class FogResponse:
    """The soft response of fog, by the range of the target.

    target   : (k,) metres, ascending; beyond the last row nothing changes
    range    : (k,) metres of the fog's return
    integral : (k,) s/m^2, maximum of the integral over the pulse
    """

    target: Float
    range: Float
    integral: Float


def fog_response(extinction: float) -> FogResponse:
    """The maximum over R of the integral of the pulse with the fog before the target, for all targets."""
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
    return FogResponse(target, found[0], found[1])


def hahner_fog(
    distance: Float, intensity: Float, *, extinction: float, rng: np.random.Generator | None
) -> RemainingReturns:
    """The returns in fog: the target's, dimmed, or the fog's where that is brighter.

    intensity : (n,) codes 0 to 255
    rng       : for the spread of the fog's returns, 10 m times Beta(2, 20) beyond them; None for none
    """
    response = fog_response(extinction)
    row = np.clip(np.searchsorted(response.target, distance), 0, len(response.target) - 1)
    ratio = _BACKSCATTER * extinction / _MOR / (_DIFFERENTIAL_REFLECTIVITY / pi)
    soft = np.minimum(intensity * distance**2 * ratio * response.integral[row], 255.0)
    hard = np.round(intensity * np.exp(-2 * extinction * distance))
    replaced = soft > hard
    place = response.range[row]
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

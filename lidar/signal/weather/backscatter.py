"""Echoes of particles in the air: soft targets, and single drops and flakes drawn pulse by pulse."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from math import log, pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.raycast.memory import inline
from lidar.sensors.physics.link import GATE, amplitude
from lidar.sensors.rig.scanner import Sensor
from lidar.signal.weather.media import Medium

_DEVIATIONS = 3.5
"""Standard deviations of the receiver's noise below the threshold, where one in 4300 echoes passes it."""

MOST = 12.0
"""Mean number of particles per pulse above which fewer are drawn."""

LENS = 0.03
"""Metres, diameter of the receiver's lens, typical value."""

LIGHT = 0.299792458
"""Metres per nanosecond."""

Found = tuple[NDArray[np.int64], Float, Float]
"""Pulse, range and power over the threshold of echoes."""

_DRAWN = 0.2
"""Power over the threshold from which on particles are drawn: several within the pulse are one echo."""

_OVERLAP = (
    0.9,
    1.0,
)  # metres between which the beam enters the receiver's field of view (Hahner et al. 2021)
_REACH = 60.0  # metres beyond the minimum range within which the response of even air has its maximum
_STEP = 0.05  # metres between samples of the response
_QUANTILES = 65  # of the range of a soft target's echo
_LEVELS = 4096  # of the table in which classes of particles are looked up
_CLASSES = 64  # of range


def overlap(sensor: Sensor, distance: Float, *, lens: float = LENS) -> Float:
    """Share of the light (n,) from near particles that falls on the detector, at distances in metres.

    A receiver that is focused far away images what is near as a disk as wide as its lens, seen from there;
    the detector is as wide as the beam (form factor of a lidar: Measures 1984, chapter 7).
    """
    near, far = _OVERLAP
    focus = lens / np.sqrt(np.prod(sensor.divergence))
    share: Float = np.clip((distance - near) / (far - near), 0, 1) / (1 + (focus / distance) ** 2)
    return share


def strength(sensor: Sensor, distance: Float, *, lens: float = LENS) -> Float:
    """Power (n,) over the threshold of a white layer, at distances in metres from the beam's start."""
    return overlap(sensor, distance, lens=lens) * amplitude(
        sensor, 1.0, distance=distance + sensor.pattern.range_offset
    )


def pulse_shape(pulse_ns: float, step: float) -> Float:
    """Power of a pulse at steps in metres, sin^2 of the full width at half maximum `pulse_ns`."""
    length = LIGHT * pulse_ns
    count = max(3, round(length / step))
    shape: Float = np.sin(pi * (np.arange(count) + 0.5) / count) ** 2
    return shape


def least_power(noise: float) -> float:
    """Power over the threshold from which on the detector may notice an echo; at least 0.2.

    noise : that the detector adds to echoes, over the threshold
    """
    return max(0.2, 1 - _DEVIATIONS * noise)


@dataclass(frozen=True, slots=True)
class SoftTarget:
    """The echo of even air, by the range at which the beam ends.

    end   : (k,) metres, ascending, in steps of `GATE`
    power : (k,) over the threshold; for a beam that ends beyond the last row, the last one's
    place : (k, q) metres, ranges of the echo at evenly spaced probabilities from 0 to 1
    """

    end: Float
    power: Float
    place: Float

    def row(self, end: Float) -> NDArray[np.int64]:
        """Rows (n,) of beams that end at ranges (n,); -1 for those that end before the first one."""
        step = self.end[1] - self.end[0] if len(self.end) > 1 else GATE
        steps = np.clip((end - self.end[0]) / step + 1e-6, -1, len(self.end) - 1)
        row: NDArray[np.int64] = np.floor(steps).astype(np.int64)
        return row

    def places(self, row: NDArray[np.int64], chance: Float) -> Float:
        """Ranges (n,) of echoes of rows (n,), at random numbers (n,) from 0 to 1."""
        at = chance * (self.place.shape[1] - 1)
        low = np.minimum(at.astype(np.int64), self.place.shape[1] - 2)
        share = at - low
        place: Float = (1 - share) * self.place[row, low] + share * self.place[row, low + 1]
        return place


def soft_target(
    sensor: Sensor,
    extinction: float,
    *,
    backscatter: Float,
    distance: Float,
    lens: float = LENS,
    noise: float = 0.0,
    least: float = 0.0,
) -> SoftTarget:
    """The echo of even air whose particles add up: the pulse convolved with what the air sends back.

    The power at range R is pi times the integral of pulse(R - r) b(r) exp(-2 a r) over r, in units of that of
    a white target: Hahner et al. 2021, equations 8 to 10, with the sensor's pulse.

    This response is flat over metres, as the blur of the receiver makes up for the fall with the square of
    the range, and each gate of range has noise of its own. So the strongest gate is stronger than the
    maximum of the response, and anywhere where that is high; see `_strongest_gate`.

    backscatter : (k,) 1/(m sr) at the distances
    distance    : (k,) metres, evenly spaced
    noise       : of the receiver over the threshold; without any, the echo is the maximum of the response
    least       : power over the threshold below which echoes need not be exact
    """
    step = float(distance[1] - distance[0])
    white = strength(sensor, distance, lens=lens) * np.exp(-2 * extinction * distance)
    sent_back = pi * backscatter * white * step
    shape = pulse_shape(sensor.pulse_ns, step)
    whole = np.convolve(sent_back, shape)
    # An echo's range is that of its maximum, less that of the pulse itself.
    places = distance[0] + step * (np.arange(len(whole)) - (len(shape) - 1) / 2)
    allowed = places >= sensor.min_range - sensor.pattern.range_offset
    best = int(np.argmax(np.where(allowed, whole, -1.0)))
    if _detected_as(np.array([[whole[best]]]), noise, gates=_REACH / GATE)[0] < least:
        return SoftTarget(distance[:1], whole[best : best + 1], np.full((1, 2), places[best]))
    stride = max(1, round(GATE / step))
    gates = np.arange(best % stride, len(whole), stride)
    gates = gates[allowed[gates] & (whole[gates] >= whole[best] / 2)]
    # Nothing that lies half a pulse beyond the last gate adds to it.
    ends = np.arange(0, min(gates[-1] + 1, len(distance)), stride)
    lag = gates[:, None] - np.arange(len(distance))
    pulse = np.where((lag >= 0) & (lag < len(shape)), shape[np.clip(lag, 0, len(shape) - 1)], 0.0)
    response = np.cumsum(pulse * sent_back, axis=1)[:, ends].T
    if noise <= 0:
        middle = places[gates[np.argmax(response, axis=1)]]
        return SoftTarget(distance[ends], response.max(axis=1), np.repeat(middle[:, None], 2, axis=1))
    power, chance = _strongest_gate(response, noise)
    sums = np.cumsum(chance, axis=1) / chance.sum(axis=1, keepdims=True)
    edges = np.append(places[gates] - GATE / 2, places[gates[-1]] + GATE / 2)
    edges = np.maximum(edges, places[allowed][0])
    level = np.linspace(0, 1, _QUANTILES)
    place = np.array([np.interp(level, np.append(0.0, row), edges) for row in sums])
    return SoftTarget(distance[ends], power, place)


def _strongest_gate(response: Float, noise: float) -> tuple[Float, Float]:
    """Power (k,) of the strongest of gates (k, g) with Gaussian noise, and weights (k, g) of its place.

    It is the power that the strongest gate exceeds in half of the pulses, or, below the threshold, that of a
    single echo which passes the threshold as often as any gate does. The strongest gate is each one in
    proportion to the chance that it exceeds the former. Gates of less than half of the strongest response
    do not count.
    """
    from scipy.special import log_ndtr, ndtr  # noqa: PLC0415  (0.2 s)

    most = response.max(axis=1, keepdims=True)
    gates = np.where(response >= most / 2, response, -np.inf)
    low, high = most, most + 5 * noise
    for _ in range(20):
        middle = (low + high) / 2
        is_low = log_ndtr((middle - gates) / noise).sum(axis=1, keepdims=True) < -log(2)
        low, high = np.where(is_low, middle, low), np.where(is_low, high, middle)
    chance: Float = ndtr((gates - low) / noise)
    return np.minimum(low[:, 0], _detected_as(gates, noise)), chance


def _detected_as(response: Float, noise: float, *, gates: float = 1.0) -> Float:
    """Power (k,) of an echo that passes the threshold as often as any gate of a response (k, g) does.

    gates : number of gates for each one that is given
    """
    from scipy.special import log_ndtr, ndtri  # noqa: PLC0415  (0.2 s)

    if noise <= 0:
        most: Float = response.max(axis=1)
        return most
    none = gates * log_ndtr((1 - response) / noise).sum(axis=1)
    power: Float = 1 + noise * ndtri(-np.expm1(none))
    return power


@functools.lru_cache(maxsize=16)
def even_echo(sensor: Sensor, medium: Medium, *, lens: float, noise: float) -> SoftTarget:
    """The echo of even air of a medium, without the particles that are drawn; noise as of `Pulses`."""
    _, rest, distance = scattering(sensor, medium, lens=lens)
    own = noise or sensor.noise_ratio
    return soft_target(
        sensor,
        medium.extinction,
        backscatter=rest,
        distance=distance,
        lens=lens,
        noise=own,
        least=least_power(noise),
    )


@functools.lru_cache(maxsize=16)
def scattering(sensor: Sensor, medium: Medium, *, lens: float) -> tuple[AirParticles | None, Float, Float]:
    """The particles of a medium that are drawn, and the back-scatter (k,) of the rest at distances (k,)."""
    if len(medium.diameter):
        return particles(sensor, medium, lens=lens)
    distance = response_ranges(sensor)
    return None, np.full(len(distance), medium.backscatter), distance


@dataclass(frozen=True, slots=True)
class AirParticles:
    """Single particles that a pulse may hit in clear air, by classes of range and size.

    count     : (c,) mean number per pulse of each class
    near, far : (c,) metres, range of each class
    strongest : (c,) power over the threshold on the beam's axis in the middle of each class
    least     : power from which on particles are drawn
    """

    count: Float
    near: Float
    far: Float
    strongest: Float
    least: float


def particles(
    sensor: Sensor, medium: Medium, *, most: float = MOST, lens: float = LENS
) -> tuple[AirParticles, Float, Float]:
    """Single particles, and the back-scatter (k,) of all others at distances (k,) in metres.

    A particle of the back-scatter cross-section s, off the axis of a Gaussian beam, sends back the power of
    a Lambertian target of reflectance s I / 4, where I is the irradiance there, over the pulse's power. With
    the irradiance I0 exp(-u), the area of the beam is 2 / I0 for each unit of u: so the number of particles
    over a power is that of u below ln(strongest / least), and none are drawn in vain.
    """
    distance = response_ranges(sensor)
    edges = np.geomspace(distance[0], sensor.max_range, _CLASSES + 1)
    middle, depth = np.sqrt(edges[1:] * edges[:-1]), np.diff(edges)
    area = np.pi / 2 * np.prod(_half_widths(sensor, middle), axis=0)
    strongest = _on_axis(sensor, medium, distance=middle, lens=lens)

    def expected(least: float) -> Float:
        u = np.log(np.maximum(strongest / least, 1.0))
        counts: Float = medium.number[:, None] * u * (area * depth)
        return counts

    least = _DRAWN
    while (counts := expected(least)).sum() > most:
        least *= 1.25
    cells = counts.ravel() > 0
    drawn = AirParticles(
        counts.ravel()[cells],
        np.broadcast_to(edges[:-1], counts.shape).ravel()[cells],
        np.broadcast_to(edges[1:], counts.shape).ravel()[cells],
        strongest.ravel()[cells],
        least,
    )
    on_axis = _on_axis(sensor, medium, distance=distance, lens=lens)
    share = np.minimum(1.0, least / np.maximum(on_axis, 1e-300))
    rest = (medium.number[:, None] * medium.section[:, None] * share).sum(axis=0) / (4 * pi)
    return drawn, rest, distance


def response_ranges(sensor: Sensor) -> Float:
    """Distances (k,) in metres from which the strongest response of even air may come."""
    near = max(_OVERLAP[0], sensor.min_range - sensor.pattern.range_offset)
    start, stop = max(_OVERLAP[0], near - LIGHT * sensor.pulse_ns), min(near + _REACH, sensor.max_range)
    return np.linspace(start, stop, max(2, round((stop - start) / _STEP)) + 1)


def _half_widths(sensor: Sensor, distance: Float) -> Float:
    """Half the width and height (2, k) of the beam at distances, to 1/e^2 of the irradiance on its axis."""
    aperture, divergence = np.array(sensor.aperture), np.array(sensor.divergence)
    widths: Float = (aperture[:, None] + divergence[:, None] * distance) / 2
    return widths


def _on_axis(sensor: Sensor, medium: Medium, *, distance: Float, lens: float) -> Float:
    """Power (s, k) over the threshold of particles of each size on the beam's axis at distances."""
    irradiance = 2 / (pi * np.prod(_half_widths(sensor, distance), axis=0))
    # A particle larger than the beam sends back no more than the whole of it.
    reflectance = np.minimum(medium.section[:, None] * irradiance / 4, 1.0)
    power: Float = reflectance * strength(sensor, distance, lens=lens)
    return power


def drawn_particles(
    some: AirParticles, end: Float, *, extinction: float = 0.0, rng: np.random.Generator
) -> Found:
    """Particles that beams hit before their ends (n,), metres, attenuated by even air (1/m); by pulse."""
    sums = np.cumsum(some.count)
    if not len(sums):
        return np.empty(0, np.int64), np.empty(0), np.empty(0)
    first = np.searchsorted(sums / sums[-1], np.arange(_LEVELS) / _LEVELS, side="right")
    weakest = np.log(some.least / some.strongest)
    classes = sums, first, some.near, some.far, some.strongest, weakest
    found: Found = _meet(classes, rng.integers(1 << 63, dtype=np.uint64), end, extinction)
    return found


@inline
def _uniform(key: Any, number: Any) -> Any:
    """The random number (0 to 1) of a key with a counter: SplitMix64, as `geoscene.support.splitmix`."""
    x = key + np.uint64(number) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.float64((x ^ (x >> np.uint64(31))) >> np.uint64(11)) * 2.0**-53


@njit(cache=True, nogil=True)
def _meet(classes: Any, key: Any, end: Any, extinction: Any) -> Any:
    """Columns of the particles that are hit."""
    sums, first, near, far, strongest, weakest = classes
    mean, few = sums[-1], np.exp(-sums[-1])
    count = np.empty(len(end), np.int64)
    used = 0  # random numbers
    for p in range(len(end)):
        # A number of the Poisson distribution: of factors whose product stays above exp(-mean).
        k, product = 0, 1.0
        while True:
            used += 1
            product *= _uniform(key, used)
            if product <= few:
                break
            k += 1
        count[p] = k
    pulse, place, power = np.empty(count.sum(), np.int64), np.empty(count.sum()), np.empty(count.sum())
    found = 0
    for p in range(len(end)):
        for _ in range(count[p]):
            which, along, across = _uniform(key, used + 1), _uniform(key, used + 2), _uniform(key, used + 3)
            used += 3
            c = first[int(which * len(first))]
            while c < len(sums) - 1 and sums[c] < which * mean:
                c += 1
            r = near[c] + along * (far[c] - near[c])
            if r < end[p]:
                left = np.exp(across * weakest[c] - 2 * extinction * r)
                pulse[found], place[found], power[found] = p, r, strongest[c] * left
                found += 1
    return pulse[:found], place[:found], power[:found]


def notice(found: Found, *, least: float, separation: float) -> Found:
    """The particles, by pulse, that return more than a power over the threshold with those near by.

    separation : metres, of particles that may give one echo
    """
    rows = np.empty(len(found[0]), np.int64)
    count = _notice(found, least, 2 * separation, rows)  # twice, as echoes join in chains
    return found[0][rows[:count]], found[1][rows[:count]], found[2][rows[:count]]


@njit(cache=True, nogil=True)
def _notice(found: Any, least: Any, reach: Any, rows: Any) -> Any:
    """Fill the rows that are noticed, and return their number."""
    pulse, place, power = found
    count = stop = 0
    while stop < len(pulse):
        start = stop
        together = 0.0
        while stop < len(pulse) and pulse[stop] == pulse[start]:
            together += power[stop]
            stop += 1
        if together <= least:
            continue
        for i in range(start, stop):
            near = 0.0
            for k in range(start, stop):
                if abs(place[k] - place[i]) <= reach:
                    near += power[k]
            if near > least:
                rows[count] = i
                count += 1
    return count

"""Echoes of what is in the air: soft targets, and single drops and flakes drawn pulse by pulse."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.physics.link import amplitude
from lidar.rig.scanner import Sensor
from lidar.weather.media import Medium

_DEVIATIONS = 3.5
"""Standard deviations of the receiver's noise below the threshold, where one in 4300 echoes passes it."""

MOST = 12.0
"""Mean number of particles per pulse above which fewer are drawn."""

LENS = 0.03
"""Metres, diameter of the receiver's lens, typical value."""

LIGHT = 0.299792458
"""Metres per nanosecond."""

_OVERLAP = (
    0.9,
    1.0,
)  # metres between which the beam enters the receiver's field of view (Hahner et al. 2021)
_REACH = 60.0  # metres beyond the minimum range within which the response of even air has its maximum
_STEP = 0.05  # metres between samples of the response
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
        1.0,
        distance + sensor.pattern.range_offset,
        reference_reflectance=sensor.reference_reflectance,
        reference_range=sensor.reference_range,
        falloff=sensor.falloff,
    )


def pulse_shape(pulse_ns: float, step: float) -> Float:
    """Power of a pulse at steps in metres, sin^2 of the full width at half maximum `pulse_ns`."""
    length = LIGHT * pulse_ns
    count = max(3, round(length / step))
    shape: Float = np.sin(pi * (np.arange(count) + 0.5) / count) ** 2
    return shape


def least_power(sensor: Sensor) -> float:
    """Power over the threshold from which on the detector may notice an echo; at least 0.2."""
    return max(0.2, 1 - _DEVIATIONS * sensor.noise_ratio)


@dataclass(frozen=True, slots=True)
class SoftTarget:
    """The echo of even air, by the range at which the beam ends.

    end      : (k,) metres, ascending
    range    : (k,) metres at which the integrated response has its maximum
    power    : (k,) that maximum over the threshold; for a beam that ends beyond the last row, the last one's
    """

    end: Float
    range: Float
    power: Float

    def at(self, end: Float) -> tuple[Float, Float]:
        """Range and power (n,) for beams that end at ranges (n,)."""
        step = self.end[1] - self.end[0] if len(self.end) > 1 else 1.0
        steps = np.clip((end - self.end[0]) / step + 1e-6, -1, len(self.end) - 1)
        row = np.floor(steps).astype(np.int64)
        return self.range[row], np.where(row >= 0, self.power[row], 0.0)


def soft_target(
    sensor: Sensor, extinction: float, *, backscatter: Float, distance: Float, lens: float = LENS
) -> SoftTarget:
    """The echo of even air whose particles add up: the pulse convolved with what the air sends back.

    The power at range R is pi times the integral of pulse(R - r) b(r) exp(-2 a r) over r, in units of that of
    a white target: Hahner et al. 2021, equations 8 to 10, with the sensor's pulse.

    backscatter : (k,) 1/(m sr) at the distances
    distance    : (k,) metres, evenly spaced
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
    if whole[best] < least_power(sensor):  # too weak wherever the beam ends
        return SoftTarget(distance[:1], places[best : best + 1], whole[best : best + 1])
    ends = np.arange(min(best + 1, len(distance)))
    found, power = np.empty(len(ends)), np.empty(len(ends))
    for end in ends:
        response = np.where(allowed, np.convolve(sent_back * (distance <= distance[end]), shape), 0.0)
        peak = int(np.argmax(response))
        found[end], power[end] = min(places[peak], distance[end]), response[peak]
    return SoftTarget(distance[: len(ends)], found, power)


@dataclass(frozen=True, slots=True)
class Particles:
    """Single particles that a pulse may meet in clear air, by classes of range and size.

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
) -> tuple[Particles, Float, Float]:
    """What a pulse may meet, and the back-scatter (k,) of all the rest at distances (k,) in metres.

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

    least = least_power(sensor) / 2
    while (counts := expected(least)).sum() > most:
        least *= 1.25
    cells = counts.ravel() > 0
    drawn = Particles(
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
    some: Particles, pulses: int, *, rng: np.random.Generator
) -> tuple[NDArray[np.int64], Float, Float]:
    """Pulse, range and power over the threshold (k,) of particles that pulses meet in clear air."""
    row = np.repeat(np.arange(len(some.count)), rng.poisson(some.count * pulses))
    pulse = rng.integers(0, pulses, len(row))
    along, across = rng.random((2, len(row)))
    distance = some.near[row] + along * (some.far[row] - some.near[row])
    strongest = some.strongest[row]
    power = strongest * (some.least / strongest) ** across
    return pulse, distance, power

"""The detector of a scanner: lost, false and foreign echoes, and measured ranges with their errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.typing import Bools, Float
from lidar.geometry.random_streams import generator
from lidar.sensors.physics.echoes import Echoes, EchoesT, artificial_echoes
from lidar.sensors.physics.link import (
    amplitude,
    apparent_of,
    daylight_noise,
    false_alarm_probability,
    noise_of,
)
from lidar.sensors.physics.origin import Origin
from lidar.sensors.physics.reflect import RETRO
from lidar.sensors.physics.settings import ScannerSettings
from lidar.sensors.rig.patterns.beams import Firings
from lidar.sensors.rig.scanner import Sensor

Deviates = Callable[[str, Echoes], Float]
"""Standard normal deviates (m,) of echoes for a purpose such as ``range noise``."""

_BLOOM_ANGLE, _BLOOM_CHANCE = np.radians(0.3), 0.3  # typical values
_BLOOM_POWER = 0.01  # of the retro-reflector's power, assumed
_OVERLAP = 5e-5  # probability that a pulse of another scanner is received, typical value (1e-5 to 1e-4)


def receive(sensor: Sensor, echoes: Echoes) -> Float:
    """Power (m,) of each echo over the detection threshold."""
    return amplitude(sensor, echoes.apparent, distance=echoes.range + sensor.pattern.range_offset)


def detect_echoes(
    sensor: Sensor, echoes: EchoesT, *, settings: ScannerSettings, deviates: Deviates
) -> EchoesT:
    """The echoes that pass the threshold, with the apparent reflectance that the sensor measures.

    With ``detection``, noise is added to the power before it is compared with the threshold, which gives the
    probability of `link.detection_probability`; the measured reflectance includes that noise.
    """
    power = receive(sensor, echoes)
    measured = power
    if settings.detection:
        sigma = noise_of(power, added_noise(sensor, settings), signal_noise=sensor.signal_noise)
        measured = power + sigma * deviates("detection", echoes)
    seen = measured > 1
    apparent = echoes.apparent * measured / np.maximum(power, 1e-300)
    return replace(echoes, apparent=apparent).take(seen)


def added_noise(sensor: Sensor, settings: ScannerSettings) -> float:
    """Noise over threshold that the detector adds to echoes of no power; 0 without ``detection``."""
    return daylight_noise(sensor.noise_ratio, settings.daylight_lux) if settings.detection else 0.0


def false_echoes(
    sensor: Sensor, pulses: Firings, *, echoes: Echoes, settings: ScannerSettings, seed: int, frame: int
) -> list[tuple[Origin, Echoes]]:
    """Echoes of no surface, by origin: blooming, pulses of other scanners, noise over the threshold.

    Each entry has at most one echo per pulse.
    """
    found: list[tuple[Origin, Echoes]] = []
    if settings.blooming:
        rng = generator(seed, sensor.name, frame, "blooming")
        found.append((Origin.RECEIVER, _blooming(pulses, echoes, rng=rng)))
    if settings.interference:
        rng = generator(seed, sensor.name, frame, "interference")
        pulse = np.flatnonzero(rng.random(len(pulses)) < 1 - (1 - _OVERLAP) ** settings.interference)
        pulse = pulse[has_code(sensor, len(pulse), rng=rng)]
        power = 100 ** rng.random(len(pulse))  # log-uniform over two decades, assumed
        found.append((Origin.INTERFERENCE, _anywhere(sensor, pulse, power=power, rng=rng)))
    if settings.false_alarms:
        rng = generator(seed, sensor.name, frame, "false alarms")
        noise = daylight_noise(sensor.noise_ratio, settings.daylight_lux)
        chance = false_alarm_probability(noise, sensor.max_range - sensor.min_range)
        pulse = np.flatnonzero(rng.random(len(pulses)) < chance)
        # Beyond a high threshold the tail of a Gaussian falls like an exponential.
        power = 1 + noise**2 * rng.standard_exponential(len(pulse))
        found.append((Origin.RECEIVER, _anywhere(sensor, pulse, power=power, rng=rng)))
    return found


def _anywhere(
    sensor: Sensor, pulse: NDArray[np.integer], *, power: Float, rng: np.random.Generator
) -> Echoes:
    """Echoes with a power over the threshold, at uniformly distributed ranges within the sensor's limits."""
    distance = rng.uniform(sensor.min_range, sensor.max_range, len(pulse))
    apparent = apparent_of(sensor, power, distance=distance)
    return artificial_echoes(pulse, distance - sensor.pattern.range_offset, apparent=apparent)


def _blooming(pulses: Firings, echoes: Echoes, *, rng: np.random.Generator) -> Echoes:
    """Echoes at the range of a retro-reflector, of pulses that pass close to it."""
    from scipy.spatial import cKDTree  # noqa: PLC0415

    bright = echoes.take(echoes.apparent > RETRO)
    if not len(bright):
        return artificial_echoes(np.empty(0, np.int32), np.empty(0), apparent=np.empty(0))
    distance, nearest = cKDTree(pulses.direction[bright.pulse]).query(
        pulses.direction, distance_upper_bound=2 * np.sin(_BLOOM_ANGLE / 2)
    )
    is_close = np.isfinite(distance)
    is_close[bright.pulse] = False
    pulse = np.flatnonzero(is_close & (rng.random(len(pulses)) < _BLOOM_CHANCE))
    source = nearest[pulse]
    return artificial_echoes(pulse, bright.range[source], apparent=_BLOOM_POWER * bright.apparent[source])


def measured_range(
    sensor: Sensor,
    pulses: Firings,
    *,
    echoes: Echoes,
    settings: ScannerSettings,
    seed: int,
    deviates: Deviates,
) -> Float:
    """Ranges (m,) as the sensor reports them, metres."""
    distance = echoes.range + sensor.pattern.range_offset
    if settings.bias:
        lasers = int(pulses.channel.max()) + 1
        error = generator(seed, sensor.name, "bias").normal(0, sensor.bias_sigma, lasers)
        distance = distance + error[pulses.channel[echoes.pulse]]
    if settings.walk or settings.range_noise == "signal":
        power = np.maximum(receive(sensor, echoes), 1.0)
        if settings.walk:
            distance = distance + walk(power)
    if settings.range_noise != "none":
        sigma: Float = np.full(len(echoes), sensor.range_sigma)
        if settings.range_noise == "signal":
            sigma = np.hypot(sigma, signal_sigma(power, sensor.weak_sigma))
        distance = distance + sigma * deviates("range noise", echoes)
    if settings.stretch and not settings.traces_footprints:
        width = stretch_sigma(echoes.range, echoes.cosine, divergence=sensor.divergence[1])
        distance = distance + width * deviates("stretch", echoes)
    return quantise(distance, sensor.range_quantum) if settings.quantise else distance


METRES_PER_NS = 0.299792458 / 2
"""Range per nanosecond of delay."""


def shift_by_delay(sensor: Sensor, count: int, *, rng: np.random.Generator) -> Float:
    """Metres (count,) by which prepared pulses seem off, as the sensor fires its own at random times.

    Uniform over c J / 2 of the sensor's greatest delay J, around 0: the mean delay is known to all.
    """
    if not sensor.firing_jitter_ns:
        return np.zeros(count)
    return METRES_PER_NS * sensor.firing_jitter_ns * rng.uniform(-0.5, 0.5, count)


def has_code(sensor: Sensor, count: int, *, rng: np.random.Generator) -> Bools:
    """Mask (count,) of pulses from elsewhere that have the code of the sensor's pulse by chance."""
    if not sensor.code_bits:
        return np.ones(count, bool)
    return rng.random(count) < 0.5**sensor.code_bits


_WALK = 0.005  # metres nearer per decade of amplitude, typical value


def signal_sigma(received: ArrayLike, weak_sigma: tuple[float, float]) -> Float:
    """Standard deviation in metres that noise adds to ranges, by received power A over threshold.

    sqrt(s^2 / A + b^2 / A^2): noise of the signal's own photons, and of background and receiver. With b = 0
    it is dR / sqrt(2 SNR) of LISA (Kilic et al. 2021), of which dR = 0.09 m is the default.

    weak_sigma : (s, b) metres, both at the threshold
    """
    power = np.asarray(received, float)
    own, background = weak_sigma
    sigma: Float = np.hypot(own / np.sqrt(power), background / power)
    return sigma


def stretch_sigma(distance: ArrayLike, cosine: ArrayLike, *, divergence: float) -> Float:
    """Standard deviation in metres that the depth of the footprint on a slanted surface adds.

    The 1/e^2 footprint is R B tan(theta) deep, and the deviation of a Gaussian is a quarter of its 1/e^2
    width. The depth of grazing beams is limited to the distance.
    """
    c = np.maximum(np.asarray(cosine, float), 1e-3)
    depth = np.asarray(distance, float) * divergence * np.sqrt(np.maximum(1 - c * c, 0)) / c
    sigma: Float = np.minimum(depth, np.asarray(distance, float)) / 4
    return sigma


def walk(received: ArrayLike) -> Float:
    """Range walk in metres, negative: the flank of a bright echo crosses the threshold earlier."""
    error: Float = -_WALK * np.log10(np.maximum(np.asarray(received, float), 1.0))
    return error


def quantise(distance: Float, quantum: float) -> Float:
    """Distances rounded to multiples of ``quantum`` metres; unchanged if that is 0."""
    if quantum <= 0:
        return distance
    # Divide by whole steps per metre: 3 steps of 2 mm are then 0.006, not 0.006000000000000001.
    steps = round(1 / quantum)
    if abs(steps * quantum - 1) < 1e-9:
        return np.round(distance * steps) / steps
    return quantum * np.round(distance / quantum)

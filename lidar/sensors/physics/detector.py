"""The detector of a scanner: lost and false echoes, and measured ranges."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
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
from lidar.sensors.physics.pulse_identity import has_code
from lidar.sensors.physics.range_error import quantise, signal_sigma, stretch_sigma, walk
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
    return amplitude(
        echoes.apparent,
        echoes.range + sensor.pattern.range_offset,
        reference_reflectance=sensor.reference_reflectance,
        reference_range=sensor.reference_range,
        falloff=sensor.falloff,
    )


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
    apparent = apparent_of(
        power,
        distance,
        reference_reflectance=sensor.reference_reflectance,
        reference_range=sensor.reference_range,
        falloff=sensor.falloff,
    )
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
    if settings.stretch and settings.rays == 1:
        width = stretch_sigma(echoes.range, echoes.cosine, divergence=sensor.divergence[1])
        distance = distance + width * deviates("stretch", echoes)
    return quantise(distance, sensor.range_quantum) if settings.quantise else distance

"""Extremes of statistics: moments of every noise model, and independence of random streams, in sigmas."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial

import numpy as np

from geoscene.typing import Float
from lidar.geometry.attitude import Mount
from lidar.geometry.random_streams import generator, normal_of, uniform_of
from lidar.sensors.navigation.gnss import gauss_markov
from lidar.sensors.navigation.imu import inertial_noise
from lidar.sensors.physics.detector import (
    Deviates,
    detect_echoes,
    measured_range,
    receive,
    signal_sigma,
    stretch_sigma,
)
from lidar.sensors.physics.echoes import Echoes, artificial_echoes
from lidar.sensors.physics.link import daylight_noise, detection_probability, noise_of
from lidar.sensors.physics.settings import ScannerSettings
from lidar.sensors.rig.scanner import firings, load_sensor
from lidar.sensors.rig.specs import ImuSpec
from lidar.tools.selftest.case import BATCH, ExtremeCase, batches

SIGMAS = 5.0
"""Bound of a statistic's deviation from its expectation: exceeded by chance once in 1.7 million."""


def _moments(samples: Iterable[Float]) -> float:
    """Largest deviation, in standard errors, of mean, variance, skewness and kurtosis from a normal's."""
    total, count = np.zeros(4), 0
    for x in samples:
        total += [(x**p).sum() for p in (1, 2, 3, 4)]
        count += len(x)
    expected, spread = np.array([0, 1, 0, 3]), np.array([1, 2, 15, 96])  # var(x^p) = m(2p) - m(p)^2
    return float(np.abs((total / count - expected) / np.sqrt(spread / count)).max())


def counter_normals(count: int) -> float:
    """Moments of `normal_of` over consecutive numbers."""
    return _moments(normal_of(np.arange(k * BATCH, k * BATCH + size), 7) for k, size in batches(count))


def counter_uniforms(count: int) -> float:
    """Deviation of the occupancy of 1,000 equal bins of `uniform_of`, chi-square in standard errors."""
    hits = np.zeros(1000)
    for k, size in batches(count):
        number = np.arange(k * BATCH, k * BATCH + size)
        hits += np.bincount((uniform_of(number, 7) * 1000).astype(int), minlength=1000)
    expected = count / 1000
    return float(abs(((hits - expected) ** 2 / expected).sum() - 999) / np.sqrt(2 * 999))


def stream_normals(count: int) -> float:
    """Moments of the generators of frames."""
    return _moments(generator(0, "top", k, "range noise").standard_normal(size) for k, size in batches(count))


def _correlation(pairs: Iterable[tuple[Float, Float]]) -> float:
    """Correlation of two streams of standard deviates, in standard errors."""
    total, count = 0.0, 0
    for a, b in pairs:
        total, count = total + float(a @ b), count + len(a)
    return abs(total) / float(np.sqrt(count))


_RANGES = "top", 0, "range noise"


def between_streams(count: int, *, first: tuple[object, ...] = _RANGES, second: tuple[object, ...]) -> float:
    """Correlation of two streams whose words differ, also one deviate apart."""

    def pairs(lag: int) -> Iterable[tuple[Float, Float]]:
        one, two = generator(0, *first), generator(0, *second)
        for _, size in batches(count):
            a, b = one.standard_normal(size), two.standard_normal(size)
            yield a[lag:], b[: len(b) - lag]

    return max(_correlation(pairs(lag)) for lag in (0, 1))


def between_many_frames(count: int) -> float:
    """Largest correlation between any two of the streams of 100 frames, per pair, over its expectation."""
    size = max(count // 100, 2)
    rows = np.stack([generator(0, "top", k, "range noise").standard_normal(size) for k in range(100)])
    matrix = rows @ rows.T / np.sqrt(size)
    return float(np.abs(matrix[np.triu_indices(100, 1)]).max())


def between_seeds(count: int) -> float:
    """Correlation of `normal_of` of the same numbers under successive seeds."""

    def pairs() -> Iterable[tuple[Float, Float]]:
        for k, size in batches(count):
            number = np.arange(k * BATCH, k * BATCH + size)
            yield normal_of(number, 7), normal_of(number, 8)

    return _correlation(pairs())


def between_numbers(count: int) -> float:
    """Correlation of `normal_of` of successive numbers."""

    def pairs() -> Iterable[tuple[Float, Float]]:
        for k, size in batches(count):
            x = normal_of(np.arange(k * BATCH, k * BATCH + size + 1), 7)
            yield x[1:], x[:-1]

    return _correlation(pairs())


def between_workers(count: int) -> float:
    """Deviates of frames that depend on the order in which frames are drawn, as workers draw them."""

    def draw(frame: int) -> Float:
        return generator(3, "top", frame, "range noise").standard_normal(100)

    frames = max(count // 100, 2)
    alone = np.stack([draw(k) for k in range(frames)])
    order = np.random.default_rng(0).permutation(frames).tolist()
    mixed = np.empty_like(alone)
    for k in order:
        mixed[k] = draw(k)
    return float((alone != mixed).sum())


_SENSOR = load_sensor("vlp16")
_AWAY, _APPARENT = 40.0, 0.5
"""Metres and apparent reflectance of the echoes whose noise is measured."""


def _echoes(size: int, *, apparent: float, cosine: float = 1.0) -> Echoes:
    """Echoes (n,) at 40 m."""
    found = artificial_echoes(
        np.zeros(size, np.int32), np.full(size, _AWAY), apparent=np.full(size, apparent)
    )
    return replace(found, cosine=np.full(size, cosine))


def _deviates(*words: object) -> Deviates:
    rng = generator(1, *words)
    return lambda _, echoes: rng.standard_normal(len(echoes))


def noisy_ranges(count: int, *, settings: ScannerSettings, sigma: float, cosine: float = 1.0) -> float:
    """Moments of measured minus true ranges over their expected deviation."""
    pulses = firings(_SENSOR, 0)

    def samples() -> Iterable[Float]:
        for k, size in batches(count):
            found = measured_range(
                _SENSOR,
                pulses,
                echoes=_echoes(size, apparent=_APPARENT, cosine=cosine),
                settings=settings,
                seed=0,
                deviates=_deviates(k),
            )
            yield (found - _AWAY - _SENSOR.pattern.range_offset) / sigma

    return _moments(samples())


def signal_range_noise(count: int) -> float:
    """Moments of the range noise that depends on the received power."""
    power = float(receive(_SENSOR, _echoes(1, apparent=_APPARENT))[0])
    sigma = float(np.hypot(_SENSOR.range_sigma, signal_sigma(max(power, 1.0), _SENSOR.weak_sigma)))
    return noisy_ranges(count, settings=ScannerSettings(range_noise="signal"), sigma=sigma)


def slant_range_noise(count: int) -> float:
    """Moments of the range noise of pulses on a surface at 60 degrees."""
    sigma = float(stretch_sigma(_AWAY, 0.5, divergence=_SENSOR.divergence[1]))
    return noisy_ranges(count, settings=ScannerSettings(stretch=True), sigma=sigma, cosine=0.5)


def detection_rate(count: int) -> float:
    """Deviation of the share of detected echoes from its probability, within 2 sigmas of the threshold."""
    settings, unit = ScannerSettings(detection=True), float(receive(_SENSOR, _echoes(1, apparent=1.0))[0])
    noise, worst = daylight_noise(_SENSOR.noise_ratio, settings.daylight_lux), 0.0
    steps = np.arange(-2.0, 3.0) * float(noise_of(1.0, noise, signal_noise=_SENSOR.signal_noise))
    for row, power in enumerate((1 + steps).tolist()):
        chance = float(detection_probability(power, noise, signal_noise=_SENSOR.signal_noise))
        seen, drawn = 0, 0
        for k, size in batches(count // len(steps)):
            sent = _echoes(size, apparent=power / unit)
            seen += len(detect_echoes(_SENSOR, sent, settings=settings, deviates=_deviates(row, k)))
            drawn += size
        worst = max(worst, abs(seen - chance * drawn) / float(np.sqrt(drawn * chance * (1 - chance))))
    return worst


def imu_white_noise(count: int) -> float:
    """Moments of the white noise of gyros and accelerometers."""
    spec = ImuSpec("imu", Mount(), gyro_walk=0.0, accel_walk=0.0)
    width = np.repeat([spec.gyro_noise, spec.accel_noise], 3) * np.sqrt(spec.rate_hz)
    return _moments(
        (inertial_noise(spec, max(size // 6, 1), seed=k) / width).ravel() for k, size in batches(count)
    )


def imu_random_walk(count: int) -> float:
    """Moments of the steps of the random walk of gyros and accelerometers."""
    spec = ImuSpec("imu", Mount(), gyro_noise=0.0, accel_noise=0.0)
    width = np.repeat([spec.gyro_walk, spec.accel_walk], 3) / np.sqrt(spec.rate_hz)
    return _moments(
        (np.diff(inertial_noise(spec, max(size // 6, 2), seed=k), axis=0) / width).ravel()
        for k, size in batches(count)
    )


def gnss_processes(count: int) -> float:
    """Moments of the innovations of Gauss-Markov processes, and of independent samples of these."""
    n = max(count // 3, 300)
    u, phi = gauss_markov(generator(5, "bias"), 1.0, tau=np.full(n, 10.0)), float(np.exp(-0.1))
    steps = (u[1:] - phi * u[:-1]) / np.sqrt(1 - phi**2)
    return max(_moments([steps.ravel()]), _moments([u[::200].ravel()]))


_LIMIT = "5 standard errors: one statistic exceeds them by chance once in 1.7 million"

_case = partial(ExtremeCase, group="statistics", of="samples", quick=100_000)
_row = partial(_case, limit=_LIMIT, bound=SIGMAS, unit="σ", full=10**8)
_CONSTANT = ScannerSettings(range_noise="constant")

CASES = (
    _row("normal deviates by number: moments 1 to 4", counter_normals),
    _row("uniform deviates by number: 1,000 bins", counter_uniforms),
    _row("normal deviates of frames: moments 1 to 4", stream_normals),
    _row(
        "correlation between sensors",
        partial(between_streams, first=("left", *_RANGES[1:]), second=("right", *_RANGES[1:])),
    ),
    _row("correlation between frames", partial(between_streams, second=("top", 1, "range noise"))),
    _row("correlation between purposes", partial(between_streams, second=("top", 0, "detection"))),
    _row("largest of the correlations between 100 frames", between_many_frames),
    _row("correlation between seeds", between_seeds),
    _row("correlation between successive numbers", between_numbers),
    _case(
        "deviates that depend on the order of frames, as of workers",
        between_workers,
        "each frame has a generator of its own",
        unit="deviates",
        full=10**7,
    ),
    _row(
        "range noise, constant: moments 1 to 4",
        partial(noisy_ranges, settings=_CONSTANT, sigma=_SENSOR.range_sigma),
    ),
    _row("range noise by signal: moments 1 to 4", signal_range_noise),
    _row("range noise on a slant: moments 1 to 4", slant_range_noise),
    _row("share of detected echoes near the threshold", detection_rate),
    _row("IMU, white noise: moments 1 to 4", imu_white_noise),
    _row("IMU, random walk: moments 1 to 4", imu_random_walk),
    _row("GNSS, Gauss-Markov processes: moments 1 to 4", gnss_processes, full=3 * 10**7),
)
"""Extremes of statistics."""

"""Link equation: received power, its detection against noise, and the intensity codes of scanners."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.typing import Float
from lidar.sensors.rig.scanner import Sensor

GATE = 0.3
"""Metres of range per independent sample of the noise."""

_DAYLIGHT = 20_000.0  # lux at which daylight doubles the noise power, typical value


def amplitude(sensor: Sensor, apparent: ArrayLike, *, distance: ArrayLike) -> Float:
    """Received power over the detection threshold of extended targets.

    The link equation (rho / rho_ref) (R_ref / R)^f, scaled so that the power of the data sheet's target,
    rho_ref at R_ref, is the threshold. With the sensor's falloff f = 2 the maximum range is proportional to
    sqrt(rho).

    apparent : reflectance times the law of incidence and `transmission`
    distance : metres, as the sensor reports it
    """
    r = np.maximum(np.asarray(distance, float), 1e-3)
    scale = np.asarray(apparent, float) / sensor.reference_reflectance
    received: Float = scale * (sensor.reference_range / r) ** sensor.falloff
    return received


def transmission(distance: ArrayLike, extinction: float) -> Float:
    """Share of the power that the air lets pass to a target and back; metres, and 1/m one way."""
    share: Float = np.exp(-2 * extinction * np.asarray(distance, float))
    return share


def apparent_of(sensor: Sensor, received: ArrayLike, *, distance: ArrayLike) -> Float:
    """Reflectance that a scanner derives from received power over threshold and distance in metres.

    The inverse of `amplitude` in clear air, as instruments assume.
    """
    growth = (np.asarray(distance) / sensor.reference_range) ** sensor.falloff
    return np.asarray(received) * sensor.reference_reflectance * growth


def daylight_noise(noise_ratio: float, lux: float) -> float:
    """Noise over threshold at an illuminance in lux, which adds shot noise; typical values."""
    return float(noise_ratio * np.sqrt(1 + lux / _DAYLIGHT))


def noise_of(received: ArrayLike, noise_ratio: float, *, signal_noise: float = 0.0) -> Float:
    """Noise over threshold of echoes: ``noise_ratio``, and ``signal_noise`` times the power, independent."""
    sigma: Float = np.hypot(noise_ratio, signal_noise * np.asarray(received, float))
    return sigma


def detection_probability(received: ArrayLike, noise_ratio: float, *, signal_noise: float = 0.0) -> Float:
    """Probability that an echo passes the threshold, with the Gaussian noise `noise_of`."""
    from scipy.special import erfc  # noqa: PLC0415  (0.2 s)

    sigma = noise_of(received, noise_ratio, signal_noise=signal_noise)
    probability: Float = 0.5 * erfc((1 - np.asarray(received, float)) / (np.sqrt(2) * sigma))
    return probability


def false_alarm_probability(noise_ratio: float, reach: float) -> float:
    """Probability that noise passes the threshold somewhere within ``reach`` metres of one pulse."""
    gate = 0.5 * math.erfc(1 / (math.sqrt(2) * noise_ratio))
    return float(-np.expm1(reach / GATE * np.log1p(-gate)))


BRIGHTEST = 1000.0
"""Apparent reflectance that has the code 255: high-intensity sheeting, typical value."""


def reflectivity_code(
    apparent: Float, *, diffuse_code: float = 100.0, whole: bool = False
) -> NDArray[np.float32]:
    """Codes 0 to 255 of apparent reflectances.

    Linear up to ``diffuse_code`` for a white Lambertian target at normal incidence, logarithmic above, 255
    from `BRIGHTEST` on. Velodyne, RoboSense and Ouster publish the ranges of their codes in manuals, but not
    the base of the logarithm.

    whole : round the codes, as the instruments do
    """
    code = diffuse_code * np.clip(apparent, 0, 1)
    bright = np.flatnonzero(apparent > 1.0)
    share = np.log10(apparent[bright]) / np.log10(BRIGHTEST)
    code[bright] += (255.0 - diffuse_code) * np.minimum(share, 1.0)
    coded: NDArray[np.float32] = (np.round(code) if whole else code).astype(np.float32)
    return coded


def apparent_of_code(code: NDArray[np.floating], *, diffuse_code: float = 100.0) -> Float:
    """Apparent reflectances of codes: the inverse of `reflectivity_code`."""
    above = (np.asarray(code, np.float64) - diffuse_code) / (255.0 - diffuse_code)
    bright = BRIGHTEST ** np.clip(above, 0.0, 1.0)
    return np.where(above > 0, bright, np.clip(code, 0, diffuse_code) / diffuse_code)

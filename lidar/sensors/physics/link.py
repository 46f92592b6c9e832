"""Link equation: received power, and its detection against noise."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from geoscene.typing import Float

GATE = 0.3
"""Metres of range per independent sample of the noise."""

_DAYLIGHT = 20_000.0  # lux at which daylight doubles the noise power, typical value


def amplitude(
    apparent: ArrayLike,
    distance: ArrayLike,
    *,
    reference_reflectance: float,
    reference_range: float,
    falloff: float = 2.0,
) -> Float:
    """Received power over the detection threshold of extended targets.

    The link equation (rho / rho_ref) (R_ref / R)^f, scaled so that the power of the data sheet's target,
    rho_ref at R_ref, is the threshold. With f = 2 the maximum range is proportional to sqrt(rho).

    apparent : reflectance times the law of incidence and `transmission`
    distance : metres
    falloff  : f; 2 but for receivers whose data sheet says otherwise
    """
    r = np.maximum(np.asarray(distance, float), 1e-3)
    scale = np.asarray(apparent, float) / reference_reflectance
    received: Float = scale * (reference_range / r) ** falloff
    return received


def transmission(distance: ArrayLike, extinction: float) -> Float:
    """Share of the power that the air lets pass to a target and back; metres, and 1/m one way."""
    share: Float = np.exp(-2 * extinction * np.asarray(distance, float))
    return share


def apparent_of(
    received: ArrayLike,
    distance: ArrayLike,
    *,
    reference_reflectance: float,
    reference_range: float,
    falloff: float = 2.0,
) -> Float:
    """Reflectance that a scanner derives from received power over threshold and distance in metres.

    The inverse of `amplitude` in clear air, as instruments assume.
    """
    return np.asarray(received) * reference_reflectance * (np.asarray(distance) / reference_range) ** falloff


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

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
) -> Float:
    """Received power over the detection threshold of extended targets.

    The link equation (rho / rho_ref) (R_ref / R)^2, scaled so that the power of the data sheet's target,
    rho_ref at R_ref, is the threshold. The maximum range is proportional to sqrt(rho).

    apparent : reflectance times the law of incidence and `transmission`
    distance : metres
    """
    r = np.maximum(np.asarray(distance, float), 1e-3)
    scale = np.asarray(apparent, float) / reference_reflectance
    received: Float = scale * (reference_range / r) ** 2
    return received


def transmission(distance: ArrayLike, extinction: float) -> Float:
    """Share of the power that the air lets pass to a target and back; metres, and 1/m one way."""
    share: Float = np.exp(-2 * extinction * np.asarray(distance, float))
    return share


def apparent_of(
    received: ArrayLike, distance: ArrayLike, *, reference_reflectance: float, reference_range: float
) -> Float:
    """Reflectance that a scanner derives from received power over threshold and distance in metres.

    The inverse of `amplitude` in clear air, as instruments assume.
    """
    return np.asarray(received) * reference_reflectance * (np.asarray(distance) / reference_range) ** 2


def daylight_noise(noise_ratio: float, lux: float) -> float:
    """Noise over threshold at an illuminance in lux, which adds shot noise; typical values."""
    return float(noise_ratio * np.sqrt(1 + lux / _DAYLIGHT))


def detection_probability(received: ArrayLike, noise_ratio: float) -> Float:
    """Probability that an echo passes the threshold, with Gaussian noise of ``noise_ratio`` thresholds."""
    from scipy.special import erfc  # noqa: PLC0415  (0.2 s)

    probability: Float = 0.5 * erfc((1 - np.asarray(received, float)) / (np.sqrt(2) * noise_ratio))
    return probability


def false_alarm_probability(noise_ratio: float, reach: float) -> float:
    """Probability that noise passes the threshold somewhere within ``reach`` metres of one pulse."""
    gate = 0.5 * math.erfc(1 / (math.sqrt(2) * noise_ratio))
    return float(-np.expm1(reach / GATE * np.log1p(-gate)))

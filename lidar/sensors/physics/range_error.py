"""Range errors of a scanner: noise of weak signals, pulse stretching, range walk, quantisation."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from geoscene.typing import Float

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

"""Intensity codes of scanners: calibrated reflectivity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float

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

"""Colours for points: by class, height, intensity or sensor."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Ten anchors of viridis (Smith and van der Walt, released as CC0), evenly spaced.
_VIRIDIS = np.array(
    [
        (68, 1, 84), (72, 40, 120), (62, 74, 137), (49, 104, 142), (38, 130, 142),
        (31, 158, 137), (53, 183, 121), (109, 205, 89), (180, 222, 44), (253, 231, 37),
    ],
    float,
)  # fmt: skip

# The palette of Okabe and Ito: eight colours that colour-blind people can tell apart.
_DISTINCT = np.array(
    [
        (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66),
        (0, 114, 178), (213, 94, 0), (204, 121, 167), (0, 0, 0),
    ],
    np.uint8,
)  # fmt: skip


def ramp(values: ArrayLike, low: float, *, high: float) -> NDArray[np.uint8]:
    """Colours (..., 3) of values between ``low`` (violet) and ``high`` (yellow); clipped outside."""
    share = np.clip((np.asarray(values, float) - low) / max(high - low, 1e-12), 0.0, 1.0)
    at = share * (len(_VIRIDIS) - 1)
    steps = np.arange(len(_VIRIDIS))
    channels = [np.interp(at, steps, _VIRIDIS[:, k]) for k in range(3)]
    rgb: NDArray[np.uint8] = np.rint(np.stack(channels, axis=-1)).astype(np.uint8)
    return rgb


def distinct(index: ArrayLike) -> NDArray[np.uint8]:
    """Colours (..., 3) of small integers; they repeat after eight."""
    rgb: NDArray[np.uint8] = _DISTINCT[np.asarray(index) % len(_DISTINCT)]
    return rgb

"""Pixels at edges, whose colour needs more than one ray."""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from lidar.sensors.camera.texture import compiled

_UNLABELED = int(Class.UNLABELED)

BETWEEN = 8
"""Levels of sRGB by which neighbouring pixels of different objects differ at an edge, in one channel."""

WITHIN = 32
"""The same for pixels of one object: shadows, windows and facets. Texture is filtered where it is drawn."""


def edge_pixels(
    rgb: NDArray[np.uint8], feature: NDArray[np.int32], *, klass: NDArray[np.uint8]
) -> NDArray[np.int64]:
    """Numbers of the pixels of an image at edges, row by row from the top.

    A pixel is at an edge if its colour differs from that of one of its four neighbours by more than `WITHIN`
    levels, or by more than `BETWEEN` where the neighbour has another feature or class. Pixels without a ray
    (UNLABELED, without a feature) are at no edge.

    rgb     : (h, w, 3) of one ray per pixel
    feature : (h, w)
    klass   : (h, w)
    """
    found = np.zeros(feature.shape, np.bool_)
    _mark(rgb, feature, klass, BETWEEN, WITHIN, found)
    return np.flatnonzero(found)


@compiled
def _rayless(feature: int, klass: int) -> bool:
    return feature < 0 and klass == _UNLABELED


@compiled
def _mark(
    rgb: NDArray[np.uint8],
    feature: NDArray[np.int32],
    klass: NDArray[np.uint8],
    between: int,
    within: int,
    found: NDArray[np.bool_],
) -> None:
    h, w = feature.shape
    for i in range(h):
        for j in range(w):
            for side in range(2):
                k, m = i + side, j + 1 - side
                if k >= h or m >= w:
                    continue
                if _rayless(feature[i, j], klass[i, j]) or _rayless(feature[k, m], klass[k, m]):
                    continue
                apart = np.int32(0)
                for c in range(3):
                    step = np.int32(rgb[i, j, c]) - np.int32(rgb[k, m, c])
                    apart = max(apart, step, -step)
                same = feature[i, j] == feature[k, m] and klass[i, j] == klass[k, m]
                if apart > (within if same else between):
                    found[i, j] = True
                    found[k, m] = True

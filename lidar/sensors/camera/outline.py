"""2D bounding box and unoccluded pixel area of a body in an image."""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

import math
from typing import Any

import numpy as np

from geoscene.support.compiled import njit
from geoscene.typing import Float


def outline(corners: Float, width: int, *, height: int) -> tuple[tuple[float, float, float, float], int]:
    """Left, top, right and bottom of triangles (n, 3, 2) in an image, and the number of pixels they cover.

    The image reaches from -0.5 to its size - 0.5; a pixel is covered if its centre is. Triangles with a
    corner that is not finite are left out. The bounds are NaN if no triangle lies in the image.
    """
    whole = corners[np.isfinite(corners).all(axis=(1, 2))]
    bounds = np.array([np.inf, np.inf, -np.inf, -np.inf])
    _bounds(whole, width - 0.5, height - 0.5, bounds)
    left, top, right, bottom = bounds.tolist()
    if not left < right or not top < bottom:
        return (math.nan, math.nan, math.nan, math.nan), 0
    u0, v0 = max(math.ceil(left), 0), max(math.ceil(top), 0)
    mask = np.zeros(
        (min(math.floor(bottom), height - 1) - v0 + 1, min(math.floor(right), width - 1) - u0 + 1), np.bool_
    )
    _cover(whole, u0, v0, mask)
    return (left, top, right, bottom), int(mask.sum())


@njit(cache=True, nogil=True)
def _bounds(corners: Any, right: float, bottom: float, out: Any) -> None:
    """Widen ``out`` by the part of each triangle within the image (Sutherland and Hodgman 1974)."""
    here, there = np.empty((8, 2)), np.empty((8, 2))
    limit = (-0.5, -0.5, right, bottom)
    for t in range(len(corners)):
        low_x = min(corners[t, 0, 0], corners[t, 1, 0], corners[t, 2, 0])
        low_y = min(corners[t, 0, 1], corners[t, 1, 1], corners[t, 2, 1])
        high_x = max(corners[t, 0, 0], corners[t, 1, 0], corners[t, 2, 0])
        high_y = max(corners[t, 0, 1], corners[t, 1, 1], corners[t, 2, 1])
        if low_x > right or high_x < -0.5 or low_y > bottom or high_y < -0.5:
            continue
        if low_x >= -0.5 and high_x <= right and low_y >= -0.5 and high_y <= bottom:
            out[0], out[1] = min(out[0], low_x), min(out[1], low_y)
            out[2], out[3] = max(out[2], high_x), max(out[3], high_y)
            continue
        for k in range(3):
            here[k, 0], here[k, 1] = corners[t, k, 0], corners[t, k, 1]
        count = 3
        for side in range(4):
            axis, sign = side % 2, 1.0 if side < 2 else -1.0
            kept = 0
            for k in range(count):
                a, b = here[k], here[(k + 1) % count]
                in_a, in_b = sign * (a[axis] - limit[side]), sign * (b[axis] - limit[side])
                if in_a >= 0:
                    there[kept, 0], there[kept, 1] = a[0], a[1]
                    kept += 1
                if (in_a >= 0) != (in_b >= 0):
                    share = in_a / (in_a - in_b)
                    for r in range(2):
                        there[kept, r] = a[r] + share * (b[r] - a[r])
                    kept += 1
            here, there = there, here
            count = kept
        for k in range(count):
            for axis in range(2):
                out[axis] = min(out[axis], here[k, axis])
                out[axis + 2] = max(out[axis + 2], here[k, axis])


@njit(cache=True, nogil=True)
def _cover(corners: Any, u0: int, v0: int, mask: Any) -> None:
    """Set the pixels of ``mask``, the first of which is (u0, v0), whose centre is in a triangle."""
    high, wide = mask.shape
    for t in range(len(corners)):
        ax, ay = corners[t, 0, 0] - u0, corners[t, 0, 1] - v0
        bx, by = corners[t, 1, 0] - u0, corners[t, 1, 1] - v0
        cx, cy = corners[t, 2, 0] - u0, corners[t, 2, 1] - v0
        first = max(0, math.ceil(max(-1.0, min(ay, by, cy))))
        last = min(high - 1, math.floor(min(float(high), max(ay, by, cy))))
        for v in range(first, last + 1):
            # the row crosses two or three sides: pixels between the outermost crossings are inside
            low, up = np.inf, -np.inf
            for px, py, qx, qy in ((ax, ay, bx, by), (bx, by, cx, cy), (cx, cy, ax, ay)):
                if min(py, qy) <= v <= max(py, qy):
                    if py == qy:
                        low, up = min(low, px, qx), max(up, px, qx)
                    else:
                        x = px + (v - py) / (qy - py) * (qx - px)
                        low, up = min(low, x), max(up, x)
            if low <= up:
                for u in range(
                    max(0, math.ceil(max(-1.0, low))), min(wide - 1, math.floor(min(float(wide), up))) + 1
                ):
                    mask[v, u] = True

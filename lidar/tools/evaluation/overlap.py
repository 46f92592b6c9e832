"""Intersection over union of bounding boxes: in images, in plan, and in space."""

from __future__ import annotations

import numpy as np
import shapely

from geoscene.typing import Float

_CORNERS = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])


def flat_overlap(one: Float, other: Float) -> Float:
    """Intersection over union (n, m) of boxes (n, 4) and (m, 4): left, top, right, bottom."""
    low = np.maximum(one[:, None, :2], other[None, :, :2])
    high = np.minimum(one[:, None, 2:], other[None, :, 2:])
    common = np.clip(high - low, 0, None).prod(axis=2)
    area, area_other = ((b[:, 2:] - b[:, :2]).prod(axis=1) for b in (one, other))
    return _share(common, area[:, None] + area_other[None] - common)


def footprints(centre: Float, size: Float, *, yaw: Float) -> Float:
    """Corners (n, 4, 2) of rectangles: centres (n, 2), lengths and widths (n, 2), yaw (n,) of the length."""
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
    corners: Float = centre[:, None] + (_CORNERS * size[:, None]) @ turn.swapaxes(1, 2)
    return corners


def area_overlap(one: Float, other: Float) -> tuple[Float, Float]:
    """Common areas (n, m) and intersections over unions (n, m) of footprints (n, 4, 2) and (m, 4, 2)."""
    if not (len(one) and len(other)):
        nothing = np.zeros((len(one), len(other)))
        return nothing, nothing
    first, second = shapely.polygons(one), shapely.polygons(other)
    common = shapely.area(shapely.intersection(first[:, None], second[None]))
    union = shapely.area(first)[:, None] + shapely.area(second)[None] - common
    return common, _share(common, union)


def volume_overlap(
    common: Float, *, one: tuple[Float, Float, Float], other: tuple[Float, Float, Float]
) -> Float:
    """Intersection over union (n, m) of upright boxes whose footprints have common areas (n, m).

    one, other : their least and greatest heights and their volumes
    """
    low, high, volume = one
    low_other, high_other, volume_other = other
    tall = np.clip(np.minimum(high[:, None], high_other) - np.maximum(low[:, None], low_other), 0, None)
    shared = common * tall
    return _share(shared, volume[:, None] + volume_other - shared)


def _share(part: Float, whole: Float) -> Float:
    found: Float = np.divide(part, whole, out=np.zeros_like(part), where=whole > 0)
    return found

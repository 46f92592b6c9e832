"""Boxes around clusters: the L-shape that fits best, completed where the object hides itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float

_ANGLES = np.deg2rad(np.arange(0, 90, 2.0))
_NEAREST = 0.1
"""Metres; cells nearer to an edge than this count as on it."""


@dataclass(frozen=True, slots=True)
class Rectangle:
    """An oriented rectangle in plan.

    centre : (2,) metres
    size   : along its axis and across, metres; the first is the longer one
    yaw    : radians of its axis from x to y
    edge   : mean distance of the points from the nearest edge, metres
    """

    centre: Float
    size: tuple[float, float]
    yaw: float
    edge: float


def fit_rectangle(xy: NDArray[np.floating]) -> Rectangle:
    """The rectangle (closeness criterion of Zhang et al. 2017) around points (n, 2).

    Of 45 directions it is the one in which most points are close to an edge.
    """
    along = xy[:, :1] * np.cos(_ANGLES) + xy[:, 1:] * np.sin(_ANGLES)
    across = xy[:, 1:] * np.cos(_ANGLES) - xy[:, :1] * np.sin(_ANGLES)
    distance = np.minimum(_to_edge(along), _to_edge(across))
    best = int((1 / np.maximum(distance, _NEAREST)).sum(axis=0).argmax())
    yaw = float(_ANGLES[best])
    ends = [(float(side[:, best].min()), float(side[:, best].max())) for side in (along, across)]
    middle = np.array([(low + high) / 2 for low, high in ends])
    size = [high - low for low, high in ends]
    centre = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]) @ middle
    edge = float(distance[:, best].mean())
    if size[1] > size[0]:
        return Rectangle(centre, (size[1], size[0]), yaw + np.pi / 2, edge)
    return Rectangle(centre, (size[0], size[1]), yaw, edge)


def _to_edge(side: Float) -> Float:
    nearest: Float = np.minimum(side.max(axis=0) - side, side - side.min(axis=0))
    return nearest


def complete_rectangle(seen: Rectangle, *, length: float, width: float) -> Rectangle:
    """A vehicle's rectangle, extended away from the sensor to a typical length and width.

    The longer side is the vehicle's length if it is longer than a width can be, else its front or rear, and
    the length extends along the other axis.
    """
    yaw, (a, b) = seen.yaw, seen.size
    axis, normal = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    if a < 1.3 * width:
        axis, normal, yaw, (a, b) = normal, -axis, yaw + np.pi / 2, (b, a)
    size = max(a, length), max(b, width)
    away = [
        np.copysign((size[0] - a) / 2, seen.centre @ axis) * axis,
        np.copysign((size[1] - b) / 2, seen.centre @ normal) * normal,
    ]
    return Rectangle(seen.centre + away[0] + away[1], size, yaw, seen.edge)

"""Detectors of road users: interface, results, and rectangles (L-shapes) around points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.support.columns import Columns
from geoscene.typing import Bools, Float, Ints

_ANGLES = np.deg2rad(np.arange(0, 90, 2.0))
_NEAREST = 0.1
"""Metres; cells nearer to an edge than this count as on it."""
KINDS = {
    **dict.fromkeys((Class.CAR, Class.VAN, Class.TRUCK, Class.BUS), "vehicle"),
    Class.PEDESTRIAN: "person",
    **dict.fromkeys((Class.BICYCLE, Class.CYCLIST, Class.MOTORCYCLE, Class.MOTORCYCLIST), "cycle"),
}
"""What detectors call a class of road users."""


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


class CloudPoints(Protocol):
    """A cloud, of which only the coordinates are used."""

    @property
    def xyz(self) -> NDArray[np.floating]:
        """(n, 3) metres, sensor frame: z up, the sensor at the origin."""
        ...


class Detector(Protocol):
    """Detector of road users in the point cloud of one turn of an upright scanner on a vehicle.

    name     : "rules", "learned" or the model's file
    identity : what tells its boxes from those of other detectors, wherever its file lies
    """

    @property
    def name(self) -> str:
        """As the user gives it."""
        ...

    @property
    def identity(self) -> str:
        """The name "rules", or the start of the digest of a model."""
        ...

    def detect(self, cloud: CloudPoints) -> Detections:
        """Road users in a cloud."""
        ...


@dataclass(frozen=True, slots=True)
class Detections(Columns):
    """Boxes in the frame of the cloud, the most certain first; centre, size and yaw as in boxes of datasets.

    centre : (k, 3) metres
    size   : (k, 3) metres: length, width, height
    yaw    : (k,) radians of the length from x to y, within a half turn (front and rear are not told apart)
    score  : (k,) 0 to 1
    kind   : (k,) "vehicle", "person" or "cycle"
    points : (k,) int64, returns in the box
    """

    centre: Float
    size: Float
    yaw: Float
    score: Float
    kind: NDArray[np.str_]
    points: Ints

    def box_of(self, xyz: NDArray[np.floating], *, margin: float = 0.0) -> Ints:
        """Row (n,) of the most certain box that holds each point (n, 3); -1 for none.

        margin : metres by which boxes are wider on each side
        """
        rows = np.full(len(xyz), -1, np.int64)
        for k in range(len(self) - 1, -1, -1):
            rows[inside(xyz, self.centre[k], size=self.size[k] + 2 * margin, yaw=self.yaw[k])] = k
        return rows


def inside(xyz: NDArray[np.floating], centre: Float, *, size: Float, yaw: float) -> Bools:
    """Whether points (n, 3) are in an upright box."""
    away = xyz - centre
    along = away[:, 0] * np.cos(yaw) + away[:, 1] * np.sin(yaw)
    across = away[:, 1] * np.cos(yaw) - away[:, 0] * np.sin(yaw)
    near: Bools = (
        (np.abs(along) <= size[0] / 2) & (np.abs(across) <= size[1] / 2) & (np.abs(away[:, 2]) <= size[2] / 2)
    )
    return near


@dataclass(frozen=True, slots=True)
class DetectedObject:
    """One object: its rectangle, lowest and highest z, score and kind."""

    rectangle: Rectangle
    z: tuple[float, float]
    score: float
    kind: str


def apart(found: list[DetectedObject]) -> list[DetectedObject]:
    """The objects, best first, without those whose middle is in a better one: parts of it."""
    kept: list[DetectedObject] = []
    for one in sorted(found, key=lambda one: -one.score):
        middle = np.append(one.rectangle.centre, 0.0)[None]
        flat = [
            (np.append(k.rectangle.centre, 0.0), np.array([*k.rectangle.size, 1.0]), k.rectangle.yaw)
            for k in kept
        ]
        if not any(inside(middle, centre, size=size, yaw=yaw)[0] for centre, size, yaw in flat):
            kept.append(one)
    return kept


def table(found: list[DetectedObject], xyz: Float) -> Detections:
    """Boxes of objects, with the number of points (n, 3) in each."""
    boxes = [one.rectangle for one in found]
    z = np.array([one.z for one in found], float).reshape(-1, 2)
    centre = np.column_stack([np.array([box.centre for box in boxes], float).reshape(-1, 2), z.mean(axis=1)])
    size = np.column_stack([np.array([box.size for box in boxes], float).reshape(-1, 2), z[:, 1] - z[:, 0]])
    yaw = np.array([box.yaw for box in boxes], float)
    yaw = (yaw + np.pi / 2) % np.pi - np.pi / 2
    points = [
        np.count_nonzero(inside(xyz, c, size=s, yaw=y)) for c, s, y in zip(centre, size, yaw, strict=True)
    ]
    return Detections(
        centre,
        size,
        yaw,
        np.array([one.score for one in found], float),
        np.array([one.kind for one in found], np.str_),
        np.array(points, np.int64),
    )

"""A detector of road users without learning: ground removal, clustering, box fit, rules of size and count."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from geoscene.columns import Columns
from geoscene.typing import Bools, Float, Ints
from lidar.detection.boxes import Rectangle, completed, fitted
from lidar.detection.ground import height_above_ground


class Points(Protocol):
    """A cloud, of which only the coordinates are used."""

    @property
    def xyz(self) -> NDArray[np.floating]:
        """(n, 3) metres, sensor frame: z up, the sensor at the origin."""
        ...


@dataclass(frozen=True, slots=True)
class DetectorSettings:
    """Sizes in metres; heights above the ground.

    reach   : largest horizontal distance
    band    : lowest and highest height of points that are clustered
    cell    : side of the cells that points are thinned to before they are clustered
    link    : distance within which cells are of one object, at the sensor and per metre of distance
    length, width : of a vehicle that is seen in part
    fewest  : cells of an object
    certain : score below which nothing is returned
    """

    reach: float = 60.0
    band: tuple[float, float] = (0.3, 2.5)
    cell: float = 0.15
    link: tuple[float, float] = (0.55, 0.012)
    length: float = 4.3
    width: float = 1.8
    fewest: int = 3
    certain: float = 0.05


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


_SPACING = 0.035
"""Largest angle between beams in radians, as of a scanner with 16 over 30 degrees."""

PLAIN = DetectorSettings()


def detect(cloud: Points, *, settings: DetectorSettings = PLAIN) -> Detections:
    """Road users in a cloud of one turn of a scanner that stands upright on a vehicle.

    Points above the ground, up to 2.5 m, are clustered seen from above; clusters that are too long are
    clustered again with half the distance. Each gets a rectangle; its size, its height, the share of points
    above it and the number of cells give the score by rules.
    """
    xyz = np.asarray(cloud.xyz, float)
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    xyz = xyz[np.isfinite(xyz).all(axis=1) & (distance < settings.reach) & (distance > 0.5)]
    height = height_above_ground(xyz)
    low, high = settings.band
    solid = height > low
    body = np.flatnonzero(solid & (height < high))
    cells, cell = np.unique(
        np.floor(xyz[body, :2] / settings.cell).astype(np.int64), axis=0, return_inverse=True
    )
    middle = (cells + 0.5) * settings.cell
    groups = _clusters(middle, settings=settings)
    order = np.argsort(groups[cell], kind="stable")
    first = np.searchsorted(groups[cell][order], np.arange(groups.max(initial=-1) + 2))
    tall = _Tall(xyz[solid], height[solid])
    found = []
    for k in range(len(first) - 1):
        rows = body[order[first[k] : first[k + 1]]]
        mine = middle[groups == k]
        if len(mine) < settings.fewest:
            continue
        shape = _shape(height[rows], mine, tall=tall, settings=settings)
        one = _judged(shape, floor=float((xyz[rows, 2] - height[rows]).mean()), settings=settings)
        if one.score >= settings.certain:
            found.append(one)
    return _table(_apart(found), xyz)


@dataclass(frozen=True, slots=True)
class _Found:
    """One object: its rectangle, lowest and highest z, score and kind."""

    rectangle: Rectangle
    z: tuple[float, float]
    score: float
    kind: str


class _Tall:
    """Finds how high the points near a place are."""

    def __init__(self, xyz: Float, height: Float) -> None:
        self._tree, self.height = cKDTree(xyz[:, :2]), height

    def near(self, xy: Float, *, radius: float) -> Float:
        """Heights of points within a radius of places (k, 2)."""
        rows = self._tree.query_ball_point(xy, radius)
        return self.height[np.unique(np.concatenate([*rows, []]).astype(np.int64))]


def _clusters(xy: Float, *, settings: DetectorSettings) -> Ints:
    """Number (n,) of the cluster of each cell."""
    link = settings.link[0] + settings.link[1] * np.hypot(*xy.T)
    groups = _linked(xy, link)
    if not len(xy):
        return groups
    count = int(groups.max()) + 1
    span = np.array([np.ptp(xy[groups == k], axis=0).max() for k in range(count)])
    again = (span > 6.0)[groups]
    if again.any():
        groups[again] = count + _linked(xy[again], link[again] / 2)
        groups = np.unique(groups, return_inverse=True)[1]
    return groups


def _linked(xy: Float, link: Float) -> Ints:
    """Connected components (n,) of places (n, 2) that are linked within the smaller of their distances."""
    if not len(xy):
        return np.empty(0, np.int64)
    pairs = cKDTree(xy).query_pairs(float(link.max()), output_type="ndarray")
    apart = np.linalg.norm(xy[pairs[:, 0]] - xy[pairs[:, 1]], axis=1)
    pairs = pairs[apart <= np.minimum(link[pairs[:, 0]], link[pairs[:, 1]])]
    graph = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(xy), len(xy)))
    number: Ints = connected_components(graph, directed=False)[1].astype(np.int64)
    return number


@dataclass(frozen=True, slots=True)
class _Shape:
    """Measures of a cluster, in metres.

    seen   : its rectangle, of the middles of its cells
    cells  : number of its cells
    sides  : the longer and the shorter side of the rectangle, cells included
    top    : height of its points above the ground, but for 2 % of them
    bottom : of its lowest point
    above  : share of the points at its place that follow above the clustered heights; what hangs higher
             over it, such as a tree's crown, does not count
    roof   : height of all points at its place, but for 2 % of them
    distance : from the sensor
    across : cosine between its longer side and the line of sight, 0 for one that is seen from the side
    """

    seen: Rectangle
    cells: int
    sides: tuple[float, float]
    top: float
    bottom: float
    above: float
    roof: float
    distance: float
    across: float

    @property
    def standing(self) -> float:
        """0 to 1 by the gap to the ground, in which no beam may have hit it."""
        return _ramp(-(self.bottom - _SPACING * self.distance), -0.7, -0.4)


def _shape(height: Float, middle: Float, *, tall: _Tall, settings: DetectorSettings) -> _Shape:
    seen = fitted(middle)
    distance = float(np.hypot(*seen.centre))
    around = tall.near(middle, radius=0.25)
    following = around[around < settings.band[1] + 0.5 + _SPACING * distance]
    return _Shape(
        seen,
        len(middle),
        (seen.size[0] + settings.cell, seen.size[1] + settings.cell),
        top=float(np.quantile(height, 0.98)),
        bottom=float(height.min()),
        above=np.count_nonzero(following > settings.band[1]) / max(len(following), 1),
        roof=float(np.quantile(around, 0.98)),
        distance=distance,
        across=_aspect(seen),
    )


def _judged(shape: _Shape, *, floor: float, settings: DetectorSettings) -> _Found:
    """What a cluster most likely is, with the score of the rules.

    floor : z of the ground below it
    """
    seen, (length, width) = shape.seen, shape.seen.size
    person = Rectangle(seen.centre, (max(length, 0.5), max(width, 0.5)), seen.yaw, seen.edge)
    cycle = Rectangle(seen.centre, (max(length, 1.7), max(width, 0.6)), seen.yaw, seen.edge)
    vehicle = completed(seen, length=settings.length, width=settings.width)
    choices = [
        _Found(person, (floor, floor + shape.top), _as_person(shape), "person"),
        _Found(cycle, (floor, floor + shape.top), _as_cycle(shape), "cycle"),
        _Found(vehicle, (floor, floor + shape.top), _as_car(shape), "vehicle"),
        _Found(vehicle, (floor, floor + shape.roof), _as_truck(shape), "vehicle"),
    ]
    return max(choices, key=lambda choice: choice.score)


def _as_person(shape: _Shape) -> float:
    """0 to 1: narrow, of a person's height, and nothing above, as over a pole or a trunk."""
    side = _ramp(-shape.sides[0], -1.3, -1.0) * _ramp(shape.sides[0], 0.1, 0.4)
    few = _ramp(shape.cells, 1, 6)
    return few * shape.standing * side * _ramp(shape.top, 1.1, 1.45) * _ramp(-shape.above, -0.15, -0.01)


def _as_cycle(shape: _Shape) -> float:
    """0 to 1: as a person, but longer along the line of sight; one seen from the side is as wide as a car."""
    side = (
        _ramp(-shape.sides[0], -2.5, -2.1)
        * _ramp(shape.sides[0], 1.1, 1.4)
        * _ramp(-shape.sides[1], -1.0, -0.8)
    )
    upright = _ramp(shape.top, 1.2, 1.5) * _ramp(-shape.top, -2.1, -1.9) * _ramp(-shape.above, -0.15, -0.01)
    return _ramp(shape.cells, 1, 8) * shape.standing * side * upright * _ramp(shape.across, 0.4, 0.7)


def _as_car(shape: _Shape) -> float:
    """0 to 1: of a car's or van's length, width and height, with points along two edges and nothing above."""
    length, width = shape.sides
    size = _ramp(-length, -6.4, -5.4) * _ramp(length, 0.9, 1.5) * _ramp(-width, -2.6, -2.1)
    return _many(shape) * size * _ramp(shape.top, 0.8, 1.2) * _ramp(-shape.above, -0.05, 0.0) * _edge(shape)


def _as_truck(shape: _Shape) -> float:
    """0 to 0.6: of a truck's or bus's size; so are some walls, if one side is seen."""
    length, width = shape.sides
    size = _ramp(length, 1.8, 2.4) * _ramp(-length, -14.0, -12.0) * _ramp(-width, -3.4, -2.8)
    high = _ramp(shape.roof, 2.0, 2.5) * _ramp(-shape.roof, -4.5, -3.6)
    return 0.6 * _many(shape) * size * high * _edge(shape) * _ramp(width, -1.0, 1.2)


def _many(shape: _Shape) -> float:
    """0 to 1 by the number of cells and, as a single beam tells little, by the heights that they span."""
    return (
        shape.standing * _ramp(shape.cells, 2, 12) * (0.5 + 0.5 * _ramp(shape.top - shape.bottom, 0.1, 0.5))
    )


def _edge(shape: _Shape) -> float:
    return _ramp(-shape.seen.edge, -0.7, -0.4)


def _apart(found: list[_Found]) -> list[_Found]:
    """The objects, best first, without those whose middle is in a better one: parts of it."""
    kept: list[_Found] = []
    for one in sorted(found, key=lambda one: -one.score):
        middle = np.append(one.rectangle.centre, 0.0)[None]
        flat = [
            (np.append(k.rectangle.centre, 0.0), np.array([*k.rectangle.size, 1.0]), k.rectangle.yaw)
            for k in kept
        ]
        if not any(inside(middle, centre, size=size, yaw=yaw)[0] for centre, size, yaw in flat):
            kept.append(one)
    return kept


def _aspect(seen: Rectangle) -> float:
    """Cosine between the axis of a rectangle and the line of sight, 0 for one that is seen from the side."""
    towards = seen.centre / max(float(np.hypot(*seen.centre)), 1e-9)
    return float(abs(towards @ [np.cos(seen.yaw), np.sin(seen.yaw)]))


def _ramp(value: float, low: float, high: float) -> float:  # noqa: PLR0917 - as np.interp
    """0 up to ``low``, 1 from ``high``, linear between."""
    return min(max((value - low) / (high - low), 0.0), 1.0)


def _table(found: list[_Found], xyz: Float) -> Detections:
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

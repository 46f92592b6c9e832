"""A detector of road users without learning: ground removal, clustering, box fit, rules of size and count."""

from __future__ import annotations

from dataclasses import dataclass

from lidar.tools.detection.clusters import PLAIN, WALL, ClusterShape, DetectorSettings, find_clusters, ramp
from lidar.tools.detection.detector import (
    CloudPoints,
    DetectedObject,
    Detections,
    Rectangle,
    apart,
    complete_rectangle,
    table,
)


@dataclass(frozen=True, slots=True)
class Rules:
    """Rule-based detector of road users."""

    settings: DetectorSettings = PLAIN
    name: str = "rules"
    identity: str = "rules"

    def detect(self, cloud: CloudPoints) -> Detections:
        """Road users in a cloud."""
        return detect(cloud, settings=self.settings)


RULES = Rules()


def detect(cloud: CloudPoints, *, settings: DetectorSettings = PLAIN) -> Detections:
    """Road users in the point cloud of one turn of an upright scanner on a vehicle.

    Each cluster gets a rectangle; its size, its height, the share of points above it and the number of cells
    give the score by rules.
    """
    scan = find_clusters(cloud, settings=settings)
    found = [_judge(one.shape, floor=one.floor, settings=settings) for one in scan.clusters]
    return table(apart([one for one in found if one.score >= settings.certain]), scan.xyz)


def _judge(shape: ClusterShape, *, floor: float, settings: DetectorSettings) -> DetectedObject:
    """Most likely class of a cluster, with the score of the rules.

    floor : z of the ground below it
    """
    seen, (length, width) = shape.seen, shape.seen.size
    person = Rectangle(seen.centre, (max(length, 0.5), max(width, 0.5)), seen.yaw, seen.edge)
    cycle = Rectangle(seen.centre, (max(length, 1.7), max(width, 0.6)), seen.yaw, seen.edge)
    vehicle = complete_rectangle(seen, length=settings.length, width=settings.width)
    choices = [
        DetectedObject(person, (floor, floor + shape.top), _as_person(shape), "person"),
        DetectedObject(cycle, (floor, floor + shape.top), _as_cycle(shape), "cycle"),
        DetectedObject(vehicle, (floor, floor + shape.top), _as_car(shape), "vehicle"),
        DetectedObject(vehicle, (floor, floor + shape.roof), _as_truck(shape), "vehicle"),
    ]
    return max(choices, key=lambda choice: choice.score)


def _as_person(shape: ClusterShape) -> float:
    """0 to 1: narrow, of a person's height, and nothing above, as over a pole or a trunk."""
    side = ramp(-shape.sides[0], -1.3, -1.0) * ramp(shape.sides[0], 0.1, 0.4)
    few = ramp(shape.cells, 1, 6)
    return few * shape.standing * side * ramp(shape.top, 1.1, 1.45) * ramp(-shape.above, -0.15, -0.01)


def _as_cycle(shape: ClusterShape) -> float:
    """Score of a cyclist, 0 to 1: as a person, but longer along the line of sight."""
    side = (
        ramp(-shape.sides[0], -2.5, -2.1) * ramp(shape.sides[0], 1.1, 1.4) * ramp(-shape.sides[1], -1.0, -0.8)
    )
    upright = ramp(shape.top, 1.2, 1.5) * ramp(-shape.top, -2.1, -1.9) * ramp(-shape.above, -0.15, -0.01)
    return ramp(shape.cells, 1, 8) * shape.standing * side * upright * ramp(shape.across, 0.4, 0.7)


def _as_car(shape: ClusterShape) -> float:
    """0 to 1: of a car's or van's length, width and height, with points along two edges and nothing above."""
    length, width = shape.sides
    size = ramp(-length, -6.4, -5.4) * ramp(length, 0.9, 1.5) * ramp(-width, -2.6, -2.1)
    high = ramp(shape.top, 0.8, 1.2) * (_alone(shape) if shape.top > WALL else 1.0)
    return _many(shape) * size * high * ramp(-shape.above, -0.05, 0.0) * _edge(shape)


def _as_truck(shape: ClusterShape) -> float:
    """0 to 0.6: of a truck's or bus's size, and in no line that is longer; so are some walls."""
    length, width = shape.sides
    size = ramp(length, 1.8, 2.4) * ramp(-width, -3.4, -2.8)
    high = ramp(shape.roof, 2.0, 2.5) * ramp(-shape.roof, -4.5, -3.6)
    return 0.6 * _many(shape) * size * high * _alone(shape) * _edge(shape) * ramp(width, -1.0, 1.2)


def _many(shape: ClusterShape) -> float:
    """Score 0 to 1 by the number of cells and by the height that they span."""
    return shape.standing * ramp(shape.cells, 2, 12) * (0.5 + 0.5 * ramp(shape.top - shape.bottom, 0.1, 0.5))


def _alone(shape: ClusterShape) -> float:
    """0 to 1: no longer than a bus, and in no line of walls that is."""
    return ramp(-max(shape.line, shape.sides[0]), -14.0, -12.0)


def _edge(shape: ClusterShape) -> float:
    return ramp(-shape.seen.edge, -0.7, -0.4)

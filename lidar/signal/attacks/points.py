"""Changes of recorded clouds by whoever handles the data: perturbed, inserted, deleted and moved returns."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.typing import Float, Ints
from lidar.parameters import parameter
from lidar.sensors.laser.cloud import TracedCloud
from lidar.sensors.physics.origin import Origin
from lidar.signal.situation import Situation
from lidar.signal.stage import LABELS, Stage

_LEAST = 10
"""Returns of a road user that counts as a target."""

_SKIN = 0.1
"""Metres in front of a surface within which an inserted return replaces that of the surface."""


@dataclass(frozen=True)
class Tampering(Stage):
    """Changes of recorded data between two times; budget: a number of returns a frame."""

    points: int = parameter(0, "most returns a frame, drawn at random; 0: all", low=0, high=10_000_000)
    start: float = parameter(0.0, "time since the drive's start from which data are changed", unit="s", low=0)
    stop: float = parameter(
        inf, "time since the drive's start until which data are changed", unit="s", low=0, endless="never"
    )

    def is_on(self, at: Situation) -> bool:
        """Whether data of a frame are changed."""
        return self.start <= at.start_ns / 1e9 < self.stop

    def chosen(self, rows: Ints, *, rng: np.random.Generator) -> Ints:
        """The rows (k,) that the budget allows, in order."""
        if not self.points or len(rows) <= self.points:
            return rows
        return np.sort(rng.choice(rows, self.points, replace=False))


@dataclass(frozen=True)
class Region(Tampering):
    """A box in the sensor frame, or the nearest road user."""

    distance: float = parameter(
        10.0, "distance from the sensor to the middle of the box", unit="m", low=0, high=500
    )
    bearing: float = parameter(
        0.0, "bearing of that, from forward to the left", unit="degrees", low=-360, high=360
    )
    height: float = parameter(-1.0, "height of that above the sensor", unit="m", low=-50, high=50)
    long: float = parameter(4.5, "length of the box along the bearing", unit="m", low=0.01, high=500)
    wide: float = parameter(1.8, "width of the box across it", unit="m", low=0.01, high=500)
    high: float = parameter(1.5, "height of the box", unit="m", low=0.01, high=500)

    @property
    def middle(self) -> Float:
        """Middle (3,) of the box in the sensor frame, metres."""
        bearing = np.radians(self.bearing)
        return np.array([self.distance * np.cos(bearing), self.distance * np.sin(bearing), self.height])

    def in_box_axes(self, vectors: NDArray[np.floating]) -> Float:
        """Vectors (n, 3) of the sensor frame in the axes of the box: along the bearing, to the left, up."""
        c, s = np.cos(np.radians(self.bearing)), np.sin(np.radians(self.bearing))
        turned: Float = vectors.astype(np.float64) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return turned

    @property
    def half(self) -> Float:
        """Half of the box's lengths (3,) along its axes, metres."""
        return np.array([self.long, self.wide, self.high]) / 2


@dataclass(frozen=True)
class TargetReturns(Region):
    """Returns to change: those in a box, or of the nearest road user."""

    target: str = parameter(
        "box", "returns in the box, or of the nearest road user", among=("box", "road_user")
    )

    @property
    def requires(self) -> tuple[str, ...]:
        """Labels, by which road users are known."""
        return (LABELS,) if self.target == "road_user" else ()

    def rows(self, cloud: TracedCloud, *, rng: np.random.Generator) -> Ints:
        """The returns (k,) to change; those of a road user are known by their labels."""
        if self.target == "box":
            inside = (np.abs(self.in_box_axes(cloud.xyz - self.middle)) <= self.half).all(axis=1)
            return self.chosen(np.flatnonzero(inside), rng=rng)
        return self.chosen(_nearest_road_user(cloud), rng=rng)


def _nearest_road_user(cloud: TracedCloud) -> Ints:
    """Returns (k,) of the road user nearest to the sensor; none without one of `_LEAST` returns."""
    on = np.flatnonzero(
        (cloud.klass >= Class.CAR) & (cloud.klass <= Class.MOTORCYCLIST) & (cloud.feature >= 0)
    )
    users, user, count = np.unique(cloud.feature[on], return_inverse=True, return_counts=True)
    near = np.full(len(users), np.inf)
    np.minimum.at(near, user, cloud.range[on])
    near[count < _LEAST] = np.inf
    if not len(users) or not np.isfinite(near).any():
        return np.empty(0, np.int64)
    rows: Ints = on[user == np.argmin(near)]
    return rows


@dataclass(frozen=True)
class Perturb(Tampering):
    """Returns are shifted at random, by at most a bound."""

    bound: float = parameter(0.1, "greatest shift of a return", unit="m", low=0, high=10)
    share: float = parameter(1.0, "share of the returns", low=0, high=1)
    how: str = parameter("ball", "to all sides, or along the beam", among=("ball", "beam"))

    def cloud(self, cloud: TracedCloud, *, at: Situation, rng: np.random.Generator) -> TracedCloud:
        """The cloud with shifted returns."""
        if not self.is_on(at) or not len(cloud):
            return cloud
        rows = self.chosen(np.flatnonzero(rng.random(len(cloud)) < self.share), rng=rng)
        way = cloud.xyz[rows].astype(np.float64)
        way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
        far = self.bound * rng.uniform(-1, 1, (len(rows), 1))
        if self.how == "ball":
            way = rng.normal(size=(len(rows), 3))
            way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
            far = self.bound * np.cbrt(rng.random((len(rows), 1)))
        return _move(cloud, rows, xyz=cloud.xyz[rows] + far * way)


@dataclass(frozen=True)
class Delete(TargetReturns):
    """Returns in a box, or of the nearest road user, are deleted."""

    def cloud(self, cloud: TracedCloud, *, at: Situation, rng: np.random.Generator) -> TracedCloud:
        """The cloud without them."""
        keep = np.ones(len(cloud), bool)
        if self.is_on(at):
            keep[self.rows(cloud, rng=rng)] = False
        return cloud.where(keep)


@dataclass(frozen=True)
class Move(TargetReturns):
    """Returns in a box, or of the nearest road user, are shifted together and turned about their middle."""

    ahead: float = parameter(0.0, "shift forward", unit="m", low=-500, high=500)
    left: float = parameter(3.0, "shift to the left", unit="m", low=-500, high=500)
    up: float = parameter(0.0, "shift upwards", unit="m", low=-50, high=50)
    turn: float = parameter(0.0, "turn to the left", unit="degrees", low=-360, high=360)

    def cloud(self, cloud: TracedCloud, *, at: Situation, rng: np.random.Generator) -> TracedCloud:
        """The cloud with the returns at the other place; no shadow moves with them."""
        rows = self.rows(cloud, rng=rng) if self.is_on(at) else np.empty(0, np.int64)
        if not len(rows):
            return cloud
        xyz = cloud.xyz[rows].astype(np.float64)
        c, s = np.cos(np.radians(self.turn)), np.sin(np.radians(self.turn))
        middle = xyz.mean(axis=0)
        xyz = (xyz - middle) @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + middle
        return _move(cloud, rows, xyz=xyz + np.array([self.ahead, self.left, self.up]))


@dataclass(frozen=True)
class Insert(Region):
    """Insert returns on a box where beams with a return intersect it."""

    noise: float = parameter(0.02, "standard deviation of their ranges", unit="m", low=0, high=1)
    intensity: float = parameter(40.0, "of them", low=0, high=255)
    replaces: bool = parameter(True, "the returns behind are deleted: the box casts a shadow")

    def cloud(self, cloud: TracedCloud, *, at: Situation, rng: np.random.Generator) -> TracedCloud:
        """The cloud with them, in the order of pulses."""
        if not self.is_on(at) or not len(cloud):
            return cloud
        away = np.linalg.norm(cloud.xyz.astype(np.float64), axis=1)
        enters = self._enters(cloud.xyz / np.maximum(away, 1e-9)[:, None])
        rows = self.chosen(np.flatnonzero(enters + _SKIN < away), rng=rng)
        distance = np.maximum(enters[rows] + self.noise * rng.standard_normal(len(rows)), 0.1)
        added = _false_returns(cloud, rows, distance=distance, intensity=self.intensity)
        if self.replaces:
            return _replace_returns(cloud, rows, added=added)
        order = np.argsort(np.append(np.arange(len(cloud)), rows), kind="stable")
        return TracedCloud.concatenate([cloud, replace(added, hidden=np.full(len(rows), -1, np.int32))]).take(
            order
        )

    def _enters(self, way: NDArray[np.floating]) -> Float:
        """Distance (n,) at which beams with unit vectors (n, 3) enter the box; inf for none."""
        begin, way = self.in_box_axes(-self.middle[None]), self.in_box_axes(way)
        slope = np.where(np.abs(way) < 1e-12, 1e-12, way)
        first, last = (-self.half - begin) / slope, (self.half - begin) / slope
        near, far = np.minimum(first, last).max(axis=1), np.maximum(first, last).min(axis=1)
        return np.where((near <= far) & (near > 0), near, np.inf)


@dataclass(frozen=True)
class FalseWeather(Tampering):
    """Returns are replaced by near ones at random ranges, to look like fog or rain."""

    share: float = parameter(0.1, "share of the returns", low=0, high=1)
    nearest: float = parameter(1.5, "least range", unit="m", low=0.1, high=100)
    mean: float = parameter(
        6.0, "mean range beyond that; exponentially distributed", unit="m", low=0.1, high=200
    )
    intensity: float = parameter(3.0, "mean of their intensities", low=0, high=255)

    def cloud(self, cloud: TracedCloud, *, at: Situation, rng: np.random.Generator) -> TracedCloud:
        """The cloud with them; those that would be behind the genuine return are left out."""
        if not self.is_on(at):
            return cloud
        hit = rng.random(len(cloud)) < self.share
        distance = self.nearest + rng.exponential(self.mean, len(cloud))
        bright = np.minimum(rng.exponential(max(self.intensity, 1e-9), len(cloud)), 255)
        rows = self.chosen(np.flatnonzero(hit & (distance < cloud.range)), rng=rng)
        added = _false_returns(cloud, rows, distance=distance[rows], intensity=bright[rows])
        return _replace_returns(cloud, rows, added=added)


def _move(cloud: TracedCloud, rows: Ints, *, xyz: NDArray[np.floating]) -> TracedCloud:
    """The cloud with returns at other places (k, 3); their ranges change as their distances do."""
    before = np.linalg.norm(cloud.xyz[rows].astype(np.float64), axis=1)
    moved, distance, origin = cloud.xyz.copy(), cloud.range.copy(), cloud.origin.copy()
    moved[rows] = xyz
    distance[rows] += np.linalg.norm(moved[rows].astype(np.float64), axis=1) - before
    origin[rows] = Origin.MOVED
    return replace(cloud, xyz=moved, range=distance, origin=origin)


def _false_returns(
    cloud: TracedCloud, rows: Ints, *, distance: Float, intensity: float | Float
) -> TracedCloud:
    """Returns of nothing on the beams of others (k,), which they hide."""
    twin = cloud.take(rows)
    xyz = twin.xyz.astype(np.float64)
    xyz *= (distance / np.maximum(np.linalg.norm(xyz, axis=1), 1e-9))[:, None]
    k = len(rows)
    return replace(
        twin,
        xyz=xyz.astype(np.float32),
        range=distance,
        intensity=np.full(k, intensity, np.float32),
        klass=np.full(k, Class.NOISE, np.uint8),
        feature=np.full(k, -1, np.int32),
        incidence=np.zeros(k, np.float32),
        true_range=np.zeros(k),
        origin=np.full(k, Origin.INJECTED, np.uint8),
        source=np.full(k, -1, np.int32),
        hidden=np.where(twin.source >= 0, twin.source, twin.hidden),
    )


def _replace_returns(cloud: TracedCloud, rows: Ints, *, added: TracedCloud) -> TracedCloud:
    """The cloud with other returns in the place of some."""
    row = np.arange(len(cloud))
    row[rows] = len(cloud) + np.arange(len(rows))
    return TracedCloud.concatenate([cloud, added]).take(row)

"""Boxes that rays pass (CARLO), with returns in their shadow (Shadow-Catcher), or that appear (3D-TC2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.parameters import parameter
from lidar.tools.defences.defence import Defence, Verdict, Window, of_boxes
from lidar.tools.defences.observation import Observation

_LAGS = (1, 2, 3, 5, 8)
"""Frames back that are compared."""
_MOST = 40
"""Returns of an object that are compared."""
_FEWEST = 0.2
"""Share of an object's returns that an earlier frame must have looked at to count."""
_SPREAD = 0.02
"""Metres per metre of distance by which neighbouring returns are apart."""
_SIDEWAYS = (0.0, -1.5, 1.5)
"""Speeds in m/s across the box that are tried, as of pedestrians."""


@dataclass(frozen=True, slots=True)
class Crossings:
    """Rays of returns that cross a box.

    rows        : (k,) of the returns
    enter, leave : (k,) metres along the ray
    """

    rows: NDArray[np.intp]
    enter: Float
    leave: Float


def axes_of(yaw: float) -> Float:
    """Rotation (3, 3) from the sensor frame to the axes of a box."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def crossings(frame: Observation, row: int, *, shrink: float = 1.0) -> Crossings:
    """The rays to returns that cross a box, or its middle part.

    shrink : size of that part over the size of the box
    """
    objects = frame.objects
    half, center = shrink * objects.size[row] / 2, objects.centre[row]
    away = float(np.linalg.norm(center))
    toward = center / max(away, 1e-9)
    radius = float(np.linalg.norm(half))
    spread = np.arcsin(min(radius / max(away, radius + 1e-6), 1.0))
    rows = np.flatnonzero(frame.direction @ toward >= np.cos(min(spread + 0.01, np.pi)))
    turn = axes_of(float(objects.yaw[row]))
    start, along = turn @ -center, frame.direction[rows] @ turn.T
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (-half - start) / along, (half - start) / along
    enter = np.minimum(one, other).max(axis=1)
    leave = np.maximum(one, other).min(axis=1)
    hit = (enter < leave) & (enter > 0)
    return Crossings(rows[hit], enter[hit], leave[hit])


@dataclass(frozen=True)
class Occlusion(Defence):
    """Boxes that rays pass through, and their free space (CARLO: Sun et al. 2020)."""

    valid: float = parameter(0.05, "share of rays behind a box up to which it is genuine", low=0, high=1)
    spoofed: float = parameter(0.15, "share of rays behind a box from which it is forged", low=0, high=1)
    cell: float = parameter(0.25, "size of the voxels of free space", unit="m", low=0.05, high=2)
    core: float = parameter(0.8, "part of the box that rays must cross, of its size", low=0.1, high=1)

    def judge(self, window: Window) -> Verdict:
        """Judge the boxes of the last frame."""
        frame = window.frame
        return of_boxes(frame, [self._suspicion(frame, row) for row in range(len(frame.objects))])

    def _suspicion(self, frame: Observation, row: int) -> float:
        """Laser penetration decides where it is clear; free space decides between the two bounds."""
        crossed = crossings(frame, row, shrink=self.core)
        if not len(crossed.rows):
            return 0.0
        away = frame.distance[crossed.rows]
        behind = away > crossed.leave + 0.1
        penetration = float(behind.mean())
        free = self._free_share(frame, row, crossed=crossed)
        low, high = self.valid, max(self.spoofed, self.valid + 1e-6)
        certain = np.clip((penetration - low) / (high - low), 0.0, 1.0)
        # 0 to 0.25 where penetration says genuine, 0.75 to 1 where it says forged.
        between = 0.25 + 0.5 * (0.5 * free + 0.5 * certain)
        if penetration <= low:
            return 0.25 * free
        return float(0.75 + 0.25 * max(penetration, free)) if penetration >= high else float(between)

    def _free_share(self, frame: Observation, row: int, *, crossed: Crossings) -> float:
        """Share of the voxels of a box that rays pass and that no return is in."""
        box = frame.objects
        turn, size, center = axes_of(float(box.yaw[row])), box.size[row], box.centre[row]
        shape = np.maximum(np.ceil(size / self.cell), 1).astype(int)
        passed, filled = np.zeros(shape, bool), np.zeros(shape, bool)

        def mark(grid: NDArray[np.bool_], points: Float) -> None:
            local = (points - center) @ turn.T / size + 0.5
            inside = ((local >= 0) & (local < 1)).all(axis=1)
            grid[tuple((local[inside] * shape).astype(int).T)] = True

        rows = crossed.rows
        stop = np.minimum(crossed.leave, frame.distance[rows] - self.cell / 2)
        steps = int(np.ceil(2 * float(np.linalg.norm(size)) / self.cell))
        along = crossed.enter[:, None] + (np.arange(steps) + 0.5) * self.cell / 2
        ray, step = np.nonzero(along < stop[:, None])
        mark(passed, frame.direction[rows[ray]] * along[ray, step][:, None])
        mark(filled, frame.xyz[rows])
        return float((passed & ~filled).mean())


@dataclass(frozen=True)
class Shadow(Defence):
    """Returns in the shadow that an object casts (Shadow-Catcher: Hau et al. 2020)."""

    falloff: float = parameter(
        1.5, "exponent with which returns count less towards the shadow's end and sides", low=0, high=10
    )
    length: float = parameter(15.0, "greatest length of a shadow", unit="m", low=1, high=100)
    margin: float = parameter(
        0.3, "distance behind the object at which its shadow begins", unit="m", low=0, high=5
    )

    def judge(self, window: Window) -> Verdict:
        """Judge the boxes of the last frame."""
        frame = window.frame
        return of_boxes(frame, [self._suspicion(frame, row) for row in range(len(frame.objects))])

    def _suspicion(self, frame: Observation, row: int) -> float:
        """Weight of the returns in the shadow over that of all within the object's outline."""
        body = frame.members[row]
        if len(body) < 3:
            return 0.0
        center = float(np.arctan2(*frame.xyz[body, 1::-1].mean(axis=0)))
        side = _turn(frame.azimuth - center)
        left, right = side[body].min(), side[body].max()
        slope = frame.xyz[:, 2] / np.maximum(np.hypot(*frame.xyz[:, :2].T), 1e-6)
        low, high = slope[body].min(), slope[body].max()
        within = (side > left) & (side < right) & (slope > low) & (slope < high)
        level = np.hypot(*frame.xyz[:, :2].T)
        behind = level - float(level[body].max())
        dark = within & (behind > self.margin) & (behind < self.length)
        stopped = within & ~dark & (behind <= self.margin)
        half = max((right - left) / 2, 1e-6)
        aside = np.abs(side - (left + right) / 2) / half
        weight = np.exp(-self.falloff * (aside + np.clip(behind, 0, None) / self.length))
        inside = float(weight[dark].sum())
        total = inside + float(weight[stopped].sum())
        return inside / total if total else 0.0


def _turn(angle: Float) -> Float:
    """Angles within -pi to pi."""
    wrapped: Float = (angle + np.pi) % (2 * np.pi) - np.pi
    return wrapped


@dataclass(frozen=True)
class Temporal(Defence):
    """Objects without occupancy in earlier frames, moved by the vehicle's poses (3D-TC2: You et al. 2021)."""

    history: ClassVar[int] = max(_LAGS)

    near: float = parameter(0.35, "distance of a return that supports another", unit="m", low=0.05, high=5)
    acceleration: float = parameter(
        3.0, "acceleration of objects, which widens the distance with time", unit="m/s^2", low=0, high=20
    )
    speed: float = parameter(25.0, "greatest speed of objects that is tried", unit="m/s", low=0, high=100)
    step: float = parameter(1.0, "step of the speeds that are tried", unit="m/s", low=0.1, high=10)

    def judge(self, window: Window) -> Verdict:
        """Judge the boxes of the last frame by the others."""
        frame = window.frame
        numbers = {past.number: past for past in window.frames[:-1]}
        earlier = [numbers[frame.number - lag] for lag in _LAGS if frame.number - lag in numbers]
        rows = range(len(frame.objects))
        return of_boxes(frame, [self._suspicion(frame, k, earlier=earlier, rng=window.rng) for k in rows])

    def _suspicion(
        self, frame: Observation, row: int, *, earlier: Sequence[Observation], rng: np.random.Generator
    ) -> float:
        """1 less the support of the best motion: the share of returns that earlier frames have where it was.

        Places that an earlier frame did not look at do not count, nor motions through many of them.
        """
        body = frame.members[row]
        if len(body) > _MOST:
            body = np.sort(rng.choice(body, _MOST, replace=False))
        if len(body) < 3 or not earlier:
            return 0.0
        place = frame.scene_xyz[body]
        velocity = self._velocities(frame, row)
        support = np.zeros(len(velocity))
        counted = np.zeros(len(velocity))
        for past in earlier:
            seconds = (frame.start_ns - past.start_ns) / 1e9
            moved = place[None] - seconds * velocity[:, None]
            limit = self.near + _SPREAD * frame.distance[body] + self.acceleration * seconds**2 / 2
            filled, free = looked_at(past, moved.reshape(-1, 3), limit=np.tile(limit, len(velocity)))
            filled, free = (part.reshape(len(velocity), -1).sum(axis=1) for part in (filled, free))
            seen = filled + free
            counts = seen >= _FEWEST * len(body)
            support += np.where(counts, filled / np.maximum(seen, 1), 0)
            counted += counts
        if not counted[0]:  # as it stands, nothing is known of its place
            return 0.0
        # Motions out of what the object itself hides would excuse all: they must be seen as often as others.
        seen_enough = counted >= max(counted.max() - 1, 1)
        return float(1 - (support[seen_enough] / counted[seen_enough]).max())

    def _velocities(self, frame: Observation, row: int) -> Float:
        """Velocities (k, 3) in the scene that a box may have, standing still first."""
        speeds = np.arange(0, self.speed + 1e-9, self.step)
        speeds = np.concatenate([speeds, -speeds[1:]])
        along, across = np.meshgrid(speeds, _SIDEWAYS, indexing="ij")
        pose = frame.poses([frame.start_ns])
        c, s = np.cos(frame.objects.yaw[row]), np.sin(frame.objects.yaw[row])
        axes = pose.directions(np.array([[c, s, 0.0], [-s, c, 0.0]]))
        found: Float = along.ravel()[:, None] * axes[0] + across.ravel()[:, None] * axes[1]
        return found


def looked_at(
    past: Observation, place: Float, *, limit: Float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Whether an earlier frame has a return near places (n, 3) in the scene, and whether it looked past them.

    limit : (n,) metres
    """
    filled = past.obstacles.query(place, distance_upper_bound=float(limit.max()) + 1e-9)[0] <= limit
    pose = past.poses([past.start_ns])
    local = ((place - pose.position) / pose.scale) @ pose.rotation[0]
    away = np.linalg.norm(local, axis=1)
    return filled, ~filled & (past.depth_towards(local) > away + 2 * limit)

"""Returns behind reported solid objects: laser penetration and free space (CARLO)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.parameters import parameter
from lidar.tools.defences.defence import Defence, Window
from lidar.tools.defences.observation import Observation
from lidar.tools.defences.verdict import Verdict, of_objects


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
        objects = np.array([self._suspicion(frame, row) for row in range(len(frame.objects))])
        return of_objects(len(frame), frame.members, objects=objects)

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

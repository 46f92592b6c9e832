"""Objects that earlier frames do not support (3D-TC2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.parameters import parameter
from lidar.tools.defences.defence import Defence, Window
from lidar.tools.defences.observation import Observation
from lidar.tools.defences.verdict import Verdict, of_objects

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
        objects = np.array([self._suspicion(frame, k, earlier=earlier, rng=window.rng) for k in rows])
        return of_objects(len(frame), frame.members, objects=objects)

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

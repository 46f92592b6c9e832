"""Returns in the shadow of an object (Shadow-Catcher)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geoscene.typing import Float
from lidar.parameters import parameter
from lidar.tools.defences.defence import Defence, Window
from lidar.tools.defences.observation import Observation
from lidar.tools.defences.verdict import Verdict, of_objects


@dataclass(frozen=True)
class Shadow(Defence):
    """Returns in the shadow that an object casts (Shadow-Catcher: Hau et al. 2020)."""

    falloff: float = parameter(
        1.5,
        "exponent with which returns count less towards the shadow's end and sides",
        low=0,
        high=10,
    )
    length: float = parameter(15.0, "greatest length of a shadow", unit="m", low=1, high=100)
    margin: float = parameter(
        0.3, "distance behind the object at which its shadow begins", unit="m", low=0, high=5
    )

    def judge(self, window: Window) -> Verdict:
        """Judge the boxes of the last frame."""
        frame = window.frame
        objects = np.array([self._suspicion(frame, row) for row in range(len(frame.objects))])
        return of_objects(len(frame), frame.members, objects=objects)

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

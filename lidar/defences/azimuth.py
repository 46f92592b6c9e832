"""Sectors without the returns that the frames before and the sectors beside have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from geoscene.typing import Float, Ints
from lidar.defences.defence import Defence
from lidar.defences.observation import Observation
from lidar.defences.verdict import Gaps, Verdict
from lidar.signal.stage import parameter
from lidar.world.world import World

_SECTORS = 360
_RADIUS = 30.0
"""Metres from the sensor within which a gap is placed."""


@dataclass(frozen=True)
class Azimuth(Defence):
    """A sector that lacks returns which earlier frames or the sectors beside it have."""

    history: ClassVar[int] = 5

    width: float = parameter(4.0, "width of the sector, degrees", low=1, high=90)
    side: float = parameter(
        4.0, "width of the sectors beside it that must have returns, degrees", low=1, high=90
    )

    def judge(
        self, frames: Sequence[Observation], *, scene: World | None, rng: np.random.Generator
    ) -> Verdict:
        """Judge the last frame."""
        del scene, rng
        frame = frames[-1]
        fired, got = _counts(frame)
        share = got / np.maximum(fired, 1)
        beside = _beside(share, round(self.side), gap=round(self.width))
        expected = 0.5 * beside
        if len(frames) > 1:
            expected = np.maximum(expected, np.min([_turned(past, frame) for past in frames[:-1]], axis=0))
        # A sector that never has many returns, as towards the sky, tells nothing.
        lack = np.where(expected > 0.05, np.clip(1 - share / np.maximum(expected, 0.05), 0, 1), 0.0)
        weight = np.minimum(expected / 0.3, 1.0) * (fired > 0)
        sector = _running_mean(lack * weight, round(self.width))
        worst = int(np.argmax(sector))
        suspicion = float(np.clip(sector[worst], 0, 1))
        middle = np.radians(worst + 0.5 - 180)
        place = Gaps(
            np.array([[np.cos(middle), np.sin(middle)]]) * _RADIUS / 2,
            np.array([_RADIUS / 2]),
            np.array([suspicion]),
        )
        return Verdict(None, None, suspicion, place)


def _sector(azimuth: Float) -> Ints:
    sector: Ints = np.clip(np.degrees(azimuth) + 180, 0, _SECTORS - 1).astype(np.int64)
    return sector


def _counts(frame: Observation) -> tuple[Float, Float]:
    """Pulses that are fired and that have a return, by degree of azimuth."""
    direction = frame.firings.direction
    sector = _sector(np.arctan2(direction[:, 1], direction[:, 0]))
    has = np.ones(len(sector), bool)
    has[frame.empty] = False
    fired = np.bincount(sector, minlength=_SECTORS)
    return fired.astype(float), np.bincount(sector[has], minlength=_SECTORS).astype(float)


def _turned(past: Observation, frame: Observation) -> Float:
    """Shares of pulses with a return in an earlier frame, in the sectors that have its directions now.

    Each is the least of the sectors beside it, as the vehicle also moves.
    """
    fired, got = _counts(past)
    share = got / np.maximum(fired, 1)
    turns = [f.poses([f.start_ns]).rotation[0] for f in (past, frame)]
    back = turns[1].T @ turns[0]
    yaw = np.degrees(np.arctan2(back[1, 0], back[0, 0]))
    share = np.roll(share, round(float(yaw)))
    least: Float = np.min([np.roll(share, k) for k in (-2, -1, 0, 1, 2)], axis=0)
    return least


def _running_mean(values: Float, width: int) -> Float:
    """Mean over ``width`` sectors around each."""
    mean: Float = np.mean([np.roll(values, k - width // 2) for k in range(width)], axis=0)
    return mean


def _beside(share: Float, width: int, *, gap: int) -> Float:
    """The lesser of the mean shares of the sectors on both sides of each, a gap away."""
    mean = _running_mean(share, width)
    shift = gap // 2 + width // 2 + 1
    return np.minimum(np.roll(mean, shift), np.roll(mean, -shift))

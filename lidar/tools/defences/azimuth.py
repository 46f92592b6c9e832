"""Sectors without the returns that the rest of the turn and earlier frames let expect."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from geoscene.typing import Float
from lidar.parameters import parameter
from lidar.tools.defences.defence import Defence, Window
from lidar.tools.defences.observation import Observation
from lidar.tools.defences.verdict import Gaps, Verdict

_SECTORS = 360
_RADIUS = 30.0
"""Metres from the sensor within which a gap is placed."""
_ENOUGH = 0.3
"""Share of a sector's pulses of which a return is expected from which on its lack has full weight."""
_OPEN = 0.5
"""Share of a sector's expected returns that it may lack, as where buildings end: no suspicion up to it."""


@dataclass(frozen=True)
class Azimuth(Defence):
    """A sector that lacks returns which the rest of the turn or earlier frames have (Cao et al. 2023)."""

    history: ClassVar[int] = 5

    width: float = parameter(4.0, "width of the sector", unit="degrees", low=1, high=90)
    turn: float = parameter(
        0.35, "share of the turn that may lack a ring's returns, as towards side streets", low=0, high=0.9
    )

    def judge(self, window: Window) -> Verdict:
        """Judge the last frame."""
        frame = window.frame
        expected = self._of_turn(frame)
        if known := [self._of_earlier(past, frame) for past in window.frames[:-1]]:
            least = np.min(known, axis=0)
            expected = np.maximum(expected, np.where(np.isfinite(least), least, 0.0))
        sector = np.clip((self._lack(frame, expected) - _OPEN) / (1 - _OPEN), 0, 1)
        worst = int(np.argmax(sector))
        middle = np.radians(worst + 0.5 - 180)
        place = Gaps(
            np.array([[np.cos(middle), np.sin(middle)]]) * _RADIUS / 2,
            np.array([_RADIUS / 2]),
            sector[[worst]],
        )
        return Verdict(None, None, float(sector[worst]), place)

    def _of_turn(self, frame: Observation) -> Float:
        """Share of each ring's pulses (rings, 360) with a return that all but a part of the turn reaches."""
        fired, share = frame.answered
        least = np.nanquantile(np.where(fired > 0, share, np.nan), self.turn, axis=1, method="lower")
        return np.repeat(np.nan_to_num(least)[:, None], _SECTORS, axis=1)

    def _of_earlier(self, past: Observation, frame: Observation) -> Float:
        """Shares (rings, 360) in an earlier frame, in the sectors that have its directions now.

        Each is the least of the sectors beside it, as the vehicle also moves; infinite in sectors that lack
        returns in that frame itself.
        """
        lack = self._lack(past, self._of_turn(past)) > _OPEN
        reach = round(self.width) + 2
        suspect = np.any([np.roll(lack, k) for k in range(-reach, reach + 1)], axis=0)
        share = np.min([np.roll(past.answered[1], k, axis=1) for k in (-2, -1, 0, 1, 2)], axis=0)
        turns = [f.poses([f.start_ns]).rotation[0] for f in (past, frame)]
        back = turns[1].T @ turns[0]
        yaw = np.degrees(np.arctan2(back[1, 0], back[0, 0]))
        turned: Float = np.roll(np.where(suspect, np.inf, share), round(float(yaw)), axis=1)
        return turned

    def _lack(self, frame: Observation, expected: Float) -> Float:
        """Share (360,) of the expected returns that the sector around each degree lacks."""
        fired, share = frame.answered
        wanted = _around((fired * expected).sum(axis=0), round(self.width))
        lost = _around((fired * np.maximum(expected - share, 0)).sum(axis=0), round(self.width))
        whole = _around(fired.sum(axis=0), round(self.width))
        # A sector of which few returns are expected, as towards the sky, tells little.
        weight = np.minimum(wanted / np.maximum(_ENOUGH * whole, 1e-9), 1.0)
        return weight * lost / np.maximum(wanted, 1e-9)


def _around(values: Float, width: int) -> Float:
    """Sums over ``width`` sectors around each."""
    total: Float = np.sum([np.roll(values, k - width // 2) for k in range(width)], axis=0)
    return total

"""A cover glass that absorbs light."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidar.parameters import parameter
from lidar.sensors.physics.echoes import TracedEchoes
from lidar.signal.situation import Situation
from lidar.signal.stage import Pulses, Stage


@dataclass(frozen=True)
class CoverGlass(Stage):
    """A dirty or tinted cover glass attenuates the echoes of a sector, on both ways through it."""

    transmission: float = parameter(0.9, "share of the power that passes, one way", low=0, high=1)
    azimuth: float = parameter(
        0.0, "middle of the sector, from forward to the left", unit="degrees", low=-360, high=360
    )
    width: float = parameter(360.0, "width of the sector", unit="degrees", low=0, high=360)

    def echoes(
        self, pulses: Pulses, echoes: TracedEchoes, *, at: Situation, rng: np.random.Generator
    ) -> TracedEchoes:
        """The echoes with the power that is left."""
        del at, rng
        x, y = pulses.direction[echoes.pulse, :2].T
        off = (np.degrees(np.arctan2(y, x)) - self.azimuth + 180) % 360 - 180
        share = np.where(np.abs(off) <= self.width / 2, self.transmission**2, 1.0)
        return replace(echoes, apparent=echoes.apparent * share)

"""Data packets of a scanner that never arrive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidar.parameters import parameter
from lidar.sensors.laser.cloud import TracedCloud
from lidar.signal.situation import Situation
from lidar.signal.stage import Stage


@dataclass(frozen=True)
class DroppedPackets(Stage):
    """Packets of consecutive firings are lost, in bursts (Gilbert 1960, Elliott 1963).

    A two-state Markov chain from packet to packet, which starts each frame in its stationary distribution:
    its mean share of lost packets is ``loss``, and the mean length of a run of them is ``burst``.
    """

    loss: float = parameter(0.01, "share of packets that are lost", low=0, high=1)
    burst: float = parameter(1.0, "mean number of consecutive packets lost together", low=1, high=1e6)
    columns: int = parameter(
        24, "firing blocks (azimuth steps) a packet; 24 for a VLP-16", low=1, high=100_000
    )

    def cloud(self, cloud: TracedCloud, *, at: Situation, rng: np.random.Generator) -> TracedCloud:
        """The cloud without the returns of lost packets."""
        del at
        packet = cloud.column // self.columns
        recover = 1 / self.burst
        # A loss that the burst length cannot reach has the next packet lost for certain.
        fail = min(recover * self.loss / (1 - self.loss), 1.0) if self.loss < 1 else 1.0
        draws = rng.random(int(packet.max(initial=-1)) + 1)
        lost = np.empty(len(draws), bool)
        bad = False
        for k, draw in enumerate(draws):
            chance = self.loss if k == 0 else (1 - recover if bad and self.loss < 1 else fail)
            lost[k] = bad = bool(draw < chance)
        return cloud.where(~lost[packet])

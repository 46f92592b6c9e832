"""Relayed pulses: the sensor's own light, sent back with a delay."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidar.parameters import parameter
from lidar.sensors.physics.echoes import TracedEchoes
from lidar.sensors.physics.origin import Origin
from lidar.sensors.physics.pulse_identity import METRES_PER_NS
from lidar.signal.attacks.attacker import TimedAttacker, power_of, sent_back
from lidar.signal.situation import Situation
from lidar.signal.stage import Pulses


@dataclass(frozen=True)
class Relay(TimedAttacker):
    """Pulses of the sensor are sent back with a delay: returns behind the device (Petit 2015).

    They have the sensor's own code and firing time, so neither codes nor random delays of pulses hinder it.
    """

    delay: float = parameter(
        100.0, "time from receiving a pulse to sending it back", unit="ns", low=0, high=1e5
    )
    dimmest: float = parameter(0.3, "least apparent reflectance of a point", low=0, high=1)
    brightest: float = parameter(1.0, "greatest apparent reflectance of a point", low=0, high=1)
    share: float = parameter(1.0, "share of the pulses that are received and sent back", low=0, high=1)

    def echoes(
        self, pulses: Pulses, echoes: TracedEchoes, *, at: Situation, rng: np.random.Generator
    ) -> TracedEchoes:
        """The echoes with the relayed ones."""
        aim = self.aim(pulses, echoes, at=at)
        if aim is None:
            return echoes
        aim = self.spent(aim.where(rng.random(len(aim.row)) < self.share), rng=rng)
        distance = aim.distance + METRES_PER_NS * self.delay + self.errors(aim, rng=rng)
        reflectance = rng.uniform(self.dimmest, self.brightest, len(aim.row))
        power = np.minimum(power_of(pulses, reflectance, distance=distance), aim.power)
        return sent_back(pulses, echoes, row=aim.row, distance=distance, power=power, origin=Origin.REPLAYED)

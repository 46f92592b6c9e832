"""Returns replaced by those of a train of pulses that needs no synchronisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidar.parameters import parameter
from lidar.sensors.physics.echoes import TracedEchoes
from lidar.sensors.physics.origin import Origin
from lidar.sensors.physics.pulse_identity import METRES_PER_NS, has_code
from lidar.signal.attacks.attacker import DEVICES, Attacker, sent_back
from lidar.signal.attacks.remove import POWER_SPREAD
from lidar.signal.situation import Situation
from lidar.signal.stage import Pulses


@dataclass(frozen=True)
class HighFrequencyRemoval(Attacker):
    """A fast train of pulses, some of which arrive whenever the sensor listens (Sato 2024).

    A sensor with coded pulses accepts each of them with the probability that its code fits by chance.
    """

    device: str = parameter("pra_2023", "hardware, which limits points and angles", among=(*DEVICES,))
    frequency: float = parameter(5.0, "rate of its pulses; typical value", unit="MHz", low=1e-3, high=100)

    def echoes(
        self, pulses: Pulses, echoes: TracedEchoes, *, at: Situation, rng: np.random.Generator
    ) -> TracedEchoes:
        """The echoes with those of the train."""
        aim = self.aim(pulses, echoes, at=at)
        if aim is None:
            return echoes
        aim = self.spent(aim, rng=rng)
        step = METRES_PER_NS * 1e3 / self.frequency
        most = int(np.ceil(pulses.sensor.max_range / step))
        first = rng.uniform(0, step, len(aim.row))
        distance = (first[:, None] + step * np.arange(most)).ravel() - pulses.sensor.pattern.range_offset
        row = np.repeat(aim.row, most)
        power = np.repeat(aim.power, most) * rng.uniform(*POWER_SPREAD, len(row))
        accepted = has_code(pulses.sensor, len(row), rng=rng)
        row, distance, power = row[accepted], distance[accepted], power[accepted]
        return sent_back(pulses, echoes, row=row, distance=distance, power=power, origin=Origin.INJECTED)

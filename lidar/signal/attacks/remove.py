"""Removal of returns: an attacker's light, synchronised or not, suppresses echoes of real surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidar.parameters import parameter
from lidar.sensors.physics.detector import METRES_PER_NS, has_code, shift_by_delay
from lidar.sensors.physics.echoes import TracedEchoes
from lidar.sensors.physics.origin import Origin
from lidar.signal.attacks.attacker import DEVICES, Aim, Attacker, sent_back
from lidar.signal.situation import Situation
from lidar.signal.stage import Pulses

POWER_SPREAD = (0.5, 1.0)
"""Powers of unsynchronised pulses over the most that arrives, as they meet the receiver's gate; assumed."""


@dataclass(frozen=True)
class Remove(Attacker):
    """Returns are removed: by pulses nearer than the least range, by dazzling, or by jamming (Cao 2023).

    ``near`` needs synchronisation with the sensor, the others do not. Codes of pulses hinder all but
    ``saturation``, random delays only ``near``.
    """

    device: str = parameter("pra_2023", "hardware, which limits points and angles", among=(*DEVICES,))
    method: str = parameter(
        "near",
        "near: pulses below the least range; saturation: steady light; jamming: a pulse at a random time",
        among=("near", "saturation", "jamming"),
    )
    share: float = parameter(0.98, "share of the pulses in its window that it affects", low=0, high=1)

    def echoes(
        self, pulses: Pulses, echoes: TracedEchoes, *, at: Situation, rng: np.random.Generator
    ) -> TracedEchoes:
        """The echoes that are left, with those of jamming."""
        aim = self.aim(pulses, echoes, at=at)
        if aim is None:
            return echoes
        aim = self.spent(aim.where(rng.random(len(aim.row)) < self.share), rng=rng)
        if self.method == "saturation":
            return echoes.where(~_dazzle(pulses, echoes, aim=aim))
        sensor = pulses.sensor
        aim = aim.where(has_code(sensor, len(aim.row), rng=rng))
        if self.method == "near":
            away, power = sensor.min_range / 2 + shift_by_delay(sensor, len(aim.row), rng=rng), aim.power
        else:
            away = rng.uniform(0, sensor.max_range, len(aim.row))
            power = aim.power * rng.uniform(*POWER_SPREAD, len(aim.row))
        heard = away > 0  # others come before the sensor fires
        return sent_back(
            pulses,
            echoes,
            row=aim.row[heard],
            distance=away[heard] - sensor.pattern.range_offset,
            power=power[heard],
            origin=Origin.INJECTED,
        )


def _dazzle(pulses: Pulses, echoes: TracedEchoes, *, aim: Aim) -> NDArray[np.bool_]:
    """Mask (m,) of echoes that are weaker than steady light on the receiver."""
    level = np.zeros(len(pulses))
    level[aim.row] = aim.power
    return pulses.received(echoes) < level[echoes.pulse]


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

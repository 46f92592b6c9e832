"""Removal of returns: an attacker's light suppresses echoes of real surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidar.parameters import parameter
from lidar.sensors.physics.echoes import TracedEchoes
from lidar.sensors.physics.origin import Origin
from lidar.sensors.physics.pulse_identity import has_code, shift_by_delay
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

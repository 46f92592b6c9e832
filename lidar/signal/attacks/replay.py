"""Replayed returns: what the sensor measured some time before, and its own pulses with a delay."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidar.parameters import parameter
from lidar.sensors.laser.cloud import Cloud
from lidar.sensors.physics.detector import METRES_PER_NS, has_code, shift_by_delay
from lidar.sensors.physics.echoes import TracedEchoes
from lidar.sensors.physics.link import apparent_of_code
from lidar.sensors.physics.origin import Origin
from lidar.signal.attacks.attacker import Aim, SynchronisedAttacker, TimedAttacker, power_of, sent_back
from lidar.signal.situation import Situation
from lidar.signal.stage import Pulses

_REPEATING = ("spinning", "flash", "scan2d")
"""Kinds of scanner whose pulses of the same ring and column have the same direction in each frame."""

_NEAR = np.radians(0.5)
"""Angle between a beam and the nearest earlier return that counts as its own."""


@dataclass(frozen=True)
class Replay(SynchronisedAttacker):
    """Returns of an earlier frame are sent again, each on its own beam.

    Frames before which there is no earlier one stay as they are.
    """

    seconds: float = parameter(
        1.0, "time between the recorded frame and its replay", unit="s", low=0.01, high=600
    )
    gain: float = parameter(2.0, "power over that of the recorded return; assumed", low=1e-3, high=1e6)

    @property
    def lookback(self) -> float:
        """Seconds before a frame whose clouds are replayed."""
        return self.seconds

    def echoes(
        self, pulses: Pulses, echoes: TracedEchoes, *, at: Situation, rng: np.random.Generator
    ) -> TracedEchoes:
        """The echoes with those of the earlier frame."""
        aim = self.aim(pulses, echoes, at=at)
        if aim is None or at.earlier is None:
            return echoes
        old = at.earlier(max(1, int(self.seconds * pulses.sensor.rate_hz + 1e-6)))
        if old is None or not len(old):
            return echoes
        source = _same_beam(old, pulses, aim=aim)
        seen = np.zeros(len(pulses), np.int64)
        seen[aim.row] = source
        sensor, aim = pulses.sensor, self.spent(aim.where(source >= 0), rng=rng)
        aim = aim.where(has_code(sensor, len(aim.row), rng=rng))
        chosen = old.take(seen[aim.row])
        distance = chosen.range - sensor.pattern.range_offset + self.errors(aim, rng=rng)
        distance += shift_by_delay(sensor, len(aim.row), rng=rng)
        apparent = apparent_of_code(chosen.intensity, diffuse_code=sensor.diffuse_code)
        power = np.minimum(self.gain * power_of(pulses, apparent, distance=distance), aim.power)
        return sent_back(pulses, echoes, row=aim.row, distance=distance, power=power, origin=Origin.REPLAYED)


def _same_beam(old: Cloud, pulses: Pulses, *, aim: Aim) -> NDArray[np.int64]:
    """Row (k,) of an earlier cloud's return on each beam of an attack; -1 for none."""
    found = np.full(len(aim.row), -1, np.int64)
    if pulses.sensor.kind in _REPEATING:
        width = int(pulses.column.max()) + 1
        known = old.ring.astype(np.int64) * width + old.column
        known, first = np.unique(np.where(old.column < width, known, -1), return_index=True)
        wanted = pulses.ring[aim.row].astype(np.int64) * width + pulses.column[aim.row]
        at = np.minimum(np.searchsorted(known, wanted), len(known) - 1)
        same = known[at] == wanted
        found[same] = first[at[same]]
        return found
    from scipy.spatial import cKDTree  # noqa: PLC0415

    way = old.xyz / np.maximum(np.linalg.norm(old.xyz, axis=1, keepdims=True), 1e-9)
    off, nearest = cKDTree(way).query(pulses.direction[aim.row])
    same = off <= _NEAR
    found[same] = nearest[same]
    return found


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

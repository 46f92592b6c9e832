"""Weather on the echoes of pulses in air that is alike everywhere: extinction and back-scatter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geoscene.typing import Float
from lidar.physics.echoes import Origin, TracedEchoes
from lidar.signal.stage import Pulses, added_echoes
from lidar.weather.backscatter import (
    drawn_particles,
    least_power,
    particles,
    response_ranges,
    soft_target,
)
from lidar.weather.media import Medium


def through_even_air(
    pulses: Pulses, echoes: TracedEchoes, *, medium: Medium, rng: np.random.Generator
) -> TracedEchoes:
    """The echoes that are left, and those of the air before the nearest surface of each pulse."""
    if medium.extinction <= 0:
        return echoes
    end = beam_ends(pulses, echoes)
    added = air_echoes(pulses, end, medium=medium, rng=rng)
    dimmed = echoes.apparent * np.exp(-2 * medium.extinction * echoes.range)
    return TracedEchoes.concatenate((replace(echoes, apparent=dimmed), added))


def beam_ends(pulses: Pulses, echoes: TracedEchoes) -> Float:
    """Range (n,) of the nearest surface of each pulse, metres; infinite where there is none."""
    end = np.full(len(pulses), np.inf)
    np.minimum.at(end, echoes.pulse, echoes.range)
    return end


def air_echoes(pulses: Pulses, end: Float, *, medium: Medium, rng: np.random.Generator) -> TracedEchoes:
    """Echoes of the air in beams that end at ranges (n,): of all that is small, and of single particles."""
    sensor, extinction = pulses.sensor, medium.extinction
    distance, rest = response_ranges(sensor), medium.backscatter
    backscatter = np.full(len(distance), rest)
    if len(medium.diameter):
        some, backscatter, distance = particles(sensor, medium)
        pulse, place, power = drawn_particles(some, len(pulses), rng=rng)
        before = place < end[pulse]
        pulse, place = pulse[before], place[before]
        power = power[before] * np.exp(-2 * extinction * place)
        # Pulses whose particles stay unseen even together are left as they are.
        together = np.bincount(pulse, power, minlength=len(pulses))
        seen = together[pulse] > least_power(sensor)
        pulse, place, power = pulse[seen], place[seen], power[seen]
    else:
        pulse, place, power = np.empty(0, np.int64), np.empty(0), np.empty(0)
    soft = soft_target(sensor, extinction, backscatter=backscatter, distance=distance)
    soft_place, soft_power = soft.at(end)
    seen = np.flatnonzero(soft_power > least_power(sensor))
    pulse = np.concatenate((seen, pulse))
    place, power = np.concatenate((soft_place[seen], place)), np.concatenate((soft_power[seen], power))
    power = power * pulses.power[pulse]
    return added_echoes(pulse, place, apparent=pulses.apparent(power, place), origin=Origin.WEATHER)

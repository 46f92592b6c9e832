"""Weather on the echoes of pulses: extinction, and back-scatter before the nearest surface."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.physics.echoes import Origin, TracedEchoes
from lidar.signal.situation import Situation
from lidar.signal.stage import Pulses, added_echoes
from lidar.weather.backscatter import (
    drawn_particles,
    least_power,
    particles,
    pulse_shape,
    response_ranges,
    soft_target,
    strength,
)
from lidar.weather.fields import Field, Rays, amounts, rays_of, strongest_response
from lidar.weather.media import Medium

_STEP = 0.25  # metres of range between samples of a field's response

Found = tuple[NDArray[np.int64], Float, Float]
"""Pulse, range and power over the threshold of echoes."""


def through_air(
    pulses: Pulses,
    echoes: TracedEchoes,
    *,
    medium: Medium,
    field: Field | None,
    lens: float,
    at: Situation,
    rng: np.random.Generator,
) -> TracedEchoes:
    """The echoes that are left, and those of the air, in any order.

    field : where the medium is; None for everywhere
    lens  : diameter of the receiver's lens, metres
    """
    if medium.extinction <= 0 or (field is not None and not field.share.any()):
        return echoes
    rays = None
    if field is not None:
        rays = rays_of(pulses.origin, pulses.direction, time_ns=pulses.time_ns, at=at)
    end = _beam_ends(pulses, echoes)
    some, backscatter, distance = None, np.empty(0), response_ranges(pulses.sensor)
    if len(medium.diameter):
        some, backscatter, distance = particles(pulses.sensor, medium, lens=lens)
    else:
        backscatter = np.full(len(distance), medium.backscatter)
    found: Found = np.empty(0, np.int64), np.empty(0), np.empty(0)
    if some is not None:
        pulse, place, power = drawn_particles(some, len(pulses), rng=rng)
        before = place < end[pulse]
        found = pulse[before], place[before], power[before]
    on = np.concatenate((echoes.pulse.astype(np.int64), found[0]))
    away: Float = np.concatenate((echoes.range, found[1]))
    here, column = np.ones(len(on)), away
    if field is not None and rays is not None:
        here, column = amounts(field, rays, pulse=on, distance=away)
    passed = np.exp(-2 * medium.extinction * column)
    m = len(echoes)
    single = _noticed(pulses, (found[0], found[1], found[2] * passed[m:]), share=here[m:], rng=rng)
    if field is None or rays is None:
        soft = soft_target(
            pulses.sensor, medium.extinction, backscatter=backscatter, distance=distance, lens=lens
        )
        place, power = soft.at(end)
    else:
        place, power = _field_response(
            pulses, (field, rays), end=end, medium=medium, rest=(distance, backscatter), lens=lens
        )
    seen = np.flatnonzero(power > least_power(pulses.sensor))
    pulse = np.concatenate((seen, single[0]))
    place, power = np.concatenate((place[seen], single[1])), np.concatenate((power[seen], single[2]))
    apparent = pulses.apparent(power * pulses.power[pulse], place)
    added = added_echoes(pulse, place, apparent=apparent, origin=Origin.WEATHER)
    dimmed = replace(echoes, apparent=echoes.apparent * passed[:m])
    return TracedEchoes.concatenate((dimmed, added))


def _beam_ends(pulses: Pulses, echoes: TracedEchoes) -> Float:
    """Range (n,) of the nearest surface of each pulse, metres; infinite where there is none."""
    end = np.full(len(pulses), np.inf)
    np.minimum.at(end, echoes.pulse, echoes.range)
    return end


def _noticed(pulses: Pulses, found: Found, *, share: Float, rng: np.random.Generator) -> Found:
    """The particles that are there, of pulses whose particles together the detector may notice."""
    pulse, place, power = found
    if np.any(share < 1):
        there = rng.random(len(share)) < share
        pulse, place, power = pulse[there], place[there], power[there]
    together = np.bincount(pulse, power, minlength=len(pulses))
    seen = together[pulse] > least_power(pulses.sensor)
    return pulse[seen], place[seen], power[seen]


def _field_response(
    pulses: Pulses,
    where: tuple[Field, Rays],
    *,
    end: Float,
    medium: Medium,
    rest: tuple[Float, Float],
    lens: float,
) -> tuple[Float, Float]:
    """Range and power (n,) of the soft target of a medium that differs from place to place."""
    sensor = pulses.sensor
    reach = float(min(sensor.max_range, 300.0))
    distance = _STEP * np.linspace(0.5, int(reach / _STEP) - 0.5, int(reach / _STEP))
    # Beyond the ranges of the response of even air, no particle is seen one by one.
    backscatter = np.interp(distance, *rest, right=medium.backscatter)
    near = sensor.min_range - sensor.pattern.range_offset
    white = pi * backscatter * strength(sensor, distance, lens=lens) * _STEP
    shape = pulse_shape(sensor.pulse_ns, _STEP)
    return strongest_response(
        *where,
        end=end,
        white=white,
        extinction=medium.extinction,
        shape=shape,
        step=_STEP,
        near=near,
        least=least_power(sensor),
    )

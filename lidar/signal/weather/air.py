"""Weather on the echoes of pulses: extinction, and back-scatter before the nearest surface."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.sensors.physics.echoes import TracedEchoes
from lidar.sensors.physics.origin import Origin
from lidar.signal.situation import Situation
from lidar.signal.stage import Pulses, added_echoes
from lidar.signal.weather.backscatter import (
    Found,
    drawn_particles,
    even_echo,
    least_power,
    notice,
    pulse_shape,
    scattering,
    strength,
)
from lidar.signal.weather.fields import Field, WeatherBeams, amounts, rays_of, strongest_response
from lidar.signal.weather.media import Medium

_STEP = 0.25  # metres of range between samples of a field's response
_EVEN = 1e-6  # share of a way on which a medium may differ and be even


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
    sensor, least = pulses.sensor, least_power(pulses.noise)
    some, rest, distance = scattering(sensor, medium, lens=lens)
    end = _beam_ends(pulses, echoes)
    found: Found = np.empty(0, np.int64), np.empty(0), np.empty(0)
    if some is not None:
        found = drawn_particles(some, end, extinction=0.0 if field else medium.extinction, rng=rng)
    if field is None:
        column = echoes.range
        soft = [_even_response(pulses, end, medium=medium, lens=lens, rng=rng)]
    else:
        rays = rays_of(pulses.origin, pulses.direction, time_ns=pulses.time_ns, at=at)
        _, column = amounts(field, rays, pulse=echoes.pulse, distance=echoes.range)
        found = _in_field(found, (field, rays), extinction=medium.extinction, rng=rng)
        near = even_echo(sensor, medium, lens=lens, noise=pulses.noise).end[-1]
        is_even = _is_even((field, rays), np.minimum(end, near))
        soft = [
            _even_response(pulses, np.where(is_even, end, 0.0), medium=medium, lens=lens, rng=rng),
            _field_response(
                pulses,
                (field, rays),
                end=np.where(is_even, 0.0, end),
                medium=medium,
                rest=(distance, rest),
                lens=lens,
            ),
        ]
    single = notice(found, least=least, separation=sensor.echo_separation)
    dimmed = replace(echoes, apparent=echoes.apparent * np.exp(-2 * medium.extinction * column))
    pulse, place, power = (np.concatenate(each) for each in zip(*soft, single, strict=True))
    if not len(pulse):
        return dimmed
    apparent = pulses.apparent(power * pulses.power[pulse], place)
    added = added_echoes(pulse, place, apparent=apparent, origin=Origin.WEATHER)
    return TracedEchoes.concatenate((dimmed, added))


def _beam_ends(pulses: Pulses, echoes: TracedEchoes) -> Float:
    """Range (n,) of the nearest surface of each pulse, metres; infinite without one."""
    end = np.full(len(pulses), np.inf)
    np.minimum.at(end, echoes.pulse, echoes.range)
    return end


def _in_field(
    found: Found, where: tuple[Field, WeatherBeams], *, extinction: float, rng: np.random.Generator
) -> Found:
    """The particles that are there in a medium that differs from place to place, dimmed by it."""
    pulse, place, power = found
    share, column = amounts(*where, pulse=pulse, distance=place)
    there = rng.random(len(share)) < share
    return pulse[there], place[there], (power * np.exp(-2 * extinction * column))[there]


def _is_even(where: tuple[Field, WeatherBeams], distance: Float) -> NDArray[np.bool_]:
    """Pulses (n,) whose beams go through all of a medium, and no more, up to distances (n,) in metres."""
    if not np.any(where[0].share == 1):
        return np.zeros(len(distance), bool)
    _, column = amounts(*where, pulse=np.arange(len(distance)), distance=distance)
    even: NDArray[np.bool_] = np.abs(column - distance) < _EVEN * distance
    return even


def _even_response(
    pulses: Pulses, end: Float, *, medium: Medium, lens: float, rng: np.random.Generator
) -> Found:
    """The echoes of the soft target of even air that the detector may notice."""
    soft = even_echo(pulses.sensor, medium, lens=lens, noise=pulses.noise)
    row = soft.row(end)
    seen = np.flatnonzero((row >= 0) & (soft.power > least_power(pulses.noise))[row])
    row = row[seen]
    place = np.minimum(soft.places(row, rng.random(len(seen))), end[seen])
    return seen, place, soft.power[row]


def _field_response(
    pulses: Pulses,
    where: tuple[Field, WeatherBeams],
    *,
    end: Float,
    medium: Medium,
    rest: tuple[Float, Float],
    lens: float,
) -> Found:
    """The echoes of the soft target of a medium that differs from place to place, at its maxima."""
    sensor = pulses.sensor
    reach = float(min(sensor.max_range, 300.0))
    distance = _STEP * np.linspace(0.5, int(reach / _STEP) - 0.5, int(reach / _STEP))
    # Beyond the ranges of the response of even air, no particle is seen one by one.
    backscatter = np.interp(distance, *rest, right=medium.backscatter)
    near = sensor.min_range - sensor.pattern.range_offset
    white = pi * backscatter * strength(sensor, distance, lens=lens) * _STEP
    shape = pulse_shape(sensor.pulse_ns, _STEP)
    place, power = strongest_response(
        *where,
        end=end,
        white=white,
        extinction=medium.extinction,
        shape=shape,
        step=_STEP,
        near=near,
        least=least_power(pulses.noise),
    )
    seen = np.flatnonzero(power > least_power(pulses.noise))
    return seen, place[seen], power[seen]

"""Weather that differs from place to place: banks of fog and rain, plumes of dust, spray behind vehicles."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from math import inf, pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.geometry.frames import Frame
from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.geometry.random_streams import generator
from lidar.raycast.memory import inline
from lidar.signal.situation import Situation
from lidar.signal.weather.setting import WeatherSetting
from lidar.world.shelter import CELL

FARTHEST = 300.0
"""Metres from a sensor up to which weather differs from place to place."""

_STEP = 2.0  # metres between samples of a field
_TILE = 64.0  # metres that a sensor moves until its field is sampled anew
_ABOVE = 2.0  # metres of a sensor above the ground, assumed
_PLUME_HEIGHT = 5.0  # metres over which dust thins out, assumed
_PLUME_SIZES = (8.0, 60.0)  # metres, wavelengths of the pattern of dust, assumed
_PLUME_WAVES = 40
_PLUME_SHARE = 0.4  # of the ground under dust, assumed
_DRIFT, _DRIFT_LENGTH = 10.0, 20.0
"""Metres from the open to which fog and dust fill it, and over which they thin out beyond; assumed."""

_SPRAY_FAST = 50 / 3.6  # m/s, from which on tyres throw up spray behind a vehicle, typical value
_SPRAY_TIME, _SPRAY_LENGTH = 1.0, 4.0  # s, decay of spray, and after which it is gone; typical values
_SPRAY_HEIGHT = 0.5  # metres over which spray thins out, typical value
_SPRAY_AXLE = 1.5  # metres from a vehicle's middle to its rear axle, typical value
_SPRAY_HALF_WIDTH = 1.0  # metres, of the plume at the axle, typical value
_SPRAY_ASIDE = 8.0  # metres beside the way of a vehicle beyond which there is no spray, 4 widths of the plume
_SPRAY_SHAPE = 0.5  # of the gamma distribution of clusters: a sixth of places have twice the mean, assumed


@dataclass(frozen=True, slots=True)
class Cover:
    """Share of a medium that remains under roofs, bridges and in tunnels.

    corner : (2,) scene metres of the corner of the first cell
    roof   : (ny, nx) height below which air is covered, scene metres; -inf in the open
    share  : (ny, nx) of the medium below it
    """

    corner: tuple[float, float]
    roof: Float
    share: Float


_OPEN = Cover((0.0, 0.0), np.empty((0, 0)), np.empty((0, 0)))


@dataclass(frozen=True, slots=True)
class Field:
    """Amount of a medium as a function of place.

    corner : (2,) scene metres of the first sample
    share  : (ny, nx) of the medium in the sample's surroundings; none beyond
    ground : height above which it thins out, scene metres
    height : metres over which it falls to 1/e; infinite for none
    beyond : share where there are no samples
    cover  : what of it is under roofs; None for all
    """

    corner: tuple[float, float]
    share: Float
    ground: float
    height: float
    beyond: float = 0.0
    cover: Cover | None = None


@dataclass(frozen=True, slots=True)
class WeatherBeams:
    """Beams in a scene: where they start (n, 3) and where they go (n, 3), scene metres per metre of range."""

    start: Float
    way: Float


def _around(position: Float, far: float) -> tuple[tuple[float, float], int]:
    """The corner of a field up to a distance, the same for nearby positions, and its samples on a side."""
    reach = min(far, FARTHEST) + _TILE
    x, y = (np.floor(position[:2] / _TILE) + 0.5) * _TILE - reach
    return (float(x), float(y)), int(2 * reach / _STEP) + 1


def field_of(setting: WeatherSetting, far: float, *, at: Situation) -> Field | None:
    """Field of a weather setting up to a distance from a sensor; None if it is uniform.

    Raises InputError if the setting has a place, plumes or road users, and the situation knows none.
    """
    if setting.kind == "spray":
        return spray_field(far, at=at)
    has_place = bool(setting.radius or setting.polygon)
    plumes = setting.medium == "plumes"
    cover = _cover(setting, at=at)
    if not (has_place or plumes):
        return None if cover is None else Field((0.0, 0.0), np.ones((1, 1)), 0.0, inf, 1.0, cover)
    if at.poses is None or at.geo is None:
        raise InputError("weather with a place or plumes needs poses, which these clouds do not have")
    position = at.poses(np.array([at.start_ns])).position[0]
    corner, count = _around(position, far)
    share = np.ones((count, count))
    if has_place:
        share = _place_share(setting, at.geo, corner=corner, count=count)
    if plumes:
        share = share * plume_pattern(setting, at.start_ns / 1e9, seed=at.seed, corner=corner, count=count)
        return Field(corner, share, float(position[2]) - _ABOVE, _PLUME_HEIGHT, cover=cover)
    everywhere = cover is None and np.all(share == 1)
    return None if everywhere else Field(corner, share, 0.0, inf, cover=cover)


def _cover(setting: WeatherSetting, *, at: Situation) -> Cover | None:
    """Cover of a weather setting around a sensor; None without roofs, or if they are unknown.

    Rain and snow fall straight down. Fog and dust drift in.
    """
    if at.world is None or at.poses is None:
        return None
    shelter = at.world.shelter(at.poses(np.array([at.start_ns])).position[0])
    if shelter is None:
        return None
    share = np.zeros_like(shelter.way)
    if setting.kind not in ("rain", "snow"):
        share = np.exp(-np.maximum(shelter.way - _DRIFT, 0.0) / _DRIFT_LENGTH)
    covered = np.isfinite(shelter.roof)
    return Cover(shelter.corner, shelter.roof, share) if np.any(share[covered] < 1) else None


@functools.lru_cache(maxsize=8)
def _place_share(setting: WeatherSetting, geo: Frame, *, corner: tuple[float, float], count: int) -> Float:
    """The share (count, count) of a place at samples: 1 within, falling to 0 over the edge around it."""
    import shapely  # noqa: PLC0415  (0.1 s)

    x, y = (c + _STEP * np.arange(count) for c in corner)
    points = shapely.points(*np.meshgrid(x, y))
    if setting.radius:
        centre = shapely.Point(*geo.from_geographic(setting.longitude, setting.latitude))
        away = np.maximum(shapely.distance(points, centre) - setting.radius, 0.0)
    else:
        lon, lat = np.array(setting.corners()).T
        place = shapely.Polygon(np.transpose(geo.from_geographic(lon, lat)))
        away = shapely.distance(points, place)
    share: Float = np.clip(1 - away / setting.edge, 0, 1) if setting.edge else np.where(away > 0, 0.0, 1.0)
    return share


def plume_pattern(
    setting: WeatherSetting, seconds: float, *, seed: int, corner: tuple[float, float], count: int
) -> Float:
    """Dust (count, count) that the wind carries along: the crests of a field of waves, 1 on average there.

    The pattern drifts with the wind and depends on the seed alone, so that it passes from frame to frame.
    """
    rng = generator(seed, "weather", "dust plumes")
    length = _PLUME_SIZES[0] * (_PLUME_SIZES[1] / _PLUME_SIZES[0]) ** rng.random(_PLUME_WAVES)
    angle, phase = rng.uniform(0, 2 * pi, (2, _PLUME_WAVES))
    wave = 2 * pi / length * np.array([np.cos(angle), np.sin(angle)])
    x, y = (c + _STEP * np.arange(count) - d for c, d in zip(corner, setting.drift(seconds), strict=True))
    # The sum over waves of cos(kx x + ky y + phase), by the cosine of sums.
    along, across = np.outer(x, wave[0]), np.outer(y, wave[1]) + phase
    height = np.cos(across) @ np.cos(along).T - np.sin(across) @ np.sin(along).T
    height *= np.sqrt(2 / _PLUME_WAVES)
    level = 0.2533  # exceeded by the standard normal share _PLUME_SHARE
    share: Float = np.clip(height - level, 0, 2) / 0.71  # mean of the excess over that level
    return share


def spray_field(far: float, *, at: Situation) -> Field:
    """The spray behind the vehicles around a sensor, as shares of the spray at 100 km/h; zero without any.

    Raises InputError if the road users are unknown.
    """
    if at.world is None or at.poses is None:
        raise InputError(
            "spray needs road users, which recorded data do not have: use lidar drive --traffic on"
        )
    position = at.poses(np.array([at.start_ns])).position[0]
    corner, count = _around(position, far)
    share = np.zeros((count, count))
    start_ns, end_ns = at.world.span_ns
    ground = []
    for group in at.world.caster.instances:
        if group.transform.ndim != 4:
            continue
        place = group.transform[:, :, :, 3]
        speed = (place[:, -1] - place[:, 0]) / ((end_ns - start_ns) / 1e9)
        fast = np.linalg.norm(speed[:, :2], axis=1) > _SPRAY_FAST
        for here, velocity in zip(place[fast, 0], speed[fast], strict=True):
            _add_spray(share, corner=corner, place=here[:2], velocity=velocity[:2])
            ground.append(float(here[2]))
    if ground:
        share *= _clusters(at.seed, corner=corner, count=count)
    return Field(corner, share, float(np.median(ground)) if ground else 0.0, _SPRAY_HEIGHT)


def _clusters(seed: int, *, corner: tuple[float, float], count: int) -> Float:
    """Density (count, count) of spray over its mean, at samples: clusters that stay where they are."""
    table = _cluster_table(seed)
    first = np.round(np.array(corner) / _STEP).astype(np.int64)
    column, row = (first[:, None] + np.arange(count)) % len(table)
    density: Float = table[np.ix_(row, column)]
    return density


@functools.lru_cache(maxsize=2)
def _cluster_table(seed: int) -> Float:
    """Gamma-distributed factors (64, 64) with a mean of 1; they repeat after 128 m."""
    return generator(seed, "weather", "spray clusters").gamma(_SPRAY_SHAPE, 1 / _SPRAY_SHAPE, (64, 64))


def _add_spray(share: Float, *, corner: tuple[float, float], place: Float, velocity: Float) -> None:
    """Add the plume of a vehicle to a field: thinning with the time since it passed, and wider with it."""
    speed = float(np.hypot(*velocity))
    ahead = velocity / speed
    ends = place - np.array([[0.0], [_SPRAY_LENGTH * speed + _SPRAY_AXLE]]) * ahead - corner
    low = np.maximum(np.floor((ends.min(axis=0) - _SPRAY_ASIDE) / _STEP).astype(int), 0)
    high = np.maximum(np.ceil((ends.max(axis=0) + _SPRAY_ASIDE) / _STEP).astype(int), low)
    share = share[low[1] : high[1], low[0] : high[0]]
    y, x = np.indices(share.shape) * _STEP
    x, y = x + corner[0] + low[0] * _STEP - place[0], y + corner[1] + low[1] * _STEP - place[1]
    behind = -(x * ahead[0] + y * ahead[1]) - _SPRAY_AXLE
    beside = x * -ahead[1] + y * ahead[0]
    age = behind / speed
    wide = np.hypot(_SPRAY_HALF_WIDTH + 0.25 * np.maximum(age, 0), _STEP / 2)
    plume = np.exp(-age / _SPRAY_TIME - (beside / wide) ** 2) * (_SPRAY_HALF_WIDTH / wide)
    plume *= (speed * 3.6 / 100) ** 2
    share += np.where((behind >= 0) & (age <= _SPRAY_LENGTH), plume, 0.0)


def amounts(
    field: Field, rays: WeatherBeams, *, pulse: NDArray[np.integer], distance: Float
) -> tuple[Float, Float]:
    """The share (m,) of the medium at ranges along pulses, and its integral from the beam's start, metres."""
    here, column = np.empty(len(pulse)), np.empty(len(pulse))
    _amounts(_pack(field), (rays.start, rays.way), (pulse.astype(np.int64), distance), here, column)
    return here, column


def _pack(field: Field) -> tuple[Any, ...]:
    cover = field.cover or _OPEN
    frame = *field.corner, field.ground, field.height, field.beyond, *cover.corner
    return field.share, frame, cover.roof, cover.share


@inline
def _share(field: Any, rays: Any, pulse: Any, distance: Any) -> Any:
    """The share of the medium at a range along a pulse."""
    grid, frame, roof, left = field
    start, way = rays
    x0, y0, ground, height, share, cx, cy = frame
    x, y = start[pulse, 0] + distance * way[pulse, 0], start[pulse, 1] + distance * way[pulse, 1]
    u, v = (x - x0) / _STEP, (y - y0) / _STEP
    if 0.0 <= u < grid.shape[1] - 1 and 0.0 <= v < grid.shape[0] - 1:
        column, row = int(u), int(v)
        u, v = u - column, v - row
        share = (1 - v) * ((1 - u) * grid[row, column] + u * grid[row, column + 1])
        share += v * ((1 - u) * grid[row + 1, column] + u * grid[row + 1, column + 1])
    if share <= 0.0:
        return 0.0
    z = start[pulse, 2] + distance * way[pulse, 2]
    u, v = (x - cx) / CELL, (y - cy) / CELL
    if 0.0 <= u < roof.shape[1] and 0.0 <= v < roof.shape[0] and z < roof[int(v), int(u)]:
        share *= left[int(v), int(u)]
    return share * np.exp(-(z - ground) / height) if z > ground else share


@njit(cache=True, nogil=True)
def _amounts(field: Any, rays: Any, places: Any, here: Any, column: Any) -> None:
    """Fill the share at places and its integral up to them, by the midpoint rule."""
    pulse, distance = places
    for i in range(len(pulse)):
        steps = max(1, int(np.ceil(distance[i])))
        step = distance[i] / steps
        total = 0.0
        for k in range(steps):
            total += _share(field, rays, pulse[i], (k + 0.5) * step)
        column[i] = total * step
        here[i] = _share(field, rays, pulse[i], distance[i])


def strongest_response(
    field: Field,
    rays: WeatherBeams,
    *,
    end: Float,
    white: Float,
    extinction: float,
    shape: Float,
    step: float,
    near: float,
    least: float,
) -> tuple[Float, Float]:
    """Range and power (n,) of the maximum of the response of a medium in beams that end at ranges (n,).

    white : (k,) what a share of 1 sends back over a step at ranges (0.5, 1.5, ...) steps, if nothing dims it
    shape : (s,) power of the pulse at steps of range
    near  : metres from which on the maximum is looked for
    least : power of responses that are not worth looking for
    """
    place, power = np.empty(len(end)), np.zeros(len(end))
    beyond = np.maximum.accumulate(white[::-1])[::-1] * (
        shape.sum() * max(field.beyond, float(field.share.max()))
    )
    air = end, white, beyond, extinction, shape, step, near, least
    _strongest(_pack(field), (rays.start, rays.way), air, place, power)
    return place, power


@njit(cache=True, nogil=True)
def _strongest(field: Any, rays: Any, air: Any, place: Any, power: Any) -> None:
    """Fill range and power of the strongest response of each pulse."""
    end, white, beyond, extinction, shape, step, near, least = air
    taps = len(shape)
    sent = np.zeros(len(white) + 2 * taps)  # back by each step of range, after as many zeros as the pulse has
    for i in range(len(end)):
        best, where, passed, live, last = 0.0, 0.0, 1.0, 0, 0
        for k in range(len(white) + taps):
            r = (k + 0.5) * step
            new = 0.0
            if k < len(white) and r < end[i]:
                if live == 0 and beyond[k] * passed < max(best, least):
                    break
                share = _share(field, rays, i, r)
                if share > 0.0:
                    within = np.exp(-extinction * share * step)
                    new = share * white[k] * passed * within
                    passed *= within * within
            elif live == 0:
                break
            live = taps if new > 0.0 else max(live - 1, 0)
            sent[k + taps], last = new, k
            if live == 0:
                continue
            total = 0.0
            for j in range(taps):
                total += shape[j] * sent[k + taps - j]
            middle = r - step * (taps - 1) / 2
            if total > best and middle >= near:
                best, where = total, middle
        place[i], power[i] = min(where, end[i]), best
        sent[: last + taps + 1] = 0.0


def rays_of(start: Float, direction: Float, *, time_ns: NDArray[np.int64], at: Situation) -> WeatherBeams:
    """Beams in the scene, from their starts (n, 3) and directions (n, 3) in the sensor's frame."""
    assert at.poses is not None  # noqa: S101
    poses = at.poses(time_ns)
    return WeatherBeams(poses.place(start), poses.directions(direction))

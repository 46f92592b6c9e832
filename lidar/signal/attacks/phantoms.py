"""Shapes that an attacker makes of injected returns: their distance along the beams of a sensor."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.raycast import Caster
from lidar.sensors.physics.echoes import TracedEchoes
from lidar.signal.stage import Pulses
from lidar.world.actor_shapes import KINDS, catalogue

OBJECTS = tuple(kind for kind in KINDS if kind != "parked_motorcycle")
"""Kinds of road users whose shape a phantom may have."""

USUAL_HEIGHT = 1.73
"""Metres of a sensor above the ground where no return tells it: KITTI's HDL-64E."""

_GROUND_SECTOR = 40.0  # degrees on either side of a phantom where the ground is looked for
_GROUND_RANGE = (4.0, 25.0)  # metres from the sensor, horizontally
_GROUND_SHARE = 20.0  # percentile of the heights of downward beams' returns that counts as ground
_FEWEST = 10  # returns that tell the ground


def ground_below(pulses: Pulses, echoes: TracedEchoes, *, azimuth: float) -> float:
    """Height of the ground in the sensor frame, metres, from echoes around an azimuth (degrees)."""
    way = pulses.direction[echoes.pulse]
    point = pulses.origin[echoes.pulse] + echoes.range[:, None] * way
    level = np.hypot(point[:, 0], point[:, 1])
    off = (np.degrees(np.arctan2(point[:, 1], point[:, 0])) - azimuth + 180) % 360 - 180
    low, high = _GROUND_RANGE
    chosen = (np.abs(off) < _GROUND_SECTOR) & (level > low) & (level < high) & (way[:, 2] < -0.03)
    if np.count_nonzero(chosen) < _FEWEST:
        return -USUAL_HEIGHT
    return float(np.percentile(point[chosen, 2], _GROUND_SHARE))


@cache
def _body(kind: str) -> tuple[Caster, float]:
    """Caster of a kind of road user, in its own frame, and its length in metres."""
    shape = next(shape for shape in catalogue().values() if shape.kind == kind)
    return Caster(shape.mesh.vertices, shape.mesh.faces), shape.length


def _turn(azimuth: float) -> Float:
    """Rotation (3, 3) about the vertical by degrees."""
    c, s = np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def object_ranges(
    pulses: Pulses,
    row: NDArray[np.int64],
    *,
    kind: str,
    azimuth: float,
    distance: float,
    ground: float,
    part: tuple[float, float] = (0.0, 1.0),
) -> Float:
    """Range (k,) along beams to a road user seen from behind; infinite for beams that miss it.

    kind     : of `OBJECTS`
    azimuth  : degrees from forward to the left of its middle
    distance : metres from the sensor to its rear
    ground   : height of the ground in the sensor frame, metres
    part     : shares of its width, from the right, between which it can be seen past something in front
    """
    caster, length = _body(kind)
    turn = _turn(azimuth)
    middle = turn @ np.array([distance + length / 2, 0.0, 0.0]) + np.array([0.0, 0.0, ground])
    start = (pulses.origin[row] - middle) @ turn
    way = pulses.direction[row] @ turn
    found = caster.cast(start, way).range
    hit = np.isfinite(found)
    if part != (0.0, 1.0) and hit.any():
        across = start[hit, 1] + found[hit] * way[hit, 1]
        low, high = across.min(), across.max()
        share = (across - low) / max(high - low, 1e-6)
        found[np.flatnonzero(hit)[(share < part[0]) | (share > part[1])]] = np.inf
    return found


def wall_ranges(
    pulses: Pulses,
    row: NDArray[np.int64],
    *,
    azimuth: float,
    distance: float,
    ground: float,
    size: tuple[float, float],
) -> Float:
    """Distance (k,) along beams to an upright wall across an azimuth; infinite where they miss it.

    size : width and height in metres

    Other parameters are those of `object_ranges`.
    """
    turn = _turn(azimuth)
    start, way = pulses.origin[row] @ turn, pulses.direction[row] @ turn
    found = (distance - start[:, 0]) / np.where(way[:, 0] > 1e-6, way[:, 0], np.nan)
    across, up = start[:, 1] + found * way[:, 1], start[:, 2] + found * way[:, 2] - ground
    on = (np.abs(across) <= size[0] / 2) & (up >= 0) & (up <= size[1])
    return np.where(on, found, np.inf)


def far_trace_ranges(
    pulses: Pulses,
    row: NDArray[np.int64],
    *,
    kind: str,
    azimuth: float,
    distance: float,
    ground: float,
    seen_at: float,
) -> Float:
    """Distance (k,) along beams to the few returns of a far road user that are brought near.

    The road user is scanned ``seen_at`` metres away; its returns are shifted along the azimuth to
    ``distance`` and each is put on the beam nearest to it.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415

    everything = np.arange(len(pulses))
    trace = object_ranges(pulses, everything, kind=kind, azimuth=azimuth, distance=seen_at, ground=ground)
    hit = np.flatnonzero(np.isfinite(trace))
    shift = _turn(azimuth) @ np.array([distance - seen_at, 0.0, 0.0])
    point = pulses.origin[hit] + trace[hit, None] * pulses.direction[hit] + shift
    found = np.full(len(row), np.inf)
    if not len(row) or not len(hit):
        return found
    away = point - pulses.origin[row].mean(axis=0)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    off, beam = cKDTree(pulses.direction[row]).query(away)
    # Points between the outermost beams and the rim of the window are on no beam.
    chosen = off <= 2 * np.median(off) + 1e-9
    along = np.einsum("ij,ij->i", point - pulses.origin[row[beam]], pulses.direction[row[beam]])
    np.minimum.at(found, beam[chosen], along[chosen])
    return found

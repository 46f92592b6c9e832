"""From what moved along ways to actors with tracks on the ground."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.scene import Scene
from lidar.actors.actors import Actors
from lidar.actors.flow import DT, Flow
from lidar.actors.ground import ground_heights
from lidar.actors.lanes import STEP
from lidar.actors.shapes import STRIDE, Shape, catalogue
from lidar.actors.sweep import body_poses
from lidar.actors.traffic import Trip

Float = NDArray[np.float64]

_POSES = {"cyclist": STRIDE, "adult": STRIDE, "small_adult": STRIDE, "child": STRIDE}
_STRIDE = {"cyclist": 5.6, "adult": 1.45, "small_adult": 1.35, "child": 1.05}
"""Metres in a stride of two steps, and in a turn of a bicycle's pedals: typical."""


def table(
    shapes: Sequence[Shape],
    stretch: ArrayLike,
    knots: NDArray[np.int64],
    time_ns: NDArray[np.int64],
    position: Float,
    angles: Float,
    velocity: Float,
    gone: Float,
    *,
    parked: bool,
    scale: float,
) -> Actors:
    """Actors (n) of bodies; ``knots`` (n) is how many knots each has. Features are left at zero."""
    known = catalogue()
    names: dict[str, int] = {}
    first = []
    for shape in shapes:
        count = 1 if parked else _POSES.get(shape.kind, 1)
        stem = shape.name.rsplit("/", 1)[0] if count > 1 else ""
        wanted = [f"{stem}/{k}" for k in range(count)] if count > 1 else [shape.name]
        for name in wanted:
            names.setdefault(name, len(names))
        first.append(names[wanted[0]])
    grow = np.reshape(np.asarray(stretch, float), (-1, 3))
    size = np.array([[s.length, s.width, s.height] for s in shapes]).reshape(-1, 3) * grow
    kinds = [s.kind for s in shapes]
    return Actors(
        shapes=tuple(known[name] for name in names),
        shape=np.array(first, np.int32),
        poses=np.array([1 if parked else _POSES.get(k, 1) for k in kinds], np.int32),
        stride=np.array([_STRIDE.get(k, 1.0) for k in kinds], float),
        kind=np.array(kinds, np.str_),
        klass=np.array([int(s.klass) for s in shapes], np.uint8),
        size=size,
        stretch=grow,
        parked=np.full(len(kinds), parked),
        feature=np.zeros(len(kinds), np.int32),
        first=np.concatenate([[0], np.cumsum(knots)]).astype(np.int64),
        time_ns=time_ns.astype(np.int64),
        position=position.reshape(-1, 3),
        angles=angles.reshape(-1, 3),
        velocity=velocity.reshape(-1, 3),
        gone=gone,
        scale=scale,
    )


def moving_actors(trips: Sequence[Trip], flow: Flow, scene: Scene, *, scale: float) -> Actors:
    """Actors of the trips that took place."""
    present, counts = np.unique(flow.trip, return_counts=True)
    ends = np.concatenate([[0], np.cumsum(counts)])
    parts: list[tuple[Float, Float]] = []
    asked = []
    for n, row in enumerate(present.tolist()):
        trip = trips[row]
        at = flow.gone[ends[n] : ends[n + 1]] / STEP
        axle = trip.axle
        xy, heading = body_poses(trip.way, axle)
        stations = np.arange(len(xy))
        middle = np.stack([np.interp(at, stations, xy[:, c]) for c in (0, 1)], axis=1)
        yaw = np.interp(at, stations, heading)
        hint = np.interp(at, stations, trip.way.xyz[:, 2])
        parts.append((middle, yaw))
        asked.append(wheels(middle, yaw, hint, axle * scale, 0.8 * trip.shape.width * scale))
    if not parts:
        none = np.empty((0, 3))
        return table(
            [],
            none,
            np.empty(0, np.int64),
            np.empty(0, np.int64),
            none,
            none,
            none,
            np.empty(0),
            parked=False,
            scale=scale,
        )
    z = ground_heights(scene, np.concatenate(asked).reshape(-1, 3)).reshape(-1, 4)
    position, angles, velocity = [], [], []
    for n, row in enumerate(present.tolist()):
        part = slice(ends[n], ends[n + 1])
        trip = trips[row]
        middle, yaw = parts[n]
        height, pitch, roll = attitude(z[part], trip.axle, 0.8 * trip.shape.width)
        height, pitch, roll = (_settled(c, flow.gone[part]) for c in (height, pitch, roll))
        speed = flow.speed[part] * scale
        course = _course(middle, yaw)
        position.append(np.column_stack([middle, height]))
        angles.append(np.column_stack([yaw, pitch, roll]))
        velocity.append(
            np.column_stack([speed * np.cos(course), speed * np.sin(course), -speed * np.tan(pitch)])
        )
    return table(
        [trips[row].shape for row in present],
        [trips[row].stretch for row in present],
        counts,
        np.round(flow.step * DT * 1e9).astype(np.int64),
        np.concatenate(position),
        np.concatenate(angles),
        np.concatenate(velocity),
        flow.gone,
        parked=False,
        scale=scale,
    )


def wheels(middle: Float, yaw: Float, hint: Float, axle: float | Float, track: float | Float) -> Float:
    """Points (n, 4, 3) on the ground: front left, front right, rear left, rear right."""
    c, s = np.cos(yaw), np.sin(yaw)
    corners = [(0.5, 0.5), (0.5, -0.5), (-0.5, 0.5), (-0.5, -0.5)]
    points = [
        np.column_stack(
            [middle[:, 0] + a * axle * c - b * track * s, middle[:, 1] + a * axle * s + b * track * c, hint]
        )
        for a, b in corners
    ]
    return np.stack(points, axis=1)


def attitude(z: Float, axle: float | Float, track: float | Float) -> tuple[Float, Float, Float]:
    """Height of the middle, pitch (nose down positive) and roll of bodies whose wheels stand at z (n, 4)."""
    fore, aft = z[:, :2].mean(axis=1), z[:, 2:].mean(axis=1)
    left, right = z[:, [0, 2]].mean(axis=1), z[:, [1, 3]].mean(axis=1)
    return z.mean(axis=1), np.arctan2(aft - fore, axle), np.arctan2(left - right, track)


def _course(middle: Float, yaw: Float) -> Float:
    """Direction (n,) in which the middle moves: along the track, and along the body where it stands."""
    d = np.gradient(middle, axis=0) if len(middle) > 1 else np.zeros_like(middle)
    moves = np.hypot(*d.T) > 0.02
    course: Float = np.where(moves, np.arctan2(d[:, 1], d[:, 0]), yaw)
    return course


def _settled(values: Float, gone: Float) -> Float:
    """Values at metres ``gone``, averaged over a metre: tyres and springs take steps softly."""
    if len(values) < 2 or gone[-1] - gone[0] < 0.5:
        return np.full(len(values), values.mean()) if len(values) else values
    even = np.arange(gone[0] - 1.0, gone[-1] + 1.0, 0.25)
    from scipy.ndimage import gaussian_filter1d  # noqa: PLC0415

    smooth: Float = np.interp(
        gone, even, gaussian_filter1d(np.interp(even, gone, values), 3.0, mode="nearest")
    )
    return smooth

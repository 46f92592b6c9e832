"""Road users other than the ego vehicle, as columns, and their states at any time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.geometry.mesh import Mesh
from geoscene.scene import Scene
from geoscene.support.columns import Columns
from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.world.actor_shapes import ActorShape

Region = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Actors(Columns):
    """Actors, one row each, and the knots of their tracks.

    shapes  : the bodies
    shape   : (n,) int32 body of each actor; of a pedestrian or rider the first pose
    poses   : (n,) int32 number of poses of its cycle: bodies from ``shape`` on
    stride  : (n,) metres covered in one cycle of its poses
    kind    : (n,) str, of `lidar.world.actor_shapes.KINDS`
    klass   : (n,) uint8, `geoscene.classes.Class`
    size    : (n, 3) metres: length, width and height of its bounding box
    stretch : (n, 3) scale factors along x, y and z from the body to the actor
    parked  : (n,) bool, it never moves
    feature : (n,) int32, feature number of the actor's points and pixels, above the scene's numbers
    begin_ns, end_ns : (n,) int64, times of its first and last knot; a parked one is always there
    first   : (n + 1,) int64 rows of the knots below

    Knots of each actor, times ascending:

    time_ns  : (k,) int64, nanoseconds since the drive's start
    position : (k, 3) scene metres, centre of the bounding box, on the ground
    angles   : (k, 3) radians: yaw from the x axis (unwrapped), pitch (nose down positive), roll
    velocity : (k, 3) scene metres per second
    travelled : (k,) metres covered
    scale    : scene metres per true metre
    """

    shapes: tuple[ActorShape, ...]
    shape: NDArray[np.int32]
    poses: NDArray[np.int32]
    stride: Float
    kind: NDArray[np.str_]
    klass: NDArray[np.uint8]
    size: Float
    stretch: Float
    parked: NDArray[np.bool_]
    feature: NDArray[np.int32]
    begin_ns: NDArray[np.int64]
    end_ns: NDArray[np.int64]
    first: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    position: Float
    angles: Float
    velocity: Float
    travelled: Float
    scale: float


KNOTS = ("time_ns", "position", "angles", "velocity", "travelled")
"""Columns of `Actors` with a row for each knot."""


@dataclass(frozen=True, slots=True)
class States(Columns):
    """Actors at one moment each.

    position : (k, 3) scene metres, centre of the bounding box, on the ground
    angles   : (k, 3) yaw, pitch, roll in radians
    velocity : (k, 3) scene metres per second
    travelled : (k,) metres covered
    """

    position: Float
    angles: Float
    velocity: Float
    travelled: Float


def existing_actors(actors: Actors, start_ns: int, *, end_ns: int) -> NDArray[np.int64]:
    """Actors (k,) that exist at some time of a span."""
    return np.flatnonzero(actors.parked | ((actors.begin_ns <= end_ns) & (actors.end_ns >= start_ns)))


def states(actors: Actors, rows: ArrayLike, *, time_ns: ArrayLike) -> States:
    """States of actors (k,) at times (k,); constant beyond the ends of their tracks.

    Cubic between knots in position (Hermite, with the knots' velocities), linear in angles.
    """
    which = np.asarray(rows, np.int64)
    first, last = actors.first[which], actors.first[which + 1] - 1
    t = np.clip(np.asarray(time_ns, np.int64), actors.begin_ns[which], actors.end_ns[which])
    low = _knots_before(actors.time_ns, first, last, t)
    high = np.minimum(low + 1, last)
    span = np.maximum(actors.time_ns[high] - actors.time_ns[low], 1) * 1e-9
    w = ((t - actors.time_ns[low]) * 1e-9 / span)[:, None]
    h = span[:, None]
    p0, p1, v0, v1 = actors.position[low], actors.position[high], actors.velocity[low], actors.velocity[high]
    position = (
        (1 + 2 * w) * (1 - w) ** 2 * p0
        + w * (1 - w) ** 2 * h * v0
        + w**2 * (3 - 2 * w) * p1
        - w**2 * (1 - w) * h * v1
    )
    velocity = 6 * w * (1 - w) * (p1 - p0) / h + (1 - w) * (1 - 3 * w) * v0 + w * (3 * w - 2) * v1
    return States(
        position,
        actors.angles[low] + w * (actors.angles[high] - actors.angles[low]),
        velocity,
        actors.travelled[low] + w[:, 0] * (actors.travelled[high] - actors.travelled[low]),
    )


@njit(cache=True, nogil=True)
def _knots_before(time_ns: Any, first: Any, last: Any, t: Any) -> Any:  # noqa: PLR0917 - compiled
    """Rows (k,) of the knots at or before times (k,), of ``first`` to ``last``; the last only if alone."""
    out = np.empty(len(first), np.int64)
    for k in range(len(first)):
        low, high = first[k], max(last[k], first[k] + 1)
        while high - low > 1:
            middle = (low + high) // 2
            if time_ns[middle] <= t[k]:
                low = middle
            else:
                high = middle
        out[k] = low
    return out


def velocities(actors: Actors, time_ns: int) -> Float:
    """Velocities (n, 3) of all actors at a time, scene metres per second."""
    return states(actors, np.arange(len(actors)), time_ns=time_ns).velocity


def rotations(angles: Float) -> Float:
    """Rotations (k, 3, 3) from body to scene axes for yaw, pitch and roll (k, 3): about z, then y, then x."""
    (cy, cp, cr), (sy, sp, sr) = np.cos(angles).T, np.sin(angles).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def actor_shapes(actors: Actors) -> list[Mesh]:
    """The bodies, for ``World.load(..., actors=...)``."""
    return [shape.mesh for shape in actors.shapes]


def poses_of(actors: Actors, rows: NDArray[np.int64], *, at: States) -> NDArray[np.int32]:
    """Bodies (k,) of actors in their states: pedestrians and riders have the pose of their stride."""
    step = at.travelled / actors.stride[rows] * actors.poses[rows]
    return actors.shape[rows] + step.astype(np.int32) % actors.poses[rows]


def actor_transforms(
    actors: Actors,
    start_ns: int,
    *,
    end_ns: int,
    region: Region | None = None,
    moments: int = 3,
    which: Literal["all", "moving", "parked"] = "all",
) -> tuple[NDArray[np.int32], Float, NDArray[np.int32]]:
    """Bodies (k,), transforms (k, moments, 3, 4) and features (k,) over a span, for `World.place_actors`.

    start_ns, end_ns : the times that ray times 0 and 1 stand for
    region  : (xmin, ymin, xmax, ymax) outside which actors are left out
    which   : those that ever move, those that never do, or all
    moments : poses within the span; a car that turns at 0.5 rad/s is off by 0.1 mm between three in 0.1 s
    """
    rows = existing_actors(actors, start_ns, end_ns=end_ns)
    if which != "all":
        rows = rows[actors.parked[rows] == (which == "parked")]
    times = np.linspace(start_ns, end_ns, moments).astype(np.int64)
    if region is not None:
        rows = rows[_within(actors, rows, region=region, time_ns=int(times[0]))]
    k = len(rows)
    at = states(actors, np.repeat(rows, moments), time_ns=np.tile(times, k))
    turn = rotations(at.angles) * actors.stretch[np.repeat(rows, moments), None, :]
    turn[:, :2] *= actors.scale
    transform = np.concatenate([turn, at.position[:, :, None]], axis=2).reshape(k, moments, 3, 4)
    shape = poses_of(actors, rows, at=at.take(slice(None, None, moments)))
    return shape.astype(np.int32), transform, actors.feature[rows]


def _within(actors: Actors, rows: NDArray[np.int64], *, region: Region, time_ns: int) -> NDArray[np.bool_]:
    """Whether (k,) actors are in a region at a time, or no further beyond it than they are long."""
    x, y = states(actors, rows, time_ns=time_ns).position[:, :2].T
    reach = actors.size[rows, 0]
    inside: NDArray[np.bool_] = (
        (x > region[0] - reach) & (x < region[2] + reach) & (y > region[1] - reach) & (y < region[3] + reach)
    )
    return inside


def join_actors(groups: Sequence[Actors], *, first_feature: int) -> Actors:
    """Actors of several groups as one, features numbered from ``first_feature``."""
    shapes: dict[str, ActorShape] = {}
    for group in groups:
        shapes |= {shape.name: shape for shape in group.shapes}
    number = {name: k for k, name in enumerate(shapes)}
    shape = np.concatenate(
        [
            np.array([number[s.name] for s in g.shapes], np.int32)[g.shape] if len(g) else g.shape
            for g in groups
        ]
    )
    knots = np.concatenate([np.diff(g.first) for g in groups])
    columns = {
        name: np.concatenate([getattr(g, name) for g in groups])
        for name in groups[0].columns()
        if name not in ("shape", "feature", "first")
    }
    return Actors(
        shapes=tuple(shapes.values()),
        shape=shape,
        feature=(first_feature + np.arange(len(shape))).astype(np.int32),
        first=np.concatenate([[0], np.cumsum(knots)]).astype(np.int64),
        scale=groups[0].scale,
        **columns,
    )


def first_feature(scene: Scene) -> int:
    """The first unused feature number of a scene."""
    return max((stop for _, stop in scene.layers.values()), default=0)

"""Actors from simulated or recorded motion: tracks in plan become poses on the scene's ground."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.scene import Scene
from geoscene.support.columns import Columns
from geoscene.typing import Float, Ints
from lidar.traffic.lanes import STEP
from lidar.traffic.simulation import SimulatedTrips
from lidar.traffic.simulation_kernel import STEP_S
from lidar.traffic.trips import Trip
from lidar.world.actor_shapes import STRIDE, ActorShape, catalogue
from lidar.world.actors import Actors
from lidar.world.ground import ground_heights

_POSES = {"cyclist": STRIDE, "adult": STRIDE, "small_adult": STRIDE, "child": STRIDE}
_STRIDE = {"cyclist": 5.6, "adult": 1.45, "small_adult": 1.35, "child": 1.05}
"""Metres in a stride of two steps, and in a turn of a bicycle's pedals: typical."""

_UPRIGHT = ("adult", "small_adult", "child")
_LEANING = ("cyclist", "motorcycle")
_TRACK = 0.8  # track width over body width
_KNOTS = 1 << 16  # knots whose ground is looked for at once
_SKY = 1e4  # metres above and below zero within which the ground is searched
_STEP_UP = 0.5  # metres, maximum height difference between a wheel and the centre
_STEEP, _BANKED = 0.3, 0.15  # radians, maximum pitch and roll


def actor_table(
    shapes: Sequence[ActorShape],
    stretch: ArrayLike,
    *,
    knots: Ints,
    motion: Knots,
    parked: bool,
    scale: float,
) -> Actors:
    """Actors (n) with ``knots`` (n,) rows of motion each, which are not copied; feature numbers are zero."""
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
    ends = np.concatenate([[0], np.cumsum(knots)]).astype(np.int64)
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
        begin_ns=motion.time_ns[ends[:-1]],
        end_ns=motion.time_ns[ends[1:] - 1],
        first=ends,
        scale=scale,
        **motion.columns(),
    )


def moving_actors(trips: Sequence[Trip], flow: SimulatedTrips, *, scene: Scene, scale: float) -> Actors:
    """Actors of the trips that appeared in a simulation, while they are on the scene.

    Streets may lead beyond the bounds of a map, where there is no ground. A road user that comes back is
    another actor.
    """
    n, counts = len(flow), np.bincount(flow.trip, minlength=len(trips))
    present, first = np.flatnonzero(counts), np.cumsum(counts) - counts
    position, angles, velocity = np.empty((3, n, 3))
    knots = Knots(np.empty(n, np.int64), position, angles, velocity, np.empty(n))
    inside = np.empty(n, bool)
    for some in _together(present, trips, counts=counts):  # in order of time: they are near each other
        rows = np.concatenate([np.arange(first[row], first[row] + counts[row]) for row in some])
        tracks = _tracks([trips[row] for row in some], flow.take(rows), counts=counts[some])
        part = knots_on_ground(scene, tracks, scale=scale)
        for name, column in knots.columns().items():
            column[rows] = getattr(part, name)
        half = np.repeat(
            [np.hypot(trips[row].length, trips[row].width) / 2 * scale for row in some], counts[some]
        )
        inside[rows] = _inside(scene, part.position, half=half)
    trip, counts = present, counts[present]
    if not inside.all():
        knots, trip, counts = _parts_inside(knots, inside, trip=present, counts=counts)
    return actor_table(
        [trips[row].shape for row in trip.tolist()],
        [trips[row].stretch for row in trip.tolist()],
        knots=counts,
        motion=knots,
        parked=False,
        scale=scale,
    )


def _inside(scene: Scene, position: Float, *, half: Float) -> NDArray[np.bool_]:
    """Whether (n,) bodies of half diagonals (n,) at positions (n, 3) are within the scene's bounds."""
    low, high = np.reshape(scene.bounds, (2, 2))
    xy = position[:, :2]
    return np.asarray(((xy - half[:, None] >= low) & (xy + half[:, None] <= high)).all(axis=1), np.bool_)


def _parts_inside(
    knots: Knots, inside: NDArray[np.bool_], *, trip: Ints, counts: Ints
) -> tuple[Knots, Ints, Ints]:
    """The knots inside, and of each uninterrupted part its trip and its number of knots, two or more."""
    of = np.where(inside, np.repeat(trip, counts), -1)
    starts = np.flatnonzero(np.diff(of, prepend=-2))
    sizes = np.diff(starts, append=len(of))
    part = (of[starts] >= 0) & (sizes > 1)
    return knots.take(np.repeat(part, sizes)), of[starts[part]], sizes[part]


def _together(rows: Ints, trips: Sequence[Trip], *, counts: Ints) -> Iterator[list[int]]:
    """Trips in order of appearance, as many at once as have about `_KNOTS` knots."""
    order = rows[np.argsort([trips[row].appear_s for row in rows.tolist()], kind="stable")]
    block = np.cumsum(counts[order]) // _KNOTS
    for some in np.split(order, np.flatnonzero(np.diff(block)) + 1):
        if len(some):
            yield some.tolist()


def _tracks(trips: Sequence[Trip], flow: SimulatedTrips, *, counts: Ints) -> RoadUserTracks:
    """Tracks of trips from their motion (k,), one after another; ``counts`` are their numbers of rows."""
    ends = np.concatenate([[0], np.cumsum(counts)])
    n = len(flow.trip)
    middle, yaw, hint = np.empty((n, 2)), np.empty(n), np.empty(n)
    for k, trip in enumerate(trips):
        part, path = slice(ends[k], ends[k + 1]), trip.course.path
        at = flow.travelled[part] / STEP
        xy, heading = trip.body()
        stations = np.arange(len(xy))
        middle[part] = np.stack([np.interp(at, stations, xy[:, c]) for c in (0, 1)], axis=1)
        yaw[part] = np.interp(at, stations, heading)
        hint[part] = np.interp(at, stations, path.xyz[:, 2])
    return RoadUserTracks(
        shapes=[trip.shape for trip in trips],
        stretch=[trip.stretch for trip in trips],
        knots=counts,
        step=flow.step,
        middle=middle,
        yaw=yaw,
        hint=hint,
        speed=flow.speed,
        travelled=flow.travelled,
    )


@dataclass(frozen=True, slots=True)
class Knots(Columns):
    """Knots of actors, one after another: the columns of `lidar.world.actors.KNOTS`."""

    time_ns: Ints
    position: Float
    angles: Float
    velocity: Float
    travelled: Float


@dataclass(frozen=True, slots=True)
class RoadUserTracks:
    """Motion of road users (n) in plan; each has ``knots`` of the rows (k), which are `STEP_S` apart.

    shapes      : (n,) bodies
    stretch     : (n,) scale factors of the bodies along x, y and z
    knots       : (n,)
    step        : (k,) number of `STEP_S` since the drive's start
    middle, yaw : (k, 2) scene metres of the body's centre and (k,) radians, unwrapped
    hint        : (k,) metres, approximate height of the ground; NaN for the topmost surface
    speed, travelled : (k,) m/s and metres covered
    """

    shapes: Sequence[ActorShape]
    stretch: Sequence[tuple[float, float, float]]
    knots: NDArray[np.int64]
    step: NDArray[np.integer]
    middle: Float
    yaw: Float
    hint: Float
    speed: Float
    travelled: Float


def actors_on_ground(scene: Scene, tracks: RoadUserTracks, *, scale: float) -> Actors:
    """Actors (n) that follow tracks on the scene's ground."""
    motion = knots_on_ground(scene, tracks, scale=scale)
    return actor_table(
        tracks.shapes, tracks.stretch, knots=tracks.knots, motion=motion, parked=False, scale=scale
    )


def knots_on_ground(scene: Scene, tracks: RoadUserTracks, *, scale: float) -> Knots:
    """Knots (k) of actors that follow tracks on the scene's ground."""
    shapes, stretch, knots = tracks.shapes, tracks.stretch, tracks.knots
    middle, yaw, travelled = tracks.middle, tracks.yaw, tracks.travelled
    ends = np.concatenate([[0], np.cumsum(knots)])
    axle = np.repeat([s.base * g[0] for s, g in zip(shapes, stretch, strict=True)], knots)
    track = np.repeat([_TRACK * s.width * g[1] for s, g in zip(shapes, stretch, strict=True)], knots)
    z, pitch, roll, _ = poses_on_ground(
        scene, middle, yaw=yaw, hint=tracks.hint, axle=axle, track=track, scale=scale
    )
    course, climb = np.empty(len(z)), np.empty(len(z))
    for k, shape in enumerate(shapes):
        part = slice(ends[k], ends[k + 1])
        course[part] = _course(middle[part], yaw[part])
        for column in (z, pitch, roll):
            column[part] = _smooth(column[part], travelled[part])
        pitch[part] *= shape.kind not in _UPRIGHT
        roll[part] *= shape.kind not in _UPRIGHT and shape.kind not in _LEANING
        climb[part] = _rate(z[part])
    v = tracks.speed * scale
    return Knots(
        np.round(tracks.step * STEP_S * 1e9).astype(np.int64),
        np.column_stack([middle, z]),
        np.column_stack([yaw, pitch, roll]),
        np.column_stack([v * np.cos(course), v * np.sin(course), climb]),
        travelled,
    )


def poses_on_ground(
    scene: Scene, middle: Float, *, yaw: Float, hint: Float, axle: Float, track: Float, scale: float
) -> tuple[Float, Float, Float, NDArray[np.bool_]]:
    """Height (n,), pitch (nose down positive) and roll of bodies with four wheels on the ground.

    The last column (n,) is whether there is ground under the centre and under each wheel. A wheel without
    ground is at the height of the centre, a centre without ground at the height of the hint.

    middle, yaw : (n, 2) scene metres and (n,) radians
    hint        : (n,) approximate height of the ground; NaN for the topmost surface
    axle, track : (n,) true metres between axles and between wheels
    """
    known = np.isfinite(hint)
    points = np.column_stack([middle, np.where(known, hint, 0.0)])
    under = np.empty(len(points))
    under[known] = ground_heights(scene, points[known])
    under[~known] = ground_heights(scene, points[~known], above=_SKY, below=_SKY)
    sound = np.isfinite(under)
    points[sound, 2] = under[sound]
    c, s = np.cos(yaw) * scale / 2, np.sin(yaw) * scale / 2
    z = np.empty((len(points), 2, 2))
    for a, fore in enumerate((1, -1)):
        for b, left in enumerate((1, -1)):
            wheel = points.copy()
            wheel[:, 0] += fore * axle * c - left * track * s
            wheel[:, 1] += fore * axle * s + left * track * c
            under = ground_heights(scene, wheel, above=_STEP_UP, below=_STEP_UP)
            sound &= np.isfinite(under)
            z[:, a, b] = np.where(np.isfinite(under), under, points[:, 2])
    pitch = np.arctan2(z[:, 1].mean(axis=1) - z[:, 0].mean(axis=1), axle)
    roll = np.arctan2(z[:, :, 0].mean(axis=1) - z[:, :, 1].mean(axis=1), track)
    steep = (np.abs(pitch) > _STEEP) | (np.abs(roll) > _BANKED)
    height = np.where(steep, points[:, 2], z.mean(axis=(1, 2)))
    return height, np.clip(pitch, -_STEEP, _STEEP), np.clip(roll, -_BANKED, _BANKED), sound & ~steep


def _rate(values: Float) -> Float:
    """Change of values at knots `STEP_S` apart, per second."""
    return np.gradient(values, STEP_S) if len(values) > 1 else np.zeros(len(values))


def _course(middle: Float, yaw: Float) -> Float:
    """Direction of motion (n,) in radians; the heading of the body while it is at rest."""
    d = np.gradient(middle, axis=0) if len(middle) > 1 else np.zeros_like(middle)
    moves = np.hypot(*d.T) > 0.02
    return np.where(moves, np.arctan2(d[:, 1], d[:, 0]), yaw)


def _smooth(values: Float, travelled: Float) -> Float:
    """Values at metres ``travelled``, smoothed over a metre as by tyres and springs."""
    if len(values) < 2 or travelled[-1] - travelled[0] < 0.5:
        return np.full(len(values), values.mean()) if len(values) else values
    even = np.arange(travelled[0] - 1.0, travelled[-1] + 1.0, 0.25)
    from scipy.ndimage import gaussian_filter1d  # noqa: PLC0415

    smooth: Float = np.interp(
        travelled, even, gaussian_filter1d(np.interp(even, travelled, values), 3.0, mode="nearest")
    )
    return smooth

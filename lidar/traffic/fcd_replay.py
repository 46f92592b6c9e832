"""Replay of SUMO's floating car data as road users of a scene."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry import polylines
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.routing import edge_lines
from geoscene.scene import Scene
from geoscene.typing import Float, Ints
from lidar.errors import InputError
from lidar.geometry.poses import Trajectory
from lidar.geometry.random_streams import generator
from lidar.motion.vehicle import Vehicle
from lidar.traffic.fcd import Fcd, read_fcd
from lidar.traffic.options import TrafficFile, TrafficOptions
from lidar.traffic.populate import TrafficSetup, parked_vehicles, traffic_setup
from lidar.traffic.simulation_kernel import STEP_S
from lidar.traffic.surroundings import LEFT
from lidar.traffic.sweep import rectangles
from lidar.traffic.tracks import RoadUserTracks, actors_on_ground
from lidar.traffic.trips import VEHICLE_SHARES, random_shape, random_stretch
from lidar.world.actor_shapes import ActorShape
from lidar.world.actors import KNOTS, Actors, existing_actors, first_feature, join_actors, states

_KINDS: dict[str, tuple[str, ...]] = {
    "passenger": ("sedan", "hatchback", "suv"),
    "taxi": ("sedan",),
    "emergency": ("van",),
    "delivery": ("van",),
    "truck": ("truck",),
    "trailer": ("truck",),
    "bus": ("bus",),
    "coach": ("bus",),
    "motorcycle": ("motorcycle",),
    "moped": ("motorcycle",),
    "bicycle": ("cyclist",),
    "pedestrian": ("adult", "small_adult"),
}
"""Kinds of bodies for SUMO's vehicle classes."""
_SHORTER = 0.85  # minimum scale factor of a body that is longer than SUMO's vehicle
_JUMP = (2.0, 8.0)  # a move of more than this factor of speed * time plus metres is a teleport
_SLOW, _FAST = 5.0, 20.0  # m/s, minimum of the speed in that test, and its default
_PAUSE = 1.5  # steps between rows from which a road user was absent
_ASIDE = (1.0, 2.0)  # metres per step, and m/s, sideways, of an instantaneous lane change
_CHANGE_S = 3.0  # seconds over which it is spread
_NEAR = 12.0  # metres in plan, maximum distance of a road user from its road
_AGAINST = 8.0  # metres added to the distance of a road in the opposite direction
_ROOM = (0.6, 0.3)  # metres added to the ego's length and width in collision checks


def replay(
    scene: Scene,
    graph: RoadGraph,
    *,
    ego: Trajectory,
    vehicle: Vehicle,
    seed: int,
    options: TrafficFile,
) -> Actors:
    """The road users of a file of SUMO around the ego vehicle, and parked vehicles clear of their paths.

    Between SUMO's steps positions are cubic, never backwards, and headings linear; instantaneous lane changes
    are spread over three seconds. Road users that would collide with the ego are left out, as they do not
    react to it. Bodies depend on the seed and SUMO's ids.

    Raises FormatError for an invalid file, InputError if no road user of it comes near the ego.
    """
    fcd = read_fcd(options.path, net=options.net)
    begin = float(fcd.time.min()) if options.begin is None else options.begin
    parked_only = TrafficOptions(
        vehicles=0.0,
        cyclists=0.0,
        pedestrians=0.0,
        parked=options.parked,
        radius=options.radius,
        side=options.side,
    )
    setup = traffic_setup(scene, graph, ego=ego, seed=seed, options=parked_only)
    moving = _moving(fcd, begin, setup=setup, ego=ego, vehicle=vehicle)
    parked = parked_vehicles(setup, ego, vehicle=vehicle, swept=[_bounding_boxes(moving)])
    return join_actors([moving, parked], first_feature=first_feature(scene))


def _moving(fcd: Fcd, begin: float, *, setup: TrafficSetup, ego: Trajectory, vehicle: Vehicle) -> Actors:
    """The moving road users of a file in the ego's surroundings."""
    scene, scale = setup.scene, setup.scale
    front, heading = _scene_positions(fcd, scene)
    shapes, stretch, parts = [], [], []
    any_in_scene = False
    for k, name in enumerate(fcd.name):
        rows = slice(fcd.first[k], fcd.first[k + 1])
        rng = generator(setup.seed, "traffic", "fcd", name)
        shape, grow = _body(fcd.vclass[k], float(fcd.length[k]), rng=rng)
        back = shape.length * grow[0] / 2 * scale if fcd.vclass[k] != "pedestrian" else 0.0
        time = fcd.time[rows] - begin
        for run in _runs(time, front[rows], speed=fcd.speed[rows], scale=scale):
            yaw = np.unwrap(heading[rows][run])
            middle = front[rows][run] - back * np.column_stack([np.cos(yaw), np.sin(yaw)])
            track = _sample(time[run], middle, yaw=yaw, until=ego.duration_ns * 1e-9)
            any_in_scene |= len(track) > 0 and bool(_inside(track[:, 1:3], scene.bounds).any())
            for part in _parts_near_ego(track, scene, ego=ego, radius=setup.area.radius * scale):
                shapes.append(shape)
                stretch.append(grow)
                parts.append(part)
    if not parts:
        raise InputError(_no_road_users(fcd, begin, any_in_scene=any_in_scene))
    knots = np.array([len(part) for part in parts], np.int64)
    step, x, y, yaw, travelled = np.concatenate(parts).T
    speed = np.concatenate([_monotone(np.diff(part[:, 4]) / STEP_S) for part in parts]) / scale
    middle = np.column_stack([x, y])
    foot = np.repeat([shape.kind in _KINDS["pedestrian"] for shape in shapes], knots)
    tracks = RoadUserTracks(
        shapes=shapes,
        stretch=stretch,
        knots=knots,
        step=np.round(step).astype(np.int64),
        middle=middle,
        yaw=yaw,
        hint=_hints(setup.graph, middle, yaw=yaw, foot=foot),
        speed=speed,
        travelled=travelled / scale,
    )
    actors = actors_on_ground(scene, tracks, scale=scale)
    return _without(actors, _find_touched(actors, ego, vehicle=vehicle))


def _no_road_users(fcd: Fcd, begin: float, *, any_in_scene: bool) -> str:
    """Error message for a file without road users near the ego."""
    if any_in_scene:
        return "traffic: no road user of the file comes near the ego; raise radius or choose another route"
    first, last = float(fcd.time.min()), float(fcd.time.max())
    if begin >= last or begin < first - 86_400:
        return f"traffic: begin={begin:g}: the file has seconds {first:g} to {last:g}"
    lat, lon = float(np.median(fcd.lat)), float(np.median(fcd.lon))
    return (
        f"traffic: none of the {len(fcd.name)} road users in the file is in the scene during the drive;"
        f" they are near {lat:.4f},{lon:.4f}: is the network one of this place?"
    )


def _scene_positions(fcd: Fcd, scene: Scene) -> tuple[Float, Float]:
    """Middles of front bumpers (k, 2) in scene metres, and headings (k,) in radians from the x axis."""
    front = np.column_stack(scene.frame.from_geographic(fcd.lon, fcd.lat))
    d = np.column_stack(scene.frame.from_geographic(*fcd.ahead.T)) - front
    return front, np.arctan2(d[:, 1], d[:, 0])


def _body(
    vclass: str, length: float, *, rng: np.random.Generator
) -> tuple[ActorShape, tuple[float, float, float]]:
    """A body of a class and its scale factors; not longer than SUMO's vehicle if `_SHORTER` permits."""
    kinds = _KINDS[vclass]
    weight = np.cumsum([VEHICLE_SHARES.get(kind, 1.0) for kind in kinds])
    shape = random_shape(kinds[int(np.searchsorted(weight, rng.random() * weight[-1], side="right"))], rng)
    x, y, z = random_stretch(rng)
    if vclass != "pedestrian":
        x = max(min(x, length / shape.length), _SHORTER)
    return shape, (x, y, z)


def _runs(time: Float, front: Float, *, speed: Float, scale: float) -> list[slice]:
    """Runs of rows of one road user without absence or teleport."""
    if len(time) < 2:
        return []
    dt = np.diff(time)
    moved = np.hypot(*np.diff(front, axis=0).T) / scale
    reported = np.maximum(speed[:-1], speed[1:])
    usual = max(_FAST, float(np.median(moved / dt)))
    most = np.where(np.isfinite(reported), np.maximum(reported, _SLOW), usual)
    cut = (dt > _PAUSE * np.median(dt)) | (moved > _JUMP[0] * most * dt + _JUMP[1]) | (dt <= 0)
    ends = [0, *(np.flatnonzero(cut) + 1).tolist(), len(time)]
    return [slice(a, b) for a, b in itertools.pairwise(ends) if b - a > 1]


def _sample(time: Float, middle: Float, *, yaw: Float, until: float) -> Float:
    """Rows (k, 5) of step, x, y, yaw and scene metres covered, every `STEP_S` of the drive."""
    spread, aside = _changes(time, middle, yaw=yaw)
    chord = np.hypot(*np.diff(spread, axis=0).T)
    slope = chord / np.diff(time)
    speed = _monotone(slope)
    velocity = speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
    first, last = (
        max(int(np.ceil(time[0] / STEP_S - 1e-6)), 0),
        int(np.floor(min(time[-1], until) / STEP_S + 1e-6)),
    )
    step = np.arange(first, last + 1)
    if len(step) < 2:
        return np.empty((0, 5))
    from scipy.interpolate import CubicHermiteSpline  # noqa: PLC0415  (slow to import)

    t = step * STEP_S
    xy = CubicHermiteSpline(time, spread, velocity)(np.clip(t, time[0], time[-1]))
    for moment, offset in aside:
        u = np.clip((t - moment) / _CHANGE_S + 0.5, 0.0, 1.0)
        xy += (u**3 * (10 - 15 * u + 6 * u**2))[:, None] * offset
    travelled = polylines.stations(xy)
    return np.column_stack([step, xy, np.interp(t, time, yaw), travelled])


def _monotone(slope: Float) -> Float:
    """Speeds (n + 1,) at the knots of even steps of mean speeds (n,) for a monotone cubic.

    Harmonic means: Fritsch and Butland, "A method for constructing local monotone piecewise cubic
    interpolants", 1984.
    """
    a, b = slope[:-1], slope[1:]
    middle = np.divide(2 * a * b, a + b, out=np.zeros_like(a), where=(a > 1e-3) & (b > 1e-3))
    return np.concatenate([slope[:1], middle, slope[-1:]])


def _changes(time: Float, middle: Float, *, yaw: Float) -> tuple[Float, list[tuple[float, Float]]]:
    """Centres (n, 2) without instantaneous lane changes, and these: mean time in seconds, and offset."""
    d, dt = np.diff(middle, axis=0), np.diff(time)
    mean = (yaw[:-1] + yaw[1:]) / 2
    left = np.column_stack([-np.sin(mean), np.cos(mean)])
    sideways = (d * left).sum(axis=1)
    straight = np.abs(np.diff(yaw)) < np.radians(15.0)
    rows = np.flatnonzero(straight & (np.abs(sideways) > np.maximum(_ASIDE[0], _ASIDE[1] * dt)))
    out = middle.copy()
    found = []
    for k in rows.tolist():
        offset = sideways[k] * left[k]
        out[k + 1 :] -= offset
        found.append((float(time[k] + time[k + 1]) / 2, offset))
    return out, found


def _inside(xy: Float, bounds: tuple[float, float, float, float]) -> NDArray[np.bool_]:
    return np.asarray(((xy >= bounds[:2]) & (xy <= bounds[2:])).all(axis=1), np.bool_)


def _parts_near_ego(track: Float, scene: Scene, *, ego: Trajectory, radius: float) -> list[Float]:
    """Parts of a track that are on the map and within ``radius`` of the ego."""
    if not len(track):
        return []
    at = ego.at(np.round(track[:, 0] * STEP_S * 1e9).astype(np.int64).clip(max=ego.duration_ns)).position[
        :, :2
    ]
    away = np.hypot(*(track[:, 1:3] - at).T)
    here = _inside(track[:, 1:3], scene.bounds) & (away <= radius + LEFT)
    cuts = np.flatnonzero(np.diff(np.concatenate([[False], here, [False]]).astype(int)))
    return [
        track[a:b]
        for a, b in zip(cuts[::2].tolist(), cuts[1::2].tolist(), strict=True)
        if b - a > 1 and away[a:b].min() <= radius
    ]


def _hints(graph: RoadGraph, xy: Float, *, yaw: Float, foot: NDArray[np.bool_]) -> Float:
    """Height (n,) of the nearest road in the direction of each position; NaN without one.

    foot : (n,) bool, pedestrian: roads in all directions count
    """
    lines = edge_lines(graph)
    points = shapely.points(xy)
    row, edge = shapely.STRtree(lines).query(points, predicate="dwithin", distance=_NEAR)
    out = np.full(len(xy), np.nan)
    if not len(row):
        return out
    along = shapely.line_locate_point(lines[edge], points[row])
    length = shapely.length(lines[edge])
    course = np.arctan2(*polylines.directions(lines[edge], along, reach=0.5).T[::-1])
    cost = shapely.distance(lines[edge], points[row])
    cost += np.where(foot[row], 0.0, _AGAINST / 2 * (1 - np.cos(yaw[row] - course)))
    solid = np.array([shapely.linestrings(line) for line in graph.geometry], object)
    share = np.divide(along, length, out=np.zeros_like(along), where=length > 0)
    z = shapely.get_z(shapely.line_interpolate_point(solid[edge], share, normalized=True))
    order = np.lexsort((-cost, row))
    out[row[order]] = z[order]
    return out


def _find_touched(actors: Actors, ego: Trajectory, *, vehicle: Vehicle) -> Ints:
    """Rows of the actors whose bounding box the ego's intersects at any time."""
    hit: list[Ints] = []
    scale = actors.scale
    length, width = (size + room for size, room in zip((vehicle.length, vehicle.width), _ROOM, strict=True))
    for t in range(0, ego.duration_ns + 1, round(STEP_S * 1e9)):
        pose = ego.at([t])
        forward = pose.rotation[0, :2, 0]
        rows = existing_actors(actors, t, end_ns=t)
        at = states(actors, rows, time_ns=t)
        near = (
            np.hypot(*(at.position[:, :2] - pose.position[0, :2]).T) < (actors.size[rows, 0] + 10.0) * scale
        )
        near &= np.abs(at.position[:, 2] - pose.position[0, 2]) < 3.0
        if not near.any():
            continue
        middle = pose.position[0, :2] + scale * forward * vehicle.middle
        own = rectangles(
            middle[None], np.arctan2(forward[1:], forward[:1]), length=length * scale, width=width * scale
        )[0]
        size = actors.size[rows[near]] * scale
        boxes = rectangles(at.position[near, :2], at.angles[near, 0], length=size[:, 0], width=size[:, 1])
        hit.append(rows[near][shapely.intersects(boxes, own)])
    return np.unique(np.concatenate(hit)) if hit else np.empty(0, np.int64)


def _without(actors: Actors, rows: Ints) -> Actors:
    """The actors without some rows."""
    keep = np.ones(len(actors), bool)
    keep[rows] = False
    knots = np.diff(actors.first)
    kept = np.repeat(keep, knots)
    columns = actors.columns()
    del columns["first"]
    return replace(
        actors,
        **{name: column[kept if name in KNOTS else keep] for name, column in columns.items()},
        first=np.concatenate([[0], np.cumsum(knots[keep])]).astype(np.int64),
    )


def _bounding_boxes(actors: Actors) -> NDArray[np.object_]:
    """Bounding boxes of actors at every fifth knot, with a margin."""
    owner = np.repeat(np.arange(len(actors)), np.diff(actors.first))[::5]
    size = actors.size[owner] * actors.scale
    room = np.hypot(*actors.velocity[::5, :2].T) * STEP_S * 5
    return rectangles(
        actors.position[::5, :2],
        actors.angles[::5, 0],
        length=size[:, 0] + room + 0.5,
        width=size[:, 1] + 0.3,
    )

"""Parked vehicles along kerbs and in parking lots."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry import polylines
from geoscene.scene import Scene
from geoscene.support.columns import Columns
from geoscene.typing import Float
from lidar.geometry.random_streams import generator
from lidar.traffic.lanes import Lanes, edge_name, lane_shift
from lidar.traffic.sweep import rectangles
from lidar.traffic.tracks import Knots, actor_table, poses_on_ground
from lidar.traffic.trips import random_shape
from lidar.world.actors import Actors

PARKED = {"hatchback": 0.37, "sedan": 0.29, "suv": 0.21, "van": 0.09, "parked_motorcycle": 0.04}
"""Shares of the kinds of vehicles in parking spaces: assumed."""
_BICYCLES = 0.2  # bicycles on the sidewalk per occupied parking space: assumed
_ASIDE = 0.5  # metres from the kerb to a bicycle on the sidewalk
_FREE = 1.3  # metres beside the lane centre that stay free: half a car and a margin
_OVER = 0.35  # metres that a car's centre may be beyond the kerb in narrow streets
_ROOM, _BETWEEN = 0.2, 0.4  # metres to obstacles, and to each other
_QUIET = ("residential", "living_street", "unclassified", "tertiary", "service")
_BUSY = ("secondary", "primary")
_FAST = 14.5  # m/s, speed limit from which no vehicle parks at the kerb
_SLOT = (2.5, 5.2)  # metres of a place in a parking lot
_AISLE = 6.0


@dataclass(frozen=True, slots=True)
class ParkingSpaces(Columns):
    """Parking spaces.

    xy      : (n, 2) scene metres, the middle of the box
    heading : (n,) radians
    hint    : (n,) metres, height near which the ground is; NaN for the topmost
    narrow  : (n,) whether there is room for a bicycle only
    """

    xy: Float
    heading: Float
    hint: Float
    narrow: NDArray[np.bool_]


NO_SPACES = ParkingSpaces(np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0, np.bool_))
"""No parking spaces."""


def kerb_spaces(lanes: Lanes, near: NDArray[np.bool_], *, seed: int, share: float) -> ParkingSpaces:
    """A random share of the spaces along kerbs of the edges ``near``, and for bicycles beside them."""
    g = lanes.graph
    found: list[ParkingSpaces] = []
    for e in np.flatnonzero(near).tolist():
        kind = str(g.highway[e])
        slow = g.speed[e] < _FAST and not (g.bridge[e] or g.tunnel[e])
        if not slow or g.length[e] < 15.0 or kind not in (*_QUIET, *_BUSY):
            continue
        rng = generator(seed, "parked", "kerb", edge_name(g, e))
        lane = lane_shift(lanes, e, lane=0, width=1.82)
        # the inner side of a one-way street of several lanes is a median as likely as not
        alone = g.twin[e] < 0 and lanes.count[e] == 1 and kind in _QUIET
        both = (lanes.side, -lanes.side) if alone else (lanes.side,)
        for side in both:
            inner = lane if side == lanes.side else -lane
            out = max(float(g.width[e]) / 2 - 0.92 - 0.15, inner + _FREE + 0.92)
            if out > float(g.width[e]) / 2 + (_OVER if kind in _QUIET else -0.9):
                continue
            turned = np.pi if side != lanes.side else 0.0
            beside = float(g.width[e]) / 2 + _ASIDE
            for aside, chance, narrow in ((out, share, False), (beside, share * _BICYCLES, True)):
                line = polylines.parallel(g.geometry[e], -side * aside)
                found.append(_row(line, turned, share=chance, narrow=narrow, rng=rng))
    return ParkingSpaces.concatenate(found) if found else NO_SPACES


def _row(
    line: Float, turned: float, *, share: float, narrow: bool, rng: np.random.Generator
) -> ParkingSpaces:
    """A random share of the spaces along a line; ``turned`` is the angle from the line to the vehicles."""
    along = polylines.stations(line)
    at = np.arange(4.0 + rng.uniform(0, 2.0), along[-1] - 4.0, 5.9)
    at = at + rng.uniform(-0.25, 0.25, len(at))
    at = at[rng.random(len(at)) < share]
    d = polylines.points_at(line, at + 0.5, along=along) - polylines.points_at(line, at - 0.5, along=along)
    spots = polylines.points_at(line, at, along=along)
    heading = np.arctan2(d[:, 1], d[:, 0]) + turned + rng.normal(0.0, 0.012, len(at))
    return ParkingSpaces(spots[:, :2], heading, spots[:, 2], np.full(len(at), narrow))


def lot_spaces(lots: NDArray[np.object_], *, seed: int, share: float) -> ParkingSpaces:
    """A random share of the spaces in parking lots: rows along the longer side, with aisles between pairs."""
    xy, heading = [], []
    wide, deep = _SLOT
    for number, lot in enumerate(lots):
        rng = generator(seed, "parked", "lot", number)
        frame = shapely.minimum_rotated_rectangle(lot)
        if frame.geom_type != "Polygon" or lot.area < 30:
            continue
        ring = shapely.get_coordinates(frame)
        sides = np.diff(ring[:3], axis=0)
        long = int(np.argmax(np.hypot(*sides.T)))
        u = sides[long] / np.hypot(*sides[long])
        v = sides[1 - long] / np.hypot(*sides[1 - long])
        origin = ring[1] if long == 1 else ring[0]
        v = v if long == 0 else -v
        size = (float(np.hypot(*sides[long])), float(np.hypot(*sides[1 - long])))
        rows, flips, y = [], [], 0.3
        while y + deep <= size[1]:
            rows.append(y + deep / 2)
            flips.append(len(rows) % 2 == 0)
            y += deep + (_AISLE if len(rows) % 2 else 0.3)
        for y, flip in zip(rows, flips, strict=True):
            at = np.arange(0.4 + wide / 2, size[0] - wide / 2, wide)
            points = origin + at[:, None] * u + y * v
            angle = np.arctan2(v[1], v[0]) + (np.pi if flip else 0.0)
            slot = rectangles(points, np.full(len(at), angle), length=deep, width=wide - 0.2)
            fits = shapely.covered_by(slot, lot) & (rng.random(len(at)) < share)
            backwards = np.where(rng.random(len(at)) < 0.3, np.pi, 0.0)
            xy.append(points[fits])
            heading.append((angle + backwards + rng.normal(0.0, 0.02, len(at)))[fits])
    if not xy:
        return NO_SPACES
    whole = np.concatenate(xy)
    n = len(whole)
    return ParkingSpaces(whole, np.concatenate(heading), np.full(n, np.nan), np.zeros(n, np.bool_))


def parked_actors(
    spots: ParkingSpaces,
    scene: Scene,
    *,
    free: Iterable[NDArray[np.object_]],
    seed: int,
    scale: float,
) -> Actors:
    """Vehicles on the spaces where all wheels have ground and the body touches no obstacle or other vehicle.

    free : obstacles and areas that must stay free, polygons in plan
    """
    n = len(spots.xy)
    rng = generator(seed, "parked", *PARKED)
    kinds = np.where(spots.narrow, "bicycle", rng.choice(list(PARKED), size=n, p=list(PARKED.values())))
    shapes = [random_shape(kind, rng) for kind in kinds.tolist()]
    grow = 1 + rng.uniform(-0.03, 0.03, (n, 3))
    size = np.array([[s.length, s.width, s.base] for s in shapes]).reshape(-1, 3)
    length, width, base = size[:, 0] * grow[:, 0], size[:, 1] * grow[:, 1], size[:, 2] * grow[:, 0]
    boxes = rectangles(spots.xy, spots.heading, length=length * scale, width=width * scale)
    keep = np.ones(n, bool)
    tree = shapely.STRtree(boxes)
    for areas in free:
        keep[tree.query(areas, predicate="dwithin", distance=_ROOM)[1]] = False
    a, b = tree.query(boxes, predicate="dwithin", distance=_BETWEEN)
    for first, second in zip(a[a < b].tolist(), b[a < b].tolist(), strict=True):
        keep[second] &= not keep[first]
    rows = np.flatnonzero(keep)
    *pose, sound = poses_on_ground(
        scene,
        spots.xy[rows],
        yaw=spots.heading[rows],
        hint=spots.hint[rows],
        axle=base[rows],
        track=0.8 * width[rows],
        scale=scale,
    )
    rows = rows[sound]
    height, pitch, roll = (column[sound] for column in pose)
    return actor_table(
        [shapes[k] for k in rows],
        grow[rows],
        knots=np.ones(len(rows), np.int64),
        motion=Knots(
            np.zeros(len(rows), np.int64),
            np.column_stack([spots.xy[rows], height]),
            np.column_stack([spots.heading[rows], pitch, roll]),
            np.zeros((len(rows), 3)),
            np.zeros(len(rows)),
        ),
        parked=True,
        scale=scale,
    )

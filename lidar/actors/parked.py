"""Cars that stand: along kerbs and in parking lots."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.scene import Scene
from lidar.actors.actors import Actors
from lidar.actors.ground import ground_heights
from lidar.actors.lanes import Lanes, beside, lane_shift
from lidar.actors.shapes import PAINTS, catalogue
from lidar.actors.tracks import attitude, table, wheels
from lidar.actors.traffic import pick, rectangles
from lidar.physics.random import generator

Float = NDArray[np.float64]

_KINDS = {"hatchback": 0.38, "sedan": 0.30, "suv": 0.22, "van": 0.10}
_FREE = 1.3  # metres from the middle of the lane that a parked car leaves free: half a car and a hand
_OVER = 0.35  # metres by which a car's middle may stand beyond the kerb where the street is that narrow
_CORNER, _CROSSING = 5.0, 3.0  # metres kept free before junctions and crossings
_STREETS = ("residential", "living_street", "unclassified", "tertiary", "secondary", "primary", "service")
_FAST = 14.5  # m/s from which on nobody parks at the kerb
_SLOT = (2.5, 5.2)  # metres of a place in a parking lot
_AISLE = 6.0


@dataclass(frozen=True, slots=True)
class Spots:
    """Where bodies may stand.

    xy      : (n, 2) scene metres, the middle of the box
    heading : (n,) radians
    hint    : (n,) metres, height near which the ground is
    """

    xy: Float
    heading: Float
    hint: Float


def kerb_spots(lanes: Lanes, near: NDArray[np.bool_], *, seed: int, share: float) -> Spots:
    """Places along kerbs on the edges ``near``, a share of them, at random."""
    g = lanes.graph
    xy, heading, hint = [], [], []
    for e in np.flatnonzero(near).tolist():
        quiet = str(g.highway[e]) in _STREETS and g.speed[e] < _FAST and not (g.bridge[e] or g.tunnel[e])
        if not quiet or g.length[e] < 15.0:
            continue
        rng = generator(seed, "parked", "kerb", e)
        lane = lane_shift(lanes, e, 0, 1.82)
        both = (lanes.side,) if g.twin[e] >= 0 else (lanes.side, -lanes.side)
        for side in both:
            inner = (
                lane
                if g.twin[e] >= 0 or side == lanes.side
                else -lane_shift(lanes, e, int(lanes.count[e]) - 1, 1.82)
            )
            out = max(float(g.width[e]) / 2 - 0.92 - 0.15, inner + _FREE + 0.92)
            if out > float(g.width[e]) / 2 + _OVER:
                continue
            line = beside(g.geometry[e], -side * out)
            along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T))])
            at = np.arange(4.0 + rng.uniform(0, 2.0), along[-1] - 4.0, 5.9)
            at = at + rng.uniform(-0.25, 0.25, len(at))
            at = at[rng.random(len(at)) < share]
            d = [
                np.interp(at + 0.5, along, line[:, c]) - np.interp(at - 0.5, along, line[:, c])
                for c in (0, 1)
            ]
            turned = np.pi if side != lanes.side else 0.0
            xy.append(np.stack([np.interp(at, along, line[:, c]) for c in (0, 1)], axis=1))
            heading.append(np.arctan2(d[1], d[0]) + turned + rng.normal(0.0, 0.012, len(at)))
            hint.append(np.interp(at, along, line[:, 2]))
    if not xy:
        return Spots(np.empty((0, 2)), np.empty(0), np.empty(0))
    return Spots(np.concatenate(xy), np.concatenate(heading), np.concatenate(hint))


def lot_spots(lots: NDArray[np.object_], *, seed: int, share: float) -> Spots:
    """Places in parking lots: rows across the lot's longer side, with aisles between pairs of rows."""
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
            slot = rectangles(points, np.full(len(at), angle), deep, wide - 0.2)
            fits = shapely.covered_by(slot, lot) & (rng.random(len(at)) < share)
            backwards = np.where(rng.random(len(at)) < 0.3, np.pi, 0.0)
            xy.append(points[fits])
            heading.append((angle + backwards + rng.normal(0.0, 0.02, len(at)))[fits])
    if not xy:
        return Spots(np.empty((0, 2)), np.empty(0), np.empty(0))
    whole = np.concatenate(xy)
    return Spots(whole, np.concatenate(heading), np.full(len(whole), np.nan))


def parked_actors(
    spots: Spots, scene: Scene, obstacles: shapely.STRtree, taken: shapely.STRtree, *, seed: int, scale: float
) -> Actors:
    """Cars on the spots where they touch neither an obstacle nor ground that is taken nor another car.

    obstacles : polygons and points that stand there: buildings, poles, trees
    taken     : polygons that must stay free: what others drive over, junctions, crossings
    """
    known = catalogue()
    paints = np.array([share for _, share in PAINTS.values()])
    kinds, shares = list(_KINDS), np.array(list(_KINDS.values()))
    rng = generator(seed, "parked", "cars")
    n = len(spots.xy)
    shapes = [
        pick(known, kinds[int(rng.choice(len(kinds), p=shares / shares.sum()))], rng, paints)
        for _ in range(n)
    ]
    grow = 1 + rng.uniform(-0.03, 0.03, (n, 3))
    length = np.array([s.length for s in shapes]) * grow[:, 0] if n else np.empty(0)
    width = np.array([s.width for s in shapes]) * grow[:, 1] if n else np.empty(0)
    boxes = np.array(
        [
            rectangles(spots.xy[k : k + 1], spots.heading[k : k + 1], length[k] * scale, width[k] * scale)[0]
            for k in range(n)
        ],
        object,
    )
    keep = np.ones(n, bool)
    for tree, room in ((obstacles, 0.25), (taken, 0.1)):
        if n and len(tree):
            keep[np.unique(tree.query(boxes, predicate="dwithin", distance=room)[0])] = False
    if n:
        a, b = shapely.STRtree(boxes).query(boxes, predicate="dwithin", distance=0.4)
        for first, second in zip(a[a < b].tolist(), b[a < b].tolist(), strict=True):
            if keep[first]:
                keep[second] = False
    rows = np.flatnonzero(keep)
    hint = spots.hint[rows]
    bases = np.array([shapes[k].base for k in rows]) * grow[rows, 0] if len(rows) else np.empty(0)
    points = [
        wheels(
            spots.xy[k : k + 1],
            spots.heading[k : k + 1],
            spots.hint[k : k + 1],
            b * scale,
            0.8 * shapes[k].width,
        )
        for k, b in zip(rows.tolist(), bases.tolist(), strict=True)
    ]
    under = np.concatenate(points).reshape(-1, 3) if points else np.empty((0, 3))
    unknown = np.repeat(np.isnan(hint), 4)
    under[unknown, 2] = 0.0
    z: Float = np.empty(len(under))
    z[~unknown] = ground_heights(scene, under[~unknown])
    z[unknown] = ground_heights(scene, under[unknown], above=4000.0, below=4000.0)
    height, pitch, roll = attitude(z.reshape(-1, 4), 1.0, 1.0)
    tracks = np.array([0.8 * shapes[k].width for k in rows])
    pitch, roll = np.arctan2(np.tan(pitch), bases), np.arctan2(np.tan(roll), tracks)
    return table(
        [shapes[k] for k in rows],
        grow[rows],
        np.ones(len(rows), np.int64),
        np.zeros(len(rows), np.int64),
        np.column_stack([spots.xy[rows], height]),
        np.column_stack([spots.heading[rows], pitch, roll]),
        np.zeros((len(rows), 3)),
        np.zeros(len(rows)),
        parked=True,
        scale=scale,
    )

"""Sites for posts and trunks: off carriageways, crossings, tracks and tunnel mouths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.ground.partition import GroundPlan, rows_at, values_at
from geoscene.typing import Bools, Float

CLEARANCE = 0.5
"""Metres between the edge of a carriageway and a post beside it: the lateral clearance of traffic signs."""

FARTHEST = 15.0
"""Metres within which a clear place is searched for: more than half the width of any carriageway."""

_STEP = 0.25
"""Metres between the places that are tried."""

_TRACK = 0.8
"""Metres beside a rail that a rail vehicle sweeps; more than half a gauge, to cover the track's middle."""

_ALL_AROUND = 2 * np.pi * np.arange(24) / 24
_DRIVEN = (Class.ROAD, Class.LANE_MARKING, Class.CROSSING, Class.RAIL, Class.TUNNEL)
UNUSABLE = (*_DRIVEN, Class.KERB, Class.BUILDING_PAD, Class.WATER)


@dataclass(frozen=True, slots=True)
class Sites:
    """Areas of vehicles, and free areas for posts, on a planned ground.

    plan   : the ground
    tracks : STRtree of the areas that rail vehicles sweep
    """

    plan: GroundPlan
    tracks: shapely.STRtree

    @classmethod
    def of(cls, plan: GroundPlan) -> Sites:
        """The sites of a planned ground."""
        tracks = shapely.buffer(plan.layers.polygon[plan.layers.klass == Class.RAIL], _TRACK, quad_segs=2)
        shapely.prepare(tracks)
        return cls(plan, shapely.STRtree(tracks))

    def classes(self, xy: Float) -> NDArray[np.uint8]:
        """Class (n,) of the ground at points (n, 2), RAIL between and beside the rails of a track."""
        klass: NDArray[np.uint8] = values_at(
            self.plan.layers.klass, rows_at(self.plan, xy), base=self.plan.base[0]
        )
        point, track = self.tracks.query(shapely.points(xy))
        on = shapely.contains_xy(self.tracks.geometries[track], *xy[point].T)
        klass[point[on & (klass[point] != Class.BUILDING_PAD)]] = Class.RAIL
        return klass

    def driven(self, xy: Float) -> Bools:
        """Whether points (n, 2) lie on a carriageway, a crossing, a track or in the mouth of a tunnel."""
        return np.isin(self.classes(xy), _DRIVEN)

    def nearest_clear(self, xy: Float, *, angles: Float | None = None) -> tuple[Float, Bools]:
        """Nearest free places for points (n, 2), `CLEARANCE` beyond the edge, and a mask of those found.

        Points without a clear place within `FARTHEST` are returned as they are.

        angles : (n, k) radians counter-clockwise from east, the directions to search in, of equally near
                 places the first is taken; by default all around, and the middle of the nearest edge is taken
        """
        fan = np.tile(_ALL_AROUND, (len(xy), 1)) if angles is None else angles
        toward = np.stack([np.cos(fan), np.sin(fan)], axis=-1)
        room = round(CLEARANCE / _STEP)
        places, found = xy.copy(), np.zeros(len(xy), np.bool_)
        for near, far in ((0.0, 2.0), (2.0, 6.0), (6.0, FARTHEST)):  # most are found close by
            rows = np.flatnonzero(~found)
            if not len(rows):
                break
            radius = np.arange(near, far + CLEARANCE, _STEP)
            tried = xy[rows, None, None] + radius[:, None, None] * toward[rows, None]  # (n, radius, k, 2)
            clear = ~np.isin(self.classes(tried.reshape(-1, 2)), UNUSABLE).reshape(tried.shape[:3])
            roomy = clear[:, :-room] & clear[:, room:]
            nth = np.arange(len(rows))
            ring = roomy.any(axis=2).argmax(axis=1)
            usable = roomy[nth, ring]  # (n, k)
            preference = usable.astype(float)
            if angles is None:
                middle = (usable[:, :, None] * toward[rows]).sum(axis=1)
                preference *= 100.0 + np.round(np.einsum("nkc,nc->nk", toward[rows], middle), 6)
            way = preference.argmax(axis=1)
            hit = usable[nth, way]
            places[rows[hit]] = tried[nth, ring + room, way][hit]
            found[rows[hit]] = True
        return places, found

"""Places along and across tunnel pieces: stations, walls, mouths and the carriageway."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
import shapely

from geoscene import polylines
from geoscene.classes import Class
from geoscene.splitmix import uniform_at
from geoscene.structures.layered import PRECISION
from geoscene.structures.table import Structures
from geoscene.typing import Float, Ints

_ROOM = 3.0
"""Metres of free height that tell tunnels for vehicles from those for pedestrians."""

MOUTH = 0.7
"""Metres from a mouth to the middle of its portal."""


@dataclass(frozen=True, slots=True)
class Walls:
    """Where the walls of a piece are at stations of its line.

    at     : (n, 2) points on the line
    along  : (n, 2) unit vectors along it
    metres : (n, 2) from there to the wall on the left and on the right; NaN where there is none
    """

    at: Float
    along: Float
    metres: Float

    @classmethod
    def of(cls, table: Structures, k: int, *, stations: Float) -> Walls:
        """The walls of piece ``k`` at stations (n,) of its line."""
        line = table.line[k][:, :2]
        at = polylines.points_at(line, stations)
        along = polylines.unit(
            polylines.points_at(line, stations + 0.5) - polylines.points_at(line, stations - 0.5)
        )
        walls = cls(at, along, np.full((len(at), 2), np.nan))
        for side in (0, 1):
            walls.metres[:, side] = walls.distance(table, k, points=at, side=side)
        return walls

    def left(self, row: int | slice = slice(None)) -> Float:
        """Unit vectors to the left of the line."""
        along = self.along[row]
        return np.stack([-along[..., 1], along[..., 0]], axis=-1)

    def distance(self, table: Structures, k: int, *, points: Float, side: int) -> Float:
        """Metres (n,) from points (n, 2) to the wall on a side of the line, NaN where there is none."""
        reach = 2.0 * float(table.half[k]) + 2.0
        far = points + (reach if side == 0 else -reach) * self.left()
        rays = shapely.linestrings(np.stack([points, far], axis=1))
        hits = shapely.intersection(rays, table.inner[k].boundary)
        metres: Float = shapely.distance(shapely.points(points), hits)
        hit = points + np.where(side == 0, metres, -metres)[:, None] * self.left()
        missing = np.isnan(metres)
        hit[missing] = 0.0
        in_wall = shapely.dwithin(table.polygon[k], shapely.points(hit), 1e-6)
        inside = shapely.intersects_xy(table.inner[k], *points.T)
        return np.where(in_wall & inside & ~missing, metres, np.nan)


def has_walkway(table: Structures, k: int) -> bool:
    """Whether tunnel piece ``k`` is one for vehicles."""
    return bool(table.rise[k] > _ROOM)


def carriageway(table: Structures, k: int) -> shapely.Geometry:
    """Area of a piece that vehicles drive on."""
    rows = np.concatenate([table.tops[k], *(table.tops[q] for q in table.near[k])]).astype(np.int64)
    klass = table.surfaces.klass[rows]
    driven = rows[np.isin(klass, (Class.ROAD, Class.LANE_MARKING, Class.CROSSING, Class.RAIL))]
    return shapely.union_all(table.surfaces.polygon[np.unique(driven)], grid_size=PRECISION)


def random_shares(table: Structures, k: int, *, count: int) -> Float:
    """Uniform numbers (count,) of a tunnel, in [0, 1): equal for all of its pieces."""
    seed = np.array([zlib.crc32(str(table.osm_id[k]).encode())])
    return uniform_at(seed, np.zeros(1, np.int64), count=count)[:, 0]


def between(bounds: tuple[float, float], share: float) -> float:
    """The number at a share of the way from the lower to the upper bound."""
    return bounds[0] + share * (bounds[1] - bounds[0])


def place_in_tunnel(table: Structures, k: int) -> tuple[float, float]:
    """Station of a piece's start in its tunnel, and the tunnel's length."""
    own = (table.osm_id == table.osm_id[k]) & (table.edge == table.edge[k]) & table.tunnel
    rows = np.flatnonzero(own)
    lengths = np.array([polylines.length(table.line[q]) for q in rows.tolist()])
    return float(lengths[rows < k].sum()), float(lengths.sum())


def stations_every(table: Structures, k: int, *, spacing: float) -> tuple[Float, Ints]:
    """Stations (n,) along a piece at multiples of a spacing along its tunnel, and their numbers there."""
    start, whole = place_in_tunnel(table, k)
    count = max(round(whole / spacing), 1)
    at = (np.arange(count) + 0.5) * whole / count - start
    inside = (at >= 0.0) & (at < polylines.length(table.line[k]))
    return at[inside], np.flatnonzero(inside)


def mouths(table: Structures, k: int) -> Float:
    """Stations just inside the ends of a piece where a road goes on in the open."""
    approach = table.approach[k]
    if shapely.is_empty(approach) or approach is None:
        return np.empty(0)
    line = table.line[k]
    length = polylines.length(line)
    ends = [(MOUTH, line[0]), (length - MOUTH, line[-1])]
    return np.array(
        [
            at
            for at, end in ends
            if shapely.dwithin(approach, shapely.Point(end[:2]), 0.5) and length > 4 * MOUTH
        ]
    )


def rectangle(
    walls: Walls, row: int, *, side: int, along: tuple[float, float], across: tuple[float, float]
) -> shapely.Polygon:
    """A rectangle beside a station, metres along the line and from it to a side."""
    sign = 1.0 if side == 0 else -1.0
    ahead, left = walls.along[row], sign * walls.left(row)
    corners = [(along[0], across[0]), (along[1], across[0]), (along[1], across[1]), (along[0], across[1])]
    return shapely.Polygon([walls.at[row] + a * ahead + b * left for a, b in corners])

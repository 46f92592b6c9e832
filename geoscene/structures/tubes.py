"""Places along and across tunnel pieces, and closed bodies there."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class, materials
from geoscene.geometry import polylines
from geoscene.geometry.mesh import Mesh, concatenate
from geoscene.structures.layered import PRECISION
from geoscene.structures.table import Structures, surface_heights
from geoscene.support.splitmix import uniform_at
from geoscene.typing import Bools, Float, Ints

_ROOM = 3.0
"""Metres of free height that tell tunnels for vehicles from those for pedestrians."""

MOUTH = 0.7
"""Metres from a mouth to the middle of its portal."""

_RING = np.array([[0, 1, 2], [0, 2, 3]])


@dataclass(frozen=True, slots=True)
class TubeWalls:
    """Positions of the walls of a piece at stations of its line.

    at     : (n, 2) points on the line
    along  : (n, 2) unit vectors along it
    metres : (n, 2) from there to the wall on the left and on the right; NaN where there is none
    """

    at: Float
    along: Float
    metres: Float

    @classmethod
    def of(cls, table: Structures, k: int, *, stations: Float) -> TubeWalls:
        """The walls of piece ``k`` at stations (n,) of its line."""
        line = table.line[k][:, :2]
        at = polylines.points_at(line, stations)
        along = polylines.unit(
            polylines.points_at(line, stations + 0.5) - polylines.points_at(line, stations - 0.5)
        )
        return cls(at, along, _metres_to_walls(table, k, points=at, along=along))

    @property
    def outwards(self) -> Float:
        """Unit vectors (n, 2, 2) to the left and to the right of the line."""
        return _outwards(self.along)

    def beside(self, table: Structures, k: int, *, ahead: Float) -> Float:
        """Metres (j, n, 2) to the walls of piece ``k`` from points so many metres (j,) ahead of each one."""
        points = self.at + ahead[:, None, None] * self.along
        return _metres_to_walls(table, k, points=points, along=self.along)

    def rectangles(
        self, *, rows: Ints, side: Ints | int, along: tuple[float, float], across: tuple[Float, Float]
    ) -> Float:
        """Corners (k, 4, 2) of rectangles beside points (k,): metres along the line, and from it to a side.

        along  : both ends of all
        across : both ends (k,) of each, or of all
        """
        outwards = self.outwards[rows, side]
        return np.stack(
            [
                self.at[rows] + along[a] * self.along[rows] + np.reshape(across[b], (-1, 1)) * outwards
                for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))
            ],
            axis=1,
        )


def _outwards(along: Float) -> Float:
    """Unit vectors (n, 2, 2) to the left and to the right of unit vectors (n, 2)."""
    left = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    return np.stack([left, -left], axis=1)


def _metres_to_walls(table: Structures, k: int, *, points: Float, along: Float) -> Float:
    """Distances (..., n, 2) in metres from points to the walls at both sides; NaN without a wall.

    along : (n, 2) unit vectors along the line
    """
    outwards = _outwards(along)
    start = np.broadcast_to(points[..., None, :], (*points.shape[:-1], 2, 2))
    rays = shapely.linestrings(np.stack([start, start + (2.0 * table.half[k] + 2.0) * outwards], axis=-2))
    hits = shapely.intersection(rays, table.inner[k].boundary)
    metres: Float = shapely.distance(shapely.points(start), hits)
    hit = shapely.points(start + np.nan_to_num(metres)[..., None] * outwards)
    in_wall = shapely.dwithin(table.polygon[k], hit, 1e-6)
    inside = shapely.intersects_xy(table.inner[k], points[..., 0], points[..., 1])
    return np.where(in_wall & inside[..., None], metres, np.nan)


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
    """Stations just inside the ends of a piece where a road continues in the open."""
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


@dataclass(frozen=True, slots=True)
class Bodies:
    """Closed bodies, each with vertices of its own.

    mesh : of all of them, one after another
    size : (n,) faces of each
    """

    mesh: Mesh
    size: Ints

    def __len__(self) -> int:
        """Number of bodies."""
        return len(self.size)

    def take(self, keep: Bools) -> Bodies:
        """The bodies at which a mask (n,) is true."""
        return Bodies(self.mesh.take(np.repeat(keep, self.size)), self.size[keep])

    @classmethod
    def empty(cls) -> Bodies:
        """No bodies."""
        return cls(Mesh.empty(), np.empty(0, np.int64))

    @classmethod
    def joined(cls, some: Sequence[Bodies]) -> Bodies:
        """The bodies of one or more tables, in order."""
        return cls(
            concatenate([bodies.mesh for bodies in some]), np.concatenate([bodies.size for bodies in some])
        )


def between_rings(
    table: Structures,
    k: int,
    *,
    rings: Float,
    caps: NDArray[np.int64],
    klass: Class = Class.TUNNEL,
    material: str = "concrete",
) -> Bodies:
    """The closed bodies between two rings of corners each, turned outside.

    rings : (n, 2, c, 3)
    caps  : (m, 3) corners of the triangles that close the first ring
    """
    n = rings.shape[2]
    one = np.arange(n)
    two = np.roll(one, -1)
    faces = np.concatenate(
        [
            caps,
            caps[:, ::-1] + n,
            np.column_stack([one, one + n, two]),
            np.column_stack([two, one + n, two + n]),
        ]
    )
    vertices = rings.reshape(len(rings), 2 * n, 3)
    return _solids(table, k, vertices=vertices, faces=faces, klass=klass, material=material)


def uprights(
    table: Structures,
    k: int,
    *,
    feet: Float,
    low: float | Float,
    top: float | Float,
    klass: Class = Class.TUNNEL,
    material: str = "concrete",
) -> Bodies:
    """Bodies over feet (n, 4, 2), each between two heights above the carriageway."""
    floor = surface_heights(table, k, xy=feet.reshape(-1, 2)).reshape(-1, 4)
    ends = np.stack([floor + np.reshape(z, (-1, 1)) for z in (low, top)], axis=1)
    rings = np.concatenate([np.repeat(feet[:, None], 2, axis=1), ends[..., None]], axis=-1)
    return between_rings(table, k, rings=rings, caps=_RING, klass=klass, material=material)


def swept(table: Structures, k: int, *, rings: Float) -> Bodies:
    """The closed body along rings (n, 4, 3) of corners."""
    n = len(rings)
    one = np.arange(4)
    two = np.roll(one, -1)
    step = 4 * np.arange(n - 1)[:, None, None]
    quads = np.stack([np.column_stack([one, one + 4, two]), np.column_stack([two, one + 4, two + 4])])
    sides = (quads.reshape(-1, 3)[None] + step).reshape(-1, 3)
    faces = np.concatenate([_RING, _RING[:, ::-1] + 4 * (n - 1), sides])
    return _solids(
        table, k, vertices=rings.reshape(1, -1, 3), faces=faces, klass=Class.TUNNEL, material="metal"
    )


def _solids(
    table: Structures, k: int, *, vertices: Float, faces: NDArray[np.int64], klass: Class, material: str
) -> Bodies:
    """Closed bodies of vertices (n, v, 3) and consistently oriented faces (m, 3) of each, turned outside."""
    n, count, _ = vertices.shape
    a, b, c = (vertices[:, faces[:, j]] - vertices[:, :1] for j in range(3))
    inward = (np.cross(a, b) * c).sum(axis=(1, 2)) < 0
    turned = np.where(inward[:, None, None], faces[:, ::-1], faces)
    of = materials()[material]
    mesh = Mesh.of(
        vertices.reshape(-1, 3),
        (turned + count * np.arange(n)[:, None, None]).reshape(-1, 3),
        feature=int(table.feature[k]),
        klass=klass,
        material=of.code,
        color=of.color,
        closed=True,
    )
    return Bodies(mesh, np.full(n, len(faces)))

"""Bridges and tunnels as columns, and the heights of their carriageways away from centre lines."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from geoscene.roadgraph.surface_rows import SurfaceRows
from geoscene.support.compiled import njit
from geoscene.typing import Bools, Float

THINNEST = 0.15
"""Metres: least thickness of a tunnel's roof."""

_FADE = 1.5
"""Metres beyond its outside over which a carriageway's height ceases to count."""

SHEET = 2.5
"""Metres: carriageways that meet in plan and differ less in height are one, else one is over the other."""

_MERGED, _LEVEL = 1.0, 0.02
"""Metres from one centre line to another that is beside it, and in height that make a slope between them."""

SHARED, PARTED = 0.5, 1.0
"""Metres of difference in height up to which carriageways share one surface, and from which on they part."""


@dataclass(frozen=True, slots=True)
class StructureOptions:
    """Sizes in metres that maps do not contain.

    deck         : thickness of road bridges (as `geoscene.roadgraph.ProfileOptions.deck`)
    slab         : thickness of pedestrian bridges
    parapet      : height of parapets on road bridges
    railing      : height of parapets on pedestrian bridges (EN 1317-6: 1.0 and more; cyclists 1.2)
    rim          : thickness of parapets
    headroom     : free height in road tunnels (as `ProfileOptions.clearance`)
    passage      : free height in pedestrian tunnels
    wall         : thickness of tunnels' walls and floors
    roof         : thickness of their roofs, less where the ground above is thin
    margin       : distance from the surfaces in a tunnel to its walls
    pier_spacing : maximum distance between piers
    piece        : maximum length of pieces, each of which belongs to one tile
    walkway      : width of the walkways along the walls of road tunnels, 0 for none
    lining       : tunnels have raised walkways, niches, ribs and portals
    equipment    : lined road tunnels also have lamps, signs, jet fans and cable trays
    """

    deck: float = 0.8
    slab: float = 0.4
    parapet: float = 1.0
    railing: float = 1.2
    rim: float = 0.25
    headroom: float = 4.7
    passage: float = 2.5
    wall: float = 0.5
    roof: float = 0.6
    margin: float = 0.25
    pier_spacing: float = 25.0
    piece: float = 80.0
    walkway: float = 0.0
    lining: bool = False
    equipment: bool = False

    @classmethod
    def of_relief(cls, relief: str) -> StructureOptions:
        """The options of a scene with this relief, one of `geoscene.uses.RELIEFS`."""
        if relief == "off":
            return cls()
        return cls(walkway=0.75, lining=True, equipment=relief == "full")


@dataclass(frozen=True, slots=True)
class Structures:
    """Bridges and tunnels, one row a piece: a stretch of at most 80 m of one road, path or track.

    polygon   : (n,) object, outline of the piece in plan, scene metres; adjacent pieces share a border and do
                not overlap
    line      : (n,) object, (k, 3) float64 centre line, on the carriageway's surface
    around    : (n,) object, (k, 3) float64 the same line some metres further at both ends
    tunnel    : (n,) bool, it is a tunnel; else a bridge
    half      : (n,) float64 metres from the centre line to the outside
    body      : (n,) float64 metres, thickness of the deck, or of the tunnel's walls and floor
    body_source : (n,) str
    rise      : (n,) float64 metres, height of the parapet, or free height of the tunnel
    rise_source : (n,) str
    near      : (n,) object, (k,) int64 rows that continue this one or join it from the side
    tops      : (n,) object, (k,) int64 rows of ``surfaces`` on it
    inner     : (n,) object, shapely: area within the parapets or walls
    approach  : (n,) object, shapely: the roads' first metres beyond its end, where it has one
    pier      : (n,) object, shapely MultiPolygon, its piers
    low       : (n,) object, shapely MultiPolygon, area where the ground would rise into its deck
    pier_spacing : (n,) float64 metres, nominal; 0 without piers
    level     : (n,) int8, OSM layer
    edge      : (n,) int32, edge of the road graph, the first of a street's two; -1 for paths
    osm_id    : (n,) str
    feature   : (n,) int32, -1 for none
    surfaces  : road and path surfaces on bridges and in tunnels
    """

    polygon: NDArray[np.object_]
    line: NDArray[np.object_]
    around: NDArray[np.object_]
    tunnel: Bools
    half: Float
    body: Float
    body_source: NDArray[np.str_]
    rise: Float
    rise_source: NDArray[np.str_]
    near: NDArray[np.object_]
    tops: NDArray[np.object_]
    inner: NDArray[np.object_]
    approach: NDArray[np.object_]
    pier: NDArray[np.object_]
    low: NDArray[np.object_]
    pier_spacing: Float
    level: NDArray[np.int8]
    edge: NDArray[np.int32]
    osm_id: NDArray[np.str_]
    feature: NDArray[np.int32]
    surfaces: SurfaceRows

    def __len__(self) -> int:
        """Number of pieces."""
        return len(self.polygon)

    def take(self, keep: Bools) -> Structures:
        """The chosen rows, in their order; ``near`` refers to rows of the new table."""
        number = np.full(len(self), -1, np.int64)
        number[keep] = np.arange(int(keep.sum()))
        columns = {f.name: getattr(self, f.name)[keep] for f in fields(self) if f.name != "surfaces"}
        near = np.fromiter((number[others[keep[others]]] for others in columns["near"]), object)
        return Structures(**(columns | {"near": near}), surfaces=self.surfaces)


def nearest_on_line(line: Float, xy: Float) -> tuple[Float, Float, Bools]:
    """Nearest point on a line (k, 3) to points (n, 2): its z, its distance, whether it is not an end."""
    return _nearest(np.ascontiguousarray(line, float), np.ascontiguousarray(xy, float))


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest(line: Float, xy: Float) -> tuple[Float, Float, Bools]:
    """The result of `nearest_on_line`; of parts as near, the first counts."""
    z, metres, inner = np.empty(len(xy)), np.full(len(xy), np.inf), np.ones(len(xy), np.bool_)
    last = len(line) - 2
    for p in range(len(xy)):
        for k in range(last + 1):
            x, y = line[k + 1, 0] - line[k, 0], line[k + 1, 1] - line[k, 1]
            t = ((xy[p, 0] - line[k, 0]) * x + (xy[p, 1] - line[k, 1]) * y) / max(x * x + y * y, 1e-12)
            on = min(max(t, 0.0), 1.0)
            away = math.hypot(xy[p, 0] - (line[k, 0] + on * x), xy[p, 1] - (line[k, 1] + on * y))
            if away < metres[p] or k == 0:
                metres[p] = away
                z[p] = line[k, 2] + on * (line[k + 1, 2] - line[k, 2])
                inner[p] = not ((k == 0 and t < 0) or (k == last and t > 1))
    return z, metres, inner


def surface_heights(table: Structures, piece: int, *, xy: Float) -> Float:
    """Heights (n,) of a piece's carriageway at points (n, 2).

    The carriageway is level across its centre line. Where carriageways join, their heights are blended by the
    inverse fourth power of the distance, so that each centre line keeps its own height.
    """
    own, metres, _ = nearest_on_line(table.around[piece], xy)
    weight = _weight(metres, float(table.half[piece]))
    total, z = weight, weight * own
    for other in table.near[piece]:
        if table.edge[other] == table.edge[piece] and table.osm_id[other] == table.osm_id[piece]:
            continue  # the same line further on
        theirs, metres, beside = nearest_on_line(table.around[other], xy)
        weight = _weight(metres, float(table.half[other]))
        alike = np.clip((PARTED - np.abs(theirs - own)) / (PARTED - SHARED), 0.0, 1.0)
        weight = np.where(beside, weight * alike, 0.0)
        total, z = total + weight, z + weight * theirs
    return z / total


def slopes_across(table: Structures, piece: int) -> bool:
    """Whether a piece's carriageway shares its surface with one beside it at another height."""
    for other in table.near[piece]:
        line = table.around[other]
        z, metres, beside = nearest_on_line(table.around[piece], line[:, :2])
        shared = beside & (metres > _MERGED) & (metres < table.half[piece] + table.half[other])
        apart = np.abs(z - line[:, 2])
        if (shared & (apart > _LEVEL) & (apart < PARTED)).any():
            return True
    return False


def _weight(metres: Float, half: float) -> Float:
    share = np.clip(1.0 - (metres - half) / _FADE, 1e-4, 1.0)
    return share**2 / (metres + 0.03) ** 4

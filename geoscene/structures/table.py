"""Bridges and tunnels as columns."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from geoscene.roadgraph.surface_rows import SurfaceRows
from geoscene.typing import Bools, Float

THINNEST = 0.15
"""Metres: least thickness of a tunnel's roof."""


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
        """The options of a scene with this relief, one of `geoscene.relief.RELIEFS`."""
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

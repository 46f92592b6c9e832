"""Area of a build along a route: tiles and features within the sensors' maximum range."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry.frames import Frame
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.routing import route_line
from geoscene.typing import Float, Ints

if TYPE_CHECKING:
    from geoscene.buildings import Buildings
    from geoscene.ground import GroundPlan
    from geoscene.options import BuildOptions

Tile = tuple[int, int]

TABLE_MARGIN = 250.0
"""Metres beyond the sensors' reach that tables of features and the road graph hold: the default radius of
traffic is 200 m."""

AROUND = 50.0
"""Metres around tiles and tables in which surfaces are planned: more than objects are moved by."""

OFFSET = 15.0
"""Metres, maximum distance of a sensor from the centre line of its road."""

_CROWN = 5.0
"""Metres, maximum horizontal extent of forest trees from their position."""


@dataclass(frozen=True, slots=True)
class RoadMap:
    """The roads and buildings of a whole map, on which a drive is planned before anything is built.

    name       : of the map, for messages
    frame      : frame of the scene
    bounds     : (xmin, ymin, xmax, ymax) of its ground in scene metres
    graph      : road graph with heights; None without drivable roads
    footprints : polygons (k,) of the buildings and their parts, scene metres
    min_height : (k,) metres from the ground to the underside of each
    passages   : polygons (p,) of passages through buildings
    passage_height : (p,) metres of free height in each
    left_hand  : traffic keeps left
    """

    name: str
    frame: Frame
    bounds: tuple[float, float, float, float]
    graph: RoadGraph | None
    footprints: NDArray[np.object_]
    min_height: Float
    passages: NDArray[np.object_]
    passage_height: Float
    left_hand: bool


AreaOf = Callable[[RoadMap], Any]
"""The area that a scene is built for, as a shapely polygon in scene metres."""


@dataclass(frozen=True, slots=True)
class Reach:
    """Range of the sensors around a route.

    line   : the route as a shapely line or points, scene metres; or an area
    metres : from the line
    """

    line: Any
    metres: float

    @classmethod
    def of(cls, options: BuildOptions, graph: RoadGraph, *, frame: Frame) -> Reach | None:
        """Reach of the options' route, None without one; raises InputError if the route cannot be used."""
        if not options.along:
            return None
        line = route_line(options.along, graph, frame=frame)
        shapely.prepare(line)
        return cls(line, options.reach + OFFSET)

    @classmethod
    def within(cls, area: Any) -> Reach:
        """Features and tiles in an area, a shapely polygon in scene metres."""
        shapely.prepare(area)
        return cls(area, 0.0)

    def surroundings(self, tile_size: float, *, extent: Sequence[float]) -> Any:
        """A polygon of squares around all features of the tables, and around most tiles in range."""
        far = self.metres + TABLE_MARGIN
        low, high = np.array(extent[:2]), np.array(extent[2:])
        box = np.array(shapely.bounds(self.line)) + far * np.array([-1, -1, 1, 1])
        low, high = np.maximum(box[:2], low), np.minimum(box[2:], high)
        first, last = np.floor(low / tile_size), high / tile_size
        i, j = (axis.ravel() for axis in np.meshgrid(*map(np.arange, first, last)))
        squares = shapely.box(i * tile_size, j * tile_size, (i + 1) * tile_size, (j + 1) * tile_size)
        near = squares[shapely.dwithin(self.line, squares, far)]
        area = shapely.union_all(shapely.buffer(near, AROUND, join_style="mitre"))
        shapely.prepare(area)
        return area

    def tiles(
        self,
        ground: GroundPlan,
        *,
        rows: Mapping[str, Mapping[Tile, Ints]],
        shapes: Mapping[str, NDArray[np.object_]],
        beyond: Mapping[str, Float | float],
    ) -> list[Tile]:
        """Tiles with a feature or ground in range, sorted.

        rows   : of ``shapes`` in each tile by kind; shapes can extend beyond their tile, long walls and
                 bridges by far
        beyond : metres that features extend beyond their shapes, by kind; 0 by default
        """
        tiles = all_tiles(ground, rows)
        boxes = tile_boxes(ground, tiles)
        chosen = set(itertools.compress(tiles, shapely.dwithin(self.line, boxes, self.metres + _CROWN)))
        for kind, by_tile in rows.items():
            near = shapely.dwithin(self.line, shapes[kind], self.metres + beyond.get(kind, 0.0))
            chosen |= {tile for tile, some in by_tile.items() if near[some].any()}
        return sorted(chosen)

    def rows(
        self,
        shapes: Mapping[str, NDArray[np.object_]],
        *,
        tiles: Sequence[Tile],
        ground: GroundPlan,
        rows: Mapping[str, Mapping[Tile, Ints]],
        buildings: Buildings,
    ) -> dict[str, Ints]:
        """Rows of each table that are on disk, by layer: near the route, or on the tiles that are built.

        shapes : of all features by kind; those of buildings and parts are rows of ``buildings``
        """
        boxes = tile_boxes(ground, tiles)
        none = np.empty(0, np.int64)
        kept = {}
        for kind, geometry in shapes.items():
            near = shapely.dwithin(self.line, geometry, self.metres + TABLE_MARGIN)
            near[shapely.STRtree(geometry).query(boxes, predicate="intersects")[1]] = True
            for tile in tiles:
                near[rows.get(kind, {}).get(tile, none)] = True
            kept[kind] = np.flatnonzero(near)
        outlines = np.unique(buildings.outline[np.concatenate([kept["buildings"], kept.pop("parts")])])
        of_parts = buildings.outline[buildings.count :]
        return kept | {
            "buildings": outlines.astype(np.int64),
            "building_parts": np.flatnonzero(np.isin(of_parts, outlines)),
        }


def all_tiles(ground: GroundPlan, rows: Mapping[str, Mapping[Tile, Ints]]) -> list[Tile]:
    """Indices (i, j) of the tiles with ground or features, sorted."""
    from geoscene.ground import ground_tiles  # noqa: PLC0415  (not for drives)

    return sorted(set(ground_tiles(ground)).union(*rows.values()))


def tile_boxes(ground: GroundPlan, tiles: Sequence[Tile]) -> NDArray[np.object_]:
    """Squares (t,) of tiles, scene metres."""
    from geoscene.ground import tile_span  # noqa: PLC0415  (not for drives)

    low = np.array(tiles, float).reshape(-1, 2)
    high = low + np.array([tile_span(ground, i, j=j) for i, j in tiles])[:, None]
    boxes: NDArray[np.object_] = shapely.box(*(low * ground.tile_size).T, *(high * ground.tile_size).T)
    return boxes

"""The plan of a scene: numbered features of the whole map, before they are cut into tiles."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar, cast

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings import Buildings, read_buildings
from geoscene.errors import InputError
from geoscene.features import (
    barrier_layer,
    building_layers,
    furniture_layer,
    ground_layer,
    road_layer,
    structure_layer,
    tree_layer,
)
from geoscene.frames import Frame, rim_of, wrapped
from geoscene.ground import (
    GroundPlan,
    Layers,
    WaterLevels,
    building_pads,
    joined,
    landcover,
    plan_ground,
    water_levels,
)
from geoscene.ground.foundations import foundation_heights
from geoscene.ground.relief import Relief
from geoscene.ground.terrain import Terrain, base_heights, open_terrain
from geoscene.ground.urban import paved_fabric
from geoscene.objects.barriers import Barriers, read_barriers
from geoscene.objects.forests import Forests
from geoscene.objects.furniture import Furniture, read_furniture
from geoscene.objects.vegetation import Trees, clear_of, read_trees
from geoscene.options import BuildOptions
from geoscene.progress import Progress
from geoscene.reach import AreaOf, Reach, RoadMap, all_tiles
from geoscene.report import Problem
from geoscene.roadgraph import build_road_graph, find_obstacles, graded_ground, profile
from geoscene.roadgraph.driving_side import Side
from geoscene.roadgraph.driving_side import driving_side as found_side
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.routing import edge_lines
from geoscene.roadgraph.surfaces import RoadSurfaces, SurfaceOptions, road_surfaces
from geoscene.scene.geopackage import Layer
from geoscene.sources import OsmData
from geoscene.structures import (
    Structures,
    buildings_over,
    find_openings,
    ground_below,
    opening_layers,
    read_structures,
    within_extent,
)
from geoscene.typing import Float, Height
from geoscene.uses import USES, Use

Bounds = tuple[float, float, float, float]
T = TypeVar("T")

LARGEST_KM2 = 10_500.0
"""Maximum size of a scene in square kilometres: 100 x 100 km and a margin."""

_TOLERANCE = 0.01  # of the distance between heights: maximum error of bare ground on the terrain's grid
_ROAD_LINES = 10.0  # metres between the lines at which ground graded to roads can bend
_ROAD_REACH = 25.0  # metres, maximum distance from a centre line of ground that is graded to the road
_MARGIN = 10.0  # metres of ground added on both sides of maps narrower than twice that
_ARM = 10.0  # metres, maximum horizontal extent of lamps and signals from their position
_RAISED = 1.0  # metres, minimum height of an underside for a building to have no pad


@dataclass(frozen=True, slots=True)
class Plan:
    """All that tiles are built from.

    frame     : frame of the scene
    terrain   : elevation model, or level ground
    height    : z of the ground at x, y, graded to roads; None if it is 0 everywhere
    buildings : table of buildings and building parts
    base      : (count,) z of each building's base, NaN for those out of reach of a route
    foot      : (count,) z of the lower end of each building's walls, as ``base``
    rows      : rows of each tile by kind (``buildings``, ``trees``, ``furniture``, ``barriers``,
                ``structures``): features whose bounding box has its centre in the tile; ``parts`` are in the
                tiles of their buildings
    graph     : road graph with heights
    side      : side of the road that traffic drives on, and its source (``tag``, ``place`` or ``option``)
    ground    : polygons of the ground
    levels    : heights of water surfaces
    trees     : mapped trees
    forests   : what their trees are generated from, None without trees
    structures : bridges and tunnels
    openings  : area of each structure where the ground is left out, None for most
    use       : what of the scene is written
    layers    : feature tables in the order of feature numbers
    chosen    : tiles to build, sorted: all, or those in reach of a route
    kept      : rows of each of ``layers`` that tables on disk hold, None for all
    area      : polygon that the scene is built for, in place of a route; None without
    """

    frame: Frame
    terrain: Terrain
    height: Height | None
    buildings: Buildings
    base: Float
    foot: Float
    rows: dict[str, dict[tuple[int, int], NDArray[np.int64]]]
    graph: RoadGraph
    side: tuple[Side, str]
    ground: GroundPlan
    levels: WaterLevels
    trees: Trees
    forests: Forests | None
    furniture: Furniture
    barriers: Barriers
    structures: Structures
    openings: NDArray[np.object_]
    use: Use
    layers: list[Layer]
    chosen: list[tuple[int, int]]
    kept: dict[str, NDArray[np.int64]] | None
    area: Any | None = None

    @property
    def extent(self) -> Bounds:
        """(xmin, ymin, xmax, ymax) of the ground in scene metres."""
        return self.ground.extent

    def of_tile(self, kind: str, i: int, *, j: int) -> NDArray[np.int64]:
        """Rows of a kind of feature in tile (i, j), ascending."""
        return self.rows[kind].get((i, j), np.empty(0, np.int64))


def make_plan(
    osm: OsmData, options: BuildOptions, *, progress: Progress, needed: AreaOf | None = None
) -> tuple[Plan, list[Problem]]:
    """The plan of a scene of a map, and the features that were repaired or dropped.

    needed : chooses the area to build; the road graph is then that of the whole map

    Raises FrameError or InputError if the CRS or the elevation files cannot be used.
    """
    problems: list[Problem] = list(osm.problems)
    frame = Frame.at(*_checked_centre(osm), crs=options.crs)

    progress("buildings", 0, total=0)
    built = osm if "buildings" in options.only else replace(osm, areas=[], relations=[])
    buildings = _collect(problems, read_buildings(built, frame))
    extent = _extent(frame, osm.bounds, buildings=buildings)
    terrain = Terrain(frame)
    if options.dem:
        gaps = cast("Literal['error', 'nearest']", options.dem_gaps)
        terrain = open_terrain(options.dem, frame, bounds=extent, outside=gaps)
        problems += terrain.problems
    frame = replace(frame, vertical=terrain.vertical)

    progress("roads", 0, total=0)
    roads = _plan_roads(osm, frame, options=options, terrain=terrain, extent=extent, problems=problems)
    footprints = buildings.footprint[: buildings.count]
    reach, area = Reach.of(options, roads.graph, frame=frame), None
    if needed is not None:
        area = needed(
            RoadMap(
                osm.source,
                frame,
                extent,
                roads.graph if len(roads.graph) else None,
                footprints,
                buildings.min_height[: buildings.count],
                left_hand=roads.side == "left",
            )
        )
        reach = Reach.within(area)

    progress("ground", 0, total=0)
    cover, surfaces, pads = _collect(
        problems, _surfaces(osm, frame, extent=extent, buildings=buildings, roads=roads, only=options.only)
    )
    openings = opening_layers(roads.structures, roads.openings)
    covers = Layers.concatenate([cover, surfaces, pads, openings])
    levels = water_levels(covers, osm.ways, frame=frame, height=terrain.height)
    cover, surfaces = _numbered([cover, surfaces], len(buildings))
    covers = Layers.concatenate([cover, surfaces, pads, openings])
    ground = _plan_ground(covers, roads, extent=extent, terrain=terrain, options=options)
    objects = _collect(problems, _objects(osm, frame, ground=ground, only=options.only, side=roads.side))
    first = len(buildings) + len(cover) + len(surfaces) + len(roads.graph)
    trees, furniture, barriers, structures = _numbered([*objects, roads.structures], first)

    shapes = {
        "buildings": footprints,
        "parts": footprints[buildings.outline[buildings.count :]],
        "trees": shapely.points(trees.xy),
        "furniture": shapely.points(furniture.xy),
        "barriers": barriers.polygon,
        "structures": structures.polygon,
    }
    rows = {kind: _by_tile(column, options.tile_size) for kind, column in shapes.items()}
    rows["parts"] = {tile: buildings.count + parts for tile, parts in rows["parts"].items()}
    ground = joined(ground, set().union(*rows.values()))

    chosen, kept = all_tiles(ground, rows), None
    if reach is not None:
        shapes |= {
            "buildings": buildings.footprint,
            "parts": buildings.footprint,
            "landcover": cover.polygon,
            "road_surfaces": surfaces.polygon,
            "roads": edge_lines(roads.graph),
        }
        beyond = {"trees": trees.crown / 2, "furniture": _ARM}
        chosen = reach.tiles(ground, rows=rows, shapes=shapes, beyond=beyond)
        kept = reach.rows(shapes, tiles=chosen, ground=ground, rows=rows, buildings=buildings)
        if needed is not None:
            kept["roads"] = np.arange(len(roads.graph))
    standing = np.arange(buildings.count) if kept is None else kept["buildings"]
    base, foot = np.full((2, buildings.count), np.nan)
    base[standing] = base_heights(footprints[standing], roads.height)
    foot[standing] = foundation_heights(
        footprints[standing], base[standing], height=roads.height, layers=covers, levels=levels
    )
    buildings = _collect(problems, buildings_over(buildings, base, foot=foot, table=roads.structures))

    layers = [
        *building_layers(buildings, base),
        ground_layer("landcover", cover),
        ground_layer("road_surfaces", surfaces),
        road_layer(roads.graph),
        tree_layer(trees, _foot(trees.xy, roads.height)),
        furniture_layer(furniture, _foot(furniture.xy, roads.height)),
        barrier_layer(barriers),
        structure_layer(structures),
    ]
    plan = Plan(
        frame=frame,
        terrain=terrain,
        height=roads.height,
        buildings=buildings,
        base=base,
        foot=foot,
        rows=rows,
        graph=roads.graph,
        side=(roads.side, roads.side_source),
        ground=ground,
        chosen=chosen,
        kept=kept,
        levels=levels,
        trees=trees,
        forests=Forests.of(ground.layers, osm) if "trees" in options.only else None,
        furniture=furniture,
        barriers=barriers,
        structures=structures,
        openings=roads.openings,
        use=USES[options.use],
        layers=layers,
        area=area,
    )
    return plan, problems


def _collect(problems: list[Problem], result: tuple[T, list[Problem]]) -> T:
    """The value of a result; adds its problems to the list."""
    value, found = result
    problems += found
    return value


def _checked_centre(osm: OsmData) -> tuple[float, float]:
    """Longitude and latitude of the centre of a map; raises InputError if it is too large for a scene."""
    west, south, east, north = osm.bounds
    area = (east - west) * (north - south) * 111.2**2 * np.cos(np.radians((south + north) / 2))
    if area > LARGEST_KM2:
        raise InputError(
            f"{osm.source}: {area:,.0f} km2, more than the maximum of {LARGEST_KM2:,.0f} km2 for a scene;"
            " select a part of it with `bbox`"
        )
    return wrapped((west + east) / 2), (south + north) / 2


@dataclass(frozen=True, slots=True)
class _Roads:
    """Roads of a scene and the ground graded to them; see `Plan` for the columns.

    uneven : the ground or a road has heights other than 0
    """

    graph: RoadGraph
    surfaces: RoadSurfaces
    structures: Structures
    openings: NDArray[np.object_]
    side: Side
    side_source: str
    height: Height | None
    uneven: bool


def _plan_roads(
    osm: OsmData,
    frame: Frame,
    *,
    options: BuildOptions,
    terrain: Terrain,
    extent: Bounds,
    problems: list[Problem],
) -> _Roads:
    """Road graph with heights, road surfaces, bridges and tunnels."""
    mapped = osm if "roads" in options.only else replace(osm, areas=[], ways=[], relations=[], points=[])
    graph = _collect(problems, build_road_graph(mapped, frame))
    graph = profile(graph, terrain.height, obstacles=find_obstacles(osm, frame))
    uneven = bool(terrain.grids) or any(line[:, 2].any() for line in graph.geometry)
    height = graded_ground(graph, terrain.height, level=not terrain.grids) if uneven else None
    side, source = found_side(osm)
    if options.driving_side:
        side, source = cast("Side", options.driving_side), "option"
    surfaces = road_surfaces(mapped, graph, frame=frame, options=SurfaceOptions(left_hand=side == "left"))
    structures = _collect(problems, read_structures(surfaces, graph, osm=osm, frame=frame, height=height))
    structures = within_extent(structures, extent)
    height = ground_below(structures, height or terrain.height) if len(structures) else height
    return _Roads(
        graph, surfaces, structures, find_openings(structures, height), side, source, height, uneven
    )


def _plan_ground(
    layers: Layers, roads: _Roads, *, extent: Bounds, terrain: Terrain, options: BuildOptions
) -> GroundPlan:
    size, tolerance = options.tile_size, options.dem_tolerance
    if tolerance is None:
        tolerance = _TOLERANCE * terrain.spacing
    return plan_ground(
        extent,
        layers,
        tile_size=size,
        lines=_ROAD_LINES if roads.uneven else 0.0,
        ruled=_graded_tiles(roads.graph, size, level=not terrain.grids),
        coarse=terrain.lines,
        relief=Relief(terrain.height, tolerance, terrain.lines) if terrain.grids and tolerance else None,
    )


def _extent(frame: Frame, bounds: Bounds, *, buildings: Buildings) -> Bounds:
    """Rectangle of the ground in whole metres: contains the bounds of the map and all buildings."""
    west, south, east, north = bounds
    step = max((east - west) / 8, (north - south) / 8, 1e-6)
    x, y = frame.from_geographic(*rim_of(bounds, step=step))
    boxes = shapely.bounds(buildings.footprint[: buildings.count])
    xs = np.concatenate([x, boxes[:, 0] - 2, boxes[:, 2] + 2])
    ys = np.concatenate([y, boxes[:, 1] - 2, boxes[:, 3] + 2])
    low = np.floor([xs.min(), ys.min()])
    high = np.ceil([xs.max(), ys.max()])
    thin = high - low < 2 * _MARGIN
    low[thin] -= _MARGIN
    high[thin] += _MARGIN
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _surfaces(
    osm: OsmData,
    frame: Frame,
    *,
    extent: Bounds,
    buildings: Buildings,
    roads: _Roads,
    only: Collection[str],
) -> tuple[tuple[Layers, Layers, Layers], list[Problem]]:
    """Land cover, road surfaces and building pads, as layers of the ground."""
    surfaces = roads.surfaces
    problems: list[Problem] = []
    count = buildings.count
    footprints = buildings.footprint[:count]
    parts = [paved_fabric(footprints)]
    if "landcover" in only:
        cover, found = landcover(osm, frame, extent=extent)
        parts.append(cover)
        problems += found
    paved = Layers.of(
        surfaces.polygon,
        klass=surfaces.klass,
        material=surfaces.material,
        priority=surfaces.priority,
        osm_id=surfaces.osm_id,
        source=surfaces.source,
    )
    on_ground = footprints.copy()
    on_ground[buildings.min_height[:count] >= _RAISED] = None
    pads = building_pads(
        on_ground, osm_id=buildings.osm_id[:count].astype(str), feature=np.arange(count, dtype=np.int32)
    )
    return (Layers.concatenate(parts), paved, pads), problems


def _objects(
    osm: OsmData, frame: Frame, *, ground: GroundPlan, only: Collection[str], side: Side
) -> tuple[list[Any], list[Problem]]:
    """Trees, furniture and barriers, moved off carriageways; empty tables for kinds not in ``only``."""
    trees, problems = read_trees(osm, frame)
    trees, moved = clear_of(ground, trees)
    found: dict[str, tuple[Any, list[Problem]]] = {
        "trees": (trees, problems + moved),
        "furniture": read_furniture(osm, frame, plan=ground, left_hand=side == "left"),
        "barriers": read_barriers(osm, frame, plan=ground),
    }
    none = np.empty(0, np.int64)
    return (
        [table if kind in only else table.take(none) for kind, (table, _) in found.items()],
        [problem for kind, (_, problems) in found.items() if kind in only for problem in problems],
    )


def _graded_tiles(graph: RoadGraph, tile_size: float, *, level: bool) -> set[tuple[int, int]]:
    """Tiles whose ground is graded to roads; on ``level`` ground only those with ramps."""
    if not len(graph):
        return set()
    points = np.concatenate(list(graph.geometry))
    if level:
        points = points[np.abs(points[:, 2]) > 1e-3]
    around = np.array([(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]) * _ROAD_REACH
    tiles = np.floor((points[:, None, :2] + around).reshape(-1, 2) / tile_size).astype(int)
    return {(int(i), int(j)) for i, j in np.unique(tiles, axis=0)}


def _numbered(tables: Sequence[Any], first: int) -> list[Any]:
    """The tables with consecutive feature numbers, starting at ``first``."""
    starts = np.cumsum([first, *map(len, tables)])
    return [
        replace(table, feature=np.arange(a, b, dtype=np.int32))
        for table, a, b in zip(tables, starts[:-1], starts[1:], strict=True)
    ]


def _foot(xy: Float, height: Height | None) -> Float:
    return np.zeros(len(xy)) if height is None else np.asarray(height(xy[:, 0], xy[:, 1]), float)


def _by_tile(shapes: NDArray[Any], tile_size: float) -> dict[tuple[int, int], NDArray[np.int64]]:
    """Rows of shapes by tile: that of the centre of their bounding box."""
    boxes = shapely.bounds(shapes).reshape(-1, 4)
    home = np.floor((boxes[:, :2] + boxes[:, 2:]) / 2 / tile_size).astype(np.int64)
    if not len(home):
        return {}
    keys, owner = np.unique(home, axis=0, return_inverse=True)
    order = np.argsort(owner.ravel(), kind="stable")
    cuts = np.searchsorted(owner.ravel()[order], np.arange(len(keys) + 1))
    return {(int(i), int(j)): order[a:b] for (i, j), a, b in zip(keys, cuts[:-1], cuts[1:], strict=True)}


def take_buildings(buildings: Buildings, rows: NDArray[np.int64], *, parts: NDArray[np.int64]) -> Buildings:
    """The table of some buildings (rows below ``count``, ascending) and of their parts (rows)."""
    chosen = buildings.take(np.concatenate([rows, parts]))
    return replace(chosen, outline=np.searchsorted(rows, chosen.outline).astype(np.int32))

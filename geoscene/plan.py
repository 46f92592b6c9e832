"""All that a scene's tiles are made from: features of the whole place, numbered, not yet cut."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, cast

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
from geoscene.frames import Frame
from geoscene.ground import (
    GroundPlan,
    Layers,
    WaterLevels,
    building_pads,
    concatenate_layers,
    landcover,
    plan_ground,
    water_levels,
)
from geoscene.ground.terrain import Terrain, base_heights, flat_terrain, open_terrain
from geoscene.ground.urban import paved_fabric
from geoscene.objects.barriers import Barriers, read_barriers
from geoscene.objects.furniture import Furniture, read_furniture
from geoscene.objects.vegetation import Trees, clear_of, needle_shares, read_trees
from geoscene.progress import Progress
from geoscene.report import Problem
from geoscene.roadgraph import build_road_graph, find_obstacles, graded_ground, profile
from geoscene.roadgraph.driving_side import Side
from geoscene.roadgraph.driving_side import driving_side as found_side
from geoscene.roadgraph.graph import RoadGraph
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
from geoscene.typing import Float

Bounds = tuple[float, float, float, float]
Height = Callable[[Float, Float], Float]

KINDS = ("buildings", "roads", "landcover", "trees", "furniture", "barriers")
"""What a scene may hold besides its ground; `make_plan` takes all or some."""

LARGEST_KM2 = 4000.0
"""Square kilometres of the largest scene: 64,000 tiles of 250 m."""

_ROAD_LINES = 10.0  # metres between the lines along which the ground bends to roads
_ROAD_REACH = 25.0  # metres from a road's middle within which the ground is graded to it, at most
_STANDING = 1.0  # metres: a building whose underside is higher leaves the ground under it as it is


@dataclass(frozen=True, slots=True)
class Plan:
    """What tiles are made from.

    frame     : of the scene
    terrain   : the elevation model, or level ground
    height    : z of the ground at x, y, roads graded into it; None where all is at 0
    buildings : their table
    base      : (count,) z of each building's base
    rows      : by kind (``buildings``, ``trees``, ``furniture``, ``barriers``, ``structures``) the rows that
                belong to each tile: those with the middle of their box in it; ``parts`` go with
                their buildings
    graph     : roads, with heights
    side      : of the road that traffic keeps to, and what says so (``tag``, ``place`` or ``option``)
    ground    : what lies on the ground
    levels    : how high its water stands
    trees     : mapped ones
    needles   : share of needle-leaved trees by row of the ground's layers
    structures : bridges and tunnels
    openings  : where the ground is left out over each of them, None for most
    layers    : the feature tables, in the order of their numbers
    """

    frame: Frame
    terrain: Terrain
    height: Height | None
    buildings: Buildings
    base: Float
    rows: dict[str, dict[tuple[int, int], NDArray[np.int64]]]
    graph: RoadGraph
    side: tuple[Side, str]
    ground: GroundPlan
    levels: WaterLevels
    trees: Trees
    needles: Float
    furniture: Furniture
    barriers: Barriers
    structures: Structures
    openings: NDArray[np.object_]
    layers: list[Layer]

    @property
    def extent(self) -> Bounds:
        """(xmin, ymin, xmax, ymax) of the ground, scene metres."""
        return self.ground.extent

    def tiles(self) -> list[tuple[int, int]]:
        """All tiles, in order."""
        ground = {(int(i), int(j)) for i, j in self.ground.tiles}
        return sorted(ground.union(*self.rows.values()))

    def of_tile(self, kind: str, i: int, *, j: int) -> NDArray[np.int64]:
        """Rows of a kind that belong to tile (i, j), rising."""
        return self.rows[kind].get((i, j), np.empty(0, np.int64))


def make_plan(
    osm: OsmData,
    crs: str,
    *,
    dem: tuple[str, ...],
    dem_gaps: Literal["error", "nearest"],
    tile_size: float,
    only: Collection[str],
    driving_side: str,
    progress: Progress,
) -> tuple[Plan, list[Problem]]:
    """Read all features of a map, and what was repaired or dropped on the way.

    Arguments as in `geoscene.build.BuildOptions`. Raises FrameError and InputError for a CRS or elevation
    files that cannot serve.
    """
    west, south, east, north = osm.bounds
    area = (east - west) * (north - south) * 111.2**2 * np.cos(np.radians((south + north) / 2))
    if area > LARGEST_KM2:
        raise InputError(
            f"{osm.source}: {area:,.0f} km2, more than the {LARGEST_KM2:,.0f} of one scene;"
            " cut a part out (`bbox`)"
        )
    frame = Frame.at((west + east) / 2, (south + north) / 2, crs=crs)
    problems: list[Problem] = list(osm.problems)

    progress("buildings", 0, total=0)
    buildings, found = read_buildings(osm if "buildings" in only else _without_areas(osm), frame)
    problems += found
    extent = _extent(frame, osm.bounds, buildings=buildings)
    terrain = open_terrain(dem, frame, bounds=extent, outside=dem_gaps) if dem else flat_terrain(frame)
    frame = replace(frame, vertical=terrain.vertical)

    progress("roads", 0, total=0)
    graph, found = build_road_graph(osm if "roads" in only else _without_ways(osm), frame)
    problems += found
    graph = profile(graph, terrain.height, obstacles=find_obstacles(osm, frame))
    uneven = bool(terrain.grids) or any(line[:, 2].any() for line in graph.geometry)
    height = graded_ground(graph, terrain.height) if uneven else None
    side, side_source = (cast("Side", driving_side), "option") if driving_side else found_side(osm)
    surfaces, found = road_surfaces(
        osm if "roads" in only else _nothing(osm),
        graph,
        frame=frame,
        options=SurfaceOptions(left_hand=side == "left"),
    )
    problems += found
    structures, found = read_structures(surfaces, graph, osm=osm, frame=frame, height=height)
    problems += found
    structures = within_extent(structures, extent)
    height = ground_below(structures, height or terrain.height) if len(structures) else height
    openings = find_openings(structures, height)
    footprints = buildings.footprint[: buildings.count]
    base = base_heights(footprints, height or terrain.height)
    buildings, found = buildings_over(buildings, base, table=structures)
    problems += found

    progress("ground", 0, total=0)
    cover, roads, pads, found = _surfaces(
        osm, frame, extent=extent, buildings=buildings, surfaces=surfaces, only=only
    )
    problems += found
    n = len(buildings)
    cover, roads = _numbered(cover, n), _numbered(roads, n + len(cover))
    layers = concatenate_layers([cover, roads, pads, opening_layers(structures, openings)])
    ground = plan_ground(
        extent,
        layers,
        tile_size=tile_size,
        lines=_ROAD_LINES if uneven else 0.0,
        ruled=_graded_tiles(graph, tile_size, level=not terrain.grids),
        coarse=terrain.lines,
    )
    levels = water_levels(ground.layers, osm.ways, frame=frame, height=terrain.height)

    trees, furniture, barriers, found = _standing(osm, frame, ground=ground, only=only, side=side)
    problems += found
    first = n + len(cover) + len(roads) + len(graph)
    trees = _numbered(trees, first)
    furniture = _numbered(furniture, first + len(trees))
    barriers = _numbered(barriers, first + len(trees) + len(furniture))
    structures = _numbered(structures, first + len(trees) + len(furniture) + len(barriers))
    tables = [
        *building_layers(buildings, base),
        ground_layer("landcover", cover),
        ground_layer("road_surfaces", roads),
        road_layer(graph),
        tree_layer(trees, _foot(trees.xy, height)),
        furniture_layer(furniture, _foot(furniture.xy, height)),
        barrier_layer(barriers),
        structure_layer(structures),
    ]
    plan = Plan(
        frame=frame,
        terrain=terrain,
        height=height,
        buildings=buildings,
        base=base,
        rows={
            "buildings": _by_tile(footprints, tile_size),
            "parts": _by_tile(
                footprints[buildings.outline[buildings.count :]], tile_size, first=buildings.count
            ),
            "trees": _by_tile(shapely.points(trees.xy), tile_size),
            "furniture": _by_tile(shapely.points(furniture.xy), tile_size),
            "barriers": _by_tile(barriers.polygon, tile_size),
            "structures": _by_tile(structures.polygon, tile_size),
        },
        graph=graph,
        side=(side, side_source),
        ground=ground,
        levels=levels,
        trees=trees,
        needles=needle_shares(ground, osm),
        furniture=furniture,
        barriers=barriers,
        structures=structures,
        openings=openings,
        layers=tables,
    )
    return plan, problems


def _without_areas(osm: OsmData) -> OsmData:
    return replace(osm, areas=[], relations=[])


def _without_ways(osm: OsmData) -> OsmData:
    return replace(osm, ways=[], relations=[], points=[])


def _nothing(osm: OsmData) -> OsmData:
    return replace(osm, areas=[], ways=[], relations=[], points=[])


def _extent(frame: Frame, bounds: Bounds, *, buildings: Buildings) -> Bounds:
    """The ground's rectangle: around the extract's bounds and all buildings, out to whole metres."""
    west, south, east, north = bounds
    step = max((east - west) / 8, (north - south) / 8, 1e-6)
    rim = shapely.segmentize(shapely.box(west, south, east, north), step)
    x, y = frame.from_geographic(*shapely.get_coordinates(rim).T)
    boxes = shapely.bounds(buildings.footprint[: buildings.count])
    xs = np.concatenate([x, boxes[:, 0] - 2, boxes[:, 2] + 2])
    ys = np.concatenate([y, boxes[:, 1] - 2, boxes[:, 3] + 2])
    xmin, ymin = float(np.floor(xs.min())), float(np.floor(ys.min()))
    xmax, ymax = float(np.ceil(xs.max())), float(np.ceil(ys.max()))
    return xmin, ymin, max(xmax, xmin + 10), max(ymax, ymin + 10)


def _surfaces(
    osm: OsmData,
    frame: Frame,
    *,
    extent: Bounds,
    buildings: Buildings,
    surfaces: RoadSurfaces,
    only: Collection[str],
) -> tuple[Layers, Layers, Layers, list[Problem]]:
    """Land cover, road surfaces and building pads."""
    problems: list[Problem] = []
    count = buildings.count
    footprints = buildings.footprint[:count]
    parts = [paved_fabric(footprints)]
    if "landcover" in only:
        cover, found = landcover(osm, frame, extent=extent)
        parts.append(cover)
        problems += found
    roads = Layers.of(
        surfaces.polygon,
        klass=surfaces.klass,
        material=surfaces.material,
        priority=surfaces.priority,
        osm_id=surfaces.osm_id,
        source=surfaces.source,
    )
    standing = footprints.copy()
    standing[buildings.min_height[:count] >= _STANDING] = None
    pads = building_pads(
        standing, osm_id=buildings.osm_id[:count].astype(str), feature=np.arange(count, dtype=np.int32)
    )
    return concatenate_layers(parts), roads, pads, problems


def _standing(
    osm: OsmData, frame: Frame, *, ground: GroundPlan, only: Collection[str], side: Side
) -> tuple[Trees, Furniture, Barriers, list[Problem]]:
    """Trees, furniture and barriers that can stand where they are."""
    trees, problems = read_trees(osm, frame)
    trees, found = clear_of(ground, trees)
    furniture, more = read_furniture(osm, frame, plan=ground, left_hand=side == "left")
    barriers, still_more = read_barriers(osm, frame, plan=ground)
    tables: list[Any] = [trees, furniture, barriers]
    kept = [table if kind in only else table.take(np.zeros(len(table), np.bool_))
            for kind, table in zip(KINDS[3:], tables, strict=True)]  # fmt: skip
    said = [problems + found, more, still_more]
    listed = [p for kind, found in zip(KINDS[3:], said, strict=True) if kind in only for p in found]
    return kept[0], kept[1], kept[2], listed


def _graded_tiles(graph: RoadGraph, tile_size: float, *, level: bool) -> set[tuple[int, int]]:
    """Tiles whose ground is graded to roads; on ``level`` ground those with ramps alone."""
    if not len(graph):
        return set()
    points = np.concatenate(list(graph.geometry))
    if level:
        points = points[np.abs(points[:, 2]) > 1e-3]
    around = np.array([(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]) * _ROAD_REACH
    tiles = np.floor((points[:, None, :2] + around).reshape(-1, 2) / tile_size).astype(int)
    return {(int(i), int(j)) for i, j in np.unique(tiles, axis=0)}


def _numbered(table: Any, first: int) -> Any:
    return replace(table, feature=np.arange(first, first + len(table), dtype=np.int32))


def _foot(xy: Float, height: Height | None) -> Float:
    return np.zeros(len(xy)) if height is None else np.asarray(height(xy[:, 0], xy[:, 1]), float)


def _by_tile(
    shapes: NDArray[Any], tile_size: float, *, first: int = 0
) -> dict[tuple[int, int], NDArray[np.int64]]:
    """Rows, the first of them numbered ``first``, by the tile that holds the middle of their box."""
    boxes = shapely.bounds(shapes).reshape(-1, 4)
    home = np.floor((boxes[:, :2] + boxes[:, 2:]) / 2 / tile_size).astype(np.int64)
    if not len(home):
        return {}
    keys, owner = np.unique(home, axis=0, return_inverse=True)
    order = np.argsort(owner.ravel(), kind="stable")
    cuts = np.searchsorted(owner.ravel()[order], np.arange(len(keys) + 1))
    return {
        (int(i), int(j)): first + order[a:b] for (i, j), a, b in zip(keys, cuts[:-1], cuts[1:], strict=True)
    }


def take_buildings(buildings: Buildings, rows: NDArray[np.int64], *, parts: NDArray[np.int64]) -> Buildings:
    """The chosen buildings (rows below ``count``, rising) with all their parts (rows), as a table."""
    keep = np.concatenate([rows, parts])
    columns = {f.name: getattr(buildings, f.name)[keep] for f in fields(Buildings)}
    return Buildings(**(columns | {"outline": np.searchsorted(rows, columns["outline"]).astype(np.int32)}))

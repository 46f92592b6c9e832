"""The plan of a scene: numbered features of the whole map, before they are cut into tiles."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar, cast

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings import BuildingOptions, Buildings, read_buildings
from geoscene.buildings.facades import FacadeSetting, read_setting
from geoscene.buildings.guesses import palettes, region_at, with_looks
from geoscene.buildings.heights import with_measured_tops
from geoscene.buildings.roof_guesses import without_guess
from geoscene.classes import Class
from geoscene.errors import InputError
from geoscene.geometry.frames import Frame, extent_of, wrap_longitude
from geoscene.ground import (
    GroundPlan,
    Layers,
    WaterLevels,
    building_pads,
    cut_along,
    join_tiles,
    landcover,
    plan_ground,
    tile_span,
    water_levels,
)
from geoscene.ground.kerbs import kerb_ends, lowered_kerbs
from geoscene.ground.land import Land, parcels
from geoscene.ground.landcover import paved_fabric
from geoscene.ground.partition import PRECISION
from geoscene.ground.quays import quay_walls
from geoscene.ground.relief import Kerbs, Raised
from geoscene.ground.standing import foundation_heights, standing_height
from geoscene.ground.terrain import Terrain, base_heights, open_terrain
from geoscene.ground.terrain_lattice import TerrainHeights
from geoscene.objects.barriers import Barriers, open_barriers, read_barriers
from geoscene.objects.forests import Forests
from geoscene.objects.furniture import POSTS, STANDS, Furniture, mapped_furniture, read_furniture
from geoscene.objects.rooftops import Rooftops, plan_rooftops
from geoscene.objects.sidewalks import with_details, with_guesses
from geoscene.objects.siting import Sites
from geoscene.objects.street import Taken, guess_furniture
from geoscene.objects.vegetation import Trees, clear_of, read_trees
from geoscene.objects.wires import Wires, read_wires
from geoscene.options import BuildOptions
from geoscene.pipeline.features import (
    barrier_layer,
    building_layers,
    furniture_layer,
    ground_layer,
    passage_layer,
    road_layer,
    structure_layer,
    tree_layer,
    wire_layer,
)
from geoscene.pipeline.reach import AROUND, AreaOf, Reach, RoadMap, all_tiles, tile_boxes
from geoscene.roadgraph import (
    ProfileOptions,
    RoadOptions,
    build_road_graph,
    find_obstacles,
    graded_ground,
    profile,
    take_heights,
)
from geoscene.roadgraph.carriageways import Carriageways, read_carriageways
from geoscene.roadgraph.clipping import clip_graph, leave_out
from geoscene.roadgraph.creases import crease_lines
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.lanes import Side
from geoscene.roadgraph.lanes import driving_side as found_side
from geoscene.roadgraph.layers import find_odd_layers
from geoscene.roadgraph.relief import (
    camber_of,
    crown_rows,
    find_crowns,
    mapped_kerbs,
    read_beds,
    sidewalk_ends,
)
from geoscene.roadgraph.routing import edge_lines
from geoscene.roadgraph.short_structures import lengthen_structures
from geoscene.roadgraph.stacked import find_stacked
from geoscene.roadgraph.surfaces import RoadSurfaces, SurfaceOptions, carriageway_boxes, road_surfaces
from geoscene.roadgraph.tags import find_unused_inclines
from geoscene.roadgraph.walls import HEADROOM, Walls, find_closed
from geoscene.scene.geopackage import Layer
from geoscene.scene.writer import number_ranges
from geoscene.sources import AROUND_BOUNDS, OsmData
from geoscene.structures import (
    Passages,
    StructureOptions,
    Structures,
    buildings_over,
    find_openings,
    find_passages,
    ground_below,
    mark_passages,
    opening_layers,
    passage_cuts,
    read_structures,
    within_extent,
)
from geoscene.structures.sheets import areal
from geoscene.support.columns import squares_between
from geoscene.support.problems import Problem
from geoscene.support.progress import Progress
from geoscene.typing import Float, Height, Ints
from geoscene.uses import USES, Use

Bounds = tuple[float, float, float, float]
T = TypeVar("T")

LARGEST_KM2 = 10_500.0
"""Maximum size of a scene in square kilometres: 100 x 100 km and a margin."""

_TOLERANCE = 0.01  # of the distance between heights: maximum error of bare ground on the terrain's grid
_SURVEYED = 2.0  # metres between heights, at most, that show roads as they were built
_ROAD_LINES = 10.0  # metres between the lines at which ground graded to roads can bend
_ROAD_REACH = 25.0  # metres, maximum distance from a centre line of ground that is graded to the road
_ARM = 10.0  # metres, maximum horizontal extent of lamps and signals from their position
_COVERS: dict[str, Literal["none", "mapped", "guessed"]] = {
    "off": "none",
    "plain": "mapped",
    "full": "guessed",
}
_POLAR = 67.0  # degrees of latitude beyond which open ground is tundra; assumed
_MOVED = 40.0  # metres, more than trees and furniture are moved by and keep from other features
_FLUSH = 0.05  # metres up to which streets on level ground meet water without a wall
_RAISED = 1.0  # metres, minimum height of an underside for a building to have no pad


@dataclass(frozen=True, slots=True)
class BuildPlan:
    """Immutable plan of a build: the input of all tiles.

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
    relief    : of surfaces, of `geoscene.uses.RELIEFS`
    facades   : what the openings of walls depend on; None without relief
    rooftops  : what stands on roofs; None without full relief
    wires     : overhead wires; none without relief
    layers    : feature tables in the order of feature numbers; those of objects and surfaces far from a route
                are not complete
    ranges    : range [start, stop) of the feature numbers of each table
    chosen    : tiles to build, sorted: all, or those in reach of a route
    kept      : rows of each of ``layers`` that tables on disk hold, None for all
    area      : polygon that the scene is built for, in place of a route; None without
    route     : line that the scene is built along, scene metres; None without
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
    relief: str
    facades: FacadeSetting | None
    rooftops: Rooftops | None
    wires: Wires
    layers: list[Layer]
    ranges: dict[str, tuple[int, int]]
    chosen: list[tuple[int, int]]
    kept: dict[str, NDArray[np.int64]] | None
    area: Any | None = None
    route: Any | None = None

    @property
    def extent(self) -> Bounds:
        """(xmin, ymin, xmax, ymax) of the ground in scene metres."""
        return self.ground.extent

    def of_tile(self, kind: str, i: int, *, j: int) -> NDArray[np.int64]:
        """Rows of a kind of feature in tile (i, j), ascending."""
        return self.rows[kind].get((i, j), np.empty(0, np.int64))


def make_plan(
    osm: OsmData, options: BuildOptions, *, progress: Progress, needed: AreaOf | None = None
) -> tuple[BuildPlan, list[Problem]]:
    """The plan of a scene of a map, and the features that were repaired or dropped.

    needed : chooses the area to build; the road graph is then that of the whole map

    Raises FrameError or InputError if the CRS or the elevation files cannot be used.
    """
    problems: list[Problem] = list(osm.problems)
    osm = _collect(problems, mark_passages(osm))
    frame = Frame.at(*_checked_centre(osm), crs=options.crs)

    progress("buildings", 0, total=0)
    built = osm if "buildings" in options.only else replace(osm, areas=[], relations=[])
    buildings = _collect(
        problems,
        read_buildings(built, frame, options=BuildingOptions(guess_roofs=options.roofs == "guess")),
    )
    extent = extent_of(frame, osm.bounds, footprints=buildings.footprint[: buildings.count])
    terrain = Terrain(frame)
    if options.dem:
        gaps = cast("Literal['error', 'nearest']", options.dem_gaps)
        terrain = open_terrain(options.dem, frame, bounds=extent, outside=gaps, around=AROUND_BOUNDS)
        problems += terrain.problems
    frame = replace(frame, vertical=terrain.vertical)

    progress("roads", 0, total=0)
    if "roads" in options.only:
        osm = _collect(problems, _with_clear_ends(osm, frame))
    passages = _collect(problems, find_passages(_only_roads(osm, options), buildings, frame=frame))
    solid = _on_ground(buildings, passages, free=HEADROOM)
    some = np.flatnonzero([shape is not None for shape in solid])
    names = np.array(buildings.osm_id[some], np.str_)
    walls = Walls.of(solid[some], names, min_height=np.zeros(len(some)))
    roads = _plan_roads(
        osm, frame, extent=extent, options=options, terrain=terrain, walls=walls, problems=problems
    )
    reach, area = Reach.of(options, roads.drivable, frame=frame), None
    route = None if reach is None else reach.line
    if needed is not None:
        area = needed(
            RoadMap(
                osm.source,
                frame,
                extent,
                roads.drivable if len(roads.drivable) else None,
                buildings.footprint[buildings.drawn],
                buildings.min_height[buildings.drawn],
                passages.polygon,
                passages.height,
                left_hand=roads.side == "left",
            )
        )
        reach = Reach.within(area)

    progress("ground", 0, total=0)
    place = _Place(osm, frame, extent, terrain, buildings, passages, roads, options)
    local = _collect(problems, _in_reach(place, reach))
    cover, surfaces, structures = local.cover, local.surfaces, local.structures
    trees, furniture, barriers = local.trees, local.furniture, local.barriers
    ground, rows = local.ground, local.rows
    footprints = buildings.footprint[: buildings.count]
    chosen, kept = local.chosen, None
    if reach is not None:
        kept = reach.rows(local.shapes, tiles=chosen, ground=ground, rows=rows, buildings=buildings)
        if needed is not None:
            kept["roads"] = np.arange(len(roads.drivable))
        kept["passages"] = np.flatnonzero(np.isin(passages.building, kept["buildings"]))
    standing = np.arange(buildings.count) if kept is None else kept["buildings"]
    base, foot = np.full((2, buildings.count), np.nan)
    base[standing] = base_heights(footprints[standing], local.height)
    buildings = with_measured_tops(buildings, base)
    foot[standing] = foundation_heights(
        footprints[standing], base[standing], height=local.height, layers=ground.layers, levels=local.levels
    )
    cuts = _collect(problems, passage_cuts(passages, buildings, base=base, height=local.height))
    buildings = _collect(problems, buildings_over(buildings, base, foot=foot, table=structures, cuts=cuts))
    buildings = without_guess(buildings, np.array([len(some) > 0 for some in buildings.passages], np.bool_))

    buildings = with_looks(buildings, region_at(*_checked_centre(osm)))
    rooftops = None
    if options.relief == "full":
        rooftops = plan_rooftops(buildings, centre=_checked_centre(osm))
    facades = None
    if options.relief != "off":
        facades = read_setting(osm, frame, buildings=buildings, streets=edge_lines(roads.graph))
    surface = standing_height(ground, local.height)
    layers = [
        *building_layers(
            buildings, base, parapet=None if rooftops is None else rooftops.parapet, facades=facades
        ),
        ground_layer("landcover", cover),
        ground_layer("road_surfaces", surfaces),
        road_layer(roads.drivable),
        tree_layer(trees, _foot(trees.xy, surface), with_relief=options.relief != "off"),
        furniture_layer(furniture, _foot(furniture.xy, surface), with_relief=options.relief != "off"),
        barrier_layer(barriers),
        structure_layer(structures),
    ]
    if len(local.wires):
        layers.append(wire_layer(local.wires))
    if len(passages):
        layers.append(passage_layer(passages))
    plan = BuildPlan(
        frame=frame,
        terrain=terrain,
        height=local.height,
        buildings=buildings,
        base=base,
        foot=foot,
        rows=rows,
        graph=roads.drivable,
        side=(roads.side, roads.side_source),
        ground=ground,
        chosen=chosen,
        kept=kept,
        levels=local.levels,
        trees=trees,
        forests=Forests.of(ground.layers, osm, with_relief=options.relief != "off")
        if "trees" in options.only
        else None,
        furniture=furniture,
        barriers=barriers,
        structures=structures,
        openings=local.openings,
        use=USES[options.use],
        relief=options.relief,
        facades=facades,
        rooftops=rooftops,
        wires=local.wires,
        layers=layers,
        ranges=local.ranges,
        area=area,
        route=route,
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
    return wrap_longitude((west + east) / 2), (south + north) / 2


@dataclass(frozen=True, slots=True)
class _Roads:
    """Roads of a map and the ground graded to them.

    graph  : of the whole map, with heights
    drivable : the part of it within the extent that vehicles can drive on
    height : z of the graded ground, None if it is 0 everywhere
    uneven : the ground or a road has heights other than 0
    """

    graph: RoadGraph
    drivable: RoadGraph
    carriageways: Carriageways
    side: Side
    side_source: str
    height: Height | None
    uneven: bool


def _with_clear_ends(osm: OsmData, frame: Frame) -> tuple[OsmData, list[Problem]]:
    """The map with bridges and tunnels that end clear of streets, also beyond its bounds."""
    whole, problems = lengthen_structures(_with_around(osm), frame)
    count = len(osm.ways)
    found = replace(osm, ways=whole.ways[:count], around=whole.ways[count:])
    beyond = {way.osm_id for way in osm.around}
    return found, [problem for problem in problems if problem.osm_id not in beyond]


def _with_around(osm: OsmData) -> OsmData:
    """The map with the ways beyond its bounds, after its own."""
    return replace(osm, ways=[*osm.ways, *osm.around])


def _plan_roads(
    osm: OsmData,
    frame: Frame,
    *,
    extent: Bounds,
    options: BuildOptions,
    terrain: Terrain,
    walls: Walls,
    problems: list[Problem],
) -> _Roads:
    """Road graph with heights, and carriageways."""
    mapped = _only_roads(osm, options)
    side, source = found_side(osm)
    if options.driving_side:
        side, source = cast("Side", options.driving_side), "option"
    road_options = RoadOptions(left_hand=side == "left")
    graph = _collect(problems, build_road_graph(mapped, frame, options=road_options, walls=walls))
    problems += find_odd_layers(mapped.ways)
    if not terrain.grids:
        problems += find_unused_inclines(mapped.ways)
    surveyed = 0.0 < terrain.spacing <= _SURVEYED
    around = _with_around(mapped)
    whole = build_road_graph(around, frame, options=road_options, walls=walls)[0] if mapped.around else graph
    obstacles = find_obstacles(around, frame)
    whole = profile(whole, terrain.height, obstacles=obstacles, options=ProfileOptions(edges=surveyed))
    graph = take_heights(graph, whole) if mapped.around else whole
    uneven = bool(terrain.grids) or any(line[:, 2].any() for line in graph.geometry)
    height = None
    if uneven:
        height = graded_ground(graph, terrain.height, level=not terrain.grids, surveyed=surveyed)
    sidewalks = SurfaceOptions().sidewalks
    carriageways = read_carriageways(
        mapped, frame, sidewalks=sidewalks, left_hand=side == "left", walls=walls
    )
    closed = _collect(problems, find_closed(graph, walls)) | _collect(problems, find_stacked(graph))
    drivable = clip_graph(leave_out(graph, closed), extent)
    return _Roads(graph, drivable, carriageways, side, source, height, uneven)


def _only_roads(osm: OsmData, options: BuildOptions) -> OsmData:
    """The map that roads are read from: without features if the scene has none."""
    none = replace(osm, areas=[], ways=[], relations=[], points=[], around=[])
    return osm if "roads" in options.only else none


@dataclass(frozen=True, slots=True)
class _Place:
    """Plan of the whole map."""

    osm: OsmData
    frame: Frame
    extent: Bounds
    terrain: Terrain
    buildings: Buildings
    passages: Passages
    roads: _Roads
    options: BuildOptions


@dataclass(frozen=True, slots=True)
class _Local:
    """Plan near a route, or everywhere; see `BuildPlan` for the columns.

    shapes : of all features by kind
    """

    cover: Layers
    surfaces: Layers
    structures: Structures
    openings: NDArray[np.object_]
    height: Height | None
    levels: WaterLevels
    ground: GroundPlan
    trees: Trees
    furniture: Furniture
    barriers: Barriers
    wires: Wires
    shapes: dict[str, NDArray[np.object_]]
    rows: dict[str, dict[tuple[int, int], NDArray[np.int64]]]
    chosen: list[tuple[int, int]]
    ranges: dict[str, tuple[int, int]]


def _in_reach(place: _Place, reach: Reach | None) -> tuple[_Local, list[Problem]]:
    """Surfaces, structures and objects of all tiles in range of the route, and problems."""
    if reach is None:
        return _plan_within(place, None, area=None)
    size = place.options.tile_size
    area = reach.surroundings(size, extent=place.extent)
    while True:
        local, problems = _plan_within(place, reach, area=area)
        # A tile far away may be chosen for what extends from it into the reach; joined tiles are empty.
        boxes = tile_boxes(
            local.ground, [t for t in local.chosen if tile_span(local.ground, t[0], j=t[1]) == 1]
        )
        around = shapely.buffer(boxes, AROUND, join_style="mitre")
        beyond = around[~shapely.covers(area, around)]
        if not len(beyond):
            return local, problems
        area = shapely.union_all([area, *beyond])


def _plan_within(place: _Place, reach: Reach | None, *, area: Any | None) -> tuple[_Local, list[Problem]]:
    """Plan of an area, or of everything."""
    osm, frame, extent, roads, options = place.osm, place.frame, place.extent, place.roads, place.options
    buildings, terrain = place.buildings, place.terrain
    footprints = buildings.footprint[: buildings.count]
    land = _usual_land(osm)
    problems: list[Problem] = []
    made = road_surfaces(
        _only_roads(osm, options),
        roads.graph,
        frame=frame,
        roads=roads.carriageways,
        options=SurfaceOptions(left_hand=roads.side == "left", covers=_COVERS[options.relief]),
        area=area,
    )
    structures = _collect(
        problems,
        read_structures(
            made,
            roads.graph,
            osm=osm,
            frame=frame,
            height=roads.height,
            options=StructureOptions.of_relief(options.relief),
            area=area,
        ),
    )
    structures = within_extent(structures, extent)
    height = roads.height
    if len(structures):
        height = ground_below(structures, height or terrain.height)
    openings = find_openings(structures, height, graph=roads.graph, area=area)

    cover, surfaces, pads = _collect(
        problems,
        _surfaces(
            osm,
            frame,
            extent=extent,
            buildings=buildings,
            passages=place.passages,
            made=made,
            roads=roads,
            land=land,
            only=options.only,
        ),
    )
    found = _collect(problems, _objects(osm, frame, extent=extent, options=options))
    strung = options.relief != "off" and "furniture" in options.only
    wires = read_wires(osm if strung else replace(osm, ways=[]), frame, extent=extent)
    ranges = number_ranges(
        {
            "buildings": buildings.count,
            "building_parts": len(buildings) - buildings.count,
            "landcover": len(cover),
            "road_surfaces": made.count,
            "roads": len(roads.drivable),
            **{name: count for name, (_, _, count) in found.items()},
            "structures": len(structures),
            **({"wires": len(wires)} if len(wires) else {}),
            **({"passages": len(place.passages)} if len(place.passages) else {}),
        }
    )
    cover, surfaces = (
        replace(table, feature=table.feature + np.int32(ranges[name][0]))
        for name, table in (("landcover", cover), ("road_surfaces", surfaces))
    )
    structures = replace(structures, feature=np.arange(*ranges["structures"], dtype=np.int32))
    if len(wires):
        wires = replace(wires, feature=np.arange(*ranges["wires"], dtype=np.int32))
    low = opening_layers(structures, openings)
    graph, hilly = roads.graph, bool(terrain.grids)
    high = np.array([hilly or np.abs(line[:, 2]).max() > _FLUSH for line in graph.geometry], np.bool_)
    street = np.flatnonzero(graph.once & ~graph.bridge & ~graph.tunnel & high)
    quays = quay_walls(
        cover.polygon[cover.body != ""],
        surfaces.polygon,
        lines=edge_lines(graph)[street],
        width=graph.width[street],
    )
    raised, kerbs, extra = None, None, []
    if options.relief != "off":
        ends = sidewalk_ends(roads.carriageways)
        kerbs = Kerbs.of(ends)
        crowns = find_crowns(roads.carriageways)
        tracks = _only_roads(osm, options) if "landcover" in options.only else replace(osm, ways=[])
        beds, bed_rows = read_beds(tracks, frame, cover=cover, others=Layers.concatenate([surfaces, pads]))
        raised = Raised(camber_of(roads.carriageways, crowns), beds)
        first = ranges["road_surfaces"][0] + made.first
        extra = [
            lowered_kerbs(surfaces, mapped=mapped_kerbs(_only_roads(osm, options), frame)),
            kerb_ends(surfaces, ends),
            bed_rows,
            crown_rows(roads.carriageways, crowns, surfaces=surfaces, first=first),
        ]
    covers = Layers.concatenate([cover, surfaces, pads, low, quays, *extra])
    levels = water_levels(covers, osm.ways, frame=frame, height=terrain.height)
    ground = _plan_ground(
        covers,
        roads,
        land=land,
        extent=extent,
        terrain=terrain,
        options=options,
        creases=None if height is None else crease_lines(roads.graph, height, area=area),
        kerbs=kerbs,
        raised=raised,
    )
    trees, furniture, barriers = (
        replace(table, feature=table.feature + np.int32(ranges[name][0]))
        for name, table in _site(
            osm, frame, ground=ground, found=found, side=roads.side, relief=options.relief, problems=problems
        )
    )

    shapes = {
        "buildings": footprints,
        "parts": footprints[buildings.outline[buildings.count :]],
        "trees": shapely.points(trees.xy),
        "furniture": shapely.points(furniture.xy),
        "barriers": barriers.polygon,
        "structures": structures.polygon,
        "wires": wires.lines,
    }
    rows = {kind: _by_tile(column, options.tile_size) for kind, column in shapes.items()}
    rows["parts"] = {tile: buildings.count + parts for tile, parts in rows["parts"].items()}
    boxes = np.concatenate(
        [
            carriageway_boxes(roads.carriageways),
            shapely.bounds(made.polygon[np.char.startswith(made.osm_id, "node/")]).reshape(-1, 4),
            *(boxes for _, boxes, _ in found.values()),
            shapely.bounds(structures.polygon).reshape(-1, 4),
            shapely.bounds(wires.lines).reshape(-1, 4),
        ]
    )
    ground = join_tiles(ground, {*rows["buildings"], *rows["parts"], *_squares(boxes, options.tile_size)})

    chosen = all_tiles(ground, rows)
    if reach is not None:
        shapes |= {
            "buildings": buildings.footprint,
            "parts": buildings.footprint,
            "landcover": cover.polygon,
            "road_surfaces": surfaces.polygon,
            "roads": edge_lines(roads.drivable),
        }
        beyond = {"trees": trees.crown / 2, "furniture": _ARM}
        chosen = reach.tiles(ground, rows=rows, shapes=shapes, beyond=beyond)
    return _Local(
        cover,
        surfaces,
        structures,
        openings,
        height,
        levels,
        ground,
        trees,
        furniture,
        barriers,
        wires,
        shapes,
        rows,
        chosen,
        ranges,
    ), problems


def _plan_ground(
    layers: Layers,
    roads: _Roads,
    *,
    land: Land,
    extent: Bounds,
    terrain: Terrain,
    options: BuildOptions,
    creases: Float | None,
    kerbs: Kerbs | None,
    raised: Raised | None,
) -> GroundPlan:
    size, tolerance = options.tile_size, options.dem_tolerance
    if tolerance is None:
        tolerance = _TOLERANCE * terrain.spacing
    ground = plan_ground(
        extent,
        layers,
        tile_size=size,
        lines=_ROAD_LINES if roads.uneven else 0.0,
        ruled=_graded_tiles(roads.graph, size, level=not terrain.grids),
        coarse=terrain.lines,
        terrain=TerrainHeights(terrain.height, tolerance, terrain.lines)
        if terrain.grids and tolerance
        else None,
        base=(Class.TERRAIN, land.open),
        kerbs=kerbs,
        raised=raised,
    )
    return ground if creases is None else cut_along(ground, creases)


def _usual_land(osm: OsmData) -> Land:
    """The usual land at a map's middle."""
    centre = _checked_centre(osm)
    region = palettes()["regions"][region_at(*centre)]
    return Land("dry_grass" if abs(centre[1]) > _POLAR else region["open"], region["fields"])


def _surfaces(
    osm: OsmData,
    frame: Frame,
    *,
    extent: Bounds,
    buildings: Buildings,
    passages: Passages,
    made: RoadSurfaces,
    roads: _Roads,
    land: Land,
    only: Collection[str],
) -> tuple[tuple[Layers, Layers, Layers], list[Problem]]:
    """Land cover, road surfaces and building pads, as layers of the ground; numbers from 0 in each."""
    problems: list[Problem] = []
    count = buildings.count
    footprints = buildings.footprint[:count]
    parts = [paved_fabric(footprints)]
    if "landcover" in only:
        cover, found = landcover(osm, frame, extent=extent, land=land)
        ground = roads.carriageways.place == 0
        assumed = parcels(
            land,
            roads=roads.carriageways.line[ground],
            width=roads.carriageways.width[ground],
            buildings=footprints,
            cover=cover,
        )
        parts = [assumed, *parts, cover]
        problems += found
    first = np.flatnonzero(np.diff(made.number, prepend=-1))  # of the parts of each shape
    surfaces = made.take(first)
    paved = Layers.of(
        _together(made.polygon, first),
        klass=surfaces.klass,
        material=surfaces.material,
        priority=surfaces.priority,
        osm_id=surfaces.osm_id,
        source=surfaces.source,
        feature=surfaces.number,
    )
    pads = building_pads(
        _on_ground(buildings, passages, free=_RAISED),
        osm_id=buildings.osm_id[:count].astype(str),
        feature=np.arange(count, dtype=np.int32),
    )
    cover = Layers.concatenate(parts)
    return (replace(cover, feature=np.arange(len(cover), dtype=np.int32)), paved, pads), problems


def _on_ground(buildings: Buildings, passages: Passages, *, free: float) -> NDArray[np.object_]:
    """What buildings (count,) take of the ground, or None: not what is below raised parts or in passages.

    free : metres of the underside of raised parts, at least
    """
    shapes = buildings.footprint[: buildings.count].copy()
    low = buildings.drawn & (buildings.min_height < free)
    raised = np.unique(buildings.outline[buildings.drawn & ~low])
    of_low = np.flatnonzero(low)
    of_low = of_low[np.argsort(buildings.outline[of_low], kind="stable")]
    first, last = (np.searchsorted(buildings.outline[of_low], raised, side=s) for s in ("left", "right"))
    for k, a, b in zip(raised.tolist(), first.tolist(), last.tolist(), strict=True):
        whole = shapely.union_all(buildings.footprint[of_low[a:b]], grid_size=PRECISION)
        shapes[k] = areal(shapely.intersection(shapes[k], whole, grid_size=PRECISION))
    for k in np.unique(passages.building).tolist():
        taken = shapely.union_all(passages.polygon[passages.building == k])
        shapes[k] = areal(shapely.difference(shapes[k], taken, grid_size=PRECISION))
    shapes[shapely.is_empty(shapes)] = None
    return shapes


def _together(polygons: NDArray[np.object_], first: NDArray[np.int64]) -> NDArray[np.object_]:
    """Shapes of parts that follow each other, given each one's first: polygons if they have one part."""
    shapes = polygons[first]
    sizes = np.diff(first, append=len(polygons))
    for k in np.flatnonzero(sizes > 1).tolist():
        shapes[k] = shapely.MultiPolygon(polygons[first[k] : first[k] + sizes[k]].tolist())
    return shapes


def _objects(
    osm: OsmData, frame: Frame, *, extent: Bounds, options: BuildOptions
) -> tuple[dict[str, tuple[Any, Float, int]], list[Problem]]:
    """Mapped trees, furniture and barriers, by kind; empty for kinds that the options exclude.

    These are a table of the objects before they are sited (of furniture: the guesses or None), boxes (n, 4)
    within which they will stand, and the count of their feature numbers.
    """
    trees, problems = read_trees(osm, frame, with_relief=options.relief != "off")
    barriers, more = read_barriers(osm, frame, extent=extent)
    relief = options.relief
    posts = mapped_furniture(osm, frame, extent=extent, relief=relief)[1]
    guesses = guess_furniture(osm, frame, extent=extent) if relief == "full" else None
    each = POSTS if relief == "off" else STANDS
    extra = 0 if guesses is None else len(guesses)
    places = posts if guesses is None else np.concatenate([posts, guesses.xy])
    around = np.array([-_MOVED, -_MOVED, _MOVED, _MOVED])
    found: dict[str, tuple[Any, Float, int]] = {
        "trees": (trees, np.tile(trees.xy, 2) + around, len(trees)),
        "furniture": (guesses, np.tile(places, 2) + around, each * len(posts) + extra),
        "barriers": (barriers, shapely.bounds(barriers.polygon).reshape(-1, 4), len(barriers)),
    }
    wanted = {"trees": problems, "furniture": [], "barriers": more}
    return (
        {
            kind: row
            if kind in options.only
            else (None if row[0] is None else row[0].take(slice(0)), row[1][:0], 0)
            for kind, row in found.items()
        },
        [problem for kind, some in wanted.items() if kind in options.only for problem in some],
    )


def _site(
    osm: OsmData,
    frame: Frame,
    *,
    ground: GroundPlan,
    found: Mapping[str, tuple[Any, Float, int]],
    side: Side,
    relief: str,
    problems: list[Problem],
) -> list[tuple[str, Any]]:
    """Trees, furniture and barriers, moved off carriageways, by name."""
    trees = _collect(problems, clear_of(ground, found["trees"][0]))
    guesses, _, count = found["furniture"]
    given = osm if count else replace(osm, points=[])
    furniture = _collect(
        problems, read_furniture(given, frame, plan=ground, left_hand=side == "left", relief=relief)
    )
    barriers = _collect(problems, open_barriers(found["barriers"][0], ground))
    if relief != "off":
        furniture = with_details(furniture, Sites.of(ground), full=relief == "full")
    if guesses is not None and count:
        taken = Taken(
            np.concatenate([furniture.xy, trees.xy]),
            np.concatenate([furniture.shape, np.full(len(trees), "")]),
            barriers.polygon,
        )
        first = count - len(guesses)
        furniture = with_guesses(furniture, guesses, sites=Sites.of(ground), taken=taken, first=first)
    return [("trees", trees), ("furniture", furniture), ("barriers", barriers)]


def _graded_tiles(graph: RoadGraph, tile_size: float, *, level: bool) -> set[tuple[int, int]]:
    """Tiles whose ground is graded to roads; on ``level`` ground only those with ramps."""
    if not len(graph):
        return set()
    points = np.concatenate(list(graph.geometry))
    if level:
        points = points[np.abs(points[:, 2]) > 1e-3]
    around = np.array([(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]) * _ROAD_REACH
    return _distinct(np.floor((points[:, None, :2] + around).reshape(-1, 2) / tile_size).astype(np.int64))


def _squares(boxes: Float, tile_size: float) -> set[tuple[int, int]]:
    """Squares of the grid of tiles that boxes (n, 4) touch."""
    low, high = (np.floor(corner / tile_size).astype(np.int64) for corner in (boxes[:, :2], boxes[:, 2:]))
    return _distinct(squares_between(low, high)[0])


def _distinct(tiles: Ints) -> set[tuple[int, int]]:
    """The different ones among tiles (n, 2)."""
    low, high = tiles.min(axis=0, initial=0), tiles.max(axis=0, initial=0)
    key = np.unique(np.ravel_multi_index((tiles - low).T, high - low + 1))
    i, j = np.unravel_index(key, high - low + 1)
    return set(zip((i + low[0]).tolist(), (j + low[1]).tolist(), strict=True))


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

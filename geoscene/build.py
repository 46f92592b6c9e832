"""The pipeline: from a map extract to a scene directory."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene import __version__
from geoscene.buildings import Buildings, build_solids, read_buildings
from geoscene.errors import InputError, SourceNotFoundError
from geoscene.features import building_layers, ground_layer, road_layer, tree_layer
from geoscene.frames import Frame
from geoscene.geopackage import Layer
from geoscene.ground import (
    GroundPlan,
    Layers,
    WaterLevels,
    building_pads,
    concatenate_layers,
    ground_tile,
    landcover,
    plan_ground,
    water_levels,
)
from geoscene.mesh import Mesh, concatenate
from geoscene.progress import Progress, silent
from geoscene.report import Problem, summarise
from geoscene.road_surfaces import road_surfaces
from geoscene.roadgraph import build_road_graph, find_components, write_graphml
from geoscene.roads import RoadGraph
from geoscene.scene import Instances, Scene, open_scene
from geoscene.shapes import concatenate_instances, shapes
from geoscene.sources import ATTRIBUTION, OsmData
from geoscene.store import SceneWriter, split
from geoscene.terrain import Terrain, base_heights, flat_terrain, open_terrain
from geoscene.urban import paved_fabric
from geoscene.validate import validate_mesh
from geoscene.vegetation import Trees, clear_of, forest_trees, needle_shares, read_trees, tree_instances

Float = NDArray[np.float64]
Bounds = tuple[float, float, float, float]

_STANDING = 1.0  # metres: a building whose underside is higher leaves the ground under it as it is


@dataclass(frozen=True, slots=True)
class BuildOptions:
    """How a scene is built.

    crs       : ``local``, ``utm`` or a CRS that pyproj knows
    lod       : of buildings: 0 blocks, 1 parts with flat roofs, 2 roofs
    dem       : elevation files; level ground without
    dem_gaps  : what to do where they do not cover the scene: ``error``, or ``nearest`` height and say so
    tile_size : metres, side of a tile
    name      : of the scene, for people
    """

    crs: str = "local"
    lod: int = 2
    dem: tuple[str, ...] = ()
    dem_gaps: str = "error"
    tile_size: float = 250.0
    name: str = ""

    def __post_init__(self) -> None:
        """Refuse options that cannot be meant."""
        if self.lod not in (0, 1, 2):
            raise InputError(f"--lod {self.lod}: 0 (blocks), 1 (parts, flat roofs) or 2 (roofs)")
        if self.dem_gaps not in ("error", "nearest"):
            raise InputError(f"--dem-gaps {self.dem_gaps}: error or nearest")
        if not 50 <= self.tile_size <= 2000 or self.tile_size != int(self.tile_size):
            raise InputError(f"--tile-size {self.tile_size}: give whole metres from 50 to 2000")


@dataclass(frozen=True, slots=True)
class Plan:
    """All that tiles are made from: features of the whole scene, numbered, not yet cut.

    layers : the feature tables, in the order of their numbers
    ground : what lies on the ground
    levels : how high its water stands
    solids : the buildings
    trees  : mapped ones
    needles : share of needle-leaved trees by row of the ground's layers
    """

    terrain: Terrain
    layers: list[Layer]
    ground: GroundPlan
    levels: WaterLevels
    solids: Mesh
    trees: Trees
    needles: Float


def build(
    osm: OsmData,
    out: Path,
    options: BuildOptions | None = None,
    *,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Scene:
    """Build a scene of a map extract and write it to a directory.

    Raises SourceNotFoundError for an extract without anything to build, FrameError for a CRS that cannot
    serve and SceneFormatError for a directory that may not be used.
    """
    options = options or BuildOptions()
    if not (osm.areas or osm.ways):
        raise SourceNotFoundError(f"{osm.source or 'the extract'}: nothing in it to build from")
    west, south, east, north = osm.bounds
    frame = Frame.at((west + east) / 2, (south + north) / 2, options.crs)
    problems: list[Problem] = list(osm.problems)
    with SceneWriter(out, tile_size=options.tile_size, overwrite=overwrite) as writer:
        progress("buildings", 0, 0)
        buildings, found = read_buildings(osm, frame)
        problems += found
        extent = _extent(frame, osm.bounds, buildings)
        terrain = _terrain(frame, extent, options)
        frame = replace(frame, vertical=terrain.vertical)
        base = base_heights(buildings.footprint[: buildings.count], terrain)
        solids, found = build_solids(buildings, base=base, lod=options.lod)
        problems += found

        progress("roads and ground", 0, 0)
        graph, found = build_road_graph(osm, frame)
        problems += found
        if len(graph):
            write_graphml(graph, frame, writer.folder / "roads.graphml")
        plan, found = _plan(osm, frame, extent, terrain, buildings, base, solids, graph, options)
        problems += found

        area = _write_tiles(writer, plan, progress)
        manifest = _manifest(osm, options, plan, buildings, graph, problems) | {"ground": area}
        writer.finish(
            frame=frame,
            bounds=extent,
            layers=plan.layers,
            shapes=shapes(),
            problems=problems,
            manifest=manifest,
        )
    return open_scene(out)


def _extent(frame: Frame, bounds: Bounds, buildings: Buildings) -> Bounds:
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


def _terrain(frame: Frame, extent: Bounds, options: BuildOptions) -> Terrain:
    if not options.dem:
        return flat_terrain(frame)
    outside: Literal["error", "nearest"] = "nearest" if options.dem_gaps == "nearest" else "error"
    return open_terrain(options.dem, frame, bounds=extent, outside=outside)


def _plan(
    osm: OsmData,
    frame: Frame,
    extent: Bounds,
    terrain: Terrain,
    buildings: Buildings,
    base: Float,
    solids: Mesh,
    graph: RoadGraph,
    options: BuildOptions,
) -> tuple[Plan, list[Problem]]:
    """Read what lies and stands on the ground, and number all features."""
    n, count = len(buildings), buildings.count
    footprints = buildings.footprint[:count]
    cover, problems = landcover(osm, frame, extent=extent)
    cover = concatenate_layers([paved_fabric(footprints), cover])
    surfaces, found = road_surfaces(osm, graph, frame)
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
    cover, roads = _numbered(cover, n), _numbered(roads, n + len(cover))
    ground = plan_ground(
        extent,
        concatenate_layers([cover, roads, pads]),
        tile_size=options.tile_size,
        lines=terrain.lines,
    )
    height = terrain.height if terrain.grids else None
    levels = water_levels(ground.layers, osm.ways, frame, height=terrain.height)
    trees, found = read_trees(osm, frame)
    problems += found
    trees, found = clear_of(ground, trees)
    problems += found
    first = n + len(cover) + len(roads) + len(graph)
    trees = replace(trees, feature=np.arange(first, first + len(trees), dtype=np.int32))
    foot = height(*trees.xy.T) if height else np.zeros(len(trees))
    layers = [
        *building_layers(buildings, base),
        ground_layer("landcover", cover),
        ground_layer("road_surfaces", roads),
        road_layer(graph),
        tree_layer(trees, foot),
    ]
    return Plan(terrain, layers, ground, levels, solids, trees, needle_shares(ground, osm)), problems


def _numbered(layers: Layers, first: int) -> Layers:
    return replace(layers, feature=np.arange(first, first + len(layers), dtype=np.int32))


def make_tile(plan: Plan, i: int, j: int) -> tuple[Mesh, Instances]:
    """Ground and trees of tile (i, j), scene coordinates; the same whatever other tiles are made."""
    height = plan.terrain.height if plan.terrain.grids else None
    ground = ground_tile(plan.ground, i, j, height=height, levels=plan.levels)
    size = plan.ground.tile_size
    here = (np.floor(plan.trees.xy / size) == (i, j)).all(axis=1)
    woods = forest_trees(plan.ground, i, j, needles=plan.needles)
    copies = [tree_instances(trees, height=height) for trees in (plan.trees.take(here), woods)]
    return ground, concatenate_instances(copies)


def _write_tiles(writer: SceneWriter, plan: Plan, progress: Progress) -> dict[str, float]:
    """Write all tiles; return the ground's area in plan against the extent's, square metres."""
    stands = split(plan.solids, _tile_of_features(plan.solids, writer.tile_size))
    covered = {(int(i), int(j)) for i, j in plan.ground.tiles}
    tiles = sorted(covered | set(stands))
    area = 0.0
    for done, (i, j) in enumerate(tiles):
        progress("tiles", done, len(tiles))
        mesh, copies = make_tile(plan, i, j) if (i, j) in covered else (Mesh.empty(), Instances.empty())
        area += _plan_area(mesh)
        standing = [stands[i, j]] if (i, j) in stands else []
        writer.tile(i, j, concatenate([*standing, mesh]), copies)
    xmin, ymin, xmax, ymax = plan.ground.extent
    return {"area": area, "extent_area": (xmax - xmin) * (ymax - ymin)}


def _plan_area(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, k], :2] for k in range(3))
    u, v = b - a, c - a
    return float((u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum() / 2)


def _tile_of_features(mesh: Mesh, size: float) -> NDArray[np.int64]:
    """Tile (m, 2) of each face: the one that holds the middle of its feature's box."""
    if not len(mesh):
        return np.empty((0, 2), np.int64)
    corner = mesh.vertices[mesh.faces][:, :, :2]
    feature, owner = np.unique(mesh.feature, return_inverse=True)
    low = np.full((len(feature), 2), np.inf)
    high = np.full((len(feature), 2), -np.inf)
    np.minimum.at(low, owner, corner.min(axis=1))
    np.maximum.at(high, owner, corner.max(axis=1))
    tile: NDArray[np.int64] = np.floor((low + high) / 2 / size).astype(np.int64)[owner]
    return tile


def _manifest(
    osm: OsmData,
    options: BuildOptions,
    plan: Plan,
    buildings: Buildings,
    graph: RoadGraph,
    problems: Sequence[Problem],
) -> dict[str, Any]:
    count = buildings.count
    verdict = validate_mesh(plan.solids)
    summary = summarise(problems)
    dropped = summary["dropped"].get("building", {})
    components = find_components(graph)
    terrain = plan.terrain
    recipe = {
        "source": osm.source,
        "bounds": osm.bounds,
        "options": asdict(options),
        "version": __version__,
    }
    return {
        "generator": f"geoscene {__version__}",
        "name": options.name,
        "attribution": ATTRIBUTION,
        "fingerprint": hashlib.sha256(json.dumps(recipe, sort_keys=True).encode()).hexdigest()[:20],
        "sources": [
            {
                "kind": "osm",
                "from": osm.source,
                "timestamp": osm.timestamp,
                "licence": "ODbL-1.0",
                "attribution": ATTRIBUTION,
            },
            *({"kind": "terrain", "from": name} for name in terrain.sources),
        ],
        "geographic_bounds": list(osm.bounds),
        "options": asdict(options),
        "terrain": {
            "vertical": terrain.vertical,
            "datum": terrain.datum,
            "spacing_m": terrain.spacing,
            "posts": terrain.posts,
            "voids_filled": terrain.voids,
            "uncovered_share": terrain.uncovered,
            "rivers_turned": list(plan.levels.reversed),
        },
        "counts": {
            "buildings": count + sum(dropped.values()) - dropped.get("no-solid", 0),
            "solids": len(verdict),
            "dropped": sum(dropped.values()),
            "repaired": sum(summary["repaired"].get("building", {}).values()),
            "building_parts": len(buildings) - count,
            "watertight": int(verdict.ok.sum()),
            "faces": len(plan.solids),
            "road_edges": len(graph),
            "road_km": round(float(graph.length.sum()) / 1000, 3),
            "road_components": int(components.strong.max(initial=-1)) + 1,
            "road_largest_component_share": round(components.largest_strong_share, 4),
            "trees": len(plan.trees),
        },
        "heights": dict(sorted(Counter(buildings.height_source[:count].tolist()).items())),
        "roofs": dict(sorted(Counter(buildings.roof_shape[buildings.drawn].tolist()).items())),
        "problems": summary,
    }

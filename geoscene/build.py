"""The pipeline: from a map extract to a scene directory."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene import __version__
from geoscene.buildings import Buildings, build_solids, read_buildings
from geoscene.classes import Class, materials
from geoscene.errors import InputError, SourceNotFoundError
from geoscene.frames import Frame
from geoscene.geopackage import Layer
from geoscene.ground import (
    building_pads,
    concatenate_layers,
    landcover,
    partition_tile,
    plan_ground,
    triangulate,
)
from geoscene.ground.layers import Layers
from geoscene.mesh import Mesh, concatenate
from geoscene.progress import Progress, silent
from geoscene.report import Problem, summarise
from geoscene.road_surfaces import road_surfaces
from geoscene.roadgraph import build_road_graph, find_components, write_graphml
from geoscene.roads import RoadGraph
from geoscene.scene import Scene, open_scene
from geoscene.sources import ATTRIBUTION, OsmData
from geoscene.store import SceneWriter, split
from geoscene.validate import validate_mesh

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class BuildOptions:
    """How a scene is built.

    crs       : ``local``, ``utm`` or a CRS that pyproj knows
    lod       : of buildings: 0 blocks, 1 parts with flat roofs, 2 roofs
    tile_size : metres, side of a tile
    name      : of the scene, for people
    """

    crs: str = "local"
    lod: int = 2
    tile_size: float = 250.0
    name: str = ""

    def __post_init__(self) -> None:
        """Refuse options that cannot be meant."""
        if self.lod not in (0, 1, 2):
            raise InputError(f"--lod {self.lod}: 0 (blocks), 1 (parts, flat roofs) or 2 (roofs)")
        if not 50 <= self.tile_size <= 2000 or self.tile_size != int(self.tile_size):
            raise InputError(f"--tile-size {self.tile_size}: give whole metres from 50 to 2000")


@dataclass(frozen=True, slots=True)
class _Ground:
    """What is drawn on the ground, before it is cut to tiles."""

    cover: Layers
    roads: Layers
    pads: Layers


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
    west, south, east, north = osm.bounds
    frame = Frame.at((west + east) / 2, (south + north) / 2, options.crs)
    if not (osm.areas or osm.ways):
        raise SourceNotFoundError(f"{osm.source or 'the extract'}: nothing in it to build from")
    problems: list[Problem] = list(osm.problems)
    with SceneWriter(out, tile_size=options.tile_size, overwrite=overwrite) as writer:
        progress("buildings", 0, 0)
        buildings, found = read_buildings(osm, frame)
        problems += found
        extent = _extent(frame, osm.bounds, buildings)
        solids, found = build_solids(buildings, base=np.zeros(buildings.count), lod=options.lod)
        problems += found

        progress("roads", 0, 0)
        graph, found = build_road_graph(osm, frame)
        problems += found
        if len(graph):
            write_graphml(graph, frame, writer.folder / "roads.graphml")
        ground, found = _read_ground(osm, graph, frame, buildings, extent)
        problems += found

        layers, ground = _numbered(buildings, ground, graph)
        area = _write_tiles(writer, extent, ground, solids, progress)
        manifest = _manifest(osm, options, buildings, graph, solids, problems) | {"ground": area}
        writer.finish(
            frame=frame, bounds=extent, layers=layers, shapes={}, problems=problems, manifest=manifest
        )
    return open_scene(out)


def _extent(
    frame: Frame, bounds: tuple[float, float, float, float], buildings: Buildings
) -> tuple[float, float, float, float]:
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


def _read_ground(
    osm: OsmData,
    graph: RoadGraph,
    frame: Frame,
    buildings: Buildings,
    extent: tuple[float, float, float, float],
) -> tuple[_Ground, list[Problem]]:
    cover, problems = landcover(osm, frame, extent=extent)
    surfaces, found = road_surfaces(osm, graph, frame)
    roads = Layers.of(
        surfaces.polygon,
        klass=surfaces.klass,
        material=surfaces.material,
        priority=surfaces.priority,
        osm_id=surfaces.osm_id,
        source=surfaces.source,
    )
    standing = buildings.footprint[: buildings.count].copy()
    standing[buildings.min_height[: buildings.count] >= 1.0] = None
    pads = building_pads(standing, osm_id=buildings.osm_id[: buildings.count].astype(str))
    return _Ground(cover, roads, pads), problems + found


def _numbered(buildings: Buildings, ground: _Ground, graph: RoadGraph) -> tuple[list[Layer], _Ground]:
    """The scene's layers, and the ground with feature numbers that match them."""
    n, count = len(buildings), buildings.count
    cover = replace(ground.cover, feature=np.arange(n, n + len(ground.cover), dtype=np.int32))
    first = n + len(cover)
    roads = replace(ground.roads, feature=np.arange(first, first + len(ground.roads), dtype=np.int32))
    pads = replace(ground.pads, feature=np.arange(count, dtype=np.int32))
    lines = np.empty(len(graph), object)
    lines[:] = [shapely.linestrings(line) for line in graph.geometry]
    layers = [
        _building_layer("buildings", buildings, np.arange(count)),
        _building_layer("building_parts", buildings, np.arange(count, n)),
        _ground_layer("landcover", cover),
        _ground_layer("road_surfaces", roads),
        Layer("roads", lines, _road_columns(graph)),
    ]
    return layers, _Ground(cover, roads, pads)


def _building_layer(name: str, b: Buildings, rows: NDArray[np.integer]) -> Layer:
    columns: dict[str, NDArray[Any]] = {
        "osm_id": b.osm_id[rows],
        "use": b.use[rows],
        "name": b.name[rows],
        "height": b.height[rows],
        "height_source": b.height_source[rows],
        "height_sigma": b.height_sigma[rows],
        "min_height": b.min_height[rows],
        "min_height_source": b.min_height_source[rows],
        "levels": b.levels[rows],
        "roof_shape": b.roof_shape[rows],
        "roof_height": b.roof_height[rows],
        "roof_source": b.roof_source[rows],
        "wall_material": _names(b.wall_material[rows]),
        "wall_source": b.wall_source[rows],
        "roof_material": _names(b.roof_material[rows]),
        "roof_look_source": b.roof_look_source[rows],
    }
    if name == "building_parts":
        columns = {"building": b.outline[rows], **columns}
    return Layer(name, b.footprint[rows], columns)


def _names(codes: NDArray[np.integer]) -> NDArray[np.str_]:
    table = np.zeros(256, "U32")
    for name, material in materials().items():
        table[material.code] = name
    names: NDArray[np.str_] = table[codes]
    return names


def _ground_layer(name: str, ground: Layers) -> Layer:
    return Layer(
        name,
        ground.polygon,
        {
            "osm_id": ground.osm_id,
            "class": np.array([Class(k).name.lower() for k in ground.klass], np.str_),
            "material": _names(ground.material),
            "priority": ground.priority,
            "source": ground.source,
        },
    )


def _road_columns(graph: RoadGraph) -> dict[str, NDArray[Any]]:
    names = (
        "osm_id", "highway", "name", "ref", "oneway", "speed", "speed_source", "lanes", "lanes_source",
        "width", "width_source", "layer", "layer_source", "bridge", "tunnel", "length",
    )  # fmt: skip
    return {name: getattr(graph, name) for name in names}


def _write_tiles(
    writer: SceneWriter,
    extent: tuple[float, float, float, float],
    ground: _Ground,
    solids: Mesh,
    progress: Progress,
) -> dict[str, float]:
    """Write all tiles; return the ground's area against the extent's, square metres."""
    plan = plan_ground(
        extent, concatenate_layers([ground.cover, ground.roads, ground.pads]), tile_size=writer.tile_size
    )
    color = np.zeros((256, 3), np.uint8)
    for material in materials().values():
        color[material.code] = material.color
    stands = split(solids, _tile_of_features(solids, writer.tile_size))
    tiles = sorted({(int(i), int(j)) for i, j in plan.tiles} | set(stands))
    covered = {(int(i), int(j)) for i, j in plan.tiles}
    total = 0.0
    for done, (i, j) in enumerate(tiles):
        progress("ground", done, len(tiles))
        parts = [stands[i, j]] if (i, j) in stands else []
        if (i, j) in covered:
            cells = partition_tile(plan, i, j)
            flat = triangulate(cells)
            code = cells.material[flat.cell]
            total += float(shapely.area(cells.polygon).sum())
            parts.append(
                Mesh.of(
                    np.column_stack([flat.points, np.zeros(len(flat.points))]),
                    flat.faces,
                    feature=cells.feature[flat.cell],
                    klass=cells.klass[flat.cell],
                    material=code,
                    color=color[code],
                )
            )
        writer.tile(i, j, concatenate(parts))
    xmin, ymin, xmax, ymax = extent
    return {"area": total, "extent_area": (xmax - xmin) * (ymax - ymin)}


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
    buildings: Buildings,
    graph: RoadGraph,
    solids: Mesh,
    problems: Sequence[Problem],
) -> dict[str, Any]:
    count = buildings.count
    verdict = validate_mesh(solids)
    summary = summarise(problems)
    dropped = summary["dropped"].get("building", {})
    components = find_components(graph)
    recipe = {"source": osm.source, "bounds": osm.bounds, "options": asdict(options), "version": __version__}
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
            }
        ],
        "geographic_bounds": list(osm.bounds),
        "options": asdict(options),
        "counts": {
            "buildings": count + sum(dropped.values()) - dropped.get("no-solid", 0),
            "solids": len(verdict),
            "dropped": sum(dropped.values()),
            "repaired": sum(summary["repaired"].get("building", {}).values()),
            "building_parts": len(buildings) - count,
            "watertight": int(verdict.ok.sum()),
            "faces": len(solids),
            "road_edges": len(graph),
            "road_km": round(float(graph.length.sum()) / 1000, 3),
            "road_components": int(components.strong.max(initial=-1)) + 1,
            "road_largest_component_share": round(components.largest_strong_share, 4),
        },
        "heights": dict(sorted(Counter(buildings.height_source[:count].tolist()).items())),
        "roofs": dict(sorted(Counter(buildings.roof_shape[buildings.drawn].tolist()).items())),
        "problems": summary,
    }

"""Subjects building, reading a map and reading a scene."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import osmium
import shapely
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from bench.measure import Case, Spent, alone, command
from bench.scenes import QUICK_BOX, Setup
from geoscene.buildings import build_solids, read_buildings
from geoscene.geometry.frames import Frame
from geoscene.ground.terrain import Terrain, base_heights
from geoscene.pipeline.plan import take_buildings
from geoscene.scene import Scene, open_scene
from geoscene.sources import OsmData, read_osm
from lidar.world.world import World

_TILE_M = 250.0


def building(setup: Setup) -> Iterator[Case]:
    """Whole builds by one and two workers, and the solids of buildings alone."""
    for name, path in setup.maps().items():
        _ = setup.scene_of(name)  # fills the cache of compiled code, which the first process would wait for
        out, box = setup.folder / "built", QUICK_BOX if setup.quick else None
        part = [f"--bbox={','.join(map(str, box))}"] if box else []
        yield Case(
            "building",
            f"{name}: map file to scene",
            1,
            "scenes",
            {f"{n} worker{'s'[: n > 1]}": partial(built, path, out, *part, workers=n) for n in (2, 1)},
            "whole processes with imports; the same bytes by one and two workers",
            clock="wall",
            processes=True,
        )
        osm = read_osm(path, bounds=box)
        west, south, east, north = osm.bounds
        frame = Frame.at((west + east) / 2, (south + north) / 2)
        count = read_buildings(osm, frame)[0].count
        if count:
            yield Case(
                "building",
                f"{name}: buildings alone",
                count,
                "buildings",
                {f"LoD {lod}": partial(_solids, osm, frame, lod=lod) for lod in (2, 1)},
                "footprints, heights, appearance, bases on level ground and solids, without parsing;"
                " LoD 1 makes flat roofs",
            )


def built(osm: Path, out: Path, *words: str, workers: int) -> Spent:
    """Cost of a build by a process of its own, with all tiles: those of a former one would be kept."""
    shutil.rmtree(out, ignore_errors=True)
    return command(build_command(osm, out, *words, "--workers", str(workers)))


def build_command(osm: Path, out: Path, *extra: str) -> list[str]:
    """Command line that builds a scene of a map file."""
    words = [sys.executable, "-m", "geoscene", "build", "--osm", str(osm), "--out", str(out)]
    return [*words, "--overwrite", "--quiet", *extra]


def _solids(osm: OsmData, frame: Frame, *, lod: int) -> None:
    """Make the solids of all buildings tile by tile, as a build does."""
    table, _ = read_buildings(osm, frame)
    base = base_heights(table.footprint[: table.count], Terrain(frame).height)
    for chosen, parts in _tiles(table):
        build_solids(take_buildings(table, chosen, parts=parts), base=base[chosen], lod=lod)


def _tiles(table: Any) -> list[tuple[Any, Any]]:
    """Rows of buildings and of their parts by tiles."""
    boxes = shapely.bounds(table.footprint[: table.count])
    home = np.floor((boxes[:, :2] + boxes[:, 2:]) / (2 * _TILE_M)).astype(int)
    _, tile = np.unique(home, axis=0, return_inverse=True)
    tile = tile.ravel()
    parts = np.flatnonzero(table.is_part)
    of_part = tile[table.outline[parts]]
    return [(np.flatnonzero(tile == k), parts[of_part == k]) for k in range(tile.max(initial=-1) + 1)]


def reading_maps(setup: Setup) -> Iterator[Case]:
    """Reading a map file, against pyosmium alone."""
    for name, path in setup.maps().items():
        yield Case(
            "reading a map",
            name,
            path.stat().st_size / 1e6,
            "MB",
            {
                "geoscene": partial(read_osm, path),
                "pyosmium, areas": partial(_areas, path),
                "pyosmium, objects": partial(_objects, path),
            },
            "all in this process. geoscene: columns, areas and lines with repairs, of any order of objects;"
            " areas: libosmium's areas and lines as WKB, and tags; objects: ids, positions, references and"
            " tags of all objects as Python lists, no geometry",
        )


def _areas(path: Path) -> list[tuple[str, dict[str, str]]]:
    """Geometry and tags of all areas and lines, by pyosmium."""
    factory, found = osmium.geom.WKBFactory(), []
    for item in osmium.FileProcessor(str(path)).with_locations().with_areas():
        with suppress(RuntimeError, osmium.InvalidLocationError):  # of cut relations and ways
            if item.is_area():
                found.append((factory.create_multipolygon(item), {tag.k: tag.v for tag in item.tags}))
            elif item.is_way():
                found.append((factory.create_linestring(item), {tag.k: tag.v for tag in item.tags}))
    return found


def _objects(path: Path) -> tuple[list[Any], list[Any], list[Any]]:
    """All objects of a file as Python values, by pyosmium."""
    nodes, ways, relations = [], [], []
    for item in osmium.FileProcessor(str(path)):
        tags = {tag.k: tag.v for tag in item.tags} if item.tags else None
        if item.is_node():
            nodes.append((item.id, item.location.x, item.location.y, tags))
        elif item.is_way():
            ways.append((item.id, [node.ref for node in item.nodes], tags))
        elif item.is_relation():
            relations.append((item.id, [(m.type, m.ref, m.role) for m in item.members], tags))
    return nodes, ways, relations


def reading_scenes(setup: Setup) -> Iterator[Case]:
    """Reading a scene's tiles and loading it for ray casting, against numpy and embreex alone."""
    for name in setup.maps():
        scene = setup.scene_of(name)
        size = sum(path.stat().st_size for path in scene.files.tiles.glob("*.npz")) / 1e6
        yield Case(
            "reading a scene",
            f"{name}: tiles",
            size,
            "MB",
            {"geoscene": lambda s=scene: _each(s), "numpy": lambda s=scene: _arrays(s)},
            "geoscene opens the scene, checks the columns and makes meshes; numpy loads the same arrays",
        )
        yield Case(
            "reading a scene",
            f"{name}: ready for rays",
            size,
            "MB",
            {
                side: partial(_apart, load, scene.path)
                for side, load in {"lidar": _world, "numpy, embreex": _plain_world}.items()
            },
            "each in a process of its own, without imports. lidar: tables of surfaces, and instances of trees"
            " and furniture, too, on one core; embreex: tiles' own triangles as one mesh, on all cores",
            processes=True,
        )


def _each(scene: Scene) -> int:
    return sum(len(tile.mesh.faces) for tile in open_scene(scene.path).tiles(forests=False))


def _arrays(scene: Scene) -> list[dict[str, Any]]:
    """Arrays of all tiles, by numpy."""
    found = []
    for path in sorted(scene.files.tiles.glob("*.npz")):
        with np.load(path) as file:
            found.append({name: file[name] for name in file.files})
    return found


def _apart(load: Callable[[Path], float], path: Path) -> Spent:
    """Cost of loading a scene in a process that has loaded it once before, and so has grown before."""
    cost = alone(_warm, load, path)
    return Spent(cost.wall_s, cost.cpu_s)


def _warm(load: Callable[[Path], float], path: Path) -> Callable[[], float]:
    """Loading of a scene, done once before."""
    load(path)
    return lambda: load(path)


def _world(path: Path) -> float:
    return _first_hit(World.load(open_scene(path)).caster.cast)


def _first_hit(cast: Callable[..., Any]) -> float:
    """Cast one ray, so that a lazy engine has built its tree."""
    return float(cast(np.array([[0.0, 0.0, 100.0]]), np.array([[0.0, 0.0, -1.0]])).range[0])


def _plain_world(path: Path) -> float:
    """Embree's tree over the triangles of all tiles, by numpy and embreex; the first range."""
    tiles = _arrays(open_scene(path))
    first = np.cumsum([0, *(len(tile["vertices"]) for tile in tiles)])
    vertices = np.concatenate([tile["vertices"] + tile["origin"] for tile in tiles])
    faces = np.concatenate([tile["faces"] + k for tile, k in zip(tiles, first, strict=False)])
    engine = EmbreeScene()
    TriangleMesh(engine, vertices.astype(np.float32), faces.astype(np.int32))
    ray = np.array([[0.0, 0.0, 100.0]], np.float32), np.array([[0.0, 0.0, -1.0]], np.float32)
    return float(engine.run(*ray, output=1)["tfar"][0])

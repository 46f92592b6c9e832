"""A scene on disk: tiles, features, road graph and manifest."""

from __future__ import annotations

import functools
import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import shapely

from geoscene.errors import (
    BUILD_AGAIN,
    DIFFERS,
    GeosceneError,
    InputError,
    SceneFormatError,
    reading,
    reason_of,
    schema_fault,
)
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import Mesh
from geoscene.objects.forests import Forests
from geoscene.roadgraph import RoadGraph, read_graphml
from geoscene.scene.geopackage import Layer, Schema, database_digest, read_layer, read_schema
from geoscene.scene.tile_files import Tile, read_shapes, read_tile, with_forests
from geoscene.support.digests import digest, file_digest, value_digest
from geoscene.support.files import write_atomically
from geoscene.support.option_values import brief
from geoscene.support.registry import Previewed
from geoscene.support.storage import StoredFolder, cache_folder, url_of
from geoscene.typing import Float, Ints
from geoscene.uses import USES

if TYPE_CHECKING:
    from geoscene.scene.level_roofs import GuessedRoofs

_PARTS = {"tiles": "tiles", "colors": "colours for cameras", "tables": "attributes of features"}
"""Parts that scenes for some uses lack, in words."""

SCHEMA = 3
"""Version of the scene directory; a reader refuses others."""


OVERHANG = 50.0
"""Metres by which a building may extend beyond its tile."""

_TILES = "tiles"
"""Name of the folder of tiles."""


@dataclass(frozen=True, slots=True)
class SceneFiles:
    """Paths of the files in a scene directory.

    folder : the directory, or the cache of one in object storage
    stored : that one in storage, from which files are fetched when their paths are asked for
    """

    folder: Path
    stored: StoredFolder | None = None

    def _local(self, name: str) -> Path:
        return self.folder / name if self.stored is None else self.stored.local(name, self.folder)

    @property
    def manifest(self) -> Path:
        """Manifest: frame, bounds, sources, options and counts. It is written last."""
        return self.folder / "scene.json"

    @property
    def features(self) -> Path:
        """GeoPackage of the features."""
        return self._local("features.gpkg")

    @property
    def road_graph(self) -> Path:
        """GraphML of the drivable road graph; missing in a scene without drivable roads."""
        return self._local("roads.graphml")

    @property
    def problems(self) -> Path:
        """Table of repaired and dropped features."""
        return self._local("problems.csv")

    @property
    def shapes(self) -> Path:
        """Meshes that the tiles' instances copy."""
        return self._local("shapes.npz")

    @property
    def tiles(self) -> Path:
        """Folder of the tiles."""
        return self.folder / _TILES

    @property
    def tile_reports(self) -> Path:
        """Reports of the tiles, with digests of their inputs."""
        return self.folder / "tiles.json"

    @property
    def tile_journal(self) -> Path:
        """The same while the build runs, one line per finished tile."""
        return self.folder / "tiles.jsonl"

    def tile(self, i: int, j: int) -> Path:
        """Tile (i, j)."""
        return self._local(f"{_TILES}/{i}_{j}.npz")

    def owns(self, path: Path) -> bool:
        """Whether a path in the directory, or in its folder of tiles, is named as a file of a scene."""
        if path.parent == self.tiles:
            return re.fullmatch(r"-?\d+_-?\d+\.npz", path.name) is not None
        # SQLite has files beside a GeoPackage that another program opens.
        return path.name in _NAMES or path.name.startswith(f"{self.features.name}-")


_NAMES = frozenset(
    getattr(SceneFiles(Path()), name).name
    for name, value in vars(SceneFiles).items()
    if isinstance(value, property)
)
"""Names of the files and folders in a scene directory."""


@dataclass(frozen=True)
class Scene(Previewed):
    """A scene directory, opened. Its files are read on request; no other module needs their names.

    path     : the directory, or the cache of one in object storage
    manifest : the document that the build wrote
    frame    : the scene frame
    stored   : the directory in object storage, if it is there
    modelled : tiles are read with their facades as geometry
    leveled  : guessed roofs are read as flat, in tiles and tables
    """

    path: Path
    manifest: dict[str, Any]
    frame: Frame
    stored: StoredFolder | None = None
    modelled: bool = False
    leveled: bool = False

    @property
    def files(self) -> SceneFiles:
        """Paths of the files."""
        return SceneFiles(self.path, self.stored)

    def __repr__(self) -> str:
        """What the scene is and holds, in a few lines."""
        counts, bounds = self.manifest.get("counts", {}), self.manifest.get("bounds", (0, 0, 0, 0))
        name = f" ({self.manifest['name']})" if self.manifest.get("name") else ""
        parts = [f"{bounds[2] - bounds[0]:,.0f} m x {bounds[3] - bounds[1]:,.0f} m"]
        parts += [f"{len(self.manifest.get('tiles', ())):,} tiles", f"{counts.get('solids', 0):,} buildings"]
        parts += [f"{counts.get('road_km', 0):,.1f} km of roads"]
        lines = [f"Scene {self.location}{name}: {', '.join(parts)}"]
        if isinstance(self.frame, Frame):
            lines.append(f"  {self.frame.name}, heights {self.frame.vertical}")
        return "\n".join([*lines, f"  {self.manifest.get('attribution', '')}"]).rstrip()

    def __fspath__(self) -> str:
        """The directory, so that a scene can be given for its path."""
        return str(self.path)

    @property
    def location(self) -> str:
        """Path or URL of the scene, as it was opened, without secrets."""
        return str(self.path) if self.stored is None else self.stored.name

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """(xmin, ymin, xmax, ymax) of the ground in scene metres."""
        xmin, ymin, xmax, ymax = self.manifest["bounds"]
        return float(xmin), float(ymin), float(xmax), float(ymax)

    @property
    def tile_size(self) -> float:
        """Side of the smallest tiles in metres."""
        return float(self.manifest["tile_size"])

    @property
    def has_tiles(self) -> bool:
        """Whether the scene was built with its tiles."""
        return not USES[self.use].lacks("tiles")

    @property
    def use(self) -> str:
        """Purpose of the scene, one of `geoscene.uses.USES`."""
        return str(self.manifest.get("options", {}).get("use", "all"))

    def require(self, *parts: str) -> None:
        """Raises SceneFormatError if the scene was built for a use that `lacks` one of the parts."""
        for part in parts:
            if USES[self.use].lacks(part):
                raise SceneFormatError(
                    f"{self.path}: built for {self.use}, has no {_PARTS[part]}; build it again without --for"
                )

    @functools.cached_property
    def tile_indices(self) -> list[tuple[int, int]]:
        """(i, j) of all tiles; tile (i, j) of span n covers [i, i + n) x [j, j + n) times `tile_size`.

        Raises SceneFormatError if the scene was built without tiles.
        """
        self.require("tiles")
        return [(int(i), int(j)) for i, j, _ in self.manifest["tiles"]]

    @functools.cached_property
    def tile_spans(self) -> Ints:
        """Span (t,) of each tile: 1, or a power of two where nothing lies on the ground."""
        return np.array([n for _, _, n in self.manifest["tiles"]], np.int64)

    @functools.cached_property
    def tile_boxes(self) -> Float:
        """(xmin, ymin, xmax, ymax) of each tile (t, 4) in scene metres, not cut at the `bounds`."""
        low, span = np.array(self.tile_indices, np.int64).reshape(-1, 2), self.tile_spans[:, None]
        return np.hstack([low, low + span]) * self.tile_size

    def tiles_at(self, xy: Float) -> Ints:
        """Row (k,) in `tile_indices` of the tile of each point (k, 2); -1 outside of all tiles."""
        boxes, row = self.tile_boxes, np.full(len(xy), -1, np.int64)
        point, tile = shapely.STRtree(shapely.box(*boxes.T)).query(shapely.points(xy))
        on = ((xy[point] >= boxes[tile, :2]) & (xy[point] < boxes[tile, 2:])).all(axis=1)
        row[point[on]] = tile[on]
        return row

    @property
    def layers(self) -> dict[str, tuple[int, int]]:
        """Layer name to its range [start, stop) of feature numbers, in the order of the numbers."""
        return {name: (int(a), int(b)) for name, (a, b) in self.manifest["layers"].items()}

    def table_length(self, layer: str) -> int:
        """Number of rows of a layer's table, which may be limited to a build's route."""
        return int(self.manifest["rows"].get(layer, 0))

    @functools.cached_property
    def area(self) -> Any | None:
        """Polygon, scene metres, for which the tiles and tables were built; None without such a limit.

        The road graph of a scene with an area is that of the whole map.
        """
        text = self.manifest.get("area")
        return None if text is None else shapely.from_wkt(text)

    @functools.cached_property
    def route(self) -> Any | None:
        """Line, scene metres, along which the scene was built; None if it was not."""
        text = self.manifest.get("route")
        return None if text is None else shapely.from_wkt(text)

    @property
    def origin(self) -> dict[str, Any]:
        """The map that the scene was built of, a digest of its contents, and the options of the build."""
        maps = [{name: s[name] for name in ("kind", "from")} for s in self.manifest["sources"]]
        return {
            "digest": self.manifest["map"],
            "sources": maps,
            "bounds": self.manifest["geographic_bounds"],
            "options": self.manifest["options"],
        }

    @property
    def cut_nodes(self) -> Ints:
        """Ids (n,) of the road graph's nodes from which roads lead that a build along a route left out."""
        return np.array(self.manifest.get("cut", {"nodes": []})["nodes"], np.int64)

    @property
    def left_hand(self) -> bool:
        """Whether traffic keeps left."""
        return bool(self.manifest["roads"]["driving_side"] == "left")

    @functools.cached_property
    def forests(self) -> Forests | None:
        """Parameters from which forest trees are generated; None for a scene without forests."""
        document = self.manifest.get("forests")
        return None if document is None else Forests.from_json(document)

    def tile(self, i: int, j: int, *, forests: bool = True) -> Tile:
        """Tile (i, j) with the trees of its forests, or without them for a reader of the mesh alone.

        Raises SceneFormatError if it is missing, damaged or another one than the build wrote.
        """
        path = self.files.tile(i, j)
        stated = self._tile_digests
        tile = read_tile(path, stated=None if stated is None else stated.get(path.name, ""))
        if self.leveled and self.table_length("buildings"):
            from geoscene.scene.level_roofs import level_tile  # noqa: PLC0415  (builds solids)

            tile = level_tile(tile, self._guessed_roofs)
        if self.modelled and tile.relief is not None:
            from geoscene.buildings.facades.solids import relief_mesh  # noqa: PLC0415  (0.1 s)

            tile = replace(tile, mesh=relief_mesh(tile.mesh, tile.relief), relief=None, full_parts=None)
        if self.forests is None or not forests:
            return tile
        box = np.array([i, j, i + 1, j + 1]) * self.tile_size  # no forest is on a larger one
        low, high = np.maximum(box[:2], self.bounds[:2]), np.minimum(box[2:], self.bounds[2:])
        return with_forests(tile, self.forests, box=(*low, *high))

    @functools.cached_property
    def _tile_digests(self) -> dict[str, str] | None:
        """Digest of each tile by its file's name; None for a manifest that states no reports of tiles."""
        path = self.files.tile_reports
        if path.name not in self.manifest.get("files", {}):
            return None
        with reading(path, SceneFormatError, remedy=BUILD_AGAIN, known=SceneFormatError):
            return _tile_digests(self._verified(path))

    def _verified(self, path: Path) -> Path:
        """A file that has the digest which the manifest states; raises SceneFormatError for another one."""
        stated = self.manifest.get("files", {}).get(path.name)
        if path not in self._verified_files and stated is not None:
            found = content_digest(path)
            if found != stated and found != self._digest_since(path.name):
                fault = DIFFERS if path.exists() else f"is missing; {BUILD_AGAIN}"
                raise SceneFormatError(f"{path}: {fault}")
            self._verified_files.add(path)
        return path

    def _digest_since(self, name: str) -> str | None:
        """Digest of a file that another drive has replaced since by building more tiles of the scene."""
        with suppress(OSError, ValueError, LookupError, AttributeError):
            manifest = json.loads(self.files.manifest.read_text("utf-8-sig"))
            whole = manifest["digest"] == manifest_digest(manifest)
            if whole and all(manifest[key] == self.manifest[key] for key in ("map", "options")):
                return str(manifest["files"][name])
        return None

    @functools.cached_property
    def _verified_files(self) -> set[Path]:
        return set()

    @property
    def relief(self) -> str:
        """Relief of its surfaces, of `geoscene.uses.RELIEFS`."""
        return str(self.manifest.get("options", {}).get("relief", "off"))

    def with_relief_mesh(self) -> Scene:
        """The scene whose tiles have openings of walls as geometry; solids stay closed.

        Raises InputError if the scene was built without relief.
        """
        if self.relief == "off":
            raise InputError(f"{self.location}: has no relief; build it with `relief` plain or full")
        return replace(self, modelled=True)

    def with_level_roofs(self) -> Scene:
        """The scene with flat roofs in place of guessed ones; the walls below them have no openings."""
        return replace(self, leveled=True)

    def count_guessed_roofs(self) -> int:
        """Number of buildings with guessed roofs other than flat ones."""
        return len(self._guessed_roofs.feature) if self.table_length("buildings") else 0

    @functools.cached_property
    def _guessed_roofs(self) -> GuessedRoofs:
        from geoscene.scene.level_roofs import find_guessed  # noqa: PLC0415

        return find_guessed(replace(self, leveled=False).features("buildings"))

    def tiles(self, *, forests: bool = True) -> Iterator[Tile]:
        """All tiles, one at a time."""
        for i, j in self.tile_indices:
            yield self.tile(i, j, forests=forests)

    def shapes(self) -> dict[str, Mesh]:
        """The meshes that the tiles' instances copy, by name."""
        return dict(self._shapes)

    @functools.cached_property
    def _shapes(self) -> dict[str, Mesh]:  # several worlds of a drive ask for them
        return read_shapes(self._verified(self.files.shapes))

    def features(
        self,
        layer: str,
        *,
        geometry: Literal["scene", "projected", "none"] = "scene",
        rows: range | None = None,
    ) -> Layer:
        """The features of a layer with their columns; see `geoscene.scene.geopackage.read_layer`.

        Raises SceneFormatError if the scene has no such feature.
        """
        path = self._verified(self.files.features)
        table = read_layer(path, layer, frame=self.frame, geometry=geometry, rows=rows)
        if self.leveled and layer == "buildings":
            from geoscene.scene.level_roofs import level_columns  # noqa: PLC0415

            table = replace(table, columns=level_columns(table.columns))
        return table

    def schema(self, layer: str) -> Schema:
        """The geometry type and the columns of a layer; raises SceneFormatError as `features` does."""
        return read_schema(self._verified(self.files.features), layer)

    def road_graph(self) -> RoadGraph:
        """The drivable road graph; raises SceneFormatError if the scene has no drivable roads."""
        path = self._verified(self.files.road_graph)
        if not path.exists():
            raise SceneFormatError(f"{self.path}: this scene has no drivable roads")
        return read_graphml(path, self.frame)


SceneLike = str | os.PathLike[str]
"""Directory or URL of a scene, or an opened one."""


def open_scene(path: SceneLike) -> Scene:
    """Open a scene directory, of this machine or at a URL (``s3://``, ``gs://``, ``file://``).

    Opened scenes are returned as they are.

    Files of a scene at a URL are fetched when they are read, into a folder of the user's cache.

    Raises SceneFormatError if it is not a scene, is unfinished, or has another schema version, and
    StorageError if the storage cannot be reached or has no scene there.
    """
    if isinstance(path, Scene):
        return path
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"`scene` {brief(path)}: give the directory or URL of a scene, or an opened one")
    if url := url_of(path):
        return _open_stored(url)
    folder = Path(path)
    manifest_file = SceneFiles(folder).manifest
    if not folder.is_dir():
        raise SceneFormatError(f"{folder}: no such scene directory; geoscene build makes one")
    if not manifest_file.exists():
        raise SceneFormatError(
            f"{folder}: no {manifest_file.name} in it: not a scene, or its build did not finish"
        )
    with reading(manifest_file, SceneFormatError, remedy=BUILD_AGAIN):
        manifest = json.loads(manifest_file.read_text("utf-8-sig"))
        schema = manifest["schema"]
        if schema != SCHEMA:
            fault = schema_fault(schema, reads=SCHEMA, remedy="build the scene again")
            raise SceneFormatError(f"{folder}: {fault}")
        if manifest.get("digest") != manifest_digest(manifest):
            raise SceneFormatError(f"{manifest_file}: {DIFFERS}")
        scene = Scene(folder, manifest, Frame.from_json(manifest["frame"]))
        _ = scene.frame.crs, scene.bounds, scene.layers, scene.forests
        _ = scene.tile_boxes if scene.has_tiles else None
    return scene


def _open_stored(url: str) -> Scene:
    """Open the scene at a URL; its cache is of these contents of ``scene.json``."""
    stored = StoredFolder(url)
    data = stored.read(SceneFiles(Path()).manifest.name)
    folder = cache_folder() / "stored" / digest(url.encode() + data)
    write_atomically(SceneFiles(folder).manifest, data)
    scene, reports = open_scene(folder), SceneFiles(folder).tile_reports
    if not reports.exists():
        stored.fetch(reports.name, reports)
    with reading(reports, SceneFormatError, remedy=BUILD_AGAIN):
        tiles = {f"{_TILES}/{name}": value for name, value in _tile_digests(reports).items()}
    return replace(scene, stored=StoredFolder(url, {**scene.manifest.get("files", {}), **tiles}))


def manifest_digest(manifest: Mapping[str, Any]) -> str:
    """Digest of a manifest but for its own entry of it."""
    rest = {key: value for key, value in manifest.items() if key != "digest"}
    return value_digest(rest)


def changed_files(scene: Scene) -> list[Path]:
    """Files of a scene that are missing or differ from what the build wrote."""
    stated = {scene.path / name: value for name, value in scene.manifest.get("files", {}).items()}
    with suppress(OSError, ValueError, LookupError, TypeError):
        reports = _tile_digests(scene.files.tile_reports)
        stated |= {scene.files.tiles / name: value for name, value in reports.items()}
    here = {path: value for path, value in stated.items() if scene.stored is None or path.exists()}
    return [path for path, value in here.items() if content_digest(path) != value]


def content_digest(path: Path) -> str:
    """Digest of a scene's file as the manifest states it; empty if the file cannot be read."""
    return (database_digest if path.suffix == ".gpkg" else file_digest)(path)


def _tile_digests(reports: Path) -> dict[str, str]:
    """Digests of tiles by their files' names, from the file of their reports."""
    rows = json.loads(reports.read_text("utf-8-sig"))["tiles"]
    return {SceneFiles(Path()).tile(int(r["i"]), int(r["j"])).name: str(r["digest"]) for r in rows}


@contextmanager
def using(scene: Scene, *, known: type[Exception] = GeosceneError) -> Iterator[Scene]:
    """Yield a scene; report an unexpected error of the block as a damaged file, if one is damaged.

    known : base class of errors that name their cause; they pass

    Raises SceneFormatError that names the file.
    """
    try:
        yield scene
    except (GeosceneError, known, OSError, MemoryError):
        raise
    except Exception as error:
        if changed := changed_files(scene):
            cause = reason_of(error)
            raise SceneFormatError(f"{changed[0]}: {DIFFERS} ({cause})") from error
        raise

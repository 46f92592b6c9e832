"""A scene on disk: tiles, features, road graph and manifest."""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.errors import SceneFormatError
from geoscene.frames import Frame
from geoscene.mesh import Mesh

SCHEMA = 1
"""Version of the scene directory; a reader refuses others."""

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Instances:
    """Copies of shapes, such as trees.

    shape     : (k,) int32, index into the scene's shapes
    transform : (k, 3, 4) float64, shape to tile: rotation and scale, then shift
    feature   : (k,) int32
    """

    shape: NDArray[np.int32]
    transform: Float
    feature: NDArray[np.int32]

    def __len__(self) -> int:
        """Number of copies."""
        return len(self.shape)

    @classmethod
    def empty(cls) -> Instances:
        """No copies."""
        return cls(np.empty(0, np.int32), np.empty((0, 3, 4)), np.empty(0, np.int32))


@dataclass(frozen=True, slots=True)
class Tile:
    """A square of the scene. A building lies wholly in the tile of its representative point; ground is cut.

    origin    : (3,) float64, whole metres: tile coordinates + origin = scene coordinates
    mesh      : in tile coordinates
    instances : in tile coordinates
    """

    origin: Float
    mesh: Mesh
    instances: Instances = field(default_factory=Instances.empty)


def write_atomically(path: Path, data: bytes) -> None:
    """Write ``data`` beside ``path`` and move it there whole."""
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(data)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def pack(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """A compressed .npz whose bytes depend on the arrays alone (no time stamps)."""
    out = BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            buffer = BytesIO()
            np.lib.format.write_array(buffer, np.ascontiguousarray(array), allow_pickle=False)
            archive.writestr(entry, buffer.getvalue(), compresslevel=1)
    return out.getvalue()


def _mesh_arrays(mesh: Mesh) -> dict[str, NDArray[Any]]:
    return {f.name: getattr(mesh, f.name) for f in fields(Mesh)}


def write_tile(path: Path, tile: Tile) -> None:
    """Write one tile as .npz."""
    instances = {f"instance_{f.name}": getattr(tile.instances, f.name) for f in fields(Instances)}
    write_atomically(path, pack({"origin": tile.origin, **_mesh_arrays(tile.mesh), **instances}))


def read_tile(path: Path) -> Tile:
    """The tile that `write_tile` wrote.

    Raises SceneFormatError if the file is missing or damaged.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            mesh = Mesh(**{f.name: archive[f.name] for f in fields(Mesh)})
            instances = Instances(**{f.name: archive[f"instance_{f.name}"] for f in fields(Instances)})
            return Tile(archive["origin"], mesh, instances)
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise SceneFormatError(f"{path}: not a readable tile ({error}); build the scene again") from error


def write_shapes(path: Path, shapes: Mapping[str, Mesh]) -> None:
    """Write the shapes that instances copy, as one .npz."""
    arrays: dict[str, NDArray[Any]] = {"names": np.array(list(shapes), dtype=np.str_)}
    for name, mesh in shapes.items():
        arrays |= {f"{name}/{key}": value for key, value in _mesh_arrays(mesh).items()}
    write_atomically(path, pack(arrays))


def read_shapes(path: Path) -> dict[str, Mesh]:
    """The shapes that `write_shapes` wrote, in order; none if there is no such file."""
    if not path.exists():
        return {}
    try:
        return _shapes(path)
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise SceneFormatError(f"{path}: damaged ({error}); build the scene again") from error


def _shapes(path: Path) -> dict[str, Mesh]:
    with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
        return {
            str(name): Mesh(**{f.name: archive[f"{name}/{f.name}"] for f in fields(Mesh)})
            for name in archive["names"]
        }


@dataclass(frozen=True)
class Scene:
    """A scene directory, opened. Tiles are read when asked for.

    path     : the directory
    manifest : what ``scene.json`` holds
    frame    : the scene frame
    """

    path: Path
    manifest: dict[str, Any]
    frame: Frame

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """(xmin, ymin, xmax, ymax) of the ground in scene metres."""
        xmin, ymin, xmax, ymax = self.manifest["bounds"]
        return float(xmin), float(ymin), float(xmax), float(ymax)

    @property
    def tile_size(self) -> float:
        """Side of a tile in metres."""
        return float(self.manifest["tile_size"])

    @property
    def tile_indices(self) -> list[tuple[int, int]]:
        """(i, j) of the tiles there are; tile (i, j) covers [i, i + 1) x [j, j + 1) times `tile_size`."""
        return [(int(i), int(j)) for i, j in self.manifest["tiles"]]

    @property
    def layers(self) -> dict[str, tuple[int, int]]:
        """Layer name to its range [start, stop) of feature numbers."""
        return {name: (int(a), int(b)) for name, (a, b) in self.manifest["layers"].items()}

    @property
    def left_hand(self) -> bool:
        """Traffic keeps left."""
        return bool(self.manifest["roads"]["driving_side"] == "left")

    def tile(self, i: int, j: int) -> Tile:
        """Tile (i, j), read from disk."""
        return read_tile(self.path / "tiles" / f"{i}_{j}.npz")

    def tiles(self) -> Iterator[Tile]:
        """All tiles, one at a time."""
        for i, j in self.tile_indices:
            yield self.tile(i, j)

    def shapes(self) -> dict[str, Mesh]:
        """The shapes that tiles' instances copy."""
        return read_shapes(self.path / "shapes.npz")


def open_scene(path: str | Path) -> Scene:
    """Open a scene directory.

    Raises SceneFormatError if it is none, is unfinished, or has another schema version.
    """
    folder = Path(path)
    manifest_path = folder / "scene.json"
    if not folder.is_dir():
        raise SceneFormatError(
            f"{folder}: no such scene directory; make one with: geoscene build --demo -o {folder}"
        )
    if not manifest_path.exists():
        raise SceneFormatError(f"{folder}: no scene.json in it: not a scene, or its build did not finish")
    try:
        manifest = json.loads(manifest_path.read_text("utf-8"))
        schema = manifest["schema"]
    except (ValueError, KeyError, TypeError) as error:
        raise SceneFormatError(f"{manifest_path}: damaged ({error}); build the scene again") from error
    if schema != SCHEMA:
        raise SceneFormatError(
            f"{folder}: schema version {schema}, this program reads {SCHEMA}; build the scene again"
        )
    return Scene(folder, manifest, Frame.from_json(manifest["frame"]))

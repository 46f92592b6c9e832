"""A scene on disk: tiles, features, road graph and manifest."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from geoscene.errors import SceneFormatError
from geoscene.frames import Frame
from geoscene.mesh import Mesh
from geoscene.scene.tile_files import Tile, read_shapes, read_tile

SCHEMA = 1
"""Version of the scene directory; a reader refuses others."""


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

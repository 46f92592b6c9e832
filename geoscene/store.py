"""Writing a scene directory: whole, or not at all."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class, materials
from geoscene.errors import SceneFormatError
from geoscene.frames import Frame
from geoscene.geopackage import Layer, write_geopackage
from geoscene.mesh import Mesh
from geoscene.report import Problem
from geoscene.scene import SCHEMA, Instances, Tile, write_atomically, write_shapes, write_tile

Float = NDArray[np.float64]


class SceneWriter:
    """A scene directory in the making; it appears under its name when `finish` has been called.

    Raises SceneFormatError if the name is taken by something that may not be replaced.
    """

    def __init__(self, path: Path, *, tile_size: float, overwrite: bool = False) -> None:
        if path.exists():
            ours = (path / "scene.json").exists()
            if not path.is_dir() or (any(path.iterdir()) and not ours):
                raise SceneFormatError(f"{path}: exists and is not a scene; give another directory")
            if ours and not overwrite:
                raise SceneFormatError(f"{path}: holds a scene; add --overwrite to replace it")
        self.path = path
        self.tile_size = tile_size
        self._part = path.with_name(f"{path.name}.part")
        shutil.rmtree(self._part, ignore_errors=True)
        (self._part / "tiles").mkdir(parents=True)
        self._tiles: list[tuple[int, int]] = []
        self.faces = 0

    def tile(self, i: int, j: int, mesh: Mesh, instances: Instances | None = None) -> None:
        """Write tile (i, j) of a mesh and instances in scene metres."""
        copies = Instances.empty() if instances is None else instances
        low = mesh.vertices[:, 2].min(initial=0.0) if len(mesh.vertices) else 0.0
        origin = np.array([i * self.tile_size, j * self.tile_size, np.floor(low)])
        transform = copies.transform.copy()
        transform[:, :, 3] -= origin
        local = Tile(origin, mesh.shifted(-origin), Instances(copies.shape, transform, copies.feature))
        write_tile(self._part / "tiles" / f"{i}_{j}.npz", local)
        self._tiles.append((i, j))
        self.faces += len(mesh)

    def finish(
        self,
        *,
        frame: Frame,
        bounds: tuple[float, float, float, float],
        layers: Sequence[Layer],
        shapes: Mapping[str, Mesh],
        problems: Iterable[Problem],
        manifest: Mapping[str, Any],
    ) -> None:
        """Write everything but the tiles and move the directory to its name.

        bounds   : (xmin, ymin, xmax, ymax) of the ground, scene metres
        layers   : features; the number of a feature is its row, counted through all layers in order
        manifest : what else ``scene.json`` says
        """
        starts = np.cumsum([0, *(len(layer) for layer in layers)]).tolist()
        numbered = [
            Layer(layer.name, layer.geometry, {"feature": np.arange(a, b, dtype=np.int32), **layer.columns})
            for layer, a, b in zip(layers, starts[:-1], starts[1:], strict=True)
        ]
        write_geopackage(self._part / "features.gpkg", numbered, frame)
        if shapes:
            write_shapes(self._part / "shapes.npz", shapes)
        write_atomically(self._part / "problems.csv", _problems_csv(problems))
        document = {
            "schema": SCHEMA,
            **manifest,
            "frame": frame.to_json(),
            "bounds": list(bounds),
            "tile_size": self.tile_size,
            "tiles": sorted(self._tiles),
            "layers": {
                layer.name: [a, b] for layer, a, b in zip(layers, starts[:-1], starts[1:], strict=True)
            },
            "classes": {c.name.lower(): int(c) for c in Class},
            "materials": {name: m.code for name, m in materials().items()},
        }
        text = json.dumps(document, indent=1, ensure_ascii=False) + "\n"
        write_atomically(self._part / "scene.json", text.encode("utf-8"))
        if self.path.exists():
            shutil.rmtree(self.path)
        self._part.rename(self.path)

    @property
    def folder(self) -> Path:
        """Where files go until `finish`."""
        return self._part

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        shutil.rmtree(self._part, ignore_errors=True)


def _problems_csv(problems: Iterable[Problem]) -> bytes:
    out = io.StringIO()
    writer = csv.DictWriter(out, ["osm_id", "kind", "action", "reason", "detail"], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(p) for p in sorted(problems))
    return out.getvalue().encode("utf-8")


def split(mesh: Mesh, tile: NDArray[np.integer]) -> dict[tuple[int, int], Mesh]:
    """The mesh by tile: ``tile`` (m, 2) names each face's."""
    if not len(mesh):
        return {}
    keys, owner = np.unique(tile, axis=0, return_inverse=True)
    owner = owner.ravel()
    order = np.argsort(owner, kind="stable")
    cuts = np.searchsorted(owner[order], np.arange(len(keys) + 1))
    return {
        (int(i), int(j)): mesh.take(order[a:b])
        for (i, j), a, b in zip(keys, cuts[:-1], cuts[1:], strict=True)
    }

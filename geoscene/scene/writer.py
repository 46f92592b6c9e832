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

from geoscene.classes import Class, materials
from geoscene.errors import SceneFormatError
from geoscene.files import write_atomically
from geoscene.frames import Frame
from geoscene.mesh import Mesh
from geoscene.report import Problem
from geoscene.scene.geopackage import Layer, write_geopackage
from geoscene.scene.layout import SCHEMA
from geoscene.scene.tile_files import write_shapes


class SceneWriter:
    """A scene directory in the making; it appears under its name when `finish` has been called.

    Until then all lies in a folder beside it, which goes away when the work fails and stays when it is killed
    or interrupted, so that the next build can go on from there.

    Raises SceneFormatError if the name is taken by something that may not be replaced.
    """

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        self.former: Path | None = None
        if path.exists():
            ours = (path / "scene.json").exists()
            if not path.is_dir() or (any(path.iterdir()) and not ours):
                raise SceneFormatError(f"{path}: exists and is not a scene; give another directory")
            if ours and not overwrite:
                raise SceneFormatError(f"{path}: holds a scene; add --overwrite to replace it")
            self.former = path if ours else None
        self.path = path
        self.folder = path.with_name(f"{path.name}.part")
        self.folder.mkdir(parents=True, exist_ok=True)
        for left in self.folder.iterdir():
            if left.name not in ("tiles", "tiles.jsonl"):  # a killed build's tiles serve, nothing else
                left.unlink()

    def finish(
        self,
        *,
        frame: Frame,
        layers: Sequence[Layer],
        shapes: Mapping[str, Mesh],
        problems: Iterable[Problem],
        tiles: Mapping[str, Any],
        manifest: Mapping[str, Any],
    ) -> None:
        """Write everything but the tiles and move the directory to its name.

        layers   : features; the number of a feature is its row, counted through all layers in order
        tiles    : what ``tiles.json`` says
        manifest : what ``scene.json`` says besides frame, layers and codes
        """
        starts = np.cumsum([0, *(len(layer) for layer in layers)]).tolist()
        numbered = [
            Layer(layer.name, layer.geometry, {"feature": np.arange(a, b, dtype=np.int32), **layer.columns})
            for layer, a, b in zip(layers, starts[:-1], starts[1:], strict=True)
        ]
        write_geopackage(self.folder / "features.gpkg", numbered, frame=frame)
        write_shapes(self.folder / "shapes.npz", shapes)
        write_atomically(self.folder / "problems.csv", _problems_csv(problems))
        _write_json(self.folder / "tiles.json", tiles)
        (self.folder / "tiles.jsonl").unlink(missing_ok=True)
        ranges = {layer.name: [a, b] for layer, a, b in zip(layers, starts[:-1], starts[1:], strict=True)}
        document = {
            "schema": SCHEMA,
            **manifest,
            "frame": frame.to_json(),
            "layers": ranges,
            "classes": {c.name.lower(): int(c) for c in Class},
            "materials": {name: m.code for name, m in materials().items()},
        }
        _write_json(self.folder / "scene.json", document)
        if self.path.exists():
            shutil.rmtree(self.path)
        self.folder.rename(self.path)

    def __enter__(self) -> Self:
        return self

    def __exit__(  # noqa: PLR0917 - the protocol of context managers
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None or issubclass(kind, Exception):
            shutil.rmtree(self.folder, ignore_errors=True)


def _write_json(path: Path, document: Mapping[str, Any]) -> None:
    write_atomically(path, (json.dumps(document, indent=1, ensure_ascii=False) + "\n").encode("utf-8"))


def _problems_csv(problems: Iterable[Problem]) -> bytes:
    out = io.StringIO()
    writer = csv.DictWriter(out, ["osm_id", "kind", "action", "reason", "detail"], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(p) for p in sorted(problems))
    return out.getvalue().encode("utf-8")

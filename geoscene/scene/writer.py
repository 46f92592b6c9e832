"""Atomic writing of scene directories."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from geoscene.classes import Class, materials
from geoscene.errors import SceneFormatError
from geoscene.files import write_columns, write_json
from geoscene.frames import Frame
from geoscene.mesh import Mesh
from geoscene.report import Problem
from geoscene.roadgraph import RoadGraph, write_graphml
from geoscene.scene.geopackage import Layer, write_geopackage
from geoscene.scene.layout import SCHEMA, SceneFiles
from geoscene.scene.tile_files import write_shapes


class SceneWriter:
    """Writer of a scene directory, which appears under its name when `finish` is called.

    Until then its files are in a folder beside it, which is removed if the build fails, and kept if it is
    killed or interrupted, so that the next build can resume.

    Raises SceneFormatError if the path exists and may not be replaced.
    """

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        self.former: Path | None = None
        if path.exists():
            ours = SceneFiles(path).manifest.exists()
            if not path.is_dir() or (any(path.iterdir()) and not ours):
                raise SceneFormatError(f"{path}: exists and is not a scene; give another directory")
            if ours and not overwrite:
                raise SceneFormatError(f"{path}: holds a scene; set `overwrite` to replace it")
            self.former = path if ours else None
        self.path = path
        self.folder = path.with_name(f"{path.name}.part")
        self.folder.mkdir(parents=True, exist_ok=True)
        self.files = SceneFiles(self.folder)
        for left in self.folder.iterdir():
            if left not in (self.files.tiles, self.files.tile_journal):  # a build resumes from tiles only
                left.unlink()

    def finish(
        self,
        *,
        frame: Frame,
        layers: Sequence[Layer],
        graph: RoadGraph,
        shapes: Mapping[str, Mesh],
        problems: Iterable[Problem],
        tiles: Mapping[str, Any],
        manifest: Mapping[str, Any],
    ) -> None:
        """Write everything but the tiles and move the directory to its name.

        layers   : features; the number of a feature is its row, counted through all layers in order
        graph    : the drivable road graph; not written if it has no edges
        tiles    : the document of tile reports
        manifest : the manifest without frame, layers and codes
        """
        starts = np.cumsum([0, *(len(layer) for layer in layers)]).tolist()
        numbered = [
            Layer(layer.name, layer.geometry, {"feature": np.arange(a, b, dtype=np.int32), **layer.columns})
            for layer, a, b in zip(layers, starts[:-1], starts[1:], strict=True)
        ]
        write_geopackage(self.files.features, numbered, frame=frame)
        if len(graph):
            write_graphml(graph, frame, path=self.files.road_graph)
        write_shapes(self.files.shapes, shapes)
        rows = sorted(problems)
        columns = {f.name: [getattr(row, f.name) for row in rows] for f in fields(Problem)}
        write_columns(self.files.problems, columns)
        write_json(self.files.tile_reports, tiles, indent=1)
        self.files.tile_journal.unlink(missing_ok=True)
        ranges = {layer.name: [a, b] for layer, a, b in zip(layers, starts[:-1], starts[1:], strict=True)}
        document = {
            "schema": SCHEMA,
            **manifest,
            "frame": frame.to_json(),
            "layers": ranges,
            "classes": {c.name.lower(): int(c) for c in Class},
            "materials": {name: m.code for name, m in materials().items()},
        }
        write_json(self.files.manifest, document, indent=1)
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

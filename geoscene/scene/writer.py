"""Atomic writing of scene directories."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import fields
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import shapely

from geoscene.classes import Class, materials
from geoscene.errors import SceneFormatError, WorkersLostError
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import Mesh
from geoscene.roadgraph import RoadGraph, write_graphml
from geoscene.scene.geopackage import Layer, write_geopackage
from geoscene.scene.layout import SCHEMA, SceneFiles, content_digest, manifest_digest
from geoscene.scene.tile_files import write_shapes
from geoscene.support.columns import write_columns
from geoscene.support.files import exclusive, write_json
from geoscene.support.problems import Problem
from geoscene.support.urls import redacted
from geoscene.typing import Ints
from geoscene.uses import USES, Needed, Use

log = logging.getLogger(__name__)

_RESUMABLE = (OSError, MemoryError, WorkersLostError)
"""Errors after which the same command may succeed, with more space, memory or patience."""


def check_target(path: Path, *, overwrite: bool = False) -> bool:
    """Whether a directory holds a scene, which the writer of another may replace.

    Raises SceneFormatError if the directory exists and may not be replaced.
    """
    path = path.resolve()
    if path.is_mount() or path in (Path.cwd(), *Path.cwd().parents):
        kind = "the root of a disk" if path.is_mount() else "the current directory or holds it"
        raise SceneFormatError(f"{path}: is {kind} and cannot be replaced; give a directory in it")
    if not path.exists():
        return False
    ours = path.is_dir() and any(SceneFiles(path).owns(entry) for entry in path.iterdir())
    if not path.is_dir() or (any(path.iterdir()) and not ours):
        raise SceneFormatError(f"{path}: exists and is not a scene; give another directory")
    if ours and not overwrite:
        raise SceneFormatError(f"{path}: holds a scene; set `overwrite` to replace it")
    return ours


class SceneWriter:
    """Writer of a scene directory, which appears under its name when `finish` is called.

    Until then its files are in a folder beside it, ``<name>.part``. It is kept if the build is killed or
    interrupted, or ends for want of space or memory, so that the next build can resume; else it is removed.
    Files of others in a scene that is replaced are kept. A second writer of the same directory is refused.

    Raises SceneFormatError if the path exists and may not be replaced.
    """

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        check_target(path, overwrite=overwrite)
        self.path = path.resolve()  # the directory that a link leads to
        self.folder = self.path.with_name(f"{self.path.name}.part")
        self.files = SceneFiles(self.folder)
        self.former: Path | None = None
        self._replaced = self.path.with_name(f"{self.path.name}.old.part")
        self._overwrite = overwrite
        self._lock = ExitStack()

    def __enter__(self) -> Self:
        self._lock.enter_context(exclusive(self.path))
        self._complete_replacement()
        self.former = self.path if check_target(self.path, overwrite=self._overwrite) else None
        self.folder.mkdir(exist_ok=True)
        for left in self.folder.iterdir():
            if left not in (self.files.tiles, self.files.tile_journal):  # a build resumes from tiles only
                left.unlink()
        return self

    def _complete_replacement(self) -> None:
        """Complete the replacement of a scene in which an earlier build was killed."""
        if self._replaced.exists() and not self.path.exists():
            self._replaced.rename(self.path)
        elif self._replaced.exists():
            self._keep_foreign()

    def _keep_foreign(self) -> None:
        """Move the files of others from the replaced scene to the new one, and delete the rest."""
        old = SceneFiles(self._replaced)
        foreign = [entry for entry in self._replaced.iterdir() if not old.owns(entry)]
        if old.tiles.is_dir():
            foreign += [entry for entry in old.tiles.iterdir() if not old.owns(entry)]
        for entry in sorted(foreign):
            name = entry.relative_to(self._replaced)
            target = self.path / name
            target.parent.mkdir(exist_ok=True)
            if not target.exists():
                entry.rename(target)
                log.warning("%s: kept, though not of the scene", target)
        shutil.rmtree(self._replaced)

    def finish(
        self,
        *,
        frame: Frame,
        layers: Sequence[Layer],
        ranges: Mapping[str, tuple[int, int]] | None = None,
        graph: RoadGraph,
        kept: Mapping[str, Ints] | None = None,
        shapes: Mapping[str, Mesh],
        use: Use = USES["all"],
        problems: Iterable[Problem],
        tiles: Mapping[str, Any],
        manifest: Mapping[str, Any],
    ) -> None:
        """Write everything but the tiles and move the directory to its name.

        layers   : features; the column ``feature`` has their numbers, by default their rows, counted through
                   all layers in order
        ranges   : range [start, stop) of the numbers of each layer
        graph    : the drivable road graph; not written if it has no edges
        kept     : rows of each layer, ascending, that tables and road graph hold; all by default
        shapes   : meshes that the tiles' instances copy; not written if there are none
        use      : which tables and columns are written
        tiles    : the document of tile reports
        manifest : the manifest without frame, layers and codes
        """
        ranges = ranges or number_ranges({layer.name: len(layer) for layer in layers})
        numbered = [_number_features(layer, ranges[layer.name][0]) for layer in layers]
        cut: dict[str, Any] = {}
        if kept is not None:
            beyond = np.setdiff1d(np.arange(len(graph)), kept["roads"])
            onward = graph.node_id[np.unique(graph.tail[beyond])]
            numbered, graph = _only_kept(numbered, graph, kept=kept)
            cut = {"nodes": np.intersect1d(onward, graph.node_id).tolist()}
        left_out: dict[str, int] = {}
        if use.tables is not None:
            left_out, numbered = _left_out(numbered, use), [_select_needed(layer, use) for layer in numbered]
        write_geopackage(self.files.features, numbered, frame=frame, indexed=use.indexed)
        if len(graph):
            write_graphml(graph, frame, path=self.files.road_graph)
        if shapes:
            write_shapes(self.files.shapes, shapes)
        found = sorted(problems)
        columns = {f.name: [getattr(row, f.name) for row in found] for f in fields(Problem)}
        write_columns(self.files.problems, columns)
        write_json(self.files.tile_reports, tiles, indent=1)
        self.files.tile_journal.unlink(missing_ok=True)
        tables = (
            *(self.files.features, self.files.road_graph, self.files.shapes, self.files.problems),
            self.files.tile_reports,
        )
        document = {
            "schema": SCHEMA,
            **redacted(manifest),
            "frame": frame.to_json(),
            "layers": {name: list(ends) for name, ends in ranges.items()},
            "rows": {layer.name: len(layer) for layer in numbered},
            "left_out": manifest.get("left_out", {}) | left_out,
            **({"cut": cut} if cut else {}),
            "classes": {c.name.lower(): int(c) for c in Class},
            "materials": {name: m.code for name, m in materials().items()},
            "files": {file.name: content_digest(file) for file in tables if file.exists()},
        }
        write_json(self.files.manifest, document | {"digest": manifest_digest(document)}, indent=1)
        if self.path.exists():
            self.path.rename(self._replaced)
        self.folder.rename(self.path)
        if self._replaced.exists():
            self._keep_foreign()

    def __exit__(  # noqa: PLR0917 - the protocol of context managers
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        resumable = kind is not None and (
            not issubclass(kind, Exception)
            or (issubclass(kind, _RESUMABLE) and self.files.tile_journal.exists())
        )
        with self._lock:
            if not resumable:
                shutil.rmtree(self.folder, ignore_errors=True)


def number_ranges(counts: Mapping[str, int]) -> dict[str, tuple[int, int]]:
    """Ranges [start, stop) of feature numbers of layers that follow each other, by the count of each."""
    stops = np.cumsum(list(counts.values())).tolist()
    return {name: (stop - counts[name], stop) for name, stop in zip(counts, stops, strict=True)}


def _number_features(layer: Layer, first: int) -> Layer:
    """The layer with feature numbers, from the first on unless it has its own."""
    rows = np.arange(first, first + len(layer), dtype=np.int32)
    return Layer(layer.name, layer.geometry, {"feature": rows, **layer.columns})


def _select_needed(layer: Layer, use: Use) -> Layer:
    """The rows and columns of a layer that a use needs."""
    needed = Needed() if use.tables is None else use.tables.get(layer.name, Needed((), ()))
    rows: Any = slice(None)
    if needed.classes is not None:
        rows = np.isin(layer.columns.get("class", np.full(len(layer), "")), needed.classes)
    wanted = layer.columns if needed.columns is None else ("feature", *needed.columns)
    names = [name for name in wanted if name in layer.columns]
    return Layer(layer.name, layer.geometry[rows], {name: layer.columns[name][rows] for name in names})


def _left_out(layers: Sequence[Layer], use: Use) -> dict[str, int]:
    """Numbers of features and attributes that a use does not need, and bytes of both."""
    found = {"features": 0, "attributes": 0, "bytes": 0}
    for layer in layers:
        needed = _select_needed(layer, use)
        found["features"] += len(layer) - len(needed)
        found["attributes"] += len(needed) * (len(layer.columns) - len(needed.columns))
        found["bytes"] += _bytes(layer) - _bytes(needed)
    return found


def _bytes(layer: Layer) -> int:
    """Bytes of geometries and values, texts in UTF-8."""
    size = sum(map(len, shapely.to_wkb(layer.geometry)))
    for values in layer.columns.values():
        texts = values.dtype.kind in "USO"
        size += sum(len(str(value).encode()) for value in values.tolist()) if texts else values.nbytes
    return size


def _only_kept(
    layers: Sequence[Layer], graph: RoadGraph, *, kept: Mapping[str, Ints]
) -> tuple[list[Layer], RoadGraph]:
    """Layers and road graph with the kept rows; numbers of edges in the layers are those of the new graph."""
    edge = np.full(len(graph) + 1, -1, np.int32)
    edge[kept["roads"]] = np.arange(len(kept["roads"]))
    out = []
    for layer in layers:
        rows = kept[layer.name]
        columns = {name: values[rows] for name, values in layer.columns.items()}
        if "edge" in columns:
            columns["edge"] = edge[columns["edge"]]
        out.append(Layer(layer.name, layer.geometry[rows], columns))
    return out, graph.take(kept["roads"])

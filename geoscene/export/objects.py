"""Objects of a tile: the faces of each feature, with its name and attributes."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.errors import InputError
from geoscene.export.kinds import plain
from geoscene.geometry.mesh import Mesh, ShapeInstances, concatenate
from geoscene.scene import Scene
from geoscene.support.progress import Progress, silent
from geoscene.typing import Bools, Float, Ints

BARE = "terrain"
"""Name of the layer of faces that belong to no feature."""


@dataclass(frozen=True)
class FeatureAttributes:
    """Attributes of all features of a scene.

    starts  : (k,) int64, first feature number of each layer
    layers  : names of the layers, in the same order
    numbers : of each layer, (n,) int64 feature numbers, ascending; those of its range, or fewer
    columns : of each layer, column name to values (n,)
    unique  : of each layer, (n,) bool, the feature is the only one with its ``osm_id``
    """

    starts: Ints
    layers: tuple[str, ...]
    numbers: tuple[Ints, ...]
    columns: tuple[dict[str, NDArray[Any]], ...]
    unique: tuple[Bools, ...]

    def layer(self, feature: int) -> str:
        """Name of a feature's layer."""
        return self.layers[self._row(feature)[0]] if feature >= 0 else BARE

    def attributes(self, feature: int) -> dict[str, Any]:
        """Attributes of a feature with their sources; unknown ones are left out."""
        if feature < 0:
            return {}
        layer, row = self._row(feature)
        attributes = {name: plain(values[row]) for name, values in self.columns[layer].items()}
        return {name: value for name, value in attributes.items() if value is not None}

    def name(self, feature: int) -> str:
        """``way/123`` for the only building of that OSM id, else ``layer/number``."""
        if feature < 0:
            return BARE
        layer, row = self._row(feature)
        if self.unique[layer][row] and self.layers[layer] == "buildings":
            return str(self.columns[layer]["osm_id"][row])
        return f"{self.layers[layer]}/{feature}"

    def _row(self, feature: int) -> tuple[int, int]:
        layer = int(np.searchsorted(self.starts, feature, side="right")) - 1
        return layer, int(np.searchsorted(self.numbers[layer], feature))


def read_features(scene: Scene) -> FeatureAttributes:
    """The attributes of all features, without their geometry.

    Raises SceneFormatError if the scene lacks a layer that its manifest names.
    """
    ranges = sorted(scene.layers.items(), key=lambda item: item[1])
    layers = [name for name, _ in ranges if scene.table_length(name)]
    tables = [scene.features(name, geometry="none").columns for name in layers]
    columns = tuple({name: v for name, v in table.items() if name != "feature"} for table in tables)
    starts = np.array([scene.layers[name][0] for name in layers], np.int64)
    numbers = tuple(table["feature"].astype(np.int64) for table in tables)
    unique = []
    for layer in columns:
        _, owner, count = np.unique(layer["osm_id"].astype(str), return_inverse=True, return_counts=True)
        unique.append(count[owner] == 1)
    return FeatureAttributes(starts, tuple(layers), numbers, columns, tuple(unique))


@dataclass(frozen=True, slots=True)
class Piece:
    """The faces of one object in one tile.

    rows    : (m,) int64, which faces of the tile's mesh
    feature : scene-wide number, -1 for none
    klass   : `Class` code of its first face
    solid   : the faces bound a solid; else they are a surface
    """

    rows: Ints
    feature: int
    klass: int
    solid: bool


def pieces(mesh: Mesh) -> list[Piece]:
    """The objects of a tile: solids by feature, surfaces by feature and class; in order of feature number."""
    if not len(mesh):
        return []
    part = np.where(mesh.closed, 0, mesh.klass.astype(np.int64) + 1)
    key = (mesh.feature.astype(np.int64) + 1) * 512 + part
    order = np.argsort(key, kind="stable")
    cuts = np.flatnonzero(np.diff(key[order])) + 1
    return [
        Piece(rows, int(mesh.feature[rows[0]]), int(mesh.klass[rows[0]]), bool(mesh.closed[rows[0]]))
        for rows in np.split(order, cuts)
    ]


def rows_in_layers(scene: Scene, feature: NDArray[np.int32], *, layers: Collection[str] | None) -> Bools:
    """Whether faces or instances (m,) belong to one of the layers; all of them for None."""
    if layers is None:
        return np.ones(len(feature), np.bool_)
    keep = np.zeros(len(feature), np.bool_)
    for name in layers:
        start, stop = (-1, 0) if name == BARE else scene.layers[name]
        keep |= (feature >= start) & (feature < stop)
    return keep


@dataclass(frozen=True, slots=True)
class Part:
    """The chosen layers of a tile, in tile coordinates; see `geoscene.scene.tile_files.Tile`."""

    index: tuple[int, int]
    span: int
    origin: Float
    mesh: Mesh
    instances: ShapeInstances


def parts(
    scene: Scene, layers: Collection[str] | None = None, *, stage: str = "", progress: Progress = silent
) -> Iterator[Part]:
    """The tiles of a scene one at a time, restricted to the chosen layers.

    Raises InputError for unknown names of layers, and after the last tile if the layers have no faces.
    """
    found = layers is None
    known = [*scene.layers, BARE]
    if unknown := sorted(set(layers or ()) - set(known)):
        raise InputError(f"`layers`: no layer {', '.join(unknown)}; this scene has {', '.join(known)}")
    spans = scene.tile_spans.tolist()
    for done, ((i, j), span) in enumerate(zip(scene.tile_indices, spans, strict=True)):
        progress(stage, done, total=len(spans))
        tile = scene.tile(i, j)
        mesh, copies = tile.mesh, tile.instances
        if layers is not None:
            mesh = mesh.take(rows_in_layers(scene, mesh.feature, layers=layers))
            keep = rows_in_layers(scene, copies.feature, layers=layers)
            copies = copies.take(keep)
        found = found or len(mesh) + len(copies) > 0
        yield Part((i, j), span, tile.origin, mesh, copies)
    if not found:
        names = ", ".join(layers or ())
        raise InputError(f"`layers` {names}: no faces in this scene; they are attributes alone, or empty")


def expand(instances: ShapeInstances, library: Sequence[Mesh]) -> Mesh:
    """The instances as one mesh, for formats without instances; faces keep their instance's feature."""
    out = []
    for number in np.unique(instances.shape).tolist():
        chosen = instances.shape == number
        shape, transform = library[number], instances.transform[chosen]
        k, n = len(transform), len(shape.vertices)
        points = np.einsum("kij,nj->kni", transform[:, :, :3], shape.vertices) + transform[:, None, :, 3]
        faces = shape.faces + (np.arange(k) * n)[:, None, None]
        attributes = {
            name: np.tile(getattr(shape, name), k) for name in ("klass", "material", "surface", "closed")
        }
        feature = np.repeat(instances.feature[chosen], len(shape))
        color = np.tile(shape.color, (k, 1))
        out.append(
            Mesh.of(points.reshape(-1, 3), faces.reshape(-1, 3), feature=feature, color=color, **attributes)
        )
    return concatenate(out)


def table_columns(
    features: FeatureAttributes, *, layer: int, pairs: NDArray[np.integer]
) -> dict[str, NDArray[Any]]:
    """``feature``, ``class`` and the attributes of features of a layer.

    pairs : (n, 2) feature number and `Class` code: a building and its pad are one feature of two classes
    """
    feature, klass = pairs.T
    rows = np.searchsorted(features.numbers[layer], feature)
    names = np.array([klass_name(code) for code in klass.tolist()], object)
    attributes = {name: values[rows] for name, values in features.columns[layer].items()}
    return {"feature": feature.astype(np.int32), "class": names, **attributes}


def klass_name(code: int) -> str:
    """Name of a class code, such as ``building`` for 14."""
    return Class(code).name.lower()


def attribution(scene: Scene) -> str:
    """Attribution of all sources of the scene."""
    return str(scene.manifest.get("attribution", ""))

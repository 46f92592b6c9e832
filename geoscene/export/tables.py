"""Features in chunks of rows: the layers of a scene in plan, and its buildings as surfaces in 3D."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS
from pyproj.exceptions import CRSError

from geoscene.classes import Class
from geoscene.errors import InputError
from geoscene.export.objects import read_features
from geoscene.mesh import Mesh
from geoscene.scene import Scene
from geoscene.scene.geopackage import Layer

SOLIDS = "building_solids"
"""Name of the layer of buildings as MultiPolygon Z, which a scene does not store as features."""

ROWS = 20_000
"""Features that are in memory at once."""


def target_crs(scene: Scene, crs: str | None) -> CRS:
    """The CRS of a name, by default the scene's; raises InputError for an unknown name."""
    if crs is None:
        return scene.frame.crs
    try:
        return CRS.from_user_input(crs)
    except CRSError as error:
        raise InputError(f"`crs` {crs}: not a CRS that pyproj can read; give EPSG:<number>") from error


def chosen_layers(scene: Scene, layers: Collection[str] | None, *, solids: bool) -> list[str]:
    """Names of the layers to write, in the scene's order; by default all that have features.

    Raises InputError for an unknown name.
    """
    known = [name for name, (a, b) in sorted(scene.layers.items(), key=lambda item: item[1]) if b > a]
    if layers is None:
        return [*known, SOLIDS] if solids and "buildings" in known else known
    unknown = sorted(set(layers) - {*scene.layers, SOLIDS})
    if unknown:
        names = ", ".join([*scene.layers, SOLIDS])
        raise InputError(f"no layer {', '.join(unknown)}; this scene has {names}")
    return [name for name in [*known, SOLIDS] if name in layers]


def kinds_of_columns(scene: Scene, layer: str) -> dict[str, np.dtype[Any]]:
    """Type of each column of a layer; object for text."""
    return dict(scene.schema("buildings" if layer == SOLIDS else layer).columns)


def rows(scene: Scene, layer: str, *, crs: CRS) -> Iterator[Layer]:
    """The features of a layer in order, in chunks (solids: tile by tile)."""
    if layer == SOLIDS:
        yield from _solids(scene, crs)
        return
    start, stop = scene.layers[layer]
    same = crs == scene.frame.crs
    for first in range(0, stop - start, ROWS):
        some = scene.features(layer, geometry="projected", rows=range(first, first + ROWS))
        geometry = some.geometry if same else _transformed(scene, some.geometry, crs=crs, projected=True)
        yield Layer(layer, geometry, some.columns)


def _transformed(
    scene: Scene, geometry: NDArray[np.object_], *, crs: CRS, projected: bool
) -> NDArray[np.object_]:
    """Geometries transformed to a CRS from scene metres or from the frame's projected coordinates."""
    flat = shapely.get_coordinates(geometry, include_z=True)
    east, north = scene.frame.origin if projected else (0.0, 0.0)
    x, y = scene.frame.to_crs(flat[:, 0] - east, flat[:, 1] - north, crs=crs)
    tall = bool(shapely.has_z(geometry).any())
    out: NDArray[np.object_] = shapely.set_coordinates(
        shapely.force_3d(geometry) if tall else geometry.copy(),
        np.column_stack([x, y, np.nan_to_num(flat[:, 2])] if tall else [x, y]),
    )
    return out


def _solids(scene: Scene, crs: CRS) -> Iterator[Layer]:
    features = read_features(scene)
    columns = features.columns[features.layers.index("buildings")]
    first, stop = scene.layers["buildings"]
    for tile in scene.tiles():
        mesh = tile.mesh
        keep = mesh.closed & (mesh.feature >= first) & (mesh.feature < stop) & (mesh.klass == Class.BUILDING)
        chosen = mesh.take(np.flatnonzero(keep)[np.argsort(mesh.feature[keep], kind="stable")])
        if not len(chosen):
            continue
        feature, geometry = surfaces(chosen.shifted(tile.origin))
        own = {name: values[feature - first] for name, values in columns.items()}
        yield Layer(
            SOLIDS, _transformed(scene, geometry, crs=crs, projected=False), {"feature": feature, **own}
        )


def surfaces(mesh: Mesh) -> tuple[NDArray[np.int32], NDArray[np.object_]]:
    """Feature numbers (n,) and the faces of each as a MultiPolygon Z; the mesh is sorted by feature."""
    corners = mesh.vertices[mesh.faces]
    rings = np.concatenate([corners, corners[:, :1]], axis=1)
    feature, owner = np.unique(mesh.feature, return_inverse=True)
    return feature, shapely.multipolygons(shapely.polygons(rings), indices=owner)

"""Features in chunks of rows: the layers of a scene in plan, and measurements of the solids of buildings."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS
from pyproj.exceptions import CRSError

from geoscene.classes import Class
from geoscene.errors import InputError
from geoscene.geometry.watertight import volumes
from geoscene.scene import Scene
from geoscene.scene.geopackage import Layer
from geoscene.typing import Float

SOLIDS = "building_solids"
"""Name of the table of the solids of buildings in GeoPackages."""

ROWS = 20_000
"""Features that are in memory at once."""

_HALF_TURN = 180.0
_FAR = 50_000.0
"""Metres by which features reach beyond the ground of their scene at most."""


def target_crs(scene: Scene, crs: str | None) -> CRS:
    """The CRS of a name, by default the scene's; raises InputError for an unknown name."""
    if crs is None:
        return scene.frame.crs
    try:
        return CRS.from_user_input(crs)
    except CRSError as error:
        raise InputError(f"`crs` {crs}: not a CRS that pyproj can read; give EPSG:<number>") from error


def chosen_layers(scene: Scene, layers: Collection[str] | None, *, others: Collection[str] = ()) -> list[str]:
    """Names of the layers to write, in the scene's order; by default all that have features.

    others : names of tables that the format has besides the scene's layers

    Raises InputError for an unknown name, and if none of the layers to write has features.
    """
    ranges = sorted(scene.layers.items(), key=lambda item: item[1])
    known = [name for name, _ in ranges if scene.table_length(name)]
    if layers is None:
        return [*known, *others]
    if unknown := sorted(set(layers) - {*scene.layers, *others}):
        names = ", ".join([*scene.layers, *others])
        raise InputError(f"no layer {', '.join(unknown)}; this scene has {names}")
    chosen = [name for name in [*known, *others] if name in layers]
    if not chosen:
        raise InputError(f"`layers` {', '.join(layers)}: no features in this scene")
    return chosen


def kinds_of_columns(scene: Scene, layer: str) -> dict[str, np.dtype[Any]]:
    """Type of each column of a layer; object for text."""
    return dict(scene.schema(layer).columns)


def rows(scene: Scene, layer: str, *, crs: CRS) -> Iterator[Layer]:
    """The features of a layer in order, in chunks."""
    same = crs == scene.frame.crs
    several = geometry_type(scene, layer, crs=crs) != scene.schema(layer).geometry_type
    for first in range(0, scene.table_length(layer), ROWS):
        some = scene.features(layer, geometry="projected", rows=range(first, first + ROWS))
        geometry = some.geometry if same else _transform(scene, some.geometry, crs=crs)
        if crs.is_geographic:
            geometry = cut_at_antimeridian(geometry)
        yield Layer(layer, as_multi(geometry) if several else geometry, some.columns)


def geometry_type(scene: Scene, layer: str, *, crs: CRS) -> str:
    """GDAL's name of the type of a layer's geometries in a CRS; multi-part near 180 degrees of longitude."""
    own = scene.schema(layer).geometry_type
    xmin, ymin, xmax, ymax = np.add(scene.bounds, [-_FAR, -_FAR, _FAR, _FAR])
    lon, _ = scene.frame.to_crs([xmin, xmax, xmax, xmin], [ymin, ymin, ymax, ymax], crs=crs)
    cut = crs.is_geographic and np.ptp(lon) > _HALF_TURN and own.startswith(("Polygon", "LineString"))
    return f"Multi{own}" if cut else own


def cut_at_antimeridian(geometry: NDArray[np.object_]) -> NDArray[np.object_]:
    """Geometries in degrees, those that cross 180 degrees cut there into parts (RFC 7946, section 3.1.9).

    A geometry crosses it if it spans more than 180 degrees of longitude.
    """
    west, _, east, _ = shapely.bounds(geometry).T
    out = geometry.copy()
    for row in np.flatnonzero(east - west > _HALF_TURN).tolist():
        turned = _turn_longitudes(geometry[row : row + 1], 2 * _HALF_TURN, where=lambda lon: lon < 0)
        near, far = (
            shapely.get_parts(shapely.intersection(turned, shapely.box(x, -90, x + _HALF_TURN, 90)))
            for x in (0.0, _HALF_TURN)
        )
        parts = np.concatenate([near, _turn_longitudes(far, -2 * _HALF_TURN, where=np.isfinite)])
        parts = parts[shapely.get_dimensions(parts) == shapely.get_dimensions(turned[0])]
        out[row] = as_multi(parts, owner=np.zeros(len(parts), np.int64))[0]
    return out


def _turn_longitudes(
    geometry: NDArray[np.object_], degrees: float, *, where: Callable[[Float], NDArray[np.bool_]]
) -> NDArray[np.object_]:
    """Geometries with an angle added to the longitudes that fulfil a condition."""
    tall = bool(shapely.has_z(geometry).any())
    turned: NDArray[np.object_] = shapely.transform(
        geometry,
        lambda points: points + np.pad((degrees * where(points[:, 0]))[:, None], [(0, 0), (0, 1 + tall)]),
        include_z=tall,
    )
    return turned


def as_multi(
    geometry: NDArray[np.object_], *, owner: NDArray[np.integer] | None = None
) -> NDArray[np.object_]:
    """Polygons or lines (n,) as multi-part geometries, one each or one for each of ``owner`` (n,)."""
    parts, row = shapely.get_parts(geometry, return_index=True)
    gather = shapely.multipolygons if shapely.get_dimensions(parts[0]) == 2 else shapely.multilinestrings
    gathered: NDArray[np.object_] = gather(parts, indices=row if owner is None else owner[row])
    return gathered


def _transform(scene: Scene, geometry: NDArray[np.object_], *, crs: CRS) -> NDArray[np.object_]:
    """Geometries transformed to a CRS from the frame's projected coordinates."""
    flat = shapely.get_coordinates(geometry, include_z=True)
    east, north = scene.frame.origin
    x, y = scene.frame.to_crs(flat[:, 0] - east, flat[:, 1] - north, crs=crs)
    tall = bool(shapely.has_z(geometry).any())
    out: NDArray[np.object_] = shapely.set_coordinates(
        shapely.force_3d(geometry) if tall else geometry.copy(),
        np.column_stack([x, y, np.nan_to_num(flat[:, 2])] if tall else [x, y]),
    )
    return out


def solids(scene: Scene) -> Layer:
    """The solids of buildings as a table without geometry, in order of their features.

    feature, osm_id : of the building
    faces           : triangles
    bottom, top     : metres, in the scene's heights
    volume          : true cubic metres
    """
    first, stop = scene.layers["buildings"]
    count = stop - first
    faces, volume = np.zeros(count, np.int32), np.zeros(count)
    bottom, top = np.full(count, np.inf), np.full(count, -np.inf)
    for tile in scene.tiles(forests=False):
        mesh = tile.mesh
        keep = mesh.closed & (mesh.feature >= first) & (mesh.feature < stop) & (mesh.klass == Class.BUILDING)
        row, corners = mesh.feature[keep] - first, mesh.vertices[mesh.faces[keep]]
        heights = corners[..., 2] + tile.origin[2]
        np.minimum.at(bottom, row, heights.min(axis=1))
        np.maximum.at(top, row, heights.max(axis=1))
        np.add.at(faces, row, 1)
        scale = float(scene.frame.scale_at(*(tile.origin[:2] + scene.tile_size / 2).tolist()))
        volume += volumes(corners, owner=row, n=count) / scale**2
    table = scene.features("buildings", geometry="none").columns
    osm_id = np.full(count, None, object)
    osm_id[table["feature"] - first] = table["osm_id"]
    columns: dict[str, NDArray[Any]] = {
        "feature": np.arange(first, stop, dtype=np.int32),
        "osm_id": osm_id,
        "faces": faces,
        "bottom": bottom,
        "top": top,
        "volume": volume,
    }
    rows = np.flatnonzero(faces)
    return Layer(SOLIDS, np.full(len(rows), None), {name: values[rows] for name, values in columns.items()})

"""Tables of features with their attributes, and features as GeoPackage, GeoJSON and GeoParquet."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS
from pyproj.exceptions import CRSError

from geoscene.classes import Class
from geoscene.errors import InputError, need
from geoscene.export import styles
from geoscene.export.kinds import Summary, compact_json, plain
from geoscene.export.objects import attribution
from geoscene.geometry.watertight import volumes
from geoscene.scene import Scene
from geoscene.scene.geopackage import Layer, open_geopackage
from geoscene.support.files import atomic_file
from geoscene.support.progress import Progress, silent
from geoscene.typing import Float

SOLIDS = "building_solids"
"""Name of the table of the solids of buildings in GeoPackages."""

ROWS = 20_000
"""Features that are in memory at once."""

_HALF_TURN = 180.0
_FAR = 50_000.0
"""Metres by which features reach beyond the ground of their scene at most."""


def _reading(
    scene: Scene, names: list[str], *, crs: CRS, stage: str, progress: Progress
) -> Iterator[tuple[int, Layer]]:
    """The chunks of all layers, with the number of rows before each."""
    total = sum(map(scene.table_length, names))
    done = 0
    for name in names:
        for chunk in rows(scene, name, crs=crs):
            progress(stage, min(done, total), total=total)
            yield done, chunk
            done += len(chunk)


def write_gpkg(
    scene: Scene,
    path: Path,
    *,
    crs: str | None = None,
    layers: Collection[str] | None = None,
    progress: Progress = silent,
) -> Summary:
    """Write the features as a GeoPackage: one layer for each kind, styles, and the table ``building_solids``.

    The table has the faces, heights and volume of each building's solid but no geometry: GeoPackage has no
    type for solids, and as polygons, which are valid in plan only, their walls would be invalid. QGIS opens
    the layers in the colours of classes, by the table ``layer_styles``.

    crs    : of the coordinates; default the scene's
    layers : names to write; default all
    """
    target = target_crs(scene, crs)
    tables = [SOLIDS] if scene.table_length("buildings") and scene.has_tiles else []
    names = chosen_layers(scene, layers, others=tables)
    layers_in_plan = [name for name in names if name != SOLIDS]
    objects = count = faces = 0
    classes: dict[str, set[str]] = {name: set() for name in layers_in_plan}
    with open_geopackage(path) as append:
        for _, chunk in _reading(scene, layers_in_plan, crs=target, stage="GeoPackage", progress=progress):
            append(chunk, geometry_type(scene, chunk.name, crs=target), target.to_wkt())
            objects += len(chunk)
            if (column := styles.column_of(chunk.name)) in chunk.columns:
                classes[chunk.name].update(np.unique(chunk.columns[column].astype(str)).tolist())
        if layers_in_plan:
            append(styles.layer_styles(classes), None, None)
        if SOLIDS in names:
            table = solids(scene)
            append(table, None, None)
            count, faces = len(table), int(table.columns["faces"].sum())
    return Summary.of(path, "gpkg", objects=objects + count, solids=count, faces=faces, crs=_name_of(target))


def _name_of(crs: CRS) -> str:
    code = crs.to_authority()
    return ":".join(code) if code else str(crs.name)


def write_geojson(
    scene: Scene, path: Path, *, layers: Collection[str] | None = None, progress: Progress = silent
) -> Summary:
    """Write the features as GeoJSON (RFC 7946): longitude and latitude on WGS 84 to 1e-9 degrees (0.1 mm).

    One collection of all layers; ``kind`` is the layer of a feature. Unknown values are left out.

    layers : names to write; default all
    """
    names = chosen_layers(scene, layers)
    wgs84 = CRS.from_user_input("OGC:CRS84")
    count = 0
    with atomic_file(path) as out:
        head: dict[str, Any] = {"type": "FeatureCollection", "attribution": attribution(scene)}
        out.write(compact_json(head)[:-1] + b',"features":[')
        for _, chunk in _reading(scene, names, crs=wgs84, stage="GeoJSON", progress=progress):
            geometry = _for_geojson(chunk.geometry)
            columns = {_column_name(chunk.name, name): v.tolist() for name, v in chunk.columns.items()}
            for k, shape in enumerate(shapely.to_geojson(geometry).tolist()):
                attributes = {name: plain(values[k]) for name, values in columns.items()}
                properties = {"kind": chunk.name, **{n: v for n, v in attributes.items() if v is not None}}
                start = b",\n" if count else b"\n"
                head = {"type": "Feature", "id": properties["feature"], "properties": properties}
                out.write(start + compact_json(head)[:-1] + b',"geometry":' + shape.encode() + b"}")
                count += 1
        out.write(b"\n]}\n")
    return Summary.of(path, "geojson", objects=count, crs="OGC:CRS84")


def _for_geojson(geometry: NDArray[np.object_]) -> NDArray[np.object_]:
    """Geometries rounded, with rings oriented as RFC 7946 requires."""
    tall = bool(shapely.has_z(geometry).any())
    digits = [9, 9, 4] if tall else [9, 9]

    def rounded(xyz: Float) -> Float:
        return np.column_stack([np.round(c, d) for c, d in zip(xyz.T, digits, strict=True)])

    out: NDArray[np.object_] = shapely.transform(geometry, rounded, include_z=tall)
    return out if tall else shapely.orient_polygons(out)


def write_geoparquet(
    scene: Scene,
    path: Path,
    *,
    crs: str | None = None,
    layers: Collection[str] | None = None,
    progress: Progress = silent,
) -> Summary:
    """Write the features as one GeoParquet 1.1 table with a ``bbox`` column; ``kind`` is the layer of a row.

    crs    : of the coordinates; default the scene's
    layers : names to write; default all

    Raises MissingExtraError without pyarrow.
    """
    pa = need("pyarrow", "gis")
    parquet = need("pyarrow.parquet", "gis")
    target = target_crs(scene, crs)
    names = chosen_layers(scene, layers)
    kinds = _common_kinds(pa, scene, names=names)
    box = pa.struct([(edge, pa.float64()) for edge in ("xmin", "ymin", "xmax", "ymax")])
    fields = [("kind", pa.string()), *kinds.items(), ("bbox", box), ("geometry", pa.binary())]
    schema = pa.schema(fields, metadata={"attribution": attribution(scene)})
    types: set[str] = set()
    bounds = np.array([np.inf, np.inf, -np.inf, -np.inf])
    count = 0
    with atomic_file(path) as out, parquet.ParquetWriter(out, schema, compression="zstd") as writer:
        for _, chunk in _reading(scene, names, crs=target, stage="GeoParquet", progress=progress):
            n = len(chunk)
            boxes = shapely.bounds(chunk.geometry)
            own = {_column_name(chunk.name, name): values for name, values in chunk.columns.items()}
            columns = {
                "kind": pa.array([chunk.name] * n),
                **{name: _arrow(pa, own.get(name), kind=kind, n=n) for name, kind in kinds.items()},
                "bbox": pa.StructArray.from_arrays([pa.array(c) for c in boxes.T], fields=list(box)),
                "geometry": pa.array(shapely.to_wkb(chunk.geometry, flavor="iso").tolist()),
            }
            writer.write_table(pa.table(columns, schema=schema))
            types |= {shape.geom_type + " Z" * shape.has_z for shape in chunk.geometry}
            bounds = np.concatenate(
                [np.fmin(bounds[:2], boxes[:, :2].min(axis=0)), np.fmax(bounds[2:], boxes[:, 2:].max(axis=0))]
            )
            count += n
        geo = _geoparquet_metadata(target, sorted(types), bounds=bounds if count else None)
        writer.add_key_value_metadata({"geo": json.dumps(geo)})
    return Summary.of(path, "geoparquet", objects=count, crs=_name_of(target))


def _column_name(layer: str, column: str) -> str:
    """Name of a column in a table of all layers, where ``kind`` is the layer: ``structures_kind``."""
    return f"{layer}_kind" if column == "kind" else column


def _common_kinds(pa: Any, scene: Scene, *, names: list[str]) -> dict[str, Any]:
    """Arrow type of each column over all layers: text where layers differ, double for mixed numbers."""
    found: dict[str, list[np.dtype[Any]]] = {}
    for name in names:
        for column, kind in kinds_of_columns(scene, name).items():
            found.setdefault(_column_name(name, column), []).append(kind)
    out = {}
    for column, dtypes in found.items():
        text = any(d.kind == "O" for d in dtypes) or len({d.kind == "b" for d in dtypes}) > 1
        out[column] = pa.string() if text else pa.from_numpy_dtype(np.result_type(*dtypes))
    return out


def _arrow(pa: Any, values: NDArray[Any] | None, *, kind: Any, n: int) -> Any:
    if values is None:
        return pa.nulls(n, kind)
    if kind == pa.string():
        return pa.array([None if plain(v) is None else str(v) for v in values.tolist()], kind)
    return pa.array(values, from_pandas=True).cast(kind)


def _geoparquet_metadata(crs: CRS, types: list[str], *, bounds: Float | None) -> dict[str, Any]:
    column: dict[str, Any] = {
        "encoding": "WKB",
        "geometry_types": types,
        "crs": crs.to_json_dict(),
        "covering": {"bbox": {e: ["bbox", e] for e in ("xmin", "ymin", "xmax", "ymax")}},
    }
    if bounds is not None:
        column["bbox"] = bounds.tolist()
    return {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}


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
        raise InputError(f"`layers`: no layer {', '.join(unknown)}; this scene has {names}")
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

"""Features as GeoPackage, GeoJSON and GeoParquet."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS

from geoscene.errors import need
from geoscene.export.files import Summary, plain, size_of
from geoscene.export.objects import attribution
from geoscene.export.tables import SOLIDS, Rows, chosen_layers, kinds_of_columns, rows, target_crs
from geoscene.files import atomic_file, atomic_path
from geoscene.progress import Progress, silent
from geoscene.scene import Scene
from geoscene.typing import Float

_DATE = "2000-01-01T00:00:00Z"  # a constant, so that the same scene is the same bytes


def _reading(
    scene: Scene, names: list[str], *, crs: CRS, stage: str, progress: Progress
) -> Iterator[tuple[int, Rows]]:
    """The chunks of all layers, with the number of rows before each."""
    total = sum(np.subtract(*scene.layers[name][::-1]) for name in names if name != SOLIDS)
    done = 0
    for name in names:
        for chunk in rows(scene, name, crs=crs):
            progress(stage, min(done, int(total)), total=int(total))
            yield done, chunk
            done += len(chunk.geometry)


def write_gpkg(
    scene: Scene,
    path: Path,
    *,
    crs: str | None = None,
    layers: Collection[str] | None = None,
    progress: Progress = silent,
) -> Summary:
    """Write the features as a GeoPackage: one layer for each kind, and ``building_solids`` as MultiPolygon Z.

    The faces of a MultiPolygon Z bound the building, counter-clockwise seen from outside: GeoPackage has no
    type for solids, and readers built on GEOS do not support PolyhedralSurface.

    crs    : of the coordinates; default the scene's
    layers : names to write; default all
    """
    import pyogrio  # noqa: PLC0415  (0.3 s)
    from pyogrio.raw import write  # noqa: PLC0415

    target = target_crs(scene, crs)
    names = chosen_layers(scene, layers, solids=True)
    before = {"OGR_CURRENT_DATE": pyogrio.get_gdal_config_option("OGR_CURRENT_DATE")}
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": _DATE})
    objects = solids = faces = 0
    try:
        with atomic_path(path, keep_suffix=True) as part:
            for _, chunk in _reading(scene, names, crs=target, stage="GeoPackage", progress=progress):
                write(
                    str(part),
                    geometry=shapely.to_wkb(chunk.geometry),
                    field_data=list(chunk.columns.values()),
                    fields=list(chunk.columns),
                    geometry_type=_geometry_type(scene, chunk),
                    crs=target.to_wkt(),
                    layer=chunk.layer,
                    driver="GPKG",
                    append=part.exists(),
                    layer_options={"FID": "fid", "SPATIAL_INDEX": "YES"},
                )
                objects += len(chunk.geometry)
                if chunk.layer == SOLIDS:
                    solids += len(chunk.geometry)
                    faces += int(shapely.get_num_geometries(chunk.geometry).sum())
    finally:
        pyogrio.set_gdal_config_options(before)
    files, size = size_of(path)
    return Summary(path, "gpkg", files, size, objects, solids, faces, _named(target))


def _geometry_type(scene: Scene, chunk: Rows) -> str:
    if chunk.layer == SOLIDS:
        return "MultiPolygon Z"
    return scene.schema(chunk.layer).geometry_type


def _named(crs: CRS) -> str:
    code = crs.to_authority()
    return ":".join(code) if code else str(crs.name)


def write_geojson(
    scene: Scene, path: Path, *, layers: Collection[str] | None = None, progress: Progress = silent
) -> Summary:
    """Write the features as GeoJSON (RFC 7946): longitude and latitude on WGS 84 to 1e-9 degrees (0.1 mm).

    One collection of all layers; ``kind`` is the layer of a feature. Unknown values are left out.

    layers : names to write; default all, less ``building_solids``
    """
    names = chosen_layers(scene, layers, solids=False)
    wgs84 = CRS.from_user_input("OGC:CRS84")
    count = 0
    with atomic_file(path) as out:
        head: dict[str, Any] = {"type": "FeatureCollection", "attribution": attribution(scene)}
        out.write(_json(head)[:-1] + b',"features":[')
        for _, chunk in _reading(scene, names, crs=wgs84, stage="GeoJSON", progress=progress):
            geometry = _for_geojson(chunk.geometry)
            columns = {_column_name(chunk.layer, name): v.tolist() for name, v in chunk.columns.items()}
            for k, shape in enumerate(shapely.to_geojson(geometry).tolist()):
                attributes = {name: plain(values[k]) for name, values in columns.items()}
                properties = {"kind": chunk.layer, **{n: v for n, v in attributes.items() if v is not None}}
                start = b",\n" if count else b"\n"
                head = {"type": "Feature", "id": properties["feature"], "properties": properties}
                out.write(start + _json(head)[:-1] + b',"geometry":' + shape.encode() + b"}")
                count += 1
        out.write(b"\n]}\n")
    files, size = size_of(path)
    return Summary(path, "geojson", files, size, count, crs="OGC:CRS84")


def _json(value: Any) -> bytes:
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False).encode()


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
    layers : names to write; default all, less ``building_solids``

    Raises MissingExtraError without pyarrow.
    """
    pa = need("pyarrow", "gis")
    parquet = need("pyarrow.parquet", "gis")
    target = target_crs(scene, crs)
    names = chosen_layers(scene, layers, solids=False)
    kinds = _common_kinds(pa, scene, names=names)
    box = pa.struct([(edge, pa.float64()) for edge in ("xmin", "ymin", "xmax", "ymax")])
    fields = [("kind", pa.string()), *kinds.items(), ("bbox", box), ("geometry", pa.binary())]
    schema = pa.schema(fields, metadata={"attribution": attribution(scene)})
    types: set[str] = set()
    bounds = np.array([np.inf, np.inf, -np.inf, -np.inf])
    count = 0
    with atomic_file(path) as out, parquet.ParquetWriter(out, schema, compression="zstd") as writer:
        for _, chunk in _reading(scene, names, crs=target, stage="GeoParquet", progress=progress):
            n = len(chunk.geometry)
            boxes = shapely.bounds(chunk.geometry)
            own = {_column_name(chunk.layer, name): values for name, values in chunk.columns.items()}
            columns = {
                "kind": pa.array([chunk.layer] * n),
                **{name: _arrow(pa, own.get(name), kind=kind, n=n) for name, kind in kinds.items()},
                "bbox": pa.StructArray.from_arrays([pa.array(c) for c in boxes.T], fields=list(box)),
                "geometry": pa.array(shapely.to_wkb(chunk.geometry, flavor="iso").tolist()),
            }
            writer.write_table(pa.table(columns, schema=schema))
            types |= _type_names(chunk.geometry)
            bounds = np.concatenate(
                [np.fmin(bounds[:2], boxes[:, :2].min(axis=0)), np.fmax(bounds[2:], boxes[:, 2:].max(axis=0))]
            )
            count += n
        geo = _geoparquet_metadata(target, sorted(types), bounds=bounds if count else None)
        writer.add_key_value_metadata({"geo": json.dumps(geo)})
    files, size = size_of(path)
    return Summary(path, "geoparquet", files, size, count, crs=_named(target))


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


def _type_names(geometry: NDArray[np.object_]) -> set[str]:
    names = {
        1: "LineString",
        3: "Polygon",
        5: "MultiLineString",
        6: "MultiPolygon",
        0: "Point",
        4: "MultiPoint",
    }
    pairs = np.unique(np.column_stack([shapely.get_type_id(geometry), shapely.has_z(geometry)]), axis=0)
    return {names[kind] + (" Z" if tall else "") for kind, tall in pairs.tolist()}


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

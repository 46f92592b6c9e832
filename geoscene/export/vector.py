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
from geoscene.export.files import Summary, compact_json, plain
from geoscene.export.objects import attribution
from geoscene.export.tables import (
    SOLIDS,
    chosen_layers,
    geometry_type,
    kinds_of_columns,
    rows,
    solids,
    target_crs,
)
from geoscene.scene import Scene
from geoscene.scene.geopackage import Layer, open_geopackage
from geoscene.support.files import atomic_file
from geoscene.support.progress import Progress, silent
from geoscene.typing import Float


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
    """Write the features as a GeoPackage: one layer for each kind, and the table ``building_solids``.

    The table has the faces, heights and volume of each building's solid but no geometry: GeoPackage has no
    type for solids, and as polygons, which are valid in plan only, their walls would be invalid.

    crs    : of the coordinates; default the scene's
    layers : names to write; default all
    """
    target = target_crs(scene, crs)
    tables = [SOLIDS] if scene.table_length("buildings") and scene.has_tiles else []
    names = chosen_layers(scene, layers, others=tables)
    layers_in_plan = [name for name in names if name != SOLIDS]
    objects = count = faces = 0
    with open_geopackage(path) as append:
        for _, chunk in _reading(scene, layers_in_plan, crs=target, stage="GeoPackage", progress=progress):
            append(chunk, geometry_type(scene, chunk.name, crs=target), target.to_wkt())
            objects += len(chunk)
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

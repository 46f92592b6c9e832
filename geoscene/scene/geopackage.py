"""Features as a GeoPackage: one layer for each kind, with the source of every value."""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.errors import BUILD_AGAIN, SceneFormatError, reading
from geoscene.geometry.frames import Frame
from geoscene.support.digests import short
from geoscene.support.files import atomic_path, not_written

_TYPES: Mapping[str, Any] = {
    "BOOLEAN": np.bool_,
    "SMALLINT": np.int16,
    "MEDIUMINT": np.int32,
    "INTEGER": np.int64,
    "FLOAT": np.float32,
    "REAL": np.float64,
    "TEXT": np.object_,
}
"""Types of values by those of columns (GeoPackage 1.4, table 1); the other columns are geometries."""

_ENVELOPES = (0, 32, 48, 48, 64)
"""Bytes of the envelope between the header of a geometry and its WKB, by code (GeoPackage 1.4, 2.1.3)."""

_DATE = "2000-01-01T00:00:00.000Z"  # constant, so that the same scene gives the same bytes


@dataclass(frozen=True, slots=True)
class Layer:
    """A layer of features: geometry type and columns.

    name     : layer name
    geometry : (n,) shapely geometries in scene metres, plan or with heights
    columns  : column name to (n,) values: numbers, booleans or str
    """

    name: str
    geometry: NDArray[np.object_]
    columns: Mapping[str, NDArray[Any]]

    def __len__(self) -> int:
        """Number of features."""
        return len(self.geometry)


def _column(values: NDArray[Any]) -> NDArray[Any]:
    if values.dtype.kind in "USO":
        return np.array([None if v is None else str(v) for v in values], object)
    if values.dtype.kind == "u" or values.dtype == np.int8:
        return values.astype(np.int32)
    return values


def _geometry_type(geometry: NDArray[np.object_]) -> str:
    """GDAL's name of the type: a multi-part one if any shape is; ``Unknown`` for shapes of several kinds."""
    kinds = {shape.geom_type for shape in geometry}
    if len({kind.removeprefix("Multi") for kind in kinds}) > 1:
        return "Unknown"
    return str(max(kinds, key=len)) + " Z" * bool(shapely.has_z(geometry).any())


@contextmanager
def open_geopackage(
    path: Path, *, indexed: bool = True
) -> Iterator[Callable[[Layer, str | None, str | None], None]]:
    """Yield a function that appends rows: a layer, its geometry type and the WKT of its CRS.

    A layer without a geometry type becomes a table of attributes; ``indexed`` ones have a spatial index.

    The file appears under its name unless the block raises; the same rows give the same bytes.

    Raises GeosceneError if GDAL cannot write.
    """
    import pyogrio  # noqa: PLC0415  (0.3 s)
    from pyogrio.errors import DataLayerError, DataSourceError  # noqa: PLC0415
    from pyogrio.raw import write  # noqa: PLC0415

    before = {"OGR_CURRENT_DATE": pyogrio.get_gdal_config_option("OGR_CURRENT_DATE")}
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": _DATE})
    try:
        with atomic_path(path, keep_suffix=True) as part:

            def append(rows: Layer, kind: str | None, crs: str | None) -> None:  # noqa: PLR0917
                write(
                    str(part),
                    geometry=shapely.to_wkb(rows.geometry) if kind else None,
                    field_data=list(rows.columns.values()),
                    fields=list(rows.columns),
                    geometry_type=kind,
                    crs=crs,
                    layer=rows.name,
                    driver="GPKG",
                    append=part.exists(),
                    layer_options={"FID": "fid", "SPATIAL_INDEX": "YES" if indexed else "NO"},
                )

            yield append
            _state_no_writer(part)
    except (DataSourceError, DataLayerError) as error:
        raise not_written(path, error) from error
    finally:
        pyogrio.set_gdal_config_options(before)


_HEADER = {18: b"\1\1", 24: (1).to_bytes(4), 92: (1).to_bytes(4) + (3_000_000).to_bytes(4)}
"""Bytes of SQLite's header that programs change which only open a file, by place: journal mode, counter of
changes, counter and version of the library of the last one (SQLite's file format, 1.3)."""


def _state_no_writer(path: Path) -> None:
    """Write constants into the header, so that the same rows give the same bytes with any library."""
    with path.open("r+b") as file:
        for place, value in _HEADER.items():
            file.seek(place)
            file.write(value)


def database_digest(path: Path) -> str:
    """Digest of a GeoPackage as it was written, also if a program has opened it since; empty if missing."""
    found = hashlib.sha256()
    try:
        with path.open("rb") as file:
            head = bytearray(file.read(100))
            for place, value in _HEADER.items():
                head[place : place + len(value)] = value
            found.update(head)
            while block := file.read(2**20):
                found.update(block)
    except OSError:
        return ""
    return short(found)


def write_geopackage(path: Path, layers: Sequence[Layer], *, frame: Frame, indexed: bool = True) -> None:
    """Write layers in the frame's projected CRS; empty layers are left out."""
    with open_geopackage(path, indexed=indexed) as append:
        for layer in filter(len, layers):
            kind, geometry = _geometry_type(layer.geometry), layer.geometry
            if kind.startswith("Multi"):
                parts, owner = shapely.get_parts(geometry, return_index=True)
                gather = shapely.multipolygons if "Polygon" in kind else shapely.multilinestrings
                geometry = gather(parts, indices=owner)
            shift = np.array([*frame.origin, 0.0][: 3 if kind.endswith(" Z") else 2])
            moved = shapely.transform(geometry, partial(np.add, shift), include_z=len(shift) == 3)
            columns = {name: _column(np.asarray(values)) for name, values in layer.columns.items()}
            append(Layer(layer.name, moved, columns), kind, frame.wkt)


@dataclass(frozen=True, slots=True)
class Schema:
    """Geometry type and columns of a layer in a GeoPackage.

    geometry_type : as GDAL names it: ``Polygon``, ``MultiPolygon Z`` ...
    columns       : column name to type; object for text
    """

    geometry_type: str
    columns: Mapping[str, np.dtype[Any]]


def read_schema(path: Path, name: str) -> Schema:
    """Geometry type and columns of a layer; raises SceneFormatError if it is missing."""
    from pyogrio import read_info  # noqa: PLC0415  (0.3 s)

    with _reading(path, name):
        info = read_info(path, layer=name)
        types = [np.dtype(kind) for kind in info["dtypes"]]
        return Schema(str(info["geometry_type"]), dict(zip(info["fields"].tolist(), types, strict=True)))


def read_layer(
    path: Path,
    name: str,
    *,
    frame: Frame,
    geometry: Literal["scene", "projected", "none"] = "scene",
    rows: range | None = None,
) -> Layer:
    """A layer that `write_geopackage` wrote.

    geometry : coordinates in scene metres or as stored, in the frame's projected CRS; ``none`` reads the
               columns only and gives None for each feature
    rows     : consecutive rows to read; all by default

    Raises SceneFormatError if the file or the layer is missing or damaged.
    """
    address = f"{path.absolute().as_uri()}?mode=ro"
    with _reading(path, name), closing(sqlite3.connect(address, uri=True)) as database:
        types = dict(database.execute("SELECT name, type FROM pragma_table_info(?) WHERE NOT pk", (name,)))
        fields = [field for field, kind in types.items() if geometry != "none" or kind in _TYPES]
        cells = _cells(database, name, fields=fields, rows=rows)
        columns = {
            field: np.array(values, _TYPES[types[field]])
            for field, values in zip(fields, cells, strict=True)
            if types[field] in _TYPES
        }
        if geometry == "none":
            return Layer(name, np.full(len(cells[0]) if cells else 0, None, object), columns)
        (blobs,) = (values for field, values in zip(fields, cells, strict=True) if field not in columns)
        shapes = shapely.from_wkb([blob[8 + _ENVELOPES[blob[3] >> 1 & 7] :] for blob in blobs])
        if geometry == "scene":
            shift = np.array(frame.origin)
            has_z = bool(shapely.has_z(shapes).any())
            shift = np.append(shift, 0.0) if has_z else shift
            shapes = shapely.transform(shapes, lambda c: c - shift, include_z=has_z)
        return Layer(name, shapes, columns)


def _cells(
    database: sqlite3.Connection, name: str, *, fields: Sequence[str], rows: range | None
) -> list[list[Any]]:
    """Values of fields of a layer, field by field."""
    quoted = [f'"{field}"' for field in fields]
    part = "" if rows is None else f" LIMIT {len(rows)} OFFSET {rows.start}"
    query = f'SELECT {", ".join(quoted)} FROM "{name}" ORDER BY fid{part}'  # noqa: S608
    found = database.execute(query).fetchall()
    return [list(values) for values in zip(*found, strict=True)] or [[] for _ in fields]


def _reading(path: Path, name: str) -> AbstractContextManager[None]:
    return reading(f"{path}, layer {name}", SceneFormatError, remedy=BUILD_AGAIN)

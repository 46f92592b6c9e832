"""Features as a GeoPackage: one layer a kind, with provenance, for QGIS and everything else."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.errors import GeosceneError, SceneFormatError
from geoscene.frames import Frame

_DATE = "2000-01-01T00:00:00Z"  # a constant, so that the same scene is the same bytes


@dataclass(frozen=True, slots=True)
class Layer:
    """One kind of feature.

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
    kinds = {str(k) for k in np.unique(shapely.get_type_id(geometry))}
    names = {
        frozenset("0"): "Point",
        frozenset("1"): "LineString",
        frozenset("3"): "Polygon",
        frozenset("6"): "MultiPolygon",
        frozenset("36"): "MultiPolygon",
        frozenset("5"): "MultiLineString",
        frozenset("15"): "MultiLineString",
    }
    name = names.get(frozenset(kinds), "Unknown")
    return f"{name} Z" if name != "Unknown" and shapely.has_z(geometry).any() else name


def write_geopackage(path: Path, layers: Sequence[Layer], *, frame: Frame) -> None:
    """Write layers in the frame's projected CRS; empty layers are left out."""
    import pyogrio  # noqa: PLC0415  (0.3 s)
    from pyogrio.errors import DataSourceError  # noqa: PLC0415
    from pyogrio.raw import write  # noqa: PLC0415

    part = path.with_name(f"{path.stem}.{os.getpid()}.part{path.suffix}")
    part.unlink(missing_ok=True)
    before = {"OGR_CURRENT_DATE": pyogrio.get_gdal_config_option("OGR_CURRENT_DATE")}
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": _DATE})
    shift = np.array(frame.origin)
    try:
        for layer in layers:
            if not len(layer):
                continue
            kind = _geometry_type(layer.geometry)
            geometry = layer.geometry
            if kind.startswith("Multi"):
                parts, owner = shapely.get_parts(geometry, return_index=True)
                gather = shapely.multipolygons if "Polygon" in kind else shapely.multilinestrings
                geometry = gather(parts, indices=owner)
            has_z = kind.endswith(" Z")
            moved = shapely.transform(
                geometry,
                (lambda c: c + np.append(shift, 0.0)) if has_z else (lambda c: c + shift),
                include_z=has_z,
            )
            write(
                str(part),
                geometry=shapely.to_wkb(moved),
                field_data=[_column(np.asarray(v)) for v in layer.columns.values()],
                fields=list(layer.columns),
                geometry_type=kind,
                crs=frame.wkt,
                layer=layer.name,
                driver="GPKG",
                append=part.exists(),
                layer_options={"FID": "fid", "SPATIAL_INDEX": "YES"},
            )
    except DataSourceError as error:
        raise GeosceneError(f"{path}: cannot be written ({error}); is the disk full?") from error
    else:
        if part.exists():
            part.replace(path)
        else:
            path.unlink(missing_ok=True)
    finally:
        pyogrio.set_gdal_config_options(before)
        part.unlink(missing_ok=True)


def read_layer(path: Path, name: str, *, frame: Frame) -> Layer:
    """A layer that `write_geopackage` wrote, geometry back in scene metres.

    Raises SceneFormatError if the file or the layer is not there.
    """
    from pyogrio.errors import DataLayerError, DataSourceError  # noqa: PLC0415
    from pyogrio.raw import read  # noqa: PLC0415

    try:
        meta, _, wkb, fields = read(path, layer=name)
    except (DataSourceError, DataLayerError) as error:
        raise SceneFormatError(f"{path}: no readable layer {name} ({error})") from error
    geometry = shapely.from_wkb(wkb)
    shift = np.array(frame.origin)
    has_z = bool(shapely.has_z(geometry).any())
    moved = shapely.transform(
        geometry, (lambda c: c - np.append(shift, 0.0)) if has_z else (lambda c: c - shift), include_z=has_z
    )
    return Layer(name, moved, dict(zip(meta["fields"], fields, strict=True)))

"""Building footprints of Overture Maps (theme ``buildings``, type ``building``) in GeoParquet."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from pyproj import CRS
from pyproj.exceptions import CRSError

from geoscene.errors import InputError, SourceNotFoundError, need, reason_of
from geoscene.geometry.frames import beside
from geoscene.sources.data import Area, Bounds, OsmData, Progress, Tags
from geoscene.sources.extent import checked_bounds, close_together
from geoscene.sources.registry import SOURCES
from geoscene.sources.rings import polygons_of
from geoscene.support.problems import Problem

_TAGS = {
    "name": "name",
    "height": "height",
    "num_floors": "building:levels",
    "min_height": "min_height",
    "min_floor": "building:min_level",
    "facade_color": "building:colour",
    "facade_material": "building:material",
    "roof_shape": "roof:shape",
    "roof_height": "roof:height",
    "roof_direction": "roof:direction",
    "roof_orientation": "roof:orientation",
    "roof_color": "roof:colour",
    "roof_material": "roof:material",
}
"""Columns of Overture's schema and the OpenStreetMap keys of the same meaning; values need no translation."""

_OTHERS = ("id", "geometry", "class", "subtype", "is_underground", "sources")
_LONGEST_KM = 10.0
"""The longest buildings have about 3 km."""

_NO_NODES = np.empty(0, np.int64)


def read_overture(path: str | Path, *, bounds: Bounds | None = None, progress: Progress = iter) -> OsmData:
    """The buildings of a GeoParquet file, or of a folder of them, as areas with OpenStreetMap's tags.

    An area's ``osm_id`` is ``overture:<id>``; its ``building`` tag is the class, else the subtype, else
    ``yes``. Columns may be missing, except ``id`` and ``geometry``. Rows that hold no polygon in degrees are
    dropped, invalid polygons repaired; both are listed in ``problems``.

    bounds : keep the buildings that intersect this box (west, south, east, north in degrees); all if None

    Raises MissingExtraError without pyarrow, SourceNotFoundError if the file is absent or has no building
    (within the bounds), InputError for a file that is damaged or of another schema or CRS.
    """
    path = Path(path)
    bounds = None if bounds is None else checked_bounds(bounds)
    rows = _read_rows(path, bounds)
    shapes = shapely.force_2d(shapely.from_wkb([row["geometry"] for row in rows], on_invalid="ignore"))
    areas: list[Area] = []
    problems: list[Problem] = []
    origins: list[dict[str, Any]] = []
    middle = None if bounds is None else (bounds[0] + bounds[2]) / 2
    for row, shape in zip(progress(rows), shapes, strict=True):
        name = f"overture:{row['id']}"
        geometry, problem = _footprint(name, shape)
        if geometry is not None:
            middle = middle if middle is not None else float(shapely.bounds(geometry)[0])
            geometry = _turn(geometry, middle)
        if bounds is not None and geometry is not None and not shapely.box(*bounds).intersects(geometry):
            continue
        if problem is not None:
            problems.append(problem)
        if geometry is not None:
            areas.append(Area(name, _tags(row), geometry, _NO_NODES))
            origins += row.get("sources") or ()
    if not areas:
        raise SourceNotFoundError(f"{path}: no buildings in it" + (" within the bounds" if bounds else ""))
    areas, extent, far = close_together(areas) if bounds is None else (areas, bounds, [])
    problems += far
    return OsmData(
        bounds=extent,
        ways=[],
        areas=sorted(areas, key=lambda area: area.osm_id),
        points=[],
        relations=[],
        problems=sorted(problems),
        source=path.name,
        timestamp=max((str(origin.get("update_time") or "") for origin in origins), default=""),
        kind="overture",
        attribution=_attribution(origins),
    )


def _read_rows(path: Path, bounds: Bounds | None) -> list[dict[str, Any]]:
    """Rows whose ``bbox`` intersects the bounds or is null, with the columns of the schema that exist."""
    errors = need("pyarrow", "gis").ArrowException
    arrow = need("pyarrow.dataset", "gis")
    if not path.exists():
        raise SourceNotFoundError(f"{path}: no such file; give a GeoParquet file of Overture Maps")
    try:
        table = arrow.dataset(path, format="parquet")
        _check_schema(path, table.schema)
        columns = {c: arrow.field(c) for c in (*_TAGS, *_OTHERS) if c in table.schema.names}
        if "names" in table.schema.names:
            columns["name"] = arrow.field("names", "primary")
        near = None
        if bounds is not None and "bbox" in table.schema.names:
            xmin, ymin, xmax, ymax = (arrow.field("bbox", edge) for edge in ("xmin", "ymin", "xmax", "ymax"))
            west, south, east, north = bounds
            across = (xmin <= east) & (xmax >= west)
            if east > 180:
                across |= xmin <= east - 360
            near = across & (ymin <= north) & (ymax >= south) | ~xmin.is_valid()
        rows: list[dict[str, Any]] = table.to_table(columns=columns, filter=near).to_pylist()
    except InputError:
        raise
    except (errors, OSError, ValueError, KeyError, TypeError, CRSError) as error:
        cause = reason_of(error)
        raise InputError(f"{path}: damaged, or not Overture's GeoParquet ({cause})") from error
    return rows


def _check_schema(path: Path, schema: Any) -> None:
    """Raise InputError if ids or geometries are missing, or the CRS is not that of degrees on WGS 84."""
    if missing := {"id", "geometry"} - set(schema.names):
        raise InputError(f"{path}: no column {', '.join(sorted(missing))}; give Overture's type building")
    geo = json.loads((schema.metadata or {}).get(b"geo", b"{}"))
    stated = geo.get("columns", {}).get("geometry", {}).get("crs")
    if stated and not CRS.from_user_input(stated).equals("OGC:CRS84", ignore_axis_order=True):
        name = stated.get("name", "of another kind") if isinstance(stated, dict) else stated
        raise InputError(f"{path}: its CRS is {name}; give longitude and latitude on WGS 84 (OGC:CRS84)")


def _footprint(name: str, shape: Any) -> tuple[Any, Problem | None]:
    """A valid (multi)polygon or None, and the repair or the reason for dropping it."""
    if shape is None:
        return None, Problem(name, "building", "dropped", "no-area", "geometry is null or no WKB")
    if not (np.abs(shapely.get_coordinates(shape)) <= (180, 90)).all():
        return None, Problem(name, "building", "dropped", "bad-coordinates", "missing or out of range")
    west, south, east, north = np.radians(shapely.bounds(shape)).tolist()
    km = 6371 * math.hypot((east - west) * math.cos((south + north) / 2), north - south)
    if km > _LONGEST_KM:
        return None, Problem(name, "building", "dropped", "bad-coordinates", f"{km:,.0f} km long")
    geometry = polygons_of(shape)
    if geometry is None:
        return None, Problem(name, "building", "dropped", "no-area", shape.geom_type)
    if shapely.is_valid(shape):
        return geometry, None
    reason = str(shapely.is_valid_reason(shape)).partition("[")[0].lower()
    return geometry, Problem(name, "building", "repaired", "self-crossing", reason)


def _turn(geometry: Any, middle_deg: float) -> Any:
    """The geometry moved by a whole turn of longitude if that brings it nearer to ``middle_deg``."""
    lon = float(shapely.bounds(geometry)[0])
    turn = round(float(beside(lon, middle_deg)) - lon)
    return shapely.transform(geometry, lambda lonlat: np.add(lonlat, (turn, 0))) if turn else geometry


def _tags(row: dict[str, Any]) -> Tags:
    """The OpenStreetMap tags of a row."""
    tags = {"building": str(row.get("class") or row.get("subtype") or "yes")}
    tags |= {key: str(row[column]) for column, key in _TAGS.items() if row.get(column) is not None}
    return tags | ({"location": "underground"} if row.get("is_underground") else {})


def _attribution(origins: Sequence[dict[str, Any]]) -> str:
    """Overture's attribution with the datasets that the buildings come from, and their licences if stated."""
    licences: dict[str, str] = {}
    for origin in origins:
        dataset = str(origin.get("dataset") or "unnamed datasets")
        licences[dataset] = str(origin.get("license") or licences.get(dataset, ""))
    if "OpenStreetMap" in licences:
        licences["OpenStreetMap contributors"] = licences.pop("OpenStreetMap") or "ODbL-1.0"
    listed = ", ".join(
        f"{name} ({licence})" if licence else name for name, licence in sorted(licences.items())
    )
    return SOURCES["overture"].attribution + (f"; buildings from {listed}" if listed else "")

"""Buildings in the schema of Overture Maps, as GeoParquet files."""

import json

import pyarrow as pa
import shapely
from pyarrow import parquet

from geoscene.tags import parse_length, parse_number

SOURCE = pa.struct(
    [(name, pa.string()) for name in ("property", "dataset", "license", "record_id", "update_time")]
)
SCHEMA = pa.schema(
    [
        ("id", pa.string()),
        ("geometry", pa.binary()),
        ("bbox", pa.struct([(edge, pa.float32()) for edge in ("xmin", "xmax", "ymin", "ymax")])),
        ("sources", pa.list_(SOURCE)),
        ("names", pa.struct([("primary", pa.string())])),
        *[(name, pa.string()) for name in ("subtype", "class")],
        *[(name, pa.float64()) for name in ("height", "min_height", "roof_height", "roof_direction")],
        *[(name, pa.int32()) for name in ("num_floors", "min_floor")],
        *[(name, pa.string()) for name in ("facade_color", "facade_material", "roof_color")],
        *[(name, pa.string()) for name in ("roof_shape", "roof_material", "roof_orientation")],
        *[(name, pa.bool_()) for name in ("is_underground", "has_parts")],
    ]
)
"""Columns of theme buildings, type building (Overture schema 1.18)."""


def write_overture(path, rows, *, geo=None):
    table = pa.Table.from_pylist([_whole(row) for row in rows], SCHEMA)
    geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": geo or {}}}
    parquet.write_table(table.replace_schema_metadata({"geo": json.dumps(geo)}), path, row_group_size=50)
    return path


def _whole(row):
    shape = row.get("geometry")
    shape = shapely.from_wkt(shape) if isinstance(shape, str) else shape
    if isinstance(shape, shapely.Geometry):
        edges = zip(("xmin", "ymin", "xmax", "ymax"), shape.bounds, strict=True)
        row = {"bbox": dict(edges)} | row | {"geometry": shapely.to_wkb(shape, include_srid=True)}
    return row


def overture_row(area):
    """A row in Overture's schema of a building of OpenStreetMap."""
    tags = area.tags
    levels = parse_number(tags.get("building:levels"))
    kind, number = area.osm_id.split("/")
    return {
        "id": f"id-of-{kind}-{number}",
        "geometry": area.geometry,
        "sources": [{"dataset": "OpenStreetMap", "record_id": f"{kind[0]}{number}@1", "license": "ODbL-1.0",
                     "update_time": "2024-04-26T23:55:01Z"}],
        "names": {"primary": tags["name"]} if "name" in tags else None,
        "class": tags["building"] if tags["building"] != "yes" else None,
        "height": parse_length(tags.get("height")),
        "num_floors": None if levels is None else int(levels),
        "facade_color": tags.get("building:colour"),
        "facade_material": tags.get("building:material"),
        "roof_shape": tags.get("roof:shape", "").replace("half-hipped", "half_hipped") or None,
        "roof_material": tags.get("roof:material"),
    }  # fmt: skip

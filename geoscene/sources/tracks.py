"""Points of routes and recorded tracks, read from GPX and GeoJSON files."""

from __future__ import annotations

import codecs
import json
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.errors import InputError, SourceNotFoundError, reason_of
from geoscene.typing import Float

_Point = tuple[float, float, float]
_HIGHEST_M = 1e5


def read_track(path: Path) -> Float:
    """Points (n, 3) of a file in order: longitude and latitude in degrees, height in metres or 0.

    Of a GPX file these are its tracks, else its routes, else its waypoints; of a GeoJSON file its lines and
    points. GPX may be in any encoding that its XML declaration names, GeoJSON in UTF-8, UTF-16 or UTF-32.

    Raises SourceNotFoundError for a missing file and InputError for one that cannot be read.
    """
    if not path.exists():
        raise SourceNotFoundError(f"{path} does not exist")
    data = path.read_bytes()
    read = _gpx if _is_xml(data) else _geojson
    points = np.array(read(path, data), float).reshape(-1, 3)
    lon, lat, height = points.T
    if not (np.isfinite(points).all() and (np.abs(lat) <= 90).all() and (np.abs(lon) <= 180).all()):
        raise InputError(f"{path}: coordinates are not longitudes and latitudes in degrees")
    if (np.abs(height) > _HIGHEST_M).any():
        raise InputError(f"{path}: heights exceed {_HIGHEST_M:g} m")
    return points


def _is_xml(data: bytes) -> bool:
    """Whether a file's first character, in any encoding, is that of XML."""
    for mark in (codecs.BOM_UTF8, codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        data = data.removeprefix(mark)
    return data.lstrip(b"\x00 \t\r\n").startswith(b"<")


def _gpx(path: Path, data: bytes) -> list[_Point]:
    try:
        root = ET.fromstring(data)  # noqa: S314  (expat bounds the growth of entities)
    except (ET.ParseError, ValueError, LookupError) as error:  # of an encoding that is unknown or not kept to
        raise InputError(f"{path}: not readable as GPX: {reason_of(error)}") from error
    for tag in ("trkpt", "rtept", "wpt"):
        found = [e for e in root.iter() if e.tag.rsplit("}", 1)[-1] == tag]
        if found:
            try:
                return [(float(e.attrib["lon"]), float(e.attrib["lat"]), _elevation(e)) for e in found]
            except (KeyError, ValueError) as error:
                raise InputError(f"{path}: a {tag} without a readable lat and lon") from error
    return []


def _elevation(element: ET.Element) -> float:
    for child in element:
        if child.tag.rsplit("}", 1)[-1] == "ele" and child.text:
            return float(child.text)
    return 0.0


def _geojson(path: Path, data: bytes) -> list[_Point]:
    lines: list[Any] = []
    for shape in read_geometries(path, data):
        kind, at = shape.get("type"), shape.get("coordinates") or []
        if kind in ("LineString", "MultiPoint"):
            lines.append(at)
        elif kind == "MultiLineString":
            lines.extend(at)
        elif kind == "Point":
            lines.append([at])
    try:
        return [
            (float(p[0]), float(p[1]), float(p[2]) if len(p) > 2 else 0.0) for line in lines for p in line
        ]
    except (TypeError, ValueError, LookupError) as error:
        raise InputError(f"{path}: coordinates that are not numbers") from error


def read_geometries(path: Path, data: bytes) -> list[dict[str, Any]]:
    """The geometries, as JSON objects, of a GeoJSON file's contents: of its features, or the file's own.

    Raises InputError for a file that is not JSON or whose features are not a list.
    """
    try:
        document = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: neither GPX (XML) nor GeoJSON (JSON)") from error
    if not isinstance(document, dict):
        raise InputError(f"{path}: JSON, but not GeoJSON")
    features = document.get("features", [document])
    if not isinstance(features, list):
        raise InputError(f"{path}: its features are not a list")
    objects = [feature for feature in features if isinstance(feature, dict)]
    shapes = [feature.get("geometry") or feature for feature in objects]
    return [shape for shape in shapes if isinstance(shape, dict)]

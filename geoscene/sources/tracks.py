"""Points of routes and recorded tracks, read from GPX and GeoJSON files."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.errors import InputError, SourceNotFoundError
from geoscene.typing import Float

_Point = tuple[float, float, float]


def read_track(path: Path) -> Float:
    """Points (n, 3) of a file in order: longitude and latitude in degrees, height in metres or 0.

    Of a GPX file these are its tracks, else its routes, else its waypoints; of a GeoJSON file its lines and
    points.

    Raises SourceNotFoundError for a missing file and InputError for one that cannot be read.
    """
    if not path.exists():
        raise SourceNotFoundError(f"{path} does not exist")
    try:
        text = path.read_text("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: neither GPX (XML) nor GeoJSON (JSON)") from error
    points = np.array(_gpx(path, text) if text.lstrip().startswith("<") else _geojson(path, text), float)
    lon, lat = points.reshape(-1, 3)[:, :2].T
    if not (np.isfinite(lon).all() and (np.abs(lat) <= 90).all() and (np.abs(lon) <= 180).all()):
        raise InputError(f"{path}: coordinates are not longitudes and latitudes in degrees")
    return points.reshape(-1, 3)


def _gpx(path: Path, text: str) -> list[_Point]:
    try:
        root = ET.fromstring(text)  # noqa: S314  (expat bounds the growth of entities)
    except ET.ParseError as error:
        raise InputError(f"{path}: not readable as GPX: {error}") from error
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


def _geojson(path: Path, text: str) -> list[_Point]:
    try:
        document = json.loads(text)
    except ValueError as error:
        raise InputError(f"{path}: neither GPX (XML) nor GeoJSON (JSON)") from error
    features = document.get("features", [document]) if isinstance(document, dict) else []
    shapes = [f.get("geometry") or f for f in features if isinstance(f, dict)]
    lines: list[Any] = []
    for shape in shapes:
        kind, at = shape.get("type"), shape.get("coordinates") or []
        if kind in {"LineString", "MultiPoint"}:
            lines.append(at)
        elif kind == "MultiLineString":
            lines.extend(at)
        elif kind == "Point":
            lines.append([at])
    try:
        return [
            (float(p[0]), float(p[1]), float(p[2]) if len(p) > 2 else 0.0) for line in lines for p in line
        ]
    except (TypeError, ValueError, IndexError) as error:
        raise InputError(f"{path}: coordinates that are not numbers") from error

"""A route on the map, for building only what is seen from it."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from geoscene.errors import InputError, SourceNotFoundError
from geoscene.frames import Frame
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.routing import nearest_edge, path_line, shortest_path
from geoscene.typing import Float


def route_line(words: Sequence[str], graph: RoadGraph, *, frame: Frame) -> Any:
    """The route as a shapely line or points, scene metres.

    words : two or more waypoints ``LAT,LON`` (joined over the road graph), or one file: GPX, GeoJSON, or CSV
            with columns lon and lat (a dataset's ``poses.csv``), taken as it is

    Raises InputError for words that are neither and SourceNotFoundError for a missing file.
    """
    given = [word.strip() for word in words]
    if len(given) == 1 and "," not in given[0]:
        lonlat = _read_lonlat(Path(given[0]))
        xy = np.column_stack(frame.from_geographic(*lonlat.T))
        return shapely.LineString(xy) if len(xy) > 1 else shapely.Point(xy[0])
    try:
        latlon = np.array([[float(v) for v in word.split(",")] for word in given])
        lat, lon = latlon.T
    except ValueError:
        raise InputError(f"`along` {' '.join(given)}: a file, or two or more LAT,LON") from None
    if len(lat) < 2:
        raise InputError(f"`along` {given[0]}: one waypoint is no route; give two or more, or a file")
    xy = np.column_stack(frame.from_geographic(lon, lat))
    edges, offsets, distances = nearest_edge(graph, xy)
    if distances.max() > 100.0:
        far = int(distances.argmax())
        raise InputError(f"`along` {given[far]}: {distances[far]:.0f} m from the nearest road; at most 100")
    places = list(zip(edges.tolist(), offsets.tolist(), strict=True))
    lines = []
    for a, b in pairwise(places):
        path = shortest_path(graph, a, goal=b)
        if path is None:
            raise InputError(f"`along` {' '.join(given)}: no way to drive from one waypoint to the next")
        lines.append(path_line(graph, path)[:, :2])
    return shapely.LineString(np.concatenate(lines))


def _read_lonlat(path: Path) -> Float:
    if not path.exists():
        raise SourceNotFoundError(f"{path}: no such file; `along` takes GPX, GeoJSON, CSV, or LAT,LON")
    text = path.read_text("utf-8", errors="replace")
    try:
        if path.suffix.lower() == ".csv":
            rows = list(csv.DictReader(text.splitlines()))
            pairs = [(float(row["lon"]), float(row["lat"])) for row in rows]
        elif path.suffix.lower() == ".gpx":
            points = re.findall(r"<(?:trkpt|rtept|wpt)\b([^>]*)>", text)
            pairs = [(_attribute(p, "lon"), _attribute(p, "lat")) for p in points]
        else:
            geometry = shapely.from_geojson(json.dumps(json.loads(text)))
            pairs = [(float(x), float(y)) for x, y in shapely.get_coordinates(geometry)]
    except (ValueError, KeyError, TypeError, shapely.errors.GEOSException) as error:
        raise InputError(f"{path}: not a readable route ({error})") from error
    if not pairs:
        raise InputError(f"{path}: holds no points")
    return np.array(pairs)


def _attribute(text: str, name: str) -> float:
    found = re.search(rf"\b{name}\s*=\s*[\"']([^\"']+)[\"']", text)
    if found is None:
        raise ValueError(f"a point without {name}")
    return float(found.group(1))

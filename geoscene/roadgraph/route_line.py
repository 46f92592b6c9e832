"""The line of a route, for building only the tiles along it."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from geoscene.errors import InputError, SourceNotFoundError, reading
from geoscene.geometry.frames import Frame
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.routing import nearest_edge, path_line, shortest_path
from geoscene.sources.tracks import read_track
from geoscene.typing import Float


def route_line(words: Sequence[str], graph: RoadGraph, *, frame: Frame) -> Any:
    """The route as a shapely line or points, scene metres.

    words : two or more waypoints ``LAT,LON`` (joined over the road graph), or one file: GPX, GeoJSON, or CSV
            with columns lon and lat (a dataset's ``poses.csv``), used as it is

    Raises InputError for other words and SourceNotFoundError for a missing file.
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
    if not ((np.abs(lat) <= 90) & (np.abs(lon) <= 180)).all():
        raise InputError(f"`along` {' '.join(given)}: not latitudes and longitudes in degrees")
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
    """Longitudes and latitudes (n, 2) of the points in a file."""
    if not path.exists():
        raise SourceNotFoundError(f"{path}: no such file; a route is GPX, GeoJSON, CSV, or LAT,LON")
    if path.suffix.lower() != ".csv":
        points = read_track(path)[:, :2]
    else:
        with reading(path, InputError, remedy="give a CSV file with columns lon and lat"):
            rows = list(csv.DictReader(path.read_text("utf-8", errors="replace").splitlines()))
            points = np.array([(float(row["lon"]), float(row["lat"])) for row in rows])
    if not len(points):
        raise InputError(f"{path}: holds no points")
    return points

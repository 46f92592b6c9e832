"""Extremes of scale: wide scenes with next to nothing on them."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np

from geoscene.geometry.frames import Frame
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.scene import Scene
from geoscene.sources import read_osm
from geoscene.typing import Float, Ints
from lidar.tools.selftest.case import ExtremeCase

_PLACE = (10.0, 47.0)
_POST = 1 / 1200
"""Degrees between the posts of the elevation models, as of SRTM (90 m)."""


def empty_level(count: int) -> float:
    """CPU seconds in which an empty scene on a level elevation model is built."""
    return _built(count, roughness=0.0)[0]


def empty_rough(count: int) -> float:
    """CPU seconds in which an empty scene in mountains is built."""
    return _built(count, roughness=1.0)[0]


def gaps(count: int) -> float:
    """Edges within the ground of an empty scene in mountains that do not join two faces."""
    return _built(count, roughness=1.0)[1]


def _built(count: int, *, roughness: float) -> tuple[float, float]:
    """CPU seconds of building an empty scene of ``count`` km, and the number of gaps in its ground."""
    frame, half = Frame.at(*_PLACE), count * 500.0
    lon, lat = frame.to_geographic(np.array([-half, half]), np.array([-half, half]))
    with tempfile.TemporaryDirectory() as folder:
        path, raster = Path(folder) / "map.osm", Path(folder) / "dem.tif"
        _write_street(path)
        _write_mountains(raster, reach=half + 5000, roughness=roughness)
        osm = read_osm(path, bounds=(float(lon[0]), float(lat[0]), float(lon[1]), float(lat[1])))
        start = time.process_time()
        scene = build(osm, Path(folder) / "scene", options=BuildOptions(dem=(str(raster),)))
        return time.process_time() - start, float(_open_edges(scene))


def _write_street(path: Path) -> None:
    """Write an OSM file of a street of about 100 m."""
    lon, lat = _PLACE
    nodes = "".join(f'<node id="{k}" lon="{lon + k / 1000}" lat="{lat}"/>' for k in (1, 2))
    way = '<way id="1"><nd ref="1"/><nd ref="2"/><tag k="highway" v="residential"/></way>'
    path.write_text(f'<osm version="0.6">{nodes}{way}</osm>')


def _write_mountains(path: Path, *, reach: float, roughness: float) -> None:
    """Write a raster that reaches some metres from the place: 1,500 m high, and as rough as the Alps if 1."""
    import rasterio  # noqa: PLC0415 - slow to import
    from scipy.ndimage import map_coordinates  # noqa: PLC0415

    lon, lat = _PLACE
    columns, rows = (int(reach / m / _POST) * 2 for m in (111_000 * np.cos(np.radians(lat)), 111_000))
    heights, rng = np.full((rows, columns), 1500.0), np.random.default_rng(6)
    for octave in range(10):
        waves = 4 * 2.0**octave  # knots of noise along 100 km
        knots = rng.normal(0, 500 * 0.55**octave, (round(waves) + 4, round(waves) + 4))
        at = np.meshgrid(*(np.arange(n) / 1200 * waves % waves for n in (rows, columns)), indexing="ij")
        heights += roughness * map_coordinates(knots, at, order=1)
    corner = rasterio.Affine(_POST, 0.0, lon - columns / 2 * _POST, 0.0, -_POST, lat + rows / 2 * _POST)
    shape = {"width": columns, "height": rows, "count": 1, "dtype": "float32"}
    with rasterio.open(path, "w", driver="GTiff", crs="EPSG:4326", transform=corner, **shape) as raster:
        raster.write(heights.astype(np.float32), 1)


def _open_edges(scene: Scene) -> int:
    """Edges of the ground that do not join two faces, those along the extent's border aside."""
    vertices: list[Float] = []
    faces: list[Ints] = []
    first = 0
    for i, j in scene.tile_indices:
        tile = scene.tile(i, j=j)
        ground = tile.mesh.take(~tile.mesh.closed)
        vertices.append(ground.vertices + tile.origin)
        faces.append(ground.faces.astype(np.int64) + first)
        first += len(ground.vertices)
    points, number = np.unique(np.concatenate(vertices), axis=0, return_inverse=True)
    corners = number.ravel()[np.concatenate(faces)]
    ends = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    edge, joined = np.unique(ends[:, 0] * len(points) + ends[:, 1], return_counts=True)
    a, b = (points[n, :2] for n in np.divmod(edge, len(points)))
    xmin, ymin, xmax, ymax = scene.bounds
    border = ((a == b) & ((a == (xmin, ymin)) | (a == (xmax, ymax)))).any(axis=1)
    return int(np.count_nonzero(joined[~border] != 2) + np.count_nonzero(joined[border] != 1))


_TIME = "triangles where the terrain needs them"

CASES = (
    ExtremeCase(
        "scale", "empty scene, level elevation model", 60, "CPU s", empty_level, "km wide", 5, 100, _TIME
    ),
    ExtremeCase("scale", "empty scene in mountains", 60, "CPU s", empty_rough, "km wide", 5, 100, _TIME),
    ExtremeCase(
        "scale", "gaps in the ground of an empty scene in mountains", 0, "edges", gaps, "km wide", 5, 100, ""
    ),
)
"""Extremes of the size of a scene."""
